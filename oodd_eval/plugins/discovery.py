"""Discovery of plug-ins: one entry point at a time, so that a broken one harms nobody else.

pluggy's own loader stops at the first plug-in that cannot be imported and drops the second of two
that share a name without a word. Here each entry point of the group ``oodd_eval`` is loaded,
checked and asked for its detectors on its own; what fails is kept with its reason, for `list` and
for the exit code.
"""

from __future__ import annotations

import importlib.util
import inspect
import os
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from types import ModuleType
from typing import Any, Final

import pluggy

from oodd_eval._version import __version__
from oodd_eval.errors import (
    MissingExtraError,
    OoddError,
    PluginError,
    UnknownNameError,
    UsageError,
)
from oodd_eval.names import select
from oodd_eval.plugins import baselines as trivial
from oodd_eval.plugins import hooks as hookspecs
from oodd_eval.plugins.contract import DetectorSpec

BUILT_IN: Final = "trivial"
"""Name of the plug-in that is part of the harness."""

RESTRICT: Final = "OODD_EVAL_PLUGINS"
"""Environment variable that names the only entry points to load, separated by commas."""

OWN_DISTRIBUTION: Final = "oodd-eval"


@dataclass(frozen=True, slots=True)
class Offer:
    """A detector together with the plug-in that offers it.

    Attributes
    ----------
    spec
        What the plug-in says about the detector.
    plugin
        Name of the entry point.
    module
        Name of the module that the entry point leads to.
    distribution, version
        What pip installed it from.
    """

    spec: DetectorSpec
    plugin: str
    module: str
    distribution: str
    version: str

    @property
    def origin(self) -> str:
        """Distribution and version, as printed."""
        return f"{self.distribution} {self.version}"

    def unavailable(self) -> str:
        """Return why the detector cannot run here, with the command that helps; empty if it can."""
        missing = [name for name in self.spec.requires if not _importable(name)]
        if not missing:
            return ""
        install = f'pip install "{self.spec.extra}"' if self.spec.extra else (
            f"pip install {' '.join(missing)}"
        )  # fmt: skip
        return f"needs {', '.join(missing)}: {install}"

    def require(self) -> None:
        """Raise `MissingExtraError` when the detector cannot run here."""
        if reason := self.unavailable():
            raise MissingExtraError(f"detector {self.spec.name!r} {reason}")


@dataclass(frozen=True, slots=True)
class Broken:
    """A plug-in that is installed and does not work, with the reason."""

    plugin: str
    distribution: str
    reason: str


@dataclass
class Plugins:
    """What discovery found.

    Attributes
    ----------
    manager
        pluggy's manager, with every working plug-in registered.
    offers
        Detectors by name, sorted.
    broken
        Plug-ins that failed, in the order in which they did.
    """

    manager: pluggy.PluginManager
    offers: dict[str, Offer] = field(default_factory=dict)
    broken: list[Broken] = field(default_factory=list)
    points: dict[str, EntryPoint] = field(default_factory=dict)
    foreign: dict[str, str] = field(default_factory=dict)

    def offer(self, name: str) -> Offer:
        """Return the offered detector of this name; one with a colon is made when first named.

        Raises
        ------
        UnknownNameError
            When no working plug-in offers it.
        UsageError
            When it has a colon and no plug-in can make a detector of it.
        """
        if name not in self.offers and ":" in name:
            made = self._from_spec(name)
            return self.offers.setdefault(made.spec.name, made)
        try:
            return self.offers[name]
        except KeyError:
            raise UnknownNameError("detector", name, self.offers) from None

    def select(self, patterns: str) -> list[str]:
        """Return the names of the detectors that a comma list of names and globs selects.

        Raises
        ------
        UsageError
            When a name does not exist or a glob matches nothing.
        """
        parts = [part.strip() for part in patterns.split(",")]
        known = [self.offer(part).spec.name if ":" in part else part for part in parts]
        return select("detector", ",".join(known), self.offers)

    def spec_forms(self) -> list[tuple[str, str, str]]:
        """Return who makes detectors of names with a colon: plug-in, origin, and which names."""
        return [
            (name, f"{_distribution(point)} {_version(point)}", first_line(call).removesuffix("."))
            for name, point, call in self._makers()
        ]

    def _makers(self) -> list[tuple[str, EntryPoint, Callable[..., object]]]:
        """Return plug-ins that make detectors of names with a colon, this distribution's first."""
        hook = self.manager.hook.oodd_detector_from_spec
        return [
            (made.plugin_name, self.points[made.plugin_name], made.function)
            for made in hook.get_hookimpls()
            if made.plugin_name in self.points
        ]

    def _from_spec(self, text: str) -> Offer:
        """Ask one plug-in after the other; a failure is told as that plug-in's."""
        asked = []
        for name, point, call in self._makers():
            try:
                spec = call(spec=text)
            except OoddError:
                raise
            except (Exception, SystemExit) as error:
                raise PluginError(
                    f"plug-in {name!r} of {_distribution(point)} failed to make detector {text!r}: "
                    f"{describe(error)}"
                ) from error
            if isinstance(spec, DetectorSpec) and ":" in spec.name:
                return _offer(spec, point, point.module)
            if spec is not None:
                raise PluginError(
                    f"plug-in {name!r} of {_distribution(point)} made {spec!r:.80} of {text!r}, "
                    "expected None or a DetectorSpec whose name has a colon"
                )
            asked.append(name)
        raise UsageError(
            f"no plug-in makes a detector of {text!r}: "
            + (f"asked {', '.join(asked)}" if asked else "none that is loaded knows such names")
            + " (oodd-eval list detectors says which names there are)"
        )

    def observe(self, observer: object, name: str) -> None:
        """Register an observer of runs that is part of the program, such as a reporter."""
        self.manager.register(observer, name=name)

    def notify(self, hook: str, **arguments: Any) -> None:
        """Call an observer hook of every plug-in, one plug-in at a time.

        An observer from an entry point that raises is unregistered and noted in `broken`: a plug-in
        that watches may not stop the run. The program's own observers may raise.
        """
        plugins = dict(self.manager.list_name_plugin())
        for name, plugin in plugins.items():
            others = [p for p in plugins.values() if p is not plugin]
            call = self.manager.subset_hook_caller(hook, remove_plugins=others)
            if name not in self.foreign:
                call(**arguments)
                continue
            try:
                call(**arguments)
            except Exception as error:  # noqa: BLE001  foreign code may raise anything
                self.manager.unregister(name=name)
                self.broken.append(
                    Broken(name, self.foreign[name], f"hook {hook} failed: {describe(error)}")
                )


def discover(disabled: Collection[str] = (), *, only: Collection[str] | None = None) -> Plugins:
    """Load the built-in plug-in and every entry point of the group ``oodd_eval``.

    Parameters
    ----------
    disabled
        Names of plug-ins to leave out.
    only
        Names of the entry points to load. None means all, or those that the environment variable
        ``OODD_EVAL_PLUGINS`` names; the built-in plug-in is loaded in any case.

    Raises
    ------
    UnknownNameError
        When `disabled`, `only` or the environment variable name a plug-in that is not installed.
    """
    found = sorted(entry_points(group=hookspecs.PROJECT), key=_own_first)
    names = {BUILT_IN, *(point.name for point in found)}
    if only is None and RESTRICT in os.environ:
        only = [name.strip() for name in os.environ[RESTRICT].split(",") if name.strip()]
    for name in (*disabled, *(only or ())):
        if name not in names:
            raise UnknownNameError("plug-in", name, names)

    manager = pluggy.PluginManager(hookspecs.PROJECT)
    manager.add_hookspecs(hookspecs)
    plugins = Plugins(manager)
    if BUILT_IN not in disabled:
        plugins.manager.register(trivial, name=BUILT_IN)
        for spec in trivial.oodd_detectors():
            plugins.offers[spec.name] = Offer(
                spec, BUILT_IN, trivial.__name__, OWN_DISTRIBUTION, __version__
            )
    for point in found:
        if point.name not in disabled and (only is None or point.name in only):
            _load(plugins, point)
    plugins.offers = dict(sorted(plugins.offers.items()))
    return plugins


def describe(error: BaseException) -> str:
    """Return an exception in one line: its type and its message."""
    try:
        message = " ".join(str(error).split())
    except Exception:  # noqa: BLE001  foreign exceptions may fail to say what they are
        message = "(its text cannot be had)"
    return f"{type(error).__name__}: {message}" if message else type(error).__name__


def first_line(documented: object) -> str:
    """Return the first line of an object's docstring; empty without one."""
    return (inspect.getdoc(documented) or "").partition("\n")[0]


def _own_first(point: EntryPoint) -> tuple[bool, str, str]:
    """Order entry points so that no other distribution can take a name from this one."""
    distribution = _distribution(point)
    return distribution != OWN_DISTRIBUTION, distribution, point.name


def _distribution(point: EntryPoint) -> str:
    return point.dist.name if point.dist else "unknown distribution"


def _version(point: EntryPoint) -> str:
    return point.dist.version if point.dist else ""


def _offer(spec: DetectorSpec, point: EntryPoint, module: str) -> Offer:
    """Return a plug-in's spec as an offer; its version names the library that does the work."""
    version = "+".join(part for part in (_version(point), spec.version) if part)
    return Offer(spec, point.name, module, _distribution(point), version)


def _load(plugins: Plugins, point: EntryPoint) -> None:
    """Load one entry point; afterwards it is registered with its detectors, or noted as broken."""
    name, distribution = point.name, _distribution(point)
    if plugins.manager.has_plugin(name):
        owner = plugins.foreign.get(name, OWN_DISTRIBUTION)
        reason = f"{owner} has a plug-in of the same name: uninstall one of them"
        plugins.broken.append(Broken(name, distribution, reason))
        return
    try:
        module = point.load()
        plugins.manager.register(module, name=name)
        plugins.manager.check_pending()
        _add_offers(plugins, module, point)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # noqa: BLE001  foreign code may raise anything
        if plugins.manager.has_plugin(name):
            plugins.manager.unregister(name=name)
        plugins.broken.append(Broken(name, distribution, describe(error)))
    else:
        plugins.foreign[name] = distribution
        plugins.points[name] = point


def _add_offers(plugins: Plugins, module: ModuleType, point: EntryPoint) -> None:
    """Take over the detectors that a registered plug-in offers: all of them or none."""
    distribution = _distribution(point)
    mine: dict[str, Offer] = {}
    for spec in _offered(plugins.manager, module, point):
        previous = plugins.offers.get(spec.name) or mine.get(spec.name)
        if previous:
            raise PluginError(
                f"detector {spec.name!r} is offered twice, by {previous.distribution} (plug-in "
                f"{previous.plugin!r}) and by {distribution} (plug-in {point.name!r}): uninstall "
                f"one of them, or leave it out with -p no:{point.name}"
            )
        mine[spec.name] = _offer(spec, point, module.__name__)
    plugins.offers.update(mine)


def _offered(
    manager: pluggy.PluginManager, module: ModuleType, point: EntryPoint
) -> list[DetectorSpec]:
    """Return what the plug-in's own `oodd_detectors` returns, checked."""
    specs: list[DetectorSpec] = []
    for implementation in manager.hook.oodd_detectors.get_hookimpls():
        offered: object = implementation.function() if implementation.plugin is module else None
        if offered is None:
            continue
        if not isinstance(offered, list) or not all(isinstance(s, DetectorSpec) for s in offered):
            raise PluginError(
                f"oodd_detectors of plug-in {point.name!r} ({_distribution(point)}) returned "
                f"{offered!r:.80}, expected a list of oodd_eval.DetectorSpec"
            )
        specs += offered
    return specs


def _importable(name: str) -> bool:
    """Whether a module could be imported; only its parents are."""
    try:
        return importlib.util.find_spec(name) is not None
    except (ImportError, ValueError):
        return False


def resolve_parameters(spec: DetectorSpec, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return a detector's parameters with defaults filled in, sorted by name.

    Raises
    ------
    UnknownNameError
        When `given` names a parameter that the detector does not declare.
    UsageError
        When a value is of another kind than a default that is a number, a text or a truth value.
    """
    for name, value in given.items():
        if name not in spec.parameters and spec.other_parameters:
            continue
        if name not in spec.parameters:
            raise UnknownNameError(f"parameter of {spec.name}", name, spec.parameters)
        default = spec.parameters[name]
        kind = _kind(default)
        if kind and _kind(value) != kind:
            raise UsageError(
                f"parameter {name!r} of {spec.name} is {value!r}, expected {kind} like its "
                f"default {default!r}"
            )
    return dict(sorted({**spec.parameters, **given}.items()))


def _kind(value: object) -> str:
    """Return what sort of plain value this is; empty for None, lists and everything else."""
    match value:
        case bool():
            return "true or false"
        case int() | float():
            return "a number"
        case str():
            return "a text"
        case _:
            return ""
