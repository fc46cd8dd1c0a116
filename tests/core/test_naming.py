"""Namings: the parts that a detector says are at fault, their checks, and those of shares alone."""

import numpy as np
import pytest

from oodd_eval import Explanation, Naming, Trajectory
from oodd_eval.errors import ContractError
from oodd_eval.plugins.explanations import checked_explanation, naming_of

NAN = float("nan")
EPISODE = Trajectory(np.zeros((3, 2)), np.zeros((2, 3)))
SHARES, ONSETS = np.full((3, 2), 0.5), np.arange(3)
GOOD = Naming(np.array([0.5, 0.0]), np.array([0.0, 1.0, 0.2]), np.array([NAN, np.inf]), "actuator")


@pytest.mark.parametrize("naming", [GOOD, tuple(GOOD), GOOD._replace(actuators=np.zeros(0))])
def test_explanations_of_two_and_of_three_values_are_taken(naming):
    for returned in ((SHARES, ONSETS), (SHARES, ONSETS, None), Explanation(SHARES, ONSETS)):
        assert checked_explanation(returned, EPISODE).naming is None
    taken = checked_explanation((SHARES, ONSETS, naming), EPISODE).naming
    assert isinstance(taken, Naming)
    assert taken.sensors is naming[0]
    assert taken.kind == "actuator"


@pytest.mark.parametrize(
    ("naming", "message"),
    [
        (3, "names parts as int, expected a Naming"),
        (GOOD[:2], "names parts as tuple, expected a Naming"),
        (GOOD._replace(sensors=np.zeros(3)), r"sensors as float64 of shape \(3,\), expected .*2"),
        (GOOD._replace(sensors=[0.5, 0]), r"sensors as list, expected float64 of shape \(2,\)"),
        (GOOD._replace(sensors=np.zeros(2, int)), "sensors as int64 of shape"),
        (GOOD._replace(actuators=np.zeros(2)), r"actuators as .*\(2,\), expected .*\(3,\)"),
        (GOOD._replace(sizes=np.zeros(0)), r"sizes as .*\(0,\), expected .*\(2,\)"),
        (GOOD._replace(sensors=np.array([0, 1.5])), r"sensors with 1.5 at 1, expected 0 to 1"),
        (GOOD._replace(sensors=np.array([NAN, 0])), "sensors with nan at 0"),
        (GOOD._replace(actuators=np.array([0, 0, -0.1])), r"actuators with -0.1 at 2"),
        (GOOD._replace(sizes=np.array([NAN, -1.0])), r"sizes with -1.0 at 1, expected 0 or more"),
        (GOOD._replace(kind="motor"), r"kind 'motor', expected one of '', 'sensor'"),
        (GOOD._replace(kind=None), "kind None"),
    ],
)
def test_what_is_no_naming_is_refused(naming, message):
    with pytest.raises(ContractError, match=message):
        checked_explanation((SHARES, ONSETS, naming), EPISODE)


@pytest.mark.parametrize("returned", [None, 3, (SHARES,), (SHARES, ONSETS, GOOD, 0)])
def test_another_number_of_values_is_refused(returned):
    with pytest.raises(ContractError, match="expected shares, onsets and perhaps a Naming"):
        checked_explanation(returned, EPISODE)


@pytest.mark.parametrize(
    ("shares", "named"),
    [
        ([0.1, 0.6, 0.3], [1]),
        ([0.5, 0.25, 0.25], [0]),
        ([0.2, 0.35, 0.45], [1, 2]),
        ([0.25, 0.25, 0.25, 0.25], [0, 1]),
        ([1.0, 0.0], [0]),
        ([NAN, NAN], []),
    ],
)
def test_shares_name_the_fewest_sensors_that_carry_half(shares, named):
    rows = np.array([[1.0, *[0.0] * (len(shares) - 1)], shares])  # only the last row counts
    naming = naming_of(Explanation(rows, np.array([0, 1])), actions=2)
    assert np.flatnonzero(naming.sensors >= 0.5).tolist() == named
    assert naming.actuators.tolist() == [0, 0]
    assert np.isnan(naming.sizes).all()
    assert naming.sizes.shape == naming.sensors.shape
    assert naming.kind == ""


def test_a_naming_is_its_own_and_knows_all_actuators():
    assert naming_of(Explanation(SHARES, ONSETS, GOOD), actions=3) is GOOD
    blind = naming_of(Explanation(SHARES, ONSETS, GOOD._replace(actuators=np.zeros(0))), actions=3)
    assert blind.actuators.tolist() == [0, 0, 0]
    assert blind.sensors is GOOD.sensors
