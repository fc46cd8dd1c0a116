"""Names and units of sensors and actions, against what the simulators themselves compute."""

import math
from fractions import Fraction

import numpy as np
import pytest
from helpers_simulate import SEEDS, Reflex
from oodd_recording.environments import make

from oodd_eval.data.facts import ENVIRONMENTS, Quantity

BULLET = [e for e, info in ENVIRONMENTS.items() if info.family == "bullet"]
UNITS = {"m", "m/s", "rad", "rad/s", "N m", "1"}


def scale(unit):
    """(factor, unit): ``"10/3 m/s"`` is (10/3, "m/s")."""
    first, _, rest = unit.partition(" ")
    return (float(Fraction(first)), rest) if first[0].isdigit() and rest else (1.0, unit)


def physical(environment, row):
    """The readings by name, in plain units."""
    sensors = ENVIRONMENTS[environment].sensors
    return {q.name: float(v) * scale(q.unit)[0] for q, v in zip(sensors, row, strict=True)}


@pytest.fixture
def running(request):
    """(environment, simulator, observation) after 40 steps."""
    environment = request.param
    simulator, policy = make(environment), Reflex(environment)
    row = simulator.reset(SEEDS[environment])
    for _ in range(40):
        row, _, _ = simulator.step(policy.act(row))
    yield environment, simulator, row
    simulator.close()


@pytest.mark.parametrize("info", ENVIRONMENTS.values(), ids=ENVIRONMENTS)
def test_every_column_has_a_name_of_its_own_and_a_unit(info):
    for columns, width in ((info.sensors, info.observation_dim), (info.actions, info.action_dim)):
        assert len(columns) == len({q.name for q in columns}) == width
        assert all(isinstance(q, Quantity) and q.name == q.name.strip() for q in columns)
        assert {scale(q.unit)[1] for q in columns} <= UNITS


@pytest.mark.parametrize("running", ["acrobot"], indirect=True)
def test_acrobot(running):
    environment, simulator, row = running
    theta1, theta2, speed1, speed2 = simulator.env.state
    assert physical(environment, row) == pytest.approx({
        "cosine of theta1": math.cos(theta1), "sine of theta1": math.sin(theta1),
        "cosine of theta2": math.cos(theta2), "sine of theta2": math.sin(theta2),
        "theta1 speed": speed1, "theta2 speed": speed2,
    })  # fmt: skip
    torques = [float(a.name.split()[1]) if "N m" in a.name else 0.0
               for a in ENVIRONMENTS[environment].actions]  # fmt: skip
    assert torques == simulator.env.AVAIL_TORQUE


@pytest.mark.parametrize("running", ["cartpole"], indirect=True)
def test_cartpole(running):
    environment, simulator, row = running
    names = ["cart position", "cart velocity", "pole angle", "pole angular velocity"]
    found = physical(environment, row)
    assert found == pytest.approx(dict(zip(names, simulator.env.state, strict=True)))
    for action, side in enumerate(["push left", "push right"]):
        assert ENVIRONMENTS[environment].actions[action].name == side
        before = found["cart velocity"]
        after = physical(environment, simulator.step(action)[0])["cart velocity"]
        assert (after > before) == (side == "push right")
        found["cart velocity"] = after


@pytest.mark.parametrize("running", ["lunarlander"], indirect=True)
def test_lunarlander(running):
    environment, simulator, row = running
    lander, found = simulator.env.lander, physical(environment, row)
    # 600 x 400 pixels at 30 a metre; the pad is in the middle, the legs reach 18 pixels down.
    assert found["horizontal position"] == pytest.approx(lander.position.x - 10, abs=1e-5)
    height = lander.position.y - simulator.env.helipad_y - 18 / 30
    assert found["height above the pad"] == pytest.approx(height, abs=1e-5)
    assert found["horizontal velocity"] == pytest.approx(lander.linearVelocity.x, abs=1e-5)
    assert found["vertical velocity"] == pytest.approx(lander.linearVelocity.y, abs=1e-5)
    assert found["angle"] == pytest.approx(lander.angle, abs=1e-6)
    assert found["angular velocity"] == pytest.approx(lander.angularVelocity, abs=1e-5)
    legs = dict(zip(list(found)[6:], simulator.env.legs, strict=True))
    sides = {"left": -1, "right": 1}
    for name, leg in legs.items():
        side, what, _ = name.split()
        assert (what, math.copysign(1, leg.position.x - lander.position.x)) == ("leg", sides[side])


@pytest.mark.parametrize("running", BULLET, indirect=True)
def test_bullet_sensors(running):
    environment, simulator, row = running
    robot, found = simulator.env.robot, physical(environment, row)
    body = robot.robot_body
    roll, pitch, yaw = body.pose().rpy()
    vx, vy, vz = body.speed()
    assert found["torso height above its start"] == pytest.approx(
        body.pose().xyz()[2] - robot.initial_z, abs=1e-6
    )
    assert found["forward velocity"] == pytest.approx(
        math.cos(yaw) * vx + math.sin(yaw) * vy, abs=1e-5
    )
    assert found["sideways velocity"] == pytest.approx(
        math.cos(yaw) * vy - math.sin(yaw) * vx, abs=1e-5
    )
    assert found["upward velocity"] == pytest.approx(vz, abs=1e-5)
    assert (found["roll"], found["pitch"]) == pytest.approx((roll, pitch), abs=1e-6)
    angle = robot.walk_target_theta - yaw
    assert found["sine of angle to target"] == pytest.approx(math.sin(angle), abs=1e-6)
    assert found["cosine of angle to target"] == pytest.approx(math.cos(angle), abs=1e-6)
    assert len(found) == 8 + 2 * len(robot.ordered_joints) + len(robot.foot_list)
    for joint in robot.ordered_joints:
        name, (position, speed) = joint.joint_name.replace("_joint", ""), joint.get_state()
        half = (joint.upperLimit - joint.lowerLimit) / 2
        # Readings are clipped at 5 units; units have four digits.
        angle = np.clip(position - joint.lowerLimit - half, -5 * half, 5 * half)
        assert found[f"{name} angle from mid-range"] == pytest.approx(angle, rel=1e-3, abs=1e-5)
        assert found[f"{name} speed"] == pytest.approx(np.clip(speed, -50, 50), abs=1e-4)
    contacts = [found[f"{foot} contact"] for foot in robot.foot_list]
    assert contacts == robot.feet_contact.tolist()


@pytest.mark.parametrize("running", BULLET, indirect=True)
def test_bullet_actions_are_torques(running, monkeypatch):
    environment, simulator, _ = running
    given = {}
    for joint in simulator.env.robot.ordered_joints:
        name = f"{joint.joint_name.replace('_joint', '')} torque"
        monkeypatch.setattr(joint, "set_motor_torque", lambda v, name=name: given.update({name: v}))
    command = np.linspace(-0.5, 0.9, ENVIRONMENTS[environment].action_dim)
    simulator.env.robot.apply_action(command)
    actions = ENVIRONMENTS[environment].actions
    assert given == pytest.approx(
        {q.name: c * scale(q.unit)[0] for q, c in zip(actions, command, strict=True)}
    )
