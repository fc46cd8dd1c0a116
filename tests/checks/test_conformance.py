"""Every detector that an installed plug-in offers honours the contract."""

import pytest
from helpers_detectors import SMALL
from oodd_checks.testing import run_checks

from oodd_eval.plugins.discovery import discover

pytestmark = pytest.mark.slow

PLUGINS = discover()

ADAPTERS = [
    "sklearn:IsolationForest",
    "sklearn:OneClassSVM",
    "pyod:KNN",
    "river:HalfSpaceTrees",
    "river:GaussianScorer",
    "forecast:sklearn.linear_model.Ridge",
]
"""Some of those that are made of any class of a library."""

EXPECTED_FAILURES = {
    name: {"gross-anomaly": "a row for comparison: it knows nothing of the sensors"}
    for name in ("random", "clock", "comb")
}


# The oracle refuses any plant but its three, which the checks lack; test_oracles has its own.
LEARNING = [name for name, offer in PLUGINS.offers.items() if offer.spec.training != "oracle"]


@pytest.mark.parametrize(
    ("name", "horizon"),
    [(name, 1) for name in (*LEARNING, *ADAPTERS)]
    + [(name, 4) for name in (*LEARNING, "forecast:sklearn.linear_model.Ridge")],
)
def test_every_offered_detector_conforms(name, horizon):
    must_conform(name, horizon, SMALL.get(name))


@pytest.mark.parametrize("name", ["riqn", "npn"])
def test_a_network_per_sensor_conforms(name):
    must_conform(name, 1, {**SMALL[name], "trunk": "per-feature"})


def must_conform(name, horizon, parameters):
    report = run_checks(
        PLUGINS.offer(name).spec,
        horizon=horizon,
        parameters=parameters,
        expected_failures=EXPECTED_FAILURES.get(name),
    )
    assert report.ok, report
    assert sum(result.status == "passed" for result in report.results) >= 18


def test_no_plugin_is_left_out():
    assert not PLUGINS.broken
    assert {*SMALL, "random", "mewma"} - {*ADAPTERS} <= {*PLUGINS.offers}
