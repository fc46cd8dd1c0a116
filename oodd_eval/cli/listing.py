"""``oodd-eval list``: one line each, the name first."""

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict
from typing import Final, TypeVar

import click
from tabulate import tabulate

from oodd_eval.cli import Options, command, say_notes
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, SPLITS
from oodd_eval.data.registry import AnomalySpec, EnvironmentSpec, long_name
from oodd_eval.metrics.catalogue import (
    ATTRIBUTION,
    GUARANTEED,
    INTERVENTIONS,
    LEVELS,
    METRICS,
    RANKING,
    metric_info,
)
from oodd_eval.names import check_known, counted
from oodd_eval.plugins.contract import training_mark
from oodd_eval.plugins.discovery import Offer, Plugins, discover

T = TypeVar("T", EnvironmentSpec, AnomalySpec)
Rows = Iterable[tuple[str, ...]]

KINDS: Final = ("detectors", "envs", "anomalies", "splits", "metrics")
_SYNONYMS: Final = {"environments": "envs", "kinds": "anomalies"}


@command("list detectors", "list metrics", plugins=True)
@click.argument("kind", metavar="|".join(KINDS), shell_complete=click.Choice(KINDS).shell_complete)
def list_names(options: Options) -> int:
    """List what there is, one line each, the name first.

    The exit code is 1 when a plug-in is broken.
    """
    kind = _SYNONYMS.get(options.kind, options.kind)
    check_known("thing to list", (*KINDS, *_SYNONYMS), kind)
    plugins = discover(options.disabled)
    if kind == "detectors":
        say_notes(plugins.notes)
    print(tabulate(rows(kind, plugins), tablefmt="plain", disable_numparse=True))
    return int(kind in KINDS[:3] and bool(plugins.broken))


def rows(kind: str, plugins: Plugins) -> Rows:
    """Yield a row for each name of one of `KINDS`: the name, and what describes it."""
    match kind:
        case "detectors":
            yield from _detectors(plugins)
        case "envs":
            for e in ENVIRONMENTS.values():
                yield e.id, e.simulator, f"{e.observation_dim} sensors, {e.policy} policy"
            for env, name, origin in _custom(plugins, EnvironmentSpec):
                yield name, origin, f"{counted(len(env.sensors), 'sensor(s)')}, its own policy"
            yield from _imported()
        case "anomalies":
            for a in ANOMALIES.values():
                yield a.id, a.group, a.summary
            for anomaly, name, origin in _custom(plugins, AnomalySpec):
                yield name, anomaly.group, f"{anomaly.summary} ({origin})"
        case "splits":
            yield from _splits()
        case "metrics":
            yield from _metrics()
    for broken in plugins.broken if kind in KINDS[:3] else ():
        yield broken.plugin, broken.distribution, f"[broken plug-in] {broken.reason}"


def _custom(plugins: Plugins, kind: type[T]) -> Iterable[tuple[T, str, str]]:
    """Yield the environments, or the anomalies, of plug-ins with their name and origin."""
    specs = [spec for spec in plugins.custom_specs.specs if isinstance(spec, kind)]
    names = Counter(spec.name for spec in specs)
    for spec in specs:
        name = spec.name if names[spec.name] == 1 else long_name(spec)
        yield spec, name, plugins.origin(spec.plugin)


def _imported() -> Rows:
    """Yield the environments of logs in the splits that are at hand."""
    from oodd_eval.data.split import imported_environments

    for name, split, entry in imported_environments():
        sensors = [column for column in entry["sensors"] if column.get("role") != "score"]
        yield name, f"split {split}", f"{counted(len(sensors), 'sensor(s)')}, imported from logs"


def _detectors(plugins: Plugins) -> Rows:
    for name, offer in sorted(plugins.offers.items(), key=_group):
        why = offer.unavailable()
        marks = f"[unavailable: {why}] " if why else ""
        mark = training_mark(offer.spec.training)
        marks += f"[{mark}] " if mark else ""
        yield name, _origin(offer), marks + offer.spec.summary
    for name, origin, forms in plugins.spec_forms():
        yield f"({name})", origin, forms


def _group(entry: tuple[str, Offer]) -> tuple[object, ...]:
    """Return by which detectors are sorted: plug-ins, methods of papers, trivial rows, others."""
    (name, offer), training = entry, entry[1].spec.training
    origin = _origin(offer)
    return origin != offer.origin, training != "nominal", origin == "trivial", origin, name


def _origin(offer: Offer) -> str:
    """Return the distribution of a detector, or the paper that a shipped one is after."""
    if offer.distribution != "oodd-eval":
        return offer.origin
    source = re.search(r"([A-Z][\w-]+).*?\((\d{4})\)", offer.spec.reference)
    return f"after {' '.join(source.groups())}" if source else "trivial"


def _splits() -> Rows:
    # Listing is quick: these need numpy.
    from oodd_eval.data.layout import part_sizes, read_manifest
    from oodd_eval.data.split import split_directories

    here = split_directories()
    for name in dict.fromkeys([*SPLITS, *here]):
        if name in here:
            manifest = read_manifest(here[name])
            sizes, digest = part_sizes(manifest), manifest["digest"][:12]
            state = f"{counted(len(manifest['environments']), 'environment(s)')}, digest {digest}"
        else:
            sizes, state = asdict(SPLITS[name]), f"not here: oodd-eval data build {name}"
        text = "{train} train, {calibration} calibration, {test} test seeds"
        further = {"ladder": ", graded", "paper": ", the paper's losses"}
        recipe = SPLITS.get(name)
        noise = f", noise {recipe.noise:.0%}" if recipe and recipe.noise else ""
        suite = further.get(recipe.suite, "") if recipe else ""
        yield name, text.format_map(sizes) + suite + noise, state


_FIRST: Final = (RANKING, "found_within_20_at_5pct", "missed_at_5pct", "false_episodes_at_5pct")
"""Metrics of the table that a run ends with, in its order."""


def _metrics() -> Rows:
    yield from ((n, metric_info(n).summary) for n in dict.fromkeys([*_FIRST, *METRICS]))
    for suffix, level in LEVELS.items():
        at = f"guaranteed alarms, in at most {100 * level:g} % of nominal episodes"
        yield f"..._{suffix}", f"{', '.join(GUARANTEED)}: {at}"
        yield f"threshold_{suffix}", "the threshold of their statistic"
    yield from ((name, metric_info(name).meaning) for name in ATTRIBUTION)
    yield from ((name, f"intervene: {info.summary}") for name, info in INTERVENTIONS.items())
