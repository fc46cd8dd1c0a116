"""Environments and kinds of anomalies of plug-ins, and the meaning of their names.

An environment or a kind of anomaly has a long name, ``PLUGIN/NAME``, that nothing else has, and a
short one, which means something where one plug-in alone offers it. In a command, as in a split, a
short name has one meaning: `OfferedSpecs.register` makes it known.
"""

import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar, get_args

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, NAME_PATTERN
from oodd_eval.data.registry import (
    PULSES,
    AnomalySpec,
    EnvironmentSpec,
    Spec,
    Task,
    environment_spec,
    file_of,
    functions_of,
    inner_of,
    long_name,
    register,
)
from oodd_eval.errors import PluginError, UsageError
from oodd_eval.names import check_known, listed, select

_Sort = TypeVar("_Sort", EnvironmentSpec, AnomalySpec)
_Spec = TypeVar("_Spec", bound=Spec)


@dataclass(frozen=True, slots=True)
class OfferedSpecs:
    """Environments and kinds of anomalies of plug-ins, and what names mean.

    Parameters
    ----------
    specs
        Environments and kinds, each with the name of its plug-in.
    broken
        Why a plug-in is broken, by its name, and by the names of what it would offer.
    """

    specs: tuple[Spec, ...] = ()
    broken: Mapping[str, str] = field(default_factory=dict)

    def named(self, name: str, sort: type[_Sort]) -> list[_Sort]:
        """Return the environments, or the kinds, that have a short or a long name."""
        of_sort = (spec for spec in self.specs if isinstance(spec, sort))
        return [spec for spec in of_sort if name in (spec.name, long_name(spec))]

    def meanings(self, name: str) -> list[Spec]:
        """Return the environment or kind that a name means, or nothing.

        Raises
        ------
        UsageError
            Where it may mean several.
        PluginError
            Where a plug-in is broken that has the name, or would offer it.
        """
        specs: list[Spec] = [*self.named(name, EnvironmentSpec), *self.named(name, AnomalySpec)]
        return self._only(name, specs)

    def select_environments(self, names: str) -> list[str]:
        """Return the names that a comma list of names and globs selects, of the benchmark, too."""
        specs = [spec for spec in self.specs if isinstance(spec, EnvironmentSpec)]
        short = [*ENVIRONMENTS, *(spec.name for spec in specs)]
        return select("environment", names, [*short, *map(long_name, specs)])

    def register(
        self, environments: Iterable[str], kinds: Sequence[str] = (), beside: str = ""
    ) -> list[str]:
        """Register what names mean together; return the short names of the environments.

        Further kinds that can be recorded in the environments are registered, too.

        Parameters
        ----------
        environments
            Short and long names, also of the benchmark.
        kinds
            Names of kinds, of which a short one means that of the environments' own plug-in first.
            By default all that the environments can have.
        beside
            Plug-in whose environments are meant first.

        Raises
        ------
        UnknownNameError, UsageError, PluginError
            Where a name has no meaning, or several, where two things share a short one, and where a
            plug-in is broken that has a name, or would offer it.
        """
        meant: list[EnvironmentSpec] = []
        for name in environments:
            of_benchmark = [environment_spec(name)] if name in ENVIRONMENTS else []
            several = of_benchmark or self.named(name, EnvironmentSpec)
            meant += self._only(name, several, [beside])
            if not several:
                self.select_environments(name)
        plugins = [spec.plugin for spec in meant]
        specs = [spec for spec in self.specs if isinstance(spec, AnomalySpec)]
        kinds_meant: list[AnomalySpec] = []
        for name in dict.fromkeys([*kinds, *(spec.name for spec in specs)]):
            offered = self.named(name, AnomalySpec)
            suited = [s for s in offered if any(self.is_for(s, s.plugin, e) for e in meant)]
            first = [s for s in suited if s.plugin in plugins] or suited
            if name in kinds or (first[1:] and not kinds and first[0].plugin in plugins):
                if "/" in name:
                    check_known("anomaly", [*map(long_name, specs)], name)
                kinds_meant += self._only(name, first, plugins)
            elif len(first) == 1 and name not in {spec.name for spec in kinds_meant}:
                kinds_meant += first
        together: list[Spec] = [*meant, *kinds_meant]
        for spec in together:
            same = [s for s in together if (type(s), s.name) == (type(spec), spec.name)]
            self._only(spec.name, same, [s.plugin for s in same])
        register(together)
        return [*dict.fromkeys(spec.name for spec in meant)]

    def is_for(self, spec: Any, plugin: str, environment: EnvironmentSpec) -> bool:
        """Tell whether a kind or act of a plug-in is for an environment, by its `environments`.

        These are short and long names; of several the plug-in's own is meant.
        """
        of_plugin = self.named(f"{plugin}/{environment.name}", EnvironmentSpec) or [environment]
        is_meant = environment in of_plugin and environment.name in spec.environments
        return is_meant or not spec.environments or long_name(environment) in spec.environments

    def _only(self, name: str, several: Sequence[_Spec], beside: Sequence[str] = ()) -> list[_Spec]:
        """Return what a name means, first what is of plug-ins `beside` it, or nothing."""
        of_plugins = [spec for spec in several if spec.plugin in beside]
        reason = self.broken.get(name.rpartition("/")[0] or name)
        if reason and not (of_plugins or ("/" in name and several)):
            raise PluginError(f"{name!r} may be of the broken plug-in {reason}")
        by_name = {long_name(spec): spec for spec in of_plugins or several}
        if len(by_name) > 1:
            long = listed(sorted(by_name), 9)
            expected = "expected one of these names, and a split of its own for each"
            raise UsageError(f"{name!r} is the short name of {long}: {expected}")
        return [*by_name.values()]


def with_intermittent(specs: Iterable[Spec]) -> Iterator[Spec]:
    """Yield each spec, and the intermittent kind beside one that has it."""
    for spec in specs:
        yield spec
        if isinstance(spec, AnomalySpec) and spec.intermittent:
            on, off = PULSES
            summary = f"as {spec.name}, on for {on} rows and off for {off}"
            kind = replace(spec, name=f"{spec.name}-intermittent", summary=summary)
            yield replace(kind, pulses=PULSES, intermittent=False)


def check_spec(spec: Spec) -> None:
    """Raise `PluginError` for a wrong or taken name, functions of no module, and wrong numbers."""
    kind = "environment" if isinstance(spec, EnvironmentSpec) else "anomaly"
    taken = ENVIRONMENTS if isinstance(spec, EnvironmentSpec) else ANOMALIES
    if spec.name in {"nominal", *taken} or not re.fullmatch(NAME_PATTERN, spec.name):
        raise PluginError(
            f"{spec.name!r} cannot be the name of a custom {kind}, expected lower-case letters, "
            "digits and hyphens, and no name of the benchmark"
        )
    if problem := _problem_of(spec):
        raise PluginError(f"{kind} {spec.name!r} has {problem}")
    for function in functions_of(spec):
        inner = inner_of(function)
        module = sys.modules.get(getattr(inner, "__module__", ""))
        imported = getattr(module, getattr(inner, "__qualname__", ""), None)
        if imported is not inner or not file_of(inner):
            raise PluginError(
                f"{kind} {spec.name!r} names {inner!r:.80}, expected a function or class at the "
                "top level of a module in a file, which other processes can import"
            )


def _problem_of(spec: Spec) -> str:
    """Return what is wrong with a task, or with the rows of a kind; empty if nothing is."""
    if isinstance(spec, EnvironmentSpec):
        tasks = f"task {spec.task!r}, expected one of {', '.join(get_args(Task))}"
        return "" if spec.task in get_args(Task) else tasks
    pulses = (1, 1) if spec.pulses is None else tuple(spec.pulses)
    if min(spec.ramp, spec.lasts) < 0:
        return f"ramp {spec.ramp} and lasts {spec.lasts}, expected numbers of rows from 0"
    if len(pulses) != 2 or min(pulses) < 1:
        return f"pulses {spec.pulses}, expected two numbers of rows from 1: on, off"
    if spec.intermittent and spec.pulses is not None:
        return "pulses, so it is intermittent itself: expected intermittent=False"
    return ""
