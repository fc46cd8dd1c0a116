"""The compact ranking of one board, as tables: ranks, alarms, cost, pooled metrics, win rates."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from oodd_eval.data.facts import GROUPS
from oodd_eval.metrics.auc import POOLED
from oodd_eval.results.identity import Setting
from oodd_eval.results.tables.board import Board
from oodd_eval.results.tables.standings import METRIC, RankedBoard, Standing
from oodd_eval.results.tables.tables import TITLES, UNDEFINED, Table, show_value

FEW: Final = 30
"""Test seeds per environment below which a board says that its comparisons are weak."""

ALARMS: Final = {
    "delay_censored_at_1pct": "delay censored at 1 %",
    "missed_at_1pct": "missed at 1 %",
    "far_twin_at_1pct": "FAR twin at 1 %",
    "delay": "delay",
    "delay_null": "delay null",
    "missed": "missed",
    "far_twin": "FAR twin",
}
"""Columns of the table of alarms. Beside a delay stands what false alarms alone give, or the
false-alarm rate that was achieved."""


def ranking(ranks: RankedBoard, trust: Mapping[Setting, str]) -> Table:
    """Return ranks by matched AUC, with what a reader needs to judge them.

    Parameters
    ----------
    ranks
        A board.
    trust
        Trust level by row; rows without one get a dash.
    """
    board = ranks.board
    groups = [g for g in GROUPS if board.in_group(g)]
    rows = [
        [
            place(one),
            one.ties or UNDEFINED,
            detector(one),
            settings(one),
            one.inputs.replace("observations+actions", "+actions") or UNDEFINED,
            trust.get(one.entry, UNDEFINED),
            _text(board, one, METRIC, intervals=True),
            *(_text(board, one, METRIC, group, intervals=True) for group in groups),
            _text(board, one, "auc"),
            _text(board, one, "auc_placebo"),
            _percent(one.wins),
        ]
        for one in ranks.standings
    ]
    header = ["rank", "ties", "detector", "settings", "inputs", "trust", TITLES[METRIC], *groups,
              TITLES["auc"], TITLES["auc_placebo"], "win rate"]  # fmt: skip
    return Table("Ranking by matched AUC (%)", header, rows, labels=6)


def alarms(ranks: RankedBoard) -> Table:
    """Return alarms at a calibrated false-alarm rate of 1 %, and with the paper's threshold."""
    found = {name for record in ranks.board.records for name in record.metrics}
    names = [name for name in ALARMS if name in found]
    rows = [
        [
            *_labels(one),
            *(_text(ranks.board, one, n, intervals=n.endswith("_at_1pct")) for n in names),
        ]
        for one in ranks.standings
    ]
    return Table("Alarms", [*_HEADER, *(ALARMS[n] for n in names)], rows, labels=3)


def cost(ranks: RankedBoard) -> Table:
    """Return seconds per fit, microseconds per scored step and peak memory."""
    rows = [
        [*_labels(one), *map(_digits, (one.cost.fit, one.cost.step, one.cost.peak))]
        for one in ranks.standings
    ]
    return Table(
        "Cost", [*_HEADER, "fit (s)", "score (µs per step)", "peak memory (MB)"], rows, labels=3
    )


def pooled(ranks: RankedBoard) -> Table | None:
    """Return the metrics of the neighbouring field; None when no record has them."""
    names = [n for n in POOLED if any(n in r.metrics for r in ranks.board.records)]
    rows = [
        [*_labels(one), *(_text(ranks.board, one, n) for n in names)] for one in ranks.standings
    ]
    title = "Pooled over steps (%), not for ranking"
    return Table(title, [*_HEADER, *(TITLES[n] for n in names)], rows, labels=3) if names else None


def wins(ranks: RankedBoard) -> Table | None:
    """Return in which share of cells the row beats the column; None with fewer than two rows."""
    labels = list(ranks.ranking.ranks)
    rows = [
        [row, *("" if row == other else _percent(ranks.rates[row, other]) for other in labels)]
        for row in labels
    ]
    title = "Win rates: share of cells (%) in which the row's matched AUC is above the column's"
    return Table(title, ["detector", *labels], rows) if len(labels) > 1 else None


def notes(ranks: RankedBoard) -> list[str]:
    """Return what has to stand below a ranking."""
    lines = [f"Not ranked: {str(one.entry)}, {one.state}." for one in ranks.standings if one.state]
    seeds = ranks.board.test_seeds()
    if seeds and seeds[0] < FEW and len(ranks.ranking.ranks) > 1:
        lines.append(
            f"With {seeds[0]} test seeds per environment small differences stay hidden: rows that "
            "share a letter may well differ."
        )
    return lines


_HEADER: Final = ["rank", "detector", "settings"]


def _labels(one: Standing) -> list[str]:
    return [place(one), detector(one), settings(one)]


def place(one: Standing) -> str:
    """Return a row's rank as printed."""
    return UNDEFINED if one.rank is None else str(one.rank)


def detector(one: Standing) -> str:
    """Return a row's detector, marked where it is trivial."""
    return f"{one.entry.detector} (trivial)" if one.trivial else one.entry.detector


def settings(one: Standing) -> str:
    """Return horizon, what is not a default, and the number of detector seeds where several."""
    overrides = [f"{k}={v}" for k, v in one.entry.overrides.items()]
    several = [f"{one.seeds} seeds"] if one.seeds > 1 else []
    return ", ".join([f"Δ={one.entry.horizon}", *overrides, *several])


def _text(
    board: Board, one: Standing, metric: str, group: str = "", *, intervals: bool = False
) -> str:
    anomalies = board.in_group(group) if group else board.anomalies
    value = board.mean(one.entry, board.environments, anomalies, metric, intervals=intervals)
    return show_value(value, metric)


def _percent(rate: float) -> str:
    return UNDEFINED if math.isnan(rate) else f"{100 * rate:.0f}"


def _digits(value: float) -> str:
    """Return two significant digits, the integer part of what is larger, no more than thousandths.

    A cost that is smaller than that is none.
    """
    if math.isnan(value):
        return UNDEFINED
    if 0 < value < 0.001:
        return "< 0.001"
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"
