"""`panel` where it is the first choice: few rows or few episodes, through a scan and a watchdog."""

import numpy as np
import pytest
from oodd_live import Watchdog
from oodd_logs import scan_episodes
from oodd_logs.episodes import Episode

from oodd_eval import Trajectory

MIXING = np.random.default_rng(7).normal(size=(3, 8)) / 2
SENSORS = [f"joint {i}" for i in range(8)]


def log_of(seed, rows=300):
    """Eight sensors that three slow causes move, with noise."""
    rng = np.random.default_rng(seed)
    causes = rng.normal(size=(rows, 3))
    for t in range(1, rows):
        causes[t] += 0.9 * causes[t - 1]
    return causes @ MIXING + 0.3 * rng.normal(size=(rows, 8))


def with_step(rows, start, sensor, by=4.0):
    """Return rows of which one sensor reads too much from a row on."""
    rows = rows.copy()
    rows[start:, sensor] += by
    return rows


def alarms(watchdog, rows):
    """Return the reading of every row of an episode that begins anew."""
    watchdog.reset()
    return [watchdog.update(row) for row in rows]


@pytest.mark.parametrize("seed", range(3))
def test_three_hundred_rows_of_eight_sensors_are_enough_for_a_scan(seed):
    rows = log_of(seed)
    scan = scan_episodes([with_step(rows, 280, 2, by=6.0)], sensors=SENSORS, window=20)
    assert len(scan.episodes) == 15
    [odd] = scan.odd
    assert odd.episode.name.endswith("[280:300]")
    assert odd.first <= 3
    assert odd.suspects[0] == "joint 2"


@pytest.mark.parametrize("seed", range(3))
def test_ten_episodes_are_enough_for_a_scan(seed):
    logs = [log_of(100 * seed + i, rows=120) for i in range(10)]
    logs[4] = with_step(logs[4], 60, 5)
    [odd] = scan_episodes(logs, sensors=SENSORS).odd
    assert (odd.episode.name, odd.suspects[0]) == ("episode 4", "joint 5")
    assert odd.alarms[:60].sum() <= 2
    assert odd.alarms[66:].all()


@pytest.mark.parametrize(
    "train",
    [[log_of(1)], [log_of(i, rows=120) for i in range(10)]],
    ids=["300 rows", "10 episodes"],
)
def test_few_data_are_enough_for_a_watchdog(train):
    watchdog = Watchdog.fit(
        "panel", train, [log_of(20 + i) for i in range(19)], alpha=0.05, sensors=SENSORS
    )
    nominal = [log_of(60 + i) for i in range(10)]
    # One in twenty may alarm: three of ten have a chance of one in eighty.
    assert sum(any(reading.alarm for reading in alarms(watchdog, x)) for x in nominal) <= 2
    delays = []
    for x in nominal:
        readings = alarms(watchdog, with_step(x, 150, 3))
        first = next((r for r in readings if r.alarm and r.t >= 150), None)
        assert first is not None
        delays.append(first.t - 150)
        assert readings[-1].sensor == "joint 3"
    assert np.median(delays) <= 5


def driven(seed, rows=120):
    """Two sensors that follow a command, and the command."""
    rng = np.random.default_rng(seed)
    commands, noise = rng.normal(size=(rows - 1, 1)), 0.1 * rng.normal(size=(rows, 2))
    observations = np.zeros((rows, 2))
    for t, command in enumerate(commands):
        observations[t + 1] = 0.7 * observations[t] + command
    return observations + noise, commands


def test_a_watchdog_takes_actions_where_training_episodes_have_them(tmp_path):
    episodes = [driven(seed) for seed in range(30)]
    watchdog = Watchdog.fit("panel", episodes[:10], episodes[10:])
    assert repr(watchdog).startswith("Watchdog(panel-a, 2 sensors")
    watchdog.save(tmp_path / "fit.npz")
    loaded = Watchdog.load(tmp_path / "fit.npz")
    assert repr(loaded) == repr(watchdog)
    test = Trajectory(*driven(99))
    assert loaded.replay(test) == watchdog.replay(test)
    without = Watchdog.fit("panel", episodes[:10], episodes[10:], parameters={"actions": "no"})
    assert repr(without).startswith("Watchdog(panel, ")
    rows = [x for x, _ in episodes]
    same = Watchdog.fit("panel", rows[:10], rows[10:])
    assert repr(same).startswith("Watchdog(panel, ")
    assert [r.score for r in same.replay(test)] == [r.score for r in without.replay(test)]


def test_a_scan_takes_actions_where_episodes_have_them():
    logs = [Episode(str(i), str(i), *driven(i), None) for i in range(12)]
    scanned = scan_episodes(logs)
    assert scanned.judge.startswith("panel-a, ")
    assert scan_episodes(logs, parameters={"actions": "no"}).judge.startswith("panel, ")
    assert scan_episodes([rows for rows, _ in map(driven, range(12))]).judge.startswith("panel, ")
