"""Environments of one's own: from what `new` wrote to a ladder, and a plug-in of release 0.2."""

import re

import pytest
from helpers_docs import ROOT, Session, commands

pytestmark = pytest.mark.slow

pytest.importorskip("gymnasium", reason="needs the extra gym")
PAGE = (ROOT / "docs" / "how-to" / "own-environment.md").read_text()

PENDULUM = """
from oodd_eval import AnomalySpec, EnvironmentSpec, Fault, Quantity, hookimpl


def make():
    import gymnasium

    return gymnasium.make("Pendulum-v1")


def policy():
    def act(row):
        cosine, sine, speed = (float(x) for x in row)
        if cosine > 0.8:  # hold it
            return [max(-2.0, min(2.0, -10 * sine - 2 * speed))]
        energy = speed**2 / 2 + 15 * cosine  # 15 at the top
        return [max(-2.0, min(2.0, (15 - energy) * speed / 5))]

    return act


class Heavier(Fault):
    def __init__(self, strength, rng, simulator):
        super().__init__({})
        self.strength, self.mass = strength, simulator.env.unwrapped.m

    def command(self, action, simulator):
        simulator.env.unwrapped.m = self.mass * (1 + self.share * self.strength)
        return action

    def end(self, simulator):
        simulator.env.unwrapped.m = self.mass


@hookimpl
def oodd_environments():
    sensors = Quantity("cosine", "1"), Quantity("sine", "1"), Quantity("speed", "rad/s", noise=0.02)
    torque = (Quantity("torque", "N m"),)
    return [
        EnvironmentSpec("pendulum", make, policy, sensors, torque, 200, packages=("gymnasium",))
    ]


@hookimpl
def oodd_anomalies():
    what, unit, where = "a heavier bob", "the bob's mass", ("pendulum",)
    kind = "heavier", "dynamics", what, unit, 2.0, Heavier, where
    return [AnomalySpec(*kind, intermittent=True)]
"""

PROJECT = """
[project]
name = "oodd-pendulum"
version = "0.1.0"

[project.entry-points.oodd_eval]
pendulum = "oodd_pendulum"
"""

OF_RELEASE = """
pip install -e .
oodd-eval check pendulum
oodd-eval check heavier
oodd-eval data build swings --env pendulum --train 30 --calibration 40 --test 10 --seed-base 42 \\
  --strength heavier=0.2,1 --strength heavier-intermittent=1 --strength iid=0.1
oodd-eval run --detector mewma,persistence --env pendulum --split swings
"""
"""The plug-in and the commands on the page of release 0.2."""


@pytest.fixture
def session(tmp_path, monkeypatch):
    session = Session(tmp_path, monkeypatch)
    yield session
    session.forget()


def test_the_plug_in_of_release_0_2_leads_to_its_board(session, tmp_path, capsys):
    (tmp_path / "oodd_pendulum.py").write_text(PENDULUM)
    (tmp_path / "pyproject.toml").write_text(PROJECT)
    for command in commands(f"```sh{OF_RELEASE}```\n"):
        assert session.run(command) == 0, command
    told = capsys.readouterr().out
    board = told[told.index("Matched AUC") :]
    assert re.search(r"mewma +[│|]? *\d", board)
    assert "heavier-intermittent" in board
    assert "8 ok" in told


def test_the_page_leads_from_nothing_to_a_ladder(session, tmp_path):
    (page,) = re.findall(r"^```sh\n(python.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    steps = page.splitlines()
    assert len(steps) == 10
    # The tests run in processes that do not see this session's plug-ins.
    check = {"pytest oodd-two-link": "oodd-eval check two-link"}
    for step in steps[2:]:
        assert session.run(check.get(step, step)) == 0, step
    report = (tmp_path / "oodd-results" / "report.md").read_text()
    thresholds = report.partition("### mewma: detection thresholds by anomaly")[2]
    assert re.search(r"\| two-link +\| +\S*[\d.]+ \| +\S*[\d.]+ \|", thresholds)
