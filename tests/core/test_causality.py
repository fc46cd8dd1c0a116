"""Scores that know the future: beside those of a prefix, and of the twin."""

import math

import numpy as np
import pytest
from helpers_records import make_record
from helpers_split import make_split
from hypothesis import given
from hypothesis import strategies as st

from oodd_eval import evaluate
from oodd_eval.errors import ContractError
from oodd_eval.plugins.contract import TOLERANCE
from oodd_eval.results.evaluate import check_before_effect, difference, early_difference

WHOLE = np.array([math.nan, 1.0, 2.0, 3.0, 2.0])


@pytest.mark.parametrize("found", [WHOLE[:3], WHOLE[:2] + 3e-4, WHOLE, WHOLE[:0]])
def test_the_same_up_to_single_precision_is_the_same(found):
    assert not difference(found, WHOLE, TOLERANCE)


@pytest.mark.parametrize("constant", [0.0, 5e3, -1e7, 1e12, 1e15])
@pytest.mark.parametrize("spike", [1.0, 1e9])
@pytest.mark.parametrize("step", [0.0, 1e7])
def test_neither_a_constant_nor_a_spike_nor_a_step_hides_a_difference(constant, spike, step):
    rng = np.random.default_rng(0)
    whole = constant + rng.normal(size=100) + np.where(np.arange(100) < 30, 0.0, step)
    whole[3] += spike
    found = whole[:50].copy()
    assert not difference(found, whole, TOLERANCE)
    found[40] += 0.2
    assert difference(found, whole, TOLERANCE).startswith("at t = 40 it is")
    if abs(constant) <= 1e7:
        assert not difference(whole[:50] + 1e-5, whole, TOLERANCE)


@pytest.mark.parametrize("scores", [np.full(20, 7.0), np.where(np.arange(20) == 9, 1.0, 2.0)])
def test_scores_that_are_mostly_equal_stay_the_same_bit_for_bit(scores):
    assert not difference(scores[:15], scores, TOLERANCE)
    found = scores[:15].copy()
    found[4] = np.nextafter(found[4], 9.0)
    assert "at t = 4 it is " in difference(found, scores, TOLERANCE)


@pytest.mark.parametrize("n", [1, 2, 3])
def test_a_short_prefix_has_the_spread_of_its_episode(n):
    """An honest float32 network may give the first row another last bit when it comes alone."""
    whole = np.float32(5.0) + np.random.default_rng(0).normal(size=100).astype(np.float32)
    found = np.nextafter(whole[:n], np.float32(9.0)).astype(np.float64)
    assert not difference(found, whole.astype(np.float64), TOLERANCE)
    assert difference(found + 1e-3, whole.astype(np.float64), TOLERANCE)


@given(st.lists(st.integers(-50, 50), min_size=1, max_size=40), st.integers(1, 40))
def test_the_spread_is_the_distance_to_the_k_th_nearest_other_score(scores, n):
    whole = np.array(scores, dtype=np.float64)
    k = max(1, len(whole) // 10)
    nearest = np.sort(np.abs(whole - whole[:, None]), axis=1)
    expected = nearest[:, k] if k < len(whole) else np.zeros(1)
    allowed = TOLERANCE * expected
    assert not difference((whole + 0.99 * allowed)[:n], whole, TOLERANCE)
    assert difference((whole + 1.01 * allowed + 1e-12)[:n], whole, TOLERANCE)


class Magnitude:
    def __init__(self, *, seed, horizon):
        del seed, horizon

    def fit(self, nominal):
        pass

    def score(self, trajectory):
        return np.abs(trajectory.observations).sum(axis=1).astype(np.float64)


class Centred(Magnitude):
    def score(self, trajectory):
        scores = super().score(trajectory)
        return scores - scores.mean()


class InCompany(Magnitude):
    """Causal for itself, but standardized by whatever is scored beside it."""

    def score_many(self, trajectories):
        found = [self.score(x) for x in trajectories]
        return [scores / np.concatenate(found).std() for scores in found]


# Before the effect

LONG = np.concatenate([[math.nan], np.random.default_rng(3).normal(size=60)])
PARTS = {"test/nominal": [LONG, LONG + 1.0], "test/iid": [LONG.copy(), LONG + 1.0]}


def checked(parts, **options):
    effects = {"test/iid": [3, 4]}
    check_before_effect(parts, effects, environment="hopper", detector="mine", **options)


@pytest.mark.parametrize(
    ("row", "change", "streamed", "refused"),
    [
        (2, 0.5, False, True), (2, 1e-12, True, True), (2, 1e-12, False, False),
        (3, 0.5, True, True), (4, 0.5, True, False), (0, 7.0, True, True),
    ],
)  # fmt: skip
def test_scores_before_the_effect_are_those_of_the_twin(row, change, streamed, refused):
    later = {**PARTS, "test/iid": [PARTS["test/iid"][0], PARTS["test/iid"][1].copy()]}
    checked(later, streamed=streamed)
    scores = later["test/iid"][1]
    scores[row] = change if np.isnan(scores[row]) else scores[row] + change
    if not refused:
        checked(later, streamed=streamed)
        return
    with pytest.raises(ContractError, match=rf"hopper/test/iid\[1\] .* at t = {row} it is"):
        checked(later, streamed=streamed)


@pytest.mark.parametrize("level", ["at_10pct", "at_5pct", "at_1pct"])
def test_an_alarm_before_the_effect_is_one_of_the_twin(level):
    terms = np.array([[0.0, 1.0, 0.0], [1.0, 1.0, 1.0]])
    record = make_record()
    record.per_trajectory.update({f"early_{level}": terms, f"early_null_{level}": terms})
    assert early_difference(record) == ""
    record.per_trajectory[f"early_{level}"] = terms[:, ::-1] + [[0.0, 0, 1], [0, 0, 0]]
    assert f"early_{level} of hopper/test/iid[2] is 1, and early_null_" in early_difference(record)


class KnowsTheEnd(Magnitude):
    def score(self, trajectory):
        scores = super().score(trajectory)
        return scores * (1.0 + scores.sum())


@pytest.mark.parametrize("detector", [Magnitude, Centred, InCompany, KnowsTheEnd])
def test_look_ahead_is_found_by_the_twin(tiny_split, detector):
    records = evaluate(detector, tiny_split, environments="hopper", anomalies="iid,gravity")
    if detector is Magnitude:
        assert {r.status for r in records} == {"ok"}
        return
    assert {r.status for r in records} == {"invalid"}
    assert all("not those of its twin" in r.reason and not r.metrics for r in records)


def test_alarms_alone_give_a_look_ahead_away(tmp_path, monkeypatch):
    monkeypatch.setattr("oodd_eval.results.evaluate.check_before_effect", lambda *_, **__: None)
    split = make_split(tmp_path / "split", ("cartpole",), calibration=20)
    records = evaluate(KnowsTheEnd, split, anomalies="iid")
    assert {r.status for r in records} == {"invalid"}
    assert "early_null" in records[0].reason
