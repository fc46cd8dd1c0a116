"""The benchmark's environments and kinds of anomalies, as a plug-in that offers them.

To list them is quick: simulators and numpy are imported when one is made.
"""

import functools
from dataclasses import fields
from pathlib import Path
from typing import Any, Final

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, AnomalyInfo, EnvironmentInfo
from oodd_eval.data.registry import PULSES, AnomalySpec, Attribute, EnvironmentSpec
from oodd_eval.plugins import hookimpl

FROZEN: Final = Path(__file__).with_name("frozen")
"""Directory of the nominal policies."""

_ATTRIBUTES: Final = ("gravity", "body_mass", "friction")
_DISCRETE: Final = ("gain", "bias", "wind")  # of environments with discrete actions
_PACKAGES: Final = {
    "bullet": ("pybullet", "pybullet-envs-gymnasium"),
    "lunarlander": ("box2d",),
    "acrobot": (),  # Gymnasium's own, whose version is in every manifest
    "cartpole": (),
}


@hookimpl
def oodd_environments() -> list[EnvironmentSpec]:
    """Offer the seven environments."""
    return [_environment(info) for info in ENVIRONMENTS.values()]


@hookimpl
def oodd_anomalies() -> list[AnomalySpec]:
    """Offer the kinds of the paper, and further ones."""
    shared = {field.name for field in fields(AnomalySpec)} & {f.name for f in fields(AnomalyInfo)}
    return [
        AnomalySpec(
            name=info.id,
            make=functools.partial(make_anomaly, info.id),
            pulses=PULSES if info.id.endswith("-intermittent") else None,
            **{name: getattr(info, name) for name in shared},
        )
        for info in ANOMALIES.values()
    ]


def _environment(info: EnvironmentInfo) -> EnvironmentSpec:
    names = (*_ATTRIBUTES, *(_DISCRETE if info.discrete else ()))
    return EnvironmentSpec(
        info.id,
        functools.partial(make_environment, info.id),
        FROZEN / f"{info.id}.npz",
        info.sensors,
        info.actions,
        info.episode_cap,
        info.title,
        {
            name: Attribute(
                functools.partial(get_attribute, name), functools.partial(set_attribute, name)
            )
            for name in names
        },
        packages=_PACKAGES["bullet" if info.family == "bullet" else info.id],
    )


def make_environment(environment: str) -> Any:
    """Return a fresh simulator of an environment; only that simulator's library is imported."""
    if environment in {"acrobot", "cartpole"}:
        from oodd_recording.classic import Acrobot, CartPole  # noqa: PLC0415  slow to import

        return Acrobot() if environment == "acrobot" else CartPole()
    if environment == "lunarlander":
        from oodd_recording.lander import LunarLander  # noqa: PLC0415  slow to import

        return LunarLander()
    from oodd_recording.bullet import ROBOTS, Bullet  # noqa: PLC0415  slow to import

    return Bullet(ROBOTS[environment])


def make_anomaly(kind: str, strength: float, rng: Any, simulator: Any) -> Any:
    """Draw a fault of a kind for one episode."""
    from oodd_recording.faults import MAKERS  # noqa: PLC0415  slow to import

    return MAKERS[kind](simulator.environment, strength, simulator, rng)


def get_attribute(name: str, simulator: Any) -> float:
    """Read an attribute of the dynamics."""
    return float(simulator.get(name))


def set_attribute(name: str, simulator: Any, value: float) -> None:
    """Change an attribute of the dynamics."""
    simulator.set(name, value)
