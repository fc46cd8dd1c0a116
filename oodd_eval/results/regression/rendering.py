"""A comparison as tables for the terminal, as Markdown, and as JUnit XML.

The layout of the XML is that of the schema of Jenkins' xUnit plug-in, ``junit-10.xsd``.
"""

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Final
from xml.etree import ElementTree as ET

from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from oodd_eval.metrics.catalogue import UNDEFINED, metric_info
from oodd_eval.results.regression import MEANINGS, By, Comparison, Difference
from oodd_eval.results.tables.board import grouped
from oodd_eval.results.tables.layout import Table
from oodd_eval.results.tables.rendering import escape
from oodd_eval.results.tables.rendering import markdown as set_table

_COLOURS: Final = {"better": "green", "recovered": "green", "within": "yellow"}

_NOT_XML: Final = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 cannot hold, not even escaped."""

_WHOLE: Final = ("failed", "missing", "recovered", "new")  # of cells, for every metric


def worth_showing(comparison: Comparison) -> list[Difference]:
    """Return the differences beyond the tolerance, whether the comparison fails for them or not.

    Cells that are missing with their whole environment or detector are in the notes.
    """
    listed = (d for d in comparison.differences if d.verdict not in ("same", "within", "new"))
    return [d for d in listed if not d.outside]


def tables(differences: Iterable[Difference], by: By = "cell") -> Iterator[tuple[Table, list[str]]]:
    """Yield tables by split and detector with each row's colour; a whole cell takes one row."""
    header = [by, "metric", "reference", "now", "difference", "tolerance", "verdict"]
    for (split, detector), own in grouped(differences, _suite).items():
        several = Counter((d.place, d.verdict) for d in own)
        rows: dict[tuple[str, str], list[str]] = {}
        colours = []
        for d in own:
            figures = [_number(d.reference, d.tolerance.metric), _number(d.now, d.tolerance.metric)]
            row = [d.tolerance.metric, *figures, change(d), d.tolerance.text]
            if d.verdict in _WHOLE and several[d.place, d.verdict] > 1:
                row = ["all", "", "", change(d), ""]
            if (d.place, row[0]) not in rows:
                colours.append("red" if d.fails else _COLOURS.get(d.verdict, ""))
                rows[d.place, row[0]] = [d.place, *row, d.verdict]
        yield Table(f"{detector} on {split}", header, list(rows.values()), labels=2), colours


def change(d: Difference) -> str:
    """Return the change as printed: an arrow, its size, and percent where those are tolerated."""
    if d.verdict in ("failed", "missing", "undefined"):
        return d.reason
    by = d.now - d.reference
    if math.isnan(by):
        return d.reason or UNDEFINED
    if d.verdict == "same":
        return "="
    relative = f" ({by / abs(d.reference):+.1%})" if d.tolerance.percent and d.reference else ""
    return f"{'↑' if by > 0 else '↓'} {abs(by):.3g}{relative}"


def summary(comparison: Comparison) -> str:
    """Return one sentence: how much was compared, and what came of it."""
    known = [d for d in comparison.differences if d.verdict != "new"]
    what = {"cell": "cells", "group": "group means", "mean": "means"}[comparison.by]
    units = len({str(d) for d in known})
    metrics = list(dict.fromkeys(d.tolerance.metric for d in known))
    counts = Counter(d.verdict for d in known)
    found = ", ".join(f"{counts[v]} {v}" for v in MEANINGS if counts[v])
    new = len({str(d) for d in comparison.differences if d.verdict == "new"})
    more = f"; {new} new cells are not in the reference" if new else ""
    named = metrics[0] if len(metrics) == 1 else f"{len(metrics)} metrics"
    return f"{units} {what} compared in {named}: {found}{more}."


def show(comparison: Comparison, console: Console, *, everything: bool = False) -> None:
    """Print the differences beyond the tolerance (or everything), the notes and the summary."""
    chosen = comparison.differences if everything else worth_showing(comparison)
    for table, colours in tables(chosen, comparison.by):
        console.print(Text(table.title, "bold"))
        console.print(_rich(table, colours, console))
    for note in comparison.notes:
        console.print(Text(note, "yellow"))
    console.print(summary(comparison))
    if comparison.failures:
        console.print(Text(verdict(comparison), "bold red"))


def verdict(comparison: Comparison) -> str:
    """Return in a few words whether the comparison fails."""
    if not comparison.failures:
        return "Regression check passed"
    figures = sum(d.verdict != "new" for d in comparison.differences)
    return f"Regression check failed: {len(comparison.failures)} of {figures} figures"


def markdown(comparison: Comparison) -> str:
    """Return the comparison as Markdown, for the description or a comment of a pull request."""
    parts = [f"## {verdict(comparison)}", "", summary(comparison), ""]
    parts += _markdown_tables(worth_showing(comparison), comparison.by)
    if others := [d for d in comparison.differences if d.verdict == "within"]:
        parts += ["<details><summary>Differences within the tolerance</summary>", ""]
        parts += [*_markdown_tables(others, comparison.by), "</details>", ""]
    parts += [f"- {escape(str(c))}" for c in comparison.conditions]
    parts += [f"- {escape(note)}" for note in comparison.notes]
    return "\n".join(parts) + "\n"


def _markdown_tables(differences: Iterable[Difference], by: By) -> list[str]:
    return [set_table(replace(t, title=escape(t.title))) for t, _ in tables(differences, by)]


def _suite(d: Difference) -> tuple[str, str]:
    return d.split, d.detector


def _number(value: float, metric: str) -> str:
    """Return a figure with as many digits as a tolerance may need."""
    if math.isnan(value):
        return UNDEFINED
    return f"{value:.2f}" if metric_info(metric).unit == "steps" else f"{value:.4f}"


def _rich(table: Table, colours: Sequence[str], console: Console) -> RichTable:
    found = RichTable(box=box.SIMPLE_HEAD, pad_edge=False)
    for name, side in zip(table.header, table.alignment, strict=True):
        found.add_column(name, justify="left" if side == "left" else "right", overflow="fold")
    for row, colour in zip(table.rows, colours, strict=True):
        found.add_row(*map(Text, row[:-1]), Text(row[-1], colour))
    if not console.is_terminal:
        # Nobody knows how wide a log is; a row that is broken is hard to read anywhere.
        found.width = console.measure(found, options=console.options.update(max_width=160)).maximum
    return found


def junit(comparison: Comparison) -> str:
    """Return JUnit XML: a suite per split and detector, a case per cell (or mean) and metric."""
    whole = {"name": "oodd-eval compare", **_counts(comparison.differences)}
    root = ET.Element("testsuites", whole)
    for (split, detector), differences in grouped(comparison.differences, _suite).items():
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


def message(d: Difference) -> str:
    """Return one line about a difference: figures, change, tolerance and verdict."""
    both = d.reference, d.now
    reference, now = ("undefined" if math.isnan(v) else f"{v:.6g}" for v in both)
    figures = f"{d.tolerance.metric} {d.verdict}: reference {reference}, now {now}, {change(d)}"
    return f"{figures}, tolerance {d.tolerance.text}"


def _clean(text: str) -> str:
    return _NOT_XML.sub("\N{REPLACEMENT CHARACTER}", text)
