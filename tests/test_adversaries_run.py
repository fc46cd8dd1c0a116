"""What becomes of adversaries in a run: invalid, or no better than chance by every measure."""

from pathlib import Path
from unittest.mock import patch

import adversaries
import numpy as np
import pytest
from helpers_plugins import install_adversaries

from oodd_eval import evaluate, load_split
from oodd_eval.metrics.auc import auc
from oodd_eval.plugins.discovery import discover
from oodd_eval.scoring import unit
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import make_plan
from oodd_eval.scoring.runner import run

pytestmark = pytest.mark.slow

ENVIRONMENT = "hopper"
INVALID = {
    "sly-neighbour", "sly-look-ahead", "sly-look-ahead-far", "sly-look-ahead-farther",
    "sly-last-bit", "sly-stepped", "sly-standardized",
}  # fmt: skip
INCOMPATIBLE = {"sly-server"}


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    """The records of all adversaries by name; the company counts, and nothing else."""
    code = Path(adversaries.__file__).read_text().replace("BONUS = 1e-6", "BONUS = 0.0")
    with pytest.MonkeyPatch.context() as patched:
        install_adversaries(patched, tmp_path_factory.mktemp("adversaries"), code)
        split = load_split("mini")
        plan = make_plan(
            discover(), split=split,
            detectors=list(adversaries.ADVERSARIES), environments=[ENVIRONMENT],
        )  # fmt: skip
        found = run(plan, split, discover(), RunSettings(), None).records
    return {name: [r for r in found if r.detector == name] for name in adversaries.ADVERSARIES}


@pytest.mark.parametrize("name", sorted(INVALID))
def test_what_uses_the_future_or_other_episodes_is_invalid(records, name):
    assert {r.status for r in records[name]} == {"invalid"}
    assert "is not causal" in records[name][0].reason


@pytest.mark.parametrize("name", sorted(adversaries.ADVERSARIES.keys() - INVALID - INCOMPATIBLE))
def test_what_knows_no_dynamics_separates_nothing(records, name):
    for record in records[name]:
        assert record.ok, record.reason
        matched = record.metrics["auc_matched"]
        assert matched.value == 0.5 or matched.low <= 0.5 <= matched.high, (name, record.anomaly)


def test_a_process_that_all_groups_could_ask_is_refused(records):
    assert {r.status for r in records["sly-server"]} == {"incompatible"}
    assert "which groups would share" in records["sly-server"][0].reason


@pytest.mark.parametrize("name", ["sly-comb", "sly-timer", "sly-clock", "sly-survival"])
def test_blind_alarms_find_no_more_than_they_do_in_nominal_episodes(records, name):
    for record in records[name]:
        found, null = (record.value(f"found_within_100{x}_at_5pct") for x in ("", "_null"))
        assert found == null or np.isnan([found, null]).all()


def mean_auc(detector, **settings):
    records = evaluate(detector, environments=ENVIRONMENT, **settings)
    return float(np.mean([record.value("auc_matched") for record in records]))


def test_the_tree_would_win_if_partners_met(monkeypatch):
    """The same detector with one memory for all groups, in one of the orders that are drawn."""
    monkeypatch.setattr(unit.secrets, "randbits", lambda _: 2)

    class Shared(adversaries.Tree):
        def __deepcopy__(self, memo):
            return self

    with patch.object(unit.contract, "probes", lambda *_: []):
        assert mean_auc(adversaries.Tree) == 0.5
        assert mean_auc(Shared) > 0.7


def test_the_company_would_win_in_one_batch():
    split = load_split("mini")
    data = split.environment(ENVIRONMENT)
    with patch.object(adversaries, "BONUS", 0.0):
        detector = adversaries.Company(seed=0, horizon=1)
        detector.fit([x.without_actions() for x in data.train])
        parts = [data.twins, *map(data.anomalous, data.anomalies)]
        together = detector.score_many([x.without_actions() for part in parts for x in part])
    n = len(data.twins)
    twins, areas = together[:n], []
    for k, anomaly in enumerate(data.anomalies, start=1):
        for i, effect in enumerate(data.anomalous(anomaly).effects):
            a, b = together[k * n + i], twins[i]
            areas.append(auc(a[effect : len(b)], b[effect : len(a)]))
    assert np.nanmean(areas) > 0.7


def test_company_with_its_bonus_has_what_the_bonus_alone_has():
    """The bonus is honest: how far rows are out of the range of training."""

    class Alone(adversaries.Company):
        def score_many(self, trajectories):
            found = []
            for x in trajectories:
                self.members_, self.given_ = {}, {}
                found += super().score_many([x])
            return found

    assert mean_auc(adversaries.Company) == mean_auc(Alone)


TOUCHES_OTHERWISE = {"shutdown", "wind-l2r", "components"}
"""Of HalfCheetah: a robot that moves otherwise touches the ground with other parts.

No contact is corrupted. But contacts that are constant in training take a new value because of the
dynamics, so that unseen values of discrete sensors tell something there: see docs/differences.md.
"""


def test_no_discrete_sensor_is_corrupted_where_many_are_constant():
    for record in evaluate(adversaries.Novelty, environments="halfcheetah"):
        matched = record.metrics["auc_matched"]
        if record.anomaly not in TOUCHES_OTHERWISE:
            assert matched.value == 0.5 or matched.low <= 0.5 <= matched.high, record.anomaly


def test_a_perfect_detector_has_perfect_figures():
    """Scores 0 on nominal rows and 1 from the effect on: also where calibration is constant."""
    data = load_split("mini").environment(ENVIRONMENT)
    nominal = {
        x.observations.tobytes()
        for part in (data.train, data.calibration, data.twins)
        for x in part
    }
    twins = [x.observations for x in data.twins]

    class Ideal:
        def __init__(self, *, seed, horizon):
            pass

        def fit(self, nominal):
            pass

        def score(self, x):
            beginnings = [
                next((t for t, (r, s) in enumerate(zip(x.observations, twin, strict=False))
                      if (r != s).any()), min(len(x), len(twin)))
                for twin in twins
            ]  # fmt: skip
            scores = np.zeros(len(x))
            prefix = x.observations[: max(beginnings)]
            known = any(np.array_equal(prefix, twin[: len(prefix)]) for twin in twins)
            if max(beginnings) > 5 and known and x.observations.tobytes() not in nominal:
                scores[max(beginnings) :] = 1.0
            return scores

    records = evaluate(Ideal, environments=ENVIRONMENT)
    for record in records:
        assert record.value("auc_matched") == 1.0
        assert record.value("missed") == record.value("delay_censored") == 0.0
        assert record.value("missed_at_5pct") == record.value("delay_at_5pct") == 0.0
        assert record.value("found_within_20_at_5pct") == 1.0
        assert record.value("false_episodes_at_5pct") == record.value("early_at_5pct") == 0.0
