"""Drawing anomalies: the paper's values, who is chosen, what is redrawn, what noise looks like."""

from types import SimpleNamespace

import numpy as np
import pytest
from oodd_recording.anomalies import VALUES, Draw, draw
from oodd_recording.environments import make

from oodd_eval.data.facts import ENVIRONMENTS, TABLE1

# Table 1 of Danesh & Fern (2021), written out a second time: mean, s.d., factor, slope, wind.
TABLE_1 = {
    "acrobot": (2, 2, 10, 0.005, 0.66), "cartpole": (1, 2, 3, 0.0002, 0.66),
    "lunarlander": (0, 1, 3, 0.0001, 0.5), "ant": (0, 1, 2, 0.0001, 0.33),
    "halfcheetah": (0, 0.12, 1.25, 0.00002, 0.33), "hopper": (0, 1, 1.25, 0.00002, 0.33),
    "walker2d": (0, 0.12, 1.25, 0.00002, 0.33),
}  # fmt: skip

RANGES = {
    "acrobot": {"gravity": (10, 11), "link_length_1": (0.5, 2), "link_length_2": (0.5, 2),
                "link_mass_1": (0.5, 2), "link_mass_2": (0.5, 2)},
    "cartpole": {"gravity": (9, 11), "pole_length": (0.1, 2), "pole_mass": (0.01, 1)},
    "lunarlander": {"gravity": (9, 10), "main_engine_power": (10, 15),
                    "side_engine_power": (0, 1)},
    "ant": {"gravity": (9.8, 10.5), "power": (1.5, 1.5)},
    "halfcheetah": {"gravity": (9.8, 10.5), "power": (0.6, 0.6)},
    "hopper": {"gravity": (9.8, 10.5), "power": (0.65, 0.65)},
    "walker2d": {"gravity": (9.8, 10.5), "power": (0.35, 0.35)},
}  # fmt: skip

CHOSEN = {"acrobot": 1, "cartpole": 1, "lunarlander": 1, "ant": 5, "halfcheetah": 5,
          "hopper": 3, "walker2d": 4}  # fmt: skip


@pytest.fixture(scope="module", params=ENVIRONMENTS)
def draws(request):
    """(environment, nominal attributes, {anomaly: 300 draws})."""
    environment = request.param
    simulator = make(environment)
    simulator.reset(0)
    rng = np.random.default_rng(1)
    found = {a: [draw(environment, a, simulator, rng) for _ in range(300)] for a in TABLE1}
    nominal = {name: simulator.get(name) for name in RANGES[environment]}
    simulator.close()
    return environment, nominal, found


def test_strengths_are_those_of_table_1(draws):
    environment, _, found = draws
    mean, std, factor, slope, wind = TABLE_1[environment]
    kind = "probability" if ENVIRONMENTS[environment].discrete else "strength"

    def drawn(anomaly):
        p = dict(found[anomaly][0].parameters)
        p.pop("sensors", None)
        return p

    assert drawn("iid") == {"mean": mean, "std": std}
    assert drawn("shutdown") == {}
    assert drawn("calibration") == {"factor": factor}
    assert drawn("drift") == {"slope": slope}
    assert drawn("wind-l2r") == {"direction": 1, kind: wind}
    assert drawn("wind-r2l") == {"direction": -1, kind: wind}


def test_sensors_are_a_fifth_of_all_from_the_list_each_in_its_turn(draws):
    environment, _, found = draws
    for anomaly in ("iid", "shutdown", "calibration", "drift"):
        chosen = [d.parameters["sensors"] for d in found[anomaly]]
        assert {len(set(c)) for c in chosen} == {CHOSEN[environment]}
        assert {s for c in chosen for s in c} == set(VALUES["sensors"][environment])


def test_drawn_attributes_span_their_range_and_keep_2_percent_off_nominal(draws):
    environment, nominal, found = draws
    values = {name: [] for name in RANGES[environment]}
    for d in found["gravity"] + found["components"]:
        assert d.parameters == d.attributes
        for name, value in d.attributes.items():
            values[name].append(value)
    for name, (low, high) in RANGES[environment].items():
        drawn = np.array(values[name])
        assert low <= drawn.min() <= drawn.max() <= high, name
        assert (np.abs(drawn - nominal[name]) > 0.02 * nominal[name]).all(), name
        margin = 0.02 * nominal[name]
        reach_low = nominal[name] + margin if abs(low - nominal[name]) < margin else low
        reach_high = nominal[name] - margin if abs(high - nominal[name]) < margin else high
        assert drawn.min() <= reach_low + 0.1 * (high - low), name
        assert drawn.max() >= reach_high - 0.1 * (high - low), name


def test_components_are_every_non_empty_subset(draws):
    environment, _, found = draws
    names = set(RANGES[environment]) - {"gravity"}
    subsets = {frozenset(d.attributes) for d in found["components"]}
    assert frozenset() not in subsets
    assert len(subsets) == 2 ** len(names) - 1


# Corruption


def corrupt(anomaly, row, step=0, seed=0, **parameters):
    rng = np.random.default_rng(seed)
    drawn = Draw(anomaly, parameters, rng, sensors=np.array([1, 3]))
    return drawn.observe(np.array(row, np.float32), step)


def test_corrupted_values_worked_by_hand():
    row = [1.0, -2.0, 3.0, 0.5]
    assert corrupt("shutdown", row).tolist() == [1, 0, 3, 0]
    assert corrupt("calibration", row, factor=3.0).tolist() == [1, -6, 3, 1.5]
    assert corrupt("drift", row, step=40, slope=0.005).tolist() == pytest.approx(
        [1, -1.8, 3, 0.7], rel=1e-7
    )


def test_corruption_rounds_once_to_float32_and_leaves_its_input():
    row = np.array([0.0, 0.1, 0.0, 1e8], np.float32)
    kept = row.copy()
    found = Draw("drift", {"slope": 1e-4}, None, sensors=np.array([1, 3])).observe(row, 7)
    assert found.dtype == np.float32
    assert found[1] == np.float32(float(np.float32(0.1)) + 7e-4)
    assert (row == kept).all()


def test_noise_is_fresh_every_step_and_sensor_with_the_stated_moments():
    rng = np.random.default_rng(0)
    drawn = Draw("iid", {"mean": 2.0, "std": 3.0}, rng, sensors=np.array([0, 2]))
    rows = np.array([drawn.observe(np.zeros(3, np.float32), t) for t in range(4000)])
    assert (rows[:, 1] == 0).all()
    noise = rows[:, [0, 2]]
    np.testing.assert_allclose(noise.mean(axis=0), 2.0, atol=5 * 3 / 4000**0.5)
    np.testing.assert_allclose(noise.std(axis=0), 3.0, rtol=5 / 8000**0.5)
    assert abs(np.corrcoef(noise.T)[0, 1]) < 5 / 4000**0.5
    assert abs(np.corrcoef(noise[1:, 0], noise[:-1, 0])[0, 1]) < 5 / 4000**0.5


# Action on the simulator


def test_gusts_come_with_the_stated_probability_and_are_drawn_every_step():
    simulator, rng = SimpleNamespace(wind=0), np.random.default_rng(0)
    drawn = Draw("wind-r2l", {"direction": -1, "probability": 0.66}, rng)
    winds = []
    for _ in range(4000):
        assert drawn.command(2, simulator) == 2
        winds.append(simulator.wind)
    assert set(winds) == {0, -1}
    assert -np.mean(winds) == pytest.approx(0.66, abs=5 * (0.66 * 0.34 / 4000) ** 0.5)
    assert abs(np.corrcoef(winds[1:], winds[:-1])[0, 1]) < 5 / 4000**0.5
