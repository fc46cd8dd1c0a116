"""A comparison for people: a table of differences for the terminal, and Markdown."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Final

from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from oodd_eval.results.regression.differences import MEANINGS, By, Comparison, Difference
from oodd_eval.results.tables import markdown
from oodd_eval.results.tables.tables import UNDEFINED, Table

_COLOURS: Final = {"better": "green", "recovered": "green", "within": "yellow"}

_WHOLE: Final = ("failed", "missing", "recovered", "new")
"""Verdicts on cells, the same for every metric."""


def worth_showing(comparison: Comparison) -> list[Difference]:
    """Return the differences beyond the tolerance, whether the comparison fails for them or not."""
    return [d for d in comparison.differences if d.verdict not in ("same", "within", "new")]


def table(differences: Sequence[Difference], title: str = "", *, by: By = "cell") -> Table:
    """Return differences as a table of texts; a verdict on a whole cell takes one row."""
    header = [by, "metric", "reference", "now", "difference", "tolerance", "verdict"]
    rows = []
    for d, whole in _collapsed(differences):
        figures = [_number(d.reference, d.metric), _number(d.now, d.metric)]
        if whole:
            rows.append([d.place, "all", "", "", change(d), "", d.verdict])
        else:
            rows.append([d.place, d.metric, *figures, change(d), d.tolerance.text, d.verdict])
    return Table(title, header, rows, labels=2)


def change(difference: Difference) -> str:
    """Return the change as printed: an arrow, its size, and percent where those are tolerated."""
    if difference.verdict in ("failed", "missing", "undefined"):
        return difference.reason
    if math.isnan(difference.change):
        return difference.reason or UNDEFINED
    if difference.verdict == "same":
        return "="
    arrow = "↑" if difference.change > 0 else "↓"
    text = f"{arrow} {abs(difference.change):.3g}"
    if difference.tolerance.percent and difference.reference:
        text += f" ({difference.change / abs(difference.reference):+.1%})"
    return text


def summary(comparison: Comparison) -> str:
    """Return one sentence: how much was compared, and what came of it."""
    known = [d for d in comparison.differences if d.verdict != "new"]
    what = {"cell": "cells", "group": "group means", "mean": "means"}[comparison.by]
    units = len({(d.split, d.place, d.detector) for d in known})
    metrics = list(dict.fromkeys(d.metric for d in known))
    counts = Counter(d.verdict for d in known)
    found = ", ".join(f"{counts[v]} {v}" for v in MEANINGS if counts[v])
    new = len({d.place + d.detector for d in comparison.differences if d.verdict == "new"})
    more = f"; {new} new cells are not in the reference" if new else ""
    named = metrics[0] if len(metrics) == 1 else f"{len(metrics)} metrics"
    return f"{units} {what} compared in {named}: {found}{more}."


def show(comparison: Comparison, console: Console, *, everything: bool = False) -> None:
    """Print the differences beyond the tolerance (or everything), the notes and the summary."""
    chosen = comparison.differences if everything else worth_showing(comparison)
    for (split, detector), differences in _by_detector(chosen).items():
        console.print(Text(f"{detector} on {split}", "bold"))
        console.print(_rich(differences, comparison.by, console))
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


def render(comparison: Comparison) -> str:
    """Return the comparison as Markdown, for the description or a comment of a pull request."""
    parts = [f"## {verdict(comparison)}", "", summary(comparison), ""]
    parts += _tables(worth_showing(comparison), comparison.by)
    if others := [d for d in comparison.differences if d.verdict == "within"]:
        parts += ["<details><summary>Differences within the tolerance</summary>", ""]
        parts += [*_tables(others, comparison.by), "</details>", ""]
    parts += [f"- {markdown.escape(c.text)}" for c in comparison.conditions]
    parts += [f"- {markdown.escape(note)}" for note in comparison.notes]
    return "\n".join(parts) + "\n"


def _tables(differences: Sequence[Difference], by: By) -> list[str]:
    return [
        markdown.table(table(own, markdown.escape(f"{detector} on {split}"), by=by))
        for (split, detector), own in _by_detector(differences).items()
    ]


def _by_detector(differences: Iterable[Difference]) -> dict[tuple[str, str], list[Difference]]:
    found: dict[tuple[str, str], list[Difference]] = {}
    for d in differences:
        found.setdefault((d.split, d.detector), []).append(d)
    return found


def _collapsed(differences: Sequence[Difference]) -> list[tuple[Difference, bool]]:
    """Pair each difference with whether it stands for all metrics of its cell."""
    several = Counter((d.place, d.verdict) for d in differences)
    found: list[tuple[Difference, bool]] = []
    for d in differences:
        whole = d.verdict in _WHOLE and several[d.place, d.verdict] > 1
        if not (whole and found and found[-1][1] and found[-1][0].place == d.place):
            found.append((d, whole))
    return found


def _number(value: float, metric: str) -> str:
    """Return a figure with as many digits as a tolerance may need."""
    if math.isnan(value):
        return UNDEFINED
    return f"{value:.2f}" if metric.startswith("delay") else f"{value:.4f}"


def _rich(differences: Sequence[Difference], by: By, console: Console) -> RichTable:
    texts = table(differences, by=by)
    found = RichTable(box=box.SIMPLE_HEAD, pad_edge=False)
    for name, side in zip(texts.header, texts.alignment, strict=True):
        found.add_column(name, justify="left" if side == "left" else "right", overflow="fold")
    for row, (d, _) in zip(texts.rows, _collapsed(differences), strict=True):
        colour = "red" if d.fails else _COLOURS.get(d.verdict, "")
        found.add_row(*(Text(cell) for cell in row[:-1]), Text(row[-1], colour))
    if not console.is_terminal:
        # Nobody knows how wide a log is; a row that is broken is hard to read anywhere.
        found.width = console.measure(found, options=console.options.update(max_width=160)).maximum
    return found
