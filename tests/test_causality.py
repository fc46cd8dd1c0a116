"""Prefixes that are scored again in a run: which, and what is made of their scores."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from oodd_eval import evaluate
from oodd_eval.errors import ContractError
from oodd_eval.plugins.contract import MIN_ROWS, PROBES, check_prefix, probes

LENGTHS = st.dictionaries(
    st.sampled_from(["calibration", "test/nominal", "test/iid"]),
    st.lists(st.integers(1, 500), max_size=20),
)


@given(LENGTHS, st.text())
def test_probes_are_of_different_episodes_and_cut_each_in_its_middle_half(lengths, key):
    found = probes(lengths, key)
    long = sum(n >= MIN_ROWS for part in lengths.values() for n in part)
    assert len({(p.part, p.index) for p in found}) == len(found) == min(long, PROBES)
    for probe in found:
        n = lengths[probe.part][probe.index]
        assert n // 4 <= probe.rows <= 3 * n // 4 < n
    assert found == probes(lengths, key)


def test_the_key_decides_and_every_part_is_probed():
    lengths = {"calibration": [100] * 20, "test/iid": [100] * 20}
    drawn = [probes(lengths, f"key {i}") for i in range(50)]
    assert len({tuple(found) for found in drawn}) == 50
    share = np.mean([p.part == "calibration" for found in drawn for p in found])
    assert abs(share - 0.5) < 4 * 0.5 / math.sqrt(50 * PROBES)


WHOLE = np.array([math.nan, 1.0, 2.0, 3.0, 2.0])


@pytest.mark.parametrize("found", [WHOLE[:3], WHOLE[:3] * (1 + 5e-4), WHOLE, WHOLE[:0]])
def test_the_same_up_to_single_precision_is_the_same(found):
    check_prefix(found, WHOLE, detector="mine", where="hopper/test/iid[7]")


def test_what_differs_is_named_with_both_values():
    with pytest.raises(ContractError) as error:
        check_prefix(
            np.array([math.nan, 1.0, 2.01]), WHOLE, detector="mine", where="hopper/test/iid[7]"
        )
    assert str(error.value) == (
        "detector 'mine' gives the first 3 of 5 observations of hopper/test/iid[7] other scores "
        "when they are all it gets: at t = 2 it is 2.01 instead of 2; expected the same, as a "
        "score may use nothing after its time and nothing of other episodes (`oodd-eval check "
        "mine -k prefix`)"
    )


def test_a_nan_that_the_whole_episode_does_not_have_differs():
    with pytest.raises(ContractError, match="at t = 1 it is nan instead of 1"):
        check_prefix(
            np.array([math.nan, math.nan]), WHOLE, detector="mine", where="hopper/test/iid[7]"
        )


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
        with pytest.raises(ContractError, match="when they are all it gets: at t = 0 it is"):
            evaluate(wrong, tiny_split, environments="hopper")
