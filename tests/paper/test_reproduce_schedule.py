"""What is run in which order, how long it takes, and what is told of it."""

import contextlib
import dataclasses

import pytest
from helpers_records import make_record
from oodd_paper.experiments import EXPERIMENTS, TIERS, of_paper
from oodd_paper.run import (
    Progress,
    duration,
    estimated_cost,
    lay_out,
    remaining_seconds,
    scored_rows,
    stage_of,
    unfinished,
)

from oodd_eval import load_split
from oodd_eval.data.condition import Condition
from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.plugins.discovery import discover
from oodd_eval.results.identity import Setting
from oodd_eval.scoring.plan import Unit

RIQN = Setting("riqn")
ROWS = {"ant": 30_000}


@pytest.fixture(scope="module")
def mini():
    return lay_out(EXPERIMENTS, TIERS["mini"], load_split("mini"), discover())


def make_unit(setting=RIQN, fit="a", seed=0, key=""):
    conditions = Condition("iid"), Condition("drift")
    return Unit("ant", setting, seed, conditions, {}, {}, "riqn", "oodd-eval", "1.0",
                scores_key=key, fit_key=fit)  # fmt: skip


def test_every_unit_is_there_once_and_only_what_is_wanted(mini):
    labels = [(u.environment, u.setting.label(u.seed)) for u in mini]
    assert len(set(labels)) == len(labels) == 315
    assert len({u.scores_key for u in mini}) == 315
    assert {u.environment for u in mini} == set(ENVIRONMENTS)
    assert all(len(u.conditions) == 8 for u in mini)
    delays = [e for e in EXPERIMENTS if e.id == "delays"]
    units = lay_out(delays, TIERS["mini"], load_split("mini"), discover())
    assert {str(of_paper(u.setting)) for u in units} == {"riqn", "riqn[h=10]", "riqn[h=20]"}
    assert {(u.parameters["members"], u.parameters["updates"]) for u in units} == {(5, 2500)}
    assert len(units) == 7 * (3 + 1 + 1)


def test_records_are_those_of_the_paper_by_their_parameters_whatever_the_defaults_were():
    paper, fewer = {"members": 5, "updates": 2500}, {"members": 3, "updates": 1250}
    assert of_paper(RIQN, paper) == of_paper(Setting.of("riqn", 1, paper), paper) == RIQN
    assert of_paper(RIQN, fewer) == Setting.of("riqn", 1, fewer)
    assert of_paper(Setting("npn"), fewer) == Setting("npn")


def test_a_device_reaches_the_detectors_that_have_one_and_changes_no_row(mini):
    controls = [e for e in EXPERIMENTS if e.id == "controls"]
    placed = lay_out(controls, TIERS["mini"], load_split("mini"), discover(), "auto")
    devices = {u.setting.detector: u.parameters.get("device") for u in placed}
    assert devices["riqn"] == devices["npn"] == "auto"
    assert devices["rf"] is devices["clock"] is None
    assert {(u.setting, u.scores_key) for u in placed} < {(u.setting, u.scores_key) for u in mini}


def test_stages_follow_one_another_and_each_goes_environment_by_environment(mini):
    order = [(stage_of(u), list(ENVIRONMENTS).index(u.environment)) for u in mini]
    assert order == sorted(order)
    first = {(u.setting.detector, u.setting.horizon) for u in mini if stage_of(u) <= 1}
    assert ("riqn", 1) in first
    assert all(horizon == 1 for _, horizon in first)


def test_seeds_are_three_at_delta_one_and_one_where_scoring_is_expensive():
    tier = TIERS["mini"]
    assert tier.seeds(RIQN) == range(3)
    assert tier.seeds(Setting("riqn", 10)) == range(1)
    assert tier.seeds(Setting.parse("riqn[samples=128]")) == range(1)
    assert tier.seeds(Setting("clock")) == range(1)
    assert TIERS["full"].seeds(Setting("riqn", 20)) == range(3)


def test_sampling_sizes_share_a_fit_that_the_first_of_them_makes(mini):
    ant = [u for u in mini if u.environment == "ant" and u.seed == 0]
    own = [
        u for u in ant
        if u.setting.detector == "riqn" and "members" not in of_paper(u.setting).overrides
    ]  # fmt: skip
    near = [u for u in own if u.setting.horizon == 1]
    assert len(near) > 1
    assert len({u.fit_key for u in near}) == 1
    assert of_paper(near[0].setting) == RIQN
    # Networks are trained on their own samples where they are to forecast further than one step.
    assert len({u.fit_key for u in own}) == len({u.setting.horizon for u in own}) == 3
    assert len({u.fit_key for u in ant if u.setting.detector == "rf"}) == 1


def test_a_shared_fit_is_counted_once_and_a_kept_one_not_at_all():
    units = [make_unit(), make_unit(Setting("riqn", 10)), make_unit(Setting("rf"), fit="b")]
    costs = [estimated_cost(u.setting, "ant", 30_000) for u in units]
    scoring = sum(score for _, score in costs)
    assert remaining_seconds(units, ROWS, ()) == pytest.approx(scoring + costs[0][0] + costs[2][0])
    assert remaining_seconds(units, ROWS, {"a"}) == pytest.approx(scoring + costs[2][0])
    assert remaining_seconds([], ROWS, ()) == 0
    assert [duration(s) for s in (7.4, 600, 7260)] == ["7 s", "10 min", "2 h 01 min"]
    assert estimated_cost(Setting("someone-elses"), "ant", 30_000)[0] > 0
    (fit, score), (same, more) = (estimated_cost(RIQN, "ant", n) for n in (30_000, 60_000))
    assert fit == same > 0
    assert more - 3 == pytest.approx(2 * (score - 3))
    split = load_split("mini")
    with contextlib.closing(split.environment("acrobot")) as data:
        sets = [data.calibration, data.twins, *(data.anomalous(a) for a in data.anomalies)]
        rows = sum(int(s.lengths.sum()) + len(s) for s in sets)
    assert scored_rows(split)["acrobot"] == rows


def test_a_unit_is_finished_when_all_its_anomalies_are_scored():
    unit = make_unit(key="k")
    records = {a: dataclasses.replace(make_record(anomaly=a), scores="k") for a in ("iid", "drift")}
    failed = dataclasses.replace(records["iid"], status="error")
    assert unfinished([unit], [records["drift"]]) == [unit]
    assert unfinished([unit], [records["drift"], failed]) == [unit]
    assert unfinished([unit], [records["drift"], failed, records["iid"]]) == []


def finish(progress, unit, resumed=False, **changes):
    for condition in unit.conditions:
        record = make_record(
            unit.setting.detector, unit.environment, condition.anomaly, seed=unit.seed,
            horizon=unit.setting.horizon,
        )  # fmt: skip
        progress.oodd_cell_finished(dataclasses.replace(record, **changes), resumed=resumed)


def test_progress_tells_of_every_unit_once_with_what_came_of_it():
    lines = []
    units = [make_unit(seed=seed, fit=str(seed)) for seed in range(3)]
    progress = Progress(units, ROWS, 1, lines.append)
    whole = progress.remaining()
    finish(progress, units[0], seconds_fit=60.0, seconds_score=20.0)
    assert progress.remaining() < whole
    finish(progress, units[1], resumed=True)
    finish(progress, units[2], status="timeout", reason="not done after 5 s")
    assert [line.split("  ")[:2] for line in lines] == [
        ["[1/3] ant/riqn[h=1,seed=0]", "80 s"],
        ["[2/3] ant/riqn[h=1,seed=1]", "kept"],
        ["[3/3] ant/riqn[h=1,seed=2]", "timeout: not done after 5 s"],
    ]
    assert progress.remaining() == 0


def test_the_remaining_time_is_corrected_by_what_has_finished():
    def after(times, factor):
        units = [make_unit(cheap, seed=seed, fit=str(seed)) for seed in range(10)]
        progress = Progress(units, {"ant": 0}, 2)
        for unit in units[:times]:
            finish(progress, unit, seconds_fit=factor * expected - 3, seconds_score=0.0)
        assert progress.factor() == pytest.approx(factor if times > 1 else 1.0)
        return progress.remaining()

    cheap = Setting("rf")
    expected = sum(estimated_cost(cheap, "ant", 0))
    assert expected < 60 < 5 * expected  # one unit says nothing yet
    assert after(5, 2.0) == pytest.approx(2.0 * 5 * expected / 2)
    assert after(1, 2.0) == pytest.approx(9 * expected / 2)
