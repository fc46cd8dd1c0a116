"""Re-runs: seeds drawn once for versions of entries, what is run, and the whole command."""

import dataclasses
import itertools
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
from helpers_submission import Draft
from oodd_leaderboard.entry import read_entry
from oodd_leaderboard.sandbox.launcher import make_sandbox
from oodd_leaderboard.submit import Statement, submit
from oodd_leaderboard.verify import verify_entry
from oodd_leaderboard.verify.rerun import ORDER, read_order
from oodd_recording import rerun as recording
from oodd_recording.build import build_split, digest_of_bits
from oodd_recording.rerun import check_installed, chosen, definition_of, draw, earlier, plan_of
from test_submission_trust import entry, of_three  # noqa: F401  a fixture

from oodd_eval.api import evaluate
from oodd_eval.cli import main as cli
from oodd_eval.data.facts import SPLITS
from oodd_eval.data.split import load_split
from oodd_eval.errors import ResultsError, UsageError
from oodd_eval.plugins.discovery import discover
from oodd_eval.results.directory import ResultsDirectory

pytestmark = pytest.mark.slow

NAMES = ["acrobot", "cartpole", "hopper"]


@pytest.fixture
def verdict(entry, tmp_path):  # noqa: F811
    return verify_entry(of_three(entry, tmp_path).path)


def on(verdict, split):
    return dataclasses.replace(verdict, entry=dataclasses.replace(verdict.entry, split=split))


def test_bits_are_drawn_once_and_stay(verdict, tmp_path):
    assert read_order(tmp_path / "again") is None
    first = draw([verdict], tmp_path / "again", NAMES)
    assert first == draw([verdict], tmp_path / "again", NAMES) == read_order(tmp_path / "again")
    others = {draw([verdict], tmp_path / str(k), NAMES).bits for k in range(20)}
    assert len(others) == 20
    # All 128 bits are drawn: each is 0 in one of these and 1 in another.
    ones, zeros = 0, 0
    for bits in others:
        ones, zeros = ones | int(bits, 16), zeros | ~int(bits, 16)
    assert ones == zeros % 2**128 == 2**128 - 1


def test_bits_count_for_one_version_of_an_entry_in_any_environments(verdict, tmp_path):
    first = draw([verdict], tmp_path / "again", NAMES)
    assert draw([verdict], tmp_path / "again", ["hopper"]) == first  # a grant waits for the others
    more = draw([verdict], tmp_path / "again", ["ant"])
    assert (more.bits, more.environments) == (first.bits, [*NAMES[:2], "ant", "hopper"])
    assert read_order(tmp_path / "again") == more
    changed = dataclasses.replace(verdict, digest="e" * 64)
    with pytest.raises(UsageError, match="seeds are drawn for one version of an entry"):
        draw([changed], tmp_path / "again", NAMES)


def test_without_environments_named_a_re_run_goes_on_with_those_it_has(verdict, tmp_path):
    options = SimpleNamespace(env=None, detector="all", seed=None)
    order = draw([verdict], tmp_path / "again", ["hopper"])
    assert {r.environment for r in chosen([verdict], options, None)} == {*NAMES}
    assert {r.environment for r in chosen([verdict], options, order)} == {"hopper"}


@pytest.mark.parametrize(
    "text",
    ["", "{}", "[]", '{"schema": 3}', "\x00", "{" * 9999,
     '{"entries": [], "bits": "7", "day": "", "environments": []}'],
)  # fmt: skip
def test_a_damaged_order_is_told(tmp_path, text):
    (tmp_path / ORDER).write_text(text)
    with pytest.raises(ResultsError, match="is no order of a re-run"):
        read_order(tmp_path)


def test_the_split_is_the_entrys_but_for_the_seeds(verdict):
    made = definition_of(on(verdict, "mini"), 5)
    assert made.drawn == digest_of_bits(5)
    same = {"name": "mini", "seed_base": SPLITS["mini"].seed_base, "drawn": ""}
    assert dataclasses.replace(made, **same) == SPLITS["mini"]
    for split in ("three@01234567", "ladder"):
        with pytest.raises(UsageError, match="expected one that can be recorded with other seeds"):
            definition_of(on(verdict, split))


def test_a_plan_has_the_rows_and_seeds_of_the_entry(verdict):
    plan = plan_of([*verdict.records.values()], load_split("mini"), discover())
    assert {(u.environment, u.setting.detector, u.seed) for u in plan.units} == {
        (name, "persistence", 0) for name in NAMES
    }
    assert len(plan.cells) == 24


@pytest.mark.parametrize("field", ["detector_version", "plugin_source", "plugin"])
def test_another_version_of_the_plug_in_is_not_run(verdict, field):
    records = [*verdict.records.values()]
    check_installed(records, discover())
    others = [dataclasses.replace(r, **{field: "e" * 64}) for r in records]
    with pytest.raises(UsageError, match=r"is installed as .*, but .* has .*: install that"):
        check_installed(others, discover())


def test_what_is_not_installed_is_not_run(verdict):
    records = [dataclasses.replace(r, detector="theirs") for r in verdict.records.values()]
    with pytest.raises(UsageError, match=r"cannot be had .*, but .* has .*: install that"):
        check_installed(records, discover())


# The whole command


@pytest.fixture(scope="module")
def submitted(tmp_path_factory):
    """An entry of two rows on a split that takes seconds to build, and the split's definition."""
    home = tmp_path_factory.mktemp("submitted")
    sizes = {"train": 3, "calibration": 20, "test": 10, "episode_cap": 80}
    small = dataclasses.replace(SPLITS["mini"], name="small", seed_base=950, **sizes)
    split = build_split(small, home / "split", environments=["cartpole"])
    for detector in ("persistence", "random"):
        evaluate(detector, split, output=home / "out")
    return submit(home / "out", home / "results", Statement(submitter="A. Tester")).path, small


@pytest.fixture
def path(submitted, tmp_path, monkeypatch):
    """A copy of the entry, in a directory of entries of its own, whose split is a published one."""
    make_sandbox()
    source, small = submitted
    monkeypatch.setattr(recording, "SPLITS", {**SPLITS, read_entry(source).meta.split: small})
    # The first draw is the same in every run of the tests, as one honest row in a hundred is
    # refused by chance. Each further draw is another.
    draws = (f"{n:032x}" for n in itertools.count(1))
    stand_in = SimpleNamespace(token_hex=lambda _: next(draws))
    monkeypatch.setattr(recording, "secrets", stand_in)
    monkeypatch.chdir(tmp_path)
    return shutil.copytree(source, tmp_path / "results" / source.name)


def rerun(path, *options):
    return cli.main(["leaderboard", "rerun", str(path), *map(str, options)])


def test_rows_are_added_one_by_one_until_all_of_them_can_be_granted(path, capsys, monkeypatch):
    assert rerun(path, "--detector", "persistence") == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "1 of 2 rows" in out
    assert "established here: reported" in out
    directory = path.parents[1] / f"rerun-{path.name}"
    bits = read_order(directory).bits
    assert rerun(path, "--detector", "persistence", "--grant", "Hopper") == 4
    assert read_entry(path).trust == "reported"
    capsys.readouterr()
    assert rerun(path) == 0
    assert "established here: re-run" in " ".join(capsys.readouterr().out.split())
    # What is finished is compared, and nothing is run or asked for.
    for name in ("make_sandbox", "discovered", "record_split", "run"):
        monkeypatch.setattr(recording, name, None)
    assert rerun(path, "--grant", "Hopper") == 0
    grant = read_entry(path).grant
    assert (grant.trust, grant.by) == ("re-run", "Hopper")
    assert bits in grant.how
    assert grant.how.endswith(
        "1 of 1 environments, 8 of 8 kinds of anomalies, 2 of 2 rows, 1 of 1 detector seeds, "
        "16 of 16 cells"
    )
    assert {r.split_digest[:12] for r in earlier(ResultsDirectory(directory))} == {
        load_split(directory / "split").digest[:12]
    }


def test_entries_of_a_split_share_one_that_is_recorded_once(path, submitted, capsys):
    shutil.rmtree(path)  # it has their rows
    home, results = submitted[0].parents[1], path.parent
    apart = [
        submit(home / "out", results, Statement(id=name, submitter="A. Tester"), detectors=name)
        for name in ("persistence", "random")
    ]
    paths = [str(one.path) for one in apart]
    assert rerun(*paths) == 4
    assert "several entries need --output" in " ".join(capsys.readouterr().err.split())
    assert rerun(*paths, "--output", "again") == 0
    out = " ".join(capsys.readouterr().out.split())
    assert out.count("established here: re-run") == 2
    assert "for 2 entries" in out
    granted = []
    for one in paths:
        assert rerun(one, "--output", "again", "--grant", "Hopper") == 0
        granted.append(read_entry(Path(one)).grant)
    assert [grant.trust for grant in granted] == ["re-run", "re-run"]
    assert [*granted[0].means] == ["persistence"]


def test_entries_of_several_splits_are_refused(path, submitted, monkeypatch, capsys):
    other = dataclasses.replace(submitted[1], test=11)
    definitions = iter((submitted[1], other))
    monkeypatch.setattr(recording, "definition_of", lambda _verdict: next(definitions))
    assert rerun(path, path, "--output", "again") == 4
    assert "are on several splits" in capsys.readouterr().err


def test_what_is_interrupted_goes_on_with_the_same_seeds(path, monkeypatch, capsys):
    def stopped(*_arguments, **_options):
        raise KeyboardInterrupt

    with monkeypatch.context() as broken:
        broken.setattr(recording, "run", stopped)
        assert rerun(path, "--output", "again") == 2
    order = read_order(path.parents[1] / "again")
    assert rerun(path, "--output", "again", "--detector", "persistence") == 0
    assert read_order(path.parents[1] / "again") == order
    assert order.bits in "".join(capsys.readouterr().out.split())


def test_an_entry_that_knew_its_episodes_is_refused(path, capsys):
    draft = Draft(path, path.parents[1] / "lies")
    for index, record in enumerate(draft.records):
        if record["detector"] == "random":
            terms = record["per_trajectory"]["auc_matched"]
            terms[0] = [0.99 * n for n in terms[1]]
            draft.consistent(index, "auc_matched")
    draft.write()
    assert rerun(draft.path, "--detector", "random") == 1
    out = " ".join(capsys.readouterr().out.split())
    assert "random auc_matched cartpole" in out
    assert rerun(draft.path, "--detector", "random", "--grant", "me") == 4
    assert read_entry(draft.path).trust == "reported"


def test_without_a_sandbox_nothing_is_drawn(path, monkeypatch, capsys):
    def lacking(_):
        raise UsageError("no bubblewrap here")

    monkeypatch.setattr(recording, "make_sandbox", lacking)
    assert rerun(path) == 4
    assert "no bubblewrap here" in capsys.readouterr().err
    assert not (path.parents[1] / f"rerun-{path.name}").exists()


def test_only_a_valid_entry_is_run(path, tmp_path, capsys):
    (path / "more").write_text("")
    assert rerun(path) == 4
    assert "expected one valid entry" in capsys.readouterr().err
    assert not (tmp_path / f"rerun-{path.name}").exists()


@pytest.mark.parametrize(
    ("option", "message"),
    [
        (("--seed", "7"), "has seeds 0"),
        (("--env", "hopper"), "hopper"),
        (("--detector", "rf"), "rf"),
    ],
)
def test_only_what_the_entry_has_is_run(path, option, message, capsys):
    assert rerun(path, *option) == 4
    assert message in capsys.readouterr().err
