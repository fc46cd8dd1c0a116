"""Levels of trust: how each is reached with a command, and what does not reach it."""

import dataclasses
import json

import numpy as np
import pytest
from helpers_split import make_split
from helpers_submission import Draft, assert_refused
from oodd_leaderboard.entry import GRANTS, read_entry
from oodd_leaderboard.submit import Statement, submit
from oodd_leaderboard.verify import grant, verify_entry
from oodd_leaderboard.verify.rerun import Rerun, RerunDifference, RerunOrder, compare_rerun

from oodd_eval.api import evaluate
from oodd_eval.cli import main as cli
from oodd_eval.errors import UsageError
from oodd_eval.results.record import Record

THREE = ("cartpole", "acrobot", "hopper")


@pytest.fixture(scope="module")
def entry(tmp_path_factory):
    """An entry of one row on three environments."""
    home = tmp_path_factory.mktemp("entry")
    split = make_split(home / "split", THREE, calibration=20, test=10, name="three")
    evaluate("persistence", split, output=home / "out")
    return submit(home / "out", home / "results", Statement(submitter="A. Tester")).path


@pytest.fixture(scope="module")
def fresh(tmp_path_factory):
    """Records of a run on a split of fresh seeds with the same sizes."""
    home = tmp_path_factory.mktemp("fresh")
    split = make_split(home / "split", THREE, calibration=20, test=10, name="fresh", seed_base=77)
    return list(evaluate("persistence", split, output=home / "out"))


def verify(submissions, path, *options):
    arguments = ["leaderboard", "verify", str(path), "--split", str(submissions.split)]
    return cli.main([*arguments, *map(str, options)])


def trust(draft):
    return read_entry(draft.path).trust


def of_three(entry, tmp_path):
    """A copy of the entry of three environments, in a directory of entries of its own."""
    draft = Draft(entry, tmp_path / "results")
    draft.write()
    return draft


def copy(submissions, tmp_path, which="full"):
    draft = Draft(getattr(submissions, which), tmp_path / "results")
    draft.write()
    return draft


def changed(records, **changes):
    """Records of a re-run in which a metric's terms are others."""
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
    before = draft.file("entry.json").read_bytes()
    assert verify(submissions, draft.path, "--grant", "M. Aintainer") == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "trust level established here: re-scored" in out
    assert "trust re-scored is written to" in out
    assert trust(draft) == "re-scored"
    assert draft.file("entry.json").read_bytes() == before
    assert verify(submissions, draft.path) == 0
    assert "re-scored was granted by M. Aintainer on 2" in " ".join(capsys.readouterr().out.split())


def test_nothing_is_granted_without_scores_or_a_run_again(submissions, tmp_path, capsys):
    draft = copy(submissions, tmp_path, "plain")
    assert verify(submissions, draft.path, "--grant", "me") == 4
    assert "what was established here is 'reported'" in capsys.readouterr().err
    assert not (tmp_path / GRANTS).exists()


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
    assert trust(draft) == "reported"


# re-run


def compared(draft, fresh, environments=THREE):
    """The verdict on an entry with a re-run of these records, under an order of seeds."""
    verdict = verify_entry(draft.path)
    order = RerunOrder([verdict.digest], "0" * 32, "2026-11-26", list(environments))
    again = compare_rerun(verdict.records, fresh, order, verdict.findings)
    return dataclasses.replace(verdict, rerun=again)


def test_fresh_seeds_confirm_within_what_chance_explains(entry, tmp_path, fresh):
    draft = of_three(entry, tmp_path)
    verdict = compared(draft, fresh)
    assert verdict.reached == "re-run", verdict.findings.problems
    assert trust(draft) == "reported"
    grant(draft.path, verdict, "M. Aintainer")
    granted = read_entry(draft.path).grant
    assert (granted.trust, granted.by) == ("re-run", "M. Aintainer")
    assert granted.how.endswith("24 of 24 cells")
    assert sorted(granted.environments) == sorted(THREE)
    entry, again = (
        np.mean([r.value("auc_matched") for r in records])
        for records in (read_entry(draft.path).records, fresh)
    )
    assert granted.means["persistence"]["auc_matched"] == pytest.approx((entry, again), rel=1e-5)


def test_a_row_that_is_worse_than_its_run_again_is_honest(entry, tmp_path, fresh):
    records = changed(fresh, auc_matched=lambda v: (1 + v) / 2)
    assert compared(of_three(entry, tmp_path), records).reached == "re-run"


def test_a_row_that_is_better_in_all_environments_is_refused(entry, tmp_path, fresh):
    records = changed(fresh, auc_matched=lambda v: v * 0.7)
    verdict = compared(of_three(entry, tmp_path), records)
    assert_refused(verdict, "persistence auc_matched mean", "in the re-run: better by")
    assert verdict.reached is None


def test_a_row_that_is_better_in_one_environment_is_refused(entry, tmp_path, fresh):
    lies = changed([r for r in fresh if r.environment == "hopper"], auc_matched=lambda v: v * 0.5)
    records = [r for r in fresh if r.environment != "hopper"] + lies
    verdict = compared(of_three(entry, tmp_path), records)
    assert_refused(verdict, "persistence auc_matched hopper", "in the re-run: better by")


def test_an_entry_does_not_hide_a_lie_behind_its_own_spread(entry, tmp_path, fresh):
    """Episodes that are 1 or 0.7 have a standard error of which no re-run knows."""
    draft = of_three(entry, tmp_path)
    for index, record in enumerate(draft.records):
        terms = record["per_trajectory"]["auc_matched"]
        terms[0] = [1.0, 1.0, *[0.4] * (len(terms[0]) - 2)]
        terms[1] = [1.0] * len(terms[0])
        draft.consistent(index, "auc_matched")
    draft.write()
    records = changed(fresh, auc_matched=lambda v: 0.4)
    assert_refused(compared(draft, records), "persistence auc_matched mean", "better by")


def test_what_is_found_everywhere_may_be_missed_by_a_hair(entry, tmp_path, fresh):
    """Without any spread on either side one episode more may have gone otherwise."""
    draft = of_three(entry, tmp_path)
    for index, record in enumerate(draft.records):
        terms = record["per_trajectory"]["auc_matched"]
        terms[0] = list(terms[1])
        draft.consistent(index, "auc_matched")
    draft.write()
    hair = changed(fresh, auc_matched=lambda v: 0.97)
    assert compared(draft, hair).reached == "re-run"
    more = changed(fresh, auc_matched=lambda v: 0.7)
    assert compared(draft, more).reached is None


@pytest.mark.parametrize(
    ("metric", "change"),
    [
        ("far_twin", lambda v: v + 500),
        ("missed", lambda v: v + 9),
        ("delay_censored", lambda v: 2 * v + 500),
    ],
)
def test_every_compared_metric_can_fail(entry, tmp_path, fresh, metric, change):
    # The entry's numbers are made better, as the re-run's decide what chance explains.
    draft = of_three(entry, tmp_path)
    records = changed(fresh, **{metric: change})
    assert_refused(compared(draft, records), f"persistence {metric} mean", "better by")


@pytest.mark.parametrize(
    ("freedom", "ratio", "z"),
    # Ratios as rare as z, from tables of the t distribution (P = .01, .001) and of the normal one.
    [(2, 6.965, 2.326), (6, -3.143, -2.326), (18, 3.610, 3.090), (60, 3.232, 3.090)],
)
def test_a_ratio_of_few_episodes_counts_by_its_t_distribution(freedom, ratio, z):
    higher = RerunDifference("auc", "hopper", 0.5 + ratio / 100, 0.5, 0.01, freedom)
    assert higher.z == pytest.approx(z, rel=0.03)
    lower = RerunDifference("missed", "hopper", 0.5 + ratio / 100, 0.5, 0.01, freedom)
    assert lower.z == pytest.approx(-z, rel=0.03)


OTHERWISE = {
    "version": ({"detector_version": "9.9"}, "detector_version", "expected '9.9'"),
    "failure": ({"status": "timeout", "reason": "slow"}, "status", "timeout"),
    "training": ({"training": "anomalies"}, "training", "expected 'anomalies'"),
}  # fmt: skip


@pytest.mark.parametrize("case", OTHERWISE)
def test_a_run_of_something_else_confirms_nothing(entry, tmp_path, fresh, case):
    changes, field, message = OTHERWISE[case]
    records = [dataclasses.replace(r, **changes) for r in fresh]
    verdict = compared(of_three(entry, tmp_path), records)
    assert_refused(verdict, field, message)


def test_what_is_undefined_in_an_entry_alone_is_refused(entry, tmp_path, fresh):
    draft = of_three(entry, tmp_path)
    record = draft.records[0]
    record["per_trajectory"]["auc_matched"] = [[0.0] * 3, [0.0] * 3]
    record["metrics"]["auc_matched"] = {"value": None, "low": None, "high": None, "n": 0}
    draft.write()
    verdict = compared(draft, fresh)
    assert_refused(verdict, "auc_matched", "is undefined, and defined in the re-run")


def test_a_grant_needs_every_cell_of_every_row(entry, tmp_path, fresh):
    draft = of_three(entry, tmp_path)
    others = [dataclasses.replace(r, horizon=5) for r in fresh]
    hopper = [r for r in fresh if r.environment != "hopper"]
    for some in (fresh[:-1], hopper, others, []):
        verdict = compared(draft, some)
        assert verdict.reached == "reported"
        with pytest.raises(UsageError, match="leaderboard rerun of all its rows"):
            grant(draft.path, verdict, "me")


def test_a_grant_of_more_environments_replaces_one_of_fewer(entry, tmp_path, fresh):
    draft = of_three(entry, tmp_path)
    two = [r for r in fresh if r.environment != "hopper"]
    for records, environments in ((two, THREE[:2]), (fresh, THREE)):
        verdict = compared(draft, records, environments)
        grant(draft.path, verdict, "me")
        assert sorted(read_entry(draft.path).grant.environments) == sorted(environments)
        with pytest.raises(UsageError, match="in more environments than before"):
            grant(draft.path, compared(draft, records, environments), "me")
    with pytest.raises(UsageError, match="in more environments than before"):
        grant(draft.path, compared(draft, two, THREE[:2]), "me")


def test_a_re_run_of_some_rows_is_no_part_of_a_grant_from_scores(submissions, tmp_path):
    draft = copy(submissions, tmp_path)
    verdict = verify_entry(draft.path, split=submissions.split)
    grant(draft.path, dataclasses.replace(verdict, rerun=Rerun("a part", {}, False)), "me")
    granted = read_entry(draft.path).grant
    assert (granted.trust, granted.how) == ("re-scored", "every metric recomputed from its scores")


def test_where_it_was_computed_makes_no_other_detector(entry, tmp_path, fresh):
    there = [dataclasses.replace(r, provenance={"device": "cuda"}) for r in fresh]
    assert compared(of_three(entry, tmp_path), there).reached == "re-run"


def test_grants_are_of_one_entry(submissions, capsys):
    both = [submissions.plain, submissions.full]
    assert cli.main(["leaderboard", "verify", *map(str, both), "--grant", "me"]) == 4
    assert "name a single PATH" in capsys.readouterr().err
