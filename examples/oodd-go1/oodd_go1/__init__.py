"""Unitree's Go1 with a published locomotion policy, in MuJoCo, as an environment of oodd-eval.

Model and policy are those of MuJoCo Playground 0.0.4 (Apache-2.0), which the reader downloads; the
variable GO1 names the directory that they were unpacked into. See the README.
"""

import os
from pathlib import Path

from oodd_eval import AnomalySpec, EnvironmentSpec, Fault, Quantity, hookimpl

HOME = Path(os.environ.get("GO1", "go1"))
MODEL = "mujoco_playground/_src/locomotion/go1/xmls/scene_mjx_feetonly_flat_terrain.xml"
POLICY = HOME / "policy.npz"  # of `oodd-eval policies import`

JOINTS = [
    f"{leg} {joint}" for leg in ("FR", "FL", "RR", "RL") for joint in ("hip", "thigh", "calf")
]
SENSORS = (
    *(Quantity(f"velocity {axis}", "m/s", noise=0.02) for axis in "xyz"),
    *(Quantity(f"gyro {axis}", "rad/s", noise=0.01) for axis in "xyz"),
    *(Quantity(f"gravity {axis}", "1", noise=0.005) for axis in "xyz"),
    *(Quantity(f"{joint} angle from home", "rad", noise=0.002) for joint in JOINTS),
    *(Quantity(f"{joint} speed", "rad/s", noise=0.05) for joint in JOINTS),
    *(Quantity(f"{joint} last action", "0.5 rad", "memory") for joint in JOINTS),
    *(Quantity(f"wanted {what}", "m/s", "reference") for what in ("velocity x", "velocity y")),
    Quantity("wanted turn", "rad/s", "reference"),
)
ACTIONS = tuple(Quantity(f"{joint} target from home", "0.5 rad") for joint in JOINTS)


def make():
    """Return a robot that is to walk at a speed of its own in each episode."""
    from oodd_go1.robot import Go1

    return Go1(HOME / MODEL)


def make_payload(strength, rng, simulator):
    """Return a fault that adds `strength` kg to the trunk."""
    trunk = simulator.env.model.body("trunk")
    mass = float(trunk.mass[0])

    class Payload(Fault):
        def command(self, action, simulator):
            trunk.mass[0] = mass + self.share * strength
            return action

        def end(self, simulator):
            trunk.mass[0] = mass

    return Payload({})


def make_weak_motor(strength, rng, simulator):
    """Return a fault that takes a share of one motor's stiffness and of its largest force."""
    model, j = simulator.env.model, int(rng.integers(12))
    names = ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange")
    nominal = [getattr(model, name)[j].copy() for name in names]

    class WeakMotor(Fault):
        def command(self, action, simulator):
            self.set(1 - self.share * strength)
            return action

        def end(self, simulator):
            self.set(1.0)

        def set(self, factor):
            for name, values in zip(names, nominal, strict=True):
                getattr(model, name)[j] = factor * values

    return WeakMotor({"actuator": j})


def make_slippery(strength, rng, simulator):
    """Return a fault that takes a share of the ground's friction."""
    floor = simulator.env.model.geom("floor")
    friction = float(floor.friction[0])

    class Slippery(Fault):
        def command(self, action, simulator):
            floor.friction[0] = friction * (1 - self.share * strength)
            return action

        def end(self, simulator):
            floor.friction[0] = friction

    return Slippery({})


@hookimpl
def oodd_environments():
    """Offer the robot."""
    return [
        EnvironmentSpec(
            "go1",
            make,
            POLICY,
            SENSORS,
            ACTIONS,
            episode_cap=300,
            title="Go1",
            task="loss",
            ladder=HOME / "ladder.json",  # of `oodd-eval data calibrate`
            packages=("mujoco",),
        )
    ]


@hookimpl
def oodd_anomalies():
    """Offer three faults, each also on and off again."""
    kinds = (
        ("go1-payload", "the trunk gets heavier", "kg", 8.0, make_payload),
        ("go1-weak-motor", "a motor gets weaker", "share of its stiffness", 0.9, make_weak_motor),
        ("go1-slippery", "the ground gets slippery", "share of its friction", 0.9, make_slippery),
    )
    return [
        AnomalySpec(name, "dynamics", what, unit, bound, make, ("go1",), intermittent=True)
        for name, what, unit, bound, make in kinds
    ]
