"""Roles of sensors reach detectors that declare them, and change neither names nor digests."""

import json
from typing import ClassVar

import numpy as np
import pytest
from helpers_plugins import install
from helpers_split import make_split

from oodd_eval import DetectorSpec, Quantity, load_split
from oodd_eval.data.facts import ENVIRONMENTS, roles_of
from oodd_eval.data.layout import environment_digest, own_facts, roles_in
from oodd_eval.data.parts import TWINS
from oodd_eval.errors import SplitError, UsageError
from oodd_eval.plugins.discovery import Offer, discover
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.scoring.plan import make_plan
from oodd_eval.scoring.unit import UnitJob


def test_what_follows_a_controller_is_not_measured():
    assert [Quantity("x", "m", role).measured for role in ("velocity", "contact", "measured")] == (
        [True] * 3
    )
    for role in ("reference", "memory", "setpoint"):
        assert not Quantity("x", "m", role).measured
        with pytest.raises(UsageError, match="no noise"):
            Quantity("x", "m", role, noise=0.1)


def test_roles_are_no_part_of_the_rows_that_digests_cover():
    assert Quantity("x", "m", "velocity", noise=0.1).row == Quantity("x", "m", noise=0.1).row
    assert Quantity("x", "m", "reference").row["role"] == "reference"
    sensors = Quantity("x", "m", "velocity"), Quantity("y", "m")
    entry = {
        "groups": {},
        "sensors": [q.row for q in sensors],
        "actions": [],
        **own_facts("rover", discrete=False, groups={}, sensors=sensors),
    }
    assert roles_in("rover", entry) == ("velocity", "measured")
    plain = {name: value for name, value in entry.items() if name != "roles"}
    assert environment_digest(entry) == environment_digest(plain)
    assert roles_in("rover", plain) == ()
    with pytest.raises(SplitError, match="3 roles"):
        roles_in("rover", entry | {"roles": ["angle"] * 3})


def test_environments_of_the_benchmark_have_the_roles_of_their_facts():
    split = load_split("mini")
    assert "roles" not in json.dumps(split.manifest["environments"]["lunarlander"])
    data = split.environment("lunarlander")
    assert data.sensors == ENVIRONMENTS["lunarlander"].sensors
    assert split.roles("lunarlander") == roles_of(data.sensors)
    assert split.roles("lunarlander").count("contact") == 2
    for name in ("ant", "halfcheetah", "hopper", "walker2d"):
        roles = split.roles(name)
        assert (roles.count("velocity"), roles.count("angle")) == (3, 2)


class Takes:
    """A detector that keeps the roles it is made with."""

    made: ClassVar[list] = []

    def __init__(self, *, seed=0, horizon=1, roles=()):
        self.roles = roles
        type(self).made.append(roles)

    def fit(self, nominal):
        pass

    def score(self, x):
        size = np.abs(x.observations).sum(axis=1).astype(np.float64)
        return size + 1000 * len(self.roles)


def unit_of(split, environment, **changes):
    plugins = discover(only=())
    plugins.add(Offer(DetectorSpec("takes", Takes, "", **changes), "", "", "local", ""))
    plan = make_plan(plugins, split=split, detectors=["takes"], environments=[environment])
    return plan, plan.units[0], plugins


def test_a_run_hands_roles_over_where_they_are_declared(tmp_path):
    split = load_split(make_split(tmp_path / "tiny", ("cartpole",)))
    roles = ("position", "velocity", "angle", "measured")
    keys = set()
    for changes, expected in (({}, ()), ({"roles": True}, roles)):
        plan, unit, plugins = unit_of(split, "cartpole", **changes)
        assert unit.roles == expected
        keys.add(unit.scores_key)
        Takes.made.clear()
        with split.opened() as opened:
            job = UnitJob(plan, unit, opened("cartpole"), plugins.offer("takes"))
            outcome = job(Limits(60, None), lambda: False, None, fresh=True)
        assert outcome.status == "ok", outcome.reason
        assert {*Takes.made} == {expected}
    assert len(keys) == 2


def test_a_worker_gets_roles_and_fits_know_them(tmp_path, monkeypatch):
    code = """
import numpy as np
from oodd_eval import DetectorSpec, hookimpl

class Counts:
    def __init__(self, *, seed, horizon, roles=()): self.roles = roles
    def fit(self, nominal): pass
    def score(self, x):
        assert type(self.roles) is tuple
        return np.full(len(x), float(len(self.roles)))

@hookimpl
def oodd_detectors():
    return [DetectorSpec("counts", Counts, ""), DetectorSpec("takes", Counts, "", roles=True)]
"""
    install(monkeypatch, tmp_path, "counting", code, header="")
    split = load_split(make_split(tmp_path / "tiny", ("cartpole",)))
    plugins = discover()
    fits = []
    for name, expected in (("counts", 0.0), ("takes", 4.0)):
        plan = make_plan(plugins, split=split, detectors=[name], environments=["cartpole"])
        fits.append(plan.units[0].fit_key)
        with split.opened() as opened:
            job = UnitJob(plan, plan.units[0], opened("cartpole"), plugins.offer(name))
            outcome = job(Limits(60, None), lambda: False, None, fresh=True)
        assert outcome.status == "ok", outcome.reason
        assert {*np.concatenate(outcome.file.parts[TWINS])} == {expected}
    assert len({*fits}) == 2


def test_other_sensors_than_the_benchmarks_have_no_roles_of_facts():
    sensors = [sensor.row for sensor in ENVIRONMENTS["cartpole"].sensors]
    assert roles_in("cartpole", {"sensors": sensors})[0] == "position"
    assert roles_in("cartpole", {"sensors": [{**sensors[0], "name": "x"}, *sensors[1:]]}) == ()
