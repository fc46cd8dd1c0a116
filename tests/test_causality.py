"""Prefixes that are scored again in a run: which, and what is made of their scores."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from oodd_eval import evaluate
from oodd_eval.errors import ContractError
from oodd_eval.plugins.contract import MIN_ROWS, PROBES, TOLERANCE, check_prefix, difference, probes

LENGTHS = st.dictionaries(
    st.sampled_from(["calibration", "test/nominal", "test/iid"]),
    st.lists(st.integers(1, 500), max_size=20),
)


@given(LENGTHS, st.integers(0, 2**53 - 1))
def test_probes_are_of_different_episodes_and_the_first_reaches_the_last_quarter(lengths, seed):
    found = probes(lengths, seed)
    seeds = {
        (part == "calibration", i)
        for part, own in lengths.items()
        for i, n in enumerate(own)
        if n >= MIN_ROWS
    }
    drawn = {(p.part == "calibration", p.index) for p in found}
    assert drawn <= seeds
    assert len(drawn) == len(found) == min(len(seeds), PROBES)
    for k, probe in enumerate(found):
        n = lengths[probe.part][probe.index]
        assert (n // 4 if k else 3 * n // 4) <= probe.rows < n
    assert found == probes(lengths, seed)


WHOLE = np.array([math.nan, 1.0, 2.0, 3.0, 2.0])


@pytest.mark.parametrize("found", [WHOLE[:3], WHOLE[:2] + 3e-4, WHOLE, WHOLE[:0]])
def test_the_same_up_to_single_precision_is_the_same(found):
    check_prefix(found, WHOLE, detector="mine", where="hopper/test/iid[7]")


@pytest.mark.parametrize("constant", [0.0, 5e3, -1e7, 1e12, 1e15])
@pytest.mark.parametrize("spike", [1.0, 1e9])
@pytest.mark.parametrize("step", [0.0, 1e7])
def test_neither_a_constant_nor_a_spike_nor_a_step_hides_a_difference(constant, spike, step):
    rng = np.random.default_rng(0)
    whole = constant + rng.normal(size=100) + np.where(np.arange(100) < 30, 0.0, step)
    whole[3] += spike
    found = whole[:50].copy()
    check_prefix(found, whole, detector="mine", where="hopper/test/iid[7]")
    found[40] += 0.2
    with pytest.raises(ContractError, match="at t = 40 it is"):
        check_prefix(found, whole, detector="mine", where="hopper/test/iid[7]")
    if abs(constant) <= 1e7:
        check_prefix(whole[:50] + 1e-5, whole, detector="mine", where="hopper/test/iid[7]")


def test_rollouts_may_leave_more_rounding_and_no_more_than_that():
    whole = np.arange(100.0)  # the tenth nearest other score is five away
    for horizon, allowed in ((1, 5e-3), (2, 25e-3)):
        given = {"detector": "mine", "where": "hopper/test/iid[7]", "horizon": horizon}
        check_prefix(whole[:90] + 0.9 * allowed, whole, **given)
        with pytest.raises(ContractError, match="is not causal"):
            check_prefix(whole[:90] + 1.1 * allowed, whole, **given)


@pytest.mark.parametrize("scores", [np.full(20, 7.0), np.where(np.arange(20) == 9, 1.0, 2.0)])
def test_scores_that_are_mostly_equal_stay_the_same_bit_for_bit(scores):
    check_prefix(scores[:15], scores, detector="mine", where="x")
    found = scores[:15].copy()
    found[4] = np.nextafter(found[4], 9.0)
    with pytest.raises(ContractError, match=r"at t = 4 it is [27]\.00000000000000"):
        check_prefix(found, scores, detector="mine", where="x")


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


def test_a_detector_in_this_process_is_probed_too(tiny_split):
    records = evaluate(Magnitude, tiny_split, environments="hopper")
    assert {r.status for r in records} == {"ok"}
    for wrong in (Centred, InCompany):
        with pytest.raises(ContractError, match=r"is not causal: .* at t = 0 it is"):
            evaluate(wrong, tiny_split, environments="hopper")
