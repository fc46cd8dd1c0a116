"""Detectors name the parts at fault: recorded and live alike, from a restored fit, in own units."""

import numpy as np
import pytest
from oodd_common.latest_rows import MOST_SENSORS, ROWS
from oodd_mewma import make_mewma, make_mewma_a
from oodd_panel import make_panel

from oodd_eval import Trajectory

MIXING = np.array([[0.6, 0.2, 0.0, 0.1], [-0.2, 0.5, 0.1, 0.0], [0.0, 0.1, 0.7, 0.2]])
MAKERS = {
    "mewma": make_mewma,
    "mewma-a": make_mewma_a,
    "panel": lambda **kw: make_panel(forecast="linear", learn="none", **kw),
    "panel-a": lambda **kw: make_panel("panel-a", forecast="linear", learn="none", **kw),
}
BIAS, SENSOR, ONSET = 4.0, 2, 150


def driven(seed, rows=220, level=0.0, gain=1.0):
    """Three states that a command pushes, each read by a sensor with a level and a gain."""
    rng = np.random.default_rng(seed)
    state, commands = np.zeros((rows, 3)), rng.normal(size=(rows - 1, 1))
    for t in range(1, rows):
        pushed = np.r_[state[t - 1], commands[t - 1]]
        state[t] = MIXING @ pushed + 0.3 * rng.normal(size=3)
    return Trajectory(level + gain * state, commands)


def biased(x, bias=BIAS):
    rows = x.observations.copy()
    rows[ONSET:, SENSOR] += bias
    return Trajectory(rows, x.actions)


NOMINAL = [driven(seed) for seed in range(12)]


def fed(detector, x):
    """Feed an episode through one action's buffer, as loops of robots do."""
    detector.reset()
    buffer = np.empty(x.action_dim, np.float32)
    for t, row in enumerate(x.observations):
        if t:
            buffer[:] = x.actions[t - 1]
        detector.update(row, buffer if t else None)
    buffer[:] = np.nan
    return detector.explain_last()


@pytest.fixture(scope="module", params=[(n, h) for n in MAKERS for h in (1, 3)], ids=str)
def fitted(request):
    name, horizon = request.param
    return name, horizon, MAKERS[name](horizon=horizon).fit(NOMINAL)


def test_the_faulty_sensor_is_named(fitted):
    name, _, detector = fitted
    named = np.zeros(3)
    for seed in range(50, 58):
        naming = detector.explain(biased(driven(seed))[: ONSET + 6]).naming
        assert naming.actuators.shape == (name.endswith("-a"),)
        named += naming.sensors >= 0.5
    assert named[SENSOR] == 8
    assert named.sum() <= 10


def test_a_naming_is_the_same_recorded_live_and_from_a_restored_fit(fitted):
    name, horizon, detector = fitted
    restored = MAKERS[name](horizon=horizon)
    restored.restore(detector.state())
    x = biased(driven(60))
    for rows in (1, 2, horizon, horizon + 1, 40, ROWS, ROWS + 1, ONSET + 1, ONSET + 20):
        explained = detector.explain(x[:rows])
        shares, onset, naming = fed(restored, x[:rows])
        np.testing.assert_allclose(shares, explained.shares[-1], rtol=1e-9)
        assert onset == explained.onsets[-1]
        assert (naming is None) == (explained.naming is None) == (rows <= horizon)
        if naming:
            assert naming.kind == explained.naming.kind
            for part, expected in zip(naming[:3], explained.naming[:3], strict=True):
                np.testing.assert_array_equal(part, expected)


def test_rows_before_the_latest_do_not_matter(fitted):
    _, _, detector = fitted
    x, other = biased(driven(61)), driven(62)
    rows = np.r_[other.observations[: ONSET - 80], x.observations[ONSET - 80 : ONSET + 10]]
    actions = np.r_[other.actions[: ONSET - 80], x.actions[ONSET - 80 : ONSET + 9]]
    spliced = Trajectory(rows, actions)
    assert (detector.explain(spliced).naming.sensors >= 0.5).tolist() == [False, False, True]


def test_sizes_are_in_the_units_of_an_episode_with_a_baseline_of_its_own():
    panel = MAKERS["panel-a"](baseline=60).fit([driven(s, level=s % 3) for s in range(12)])
    nominal, sizes = driven(63), []
    for gain in (1.0, 4.0):
        own = Trajectory(10.0 + gain * nominal.observations, nominal.actions)
        x = biased(own, gain * BIAS)[: ONSET + 6]
        naming = panel.explain(x).naming
        assert (naming.sensors >= 0.5).tolist() == [False, False, True]
        np.testing.assert_array_equal(fed(panel, x)[2].sizes, naming.sizes)
        sizes.append(naming.sizes[SENSOR])
    # As seen at training's level both faults are about as large.
    assert 2.5 < sizes[1] / sizes[0] < 5


@pytest.mark.parametrize("name", MAKERS)
def test_no_parts_are_named_of_very_many_sensors(name):
    rng = np.random.default_rng(0)
    nominal = [Trajectory(rng.normal(size=(60, MOST_SENSORS + 1)), rng.normal(size=(59, 1)))] * 5
    detector = MAKERS[name]().fit(nominal)
    assert detector.explain(nominal[0]).naming is None
    assert fed(detector, nominal[0])[2] is None
    assert not any(key.startswith("naming") for key in detector.state())
