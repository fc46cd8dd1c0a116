"""Levels of trust: how each is reached with a command, and what does not reach it."""

import dataclasses
import json

import numpy as np
import pytest
from helpers_split import make_split
from helpers_submission import Draft, assert_refused

from oodd_eval.api import evaluate
from oodd_eval.cli import main as cli
from oodd_eval.data.facts import PROTOCOL
from oodd_eval.leaderboard.entry import GRANTS, read_entry
from oodd_eval.leaderboard.submit import Statement, submit
from oodd_eval.leaderboard.verify import verify_entry
from oodd_eval.leaderboard.verify.rerun import COMPARED, LEVEL, by_chance
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.record import Record

THREE = ("cartpole", "acrobot", "hopper")


@pytest.fixture(scope="module")
def entry(tmp_path_factory):
    """An entry of one row on three environments."""
    home = tmp_path_factory.mktemp("entry")
    split = make_split(home / "split", THREE, calibration=20, name="three")
    evaluate("persistence", split, output=home / "out")
    return submit(home / "out", home / "results", Statement(submitter="A. Tester")).path


@pytest.fixture(scope="module")
def fresh(tmp_path_factory):
    """A run on a split of fresh seeds with the same sizes."""
    home = tmp_path_factory.mktemp("fresh")
    split = make_split(home / "split", THREE, calibration=20, name="fresh", seed_base=77)
    evaluate("persistence", split, output=home / "out")
    return home / "out"


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


def test_fresh_seeds_confirm_within_what_chance_explains(
    submissions, entry, tmp_path, fresh, capsys
):
    draft = of_three(entry, tmp_path)
    arguments = ["leaderboard", "verify", str(draft.path), "--rerun", str(fresh)]
    code = cli.main(arguments)
    out = capsys.readouterr().out
    assert code == 0, out
    assert "trust level established here: re-run" in out
    assert "persistence: 24 of 24 cells run again; auc_matched" in out
    assert trust(draft) == "reported"
    assert cli.main([*arguments, "--grant", "M. Aintainer"]) == 0
    granted = read_entry(draft.path).grant
    assert (granted.trust, granted.by) == ("re-run", "M. Aintainer")
    assert granted.how.startswith("fresh seeds (split fresh, digest ")
    assert granted.how.endswith("24 of 24 cells")
    entry, again = (
        np.mean([r.value("auc_matched") for r in records if r.detector == "persistence"])
        for records in (read_entry(draft.path).records, ResultsDirectory(fresh).records())
    )
    assert granted.means["persistence"]["auc_matched"] == pytest.approx((entry, again), rel=1e-5)


def test_an_honest_row_is_rarely_refused_and_a_raised_one_is_found():
    """Of 2000 rows in seven environments; each has a noise of its own in every environment."""
    rng = np.random.default_rng(0)
    change = rng.normal(0, 0.02, (2000, len(COMPARED), 7)) * rng.uniform(0.5, 2, (2000, 1, 7))

    def refused(raised):
        return [any(m.mean() > by_chance(m) for m in own) for own in change + raised]

    assert 0 < np.mean(refused(0.0)) < LEVEL + 3 * np.sqrt(LEVEL * (1 - LEVEL) / 2000)
    assert np.mean(refused(0.1)) > 0.95


def test_what_differs_by_the_same_in_few_environments_may_be_chance():
    same = np.array([0.02, 0.0200001, 0.02])
    assert same.mean() > by_chance(same)
    assert same.mean() < by_chance(same, episodes=0.01)


def test_a_row_that_is_worse_than_its_run_again_is_honest(entry, tmp_path, fresh):
    draft = of_three(entry, tmp_path)
    records = changed(ResultsDirectory(fresh).records(), auc_matched=lambda v: (1 + v) / 2)
    assert verify_entry(draft.path, rerun=records).reached == "re-run"


def test_a_row_that_is_better_than_its_run_again_is_refused(entry, tmp_path, fresh):
    draft = of_three(entry, tmp_path)
    records = changed(ResultsDirectory(fresh).records(), auc_matched=lambda v: v * 0.5)
    verdict = verify_entry(draft.path, rerun=records)
    assert_refused(verdict, "persistence auc_matched", "in the entry: chance explains")
    assert verdict.reached is None


@pytest.mark.parametrize(
    ("metric", "change"),
    [
        ("far_twin", lambda v: v + 500),
        ("missed", lambda v: v + 9),
        ("delay_censored", lambda v: 2 * v + 500),
    ],
)
def test_every_compared_metric_can_fail(entry, tmp_path, fresh, metric, change):
    draft = of_three(entry, tmp_path)
    records = changed(ResultsDirectory(fresh).records(), **{metric: change})
    verdict = verify_entry(draft.path, rerun=records)
    assert_refused(verdict, f"persistence {metric}", "not the whole difference")


def test_results_on_seeds_that_were_known_confirm_nothing(entry, tmp_path):
    draft = of_three(entry, tmp_path)
    verdict = verify_entry(draft.path, rerun=read_entry(draft.path).records)
    assert_refused(verdict, "split", "seeds that nobody could know before")


OTHERWISE = {
    "version": ({"detector_version": "9.9"}, "detector_version", "expected '9.9'"),
    "failure": ({"status": "timeout", "reason": "slow"}, "status", "timeout"),
    "limited": ({"limit": 3}, "split", "is none without --limit"),
    "protocol": ({"protocol": PROTOCOL + 1}, "split", "is none without --limit"),
    "another-row": ({"horizon": 5}, "persistence", "in 0 environments, expected 3"),
    "sizes": ({"counts": {"train": 1, "calibration": 20, "test": 3}}, "counts", "but for test"),
}  # fmt: skip


@pytest.mark.parametrize("case", OTHERWISE)
def test_a_run_of_something_else_confirms_nothing(entry, tmp_path, fresh, case):
    changes, field, message = OTHERWISE[case]
    draft = of_three(entry, tmp_path)
    records = [dataclasses.replace(r, **changes) for r in ResultsDirectory(fresh).records()]
    verdict = verify_entry(draft.path, rerun=records)
    places = [f"{p.field} {p.message}" for p in verdict.findings.problems]
    assert not verdict.ok
    assert any(field in place and message in place for place in places), places


def test_single_anomalies_and_few_environments_are_not_enough(entry, tmp_path, fresh):
    draft = of_three(entry, tmp_path)
    records = ResultsDirectory(fresh).records()
    for some in (records[:-1], [r for r in records if r.environment != "hopper"]):
        verdict = verify_entry(draft.path, rerun=some)
        assert_refused(verdict, "persistence", "in 2 environments, expected 3")


def test_where_it_was_computed_makes_no_other_detector(entry, tmp_path, fresh):
    draft = of_three(entry, tmp_path)
    there = [
        dataclasses.replace(r, provenance=r.provenance | {"device": "cuda"})
        for r in ResultsDirectory(fresh).records()
    ]
    assert verify_entry(draft.path, rerun=there).reached == "re-run"


def test_runs_again_and_grants_are_of_one_entry(submissions, tmp_path, fresh, capsys):
    both = [submissions.plain, submissions.full]
    arguments = ["leaderboard", "verify", *map(str, both)]
    assert cli.main([*arguments, "--grant", "me"]) == 4
    assert cli.main([*arguments, "--rerun", str(fresh)]) == 4
    assert capsys.readouterr().err.count("name a single PATH") == 2
    assert verify(submissions, submissions.plain.parent, "--rerun", fresh) == 4
    assert "is a directory of entries" in capsys.readouterr().err
    assert verify(submissions, submissions.plain, "--rerun", tmp_path) == 4
    assert "no results in" in capsys.readouterr().err
