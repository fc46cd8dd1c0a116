"""What is run in which order, how long it takes, and when a budget ends it."""

import dataclasses

import pytest
from helpers_records import make_record

from oodd_eval import load_split
from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.paper import carry
from oodd_eval.paper.carry import Watch, carry_out
from oodd_eval.paper.costs import Cost, correction, duration, estimate, scored_rows
from oodd_eval.paper.experiments import EXPERIMENTS, RIQN, TIERS, Setup
from oodd_eval.paper.schedule import (
    Work,
    finished_keys,
    is_done,
    lay_out,
    next_batch,
    remaining_seconds,
)
from oodd_eval.plugins.discovery import discover
from oodd_eval.scoring.plan import Plan, Unit
from oodd_eval.scoring.runner import Run, Settings


@pytest.fixture(scope="module")
def mini():
    return lay_out(EXPERIMENTS, TIERS["mini"], load_split("mini"), discover())


def make_work(fit, cost, environment="ant", seed=0, horizon=1):
    unit = Unit("riqn", horizon, seed, environment, {}, {}, ("iid",))
    return Work(Plan("mini", "d", (unit,)), 1, f"{fit}{seed}{horizon}{environment}", fit, cost)


def test_every_unit_is_there_once(mini):
    labels = [(w.unit.environment, w.unit.label) for w in mini]
    assert len(set(labels)) == len(labels) == 252
    assert len({w.key for w in mini}) == 252
    assert {w.unit.environment for w in mini} == set(ENVIRONMENTS)
    assert all(len(w.unit.anomalies) == 8 for w in mini)


def test_a_device_is_given_to_those_that_have_one():
    table_5 = [e for e in EXPERIMENTS if e.id == "controls"]
    placed = lay_out(table_5, TIERS["mini"], load_split("mini"), discover(), "auto")
    devices = {w.unit.detector: w.unit.overrides for w in placed}
    assert devices["riqn"] == devices["npn"] == {"device": "auto"}
    assert devices["rf"] == devices["clock"] == {}
    usual = lay_out(table_5, TIERS["mini"], load_split("mini"), discover(), "cpu")
    assert all(w.unit.overrides == {} for w in usual)


def test_stages_follow_one_another_and_each_goes_environment_by_environment(mini):
    order = [(w.stage, list(ENVIRONMENTS).index(w.unit.environment)) for w in mini]
    assert order == sorted(order)
    first = {(w.unit.detector, w.unit.horizon) for w in mini if w.stage <= 1}
    assert ("riqn", 1) in first
    assert all(horizon == 1 for _, horizon in first)


def test_seeds_are_three_at_delta_one_and_one_where_scoring_is_dear():
    tier = TIERS["mini"]
    assert tier.seeds(RIQN) == range(3)
    assert tier.seeds(Setup("riqn", 10)) == range(1)
    assert tier.seeds(Setup("riqn", 1, (("samples", 128),))) == range(1)
    assert tier.seeds(Setup("clock")) == range(1)
    assert TIERS["full"].seeds(Setup("riqn", 20)) == range(3)


def test_only_what_is_wanted_is_laid_out():
    delays = [e for e in EXPERIMENTS if e.id == "delays"]
    works = lay_out(delays, TIERS["mini"], load_split("mini"), discover())
    assert {(w.unit.detector, w.unit.horizon) for w in works} == {
        ("riqn", 1), ("riqn", 10), ("riqn", 20)
    }  # fmt: skip
    assert len(works) == 7 * (3 + 1 + 1)


def test_horizons_and_sampling_sizes_share_a_fit(mini):
    ant = [w for w in mini if w.unit.environment == "ant" and w.unit.seed == 0]
    riqn = {w.fit for w in ant if w.unit.detector == "riqn" and "members" not in w.unit.overrides}
    assert len(riqn) == 1
    assert len({w.fit for w in ant if w.unit.detector == "npn"}) == 1


def test_a_shared_fit_is_counted_once():
    works = [make_work("a", Cost(30, 1)), make_work("a", Cost(30, 5), horizon=10),
             make_work("b", Cost(20, 2))]  # fmt: skip
    assert remaining_seconds(works, ()) == 30 + 1 + 5 + 20 + 2
    assert remaining_seconds(works, {"a"}) == 1 + 5 + 20 + 2
    assert remaining_seconds([], ()) == 0


def test_a_batch_starts_with_new_fits_and_long_ones():
    works = [make_work("a", Cost(30, 1)), make_work("a", Cost(30, 9), horizon=10),
             make_work("b", Cost(50, 2)), make_work("a", Cost(30, 3), horizon=20)]  # fmt: skip
    batch = next_batch(works, 1000, ())
    assert [(w.fit, w.unit.horizon) for w in batch] == [("b", 1), ("a", 1), ("a", 10), ("a", 20)]


def test_a_batch_is_as_long_as_asked_and_never_empty():
    works = [make_work(f"{i}", Cost(9, 1), seed=i) for i in range(10)]
    assert len(next_batch(works, 35, ())) == 3
    assert len(next_batch(works, 0.1, ())) == 1
    assert next_batch([], 10, ()) == []


def test_a_unit_is_done_when_all_its_anomalies_are_scored():
    work = dataclasses.replace(make_work("a", Cost(1, 1)), key="k")
    other = make_record(anomaly="drift")
    ok = make_record(anomaly="iid")
    failed = make_record(anomaly="iid", status="error")
    for record in (other, ok, failed):
        record.scores = "k"
    assert not is_done(work, finished_keys([other]))
    assert not is_done(work, finished_keys([failed]))
    assert is_done(work, finished_keys([other, ok]))


def test_costs_grow_with_what_is_scored_and_not_with_the_number_of_seeds():
    def unit(horizon=1, **overrides):
        return Unit("riqn", horizon, 0, "ant", overrides, overrides, ())

    near, far = estimate(unit(), 30_000), estimate(unit(20), 30_000)
    assert near.fit == far.fit > 0
    assert far.score > 10 * near.score > 0
    assert estimate(unit(samples=128), 30_000).score > estimate(unit(samples=32), 30_000).score
    assert estimate(unit(members=1), 30_000).fit < near.fit
    more = estimate(unit(20), 60_000)
    assert more.score - 3 == pytest.approx(2 * (far.score - 3))
    unknown = Unit("someone-elses", 1, 0, "ant", {}, {}, ())
    assert estimate(unknown, 30_000).fit > 0


def test_rows_are_counted_from_the_manifest():
    split = load_split("mini")
    data = split.environment("acrobot")
    sets = [data.calibration, data.twins, *(data.anomalous(a) for a in data.anomalies)]
    assert scored_rows(split, "acrobot") == sum(int(s.lengths.sum()) + len(s) for s in sets)
    data.close()


def test_estimates_are_corrected_by_what_has_finished():
    def finished(fit, n):
        made = make_record("riqn", "ant")
        return [dataclasses.replace(made, seconds_fit=fit, seconds_score=0.0)] * n

    expected = estimate(Unit("riqn", 1, 0, "ant", {}, {}, ()), 0)
    twice = 2 * (expected.fit + expected.score) - 3
    assert correction(finished(twice, 5), {"ant": 0}) == pytest.approx(2.0)
    assert correction([], {}) == 1.0


@pytest.mark.parametrize(("seconds", "text"), [(7.4, "7 s"), (600, "10 min"),
                                               (7260, "2 h 01 min")])  # fmt: skip
def test_durations_are_readable(seconds, text):
    assert duration(seconds) == text


class FakeRunner:
    """Finishes units at a price of one second each, on a clock of its own."""

    def __init__(self, watch, *, interrupted=False, finishes=True):
        self.watch, self.now, self.batches = watch, 0.0, []
        self.interrupted, self.finishes = interrupted, finishes

    def __call__(self, plan, split, plugins, settings, results):
        self.batches.append(len(plan.units))
        for unit in plan.units if self.finishes else ():
            self.now += 1.0
            record = make_record(unit.detector, unit.environment, seed=unit.seed)
            cell = f"mini/{unit.environment}/iid::{unit.label}"
            self.watch.oodd_cell_finished(dataclasses.replace(record, cell=cell), resumed=False)
        return Run([], self.interrupted)

    def clock(self):
        return self.now


class Observed:
    def observe(self, observer, name):
        assert name == "reproduce"


def run_with(monkeypatch, watch, budget=None, **kinds):
    fake = FakeRunner(watch, **kinds)
    monkeypatch.setattr(carry, "run", fake)
    split = type("Split", (), {"name": "mini", "digest": "d"})
    outcome = carry_out(
        watch, split, Observed(), Settings(jobs=1), None, budget=budget, clock=fake.clock
    )
    return outcome, fake


def test_everything_is_run_without_a_budget(monkeypatch):
    lines = []
    works = [make_work(str(i), Cost(50, 0), seed=i) for i in range(12)]
    watch = Watch(works, {}, 1, lines.append)
    outcome, fake = run_with(monkeypatch, watch)
    assert (outcome.attempted, outcome.left, outcome.interrupted) == (12, 0, False)
    assert fake.batches == [4, 4, 4]  # 240 seconds each
    assert len(lines) == 12
    assert lines[-1].startswith("[12/12] ant/riqn[h=1,seed=11]")


def test_a_budget_ends_the_run_and_says_what_is_left(monkeypatch):
    works = [make_work(str(i), Cost(1, 0), seed=i) for i in range(50)]
    outcome, fake = run_with(monkeypatch, Watch(works, {}, 1), budget=20.0)
    assert outcome.left == 50 - outcome.attempted > 0
    assert not outcome.interrupted
    assert 20 <= fake.now <= 21  # batches shrink, so that the last ends soon after
    assert fake.batches[-1] == 1


def test_an_interrupted_run_stops(monkeypatch):
    works = [make_work(str(i), Cost(200, 0), seed=i) for i in range(5)]
    outcome, fake = run_with(monkeypatch, Watch(works, {}, 1), interrupted=True)
    assert outcome.interrupted
    assert (outcome.attempted, outcome.left, len(fake.batches)) == (1, 4, 1)


def test_a_batch_of_which_nothing_comes_is_not_tried_for_ever(monkeypatch):
    works = [make_work("a", Cost(1, 0))]
    outcome, fake = run_with(monkeypatch, Watch(works, {}, 1), finishes=False)
    assert (outcome.left, len(fake.batches)) == (1, 1)
