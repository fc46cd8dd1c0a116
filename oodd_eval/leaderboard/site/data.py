"""What the site shows, as plain data for its page: boards, rows, cells, intervals, curves.

Everything that is not simple arithmetic is computed here; the page filters, averages over cells,
sorts and draws.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, Final

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS
from oodd_eval.leaderboard.entry import Entry, SubmittedEntry
from oodd_eval.leaderboard.sections import LeaderboardSection, sections
from oodd_eval.leaderboard.site.packing import packed
from oodd_eval.leaderboard.site.selections import Cell, selection_intervals, selections
from oodd_eval.metrics.auc import HIGHER_IS_BETTER, METRICS, POOLED
from oodd_eval.metrics.cusum import DRIFT, THRESHOLD
from oodd_eval.results.curve_file import read_curves
from oodd_eval.results.record import Record
from oodd_eval.results.tables.standings import Standing
from oodd_eval.results.tables.tables import PERCENT, TITLES

WITH_INTERVALS: Final = (
    "auc_matched", "auc", "delay", "delay_null", "delay_censored", "missed", "far", "far_twin",
    *(f"{name}_{suffix}" for suffix in ("at_1pct", "at_01pct")
      for name in ("delay", "delay_censored", "missed", "far_twin")),
)  # fmt: skip
"""Metrics that have intervals on the site: those that comparisons are made with."""

ENTRY_FIELDS: Final = (
    "id", "title", "submitter", "trust", "rerun", "created", "citation", "url", "caption",
    "command",
)  # fmt: skip
"""What the site says of an entry."""

SUFFIXES: Final = {"": "", "at_1pct": "1 %", "at_01pct": "0.1 %"}
"""Targets of calibrated thresholds by the suffix of their metrics."""

_ORDER: Final = {
    (e, a): (i, j) for i, e in enumerate(ENVIRONMENTS) for j, a in enumerate(ANOMALIES)
}

_THRESHOLD: Final = {"threshold": "smallest threshold that meets the target on calibration data"}

_PAPER = Path(__file__).parents[2] / "data" / "paper_tables.json"

Json = dict[str, Any]
Units = Mapping[str, list[Json]]
"""Curves of single cells by the id of their entry."""


def site_data(entries: Sequence[SubmittedEntry]) -> tuple[Json, list[Json]]:
    """Return the content of the site.

    Parameters
    ----------
    entries
        As read by `oodd_eval.leaderboard.entry.read_entries`.

    Returns
    -------
    data
        What the page needs at once.
    curves
        What it needs when a row is opened, by ``environment/anomaly``. A row names its place in
        this list.

    Raises
    ------
    ResultsError
        When entries contradict one another, or curves cannot be read.
    """
    units = {entry.meta.id: read_curves(entry.curves)["units"] for entry in entries if entry.curves}
    curves: list[Json] = []
    shown = [_board(section, units, curves) for section in sections(entries)]
    names = dict.fromkeys(name for board in shown for name in board["metrics"])
    return {
        "threshold": THRESHOLD,
        "drift": DRIFT,
        "metrics": {name: _metric(name) for name in names},
        "environments": {
            e.id: {"title": e.title, "family": e.family} for e in ENVIRONMENTS.values()
        },
        "anomalies": {
            a.id: {"title": a.title, "group": a.group, "summary": a.summary}
            for a in ANOMALIES.values()
        },
        "paper": json.loads(_PAPER.read_text(encoding="utf-8"))["table5_groups_delta1"],
        "boards": shown,
    }, curves


def _metric(name: str) -> Json:
    base, _, suffix = name.partition("_at_")
    target = SUFFIXES[f"at_{suffix}" if suffix else ""]
    title = TITLES.get(base, base) + (f" at {target}" if target else "")
    meaning = (METRICS | POOLED | _THRESHOLD)[base]
    under = f"; with a false-alarm rate calibrated to {target}" if base in METRICS else ""
    return {
        "title": title[0].upper() + title[1:],
        "meaning": meaning + (under if target else ""),
        "kind": _kind(name),
        "higher": base in HIGHER_IS_BETTER,
    }


def _kind(metric: str) -> str:
    base = metric.partition("_at_")[0]
    return "percent" if base in PERCENT else "steps" if base.startswith("delay") else "rate"


def _board(section: LeaderboardSection, units: Units, curves: list[Json]) -> Json:
    ranks, board = section.ranks, section.ranks.board
    found = {name for r in board.records for name in r.metrics}
    calibrated = [f"{m}_{s}" for s in SUFFIXES if s for m in (*METRICS, *_THRESHOLD)]
    # The plain ones stand there even where every cell of the board has failed.
    names = [*METRICS, *(name for name in (*calibrated, *POOLED) if name in found)]
    have = {(r.environment, r.anomaly) for r in board.records}
    chosen = selections([c for c in product(board.environments, board.anomalies) if c in have])
    return {
        "id": section.name,
        "split": board.split,
        "digest": board.digest,
        "protocol": board.protocol,
        "limit": board.limit,
        "tests": board.test_seeds(),
        "environments": board.environments,
        "anomalies": board.anomalies,
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
    section: LeaderboardSection,
    standing: Standing,
    names: Sequence[str],
    chosen: Mapping[str, Sequence[Cell]],
    units: Units,
    curves: list[Json],
) -> Json:
    row, records, cost = standing.entry, standing.records, standing.cost
    sources = [source.meta for source in section.sources[row]]
    own = _curves([u for meta in sources for u in units.get(meta.id, [])], records)
    if own:
        curves.append(packed(own))
    return {
        "id": f"{section.name}/{str(row)}",
        "label": str(row),
        "detector": row.detector,
        "version": records[0].detector_version,
        "plugin": records[0].plugin,
        "horizon": row.horizon,
        "parameters": records[0].parameters,
        "overrides": row.overrides,
        "seeds": sorted({r.seed for r in records}),
        "trivial": standing.trivial,
        "inputs": standing.inputs,
        "rank": standing.rank,
        "ties": standing.ties,
        "state": standing.state,
        "wins": _short(standing.wins),
        "cost": {name: _short(getattr(cost, name)) for name in ("fit", "step", "peak")},
        "trust": section.trust[row],
        "entries": [_entry(meta, records[0].plugin) for meta in sources],
        "cells": [_cell(r, names) for r in sorted(records, key=_place)],
        "intervals": _intervals(records, names, chosen),
        "curves": len(curves) - 1 if own else None,
    }


def _entry(meta: Entry, plugin: str) -> Json:
    """Tell who an entry is from, and the digest of the plug-in's source that it names."""
    digests = [
        named["source_digest"]
        for named in meta.plugins
        if f"{named['distribution']}:{named['plugin']}" == plugin
    ]
    return {name: getattr(meta, name) for name in ENTRY_FIELDS} | {
        "source_digest": digests[0] if digests else ""
    }


def _place(record: Record) -> tuple[int, int, int]:
    """Order of the benchmark: environment, anomaly, seed."""
    return (*_ORDER[record.environment, record.anomaly], record.seed)


def _cell(record: Record, names: Sequence[str]) -> Json:
    """One record: its values, and its intervals, in the orders of the board's lists of names."""
    plain: Json = {
        "environment": record.environment,
        "anomaly": record.anomaly,
        "seed": record.seed,
    }
    if not record.ok:
        return plain | {"status": record.status, "reason": record.reason}
    metrics = [record.metrics.get(name) for name in names]
    bounds = [(record.metrics.get(name), _kind(name)) for name in _with_intervals(names)]
    return plain | {
        "values": [m and _short(m.value) for m in metrics],
        "low": [m and _printed(m.low, kind) for m, kind in bounds],
        "high": [m and _printed(m.high, kind) for m, kind in bounds],
    }


def _intervals(
    records: Sequence[Record], names: Sequence[str], chosen: Mapping[str, Sequence[Cell]]
) -> Json:
    """Intervals of means by key of the selection, in the order of the board's ``intervals``."""
    metrics = _with_intervals(names)
    found: dict[str, list[list[float | None] | None]] = {}
    for i, metric in enumerate(metrics):
        for key, pair in selection_intervals(records, metric, chosen).items():
            bounds = [_printed(value, _kind(metric)) for value in pair]
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


def _short(value: float | None) -> float | None:
    """Round to six digits, finer than anything printed; None for what is undefined."""
    if value is None or not math.isfinite(value):
        return None
    near = float(f"{value:.6g}")
    return int(near) if near.is_integer() else near


def _printed(value: float | None, kind: str) -> float | None:
    """Round an end of an interval to what is printed: nothing is computed from it."""
    if value is None or not math.isfinite(value):
        return None
    # A percentage is rounded as one, so that the page and other tables have the same digits.
    if kind == "percent":
        return _short(round(round(100 * value, 1) / 100, 3))
    return _short(round(value, 1 if kind == "steps" else 3))
