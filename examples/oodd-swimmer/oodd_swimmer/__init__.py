"""MuJoCo's Swimmer as an environment of oodd-eval, a fluid that gets thicker, and a safe stop."""

from pathlib import Path

from oodd_eval import AnomalySpec, EnvironmentSpec, Fault, Quantity, hookimpl

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


class Thicker(Fault):
    """A fluid whose viscosity is multiplied by 1 + strength, as far as the fault is in force."""

    def __init__(self, strength, options):
        super().__init__({})
        self.strength, self.options, self.nominal = strength, options, options.viscosity

    def command(self, action, simulator):
        self.options.viscosity = self.nominal * (1 + self.share * self.strength)
        return action

    def end(self, simulator):
        self.options.viscosity = self.nominal


def make_thicker(strength, rng, simulator):
    """Return a fault that multiplies the viscosity of the fluid by 1 + strength."""
    return Thicker(strength, simulator.env.unwrapped.model.opt)


@hookimpl
def oodd_environments():
    """Offer the swimmer."""
    return [
        EnvironmentSpec(
            "swimmer", make, POLICY, SENSORS, ACTIONS, episode_cap=250, packages=("mujoco",)
        )
    ]


@hookimpl
def oodd_anomalies():
    """Offer the thicker fluid, also in clouds of 10 decisions with 40 of clear water between."""
    summary = "the fluid gets thicker: its viscosity times 1 + strength"
    unit = "the viscosity of water"
    return [
        AnomalySpec(
            "viscosity",
            "dynamics",
            summary,
            unit,
            4.0,
            make_thicker,
            ("swimmer",),
            intermittent=True,
        )
    ]


class Stretched:
    """A safe stop: both joints are pulled straight, and the swimmer drifts."""

    def act(self, row):
        return [
            max(-1.0, min(1.0, -0.2 * float(row[i]) - 0.05 * float(row[i + 5]))) for i in (1, 2)
        ]


def make_stretched(situation):
    """Return the act; it needs nothing of the situation at the alarm."""
    return Stretched()


@hookimpl
def oodd_acts():
    """Offer the stop."""
    from oodd_interventions import ActSpec

    summary = "both joints are pulled straight, and the swimmer drifts"
    return [ActSpec("stop", make_stretched, summary, ("dynamics",), ("swimmer",))]
