"""Recorded episodes: redraws, caps, streams of numbers, and what reaches the terminal."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers_simulate import Reflex, record
from oodd_recording import closed_loop as recording
from oodd_recording.closed_loop import Setup, TwinTooShortError
from oodd_recording.environments import make
from oodd_recording.faults import Fault

from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import SimulationError

pytestmark = pytest.mark.slow


def test_recording_prints_nothing_on_the_streams_of_its_process(capfd):
    record("hopper", "iid", 0, policy=Reflex("hopper"))
    assert capfd.readouterr() == ("", "")


def test_seeds_and_anomalies_have_streams_of_their_own():
    names = [(e, a, s, k) for e in ("ant", "hopper") for a in ("iid", "drift")
             for s in (1, 2) for k in (0, 1)]  # fmt: skip
    firsts = {recording.generator(*n).integers(2**62) for n in names}
    assert len(firsts) == len(names)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_every_part_of_128_bits_reaches_the_simulator_and_the_anomaly(environment):
    seeds = [2**127 + 5, *(2**127 + 5 + 2**bit for bit in (0, 31, 32, 63, 64, 95, 96, 126))]
    firsts = set()
    for seed in seeds:
        simulator = make(environment)
        firsts.add(simulator.reset(seed).tobytes())
        simulator.close()
    draws = {recording.generator(environment, "gravity", seed, 0).integers(2**62) for seed in seeds}
    assert len(firsts) == len(draws) == len(seeds)


def test_the_cap_ends_an_episode_without_terminating_it():
    capped = Setup("halfcheetah", Reflex("halfcheetah"), 40).record(1)
    assert (capped.trajectory.transitions, capped.terminated) == (40, False)
    longer = Setup("halfcheetah", Reflex("halfcheetah"), 60).record(1)
    assert (longer.trajectory.observations[:41] == capped.trajectory.observations).all()
    fallen = Setup("cartpole", _Right()).record(1)
    assert fallen.terminated
    assert fallen.trajectory.transitions < 50
    with pytest.raises(TwinTooShortError, match=r"cartpole with seed 1 .* at least 50"):
        record("cartpole", "iid", 1, policy=_Right())


class _Right:
    digest = "right"

    def act(self, row):
        return 1


def test_draws_that_change_nothing_are_redrawn_up_to_100_times(monkeypatch):
    true_draw, calls = recording.draw, []

    def idle(times):
        def draw(environment, anomaly, simulator, rng):
            calls.append(anomaly)
            drawn = true_draw(environment, anomaly, simulator, rng)
            return drawn if len(calls) > times else Fault(drawn.parameters)

        calls.clear()
        monkeypatch.setattr(recording, "draw", draw)
        return record("cartpole", "drift", 1, policy=Reflex("cartpole"), episode_cap=60)

    assert (idle(2).redraws, len(calls)) == (2, 3)
    with pytest.raises(SimulationError, match="no drift episode of cartpole with seed 1 differs"):
        idle(999)
    assert len(calls) == 101


def scripted(monkeypatch, script):
    """Let attempts have given onsets, lengths and first differing rows; None: equal to the twin."""
    twin = recording.RecordedEpisode(
        Trajectory(np.zeros((101, 4)), np.eye(2)[[0] * 100]), np.zeros(100, "f4"), False, 7
    )
    attempts = []

    def run(setup, seed, replayed, anomaly):
        _, length, effect = script(len(attempts) - 1)
        rows = np.zeros((length + 1, 4), np.float32)
        if effect is not None:
            rows[effect:, 1] = 1
        actions = np.eye(2, dtype=np.float32)[[0] * length]
        drawn = {"attempt": len(attempts) - 1}
        episode = Trajectory(rows, actions), np.zeros(length, "f4"), True, seed
        return recording.RecordedEpisode(*episode, parameters=drawn)

    def generator(environment, anomaly, seed, attempt):
        attempts.append(attempt)
        onset, _, _ = script(attempt)
        return SimpleNamespace(integers=lambda low, high: onset)

    monkeypatch.setattr(recording, "_run", run)
    monkeypatch.setattr(recording, "generator", generator)
    found = recording.record_anomalous(recording.Setup("cartpole", None), "iid", None, twin)
    assert attempts == list(range(len(attempts)))
    return found, len(attempts)


def test_where_every_tail_is_short_the_longest_that_differs_from_its_twin_is_kept(monkeypatch):
    def script(k):
        # The longest of all, attempt 50, equals its twin; 20 and 70 tie behind it.
        tail = {50: 60, 20: 15, 70: 15}.get(k, 1 + k % 10)
        return 35, 35 + tail, None if k == 50 else 36

    found, attempts = scripted(monkeypatch, script)
    assert (attempts, found.redraws) == (101, 100)
    assert found.parameters == {"attempt": 20}
    assert found.trajectory.transitions == 50


def test_a_tail_of_20_is_redrawn_and_one_of_21_is_kept(monkeypatch):
    # Attempt k ends 18 + k transitions beyond its onset; T > onset + 20 holds first for k = 3.
    found, attempts = scripted(monkeypatch, lambda k: (40 + k, 58 + 2 * k, 45 + k))
    assert (found.trajectory.transitions - found.onset, found.redraws, attempts) == (21, 3, 4)
    assert (found.onset, found.effect, found.parameters) == (43, 48, {"attempt": 3})
    # An episode that only outlives its twin equals it: row 101 is the first that it does not have.
    found, _ = scripted(monkeypatch, lambda k: (40, 150, 101 if k < 2 else 100))
    assert (found.redraws, found.effect) == (2, 100)
