"""Levels of trust: how each is reached with a command, and what does not reach it."""

import dataclasses
import json
import shutil

import pytest
from helpers_split import make_split
from helpers_submission import Draft, assert_refused

from oodd_eval.api import evaluate
from oodd_eval.cli import main as cli
from oodd_eval.data.facts import PROTOCOL
from oodd_eval.leaderboard.entry import read_entry
from oodd_eval.leaderboard.verify import verify_entry
from oodd_eval.leaderboard.verify.files import Findings
from oodd_eval.leaderboard.verify.trust import compare_rerun
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.record import Record


@pytest.fixture(scope="module")
def again(submissions, tmp_path_factory):
    """The verifier's own run of what the full entry holds."""
    home = tmp_path_factory.mktemp("again")
    evaluate("persistence", submissions.split, output=home / "out")
    return home / "out"


@pytest.fixture(scope="module")
def fresh(tmp_path_factory):
    """A run on a split of fresh seeds with the same sizes."""
    home = tmp_path_factory.mktemp("fresh")
    split = make_split(home / "split", ("cartpole",), calibration=20, name="fresh", seed_base=77)
    evaluate("persistence", split, output=home / "out")
    return home / "out"


def verify(submissions, path, *options):
    arguments = ["leaderboard", "verify", str(path), "--split", str(submissions.split)]
    return cli.main([*arguments, *map(str, options)])


def trust(draft):
    entry = json.loads(draft.file("entry.json").read_text())
    return entry["trust"], entry["rerun"]


def copy(submissions, tmp_path, which="full"):
    draft = Draft(getattr(submissions, which), tmp_path)
    draft.write()
    return draft


def only_persistence(submissions, tmp_path):
    """The entry without scores, of one detector alone."""
    draft = Draft(submissions.full, tmp_path)
    shutil.rmtree(draft.file("scores"))
    draft.entry["files"] = {n: f for n, f in draft.entry["files"].items() if "scores" not in n}
    draft.write()
    return draft


def changed(records, **changes):
    """Records of a run again in which a metric's terms are others."""
    found = []
    for record in records:
        plain = json.loads(record.to_json())
        for name, change in changes.items():
            top, bottom = plain["per_trajectory"][name]
            plain["per_trajectory"][name] = [list(map(change, top)), bottom]
            plain["metrics"][name]["value"] = sum(plain["per_trajectory"][name][0]) / sum(bottom)
        found.append(Record.from_json(json.dumps(plain)))
    return found


# re-scored


def test_scores_that_confirm_every_metric_are_granted_as_re_scored(submissions, tmp_path, capsys):
    draft = copy(submissions, tmp_path)
    assert verify(submissions, draft.path, "--grant", "M. Aintainer") == 0
    out = capsys.readouterr().out
    assert "trust level established here: re-scored" in out
    assert "trust re-scored is written to its entry.json" in out
    assert trust(draft) == ("re-scored", None)
    assert verify(submissions, draft.path) == 0


def test_nothing_is_granted_without_scores_or_a_run_again(submissions, tmp_path, capsys):
    draft = only_persistence(submissions, tmp_path)
    before = draft.file("entry.json").read_bytes()
    assert verify(submissions, draft.path, "--grant", "me") == 4
    assert "what was established here is 'reported'" in capsys.readouterr().err
    assert draft.file("entry.json").read_bytes() == before


def test_nothing_is_granted_to_what_is_refused(submissions, tmp_path, capsys):
    draft = copy(submissions, tmp_path)
    draft.records[0]["group"] = "dynamics"
    draft.write()
    assert verify(submissions, draft.path, "--grant", "me") == 4
    assert "is refused, so nothing is granted" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["<b>me</b>", "x" * 201])
def test_who_grants_is_plain_text(submissions, tmp_path, name, capsys):
    draft = copy(submissions, tmp_path)
    assert verify(submissions, draft.path, "--grant", name) == 4
    assert "--grant" in capsys.readouterr().err
    assert trust(draft) == ("reported", None)


# re-run


def test_a_run_again_with_the_same_numbers_is_granted(submissions, tmp_path, again, capsys):
    draft = only_persistence(submissions, tmp_path)
    assert verify(submissions, draft.path, "--rerun", again) == 0
    out = capsys.readouterr().out
    assert "trust level established here: re-run" in out
    assert "persistence: 8 of 8 cells run again, 8 with the same numbers" in out
    assert trust(draft)[0] == "reported"
    assert verify(submissions, draft.path, "--rerun", again, "--grant", "M. Aintainer") == 0
    level, rerun = trust(draft)
    assert (level, rerun["by"]) == ("re-run", "M. Aintainer")
    assert rerun["how"].startswith("the same split, 8 of 8 cells, 8 with the same numbers, 2")
    assert verify(submissions, draft.path) == 0
    assert "nothing here confirms it without a run of yours" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("field", "other"), [("deterministic", False), ("alarm", "score"), ("inputs", "")]
)
def test_a_run_again_has_the_same_statements_on_the_detector(submissions, tmp_path, field, other):
    draft = only_persistence(submissions, tmp_path)
    records = read_entry(draft.path).records
    assert all(getattr(r, field) != other for r in records)
    findings = Findings()
    places = {str(i): r for i, r in enumerate(records)}
    assert compare_rerun(places, records, findings).confirmed
    again = [dataclasses.replace(r, **{field: other}) for r in records]
    assert not compare_rerun(places, again, findings).confirmed
    assert {p.field for p in findings.problems} == {field}


def test_fresh_seeds_confirm_within_intervals(submissions, tmp_path, fresh, capsys):
    draft = only_persistence(submissions, tmp_path)
    code = verify(submissions, draft.path, "--rerun", fresh)
    out = capsys.readouterr().out
    assert code == 0, out
    assert "persistence: 8 of 8 cells run again, 0 with the same numbers; auc_matched" in out


def test_a_claim_that_nothing_confirms_is_said_to_be_one(submissions, tmp_path):
    draft = Draft(submissions.plain, tmp_path)
    draft.entry.update(trust="re-run", rerun={"by": "everybody", "how": "believe me"})
    verdict = draft.verdict()
    assert verdict.ok
    assert verdict.reached == "reported"
    assert any("is what the entry says (by everybody: believe me)" in n
               for n in verdict.findings.notes)  # fmt: skip


def test_small_differences_agree_and_large_ones_do_not(submissions, tmp_path, again):
    draft = only_persistence(submissions, tmp_path)
    records = ResultsDirectory(again).records()
    near = changed(records, auc_matched=lambda v: v * 0.99)
    verdict = verify_entry(draft.path, rerun=near)
    assert verdict.reached == "re-run"
    (line,) = verdict.rerun.lines
    assert "0 with the same numbers; auc_matched" in line
    far = changed(records, auc_matched=lambda v: v * 0.9)
    verdict = verify_entry(draft.path, rerun=far)
    assert_refused(verdict, "persistence auc_matched", "in the entry: expected at most 0.02")
    assert verdict.reached is None


@pytest.mark.parametrize(
    ("metric", "change", "allowed"),
    [
        ("far_twin", lambda v: v + 5, "at most 0.02"),
        ("missed", lambda v: 1 - v, "at most 0.05"),
        ("delay_censored", lambda v: 2 * v + 5, "expected at most"),
    ],
)
def test_every_compared_metric_can_fail(submissions, tmp_path, again, metric, change, allowed):
    draft = only_persistence(submissions, tmp_path)
    records = changed(ResultsDirectory(again).records(), **{metric: change})
    verdict = verify_entry(draft.path, rerun=records)
    assert_refused(verdict, f"persistence {metric}", allowed)


def edited(records, **changes):
    import dataclasses

    return [
        dataclasses.replace(
            r,
            **{k: v for k, v in changes.items() if k != "provenance"},
            provenance=r.provenance | changes.get("provenance", {}),
        )
        for r in records
    ]


OTHERWISE = {
    "version": ({"detector_version": "9.9"}, "detector_version", "expected '9.9'"),
    "source": ({"plugin_source": "f" * 64}, "plugin_source", "in the run again"),
    "distribution": ({"plugin": "oodd-x:trivial"}, "plugin", "oodd-x:trivial"),
    "failure": ({"status": "timeout", "reason": "slow"}, "status", "timeout"),
    "limited": ({"limit": 3}, "split", "is none without --limit"),
    "protocol": ({"protocol": PROTOCOL + 1}, "split", "is none without --limit"),
    "another-row": ({"horizon": 5}, "persistence", "run it again in one at least"),
    "sizes": ({"counts": {"train": 1, "calibration": 20, "test": 3}}, "counts", "of the entry"),
}  # fmt: skip


@pytest.mark.parametrize("case", OTHERWISE)
def test_a_run_of_something_else_confirms_nothing(submissions, tmp_path, again, case):
    changes, field, message = OTHERWISE[case]
    draft = only_persistence(submissions, tmp_path)
    records = edited(ResultsDirectory(again).records(), **changes)
    verdict = verify_entry(draft.path, rerun=records)
    places = [f"{p.field} {p.message}" for p in verdict.findings.problems]
    assert not verdict.ok
    assert any(field in place and message in place for place in places), places


def test_a_row_that_was_not_run_again_is_named(submissions, tmp_path, again, capsys):
    draft = copy(submissions, tmp_path, "plain")
    assert verify(submissions, draft.path, "--rerun", again) == 1
    assert "random: is not there with all anomalies" in capsys.readouterr().out


def test_single_anomalies_are_no_environment(submissions, tmp_path, again):
    draft = only_persistence(submissions, tmp_path)
    verdict = verify_entry(draft.path, rerun=ResultsDirectory(again).records()[:7])
    assert_refused(verdict, "persistence", "all anomalies of an environment")


def test_where_it_was_computed_makes_no_other_detector(submissions, tmp_path, again):
    draft = only_persistence(submissions, tmp_path)
    there = edited(
        ResultsDirectory(again).records(), provenance={"device": "cuda"},
    )  # fmt: skip
    assert verify_entry(draft.path, rerun=there).reached == "re-run"


def test_runs_again_and_grants_are_of_one_entry(submissions, tmp_path, again, capsys):
    both = [submissions.plain, submissions.full]
    arguments = ["leaderboard", "verify", *map(str, both)]
    assert cli.main([*arguments, "--grant", "me"]) == 4
    assert cli.main([*arguments, "--rerun", str(again)]) == 4
    assert capsys.readouterr().err.count("name a single PATH") == 2
    assert verify(submissions, submissions.plain.parent, "--rerun", again) == 4
    assert "is a directory of entries" in capsys.readouterr().err
    assert verify(submissions, submissions.plain, "--rerun", tmp_path) == 4
    assert "no results in" in capsys.readouterr().err
