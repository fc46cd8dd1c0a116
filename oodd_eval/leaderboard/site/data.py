"""The content of the site as plain data: boards, rows, cells, intervals, curves.

Everything that is not simple arithmetic is computed here, such as the intervals of means over all
selections of cells; the page filters, averages over cells, sorts and draws.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, Final

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, TABLE1, paper_tables
from oodd_eval.leaderboard.entry import SubmittedEntry, commands_of
from oodd_eval.leaderboard.sections import LeaderboardSection, SuiteSection
from oodd_eval.metrics import bootstrap, catalogue
from oodd_eval.metrics.bootstrap import DrawnCell
from oodd_eval.metrics.catalogue import (
    GUARANTEED,
    HEADLINE,
    LEVELS,
    METRICS,
    RANKING,
    metric_info,
)
from oodd_eval.metrics.cusum import DRIFT, THRESHOLD
from oodd_eval.results.curve_file import read_curves
from oodd_eval.results.ladder import FOUND, curve
from oodd_eval.results.record import Record
from oodd_eval.results.tables.board import Standing, contribution, grouped

_COMPARED: Final = (
    "false_episodes", "early", "delay", "delay_censored", "missed", "found_within_20",
    "found_within_100",
)  # fmt: skip
WITH_INTERVALS: Final = (
    "auc_matched", "auc_smoothed", "auc_unpaired", "auc", "delay", "delay_null", "delay_censored",
    "missed", "far", "far_twin",
    *(f"{name}_{HEADLINE}" for name in _COMPARED),
)  # fmt: skip
"""Metrics that have intervals on the site: those that comparisons are made with."""

ENTRY_FIELDS: Final = (
    "id", "title", "submitter", "created", "citation", "url", "caption",
)  # fmt: skip
"""Fields of an entry that the site shows."""

_ORDER: Final = {cell: i for i, cell in enumerate(product(ENVIRONMENTS, ANOMALIES))}

Json = dict[str, Any]
Units = Mapping[str, list[Json]]  # curves of single cells by the id of their entry

SelectedCell = tuple[str, str]  # environment and anomaly


def site_data(
    sections: Sequence[LeaderboardSection], suites: Sequence[SuiteSection] = ()
) -> tuple[Json, list[Json]]:
    """Return the data that the page needs at once, and the curves of single rows.

    A row names its place in the list of curves, which are by ``environment/anomaly``.
    """
    entries = {entry.meta.id: entry for section in sections for entry in section.entries}
    units = {i: read_curves(e.curves)["units"] for i, e in entries.items() if e.curves}
    curves: list[Json] = []
    shown = [_board(section, units, curves) for section in sections]
    names = dict.fromkeys(name for board in shown for name in board["metrics"])
    used = {*TABLE1, *(name for board in shown for name in board["anomalies"])}
    kinds = [a for a in ANOMALIES.values() if a.id in used]
    data = {
        "threshold": THRESHOLD, "drift": DRIFT, "metrics": {name: _metric(name) for name in names},
        "environments": {e.id: _fields(e, "title", "family") for e in ENVIRONMENTS.values()},
        "anomalies": {a.id: _fields(a, "title", "group", "summary") for a in kinds},
        "paper": paper_tables()["table5_groups_delta1"], "boards": shown,
        "power": [_power(section) for section in suites if section.graded],
    }  # fmt: skip
    return data, curves


def _power(section: SuiteSection) -> Json:
    """Return tables of a board of graded strengths, and each row's means along the ladder.

    Points are (strength, share of the return lost, value), the weakest strength first.
    """
    board, tables = section.board, section.tables[:2]
    by_name = {str(row): row for row in board.entries}
    rows = [by_name[line[0]] for line in tables[0].rows] if tables else []
    records = grouped(board.records, lambda r: r.setting)
    metrics = [metric_info(name) for name in (FOUND, RANKING)]
    return {
        **_fields(board, "split", "digest"),
        "tables": [_fields(table, "title", "header", "rows", "note") for table in tables],
        "metrics": [_metric(info.name) | {"chance": info.name == RANKING} for info in metrics],
        "rows": [
            {"label": str(row), "trivial": board.is_trivial(row),
             "points": [_points(records[row], info.name) for info in metrics]}
            for row in rows
        ],
    }  # fmt: skip


def _points(records: Sequence[Record], metric: str) -> list[list[float | None]]:
    return [[_short(value) for value in point] for point in curve(records, metric)]


def _fields(thing: object, *names: str) -> Json:
    return {name: getattr(thing, name) for name in names}


def _metric(name: str) -> Json:
    info = metric_info(name)
    title = info.title[0].upper() + info.title[1:]
    higher = info.better == "higher"
    return {"title": title, "meaning": info.summary, "kind": info.unit, "higher": higher}


def _board(section: LeaderboardSection, units: Units, curves: list[Json]) -> Json:
    ranks, board = section.ranks, section.ranks.board
    found = {name for r in board.records for name in r.metrics}
    # The plain ones stand there even where every cell of the board has failed.
    by_level = [f"{m}_{suffix}" for suffix in LEVELS for m in (*GUARANTEED, "threshold")]
    names = [*METRICS, *(name for name in (*by_level, *catalogue.ATTRIBUTION) if name in found)]
    have = {(r.environment, r.anomaly) for r in board.records}
    chosen = selections([c for c in product(board.environments, board.anomalies) if c in have])
    return {
        "id": section.name,
        **_fields(board, "split", "digest", "protocol", "limit"),
        "tests": board.test_seeds(),
        **_fields(board, "environments", "anomalies"),
        "metrics": names,
        "intervals": _with_intervals(names),
        "rows": [_row(section, s, names, chosen, units, curves) for s in ranks.standings],
        "comparisons": [
            [c.first, c.second, *map(_short, (c.difference, c.low, c.high, c.p_holm))]
            for c in ranks.ranking.comparisons
        ],
        "resamples": ranks.ranking.resamples,
        "wins": [[one, other, _short(rate)] for (one, other), rate in ranks.rates.items()],
    }


def _row(
    section: LeaderboardSection, standing: Standing, names: Sequence[str],
    chosen: Mapping[str, Sequence[SelectedCell]], units: Units, curves: list[Json],
) -> Json:  # fmt: skip
    row, records = standing.entry, standing.records
    source = section.sources[row]
    own = _curves(units.get(source.meta.id, []), records)
    if own:
        curves.append(own)
    in_order = sorted(records, key=lambda r: (_ORDER[r.environment, r.anomaly], r.seed))
    return {
        "id": f"{section.name}/{row!s}", "label": str(row), "detector": row.detector,
        "version": records[0].detector_version, "plugin": records[0].plugin, "horizon": row.horizon,
        "parameters": records[0].parameters, "overrides": row.overrides,
        "seeds": sorted({r.seed for r in records}),
        **_fields(standing, "trivial", "primary", "below", "inputs", "rank", "alarm_rank",
                  "ties", "state"),
        "wins": _short(standing.wins),
        "cost": {n: _short(v) for n, v in standing.cost._asdict().items()},
        "trust": section.trust[row], "command": " && ".join(commands_of(records)),
        "entry": _entry(source, records[0].plugin),
        "cells": [_cell(r, names) for r in in_order],
        "intervals": _intervals(records, names, chosen), "curves": len(curves) - 1 if own else None,
    }  # fmt: skip


def _entry(entry: SubmittedEntry, plugin: str) -> Json:
    """Return who an entry is from, and the digest of the plug-in's source that it names."""
    meta, grant = entry.meta, entry.grant
    digests = {f"{p['distribution']}:{p['plugin']}": p["source_digest"] for p in meta.plugins[::-1]}
    return _fields(meta, *ENTRY_FIELDS) | {
        "source_digest": digests.get(plugin, ""),
        "grant": grant and _fields(grant, "by", "day", "how"),
    }  # fmt: skip


def _cell(record: Record, names: Sequence[str]) -> Json:
    """One record: its values, and its intervals, in the orders of the board's lists of names."""
    plain = _fields(record, "environment", "anomaly", "seed")
    if not record.ok:
        return plain | _fields(record, "status", "reason")
    metrics = [record.metrics.get(name) for name in names]
    bounds = [(record.metrics.get(name), metric_info(name).unit) for name in _with_intervals(names)]
    return plain | {
        "values": [m and _short(m.value) for m in metrics],
        "low": [m and _printed(m.low, kind) for m, kind in bounds],
        "high": [m and _printed(m.high, kind) for m, kind in bounds],
    }


def _intervals(
    records: Sequence[Record], names: Sequence[str], chosen: Mapping[str, Sequence[SelectedCell]]
) -> Json:
    """Intervals of means by key of the selection, in the order of the board's ``intervals``."""
    metrics = _with_intervals(names)
    found: dict[str, list[list[float | None] | None]] = {}
    for i, metric in enumerate(metrics):
        for key, pair in selection_intervals(records, metric, chosen).items():
            bounds = [_printed(value, metric_info(metric).unit) for value in pair]
            found.setdefault(key, [None] * len(metrics))[i] = bounds
    return found


def _with_intervals(names: Sequence[str]) -> list[str]:
    return [name for name in WITH_INTERVALS if name in names]


def _curves(units: Sequence[Json], records: Sequence[Record]) -> Json:
    """Curves of a row's cells by ``environment/anomaly``, of the first seed that has them."""
    cells = {str(r.cell) for r in records}
    found: Json = {}
    for unit in units:
        if unit["cell"] in cells:
            shown = {name: unit[name] for name in ("seed", "roc", "delay_far", "example")}
            found.setdefault(f"{unit['environment']}/{unit['anomaly']}", shown)
    return found


def _short(value: float) -> float | None:
    """Round to six digits, finer than anything printed; None for what is undefined."""
    if not math.isfinite(value):
        return None
    near = float(f"{value:.6g}")
    return int(near) if near.is_integer() else near


def _printed(value: float, kind: str) -> float | None:
    """Round an end of an interval to what is printed: nothing is computed from it."""
    # A percentage is rounded as one, so that the page and other tables have the same digits.
    if kind == "percent":
        return _short(round(round(100 * value, 1) / 100, 3))
    return _short(round(value, 1 if kind == "steps" else 3))


def selections(cells: Sequence[SelectedCell]) -> dict[str, list[SelectedCell]]:
    """Return the selections of cells that filters can make, by key.

    A key is ``environments|anomalies``: for the one ``all``, a family or an environment, for the
    other ``all``, a group or an anomaly.
    """
    environments: dict[str, set[str]] = {}
    anomalies: dict[str, set[str]] = {}
    for environment, anomaly in cells:
        for name in ("all", ENVIRONMENTS[environment].family, environment):
            environments.setdefault(name, set()).add(environment)
        for name in ("all", ANOMALIES[anomaly].group, anomaly):
            anomalies.setdefault(name, set()).add(anomaly)
    found = {
        f"{some}|{others}": [(e, a) for e, a in cells if e in environments[some] and a in named]
        for some in environments
        for others, named in anomalies.items()
    }
    return {key: chosen for key, chosen in found.items() if chosen}


def selection_intervals(
    records: Sequence[Record], metric: str, chosen: Mapping[str, Sequence[SelectedCell]]
) -> dict[str, tuple[float, float]]:
    """Return the 95 % interval of one row's mean over each selection of cells, by key.

    They are those of `Board.mean`, with each cell resampled once. Left out are selections with a
    failed cell, without an interval, and of one record, which has its own.
    """
    draws: dict[tuple[int, str, str], DrawnCell] = {}
    for r in records:
        if metric in r.per_trajectory:
            drawn = bootstrap.drawn_cell(r.environment, r.seed, contribution(r, metric))
            draws[r.seed, r.environment, r.anomaly] = drawn
    if not draws:
        return {}
    kind = metric_info(metric).interval
    seeds = list(dict.fromkeys(seed for seed, _, _ in draws))
    failed = {(r.environment, r.anomaly) for r in records if not r.ok}
    found = {}
    for key, cells in chosen.items():
        own = [draws[s, *cell] for s in seeds for cell in cells if (s, *cell) in draws]
        one = len(seeds) == len(cells) == 1
        if own and not one and not failed.intersection(cells):
            low, high = bootstrap.mean_interval(own, kind=kind)
            if not math.isnan(low):
                found[key] = low, high
    return found
