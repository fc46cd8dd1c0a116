"""Facts of registered environments: what recording has to know of them beside their specs."""

import functools
import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final, NamedTuple

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, EnvironmentInfo, in_order
from oodd_eval.data.registry import (
    AnomalySpec,
    EnvironmentSpec,
    Spec,
    anomaly_spec,
    environment_spec,
    file_of,
    functions_of,
    inner_of,
    registered,
)
from oodd_eval.errors import UsageError


class Measured(NamedTuple):
    """The spread of each sensor in nominal rows, and the numbers of the sensors that may break."""

    spread: tuple[float, ...]
    sensors: tuple[int, ...]


_infos: Final[dict[str, tuple[EnvironmentSpec, EnvironmentInfo]]] = {}
MEASURED: Final[dict[str, Measured]] = {}
"""Spreads and sensors of environments by name; those of custom ones are measured at recording."""


def info_of(environment: str) -> EnvironmentInfo:
    """Return the facts of an environment.

    The first call makes a custom environment once, to see its spaces. `UsageError` when they are
    not as `EnvironmentSpec` says.
    """
    if environment in ENVIRONMENTS:
        return ENVIRONMENTS[environment]
    spec = environment_spec(environment)
    if environment in _infos and _infos[environment][0] is not spec:  # another of the same name
        del _infos[environment]
        MEASURED.pop(environment, None)
    if environment not in _infos:
        _infos[environment] = spec, _inspected(spec)
    return _infos[environment][1]


def kinds_of(environment: str) -> list[str]:
    """Return the kinds of anomalies that can be recorded in an environment at any strength."""
    discrete, attributes = info_of(environment).discrete, environment_spec(environment).attributes
    kinds = [
        spec.name
        for spec in registered()
        if isinstance(spec, AnomalySpec)
        and environment in (spec.environments or [environment])
        and {*spec.needs, *(spec.needs_discrete if discrete else ())} <= attributes.keys()
    ]
    return in_order(kinds, ANOMALIES)


def code_digest(environment: str, kinds: Iterable[str]) -> str:
    """Return the SHA-256 of the modules that custom specs name; empty without any.

    Arguments of a ``functools.partial`` count, too.
    """
    specs: list[Spec] = [environment_spec(environment), *map(anomaly_spec, kinds)]
    functions = [f for spec in specs for f in functions_of(spec) if not _of_benchmark(f)]
    arguments = [repr((f.args, f.keywords)) for f in functions if isinstance(f, functools.partial)]
    files = sorted({file_of(inner_of(f)) for f in functions})
    digests = [hashlib.sha256(Path(file).read_bytes()).hexdigest() for file in files]
    return hashlib.sha256(repr((digests, arguments)).encode()).hexdigest() if files else ""


def _of_benchmark(function: Callable[..., Any]) -> bool:
    return getattr(inner_of(function), "__module__", "").partition(".")[0] == __package__


def _inspected(spec: EnvironmentSpec) -> EnvironmentInfo:
    """Look at the spaces of an environment."""
    env = spec.make()
    rows, actions = env.observation_space, env.action_space
    env.close()
    discrete = hasattr(actions, "n") and hasattr(actions, "start")
    widths = (getattr(rows, "shape", None), (int(actions.n),) if discrete else actions.shape)
    expected = (len(spec.sensors),), (len(spec.actions),)
    unit = discrete or (bool((actions.low == -1).all()) and bool((actions.high == 1).all()))
    if widths != expected or not unit or (discrete and actions.start != 0):
        raise UsageError(
            f"environment {spec.name!r} has observations {rows} and actions {actions}, expected a "
            f"Box of shape {expected[0]} as it names {len(spec.sensors)} sensors, and Discrete("
            f"{len(spec.actions)}) or a Box of shape {expected[1]} from -1 to 1 as it names "
            f"{len(spec.actions)} actions"
        )
    title, columns = spec.title or spec.name, (spec.sensors, spec.actions)
    return EnvironmentInfo(
        spec.name, title, spec.name, "custom", discrete, *columns, spec.episode_cap
    )
