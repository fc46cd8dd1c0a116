"""``oodd-eval list``: one line each, the name first."""

import argparse
from collections.abc import Iterable
from dataclasses import asdict
from typing import TypeVar

from tabulate import tabulate

from oodd_eval.cli import Parser
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, SPLITS
from oodd_eval.data.own import AnomalySpec, EnvironmentSpec
from oodd_eval.errors import UnknownNameError
from oodd_eval.metrics.catalogue import ATTRIBUTION, GUARANTEED, LEVELS, METRICS, metric_info
from oodd_eval.plugins.discovery import Plugins, discover

T = TypeVar("T")
Rows = Iterable[tuple[str, ...]]


def define(parser: Parser) -> None:
    """Add the options."""
    add = parser.options(run, "list detectors", "list metrics", plugins=True)
    add("what", metavar="detectors|envs|anomalies|splits|metrics")


def run(options: argparse.Namespace) -> int:
    """Carry out ``oodd-eval list``; 1 when a plug-in is broken."""
    rows: Rows
    code = 0
    match options.what:
        case "detectors":
            plugins = discover(options.disabled)
            rows = list(_detectors(plugins))
            code = int(bool(plugins.broken))
        case "envs":
            rows = [
                (e.id, e.simulator, f"{e.observation_dim} sensors, {e.policy} policy")
                for e in ENVIRONMENTS.values()
            ]
            rows += [
                (s.name, origin, f"{len(s.sensors)} sensors, its own policy")
                for s, origin in _own(options, EnvironmentSpec)
            ]
        case "anomalies":
            rows = [(a.id, a.group, a.summary) for a in ANOMALIES.values()]
            rows += [
                (s.name, s.group, f"{s.summary} ({origin})")
                for s, origin in _own(options, AnomalySpec)
            ]
        case "splits":
            rows = _splits()
        case "metrics":
            rows = _metrics()
        case _:
            kinds = "detectors", "envs", "anomalies", "splits", "metrics"
            raise UnknownNameError("thing to list", options.what, kinds)
    print(tabulate(rows, tablefmt="plain", disable_numparse=True))
    return code


def _own(options: argparse.Namespace, kind: type[T]) -> Iterable[tuple[T, str]]:
    """Yield the environments, or the anomalies, of plug-ins with their origin."""
    for spec, origin in discover(options.disabled).own_specs.values():
        if isinstance(spec, kind):
            yield spec, origin


def _detectors(plugins: Plugins) -> Rows:
    for name, offer in plugins.offers.items():
        why = offer.unavailable()
        yield name, offer.origin, (f"[unavailable: {why}] " if why else "") + offer.spec.summary
    for name, origin, forms in plugins.spec_forms():
        yield f"({name})", origin, forms
    yield from ((b.plugin, b.distribution, f"[broken plug-in] {b.reason}") for b in plugins.broken)


def _splits() -> Rows:
    # Listing is quick: these need numpy.
    from oodd_eval.data.layout import part_sizes, read_manifest
    from oodd_eval.data.split import split_directories

    here = split_directories()
    for name in dict.fromkeys([*SPLITS, *here]):
        if name in here:
            manifest = read_manifest(here[name])
            sizes, digest = part_sizes(manifest), manifest["digest"][:12]
            where = f"{len(manifest['environments'])} environments, digest {digest}"
        else:
            sizes, where = asdict(SPLITS[name]), f"not here: oodd-eval data build {name}"
        text = "{train} train, {calibration} calibration, {test} test seeds"
        further = {"ladder": ", graded", "paper": ", the paper's losses"}
        recipe = SPLITS.get(name)
        noise = f", noise {recipe.noise:.0%}" if recipe and recipe.noise else ""
        suite = further.get(recipe.suite, "") if recipe else ""
        yield name, text.format_map(sizes) + suite + noise, where


def _metrics() -> Rows:
    yield from ((name, info.summary) for name, info in METRICS.items())
    for suffix, level in LEVELS.items():
        at = f"guaranteed alarms, in at most {100 * level:g} % of nominal episodes"
        yield f"..._{suffix}", f"{', '.join(GUARANTEED)}: {at}"
        yield f"threshold_{suffix}", "the threshold of their statistic"
    yield from ((name, metric_info(name).summary) for name in ATTRIBUTION)
