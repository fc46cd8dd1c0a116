"""``oodd-eval info``: describe a detector, an environment, an anomaly, a split or a metric."""

import json
from collections.abc import Iterator, Mapping, Sequence
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
from oodd_eval.data.split import imported_environments, split_directories
from oodd_eval.errors import UnknownNameError, UsageError, near
from oodd_eval.metrics.catalogue import NAMES, MetricInfo, metric_info
from oodd_eval.names import counted
from oodd_eval.plugins.contract import Alarm, Training
from oodd_eval.plugins.discovery import Offer
from oodd_eval.plugins.parameters import parameters_of

Lines = Iterator[tuple[str, str]]


@command("info pe", "info hopper", "info gravity", "info mini", "info auc_matched", plugins=True)
@click.argument(
    "name", type=Name(*KINDS), metavar="NAME", help="of a detector, environment, anomaly, ..."
)
def info(options: Options) -> int:
    """Print all there is to know of one detector, environment, anomaly, split or metric."""
    name = options.name
    if name in ENVIRONMENTS:
        lines = _environment(ENVIRONMENTS[name])
    elif name in ANOMALIES:
        lines = _anomaly(ANOMALIES[name])
    elif name in NAMES:
        lines = _metric(metric_info(name))
    else:
        plugins = discovered(options)
        custom = plugins.custom_specs
        imported = {env: (split, entry) for env, split, entry in imported_environments()}
        try:
            if name in custom and name in imported:  # logs may have a plug-in's name
                lines = chain(_custom(*custom[name]), _imported(name, *imported[name]))
            elif name in custom:
                lines = _custom(*custom[name])
            elif name in imported:
                lines = _imported(name, *imported[name])
            elif name in split_directories():
                described: int = load("oodd_eval.cli.data:info").handler(options)
                return described
            elif name in SPLITS:
                lines = _absent(*next(r for r in rows("splits", plugins) if r[0] == name))
            else:
                lines = _detector(plugins.offer(name))
        except UnknownNameError:
            names = [*ENVIRONMENTS, *ANOMALIES, *custom, *imported, *plugins.offers]
            names += [*SPLITS, *split_directories(), *NAMES]
            close = near(name, names)
            meant = f": did you mean {' or '.join(map(repr, close))}?" if close else ":"
            kinds = "detector, environment, anomaly, split or metric"
            raise UsageError(
                f"unknown {kinds} {name!r}{meant} `oodd-eval list KIND` has all names of a kind"
            ) from None
    print(tabulate(lines, tablefmt="plain", disable_numparse=True))
    return 0


def _absent(split: str, sizes: str, why: str) -> Lines:
    yield "split", split
    yield "trajectories", sizes
    yield "digest", f"unknown, as it is {why}"


def _environment(info: EnvironmentInfo) -> Lines:
    yield "environment", f"{info.id} ({info.title} of the paper)"
    yield "simulator", info.simulator
    yield "policy", f"{info.policy}, mean return {info.paper_return:g} in the paper"
    yield "longest episode", counted(info.episode_cap, "step(s)")
    yield from _columns("sensor(s)", info.sensors)
    yield from _columns("discrete action(s)" if info.discrete else "action(s)", info.actions)


def _columns(noun: str, columns: Sequence[Quantity]) -> Lines:
    """Yield names with units, and before the first one how many there are."""
    for i, column in enumerate(columns):
        yield "" if i else counted(len(columns), noun), f"{column.name} ({column.unit})"


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
    of_paper = " of the paper" if info.id in TABLE1 else ""
    yield "anomaly", f"{info.id} ({info.title}{of_paper})"
    yield "group", info.group
    yield "what it changes", info.summary
    for environment in ENVIRONMENTS:
        if info.id not in read_ladder().get(environment, {}):
            bound, unit = bound_of(environment, info.id), unit_of(environment, info.id)
            yield f"strength in {environment}", f"0 to {bound:g} ({unit}): not calibrated"
            continue
        rungs = rungs_of(environment, info.id)
        ends = [f"{rungs[name].strength:.3g}" for name in (["kept99", [*rungs][-1]])]
        strengths, names = map(_range, (ends, ["kept99", [*rungs][-1]]))
        text = f"{strengths} ({unit_of(environment, info.id)}): {names}"
        yield f"strength in {environment}", text


def _range(ends: list[str]) -> str:
    """Return the first to the last, once where they are one."""
    return " to ".join(dict.fromkeys(ends))


_BETTER: Final = {"higher": "higher is better", "lower": "lower is better", "": "neither"}
_UNITS: Final = {"percent": "a share, printed in percent", "steps": "steps", "rate": "a number"}
_CELLS: Final = {"paired": "with twins", "unpaired": "without twins", "": "with and without twins"}


def _metric(info: MetricInfo) -> Lines:
    low, high = info.range
    yield "metric", f"{info.name} ({info.title})"
    yield "what it says", info.summary
    yield "unit", f"{_UNITS[info.unit]}, from {low:g} to {high:g}"
    yield "better side", _BETTER[info.better]
    if info.level:
        yield "alarms", f"guaranteed, in at most {info.level} of nominal episodes"
    if info.null:
        yield "by chance", f"{info.null}: {metric_info(info.null).summary}"
    yield "cells", _CELLS[info.cells]
    if info.request:
        yield "computed", "when asked for (--row-metrics)"
    yield "more", "docs/metrics.md"


_TRAINING: Final[Mapping[Training, str]] = {
    "nominal": "the nominal trajectories of a split",
    "simulation": "simulation: nominal episodes of its own besides (boards do not rank it)",
    "anomalies": "anomalies (boards do not rank it)",
    "failures": "nominal and failed training episodes (boards do not rank it)",
    "external": "external data (boards do not rank it)",
    "oracle": "nominal trajectories, with the true equations (boards do not rank it)",
}


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
    yield "trained on", _TRAINING[spec.training]
    yield "seed", "changes nothing" if spec.deterministic else "decides random draws"
    for i, (name, parameter) in enumerate(parameters_of(spec.parameters).items()):
        default = f"{name} = {json.dumps(parameter.default, default=str)}"
        yield "" if i else "parameters", f"{default}  {parameter.help}".rstrip()
    if spec.other_parameters:
        yield "", "and any others"
