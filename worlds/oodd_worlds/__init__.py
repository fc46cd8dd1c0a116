"""Three worlds with nominal variation and noisy sensors: an arm, a drone, four tanks.

They are an ordinary plug-in. Listing them imports no simulator.
"""

from pathlib import Path
from typing import Any, Final

from oodd_eval import AnomalySpec, Detector, DetectorSpec, EnvironmentSpec, hookimpl
from oodd_eval.data.facts import Group
from oodd_worlds.description import describe
from oodd_worlds.facts import read_world

HERE: Final = Path(__file__).parent
ROWS: Final = 400
TITLES: Final = {"arm": "Arm", "drone": "Drone", "tank": "Tank"}


def make_arm() -> Any:
    """Return a fresh arm."""
    from oodd_worlds.arm import Arm  # noqa: PLC0415  imports the simulator

    return Arm()


def make_drone() -> Any:
    """Return a fresh drone."""
    from oodd_worlds.drone import Drone  # noqa: PLC0415  imports the simulator

    return Drone()


def make_tank() -> Any:
    """Return fresh tanks."""
    from oodd_worlds.tank import Tank  # noqa: PLC0415  slow to import

    return Tank()


def control_arm() -> Any:
    """Return the arm's controller."""
    from oodd_worlds.arm import ComputedTorque  # noqa: PLC0415  imports the simulator

    return ComputedTorque()


def control_drone() -> Any:
    """Return the drone's controller."""
    from oodd_worlds.drone import control  # noqa: PLC0415  imports the simulator

    return control


def control_tank() -> Any:
    """Return the tanks' controller, which has memory."""
    from oodd_worlds.tank import PI  # noqa: PLC0415  slow to import

    return PI()


def draw_arm() -> str:
    """Return a drawing of the arm."""
    from oodd_worlds.pictures import picture_arm  # noqa: PLC0415  slow to import

    return picture_arm()


def draw_drone() -> str:
    """Return a drawing of the drone."""
    from oodd_worlds.pictures import picture_drone  # noqa: PLC0415  slow to import

    return picture_drone()


def draw_tank() -> str:
    """Return a drawing of the tanks."""
    from oodd_worlds.pictures import picture_tank  # noqa: PLC0415  slow to import

    return picture_tank()


@hookimpl
def oodd_environments() -> list[EnvironmentSpec]:
    """Offer the worlds."""
    makers = {"arm": make_arm, "drone": make_drone, "tank": make_tank}
    pictures = {"arm": draw_arm, "drone": draw_drone, "tank": draw_tank}
    controllers = {"arm": control_arm, "drone": control_drone, "tank": control_tank}
    return [
        EnvironmentSpec(
            name,
            makers[name],
            controllers[name],
            read_world(name).sensors,
            read_world(name).actions,
            episode_cap=ROWS,
            title=title,
            task="loss",
            ladder=HERE / "ladder.json",
            packages=() if name == "tank" else ("mujoco",),
            description=describe(name),
            picture=pictures[name],
        )
        for name, title in TITLES.items()
    ]


KINDS: Final[tuple[tuple[str, str, Group, str, str, float], ...]] = (
    ("arm", "joint-friction", "dynamics", "a joint's frictions grow", "the joint's friction", 8.0),
    ("arm", "payload", "dynamics", "the payload gets heavier", "kg", 4.0),
    ("arm", "motor-loss", "dynamics", "a motor gives less torque", "share of the torque", 0.9),
    ("arm", "encoder-offset", "sensor", "an encoder is off", "rad", 0.2),
    ("arm", "backlash", "sensor", "a gear has play", "rad", 0.2),
    ("drone", "rotor-loss", "dynamics", "a rotor gives less thrust", "share of the thrust", 0.5),
    ("drone", "steady-wind", "dynamics", "a steady wind sets in", "m/s", 12.0),
    ("drone", "gyro-bias", "sensor", "a gyroscope is off", "rad/s", 2.0),
    ("drone", "position-drift", "sensor", "a position drifts", "m a row", 0.05),
    ("tank", "leak", "dynamics", "a tank leaks", "cm²", 0.1),
    ("tank", "pump-wear", "dynamics", "a pump gives less flow", "share of the flow", 0.6),
    ("tank", "slow-pump", "dynamics", "a pump lags more", "s", 60.0),
    ("tank", "split-valve", "dynamics", "a valve shifts", "share of the flow", 0.4),
    ("tank", "level-drift", "sensor", "a level drifts", "cm a row", 0.05),
)
"""World, name, group, what changes, unit and bound of each kind."""


@hookimpl
def oodd_anomalies() -> list[AnomalySpec]:
    """Offer the kinds of anomalies of the worlds."""
    from oodd_worlds import kinds  # noqa: PLC0415  slow to import

    return [
        AnomalySpec(
            name, group, summary, unit, bound, getattr(kinds, name.replace("-", "_")), (world,)
        )
        for world, name, group, summary, unit, bound in KINDS
    ]


@hookimpl
def oodd_acts() -> list[Any]:
    """Offer the acts of the worlds."""
    from oodd_worlds.acts import ACTS  # noqa: PLC0415  slow to import

    return ACTS


def make_oracle(*, seed: int = 0, horizon: int = 1) -> Detector:
    """Return an unfitted oracle of the worlds."""
    from oodd_worlds.oracles import OracleDetector  # noqa: PLC0415  keeps the listing quick

    return OracleDetector("oracle", seed=seed, horizon=horizon)


def make_gym_oracle(*, seed: int = 0, horizon: int = 1) -> Detector:
    """Return an unfitted oracle of Acrobot, CartPole and LunarLander."""
    from oodd_worlds.gym import GymOracle  # noqa: PLC0415  keeps the listing quick

    return GymOracle("oracle-gym", seed=seed, horizon=horizon)


@hookimpl
def oodd_detectors() -> list[DetectorSpec]:
    """Offer the oracles of the worlds and of three of the benchmark's environments."""
    return [
        DetectorSpec(
            name="oracle-gym",
            factory=make_gym_oracle,
            summary="the equations of Acrobot, CartPole and LunarLander",
            reference="Sutton (1996), Barto et al. (1983); charts of innovations, Mehra & Peschon "
            "(1971)",
            inputs="observations+actions",
            deterministic=True,
            training="oracle",
            alarm="score",
        ),
        DetectorSpec(
            name="oracle",
            factory=make_oracle,
            summary="Kalman filter with the equations of arm, drone or tank",
            reference="Kalman (1960); charts of innovations, Mehra & Peschon (1971)",
            inputs="observations+actions",
            deterministic=True,
            training="oracle",
            alarm="score",
            requires=("gymnasium", "mujoco"),
            extra="oodd-eval[worlds]",
        ),
    ]
