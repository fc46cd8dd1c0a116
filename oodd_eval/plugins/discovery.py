"""Discovery of plug-ins: entry points of the group ``oodd_eval``, each loaded when it is needed.

A plug-in that breaks stops only runs of its own detectors: it is kept with its reason, for messages
and the exit code, and nothing of it is used. (pluggy's own loader stops at the first such plug-in,
and silently drops the second of two that share a name.)
"""

from __future__ import annotations

import fnmatch
import inspect
import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.machinery import PathFinder
from importlib.metadata import EntryPoint
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

import pluggy

from oodd_eval import plugins as hooks
from oodd_eval.errors import MissingExtraError, OoddError, PluginError, UnknownNameError, UsageError
from oodd_eval.names import check_known, select
from oodd_eval.plugins.contract import DetectorSpec
from oodd_eval.plugins.installed import named, points_of
from oodd_eval.plugins.parameters import resolve_parameters
from oodd_eval.plugins.specs import MOST_SPECS, plain_spec

if TYPE_CHECKING:
    # A worker discovers detectors, and is to know nothing of environments.
    from oodd_eval.data.offers import OfferedSpecs
    from oodd_eval.data.registry import Spec


_Spec = TypeVar("_Spec", bound=Any)  # what plug-ins offer under a name
_Check = Callable[[Any], object]

_BUILT_IN: Final = "trivial"
RESTRICT: Final = "OODD_EVAL_PLUGINS"
ACTIONS: Final = "actions"
"""Parameter whose value ``"no"`` leaves actions out, see `DetectorSpec.with_actions`."""

LONGEST_REASON: Final = 600  # characters; of a longer one, the start and the end are kept


@contextmanager
def staying() -> Iterator[None]:
    """Go back to the working directory after the block, if it was left and can be gone back to."""
    before = _working_directory()
    try:
        yield
    finally:
        if before and _working_directory() != before:
            os.chdir(before)


def _working_directory() -> str:
    """Return its path; empty when it has been removed."""
    try:
        return os.getcwd()  # noqa: PTH109
    except OSError:
        return ""


@dataclass(frozen=True, slots=True)
class Offer:
    """A detector (`spec`) together with the plug-in that offers it.

    `plugin` names the entry point, `module` what it leads to; pip installed the `distribution`:
    into directories of `packages`, which only sandboxes have on their import path, or here.
    """

    spec: DetectorSpec
    plugin: str
    module: str
    distribution: str
    version: str
    packages: tuple[Path, ...] = ()

    @property
    def origin(self) -> str:
        """Distribution and version, as printed."""
        return f"{self.distribution} {self.version}"

    def unavailable(self) -> str:
        """Return why the detector cannot run here, with the command that helps; empty if it can."""
        missing = [name for name in self.spec.requires if not self._importable(name)]
        if not missing:
            return ""
        requirements = f'"{self.spec.extra}"' if self.spec.extra else " ".join(missing)
        return f"needs {', '.join(missing)}: pip install {requirements}"

    def require(self) -> None:
        """Raise `MissingExtraError` when it cannot run here."""
        if reason := self.unavailable():
            raise MissingExtraError(f"detector {self.spec.name!r} {reason}")

    def _importable(self, name: str) -> bool:
        """Tell whether a module could be imported, by the package that it is in: nothing is."""
        top = name.partition(".")[0]
        try:
            return bool(find_spec(top) or PathFinder.find_spec(top, [*map(str, self.packages)]))
        except (ImportError, ValueError, AttributeError):
            return False


class Broken(NamedTuple):
    """A plug-in that is installed and does not work, with the reason."""

    plugin: str
    distribution: str
    reason: str


@dataclass(frozen=True, slots=True)
class Plugin:
    """A loaded plug-in: its entry point and its hooks."""

    point: EntryPoint
    hook: pluggy.HookRelay

    def __str__(self) -> str:
        return name_of(self.point)

    def specs(self) -> list[DetectorSpec]:
        """Return what its `oodd_detectors` returns, checked."""
        return [*map(plain_spec, self.listed("oodd_detectors", DetectorSpec))]

    @property
    def form(self) -> str:
        """The form of names with a colon that it knows, in its words; empty if none."""
        makers = self.hook.oodd_detector_from_spec.get_hookimpls()
        if not makers:
            return ""
        description = inspect.getdoc(makers[0].function) or "names with a colon"
        return printable(description.partition("\n")[0].removesuffix("."))

    def from_spec(self, text: str) -> DetectorSpec | None:
        """Return the detector for a `maker:name` text, or None if it does not know the maker."""
        spec = self.hook.oodd_detector_from_spec(spec=text)
        plain = plain_spec(spec) if type(spec) is DetectorSpec else None
        if spec is None or (plain and ":" in plain.name):
            return plain
        expected = "None or a DetectorSpec whose name has a colon"
        raise PluginError(f"{self} made {spec!r:.80} of {text!r}, expected {expected}")

    def custom_specs(self) -> list[Spec]:
        """Return its environments and anomalies, each with its name."""
        from oodd_eval.data.offers import with_intermittent  # noqa: PLC0415
        from oodd_eval.data.registry import AnomalySpec, EnvironmentSpec  # noqa: PLC0415

        environments = self.listed("oodd_environments", EnvironmentSpec)
        specs = with_intermittent([*environments, *self.listed("oodd_anomalies", AnomalySpec)])
        return [replace(spec, plugin=self.point.name) for spec in specs]

    def listed(self, hook: str, kind: type[_Spec]) -> list[_Spec]:
        """Return what one of its hooks offers, if these are lists of one kind."""
        specs: list[_Spec] = []
        for returned in getattr(self.hook, hook)():
            specs += _list_of(returned, kind, f"{hook} of {self}")
        return specs


class Plugins:
    """The installed plug-ins, loaded as far as they were needed; made by `discover`.

    `loaded` holds the working ones by name, `broken` those that failed, in the order in which they
    did, `observer_points` the entry points of plug-ins that observe runs, and `notes` a sentence on
    other distributions with broken metadata.
    """

    def __init__(
        self,
        points: list[EntryPoint],
        observer_points: list[EntryPoint],
        load: Callable[[EntryPoint], Plugin] | None = None,
        packages: Sequence[Path] = (),
    ) -> None:
        self.loaded: dict[str, Plugin] = {}
        self.broken: list[Broken] = []
        self.notes: list[str] = []
        self.points, self.observer_points = points, observer_points
        self._load_point, self._waiting = load or loaded_plugin, list(points)
        self._observed, self._packages = load is None, tuple(packages)
        self._offers: dict[str, Offer] = {}
        self._forms: dict[str, str] = {}
        self._claims: dict[str, list[str]] = {}  # names of what broken plug-ins offer
        self._listener: Callable[[Broken], object] | None = None

    @property
    def names(self) -> set[str]:
        """Names of all plug-ins, loaded or not."""
        return {point.name for point in (*self.points, *self.observer_points)}

    @property
    def observing(self) -> list[EntryPoint]:
        """Entry points of plug-ins that may observe a run: none that only a sandbox loads."""
        loaded = [plugin.point for plugin in self.loaded.values()]
        return [*loaded, *self.observer_points] if self._observed else []

    @property
    def custom_specs(self) -> OfferedSpecs:
        """Environments and anomalies of plug-ins, and what names mean; all are loaded."""
        from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS  # noqa: PLC0415
        from oodd_eval.data.offers import OfferedSpecs, check_spec  # noqa: PLC0415

        specs = tuple(s for s, _ in self._offered(lambda p: p.custom_specs(), check_spec))
        names = ((n, b) for b in self.broken for n in (b.plugin, *self._claims.get(b.plugin, ())))
        reasons = {n: f"{b.plugin!r} of {b.distribution}: {b.reason}" for n, b in names}
        ours = {*ENVIRONMENTS, *ANOMALIES}
        return OfferedSpecs(specs, {n: why for n, why in reasons.items() if n not in ours})

    def origin(self, plugin: str) -> str:
        """Return what messages call a loaded plug-in."""
        return name_of(self.loaded[plugin].point)

    def offered_by(
        self, hook: str, kind: type[_Spec], check: _Check, taken: Collection[str] = ()
    ) -> list[_Spec]:
        """Return what a hook of plug-ins offers; all are loaded.

        What shares its name, or has one that is `taken`, is named ``PLUGIN/NAME``. A plug-in is
        broken when `check` raises for something that it offers.
        """
        offered = self._offered(lambda plugin: plugin.listed(hook, kind), check)
        names = Counter([*taken, *(spec.name for spec, _ in offered)])
        return [
            replace(spec, name=f"{plugin}/{spec.name}") if names[spec.name] > 1 else spec
            for spec, plugin in offered
        ]

    @property
    def offers(self) -> dict[str, Offer]:
        """All detectors by name, sorted; every plug-in is loaded for that."""
        for point in list(self._waiting):
            self._load(point)
        return dict(sorted(self._offers.items()))

    def add(self, offer: Offer) -> None:
        """Offer a detector that is no plug-in's."""
        self._offers[offer.spec.name] = offer

    def offer(self, name: str) -> Offer:
        """Return the offered detector of this name; one with a colon is made when first named.

        Plug-ins are loaded until one offers it: those of this distribution, whose names no other
        one can take, then the one of the same name, then the others. Raises `UnknownNameError` when
        none offers it, and `UsageError` when it has a colon and none can make a detector of it.
        """
        if name not in self._offers and ":" in name:
            offer = self._from_spec(name)
            return self._offers.setdefault(offer.spec.name, offer)
        for point in sorted(self._waiting, key=lambda p: (_foreign(p), p.name != name)):
            if name not in self._offers:
                self._load(point)
        check_known("detector", self._offers, name)
        return self._offers[name]

    def taking_actions(
        self, offer: Offer, parameters: Mapping[str, Any], selected: Collection[str] = ()
    ) -> tuple[Offer, dict[str, Any]]:
        """Return what runs where episodes have actions when a detector is named, with parameters.

        It is the detector that its spec names as `with_actions`, unless that is `selected`, too, or
        the parameter ``actions`` is ``"no"``. `UsageError`: a parameter is wrong.
        """
        spec, values = offer.spec, dict(parameters)
        name = spec.with_actions
        if not offer.plugin or not name or name in selected or values.get(ACTIONS) == "no":
            return offer, values
        resolve_parameters(spec.name, spec.parameters, values, others=spec.other_parameters)
        values.pop(ACTIONS, None)
        return self.offer(name), values

    def select(self, patterns: str, columns: Collection[str] = ()) -> list[str]:
        """Return the names of the detectors that a comma list of names and globs selects.

        A glob behind a colon, such as ``column:*_innov``, stands for all `columns` that it matches.
        """
        listed = (part.strip() for part in patterns.split(","))
        parts = [name for part in listed for name in _of_columns(part, columns)]
        several = [p for p in parts if p == "all" or (":" not in p and set(p) & set("*?["))]
        exact = {p: self.offer(p).spec.name for p in parts if p and p not in several}
        offers = self.offers if several else self._offers
        return select("detector", ",".join(exact.get(part, part) for part in parts), offers)

    def spec_forms(self) -> list[tuple[str, str, str]]:
        """Return who makes detectors of names with a colon: plug-in, origin, and which names."""
        return [
            (maker.point.name, " ".join(named(maker.point.dist)), form)
            for maker, form in self._makers()
        ]

    def report_broken_to(self, listener: Callable[[Broken], object]) -> None:
        """Call a function with every broken plug-in: with those found so far, and later ones."""
        self._listener = listener
        for broken in self.broken:
            listener(broken)

    @contextmanager
    def blaming(self, point: EntryPoint, doing: str = "") -> Iterator[None]:
        """Note the plug-in as broken when the block raises anything, and go on after the block.

        The working directory, to which results may be relative, is then what it was.
        """
        try:
            with staying():
                yield
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # noqa: BLE001  foreign code may raise anything
            reason = printable(doing + describe(error))
            self.broken.append(Broken(point.name, distribution_of(point), reason))
            if self._listener:
                self._listener(self.broken[-1])

    def _offered(
        self, of: Callable[[Plugin], list[_Spec]], check: _Check
    ) -> list[tuple[_Spec, str]]:
        """Return what all plug-ins offer, checked, with the name of the plug-in."""
        for point in list(self._waiting):
            self._load(point)
        offered: list[tuple[_Spec, str]] = []
        for plugin in list(self.loaded.values()):
            with self.blaming(plugin.point):
                specs = of(plugin)
                names = self._claims[plugin.point.name] = [spec.name for spec in specs]
                for i, spec in enumerate(specs):
                    check(spec)
                    if spec.name in names[:i]:
                        raise PluginError(f"{spec.name!r} is offered twice by {plugin}")
                offered += [(spec, plugin.point.name) for spec in specs]
                del self._claims[plugin.point.name]
        return offered

    def _load(self, point: EntryPoint) -> None:
        """Load an entry point: afterwards all that it offers is there, or it is broken."""
        self._waiting.remove(point)
        with self.blaming(point):
            if other := self.loaded.get(point.name):
                owner = distribution_of(other.point)
                raise PluginError(f"{owner} has a plug-in of the same name: uninstall one of them")
            plugin = self._load_point(point)
            offers: dict[str, Offer] = {}
            for spec in plugin.specs():
                if previous := self._offers.get(spec.name) or offers.get(spec.name):
                    by = f"plug-in {previous.plugin!r} of {previous.distribution}"
                    by = f"{by} and by {name_of(point)}"
                    advice = f"uninstall one of them, or leave it out with -p no:{point.name}"
                    raise PluginError(f"detector {spec.name!r} is offered twice, by {by}: {advice}")
                offers[spec.name] = self._offer(point, spec)
            self._forms[point.name] = plugin.form
            self._offers |= offers
            self.loaded[point.name] = plugin

    def _makers(self) -> Iterator[tuple[Plugin, str]]:
        """Yield plug-ins that make detectors of names with a colon, this distribution's first."""
        # Each comes with the names that it knows.
        for point in self.points:
            if point in self._waiting:
                self._load(point)
            plugin = self.loaded.get(point.name)
            if plugin and plugin.point is point and (form := self._forms[point.name]):
                yield plugin, form

    def _from_spec(self, text: str) -> Offer:
        """Ask one plug-in after the other; a failure is told as that plug-in's."""
        asked = []
        for maker, _ in self._makers():
            try:
                with staying():
                    spec = maker.from_spec(text)
            except (OoddError, KeyboardInterrupt):
                raise
            except BaseException as error:
                reason = f"failed to make detector {text!r}: {printable(describe(error))}"
                raise PluginError(f"{name_of(maker.point)} {reason}") from error
            if spec:
                return self._offer(maker.point, spec)
            asked.append(maker.point.name)
        whom = f"asked {', '.join(asked)}" if asked else "none that is loaded knows such names"
        advice = "oodd-eval list detectors says which names there are"
        raise UsageError(f"no plug-in makes a detector of {text!r}: {whom} ({advice})")

    def _offer(self, point: EntryPoint, spec: DetectorSpec) -> Offer:
        """Return a spec as an offer; its version names the library that does the work, too."""
        version = "+".join(filter(None, (named(point.dist)[1], spec.version)))
        distribution = distribution_of(point)
        return Offer(spec, point.name, point.module, distribution, version, self._packages)


def _of_columns(text: str, columns: Collection[str]) -> list[str]:
    """Return what a name with a glob behind a colon stands for; itself for any other name."""
    match = re.fullmatch(r"([a-z]+:-?(?:\||abs\()?)([^|)]*[*?][^|)]*)([|)]?)", text)
    if not match:
        return [text]
    # Columns are often called NAME[0], NAME[1]: brackets are none of a glob.
    names = fnmatch.filter(columns, match[2].replace("[", "[[]"))
    check_known(f"column for {text!r}", columns, *(names or [match[2]]))
    return [match[1] + name + match[3] for name in names]


def discover(
    disabled: Collection[str] = (),
    *,
    only: Collection[str] | None = None,
    load: Callable[[EntryPoint], Plugin] | None = None,
    packages: Sequence[Path] = (),
) -> Plugins:
    """Find the installed plug-ins, without loading any; those `disabled` are left out.

    `only` names those to take, beside the built-in rows. None means all, or those that the
    environment variable ``OODD_EVAL_PLUGINS`` names. `load` is used in place of importing them.
    With directories of `packages`, plug-ins are those installed there, and no others.
    """
    every, broken = points_of((hooks.PROJECT, "oodd_eval.observers"), packages)
    points, observers = (
        sorted(group, key=lambda p: (_foreign(p), distribution_of(p), p.name)) for group in every
    )
    names = {point.name for point in (*points, *observers)}
    if only is None and not packages and RESTRICT in os.environ:
        only = [name.strip() for name in os.environ[RESTRICT].split(",") if name.strip()]
    check_known("plug-in", names, *disabled, *(only or ()))

    def selected(point: EntryPoint) -> bool:
        built_in = point.name == _BUILT_IN and not _foreign(point)
        return point.name not in disabled and (only is None or built_in or point.name in only)

    plugins = Plugins([*filter(selected, points)], [*filter(selected, observers)], load, packages)
    plugins.broken += [Broken("unknown", b.distribution, b.reason) for b in broken if b.is_ours]
    if not_ours := [b for b in broken if not b.is_ours]:
        more = f", and {len(not_ours) - 1} more" if not_ours[1:] else ""
        plugins.notes.append(f"passed over {not_ours[0].distribution}{more}: {not_ours[0].reason}")
    return plugins


def loaded_plugin(point: EntryPoint) -> Plugin:
    """Return the plug-in of an entry point, whatever it raises when it is loaded."""
    return Plugin(point, register(point.load()))


def name_of(point: EntryPoint) -> str:
    """Return what messages call a plug-in."""
    return f"plug-in {point.name!r} of {distribution_of(point)}"


def register(plugin: object, *specifications: ModuleType) -> pluggy.HookRelay:
    """Return the hooks of one plug-in, which may be those for detectors and those specified.

    Raises `UnknownNameError` for an unknown hook, `PluginValidationError` for such an argument.
    """
    manager = pluggy.PluginManager(hooks.PROJECT)
    for specification in (hooks, *specifications):
        manager.add_hookspecs(specification)
    manager.register(plugin)
    names = {*hooks.OFFER_HOOKS, *hooks.OBSERVER_HOOKS}
    check_known("hook", names, *(caller.name for caller in manager.get_hookcallers(plugin) or ()))
    return manager.hook


def offer_of(plugin: str, detector: str, packages: Sequence[Path] = ()) -> Offer:
    """Return a detector of a plug-in; raise `PluginError` when the plug-in cannot be loaded."""
    plugins = discover(only=[plugin], packages=packages)
    try:
        return plugins.offer(detector)
    except UnknownNameError:
        for broken in plugins.broken:
            reason = f"plug-in {broken.plugin!r} cannot be loaded: {broken.reason}"
            raise PluginError(reason) from None
        raise


def _list_of(returned: object, kind: type[_Spec], hook: str) -> list[_Spec]:
    """Return what a hook returned, if it is a list of specs of one kind: of no class of its own."""
    if type(returned) is not list or not all(type(spec) is kind for spec in returned):
        expected = f"a list of {kind.__module__.partition('.')[0]}.{kind.__name__}"
        raise PluginError(f"{hook} returned {returned!r:.80}, expected {expected}")
    if len(returned) > MOST_SPECS:
        raise PluginError(f"{hook} returned {len(returned)}, expected at most {MOST_SPECS}")
    for spec in returned:
        if type(spec.name) is not str:
            raise PluginError(f"name of a {kind.__name__} is {spec.name!r:.80}, expected a text")
    return returned


def describe(error: BaseException) -> str:
    """Return an exception in one line: its type and its message."""
    kind = type.__dict__["__name__"].__get__(type(error))  # its metaclass may say otherwise
    try:
        message = " ".join(str.split(str(error)))
    except KeyboardInterrupt:
        raise
    except BaseException:  # noqa: BLE001  foreign exceptions may fail to say what they are
        message = "(no message)"
    return f"{kind}: {message}" if message else str(kind)


def printable(reason: str) -> str:
    """Return a line of a foreign process as one that every terminal, file and table takes."""
    if len(reason) > LONGEST_REASON:
        half = LONGEST_REASON // 2 - 3
        reason = f"{reason[:half]} ... {reason[-half:]}"
    # Halves of surrogate pairs, which no file takes, are not printable either.
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in reason)


def _foreign(point: EntryPoint) -> bool:
    return distribution_of(point) != "oodd-eval"


def distribution_of(point: EntryPoint) -> str:
    """Return the name of the distribution that pip installed."""
    return named(point.dist)[0]
