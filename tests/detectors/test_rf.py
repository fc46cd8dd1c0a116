"""The random forests: forecasts, score and causality against slow, obvious forms of them."""

import numpy as np
import pytest

from oodd_eval import Trajectory
from oodd_eval.errors import FittedStateError, UsageError
from oodd_eval.plugins.forecasting import FeatureScale
from oodd_eval.plugins.parameters import parameters_of
from oodd_eval.plugins.state import pack

pytest.importorskip("sklearn")
from oodd_rf import make_rf, make_rf_ewma, oodd_detectors
from oodd_rf.detector import MEMBERS
from oodd_rf.windows import Rows

SMALL = {"members": 3, "trees": 4, "leaves": 60, "rows": 400, "draws": 200}


def episode(seed, n=60, d=3):
    """Phases that differ between episodes: sines are predictable from one window to the next."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 6.28, d)
    rows = np.sin(phase + 0.3 * np.arange(n)[:, None]) + 0.02 * rng.normal(size=(n, d))
    return Trajectory(rows * [1.0, 10.0, 0.1][:d], np.zeros((n - 1, 1)))


NOMINAL = [episode(seed) for seed in range(8)]


def fitted(**changes):
    return make_rf(**{**SMALL, **changes}).fit(NOMINAL)


def test_windows_repeat_the_first_observation_of_their_own_trajectory():
    rows = Rows.stack(
        [Trajectory([[1.0], [2.0]], [[0.0]]), Trajectory([[3.0], [4.0]], [[0.0]])],
        FeatureScale(np.zeros(1), np.ones(1)),
    )  # fmt: skip
    windows = rows.window(np.array([0, 1, 2, 3]), 3)[..., 0]
    assert windows.tolist() == [[1, 1, 1], [2, 1, 1], [3, 3, 3], [4, 3, 3]]
    assert rows.with_history(1).tolist() == [1, 3]
    assert rows.with_history(2).tolist() == []


@pytest.mark.parametrize("horizon", [1, 3])
def test_scores_are_those_of_a_slow_loop(horizon):
    rf = fitted(horizon=horizon)
    x = episode(90, n=12)
    z = (x.observations.astype(np.float64) - rf.scale_.mean) / rf.scale_.std
    expected = np.full(len(x), np.nan)
    for t in range(horizon, len(x)):
        errors = []
        for member in rf.members_:
            known = list(z[: t - horizon + 1])
            for _ in range(horizon):
                window = [known[max(len(known) - 1 - lag, 0)] for lag in range(member.window)]
                features = np.concatenate(window)[None].astype(np.float32)
                trees = [tree.predict(features)[0, :, 0] for tree in member.trees]
                known.append(known[-1] + np.mean(trees, axis=0))
            errors.append(np.mean(np.abs(z[t] - known[t])))
        expected[t] = np.mean(errors)
    np.testing.assert_allclose(rf.score(x), expected, rtol=1e-5, atol=1e-6)


def test_score_is_the_mean_distance_in_standard_deviations():
    """Forests of a motionless world predict no motion, so the score is the size of the step."""
    still = [Trajectory([[v, 0.0]] * 5, np.zeros((4, 1))) for v in (-1.0, 1.0)]
    rf = make_rf(**SMALL).fit(still)
    x = Trajectory([[1.0, 0.0], [1.5, 0.25], [1.5, 0.25]], np.zeros((2, 1)))
    # Standard deviations 1 and, for the constant sensor, 1: (0.5 + 0.25) / 2.
    np.testing.assert_array_equal(rf.score(x), [np.nan, 0.375, 0.0])


def test_forecasts_beat_persistence_on_held_out_trajectories():
    rf = make_rf(members=3).fit([episode(seed) for seed in range(100, 140)])
    x = episode(60)
    moved = np.abs(np.diff(x.observations / rf.scale_.std, axis=0)).mean()
    assert np.nanmean(rf.score(x)) < 0.5 * moved


def test_members_differ_and_the_size_of_training_and_trees_is_bounded():
    members = fitted(members=6).members_
    assert [m.window for m in members] == [4, 3, 2, 1, 4, 3]
    assert len({m.trees[0].threshold.tobytes() for m in members}) == 6
    assert len(set(MEMBERS)) == 5
    for draws, drawn in ((20, 20), (100, 30)):
        rf = make_rf(members=1, trees=2, leaves=8, rows=30, draws=draws).fit(NOMINAL)
        for tree in rf.members_[0].trees:
            assert tree.n_leaves <= 8
            assert tree.weighted_n_node_samples[0] == drawn


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        ("0.left", lambda a: a.__setitem__(0, 10**6)),
        ("0.right", lambda a: a.__setitem__(0, 0)),
        ("0.feature", lambda a: a.__setitem__(0, 99)),
        ("0.threshold", lambda a: a.__setitem__(0, np.nan)),
        ("0.counts", lambda a: a.__setitem__(0, 3)),
        ("0.leaves", lambda a: a.__setitem__(0, np.inf)),
    ],
)
def test_damaged_trees_are_refused(name, damage):
    state = pack(make_rf(**SMALL).fit(NOMINAL).state()).state()
    damage(state[name])
    with pytest.raises(FittedStateError, match=r"array '|a saved (tree|forest)"):
        make_rf(**SMALL).restore(state)


# rf-ewma


def smoothed(scores, weight):
    """The running mean, one step after the other, from the first defined score on."""
    found, z = [], None
    for s in scores:
        if not np.isnan(s):
            z = s if z is None else z + weight * (s - z)
        found.append(np.nan if z is None else z)
    return found


@pytest.mark.parametrize("horizon", [1, 3])
def test_ewma_is_the_running_mean_of_rf_from_its_first_score(horizon):
    raw = fitted(horizon=horizon).score(episode(90))
    made = make_rf_ewma(**SMALL, horizon=horizon).fit(NOMINAL)
    found = made.score(episode(90))
    np.testing.assert_allclose(found, smoothed(raw, 0.03), rtol=1e-12)
    assert found[horizon] == raw[horizon]
    alone = make_rf_ewma(**SMALL, horizon=horizon, weight=1.0).fit(NOMINAL)
    np.testing.assert_array_equal(alone.score(episode(90)), raw)


def test_ewma_shares_the_fits_of_rf_and_is_its_own_statistic():
    rf, ewma = oodd_detectors()
    assert (ewma.name, ewma.alarm, rf.alarm) == ("rf-ewma", "score", "cusum")
    assert rf.fit_name == ewma.fit_name == "rf"
    known = parameters_of(ewma.parameters)
    assert {n for n in known if known[n].decides == "fit"} == set(parameters_of(rf.parameters))
    with pytest.raises(UsageError, match="parameter 'weight' of rf-ewma is 0, expected more than"):
        make_rf_ewma(weight=0)
