"""``oodd-eval info``: describe a detector, an environment, an anomaly, a split or a metric."""

import json
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import Any, Final

import click
from tabulate import tabulate

from oodd_eval.cli import Name, Options, command, load
from oodd_eval.cli.listing import KINDS, rows
from oodd_eval.cli.plugins import discovered
from oodd_eval.data.condition import read_ladder, rungs_of
from oodd_eval.data.facts import (
    ANOMALIES,
    ENVIRONMENTS,
    SPLITS,
    TABLE1,
    AnomalyInfo,
    EnvironmentInfo,
    Quantity,
)
from oodd_eval.data.layout import log_facts
from oodd_eval.data.registry import AnomalySpec, Spec
from oodd_eval.data.split import Split, imported_environments, split_directories
from oodd_eval.errors import UnknownNameError, UsageError, near
from oodd_eval.metrics.catalogue import INTERVENTIONS, NAMES, MetricInfo, metric_info
from oodd_eval.names import counted
from oodd_eval.plugins.contract import Alarm
from oodd_eval.plugins.discovery import Offer
from oodd_eval.plugins.parameters import parameters_of

Lines = Iterator[tuple[str, str]]

SCREEN: Final = 40  # lines, without --wide


@command("info pe", "info hopper", "info gravity", "info mini", "info auc_matched", plugins=True)
@click.argument(
    "name", type=Name(*KINDS), metavar="NAME", help="of a detector, environment, anomaly, ..."
)
@click.option("--wide", is_flag=True, help="print all there is, which may take several screens")
def info(options: Options) -> int:
    """Describe one detector, environment, anomaly, split or metric, on one screen."""
    name = options.name
    if name in ENVIRONMENTS:
        lines = _environment(ENVIRONMENTS[name])
    elif name in ANOMALIES:
        lines = _anomaly(ANOMALIES[name])
    elif name in (*NAMES, *INTERVENTIONS):
        lines = _metric(name)
    else:
        plugins = discovered(options)
        custom = plugins.custom_specs
        imported = {env: (split, entry) for env, split, entry in imported_environments()}
        try:
            meanings = [] if name in plugins.offers else custom.meanings(name)
            parts = [_custom(spec, plugins.origin(spec.plugin)) for spec in meanings]
            parts += [_imported(name, *imported[name])] if name in imported else []
            if parts:  # logs may have a plug-in's name
                lines = chain(*parts)
            elif options.wide and name in split_directories():
                described: int = load("oodd_eval.cli.data:info").handler(options)
                return described
            elif row := next((r for r in rows("splits", plugins) if r[0] == name), None):
                lines = _split(*row)
            else:
                lines = _detector(plugins.offer(name))
        except UnknownNameError:
            names = [*ENVIRONMENTS, *ANOMALIES, *(spec.name for spec in custom.specs)]
            names += [*imported, *plugins.offers, *SPLITS, *split_directories()]
            names += [*NAMES, *INTERVENTIONS]
            close = near(name, names)
            meant = f": did you mean {' or '.join(map(repr, close))}?" if close else ":"
            kinds = "detector, environment, anomaly, split or metric"
            raise UsageError(
                f"unknown {kinds} {name!r}{meant} `oodd-eval list KIND` has all names of a kind"
            ) from None
    text = tabulate(lines, tablefmt="plain", disable_numparse=True).splitlines()
    if len(text) > SCREEN and not options.wide:
        text[SCREEN - 1 :] = [f"{len(text) - SCREEN + 1} more lines: oodd-eval info {name} --wide"]
    print("\n".join(text))
    return 0


def _split(name: str, sizes: str, state: str) -> Lines:
    yield from (("split", name), ("trajectories", sizes), ("state", state))
    if path := split_directories().get(name):
        split = Split(path)
        entries = split.manifest["environments"].items()
        yield from _wrapped("sensors", (f"{key} {len(entry['sensors'])}" for key, entry in entries))
        kinds = dict.fromkeys(condition.partition("@")[0] for condition in split.anomalies)
        yield from _wrapped("anomalies", kinds)
        yield "more", f"oodd-eval info {name} --wide"


def _environment(info: EnvironmentInfo) -> Lines:
    yield "environment", f"{info.id} ({info.title} of the paper)"
    yield "simulator", info.simulator
    yield "policy", f"{info.policy}, mean return {info.paper_return:g} in the paper"
    yield "longest episode", counted(info.episode_cap, "step(s)")
    yield from _columns("sensor(s)", info.sensors)
    yield from _columns("discrete action(s)" if info.discrete else "action(s)", info.actions)


def _columns(noun: str, columns: Sequence[Quantity]) -> Lines:
    """Yield names with units, and before the first one how many there are."""
    return _wrapped(counted(len(columns), noun), [f"{c.name} ({c.unit})" for c in columns])


def _wrapped(heading: str, words: Iterable[str]) -> Lines:
    """Yield a heading with the words behind it in lines that break between two words."""
    text = ", ".join(word.replace(" ", "\u00a0") for word in words)
    for i, line in enumerate(textwrap.wrap(text, 80, break_on_hyphens=False)):
        yield "" if i else heading, line.replace("\u00a0", " ")


def _custom(spec: Spec, origin: str) -> Lines:
    if isinstance(spec, AnomalySpec):
        yield "anomaly", f"{spec.name}, {origin}"
        yield "group", spec.group
        yield "what it changes", spec.summary
        yield "strength", f"0 to {spec.bound:g}; 1 is: {spec.unit}"
        yield "environments", ", ".join(spec.environments) or "any"
        return
    yield "environment", f"{spec.name} ({spec.title or spec.name}), {origin}"
    yield "longest episode", counted(spec.episode_cap, "step(s)")
    yield from _columns("sensor(s)", spec.sensors)
    yield from _columns("action(s)", spec.actions)
    yield "attributes", ", ".join(spec.attributes) or "none"


def _imported(name: str, split: str, entry: Mapping[str, Any]) -> Lines:
    facts = log_facts(entry)
    yield "environment", f"{name}, imported from logs into split {split}"
    for key in ("source", "licence", "citation"):
        if text := getattr(facts, key):
            yield key, text
    for part, group in entry["groups"].items():
        yield part, counted(group["trajectories"], "episode(s)")
    sensors, actions = ([*map(Quantity.read, entry[kind])] for kind in ("sensors", "actions"))
    yield from _columns("sensor(s)", [column for column in sensors if column.role != "score"])
    yield from _columns("score(s)", [column for column in sensors if column.role == "score"])
    yield from _columns("action(s)", actions)
    yield "more", f"oodd-eval data info {split}"


def _anomaly(info: AnomalyInfo) -> Lines:
    unit_of, bound_of = (load(f"oodd_recording.values:{name}") for name in ("unit_of", "bound_of"))
    yield "anomaly", f"{info.id} ({info.title}{' of the paper' * (info.id in TABLE1)})"
    yield "group", info.group
    yield "what it changes", info.summary
    for environment in ENVIRONMENTS:
        strengths = f"0 to {bound_of(environment, info.id):g}, not calibrated"
        if info.id in read_ladder().get(environment, {}):
            rungs = rungs_of(environment, info.id)
            ends = dict.fromkeys(("kept99", [*rungs][-1]))
            strengths = " to ".join(f"{rungs[name].strength:.3g} ({name})" for name in ends)
        yield f"strength in {environment}", f"{strengths}: {unit_of(environment, info.id)}"


_UNITS: Final = {"percent": "a share, printed in percent", "steps": "steps", "rate": "a number"}
_CELLS: Final = {"paired": "with twins", "unpaired": "without twins", "": "with and without twins"}


def _facts(name: str) -> MetricInfo:
    return INTERVENTIONS.get(name) or metric_info(name)


def _metric(name: str) -> Lines:
    info = _facts(name)
    low, high = info.range
    yield "metric", f"{info.name} ({info.title})"
    yield "what it says", info.summary
    yield "unit", f"{_UNITS[info.unit]}, from {low:g} to {high:g}"
    yield "better side", f"{info.better or 'neither'} is better"
    if info.level:
        yield "alarms", f"guaranteed, in at most {info.level} of nominal episodes"
    if info.null:
        yield "by chance", f"{info.null}: {_facts(info.null).summary}"
    yield "cells", "of interventions" if info.name in INTERVENTIONS else _CELLS[info.cells]
    if info.request:
        yield "computed", "when asked for (--row-metrics)"
    yield "more", "docs/metrics.md"


_ALARMS: Final[Mapping[Alarm, str]] = {
    "cusum": "CUSUM of the score",
    "score": "the score itself",
    "column": "the recorded number itself",
    "flag": "where it is 1, at every level: it promises nothing",
}


def _detector(offer: Offer) -> Lines:
    spec = offer.spec
    yield "detector", f"{spec.name}, {offer.origin}"
    yield "summary", spec.summary
    if why := offer.unavailable():
        yield "unavailable", why
    yield "source", spec.reference or "not given"
    yield "looks at", ", ".join(spec.columns) or spec.inputs.replace("+", " and ")
    if spec.with_actions:
        yield "with actions", f"{spec.with_actions} runs in its place, unless actions is no"
    yield "alarm", _ALARMS[spec.alarm]
    further = f"{spec.training} (boards do not rank it)"
    yield "trained on", "nominal trajectories" if spec.training == "nominal" else further
    yield "seed", "changes nothing" if spec.deterministic else "decides random draws"
    for i, (name, parameter) in enumerate(parameters_of(spec.parameters).items()):
        default = f"{name} = {json.dumps(parameter.default, default=str)}"
        yield "" if i else "parameters", f"{default}  {parameter.help}".rstrip()
    if spec.other_parameters:
        yield "", "and any others"
