"""MuJoCo's Swimmer as an environment of oodd-eval, and a fluid that gets thicker."""

from pathlib import Path

from oodd_eval import AnomalySpec, EnvironmentSpec, Quantity, hookimpl

POLICY = Path(__file__).with_name("swimmer.npz")  # of `oodd-eval policies train swimmer`

SENSORS = (
    Quantity("first link angle", "rad"),
    Quantity("first joint angle", "rad"),
    Quantity("second joint angle", "rad"),
    Quantity("tip velocity x", "m/s"),
    Quantity("tip velocity y", "m/s"),
    Quantity("first link angular velocity", "rad/s"),
    Quantity("first joint angular velocity", "rad/s"),
    Quantity("second joint angular velocity", "rad/s"),
)
ACTIONS = (Quantity("first joint torque", "N m"), Quantity("second joint torque", "N m"))


def make():
    """Return a swimmer that decides every 0.16 s: 250 decisions are 40 s."""
    import gymnasium

    return gymnasium.make("Swimmer-v5", frame_skip=16, max_episode_steps=250)


def make_thicker(strength, rng, simulator):
    """Return a fault that multiplies the viscosity of the fluid by 1 + strength."""
    from oodd_recording.faults import Fault

    class Thicker(Fault):
        def begin(self, simulator, rows):
            simulator.env.unwrapped.model.opt.viscosity *= 1 + strength

    return Thicker({})


@hookimpl
def oodd_environments():
    """Offer the swimmer."""
    return [EnvironmentSpec("swimmer", make, POLICY, SENSORS, ACTIONS, episode_cap=250)]


@hookimpl
def oodd_anomalies():
    """Offer the thicker fluid."""
    summary = "the fluid gets thicker: its viscosity times 1 + strength"
    unit = "the viscosity of water"
    return [AnomalySpec("viscosity", "dynamics", summary, unit, 4.0, make_thicker, ("swimmer",))]
