"""Tampered ``entry.json`` and files: each is refused with a message that names field or file."""

import lzma
import os

import pytest
from helpers_submission import Draft, assert_refused

from oodd_eval.data.files import compress as pack
from oodd_eval.data.split import published_digests

MINI = published_digests()["mini"]


def entry(**changes):
    return lambda d: d.entry.update(changes)


def environment(**changes):
    return lambda d: d.entry["environment"].update(changes)


def renamed_split(name, digest):
    """Claim everywhere that the records are of another split."""

    def change(d):
        d.entry.update(split=name, split_digest=digest)
        for r in d.records:
            r.update(split=name, split_digest=digest)

    return change


def names_a_file(name):
    return lambda d: d.entry["files"].update({name: {"sha256": "0" * 64, "bytes": 1}})


def wrong_digest(d):
    d.sealed = False
    d.entry["files"]["records.jsonl"]["sha256"] = "0" * 64


def wrong_size(d):
    d.write()
    d.sealed = False
    d.entry["files"]["records.jsonl"]["bytes"] += 1
    d.seal()


FIELDS = {
    "title-missing": (lambda d: d.entry.pop("title"), "title"),
    "title-empty": (entry(title=""), "title"),
    "title-too-long": (entry(title="x" * 121), "title"),
    "html-in-title": (entry(title="<script>alert(1)</script>"), "title"),
    "link-in-caption": (entry(caption="[x](javascript:1)"), "caption"),
    "control-character": (entry(citation="a\x1b[31mred"), "citation"),
    "command": (entry(command="oodd-eval run --detector rf"), "command"),
    "filler-title": (entry(title="\u3164"), "title"),
    "first-year": (entry(created="0001-01-01"), "created"),
    "reversed-text": (entry(caption="a\u202eb"), "caption"),
    "two-lines": (entry(caption="a\nb"), "caption"),
    "javascript-url": (entry(url="javascript:alert(1)"), "url"),
    "unknown-field": (entry(script="x"), "script"),
    "html-in-field-name": (entry(**{"<b>": 1}), "<b>"),
    "truth-as-schema": (entry(schema=True), "schema"),
    "protocol": (entry(protocol=99), "protocol"),
    "id-of-another": (entry(id="another"), "id"),
    "id-path": (entry(id="../../x"), "id"),
    "detectors-html": (entry(detectors=["<i>"]), "detectors[0]"),
    "detectors-order": (entry(detectors=["random", "persistence"]), "detectors"),
    "detectors-too-many": (entry(detectors=["persistence", "random", "riqn"]), "detectors"),
    "grant-of-its-own": (entry(grant={"by": "A", "how": "B"}), "grant"),
    "swapped-digest": (entry(split_digest="a" * 64), "split_digest"),
    "published-digest-renamed": (renamed_split("small", MINI), "split"),
    "published-name-taken": (renamed_split("mini", "1" * 64), "split_digest"),
    "name-not-published-yet": (renamed_split("paper", "2" * 64), "split_digest"),
    "split-suffix": (renamed_split("mini@12345678", "3" * 64), "split"),
    "split-path": (renamed_split("../x", "3" * 64), "split"),
    "plugins-empty": (entry(plugins=[]), "plugins"),
    "plugin-source": (lambda d: d.entry["plugins"][0].update(source_digest="e" * 64), "plugins"),
    "plugin-twice": (lambda d: d.entry["plugins"].append(d.entry["plugins"][0]), "plugins"),
    "python": (environment(python="9.9"), "environment.python"),
    "packages-html": (environment(packages={"<b>": "1"}), "environment.packages.<b>"),
    "primary-of-no-record": (entry(primary=["rf"]), "primary"),
    "primary-twice": (entry(primary=["persistence", "persistence"]), "primary"),
    "primary-html": (entry(primary=["<b>"]), "primary[0]"),
    "primary-in-other-words": (entry(primary=["persistence[h=1]"]), "primary"),
    "file-above": (names_a_file("../../etc/passwd"), "files.../../etc/passwd"),
    "file-in-disguise": (names_a_file("scores/..h5"), "files.scores/..h5"),
    "file-absent": (names_a_file("curves.json"), "files.curves.json"),
    "file-not-named": (entry(files={}), "files.records.jsonl"),
    "file-digest": (wrong_digest, "files.records.jsonl.sha256"),
    "file-size": (wrong_size, "files.records.jsonl.bytes"),
}  # fmt: skip


@pytest.mark.parametrize("case", FIELDS)
def test_a_tampered_entry_is_refused_by_its_field(submissions, tmp_path, case):
    tamper, field = FIELDS[case]
    draft = Draft(submissions.plain, tmp_path)
    tamper(draft)
    assert_refused(draft.verdict(), field)


def raw(name, content):
    """Replace the content of a file, with fitting digests."""

    def change(d):
        d.write()
        d.file(name).write_bytes(content(d.file(name).read_bytes()))
        if name != "entry.json":
            d.seal()

    return change


def sparse(name, size):
    """Make a file huge without writing it."""

    def change(d):
        d.write()
        with d.file(name).open("r+b") as file:
            file.truncate(size)

    return change


def extra(name, content=b"x"):
    def change(d):
        d.write()
        d.file(name).parent.mkdir(parents=True, exist_ok=True)
        d.file(name).write_bytes(content() if callable(content) else content)

    return change


def symlink(name):
    def change(d):
        d.write()
        d.file(name).rename(d.path.parent / "elsewhere")
        d.file(name).symlink_to(d.path.parent / "elsewhere")

    return change


def link_to_a_directory(d):
    d.write()
    d.file("scores").symlink_to("/etc")


def pipe(d):
    d.write()
    d.file("records.jsonl").unlink()
    os.mkfifo(d.file("records.jsonl"))


def many_files(d):
    d.write()
    for i in range(2100):
        d.file(f"{i}.txt").touch()


def removed(name):
    def change(d):
        d.write()
        d.file(name).unlink()

    return change


def packed(content, name="records.jsonl", ending=".gz"):
    def change(d):
        d.write()
        if name == "entry.json":
            d.file(name).rename(d.file(name + ending))
        else:
            d.packed(name, content() if callable(content) else content, ending)

    return change


def by_xz(content):
    return packed(content, ending=".xz")


def both(first, second):
    def change(d):
        first(d)
        second(d)
        d.seal()

    return change


NESTED = b"[" * 100_000 + b"]" * 100_000

FILES = {
    "truncated": (raw("records.jsonl", lambda b: b[:-1]), "records.jsonl:16"),
    "truncated-in-a-record": (raw("records.jsonl", lambda b: b[: len(b) // 2]), "records.jsonl:"),
    "no-records": (raw("records.jsonl", lambda _: b""), "records.jsonl"),
    "other-line-ends": (
        raw("records.jsonl", lambda b: b.replace(b"\n", b"\r\n")), "records.jsonl:1",
    ),
    "not-utf8-records": (
        raw("records.jsonl", lambda b: b.replace(b"ok", b"\xff\xfe", 1)), "records.jsonl",
    ),
    "not-utf8-entry": (raw("entry.json", lambda b: b + b"\xff"), "entry.json"),
    "a-list": (raw("entry.json", lambda _: b"[]"), "entry.json"),
    "a-number": (raw("records.jsonl", lambda _: b"1\n"), "records.jsonl:1"),
    "nested-entry": (raw("entry.json", lambda _: NESTED), "entry.json"),
    "nested-record": (raw("records.jsonl", lambda _: NESTED + b"\n"), "records.jsonl:1"),
    "huge-number": (
        raw("records.jsonl", lambda b: b.replace(b'"seed": 0', b'"seed": 1' + b"0" * 5000, 1)),
        "records.jsonl:1",
    ),
    "large-number": (
        raw("records.jsonl", lambda b: b.replace(b'"seed": 0', b'"seed": 1' + b"0" * 400, 1)),
        "seed",
    ),
    "infinite-number": (
        raw("records.jsonl", lambda b: b.replace(b'"low": ', b'"low": 1e999, "x": ', 1)),
        "metrics.auc.low",
    ),
    "name-twice": (raw("entry.json", lambda b: b[:-1] + b', "caption": "x"}'), "entry.json"),
    "huge-entry": (raw("entry.json", lambda b: b + b" " * 300_000), "entry.json"),
    "huge-records": (sparse("records.jsonl", 10**9), "records.jsonl"),
    "huge-line": (
        raw("records.jsonl", lambda b: b.replace(b"{", b"{" + b" " * 5_000_000, 1)),
        "records.jsonl:1",
    ),
    "script": (extra("install.py"), "install.py"),
    "pickle": (extra("model.pkl", b"\x80\x04."), "model.pkl"),
    "directory": (extra("src/x.py"), "src"),
    "name-with-new-line": (extra("a\nb.h5"), "a\\nb.h5"),
    "many-files": (many_files, "entry"),
    "linked-records": (symlink("records.jsonl"), "records.jsonl"),
    "linked-entry": (symlink("entry.json"), "entry.json"),
    "linked-directory": (link_to_a_directory, "scores"),
    "pipe": (pipe, "records.jsonl"),
    "packed-and-plain": (extra("records.jsonl.gz", pack(b"{}")), "records.jsonl.gz"),
    "packed-bomb": (packed(lambda: pack(b" " * 64_000_001)), "records.jsonl.gz"),
    "packed-large": (packed(lambda: b"x" * 8_000_001), "records.jsonl.gz"),
    "packed-cut-off": (packed(pack(b"{}\n")[:-3]), "records.jsonl.gz"),
    "packed-with-a-tail": (packed(pack(b"{}\n") + b"x"), "records.jsonl.gz"),
    "packed-twice-in-a-row": (packed(pack(b"{}\n") * 2), "records.jsonl.gz"),
    "xz-and-gzip": (
        both(packed(None), extra("records.jsonl.xz", lzma.compress(b"{}"))), "records.jsonl.gz"
    ),
    "xz-bomb": (by_xz(lambda: lzma.compress(b" " * 64_000_001)), "records.jsonl.xz"),
    "xz-for-much-memory": (
        by_xz(lzma.compress(b"{}\n", filters=[{"id": lzma.FILTER_LZMA2, "dict_size": 2**29}])),
        "records.jsonl.xz",
    ),
    "xz-entry": (packed(None, "entry.json", ".xz"), "entry.json.xz"),
    "packed-nonsense": (packed(pack(b"hello\n")), "records.jsonl.gz:1"),
    "packed-not-utf8": (packed(pack(b"\xff\n")), "records.jsonl.gz"),
    "packed-entry": (packed(None, "entry.json"), "entry.json.gz"),
    "packed-curves-bomb": (
        both(
            extra("curves.json.gz", lambda: pack(b" " * 16_000_001)), names_a_file("curves.json.gz")
        ),
        "curves.json.gz",
    ),
    "records-removed": (removed("records.jsonl"), "records.jsonl"),
    "entry-removed": (removed("entry.json"), "entry.json"),
}  # fmt: skip


@pytest.mark.parametrize("case", FILES)
def test_tampered_files_are_refused_by_name(submissions, tmp_path, case):
    tamper, name = FILES[case]
    draft = Draft(submissions.plain, tmp_path)
    tamper(draft)
    assert_refused(draft.verdict(), name)


def test_an_entry_that_is_a_link_is_refused(submissions, tmp_path):
    from oodd_leaderboard.verify import verify_entry

    link = tmp_path / submissions.plain.name
    link.symlink_to(submissions.plain)
    assert_refused(verify_entry(link), "entry", "is a link or a file")


def test_messages_hold_no_control_characters(submissions, tmp_path):
    draft = Draft(submissions.plain, tmp_path)
    draft.entry.update({"id": "\x1b[2J", "\x1b[31mfield": 1, "detectors": ["\x07"]})
    draft.entry["environment"]["packages"]["\x1b]0;x"] = "1"
    draft.records[0]["metrics"]["\x1b[2J"] = {}
    draft.records[1]["\x1b[2J"] = 1
    extra("\x1b[2J.txt")(draft)
    problems = draft.verdict().findings.problems
    assert len(problems) >= 6
    assert all(problem.text.isprintable() for problem in problems)


@pytest.mark.parametrize("seed", range(12))
def test_random_damage_is_a_problem_and_never_a_crash(submissions, tmp_path, seed):
    import numpy as np

    rng = np.random.default_rng(seed)
    draft = Draft(submissions.plain, tmp_path)
    name = "entry.json" if seed % 3 == 0 else "records.jsonl"
    content = bytearray(draft.file(name).read_bytes())
    for _ in range(5):
        at = int(rng.integers(len(content)))
        content[at : at + int(rng.integers(3))] = rng.bytes(int(rng.integers(1, 4)))
    draft.file(name).write_bytes(bytes(content))
    draft.written = True
    assert not draft.verdict().ok
