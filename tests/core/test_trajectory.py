"""`Trajectory`: what a detector is handed."""

import os
import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import PrecisionWarning, TrajectoryError
from oodd_eval.plugins.isolation import Channel
from oodd_eval.plugins.isolation.worker import TrajectoryFile


def episode(rows=5, sensors=2, actions=1):
    grid = np.arange(rows * sensors, dtype=np.float32).reshape(rows, sensors)
    return Trajectory(grid, np.zeros((rows - 1, actions), np.float32))


def test_without_actions_their_width_is_zero():
    rows = np.arange(6.0).reshape(3, 2)
    for alone in (Trajectory(rows), Trajectory(rows, None), Trajectory(rows, np.zeros((2, 0)))):
        assert alone.actions.shape == (2, 0)
        assert (alone.transitions, alone.action_dim) == (2, 0)
        assert alone[:2].actions.shape == (1, 0)
    assert Trajectory(rows[:1]).actions.shape == (0, 0)
    known = Trajectory(rows, np.ones((2, 4)))
    alone = known.without_actions()
    assert (alone.actions.shape, known.action_dim) == ((2, 0), 4)
    assert np.array_equal(alone.observations, known.observations)
    assert alone.without_actions() is alone


def test_a_trajectory_without_actions_passes_pipe_and_file():
    reading, writing = os.pipe()
    alone = Trajectory(np.arange(6.0).reshape(3, 2))
    Channel(writing).send_trajectory(alone)
    received = Channel(reading).receive_trajectory()
    kept = TrajectoryFile([alone, episode(4), alone])
    found = [received, *kept]
    kept.close()
    assert [x.actions.shape for x in found] == [(2, 0), (2, 0), (3, 1), (2, 0)]
    assert all(np.array_equal(x.observations, alone.observations) for x in found[:2])


def test_is_a_read_only_copy_in_float32():
    source = np.zeros((3, 2))
    copied = Trajectory(source, np.zeros((2, 1)))
    source[:] = 1
    assert not copied.observations.any()
    assert copied.observations.dtype == copied.actions.dtype == np.float32
    with pytest.raises(ValueError, match="read-only"):
        copied.observations[0, 0] = 1
    with pytest.raises(AttributeError):
        copied.observations = source


@given(rows=st.integers(2, 30), cut=st.integers(1, 30))
def test_prefix_keeps_rows_and_drops_the_actions_that_led_beyond(rows, cut):
    whole, cut = episode(rows), min(cut, rows)
    prefix = whole[:cut]
    assert len(prefix) == cut
    assert prefix.transitions == cut - 1
    assert np.array_equal(prefix.observations, whole.observations[:cut])


@pytest.mark.parametrize("rows", [slice(1, 3), slice(0, 0), slice(None, None, 2), 2])
def test_only_non_empty_prefixes_are_trajectories(rows):
    with pytest.raises(TrajectoryError, match=r"expected \[:n\] with 1 <= n <= 5"):
        episode(5)[rows]


@pytest.mark.parametrize(
    ("observations", "actions", "message"),
    [
        (np.zeros((3, 2)), np.zeros((3, 1)), "got 3 observations and 3 actions, expected 4"),
        (np.zeros(3), np.zeros((2, 1)), r"observations have shape \(3,\)"),
        (np.zeros((3, 0)), np.zeros((2, 1)), "at least one row and one column"),
        (np.zeros((0, 2)), np.zeros((0, 1)), "at least one row and one column"),
        (np.zeros((0, 2)), None, "at least one row and one column"),
        (np.zeros((3, 2)), np.zeros(2), r"actions have shape \(2,\), expected \(rows, columns\)"),
        (np.zeros((3, 2)), np.zeros((3, 0)), "got 3 observations and 3 actions, expected 4"),
        ([[1.0, 2.0], [3.0]], [[0.0]], "cannot be read as a float32 matrix"),
        ([[0.0], [np.nan], [0.0]], np.zeros((2, 1)), "row 1, column 0: nan"),
        (np.zeros((3, 2)), [[0.0], [np.inf]], "actions hold 1 values that are not finite"),
        (np.ma.masked_equal([[0.0], [9.0], [0.0]], 9), None, "masked.*row 1, column 0: nan"),
        (np.ma.masked_equal([[0], [9], [0]], 9), None, "row 1, column 0: nan"),
        ([*np.ma.masked_equal([[0.0], [9.0], [0.0]], 9)], None, "row 1, column 0: nan"),
        (np.zeros((2, 2)), np.ma.masked_equal([[9.0]], 9), "actions hold 1.*masked"),
        ([[0.0], [None], [0.0]], None, "row 1, column 0: nan"),
        (np.full((2, 1), 1e300), None, "inf"),
        (np.zeros((3, 2), complex), None, "complex"),
        (np.zeros((3, 2), "M8[s]"), None, "dates"),
        (np.array([[1.0], ["x"]], object), None, "'x'"),
        (np.zeros(3, [("a", "f8")]), None, "named fields"),
        ({1.0}, None, "set"),
    ],
)
def test_bad_arrays_are_named(observations, actions, message):
    with pytest.raises(TrajectoryError, match=message):
        Trajectory(observations, actions)


@pytest.mark.parametrize(
    ("offset", "spread", "told"),
    [
        (5_412_345.0, 0.02, True),  # a northing
        (1.76e9, 1.0, True),  # an epoch
        (1e8, 30, True),  # an encoder
        (9.81, 0.01, False),
        (0.0, 1e-9, False),
        (1.0, 1e-12, False),  # a solver's rounding
    ],
)
def test_readings_that_float32_cannot_tell_are_told(offset, spread, told):
    rows = offset + np.random.default_rng(0).normal(0, spread, (50, 2)) * [0, 1]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        episode = Trajectory(rows)
        Trajectory(rows.astype(np.float32))[:20].without_actions()
    assert [w.category for w in caught] == [PrecisionWarning] * told
    assert all("float32 rounds off what sensor 1 tells," in str(w.message) for w in caught)
    assert all(w.filename == __file__ for w in caught)
    assert np.array_equal(episode.observations, rows.astype(np.float32))
