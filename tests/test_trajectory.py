"""`Trajectory`: what a detector is handed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from oodd_eval.data.trajectory import Trajectory, pad
from oodd_eval.errors import TrajectoryError


def episode(rows=5, sensors=2, actions=1):
    grid = np.arange(rows * sensors, dtype=np.float32).reshape(rows, sensors)
    return Trajectory(grid, np.zeros((rows - 1, actions), np.float32))


def test_has_one_more_observation_than_transitions():
    assert (len(episode(5)), episode(5).transitions) == (5, 4)


def test_a_single_observation_is_a_trajectory():
    alone = episode(1)
    assert (len(alone), alone.transitions, alone.action_dim) == (1, 0, 1)


def test_is_a_read_only_copy():
    source = np.zeros((3, 2), np.float32)
    made = Trajectory(source, np.zeros((2, 1)))
    source[:] = 1
    assert not made.observations.any()
    with pytest.raises(ValueError, match="read-only"):
        made.observations[0, 0] = 1


def test_is_stored_as_float32():
    made = Trajectory([[1, 2]], np.zeros((0, 3)))
    assert made.observations.dtype == made.actions.dtype == np.float32


def test_fields_cannot_be_reassigned():
    with pytest.raises(AttributeError):
        episode().observations = np.zeros((5, 2))


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
        (np.zeros((3, 0)), np.zeros((2, 1)), "at least one column"),
        (np.zeros((0, 2)), np.zeros((0, 1)), "and one row"),
        ([[1.0, 2.0], [3.0]], [[0.0]], "cannot be read as a float32 matrix"),
        ([[0.0], [np.nan], [0.0]], np.zeros((2, 1)), "row 1, column 0: nan"),
        (np.zeros((3, 2)), [[0.0], [np.inf]], "actions hold 1 values that are not finite"),
    ],
)
def test_bad_arrays_are_named(observations, actions, message):
    with pytest.raises(TrajectoryError, match=message):
        Trajectory(observations, actions)


def test_pad_fills_with_zeros_behind_the_end():
    batch, lengths = pad([np.ones((1, 2), np.float32), np.full((3, 2), 2, np.float32)])
    assert lengths.tolist() == [1, 3]
    assert batch.sum(axis=2).tolist() == [[2, 0, 0], [4, 4, 4]]


def test_pad_refuses_nothing_and_unequal_widths():
    with pytest.raises(TrajectoryError, match="at least one"):
        pad([])
    with pytest.raises(TrajectoryError, match=r"different widths .*\[1, 2\]"):
        pad([np.ones((1, 1), np.float32), np.ones((1, 2), np.float32)])


def test_a_trajectory_prints_its_sizes():
    assert repr(Trajectory(np.zeros((301, 4)), np.zeros((300, 2)))) == "Trajectory(T=300, D=4, A=2)"
