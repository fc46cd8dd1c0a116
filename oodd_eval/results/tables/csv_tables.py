"""Boards as CSV, for spreadsheets and scripts: every number with six significant digits."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence

from oodd_eval.data.facts import GROUPS
from oodd_eval.results.identity import Setting
from oodd_eval.results.tables.board import Value
from oodd_eval.results.tables.standings import METRIC, RankedBoard


def ranking(ranks: RankedBoard, trust: Mapping[Setting, str]) -> str:
    """Return one line per row: place, cost, and every metric over all cells with its interval.

    Parameters
    ----------
    ranks
        A board.
    trust
        Trust level by row.
    """
    board = ranks.board
    names = _metrics(ranks)
    groups = [g for g in GROUPS if board.in_group(g)]
    columns = [*names, *(f"{METRIC}_{g}" for g in groups)]
    header = ["rank", "ties", "state", "detector", "horizon", "overrides", "trivial", "seeds",
              "inputs", "trust", "win_rate", "seconds_fit", "microseconds_per_step",
              "peak_rss_mb", *_with_ends(columns)]  # fmt: skip
    lines = []
    for one in ranks.standings:
        entry = one.entry
        over = board.environments
        values = [board.mean(entry, over, board.anomalies, n, intervals=True) for n in names]
        values += [
            board.mean(entry, over, board.in_group(g), METRIC, intervals=True) for g in groups
        ]
        lines.append(
            [
                "" if one.rank is None else str(one.rank),
                one.ties,
                one.state,
                entry.detector,
                str(entry.horizon),
                entry.overrides_json,
                str(one.trivial).lower(),
                str(one.seeds),
                one.inputs,
                trust.get(entry, ""),
                *map(number, (one.wins, one.cost.fit, one.cost.step, one.cost.peak)),
                *(text for value in values for text in _ends(value)),
            ]
        )
    return _lines(header, lines)


def cells(ranks: RankedBoard) -> str:
    """Return one line per cell with its stored metrics and their intervals."""
    names = _metrics(ranks)
    header = ["detector", "horizon", "overrides", "seed", "environment", "group", "anomaly",
              "status", *_with_ends(names)]  # fmt: skip
    lines = []
    for one in ranks.standings:
        for r in one.records:
            found = [r.metrics.get(name) for name in names]
            lines.append(
                [
                    one.entry.detector,
                    str(one.entry.horizon),
                    one.entry.overrides_json,
                    str(r.seed),
                    r.environment,
                    r.group,
                    r.anomaly,
                    r.status,
                    *(
                        text
                        for m in found
                        for text in (map(number, (m.value, m.low, m.high)) if m else ("", "", ""))
                    ),
                ]
            )
    return _lines(header, lines)


def comparisons(ranks: RankedBoard) -> str:
    """Return one line per ordered pair of ranked rows: difference, p-values, win rate."""
    header = ["first", "second", "difference", "difference_low", "difference_high", "p", "p_holm",
              "better", "win_rate"]  # fmt: skip
    place = {label: i for i, label in enumerate(ranks.ranking.ranks)}
    lines = [
        [
            c.first,
            c.second,
            *map(number, (c.difference, c.low, c.high, c.p, c.p_holm)),
            str(c.better).lower(),
            number(ranks.rates[c.first, c.second]),
        ]
        for c in sorted(ranks.ranking.comparisons, key=lambda c: (place[c.first], place[c.second]))
    ]
    return _lines(header, lines)


def number(value: float) -> str:
    """Return a number with six significant digits; empty where undefined.

    What is rounding alone is zero: signs and digits below it may differ between machines.
    """
    if math.isnan(value):
        return ""
    return f"{value if abs(value) > 1e-12 else 0.0:.6g}"


def _metrics(ranks: RankedBoard) -> list[str]:
    """Return the names of all metrics that occur, in the order of the records."""
    return list(dict.fromkeys(name for r in ranks.board.records for name in r.metrics))


def _with_ends(names: Iterable[str]) -> list[str]:
    return [column for name in names for column in (name, f"{name}_low", f"{name}_high")]


def _ends(value: Value) -> tuple[str, str, str]:
    return number(value.value), number(value.low), number(value.high)


def _lines(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    text = io.StringIO()
    # The same bytes on every system.
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(lines)
    return text.getvalue()
