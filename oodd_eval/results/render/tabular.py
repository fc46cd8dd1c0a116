"""Results for spreadsheets and scripts, as CSV and JSON."""

import csv
import io
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Final
from xml.etree import ElementTree as ET

from oodd_eval.data.bounded import without_nan
from oodd_eval.metrics.catalogue import NAMES
from oodd_eval.results.board import Value
from oodd_eval.results.comparison import MEANINGS, Comparison, Difference
from oodd_eval.results.record import NAN, Metric, Record
from oodd_eval.results.render import renders
from oodd_eval.results.report import Report, by_suite, flat, message
from oodd_eval.results.standings import RankedBoard, cost_of


@renders("csv", "a line per cell with all metrics", tables=False)
def cells_as_csv(report: Report) -> str:
    """Return a report's cells as CSV, their columns first."""
    return csv_rows(without_nan(flat(report.records)))


@renders("json", "the same as a JSON array", tables=False)
def cells_as_json(report: Report) -> str:
    """Return a report's cells as a JSON array."""
    return json.dumps(without_nan(flat(report.records)), indent=1) + "\n"


def ranking_csv(ranks: RankedBoard) -> str:
    """Return one line per row: rank, cost, and every metric over all cells with its interval."""
    board = ranks.board
    metrics = dict.fromkeys(name for r in board.records for name in r.metrics)
    columns = {name: (name, board.anomalies) for name in metrics}
    columns |= {f"{board.ranking}_{g}": (board.ranking, kinds) for g, kinds in board.groups.items()}
    lines = []
    for row in ranks.standings:
        means = [
            board.mean(row.entry, board.environments, anomalies, metric, intervals=True)
            for metric, anomalies in columns.values()
        ]
        lines.append(
            {
                "rank": row.rank,
                "ties": row.ties,
                "alarm_rank": row.alarm_rank,
                "state": row.state,
                "detector": row.entry.detector,
                "horizon": row.entry.horizon,
                "overrides": row.entry.overrides_json,
                "trivial": str(row.trivial).lower(),
                "primary": str(row.primary).lower(),
                "training": row.training,
                "seeds": row.seeds,
                "inputs": row.inputs,
                "win_rate": number(row.wins),
                "lead": row.lead,
                "seconds_fit": number(row.cost.fit),
                "microseconds_per_step": number(row.cost.step),
                "peak_rss_mb": number(row.cost.peak),
                **dict(zip(_columns(columns), _texts(means), strict=True)),
            }
        )
    return csv_rows(lines)


def cells_csv(lines: Sequence[tuple[Mapping[str, str], Record]], *, header: bool = True) -> str:
    """Return one line per cell with its stored metrics and their intervals.

    Every cell has a mapping with columns that stand before its own, the same ones for all. Every
    metric that a record can have has a column.
    """
    facts: list[dict[str, object]] = [
        {
            **about,
            "split": r.split,
            "digest": r.split_digest,
            "protocol": r.protocol,
            "limit": "" if r.limit is None else r.limit,
            "detector": r.detector,
            "version": r.detector_version,
            "horizon": r.horizon,
            "overrides": r.setting.overrides_json,
            "seed": r.seed,
            "environment": r.environment,
            "group": r.group,
            "anomaly": r.anomaly,
            "strength": r.strength,
            "magnitude": "" if r.magnitude is None else number(r.magnitude),
            "paired": str(r.paired).lower(),
            "status": r.status,
            "note": r.note,
            "brief": str(r.brief).lower(),
            "seconds_fit": number(r.seconds_fit),
            "microseconds_per_step": number(cost_of([r]).step),
            "peak_rss_mb": number(r.peak_rss_mb),
        }
        for about, r in lines
    ]
    first = [[*facts[0], *_columns(NAMES)]] if header else []
    metrics = (_texts(map(r.metrics.get, NAMES)) for _, r in lines)
    rows = ([*cell.values(), *texts] for cell, texts in zip(facts, metrics, strict=True))
    return csv_text([*first, *rows])


def comparisons_csv(ranks: RankedBoard) -> str:
    """Return one line per ordered pair of ranked rows: difference, p-values, win rate."""
    header = [
        "first",
        "second",
        "difference",
        "difference_low",
        "difference_high",
        "p",
        "p_holm",
        "better",
        "win_rate",
    ]
    order = {label: i for i, label in enumerate(ranks.ranking.ranks)}
    lines = [
        [
            c.first,
            c.second,
            *map(number, (c.difference, c.low, c.high, c.p, c.p_holm)),
            str(c.better).lower(),
            number(ranks.rates[c.first, c.second]),
        ]
        for c in sorted(ranks.ranking.comparisons, key=lambda c: (order[c.first], order[c.second]))
    ]
    return csv_text([header, *lines])


def number(value: float) -> str:
    """Return a number with six significant digits for CSV; empty where undefined.

    Numbers that are rounding alone become zero: their digits may differ between machines.
    """
    if math.isnan(value):
        return ""
    return f"{value if abs(value) > 1e-12 else 0.0:.6g}"


def _columns(names: Iterable[str]) -> list[str]:
    """Return the columns of values and of the ends of their intervals."""
    return [name + end for name in names for end in ("", "_low", "_high")]


def _texts(values: Iterable[Value | Metric | None]) -> list[str]:
    """Return the texts of values and of the ends of their intervals, empty for None."""
    ends = ((v.value, v.low, v.high) if v else (NAN, NAN, NAN) for v in values)
    return [number(end) for group in ends for end in group]


def csv_rows(rows: Sequence[Mapping[str, object]]) -> str:
    """Return rows with the same columns as CSV, their names first."""
    return csv_text([list(rows[0]), *(list(row.values()) for row in rows)])


def csv_text(lines: Iterable[Sequence[object]]) -> str:
    """Return lines of fields as CSV."""
    text = io.StringIO()
    # The same bytes on every system.
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue()


_NOT_XML: Final = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 cannot hold, not even escaped."""


def junit(comparison: Comparison) -> str:
    """Return JUnit XML: a suite per split and detector, a case per cell (or mean) and metric."""
    attributes = {"name": "oodd-eval compare", **_counts(comparison.differences)}
    root = ET.Element("testsuites", attributes)
    for (split, detector), differences in by_suite(comparison.differences).items():
        name = _clean(f"{split}::{detector}")
        suite = ET.SubElement(root, "testsuite", {"name": name, **_counts(differences)})
        suite.set("skipped", str(sum(d.verdict == "new" for d in differences)))
        for d in differences:
            names = {"name": d.tolerance.metric, "classname": _clean(str(d)), "time": "0"}
            case = ET.SubElement(suite, "testcase", names)
            if d.fails:
                failure = ET.SubElement(case, "failure", type=d.verdict, message=_clean(message(d)))
                failure.text = f"{MEANINGS[d.verdict]}; the tolerance is {d.tolerance.text}"
            elif d.verdict == "new":
                ET.SubElement(case, "skipped", message=MEANINGS["new"])
    ET.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _counts(differences: Sequence[Difference]) -> dict[str, str]:
    failures = sum(d.fails for d in differences)
    return {"tests": str(len(differences)), "failures": str(failures), "errors": "0", "time": "0"}


def _clean(text: str) -> str:
    return _NOT_XML.sub("\N{REPLACEMENT CHARACTER}", text)
