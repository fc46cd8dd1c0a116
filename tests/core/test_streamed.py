"""Runs that hand over one row at a time: the same scores, and nothing of what comes later."""

from dataclasses import replace
from itertools import chain

import numpy as np
import pytest
from helpers_plugins import install

from oodd_eval import load_split
from oodd_eval.data.parts import lengths_of, parts_of
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import UsageError
from oodd_eval.plugins.contract import TOLERANCE
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.isolation import SCORES, supervisor
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.evaluate import difference
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import make_plan
from oodd_eval.scoring.runner import run
from oodd_eval.scoring.unit import mixed

PLUGIN = """
import threading

class Whole(Good):
    \"\"\"Has no ``update``, no state, and the length of what it was handed as its score.\"\"\"
    def fit(self, nominal):
        self.scale = sum(len(x) for x in nominal)
    def score(self, x):
        assert x.action_dim in (0, 1)
        return np.full(len(x), float(len(x))) + self.scale

class Rows(Good):
    \"\"\"Tells what it was handed.\"\"\"
    def reset(self): self.n = 0
    def update(self, observation, action=None):
        self.n += 1
        assert self.n > 1 or action is None
        assert observation.dtype == np.float32 and observation.shape == (4,)
        return float(observation.sum()) + (0.0 if action is None else 100.0 * float(action.sum()))
    def score(self, x): raise RuntimeError("not asked")

class NoFloat(Rows):
    def update(self, observation, action=None): return None

class LateNan(Rows):
    def update(self, observation, action=None):
        return float("nan") if super().update(observation, action) and self.n > 5 else 1.0

class Raises(Rows):
    def update(self, observation, action=None):
        if super().update(observation, action) and self.n > 5: raise KeyError("row five")
        return 1.0

class Locked(Rows):
    \"\"\"Cannot be copied.\"\"\"
    def fit(self, nominal): self.lock = threading.Lock()

class Slow(Rows):
    \"\"\"Takes long to copy.\"\"\"
    copies = 0
    def __deepcopy__(self, memo):
        type(self).copies += 1
        sum(range(3 * 10**6))
        return Rows()
    def update(self, observation, action=None):
        assert type(self).copies < 2
        return super().update(observation, action)

@hookimpl
def oodd_detectors():
    both = [DetectorSpec(name, cls, "a test's", inputs="observations+actions")
            for name, cls in (("rows", Rows), ("locked", Locked), ("slow", Slow))]
    return [*both, *offer(whole=Whole, no_float=NoFloat, late_nan=LateNan, raises=Raises)]
"""


def run_rows(detector, split, output=None, *, streamed=True, **parameters):
    opened, plugins = load_split(split), discover()
    plan = make_plan(plugins, split=opened, detectors=[detector], environments=["cartpole"],
                     anomalies=["iid"], parameters=parameters)  # fmt: skip
    settings = RunSettings(jobs=1, limits=Limits(120), streamed=streamed)
    results = ResultsDirectory(output) if output else None
    (record,) = run(plan, opened, plugins, settings, results).records
    if not output:
        return record
    sets = parts_of(opened.environment("cartpole"), ["iid"])
    scores = results.scores(record.scores, lengths_of(sets, None)) if record.ok else None
    return record, scores and scores.parts, sets


QUICK = [(name, {}) for name in ("mewma", "persistence", "clock", "random")]
OTHERS = [
    *((name, {}) for name in ("mahalanobis", "range", "comb", "pca", "knn", "deedee", "arcade-a")),
    *((name, {}) for name in ("manifold", "panel", "oracle-gym")),
    *((name, {"trees": 3}) for name in ("rf", "rf-ewma")),
    *((name, {"updates": 3}) for name in ("pe", "pe-a", "npn", "riqn", "riqn-ms", "rnd", "paano")),
    *(
        (name, {"updates": 3})
        for name in ("rpt-a", "logpzo", "logpzo-a", "wm-kl-a", "lstm", "dagmm")
    ),
]


@pytest.mark.parametrize(
    ("detector", "parameters"),
    [*QUICK, *(pytest.param(*other, marks=pytest.mark.slow) for other in OTHERS)],
)
def test_scores_in_lockstep_are_those_of_each_episode_alone_and_of_batches(
    tiny_split, tmp_path, monkeypatch, detector, parameters
):
    batch, expected, _ = run_rows(detector, tiny_split, tmp_path, streamed=False, **parameters)
    record, parts, _ = run_rows(detector, tiny_split, tmp_path, **parameters)
    assert record.ok, record.reason
    assert record.scores == f"{batch.scores}-rows"
    monkeypatch.setattr(supervisor._UnitRun, "_stream", one_after_the_other)
    _, alone, _ = run_rows(detector, tiny_split, tmp_path / "alone", **parameters)
    for part, sequences in parts.items():
        for found, by_itself, whole in zip(sequences, alone[part], expected[part], strict=True):
            assert found.tobytes() == by_itself.tobytes()
            assert not difference(found, whole, TOLERANCE)


STREAM = supervisor._UnitRun._stream


def one_after_the_other(unit, *arguments):
    unit.streams = 1
    STREAM(unit, *arguments)


class Spy:
    """A channel that keeps what is sent, and answers every row with 0."""

    def __init__(self):
        self.sent = []
        self.send_bytes = self.sent.append

    def receive_bytes(self):
        return SCORES + bytes(8 * (len(self.sent[-1]) // 16))


def test_messages_until_an_end_say_nothing_of_it():
    x = Trajectory(np.arange(60.0).reshape(20, 3))
    spies = [Spy(), Spy()]
    for spy, n in zip(spies, (12, 17), strict=True):
        scores = supervisor._in_lockstep(spy, [x[:5], x[:n], x])
        assert [*map(len, scores)] == [5, n, 20]
    assert spies[0].sent[:12] == spies[1].sent[:12]
    assert [len(message) // 16 for message in spies[0].sent] == [3] * 5 + [2] * 7 + [1] * 8 + [0]


@pytest.fixture
def plugin(monkeypatch, tmp_path):
    install(monkeypatch, tmp_path / "plugin", "streamed", PLUGIN)


@pytest.mark.parametrize("detector", ["rows", "locked", "slow"])
def test_a_row_comes_with_the_action_before_it(plugin, tiny_split, tmp_path, detector):
    record, parts, sets = run_rows(detector, tiny_split, tmp_path / "out")
    assert record.ok, record.reason
    for part, sequences in parts.items():
        for found, x in zip(sequences, sets[part], strict=True):
            expected = x.observations.astype(float).sum(axis=1)
            expected[1:] += 100 * x.actions.sum(axis=1)
            assert np.allclose(found, expected, atol=1e-3)


def test_without_update_a_row_is_the_last_of_a_prefix(plugin, tiny_split, tmp_path):
    record, parts, sets = run_rows("whole", tiny_split, tmp_path / "out")
    assert record.ok, record.reason
    scale = sum(map(len, load_split(tiny_split).environment("cartpole").train))
    for part, sequences in parts.items():
        for found, x in zip(sequences, sets[part], strict=True):
            assert found.tolist() == [scale + n + 1.0 for n in range(len(x))]


@pytest.mark.parametrize("tests", [{"nominal": 4, "iid": 4, "drift": 4}, {"nominal": 3, "iid": 5}])
def test_a_group_has_episodes_of_all_parts_and_no_two_of_one_seed(tests):
    sizes = {"calibration": 7, **{f"test/{part}": n for part, n in tests.items()}}
    drawn = mixed(sizes)
    assert len(drawn) == len(tests)
    assert sorted(chain(*drawn)) == [(p, i) for p, n in sorted(sizes.items()) for i in range(n)]
    for group in drawn:
        seeds = [i for part, i in group if part != "calibration"]
        assert len(seeds) == len({*seeds}) > 0
        assert "calibration" in {part for part, _ in group}


def test_without_update_long_episodes_are_incompatible(plugin, tiny_split, monkeypatch):
    monkeypatch.setattr(supervisor, "MOST_PREFIXES", 20)
    record = run_rows("whole", tiny_split)
    assert record.status == "incompatible"
    assert "without update at most 20 are scored row by row" in record.reason


@pytest.mark.parametrize(
    ("detector", "status", "reason"),
    [
        ("no-float", "invalid", "update returned NoneType, expected a float"),
        ("late-nan", "invalid", "returned nan at t = 5 of cartpole/"),
        ("raises", "error", "KeyError: 'row five'"),
    ],
)
def test_a_failure_at_a_row_is_a_state_with_a_reason(plugin, tiny_split, detector, status, reason):
    record = run_rows(detector, tiny_split)
    assert (record.status, reason in record.reason) == (status, True), record.reason


def test_a_detector_of_this_process_has_no_rows_sent(tiny_split):
    opened = load_split(tiny_split)
    plan = make_plan(discover(), split=opened, detectors=["clock"], environments=["cartpole"])
    plan = replace(plan, units=tuple(replace(unit, plugin="") for unit in plan.units))
    with pytest.raises(UsageError, match="streamed to detectors of plug-ins only"):
        run(plan, opened, discover(), RunSettings(streamed=True))
