"""Roles of sensors in recipes, frames, watchdogs and scans."""

import numpy as np
import pytest
from oodd_live import Watchdog
from oodd_live import handle as live_handle
from oodd_logs import import_frames
from oodd_logs.scanning.scan import scan_episodes

from oodd_eval import DetectorSpec, Quantity
from oodd_eval.data.facts import roles_of
from oodd_eval.errors import UnknownNameError, UsageError
from oodd_eval.plugins.discovery import Offer, discover

ROLES = {"velocity": ["v*"], "angle": ["turn"], "setpoint": "goal"}


def columns(tmp_path, **keys):
    rng = np.random.default_rng(0)
    names = ("vx", "vy", "turn", "goal")
    rows = [
        [dict(zip(names, row, strict=True)) for row in rng.normal(size=(30, 4))] for _ in range(24)
    ]
    return import_frames(
        "rover", train=rows[:4], calibration=rows[4:], output=tmp_path, report=len, **keys
    )


def test_a_recipe_names_roles_and_digests_stay(tmp_path):
    plain = columns(tmp_path / "plain")
    split = columns(tmp_path / "roles", roles=ROLES)
    assert split.roles("rover") == ("velocity", "velocity", "angle", "setpoint")
    assert plain.roles("rover") == ()
    assert split.digest == plain.digest
    with split.opened() as opened:
        sensors = opened("rover").sensors
    assert roles_of(sensors) == split.roles("rover")
    assert not sensors[3].measured


def test_an_angle_that_is_replaced_hands_its_role_to_sine_and_cosine(tmp_path):
    split = columns(tmp_path, roles=ROLES, angles=["turn"])
    assert split.roles("rover") == ("velocity", "velocity", "sine", "cosine", "setpoint")


@pytest.mark.parametrize(
    ("roles", "error", "message"),
    [
        ({"speed": ["v*"]}, UnknownNameError, "speed"),
        ({"velocity": ["w*"]}, UnknownNameError, "w"),
        ({"velocity": ["v*"], "angle": ["vx"]}, UsageError, "'vx' is velocity and angle"),
    ],
)
def test_wrong_roles_are_refused(tmp_path, roles, error, message):
    with pytest.raises(error, match=message):
        columns(tmp_path, roles=roles)


def test_an_angle_in_degrees_is_refused(tmp_path):
    sensors = ["vx", "vy", "turn[deg]", "goal"]
    with pytest.raises(UsageError, match="'turn' is in deg, expected rad"):
        columns(tmp_path / "a", sensors=sensors, roles=ROLES)
    split = columns(tmp_path / "b", sensors=sensors, roles=ROLES, angles=["turn"])
    assert "sine" in split.roles("rover")


class Takes:
    """A detector that scores by how many roles it was made with."""

    def __init__(self, *, seed=0, horizon=1, roles=()):
        self.roles = roles

    def fit(self, nominal):
        pass

    def score(self, x):
        return np.abs(x.observations[:, 0]).astype(np.float64) + 10 * len(self.roles)

    def reset(self):
        pass

    def update(self, observation, action=None):
        return float(abs(observation[0])) + 10 * len(self.roles)

    def state(self):
        return {"fitted": True}

    def restore(self, state):
        pass


@pytest.fixture
def _installed(monkeypatch):
    plugins = discover(only=())
    spec = DetectorSpec("takes", Takes, "", alarm="score", roles=True)
    plugins.add(Offer(spec, "", "", "local", ""))
    monkeypatch.setattr(live_handle, "discover", lambda: plugins)


@pytest.mark.usefixtures("_installed")
def test_watchdogs_and_scans_hand_roles_over(tmp_path):
    split = columns(tmp_path / "split", roles=ROLES)
    with split.opened() as opened:
        watchdog = Watchdog.fit("takes", opened("rover"))
    row = np.zeros(4)
    assert watchdog.update(row).score == 40
    watchdog.save(tmp_path / "kept")
    assert Watchdog.load(tmp_path / "kept").update(row).score == 40
    rows = np.random.default_rng(0).normal(size=(24, 30, 2))
    quantities = Quantity("vx", "m/s", "velocity"), Quantity("vy", "m/s", "velocity")
    named = Watchdog.fit("takes", rows[:4], rows[4:], sensors=["vx", "vy"])
    assert named.update(row[:2]).score == 0
    told = Watchdog.fit("takes", rows[:4], rows[4:], sensors=quantities)
    assert told.update(row[:2]).score == 20
    scan = scan_episodes(rows, sensors=quantities, detector="takes")
    assert min(float(e.statistic.min()) for e in scan.episodes) >= 20
