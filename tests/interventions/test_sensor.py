"""The virtual sensor: a Kalman filter whose named sensors are noisier by the sizes of faults."""

import math

import numpy as np
import pytest
from oodd_common.naming import ReadingModel
from oodd_interventions.sensor import EARLIER, TRUSTED, VirtualSensor
from oodd_interventions.situation import Situation

from oodd_eval import Naming
from oodd_eval.plugins.forecasting import FeatureScale


def model_of(coefficients, covariance, actions=0, mean=0.0, std=1.0):
    d = len(covariance)
    scales = [FeatureScale(np.full(n, mean), np.full(n, std)) for n in (d, actions)]
    return ReadingModel(*scales, np.asarray(coefficients, float), np.asarray(covariance, float))


def situation_of(model, rows, actions, named, sizes, onset=0):
    sensors = np.zeros(rows.shape[1])
    sensors[named] = 1.0
    naming = Naming(sensors, np.zeros(actions.shape[1]), np.asarray(sizes, float))
    return Situation("cartpole", None, rows, actions, naming, onset, model)


def textbook(model, rows, actions, noise, start):
    """Filter with the whole state of two rows, standardized; return its newest row at the end."""
    d, width = rows.shape[1], actions.shape[1]
    standard = (rows - model.sensors.mean) / model.sensors.std
    commands = (actions - model.actions.mean) / model.actions.std
    b = model.coefficients.T
    forward = np.block([[b[:, :d], b[:, d : 2 * d]], [np.eye(d), np.zeros((d, d))]])
    driven = np.zeros((2 * d, 2 * d))
    driven[:d, :d] = model.covariance
    state, spread = (
        np.concatenate([standard[start - 1], standard[start - 2]]),
        np.zeros_like(driven),
    )
    read = np.flatnonzero(np.isfinite(noise))
    for t in range(start, len(rows)):
        pushed = b[:, 2 * d :] @ np.concatenate([commands[t - 1], commands[t - 2], [1.0]])
        state = forward @ state
        state[:d] += pushed
        spread = forward @ spread @ forward.T + driven
        innovation = spread[np.ix_(read, read)] + np.diag(noise[read])
        gain = spread[:, read] @ np.linalg.inv(innovation)
        state = state + gain @ (standard[t] - state[:d])[read]
        spread = spread - gain @ spread[read]
    assert width == len(model.actions.mean)
    return model.sensors.mean + model.sensors.std * state[:d]


def test_one_sensor_by_hand():
    # x_t = .5 x_{t-1}, errors of variance 1, a fault of size 2: variance 4.
    rows = np.array([[2.0], [3.0], [1.0]], np.float32)
    model = model_of([[0.5], [0.0], [0.0]], [[1.0]])
    sensor = VirtualSensor(situation_of(model, rows[:2], np.empty((1, 0), np.float32), [0], [2.0]))
    # Row 0 is taken for right. Row 1: forecast 1, variance 1, gain 1/5.
    assert sensor.row(rows[1])[0] == pytest.approx(1 + (3 - 1) / 5)
    # Row 2: forecast .7, variance .25 x .8 + 1, gain 1.2/5.2.
    sensor._situation.rows, sensor._situation.actions = rows, np.empty((2, 0), np.float32)
    assert sensor.row(rows[2])[0] == pytest.approx(0.7 + 1.2 / 5.2 * (1 - 0.7))


@pytest.mark.parametrize("sizes", [[0.7, math.nan], [math.inf, 0.2], [1e-9, 3.0]])
def test_it_is_the_filter_of_textbooks(sizes):
    rng = np.random.default_rng(3)
    d, a, n = 4, 2, 40
    coefficients = rng.normal(size=(2 * (d + a) + 1, d)) * 0.2
    root = rng.normal(size=(d, d))
    model = model_of(coefficients, root @ root.T / d + 0.05 * np.eye(d), a, mean=0.3, std=2.0)
    rows = rng.normal(size=(n, d)).astype(np.float32)
    actions = rng.normal(size=(n - 1, a)).astype(np.float32)
    named, onset = [1, 3], 15
    filled = np.full(d, math.nan)
    filled[named] = sizes
    estimate = VirtualSensor(situation_of(model, rows, actions, named, filled, onset)).row(rows[-1])
    noise = np.full(d, TRUSTED)
    variances = np.maximum((np.array(sizes) / 2) ** 2, TRUSTED)
    noise[named] = np.where(np.isfinite(variances), variances, np.inf)
    expected = textbook(model, rows, actions, noise, onset - EARLIER)
    np.testing.assert_allclose(estimate[named], expected[named], atol=2e-4)
    np.testing.assert_array_equal(estimate[[0, 2]], rows[-1, [0, 2]])


def test_another_naming_is_as_if_it_had_been_the_first():
    rng = np.random.default_rng(4)
    model = model_of(rng.normal(size=(7, 3)) * 0.2, np.eye(3))
    rows, actions = rng.normal(size=(30, 3)).astype(np.float32), np.empty((29, 0), np.float32)
    first = situation_of(model, rows[:25], actions[:24], [0], [1.0] * 3, onset=20)
    second = situation_of(model, rows, actions, [1, 2], [0.5] * 3, onset=12)
    sensor = VirtualSensor(first)
    sensor.row(rows[24])
    first.rows, first.actions = rows, actions
    first.naming, first.onset = second.naming, second.onset
    np.testing.assert_array_equal(sensor.row(rows[-1]), VirtualSensor(second).row(rows[-1]))


def test_nothing_named_changes_nothing():
    rows, actions = np.ones((5, 2), np.float32), np.empty((4, 0), np.float32)
    model = model_of(np.full((5, 2), 0.3), np.eye(2))
    sensor = VirtualSensor(situation_of(model, rows, actions, [], [math.nan] * 2))
    np.testing.assert_array_equal(sensor.row(rows[-1]), rows[-1])


def test_forecasts_that_explode_stay_numbers():
    d, n = 28, 600
    model = model_of(np.vstack([3 * np.eye(d), np.eye(d), np.ones((1, d))]), np.eye(d))
    rows = np.random.default_rng(5).normal(size=(n, d)).astype(np.float32)
    sizes = np.array([math.inf, 1e30, 0.0, *[math.nan] * (d - 3)])
    situation = situation_of(model, rows, np.empty((n - 1, 0), np.float32), [0, 1, 2, 3], sizes)
    estimate = VirtualSensor(situation).row(rows[-1])
    assert np.isfinite(estimate).all()
    assert np.abs(estimate).max() <= 10
