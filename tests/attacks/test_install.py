"""Wheels of strangers: nothing of them runs when they are installed, and nothing is replaced."""

import hashlib
import os
import tarfile
from dataclasses import replace

import numpy as np
import pytest
from helpers_wheel import write_wheel
from oodd_leaderboard import install as installing
from oodd_leaderboard.entry import Entry
from oodd_leaderboard.install import install

from oodd_eval.errors import PluginError

RUNS = "raise SystemExit('a stranger runs')\n"


@pytest.fixture(autouse=True)
def offline(monkeypatch, tmp_path):
    """No index, and a folder of wheels in place of one."""
    for name, value in {"NO_INDEX": "1", "FIND_LINKS": str(tmp_path / "index")}.items():
        monkeypatch.setenv(f"PIP_{name}", value)
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    (tmp_path / "index").mkdir()


@pytest.fixture
def entry(tmp_path):
    """Return the entry of a wheel that is written beside it."""

    def made(files=(), requires=(), name="oodd-mine", **fields):
        wheel = write_wheel(tmp_path / "entries/mine", name, "1.0", {**dict(files)}, requires)
        wheel.with_name("entry.toml").write_text("")
        digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
        return Entry("mine", **({"wheel": wheel.name, "sha256": digest} | fields))

    return made


@pytest.fixture
def refusal(tmp_path):
    """Return why an entry is not installed: nothing of it is there."""

    def reason(entry):
        with pytest.raises(PluginError) as refused:
            install(entry, tmp_path / "entries", tmp_path / "packages/mine")
        assert [*tmp_path.glob("packages/*")] == []
        assert str(refused.value).isprintable()
        return str(refused.value)

    return reason


def test_what_an_entry_lacks_is_installed_with_it_and_nothing_runs(entry, tmp_path):
    write_wheel(tmp_path / "index", "lacking", "3.1", {"lacking.py": RUNS})
    files = dict.fromkeys(
        ("oodd_mine.py", "sitecustomize.py", "runs.pth", "numpy/__init__.py"), RUNS
    )
    mine = entry(files, requires=("lacking>=3", "numpy>=1", "oodd-eval", "never; extra == 'x'"))
    target = tmp_path / "packages/mine"
    (target / "old").mkdir(parents=True)
    installed = install(mine, tmp_path / "entries", target)
    assert [(i["distribution"], i["version"]) for i in installed] == [
        ("oodd-mine", "1.0"), ("lacking", "3.1"),
    ]  # fmt: skip
    assert installed[0]["sha256"] == mine.sha256
    found = {path.name for path in target.iterdir()} - {"numpy"}
    assert found == {
        "oodd_mine.py", "sitecustomize.py", "runs.pth", "lacking.py", "oodd_mine-1.0.dist-info",
        "lacking-3.1.dist-info",
    }  # fmt: skip
    assert [path.name for path in (tmp_path / "packages").iterdir()] == ["mine"]


def test_a_row_that_is_shipped_needs_nothing(tmp_path):
    assert install(Entry("rf"), tmp_path, tmp_path / "packages") == []


def test_nothing_that_is_installed_here_is_replaced(entry, refusal, tmp_path):
    write_wheel(tmp_path / "index", "numpy", "1.0", {"numpy.py": RUNS})
    reason = refusal(entry(requires=("numpy==1.0",)))
    assert f"numpy 1.0 would replace {np.__version__}" in reason


def test_a_file_at_a_url_is_refused_before_pip_runs_code_of_it(entry, refusal, tmp_path):
    (tmp_path / "evil").mkdir()
    (tmp_path / "evil/setup.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')\n")
    with tarfile.open(tmp_path / "evil-1.tar.gz", "w:gz") as archive:
        archive.add(tmp_path / "evil", "evil-1")
    requirement = f"evil @ file://{tmp_path}/evil-1.tar.gz"
    assert repr(requirement)[1:60] in refusal(entry(requires=(requirement,)))
    assert not (tmp_path / "ran").exists()


def test_a_distribution_that_a_wheel_brings_along_is_refused(entry, refusal):
    data = "oodd_mine-1.0.data/purelib/numpy-9.dist-info/METADATA"
    reason = refusal(entry({data: "Metadata-Version: 2.1\nName: numpy\nVersion: 9\n"}))
    assert "numpy 9 has the name of" in reason


def test_a_wheel_of_what_is_installed_here_is_refused_with_the_way_out(entry, refusal):
    reason = refusal(entry(name="pytest"))
    assert f"pytest {pytest.__version__} is installed here already" in reason
    assert "`pip uninstall pytest`" in reason


MEMBERS = ("../oodd_mine.py", "a/../../b.py", "/etc/x", "a\\..\\b", "a\nb")


@pytest.mark.parametrize("member", MEMBERS)
def test_a_file_outside_its_directory_is_refused(entry, refusal, member):
    assert "expected one inside" in refusal(entry({member: RUNS}))


@pytest.mark.parametrize(("limit", "value"), [("MOST_FILES", 3), ("MOST_BYTES", 10**6)])
def test_a_wheel_beyond_the_bounds_is_not_unpacked(entry, refusal, monkeypatch, limit, value):
    monkeypatch.setattr(installing, limit, value)
    assert "expected at most" in refusal(entry({"a.py": "x" * 10**6}))


def test_a_wheel_that_is_too_large_is_not_read(entry, refusal, tmp_path):
    mine = entry()
    with (tmp_path / "entries/mine" / mine.wheel).open("r+b") as file:
        file.truncate(3 * 10**9)
    assert "more than 1000000000 bytes" in refusal(mine)


CHANGES = {
    "another digest": ({"sha256": "0" * 64}, "the entry has 000000"),
    "no digest": ({"sha256": ""}, "the entry has None"),
    "a path": ({"wheel": "../mine/x.whl"}, "expected a file NAME.whl"),
    "an archive": ({"wheel": "x.tar.gz"}, "expected a file NAME.whl"),
    "no file": ({"wheel": "x-1-py3-none-any.whl"}, "cannot be read"),
    "an option": ({"wheel": "", "requirement": "--index-url=x"}, "expected NAME==VERSION"),
    "a url": ({"wheel": "", "requirement": "x @ file:///x"}, "expected NAME==VERSION"),
    "a range": ({"wheel": "", "requirement": "x>=1"}, "expected NAME==VERSION"),
    "nobody's": ({"wheel": "", "requirement": "oodd-nobody==1"}, "No matching distribution"),
    "ours": ({"wheel": "", "requirement": f"numpy=={np.__version__}"}, "installed here already"),
}  # fmt: skip


@pytest.mark.parametrize(("fields", "reason"), CHANGES.values(), ids=CHANGES)
def test_what_is_not_as_declared_is_refused(entry, refusal, fields, reason):
    assert reason in refusal(replace(entry(), **fields))


def test_a_requirement_with_another_digest_is_refused(refusal, tmp_path):
    write_wheel(tmp_path / "index", "oodd-mine", "1.0", {})
    mine = Entry("mine", requirement="oodd-mine==1.0", sha256="1" * 64)
    assert "the entry has 111111" in refusal(mine)


def test_no_archive_is_no_wheel(entry, refusal, tmp_path):
    mine = entry()
    path = tmp_path / "entries/mine" / mine.wheel
    path.write_bytes(b"PK\x03\x04" * 99)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    assert "is no wheel" in refusal(replace(mine, sha256=digest))


def test_an_interrupted_install_leaves_what_was_there(entry, monkeypatch, tmp_path):
    target = tmp_path / "packages/mine"
    (target / "old").mkdir(parents=True)

    def interrupted(work, command, *arguments):
        if command == "install" and "--target" in arguments:
            (work / "packages").mkdir()
            raise KeyboardInterrupt
        return plain(work, command, *arguments)

    plain = installing._pip
    monkeypatch.setattr(installing, "_pip", interrupted)
    with pytest.raises(KeyboardInterrupt):
        install(entry({"a.py": RUNS}), tmp_path / "entries", target)
    assert [*tmp_path.glob("packages/*")] == [target]
    assert [path.name for path in target.iterdir()] == ["old"]


def test_without_pip_the_reason_says_how_to_get_it(entry, monkeypatch, refusal):
    monkeypatch.setattr(installing, "find_spec", lambda _: None)
    assert "-m ensurepip" in refusal(entry())


def test_a_pip_that_hangs_is_ended(entry, monkeypatch, refusal):
    monkeypatch.setattr(installing, "SECONDS", 0.01)
    assert "is not done after" in refusal(entry())
