"""The registry of environments and kinds of anomalies that episodes can be recorded with.

Plug-ins offer them as specs through the hooks ``oodd_environments`` and ``oodd_anomalies``; the
benchmark's are those of the plug-in `oodd_recording.benchmark`. They are known by short names here:
what names mean that several plug-ins have is decided before (`oodd_eval.data.offers`). Nothing is
simulated here, so that listing them stays quick. Recording takes place in processes of their own,
which import what a spec names again: its functions stand at the top level of a module.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

from oodd_eval.data.facts import EnvironmentInfo, Group, Quantity
from oodd_eval.names import check_known

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


class Attribute(NamedTuple):
    """A number of the dynamics: `get` reads it from an environment, `set` changes it there."""

    get: Callable[[Any], float]
    set: Callable[[Any, float], None]


Task = Literal["return", "loss"]


@dataclass(frozen=True, slots=True)
class EnvironmentSpec:
    """One environment that a plug-in offers.

    Parameters
    ----------
    name
        Lower-case letters, digits and hyphens.
    make
        Called as ``make()`` for every episode; returns a Gymnasium environment with a Box of
        observations of shape (D,), and either ``Discrete(n)`` actions or a Box of shape (A,) with
        finite ends, in the units of `actions`. What ``reset(seed=...)`` is given decides the whole
        episode.
    policy
        Called as ``policy()``; returns a function of an observation row alone, float32 of shape
        (D,), to an action: a whole number, or a row of shape (A,). Or an object with ``act(row)``
        and ``reset()``: a controller with memory, which is reset before an episode and is handed
        every row of it. Or the path of a policy file such as ``oodd-eval policies train`` and
        ``oodd-eval policies import`` write.
    sensors, actions
        Names and units of the columns of observations, and of actions. Those of observations say
        which are measured, and with which noise: it is added to each row before the policy sees
        it.
    episode_cap
        Longest episode in transitions.
    title
        How people call it; default the name.
    attributes
        Numbers of the dynamics that anomalies of the benchmark change: ``"gravity"`` (kind
        gravity), ``"body_mass"`` (mass) and ``"friction"`` (friction); where actions are discrete
        also ``"gain"`` and ``"bias"``. Kinds without their attribute cannot be recorded.
    task
        What a ladder's levels are: shares of the ``"return"`` that the policy keeps, or growth of
        the ``"loss"``, which is 1 - reward a row, and 1 in rows after an early end; rewards lie in
        [0, 1] then.
    ladder
        Path of the strengths that ``oodd-eval data calibrate`` found, which the suite ladder
        records.
    packages
        Names of the distributions that simulate: their versions stand in a split's manifest.
    description
        What its page says of it, as Markdown: model, controller, where the numbers are from. Its
        sections, from the first ``##`` on, follow the page's first table.
    picture
        Called as ``picture()``; returns the picture of its page: an SVG as text, or a PNG as bytes.
    plugin
        Name of its plug-in, which is filled in when the plug-in is loaded.
    """

    name: str
    make: Callable[[], Any]
    policy: Callable[[], Any] | str | Path
    sensors: tuple[Quantity, ...]
    actions: tuple[Quantity, ...]
    episode_cap: int
    title: str = ""
    attributes: Mapping[str, Attribute] = field(default_factory=dict)
    task: Task = "return"
    ladder: Path | None = None
    packages: tuple[str, ...] = ()
    description: str = ""
    picture: Callable[[], str | bytes] | None = None
    plugin: str = ""


class Fault:
    """One anomaly as drawn for one episode; it acts from the onset on.

    A kind overrides what it needs. Strength 0 changes nothing.

    Parameters
    ----------
    parameters
        What was drawn, as plain JSON; stored with the episode. Corrupted sensors are listed under
        ``"sensors"``, by number; only measured ones can be.

    Attributes
    ----------
    share
        The part of the strength that is in force, from 0 to 1, where a kind grows, ends or rests
        (see `AnomalySpec`); else 1. It is set before every call of `command`. What `command`
        changes is the fault's to weaken; rows that `observe` returns are mixed by it: at a share of
        .3 they keep seven tenths of the values that came in.
    """

    share: float = 1.0

    def __init__(self, parameters: dict[str, Any]) -> None:
        self.parameters = parameters

    def begin(self, simulator: Any, rows: Sequence[NDArray[np.float32]]) -> None:
        """Prepare, once, before the transition onto the onset; after a rest, again.

        Parameters
        ----------
        simulator
            The episode's; ``simulator.env`` is the environment.
        rows
            Observation rows seen until then.
        """

    def command(self, action: Any, simulator: Any) -> Any:
        """Return what the simulator is given for an action; called before every transition.

        Parameters
        ----------
        action
            Command of the policy: the number of a discrete action, or a float32 row of shape (A,)
            in the units of actions.
        simulator
            The episode's.

        Returns
        -------
        int or float32 array of shape (A,)
            Command for the simulator. What comes back while the fault rests is dropped.
        """
        return action

    def observe(self, row: NDArray[np.float32], step: int) -> NDArray[np.float32]:
        """Return an observation row as the broken sensors report it.

        It is also called while the fault rests, so that its draws go on; what it returns is dropped
        then.

        Parameters
        ----------
        row
            Row of the simulator with its nominal noise, float32 of shape (D,).
        step
            Its number in the episode.

        Returns
        -------
        float32 array of shape (D,)
        """
        return row

    def end(self, simulator: Any) -> None:
        """Put back what `begin` and `command` changed, before a transition without the fault.

        Attributes that were changed by ``simulator.scale``, and wind, are put back besides.

        Parameters
        ----------
        simulator
            The episode's.
        """


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
        Called as ``make(strength, rng, simulator)`` at the onset; returns a `Fault`. What it draws
        comes from the generator `rng` and does not depend on the strength. ``simulator.env`` is the
        environment.
    environments
        Names of the environments that it can be recorded in; empty for any. Of several that share a
        short name, that of the same plug-in is meant.
    units
        Unit and bound where they differ: by the name of an environment, or for ``"discrete"`` or
        ``"continuous"`` actions.
    needs, needs_discrete
        Attributes that an environment must have, see `EnvironmentSpec`; the latter where its
        actions are discrete.
    ramp
        Number of rows over which the fault grows from nothing to its strength, as wear does: `k`
        rows after the onset a share of ``(k + 1) / ramp`` is in force.
    lasts
        Number of rows after which the fault ends; 0 where it lasts to the end of the episode.
    pulses
        Rows for which the fault is on, then for which it is off, again and again; None where it
        stays on.
    intermittent
        Whether there is another kind besides, its name followed by ``-intermittent``: on for 10
        rows and off for 40.
    plugin
        Name of its plug-in, which is filled in when the plug-in is loaded.
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
    ramp: int = 0
    lasts: int = 0
    pulses: tuple[int, int] | None = None
    intermittent: bool = False
    plugin: str = ""

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
        default = self.units.get(family, (self.unit, self.bound))
        return self.units.get(environment.id, default)


Spec = EnvironmentSpec | AnomalySpec

PULSES: Final = (10, 40)  # rows on and off of intermittent kinds


def long_name(spec: Spec) -> str:
    """Return the name that no other plug-in can have; of what is no plug-in's, its name."""
    return f"{spec.plugin}/{spec.name}" if spec.plugin else spec.name


_environments: Final[dict[str, EnvironmentSpec]] = {}
_anomalies: Final[dict[str, AnomalySpec]] = {}


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
    further = [f for f in (spec.policy, spec.picture) if callable(f)]
    return [spec.make, *further, *accessors]
