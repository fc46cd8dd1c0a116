"""An anomaly that changes nothing is found as little as its twin, by every offered detector."""

import numpy as np
import pytest
from helpers_detectors import SMALL
from helpers_split import make_group, make_split

from oodd_eval import evaluate
from oodd_eval.data.facts import ENVIRONMENTS, SplitDefinition
from oodd_eval.data.layout import write_environment, write_manifest
from oodd_eval.data.parts import TWINS
from oodd_eval.plugins.discovery import discover

ENVIRONMENT = "hopper"
PLUGINS = discover()


@pytest.fixture(scope="module")
def placebo(tmp_path_factory):
    """A split whose anomalous episodes are their twins; both are noisy enough to raise alarms."""
    first = 9 * 10**6
    sizes = {"train": 6, "calibration": 40, TWINS: 6}
    starts = {"train": first, "calibration": first + 300_000, TWINS: first + 600_000}
    groups = {
        part: make_group(ENVIRONMENT, range(starts[part], starts[part] + n), 60,
                         "gravity" if part == TWINS else None)
        for part, n in sizes.items()
    }  # fmt: skip
    groups["test/gravity"] = groups[TWINS]
    known = ("onsets", "effects", "redraws", "parameters")
    groups[TWINS] = {name: a for name, a in groups[TWINS].items() if name not in known}
    directory = tmp_path_factory.mktemp("splits") / "placebo"
    directory.mkdir()
    info = ENVIRONMENTS[ENVIRONMENT]
    entry = write_environment(directory / f"{ENVIRONMENT}.h5", groups.items(), "0" * 64,
                              sensors=info.sensors, actions=info.actions)  # fmt: skip
    definition = SplitDefinition("placebo", 6, 40, 6, 62, 9)
    write_manifest(directory, definition, {ENVIRONMENT: entry}, generator=1, versions={})
    return directory


def must_be_like_its_twins(record):
    """Every metric of a cell is what its nominal twins give, episode by episode."""
    assert record.ok
    for metric in ("auc_matched", "auc_smoothed"):
        values, counted = record.per_trajectory[metric]
        assert counted.any()
        assert (values == 0.5 * counted).all()
    nulls = [n for n in record.per_trajectory if n.endswith(("_null_at_5pct", "_null_at_10pct"))]
    assert {"found_within_100_null_at_5pct", "missed_null_at_5pct"} <= {*nulls}
    for null in nulls:
        plain = record.per_trajectory[null.replace("_null", "")]
        assert np.array_equal(plain, record.per_trajectory[null])
    assert record.value("auc_unpaired") == record.value("auc_placebo")


QUICK = {"random", "comb", "persistence", "range", "mewma", "mewma-a", "knn", "rf-ewma", "npn"}
"""Rows of every statistic that an alarm is raised on."""

# Oracles know some environments alone, and no episode of a recorded split has failed; how a row is
# judged depends on no detector.
NAMES = [
    pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
    for name, offer in PLUGINS.offers.items()
    if not name.startswith("oracle") and offer.spec.training != "failures"
]


@pytest.mark.parametrize("name", NAMES)
def test_what_equals_its_twin_is_found_exactly_as_often(name, placebo):
    settings = {"anomalies": "gravity", "parameters": SMALL.get(name)}
    (record,) = evaluate(PLUGINS.offer(name).spec, placebo, **settings)
    must_be_like_its_twins(record)
    if name == "persistence":  # some of these twins raise alarms
        assert record.value("found_within_100_null_at_5pct") > 0


def test_what_differs_from_its_twin_is_not_taken_for_it(tmp_path):
    split = make_split(tmp_path / "plain", [ENVIRONMENT], calibration=40)
    (record,) = evaluate("persistence", split, anomalies="gravity")
    with pytest.raises(AssertionError):
        must_be_like_its_twins(record)
