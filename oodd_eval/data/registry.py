"""The registry of environments and kinds of anomalies that episodes can be recorded with.

Plug-ins offer them as specs through the hooks ``oodd_environments`` and ``oodd_anomalies``; the
benchmark's are those of the plug-in `oodd_recording.benchmark`. Nothing is simulated here, so that
listing them stays quick. Recording takes place in processes of their own, which import what a spec
names again: its functions stand at the top level of a module.
"""

from __future__ import annotations

import functools
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
    EnvironmentInfo,
    Group,
    Quantity,
)
from oodd_eval.errors import PluginError
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
    units
        Unit and bound where they differ: by the name of an environment, or for ``"discrete"`` or
        ``"continuous"`` actions.
    needs, needs_discrete
        Attributes that an environment must have, see `EnvironmentSpec`; the latter where its
        actions are discrete.
    """

    name: str
    group: Group
    summary: str
    unit: str
    bound: float
    make: Callable[..., Any]
    environments: tuple[str, ...] = ()
    units: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    needs: tuple[str, ...] = ()
    needs_discrete: tuple[str, ...] = ()

    def scale(self, environment: EnvironmentInfo) -> tuple[str, float]:
        """Return unit and bound of the strength in an environment.

        Parameters
        ----------
        environment
            Its facts.

        Returns
        -------
        tuple
            The text of the unit, and the number.
        """
        family = "discrete" if environment.discrete else "continuous"
        unit, bound = self.units.get(environment.id) or self.units.get(
            family, (self.unit, self.bound)
        )
        return unit, bound


Spec = EnvironmentSpec | AnomalySpec


_environments: Final[dict[str, EnvironmentSpec]] = {}
_anomalies: Final[dict[str, AnomalySpec]] = {}


def check_spec(spec: Spec) -> None:
    """Raise `PluginError` for a spec with a wrong or taken name, or functions of no module."""
    kind = "environment" if isinstance(spec, EnvironmentSpec) else "anomaly"
    taken = {"nominal", *(ENVIRONMENTS if isinstance(spec, EnvironmentSpec) else ANOMALIES)}
    if spec.name in taken or not re.fullmatch(NAME_PATTERN, spec.name):
        raise PluginError(
            f"{spec.name!r} cannot be the name of a custom {kind}, expected lower-case letters, "
            "digits and hyphens, and no name of the benchmark"
        )
    for function in functions_of(spec):
        inner = inner_of(function)
        name, home = getattr(inner, "__qualname__", ""), getattr(inner, "__module__", "")
        if (
            not name
            or getattr(sys.modules.get(home), name, None) is not inner
            or not file_of(inner)
        ):
            raise PluginError(
                f"{kind} {spec.name!r} names {inner!r:.80}, expected a function or class at the "
                "top level of a module in a file, which other processes can import"
            )


def register(specs: Iterable[Spec]) -> None:
    """Make environments and anomalies known in this process."""
    for spec in specs:
        if isinstance(spec, AnomalySpec):
            _anomalies[spec.name] = spec
        else:
            _environments[spec.name] = spec


def registered() -> list[Spec]:
    """Return all specs that are known in this process."""
    return [*_environments.values(), *_anomalies.values()]


def environment_spec(name: str) -> EnvironmentSpec:
    """Return the spec of an environment; `UnknownNameError` without one."""
    check_known("environment", _environments, name)
    return _environments[name]


def anomaly_spec(name: str) -> AnomalySpec:
    """Return the spec of a kind of anomaly; `UnknownNameError` without one."""
    check_known("anomaly", _anomalies, name)
    return _anomalies[name]


def inner_of(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function that a ``functools.partial`` calls, or the function itself."""
    return function.func if isinstance(function, functools.partial) else function


def file_of(function: Callable[..., Any]) -> str:
    """Return the file of a function's code; empty where it is in none."""
    try:
        file = inspect.getsourcefile(function) or ""
    except TypeError:
        return ""
    return file if Path(file).is_file() else ""


def functions_of(spec: Spec) -> list[Callable[..., Any]]:
    """Return all functions that a spec names."""
    if isinstance(spec, AnomalySpec):
        return [spec.make]
    accessors = [f for attribute in spec.attributes.values() for f in attribute]
    return [spec.make, *([spec.policy] if callable(spec.policy) else []), *accessors]
