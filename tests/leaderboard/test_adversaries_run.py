"""What becomes of adversaries in a plain run, which trusts them: what free checks find."""

from collections import Counter

import adversaries
import numpy as np
import pytest
from helpers_plugins import install_adversaries

from oodd_eval import evaluate, load_split
from oodd_eval.metrics.auc import auc
from oodd_eval.plugins.discovery import discover
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import make_plan
from oodd_eval.scoring.runner import run
from oodd_eval.scoring.unit import mixed

pytestmark = pytest.mark.slow

ENVIRONMENT = "hopper"
FUTURE = [f"sly-{name}" for name in adversaries.KINDS["future"] if name != "look-ahead-prefix"]
BLIND = [f"sly-{name}" for name in adversaries.KINDS["blind"]]
OWN_MEMORY = [
    "sly-company", "sly-company-batch", "sly-company-module", "sly-company-environment",
    "sly-child", "sly-thread",
]  # fmt: skip


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    """The records of adversaries by name."""
    names = [adversaries.BASE, *FUTURE, *BLIND, *OWN_MEMORY]
    with pytest.MonkeyPatch.context() as patched:
        install_adversaries(patched, tmp_path_factory.mktemp("adversaries"))
        split = load_split("mini")
        plan = make_plan(discover(), split=split, detectors=names, environments=[ENVIRONMENT])
        made = run(plan, split, discover(), RunSettings(), None).records
    return {name: [r for r in made if r.detector == name] for name in names}


@pytest.mark.parametrize("name", FUTURE)
def test_what_uses_the_future_is_invalid(records, name):
    assert {r.status for r in records[name]} == {"invalid"}, records[name][0].reason


@pytest.mark.parametrize("name", BLIND)
def test_what_knows_no_dynamics_separates_nothing(records, name):
    for record in records[name]:
        assert record.ok, record.reason
        matched = record.metrics["auc_matched"]
        assert matched.value == 0.5 or matched.low <= 0.5 <= matched.high, (name, record.anomaly)


@pytest.mark.parametrize("name", OWN_MEMORY)
def test_what_remembers_in_its_own_process_has_what_the_honest_one_has(records, name):
    for mine, honest in zip(records[name], records[adversaries.BASE], strict=True):
        assert repr(mine.metrics["auc_matched"]) == repr(honest.metrics["auc_matched"]), mine.reason


@pytest.mark.parametrize("name", ["sly-comb", "sly-clock"])
def test_blind_alarms_find_no_more_than_they_do_in_nominal_episodes(records, name):
    for record in records[name]:
        alarms, null = (record.value(f"found_within_100{x}_at_5pct") for x in ("", "_null"))
        assert alarms == null or np.isnan([alarms, null]).all()


def test_the_company_would_win_in_one_batch():
    data = load_split("mini").environment(ENVIRONMENT)
    detector = adversaries.CompanyInBatch(seed=0, horizon=1)
    detector.fit([x.without_actions() for x in data.train])
    parts = [data.twins, *map(data.anomalous, data.anomalies)]
    together = detector.score_many([x.without_actions() for part in parts for x in part])
    n = len(data.twins)
    twins, areas = together[:n], []
    for k, anomaly in enumerate(data.anomalies, start=1):
        for i, effect in enumerate(data.anomalous(anomaly).effects):
            a, b = together[k * n + i], twins[i]
            areas.append(auc(a[effect : len(b)], b[effect : len(a)]))
    assert np.nanmean(areas) > 0.95


def test_the_number_of_a_mixed_group_says_nothing_of_its_episodes():
    sizes = {"calibration": 40, **{f"test/{k}": 20 for k in range(9)}}
    first = Counter(part for _ in range(200) for part, _ in mixed(sizes)[0])
    share = first.total() / sum(sizes.values())
    for part, n in sizes.items():
        assert abs(first[part] - share * n) < 6 * np.sqrt(share * n), part


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
