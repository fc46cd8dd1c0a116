"""Drawing anomalies: the paper's values, who is chosen, what is redrawn, what noise looks like."""

import numpy as np
import pytest
from oodd_recording.anomalies import VALUES, draw
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
        for name, value in d.parameters.items():
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
    subsets = {frozenset(d.parameters) for d in found["components"]}
    assert frozenset() not in subsets
    assert len(subsets) == 2 ** len(names) - 1
