"""Plug-ins described in a sandbox: the command imports none of them, and believes none.

A process in a sandbox loads the plug-ins of one distribution and says what they offer, as plain
data. A plug-in that floods, hangs, dies or tells what no plug-in says is broken, with the reason;
whatever it has changed in its process ends with that. What a name, a version or a source stands for
is never the plug-in's to say: the command reads it from the installed distribution.
"""

import os
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, NoReturn

from oodd_eval.errors import PluginError, UsageError
from oodd_eval.plugins import PROJECT, hookimpl
from oodd_eval.plugins.contract import Detector, DetectorSpec
from oodd_eval.plugins.discovery import (
    Plugin,
    Plugins,
    describe,
    discover,
    distribution_of,
    loaded_plugin,
    printable,
    register,
    staying,
)
from oodd_eval.plugins.installed import points_of
from oodd_eval.plugins.isolation import ChannelClosedError, ChannelGarbledError
from oodd_eval.plugins.isolation.child import Child, GivenUpError, Launcher, Limits
from oodd_eval.plugins.isolation.worker import connect
from oodd_eval.plugins.specs import MOST_SPECS, is_line
from oodd_leaderboard.sandbox.described_specs import description_of, spec_of
from oodd_leaderboard.sandbox.launcher import make_sandbox
from oodd_leaderboard.sandbox.metadata import check_packages

SECONDS: Final = (
    60.0  # for the plug-ins of one distribution to be imported and to say what they offer
)
_EXIT_SECONDS: Final = 2.0  # for a process that has closed its channel to end

Answer = Mapping[str, Any]


def discover_in_sandbox(
    disabled: Collection[str], launcher: Launcher, memory: int | None
) -> Plugins:
    """Find the installed plug-ins, as `discover` does; what is needed of them a sandbox loads.

    They neither observe runs nor offer environments, anomalies and readers. `memory` limits the
    bytes of a process that loads them.
    """
    return _Describer(launcher, memory, disabled=disabled).plugins


def discover_entry(packages: Path, launcher: Launcher, memory: int | None) -> Plugins:
    """Find the plug-ins in a directory of a stranger's packages, and no others.

    `launcher` is a sandbox with these packages; here metadata alone is read of them. Raises
    `PluginError` as `check_packages` does, and where they offer nothing.
    """
    check_packages(packages)
    plugins = _Describer(launcher, memory, packages=[packages]).plugins
    if not plugins.points:
        raise PluginError(f"it offers no plug-in: expected an entry point of group {PROJECT}")
    return plugins


def sandboxed_plugins(
    hidden: Sequence[str], packages: Sequence[str], memory: int | None
) -> tuple[Launcher, Plugins]:
    """Make a sandbox as `Sandbox.elsewhere` tells of it, and find the plug-ins in it."""
    launcher = make_sandbox(hidden, packages)
    if not packages:
        return launcher, discover_in_sandbox((), launcher, memory)
    return launcher, discover_entry(Path(packages[0]), launcher, memory)


class _Describer:
    """Has a sandbox load the plug-ins of a distribution, all at once, when one is needed."""

    def __init__(self, launcher: Launcher, memory: int | None, **settings: Any) -> None:
        self.plugins = discover(load=self._load, **settings)
        self._launcher, self._limits = launcher, Limits(SECONDS, memory)
        self._answers: dict[tuple[str, str], Answer] = {}

    def _load(self, point: EntryPoint) -> Plugin:
        """Return a plug-in whose hooks say what a sandbox says of it."""
        distribution = distribution_of(point)
        key = distribution, point.name
        if key not in self._answers:
            points = self.plugins.points
            names = [p.name for p in points if distribution_of(p) == distribution]
            answers = self._ask(distribution, names)
            self._answers |= {(distribution, name): answers[name] for name in names}
        answer = _unbroken(self._answers[key])
        with _wrong_form():
            form, described = answer["form"], answer["specs"]
            if not is_line(form) or len(described) > MOST_SPECS:
                raise PluginError(f"it describes {len(described)} detectors, and {form!r:.80}")
            specs = [spec_of(description, _in_a_sandbox) for description in described]

        @hookimpl
        def oodd_detectors() -> list[DetectorSpec]:
            return specs

        @hookimpl
        def oodd_detector_from_spec(spec: str) -> DetectorSpec | None:
            answer = _unbroken(self._ask(distribution, [point.name], spec)[point.name])
            if refused := answer.get("refused"):
                raise UsageError(printable(str(refused)))
            with _wrong_form():
                return None if answer["spec"] is None else spec_of(answer["spec"], _in_a_sandbox)

        hooks = SimpleNamespace(oodd_detectors=oodd_detectors)
        if form:
            oodd_detector_from_spec.__doc__ = form
            hooks.oodd_detector_from_spec = oodd_detector_from_spec
        return Plugin(point, register(hooks))

    def _ask(self, distribution: str, names: list[str], text: str = "") -> dict[str, Answer]:
        """Return the answers of plug-ins by name: nothing but a mapping is sure of each."""
        with closing(Child(__name__, self._limits, None, self._launcher)) as child:
            ending, answers = "", {}
            try:
                child.channel.send({"distribution": distribution, "plugins": names, "make": text})
                answers = child.channel.receive()
            except GivenUpError as error:
                ending = error.ending or error.reason
            except ChannelClosedError:
                ended = child.wait_for_exit(seconds=_EXIT_SECONDS)
                ending = "" if ended else "closed its pipe"
            except (ChannelGarbledError, ConnectionError):
                ending = "wrote into the pipe to the command"
            child.end()
        ending = f"the process that loads it in a sandbox {ending or child.death()}"
        every = {name: answers.get(name, {"broken": ending}) for name in names}
        nothing = {"broken": "said nothing of itself"}
        return {name: a if isinstance(a, dict) else nothing for name, a in every.items()}


def _unbroken(answer: Answer) -> Answer:
    """Return an answer, unless it tells why the plug-in is broken."""
    if "broken" in answer:
        raise PluginError(printable(str(answer["broken"])))
    return answer


@contextmanager
def _wrong_form() -> Iterator[None]:
    """Raise `PluginError` for whatever is wrong with an answer."""
    try:
        yield
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise PluginError(
            f"described itself in a wrong form: {printable(describe(error))}"
        ) from None


def _in_a_sandbox(**_: Any) -> Detector:
    raise PluginError("this detector is loaded in sandboxes alone, not in the command")


def _answer(plugin: Plugin, text: str) -> Answer:
    """Return what a plug-in offers, or what it makes of a name with a colon."""
    if not text:
        return {"form": plugin.form, "specs": [description_of(spec) for spec in plugin.specs()]}
    try:
        spec = plugin.from_spec(text)
    except UsageError as error:
        return {"refused": printable(str(error))}
    return {"spec": spec and description_of(spec)}


def _plugin_of(distribution: str, name: str, packages: Sequence[Path] = ()) -> Plugin:
    """Return a loaded plug-in, whatever it raises when it is."""
    (points,), _ = points_of((PROJECT,), packages)
    for point in points:
        if (point.name, distribution_of(point)) == (name, distribution):
            return loaded_plugin(point)
    raise PluginError(f"{distribution} is not installed in the environment of {sys.executable}")


def main(arguments: Sequence[str]) -> NoReturn:
    """Load the plug-ins of a distribution, tell what they offer, and end."""
    channel, packages = connect(arguments)
    request, answers = channel.receive(), {}
    for name in request["plugins"]:
        try:
            with staying():
                plugin = _plugin_of(request["distribution"], name, packages)
                answers[name] = _answer(plugin, request["make"])
        except BaseException as error:  # noqa: BLE001  foreign code may raise anything
            answers[name] = {"broken": printable(describe(error))}
    channel.send(answers)
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1:])
