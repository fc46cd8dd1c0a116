"""Baseline rows: the harness brings episodes to training's, or a detector does it itself."""

import dataclasses

import numpy as np
import pytest
from helpers_logs import UNPAIRED, log_episode, make_log_split, write_log_split
from helpers_plugins import install

from oodd_eval import DetectorSpec, Trajectory, load_split
from oodd_eval.data.baseline import Baseline
from oodd_eval.data.parts import CALIBRATION, TWINS
from oodd_eval.errors import TrajectoryError
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.scoring.plan import make_plan
from oodd_eval.scoring.unit import UnitJob

B = 20
FACTS = dataclasses.replace(UNPAIRED, baseline=B)


class Remembers:
    """Keeps what it was handed, and scores rows by their size."""

    def __init__(self, *, seed=0, horizon=1, baseline=0):
        self.baseline = baseline

    def fit(self, nominal):
        type(self).fitted = [x.observations.copy() for x in nominal]

    def score(self, x):
        type(self).shown = x.observations.copy()
        return np.abs(x.observations).sum(axis=1).astype(np.float64)


def scored(split, factory, detector="mine", **changes):
    """Scores by part of one unit in this process, or of an installed detector."""
    plugins = discover()
    if factory is not None:
        from oodd_eval.plugins.discovery import Offer

        plugins = discover(only=())
        plugins.add(Offer(DetectorSpec(detector, factory, "", **changes), "", "", "local", ""))
    plan = make_plan(plugins, split=split, detectors=[detector], environments=["arm"])
    with split.opened() as opened:
        job = UnitJob(plan, plan.units[0], opened("arm"), plugins.offer(detector))
        outcome = job(Limits(60, None), lambda: False, None, fresh=True)
    assert outcome.status == "ok", outcome.reason
    return outcome.file


def test_an_episode_is_brought_to_trainings_by_hand():
    train = [Trajectory([[1.0], [3.0], [9.0]]), Trajectory([[5.0], [5.0], [9.0]])]
    base = Baseline.fit(train, 2)
    # Means 2 and 5, variances 1 and 0.
    assert (base.mean.item(), base.std.item()) == (3.5, pytest.approx(np.sqrt(0.5)))
    judged = base.judged(Trajectory([[10.0], [14.0], [12.0], [15.0]]))
    factor = np.sqrt(0.5) / np.sqrt((4 + 0.5) / 2)
    expected = np.array([[0.0], [3.0]]) * factor + 3.5
    np.testing.assert_allclose(judged.observations, expected, rtol=1e-6)
    # A sensor that stands still is moved but not stretched.
    base = Baseline.fit([Trajectory([[2.0], [2.0], [2.0]])], 2)
    judged = base.judged(Trajectory([[7.0], [7.0], [7.0], [8.0]]))
    assert judged.observations.ravel().tolist() == [2.0, 3.0]
    # Machines that differ by a shift look alike.
    train = [Trajectory(log_episode(i).observations) for i in range(5)]
    base, moved = Baseline.fit(train, B), Trajectory(train[0].observations + np.float32(40.0))
    both = [base.judged(x).observations for x in (train[0], moved)]
    np.testing.assert_allclose(*both, atol=1e-4)


@pytest.mark.parametrize("rows", [B, B - 5])
def test_an_episode_without_a_further_row_is_refused(rows):
    train = [Trajectory(log_episode(i).observations) for i in range(3)]
    short = Trajectory(log_episode(9, rows).observations)
    with pytest.raises(TrajectoryError, match=f"training episode 3 has {rows} rows, expected more"):
        Baseline.fit([*train, short], B)
    with pytest.raises(TrajectoryError, match="calibration episode 2"):
        Baseline.fit(train, B).judged(short, "calibration episode 2")


def test_a_run_hands_over_the_rows_behind_and_leaves_the_first_undefined(tmp_path):
    split = load_split(make_log_split(tmp_path / "arm", FACTS, calibration=20))
    file = scored(split, Remembers)
    with split.opened() as opened:
        data = opened("arm")
        base = Baseline.fit(data.train, B)
        for x, handed in zip(data.train, Remembers.fitted, strict=True):
            assert np.array_equal(base.judged(x).observations, handed)
        for part in (CALIBRATION, TWINS, "test/slip"):
            sets = {CALIBRATION: data.calibration, TWINS: data.twins}
            episodes = sets.get(part) or data.labelled("slip")
            for x, scores in zip(episodes, file.parts[part], strict=True):
                assert len(scores) == len(x)
                assert np.isnan(scores[:B]).all()
                assert np.array_equal(scores[B:], Remembers().score(base.judged(x)))


def test_a_detector_that_adapts_is_handed_whole_episodes_and_their_number(tmp_path):
    split = load_split(make_log_split(tmp_path / "arm", FACTS, calibration=20))

    class Adapts(Remembers):
        def score(self, x):
            return super().score(x) + 1000 * self.baseline

    file = scored(split, Adapts, adapts="baseline")
    with split.opened() as opened:
        data = opened("arm")
        for x, handed in zip(data.train, Adapts.fitted, strict=True):
            assert np.array_equal(x.observations, handed)
        for x, scores in zip(data.twins, file.parts[TWINS], strict=True):
            assert np.isnan(scores[:B]).all()
            size = np.abs(x.observations).sum(axis=1).astype(np.float64)
            assert np.array_equal(scores[B:], size[B:] + 1000 * B)


@pytest.mark.slow
def test_a_worker_scores_as_this_process_does(tmp_path, monkeypatch):
    code = """
import numpy as np
from oodd_eval import DetectorSpec, hookimpl

class Size:
    def __init__(self, *, seed, horizon, baseline=0): self.baseline = baseline
    def fit(self, nominal): pass
    def score(self, x):
        return abs(x.observations).sum(axis=1).astype(float) + 1000 * self.baseline

@hookimpl
def oodd_detectors():
    return [DetectorSpec("size", Size, ""), DetectorSpec("adapting", Size, "", adapts="baseline")]
"""
    install(monkeypatch, tmp_path, "sizes", code, header="")
    split = load_split(make_log_split(tmp_path / "arm", FACTS, calibration=20))
    plain, adapting = (scored(split, None, name) for name in ("size", "adapting"))
    with split.opened() as opened:
        data = opened("arm")
        base = Baseline.fit(data.train, B)
        for x, a, b in zip(data.twins, plain.parts[TWINS], adapting.parts[TWINS], strict=True):
            size = lambda o: np.abs(o).sum(axis=1).astype(float)  # noqa: E731
            assert np.array_equal(a[B:], size(base.judged(x).observations))
            assert np.array_equal(b[B:], size(x.observations[B:]) + 1000 * B)
            assert np.isnan([*a[:B], *b[:B]]).all()


def test_a_run_names_an_episode_that_is_too_short(tmp_path):
    parts = {
        "train": [log_episode(i) for i in range(3)],
        "calibration": [log_episode(10), log_episode(11, B)],
        "test/slip": [log_episode(12, intervals=[(30, 40)])],
    }
    split = load_split(write_log_split(tmp_path / "arm", parts, FACTS))
    with pytest.raises(TrajectoryError, match=rf"arm/calibration\[1\] has {B} rows, expected more"):
        scored(split, Remembers)


def test_fits_with_and_without_baseline_rows_are_different_ones(tmp_path):
    plugins, keys = discover(), set()
    for name, facts in (("with", FACTS), ("without", UNPAIRED)):
        split = load_split(make_log_split(tmp_path / name, facts))
        plan = make_plan(plugins, split=split, detectors=["mewma"], environments=["arm"])
        keys.add(plan.units[0].fit_key)
    assert len(keys) == 2
