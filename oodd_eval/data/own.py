"""Environments and anomalies of one's own: what plug-ins declare, and which are known here.

Nothing is simulated here, so that listing them stays quick. Recording takes place in processes of
their own, which import what a spec names again: its functions stand at the top level of a module.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

from oodd_eval.data.facts import (
    ANOMALIES,
    ENVIRONMENTS,
    NAME_PATTERN,
    AnomalyInfo,
    EnvironmentInfo,
    Group,
    Quantity,
)
from oodd_eval.errors import PluginError, UsageError
from oodd_eval.names import check_known


class Attribute(NamedTuple):
    """A number of the dynamics: `get` reads it from an environment, `set` changes it there."""

    get: Callable[[Any], float]
    set: Callable[[Any, float], None]


@dataclass(frozen=True, slots=True)
class EnvironmentSpec:
    """One environment that a plug-in offers.

    Parameters
    ----------
    name
        Lower-case letters, digits and hyphens.
    make
        Called as ``make()`` for every episode; returns a Gymnasium environment with a Box of
        observations of shape (D,), and either ``Discrete(n)`` actions or a Box of shape (A,) from
        -1 to 1 (``gymnasium.wrappers.RescaleAction`` makes one of any other). What
        ``reset(seed=...)`` is given decides the whole episode.
    policy
        Called as ``policy()``; returns a function of an observation row alone, float32 of shape
        (D,), to an action: a whole number, or a row of shape (A,). Or the path of a policy file
        such as ``oodd-eval policies train`` writes.
    sensors, actions
        Names and units of the columns of observations, and of actions.
    episode_cap
        Longest episode in transitions.
    title
        How people call it; default the name.
    attributes
        Numbers of the dynamics that anomalies of the benchmark change: ``"gravity"`` (kind
        gravity), ``"body_mass"`` (mass) and ``"friction"`` (friction); where actions are discrete
        also ``"gain"`` and ``"bias"``. Kinds without their attribute cannot be recorded.
    """

    name: str
    make: Callable[[], Any]
    policy: Callable[[], Callable[[Any], Any]] | str | Path
    sensors: tuple[Quantity, ...]
    actions: tuple[Quantity, ...]
    episode_cap: int
    title: str = ""
    attributes: Mapping[str, Attribute] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class AnomalySpec:
    """One kind of anomaly that a plug-in offers.

    Parameters
    ----------
    name
        Lower-case letters, digits and hyphens.
    group
        ``"sensor"`` or ``"dynamics"``.
    summary
        One line: what changes.
    unit
        What a strength of 1 means.
    bound
        Largest sensible strength; 0 is nothing at all.
    make
        Called as ``make(strength, rng, simulator)`` at the onset; returns a `Fault` of
        `oodd_recording.faults`. What it draws comes from the generator `rng` and does not
        depend on the strength. ``simulator.env`` is the environment.
    environments
        Names of the environments that it can be recorded in; empty for any.
    """

    name: str
    group: Group
    summary: str
    unit: str
    bound: float
    make: Callable[..., Any]
    environments: tuple[str, ...] = ()


OwnSpec = EnvironmentSpec | AnomalySpec


class Measured(NamedTuple):
    """The spread of each sensor in nominal rows, and the numbers of the sensors that may break."""

    spread: tuple[float, ...]
    sensors: tuple[int, ...]


_SENSORS: Final = (
    "iid",
    "calibration",
    "drift",
    "shutdown",
    "ar1",
    "varma",
    "delay",
    "stuck",
    "iid-intermittent",
    "calibration-intermittent",
    "shutdown-intermittent",
)
_COMMANDS: Final = ("stuck-joint", "latency", "action-noise")
_ROWS: Final = ("gain", "bias", "wind-l2r", "wind-r2l", "wind-intermittent", "gain-intermittent")
_NEEDS: Final = {"gravity": "gravity", "mass": "body_mass", "friction": "friction"}
_NEEDS_DISCRETE: Final = {"gain": "gain", "gain-intermittent": "gain", "bias": "bias"}

_environments: Final[dict[str, EnvironmentSpec]] = {}
_anomalies: Final[dict[str, AnomalySpec]] = {}
_infos: Final[dict[str, EnvironmentInfo]] = {}
MEASURED: Final[dict[str, Measured]] = {}
"""Spreads and sensors of environments of one's own, by name; recording measures them."""


def check_spec(spec: EnvironmentSpec | AnomalySpec) -> None:
    """Raise `PluginError` for a spec with a wrong or taken name, or functions of no module."""
    kind = "environment" if isinstance(spec, EnvironmentSpec) else "anomaly"
    taken = ENVIRONMENTS if isinstance(spec, EnvironmentSpec) else ANOMALIES
    if spec.name in taken or spec.name == "nominal" or not re.fullmatch(NAME_PATTERN, spec.name):
        raise PluginError(
            f"{spec.name!r} cannot be the name of an {kind} of one's own, expected lower-case "
            "letters, digits and hyphens, and no name of the benchmark"
        )
    for function in _functions(spec):
        inner = _inner(function)
        name, home = getattr(inner, "__qualname__", ""), getattr(inner, "__module__", "")
        if not name or getattr(sys.modules.get(home), name, None) is not inner or not _file(inner):
            raise PluginError(
                f"{kind} {spec.name!r} names {inner!r:.80}, expected a function or class at the "
                "top level of a module in a file, which other processes can import"
            )


def register(specs: Iterable[EnvironmentSpec | AnomalySpec]) -> None:
    """Make environments and anomalies known in this process; `PluginError` for a wrong spec."""
    for spec in specs:
        check_spec(spec)
        if isinstance(spec, EnvironmentSpec):
            _environments[spec.name] = spec
            _infos.pop(spec.name, None)
            MEASURED.pop(spec.name, None)
        else:
            _anomalies[spec.name] = spec


def registered() -> list[EnvironmentSpec | AnomalySpec]:
    """Return all specs that are known in this process."""
    return [*_environments.values(), *_anomalies.values()]


def environment_spec(name: str) -> EnvironmentSpec | None:
    """Return the spec of an environment of one's own; None for one of the benchmark."""
    check_known("environment", [*ENVIRONMENTS, *_environments], name)
    return _environments.get(name)


def anomaly_spec(name: str) -> AnomalySpec | None:
    """Return the spec of a kind of one's own; None for one of the benchmark."""
    check_known("anomaly", [*ANOMALIES, *_anomalies], name)
    return _anomalies.get(name)


def info_of(environment: str) -> EnvironmentInfo:
    """Return the facts of an environment of the benchmark or of one's own.

    The first call makes one's own environment once, to see its spaces. `UsageError` when they are
    not as `EnvironmentSpec` says.
    """
    spec = environment_spec(environment)
    if spec is None:
        return ENVIRONMENTS[environment]
    if environment not in _infos:
        _infos[environment] = _seen(spec)
    return _infos[environment]


def anomaly_info(kind: str) -> AnomalyInfo:
    """Return name, group and summary of a kind of the benchmark or of one's own."""
    spec = anomaly_spec(kind)
    return AnomalyInfo(kind, kind, spec.group, spec.summary) if spec else ANOMALIES[kind]


def kinds_of(environment: str) -> list[str]:
    """Return the kinds of anomalies that can be recorded in an environment at any strength."""
    own = [s.name for s in _anomalies.values() if environment in (s.environments or [environment])]
    spec = environment_spec(environment)
    if spec is None:
        return [*ANOMALIES, *own]
    found = [*_SENSORS, *_COMMANDS]
    needs = _NEEDS | _NEEDS_DISCRETE if info_of(environment).discrete else _NEEDS
    found += [] if info_of(environment).discrete else _ROWS
    found += [kind for kind, attribute in needs.items() if attribute in spec.attributes]
    return [*(kind for kind in ANOMALIES if kind in found), *own]


def code_digest(environment: str, kinds: Iterable[str]) -> str:
    """Return the SHA-256 of the modules that specs of one's own name; empty for the benchmark's.

    Arguments of a ``functools.partial`` count, too.
    """
    specs = [environment_spec(environment), *map(anomaly_spec, kinds)]
    named = [f for spec in specs if spec for f in _functions(spec)]
    given = [repr((f.args, f.keywords)) for f in named if isinstance(f, functools.partial)]
    files = sorted({_file(_inner(f)) for f in named})
    digests = [hashlib.sha256(Path(file).read_bytes()).hexdigest() for file in files]
    return hashlib.sha256(repr((digests, given)).encode()).hexdigest() if files else ""


def _inner(function: Callable[..., Any]) -> Callable[..., Any]:
    return function.func if isinstance(function, functools.partial) else function


def _file(function: Callable[..., Any]) -> str:
    """Return the file of a function's code; empty where it is in none."""
    try:
        file = inspect.getsourcefile(function) or ""
    except TypeError:
        return ""
    return file if Path(file).is_file() else ""


def _functions(spec: EnvironmentSpec | AnomalySpec) -> list[Callable[..., Any]]:
    if isinstance(spec, AnomalySpec):
        return [spec.make]
    named = [f for attribute in spec.attributes.values() for f in attribute]
    return [spec.make, *([spec.policy] if callable(spec.policy) else []), *named]


def _seen(spec: EnvironmentSpec) -> EnvironmentInfo:
    """Look at the spaces of an environment."""
    env = spec.make()
    seen, given = env.observation_space, env.action_space
    env.close()
    discrete = hasattr(given, "n") and hasattr(given, "start")
    widths = (getattr(seen, "shape", None), (int(given.n),) if discrete else given.shape)
    expected = (len(spec.sensors),), (len(spec.actions),)
    unit = discrete or (bool((given.low == -1).all()) and bool((given.high == 1).all()))
    if widths != expected or not unit or (discrete and given.start != 0):
        raise UsageError(
            f"environment {spec.name!r} has observations {seen} and actions {given}, expected a "
            f"Box of shape {expected[0]} as it names {len(spec.sensors)} sensors, and Discrete("
            f"{len(spec.actions)}) or a Box of shape {expected[1]} from -1 to 1 as it names "
            f"{len(spec.actions)} actions"
        )
    return EnvironmentInfo(
        spec.name,
        spec.title or spec.name,
        spec.name,
        "own",
        len(spec.sensors),
        len(spec.actions),
        "IQN" if discrete else "TD3",
        float("nan"),
        spec.episode_cap,
        spec.sensors,
        spec.actions,
        discrete,
    )
