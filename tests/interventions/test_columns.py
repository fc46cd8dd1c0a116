"""Columns of studies of interventions: cells made by hand, whose answers are known."""

import json
import random

import numpy as np
import pytest
from helpers_studies import episode, naming, study_cell
from oodd_interventions.columns import ALL, records_of

from oodd_eval.metrics.catalogue import INTERVENTIONS

#               twin never watchdog oracle placebo false forced
SAVES = episode(1, [100, 20, 60, 100, 30, 100, 90])
HALF = episode(2, [100, 60, 80, 80, 50, 96, 80])


def figure(record, name):
    return record["intervention"][name]["value"]


def of(records, **fields):
    (record,) = (r for r in records if all(r[name] == value for name, value in fields.items()))
    return record


def test_return_saved_is_a_ratio_of_sums():
    (cell, *_) = records_of([study_cell([SAVES, HALF])])
    assert figure(cell, "return_saved") == pytest.approx((40 + 20) / (80 + 20))
    assert figure(cell, "placebo_saved") == pytest.approx((10 - 10) / (80 + 20))
    assert cell["intervention"]["return_saved"]["n"] == 2
    assert figure(cell, "harm_on_nominal") == pytest.approx(0.04 / 2)
    assert figure(cell, "forced_harm") == pytest.approx((0.1 + 0.2) / 2)
    assert cell["returns"]["never"] == 40


@pytest.mark.parametrize(("scale", "shift"), [(1e-3, 0), (1, -200)])
def test_shares_have_no_unit(scale, shift):
    """Also of rewards that are losses: there the nominal return is negative, here -100."""
    episodes = [
        e | {"returns": {arm: scale * (value + shift) for arm, value in e["returns"].items()}}
        for e in (SAVES, HALF)
    ]
    (record, *_) = records_of([study_cell(episodes)])
    expected, *_ = records_of([study_cell([SAVES, HALF])])
    for name in ("return_saved", "placebo_saved", "harm_on_nominal", "forced_harm"):
        assert figure(record, name) == pytest.approx(figure(expected, name))


def test_kinds_on_which_acting_cannot_pay_are_in_no_saving():
    """Of iid the oracle saves half; of drift, which costs 1 %, it saves 1 % and the alarm harms."""
    drift = [episode(s, [100, 99, 79, 100, 99, 100, 100]) for s in (1, 2)]
    gravity = [episode(s, [100, 40, 20, 44, 40, 98, 100]) for s in (1, 2)]
    cells = [study_cell([SAVES, HALF]), study_cell(drift, anomaly="drift")]
    cells.append(study_cell(gravity, anomaly="gravity", group="dynamics"))
    records = records_of(cells)
    for anomaly in ("drift", "gravity"):
        saved = of(records, anomaly=anomaly)["intervention"]["return_saved"]
        assert saved == {"value": None, "low": None, "high": None, "n": 0}
    whole = of(records, environment="hopper", anomaly=ALL)
    assert figure(whole, "return_saved") == pytest.approx(0.6)
    assert whole["group"] == ALL
    # Acting where nothing needed it: on twins, and under drift, which costs less than 5 %.
    assert figure(of(records, anomaly="drift"), "availability_cost") == pytest.approx(0.1)
    assert figure(of(records, anomaly="gravity"), "availability_cost") == pytest.approx(0.02)
    lost = 0.04 + 2 * 0.2 + 2 * 0.02  # of 2 twins each of three kinds, and 2 episodes of drift
    assert figure(whole, "availability_cost") == pytest.approx(lost / 8)


def test_failures_and_acts_are_counted():
    episodes = [
        episode(1, [100, 20, 90, 100, 20, 100, 100], failed={"never"}),
        episode(2, [100, 20, 20, 100, 20, 100, 100], failed={"never", "watchdog"}, alarm=None),
        episode(3, [100, 90, 20, 100, 20, 100, 100], failed={"watchdog"}, alarm=39),
        episode(4, [100, 90, 95, 100, 20, 100, 100], alarm=51),
        episode(5, [100, 90, 95, 100, 20, 100, 100], alarm=42),
    ]
    (record, *_) = records_of([study_cell(episodes)])
    assert figure(record, "safety_gain") == pytest.approx(0.0)
    assert figure(record, "residual_hazard") == pytest.approx(0.4)
    assert figure(record, "acted") == pytest.approx(0.8)
    assert figure(record, "act_delay") == 5  # of 5, 11 and 2: the act at row 39 was early
    assert record["intervention"]["act_delay"]["n"] == 3


def test_an_environment_counts_once_in_the_mean():
    hopper = [study_cell([SAVES, HALF], anomaly=a) for a in ("iid", "calibration", "shutdown")]
    perfect = [episode(s, [10, 0, 10, 10, 0, 10, 10]) for s in (1, 2)]
    records = records_of([*hopper, study_cell(perfect, environment="cartpole", cap=500)])
    assert [(r["environment"], r["anomaly"]) for r in records] == [
        ("cartpole", "iid"), ("hopper", "calibration"), ("hopper", "iid"), ("hopper", "shutdown"),
        ("cartpole", ALL), ("hopper", ALL), (ALL, ALL),
    ]  # fmt: skip
    assert figure(of(records, environment=ALL), "return_saved") == pytest.approx(0.8)
    assert "returns" not in records[-1]


def test_namings_at_the_alarm_and_20_rows_later():
    first = {"0": naming(0, -1, onset=37), "20": naming(0, 2)}
    alike = [100, 20, 60, 100, 30, 100, 90]
    episodes = [
        episode(1, alike, named=first),
        episode(2, alike, named={"0": naming(kind="body")}),  # names nothing, and soon ends
        episode(3, alike, named={"0": naming(1)}, alarm=12),  # before the effect
        episode(4, alike, alarm=None, acted=None),
    ]
    (record, *_) = records_of([study_cell(episodes)])
    expected = {
        "named_precision": 0.5, "named_recall": 0.25, "named_precision_20": 1.0,
        "named_recall_20": 0.5, "named_chance": 0.5, "named_largest": 0.25, "kind_named": 0.5,
        "onset_error": (3 + 2) / 2,
    }  # fmt: skip
    assert {name: figure(record, name) for name in expected} == expected
    assert {*record["intervention"]} == {*expected, *INTERVENTIONS}


def test_kinds_of_dynamics_need_not_be_told_apart():
    """A body's fault may be named an environment's, but no actuator's; it has no faulty part."""
    parts = {"sensors": [], "actuators": [], "kind": "body"}
    named = [naming(1, kind=kind) for kind in ("environment", "actuator")]
    episodes = [
        episode(s, [100, 20, 60, 100, 30, 100, 90], named={"0": n}, parts=parts)
        for s, n in enumerate(named)
    ]
    (record, *_) = records_of([study_cell(episodes, group="dynamics", anomaly="gravity")])
    assert figure(record, "kind_named") == 0.5
    assert figure(record, "named_precision") is None


def noisy(detector, saved, seeds=20):
    """A cell whose watchdog saves a share, in some episodes more than in others."""
    rng = np.random.default_rng(5)
    episodes = []
    for seed in range(seeds):
        never, noise = 20 + 30 * rng.random(), 4 * rng.standard_normal()
        watchdog = never + saved * (100 - never) + noise
        episodes.append(episode(seed, [100, never, watchdog, 100, never, 100, 100]))
    return study_cell(episodes, detector=detector)


def test_intervals_hold_the_value_and_are_the_same_whatever_is_beside():
    alone = records_of([noisy("panel", 0.6)])
    beside = records_of([noisy("panel", 0.6), noisy("riqn", 0.2)])
    assert alone[0] == of(beside, detector="panel", anomaly="iid")
    saved = alone[0]["intervention"]["return_saved"]
    assert saved["low"] < saved["value"] < saved["high"]
    assert 0.01 < saved["high"] - saved["low"] < 0.2


def test_rows_are_compared_with_the_best_by_seed():
    """The noise is the same for all: differences of detectors are paired."""
    cells = [noisy("riqn", 0.5), noisy("panel", 0.6), noisy("rf", 0.6), noisy("pe", 0.55)]
    records = {r["detector"]: r for r in records_of(cells) if r["environment"] == ALL}
    assert "behind" not in records["panel"]
    for detector, behind in (("riqn", 0.1), ("pe", 0.05)):
        test = records[detector]["behind"]
        assert test["row"] == "panel"
        assert test["value"] == pytest.approx(behind)
        assert 0 < test["low"] <= test["value"] <= test["high"]
        assert test["p"] < 0.01
    assert records["rf"]["behind"]["value"] == 0
    assert records["rf"]["behind"]["p"] == 1


def test_rows_are_compared_where_all_have_a_value():
    riqn = [noisy("riqn", 0.5), noisy("riqn", 0.9) | {"anomaly": "shutdown"}]
    records = records_of([noisy("panel", 0.6), *riqn])
    assert figure(of(records, detector="riqn", environment=ALL), "return_saved") > 0.65
    behind = of(records, detector="riqn", environment=ALL)["behind"]
    assert (behind["row"], behind["value"]) == ("panel", pytest.approx(0.1))
    apart = [noisy("panel", 0.6), noisy("riqn", 0.5) | {"anomaly": "shutdown"}]
    assert not any("behind" in record for record in records_of(apart))


def test_acts_are_rows_of_their_own():
    records = records_of([noisy("panel", 0.6), noisy("panel", 0.2) | {"act": "stop"}])
    saved = {r["act"]: figure(r, "return_saved") for r in records if r["environment"] == ALL}
    assert saved["mask"] - saved["stop"] == pytest.approx(0.4)


def test_records_are_plain_json_whatever_the_order_of_cells():
    cells = [noisy("panel", 0.6), noisy("riqn", 0.5), study_cell([SAVES], environment="cartpole")]
    records = records_of(cells)
    assert json.loads(json.dumps(records, allow_nan=False)) == records
    random.Random(1).shuffle(cells)
    assert records_of(cells) == records


def test_a_study_without_cells_has_no_records():
    assert records_of([]) == []
