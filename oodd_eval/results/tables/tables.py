"""The tables of a report, as text in cells; Markdown and the terminal only set them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, GROUPS
from oodd_eval.metrics.auc import METRICS, POOLED
from oodd_eval.results.identity import Setting
from oodd_eval.results.tables.board import Board, Value

PERCENT: Final = frozenset({"auc", "auc_null", "auc_matched", "auc_placebo", *POOLED})
"""Metrics that are printed in percent, AUCs as the paper does."""

TITLES: Final = {
    "auc": "AUC",
    "auc_null": "AUC null",
    "auc_matched": "matched AUC",
    "auc_placebo": "placebo",
    "delay": "Delay",
    "delay_null": "Delay null",
    "delay_censored": "Delay censored",
    "missed": "Missed",
    "far": "FAR",
    "far_twin": "FAR twin",
    "auc_pooled": "pooled AUC",
    "average_precision": "AP",
    "fpr95": "FPR95",
    "threshold": "Threshold",
}

UNDEFINED: Final = "\N{EN DASH}"
"""What is printed for NaN."""

SIMPLE: Final = ("random", "persistence", "clock", "rf")
"""Rows that a detector with a learned model of the dynamics should beat."""


@dataclass(frozen=True, slots=True)
class Table:
    """A titled table of texts; the first `labels` columns are set to the left."""

    title: str
    header: list[str]
    rows: list[list[str]]
    labels: int = 1

    @property
    def alignment(self) -> tuple[str, ...]:
        """``"left"`` or ``"right"`` for every column, as tabulate takes it."""
        return tuple("left" if i < self.labels else "right" for i in range(len(self.header)))

    def columns(self, indices: Sequence[int]) -> Table:
        """Return the table with these columns only."""
        rows = [[row[i] for i in indices] for row in self.rows]
        return Table(self.title, [self.header[i] for i in indices], rows, self.labels)

    def transposed(self) -> Table:
        """Return the table with rows and columns exchanged."""
        whole = [list(column) for column in zip(self.header, *self.rows, strict=True)]
        return Table(self.title, whole[0], whole[1:])


def show_value(value: Value, metric: str) -> str:
    """Return a mean as printed: percent or number, a dash where undefined, a failure's state.

    A star marks a mean over fewer cells than other rows have; an empty text, no cell at all.
    """
    if not value.cells:
        return ""
    star = "*" if value.partial else ""
    if value.state:
        return value.state + star
    text = number(value.value, metric)
    if not math.isnan(value.low):
        text += f" [{number(value.low, metric)}, {number(value.high, metric)}]"
    return text + star


def number(value: float, metric: str) -> str:
    """Return one number as printed: AUCs in percent, delays in steps, rates as they are."""
    if math.isnan(value):
        return UNDEFINED
    base = metric.split("_at_", maxsplit=1)[0]
    if base in PERCENT:
        return f"{100 * value:.1f}"
    return f"{value:.1f}" if base.startswith("delay") else f"{value:.3f}"


def ranking(board: Board, *, intervals: bool = False) -> Table:
    """Return matched AUC by environment: the table that ranks, best mean first."""
    metric = "auc_matched"
    everywhere = board.environments, board.anomalies

    def mean(entry: Setting, environments: Sequence[str], anomalies: Sequence[str]) -> Value:
        return board.mean(entry, environments, anomalies, metric, intervals=intervals)

    def order(entry: Setting) -> float:
        value = mean(entry, *everywhere).value
        return math.inf if math.isnan(value) else -value

    groups = [g for g in GROUPS if board.in_group(g)]
    header = ["detector", "mean", *groups, *board.environments]
    rows = [
        [
            str(entry),
            show_value(mean(entry, *everywhere), metric),
            *(show_value(mean(entry, board.environments, board.in_group(g)), metric)
              for g in groups),
            *(show_value(mean(entry, [e], board.anomalies), metric) for e in board.environments),
        ]
        for entry in sorted(board.entries, key=order)
    ]  # fmt: skip
    return Table("Matched AUC (%), which ranks", header, rows)


def anomaly_groups(
    board: Board, horizon: int, groups: Sequence[str] = GROUPS, *, intervals: bool = False
) -> Table:
    """Return AUC, delay and false-alarm rate by environment and anomaly group: the paper's Table 5.

    The columns AVG are means over the detectors, trivial ones left out where there are others.
    """
    entries = [e for e in board.entries if e.horizon == horizon]
    averaged = [e for e in entries if not board.is_trivial(e)] or entries
    groups = [g for g in groups if board.in_group(g)]
    header = ["Environment", "Result"]
    for group in groups:
        short = [str(e).replace(f"h={horizon},", "").replace(f"[h={horizon}]", "")
                 for e in entries]  # fmt: skip
        header += [f"{group}: {label}" if len(groups) > 1 else label for label in [*short, "AVG"]]
    rows = []
    for environment in board.environments:
        for metric in ("auc", "delay", "far"):
            row = [ENVIRONMENTS[environment].title, TITLES[metric]]
            for group in groups:
                means = {
                    e: board.mean(e, [environment], board.in_group(group), metric,
                                  intervals=intervals)
                    for e in entries
                }  # fmt: skip
                defined = [means[e].value for e in averaged if not math.isnan(means[e].value)]
                average = Value(
                    sum(defined) / len(defined) if defined else math.nan,
                    cells=1,
                    partial=any(means[e].state or means[e].partial for e in averaged),
                )
                row += [show_value(v, metric) for v in [*means.values(), average]]
            rows.append(row)
    of = f"{groups[0]}-injected anomalies" if len(groups) == 1 else "by anomaly group"
    title = f"AUC (%), delay (steps), false-alarm rate, {of}, Δ = {horizon}"
    return Table(title, header, rows, labels=2)


def all_metrics(board: Board, *, intervals: bool = False) -> Table:
    """Return every metric by detector, mean over all cells, with the null and placebo columns."""
    return _by_metric(board, list(METRICS), "All metrics, mean over cells", intervals=intervals)


def pooled(board: Board) -> Table:
    """Return pooled AUC, average precision and FPR95 by detector: no part of a report unasked."""
    return _by_metric(board, list(POOLED), "Pooled steps (%), mean over cells", intervals=False)


def calibrated(board: Board, *, intervals: bool = False) -> Table | None:
    """Return alarms under calibrated thresholds; None when no record has them."""
    names = [
        f"{name}_{suffix}"
        for suffix in ("at_1pct", "at_01pct")
        for name in ("far_twin", "far", "delay", "delay_censored", "missed")
        if any(f"{name}_{suffix}" in r.metrics for r in board.records)
    ]
    title = "Alarms at a false-alarm rate calibrated to 1 % (and 0.1 %), mean over cells"
    return _by_metric(board, names, title, intervals=intervals) if names else None


def by_anomaly(
    board: Board, entry: Setting, metric: str = "auc_matched", *, intervals: bool = False
) -> Table:
    """Return one detector's metric by environment and anomaly."""
    rows = [
        [
            ENVIRONMENTS[environment].title,
            *(show_value(board.mean(entry, [environment], [a], metric, intervals=intervals), metric)
              for a in board.anomalies),
        ]
        for environment in board.environments
    ]  # fmt: skip
    unit = " (%)" if metric in PERCENT else ""
    title = f"{str(entry)}: {_title(metric)}{unit} by anomaly"
    return Table(title, ["Environment", *(ANOMALIES[a].id for a in board.anomalies)], rows)


def findings(board: Board) -> list[str]:
    """Return a sentence for every detector that a simple row beats, in matched AUC or AUC.

    The clock's AUC is left out: it is 1 by construction.
    """
    sentences = []
    for entry in board.entries:
        for simple in board.entries:
            if simple.detector not in SIMPLE or simple.horizon != entry.horizon:
                continue
            if board.is_trivial(entry) or simple.detector == entry.detector:
                continue
            for metric in ("auc_matched", "auc"):
                if metric == "auc" and simple.detector == "clock":
                    continue
                theirs, own, cells = board.compare(simple, entry, metric)
                if theirs > own:
                    sentences.append(
                        f"{str(simple)} beats {str(entry)} in mean {TITLES[metric]}: "
                        f"{number(theirs, metric)} against {number(own, metric)} over {cells} "
                        f"cell{'s' if cells != 1 else ''}."
                    )
    return sentences


def notes(board: Board) -> list[str]:
    """Return what has to stand below the tables of a board."""
    seeds = ", ".join(map(str, board.test_seeds()))
    facts = f"digest {board.digest[:12]}, protocol {board.protocol}"
    lines = [f"Split {board.split}, {facts}, test seeds per environment: {seeds}."]
    if board.limit is not None:
        lines.append(f"Limited to the first {board.limit} trajectories of each part: for trying.")
    for group in GROUPS:
        have = board.in_group(group)
        missing = [a.id for a in ANOMALIES.values() if a.group == group and a.id not in have]
        if have and missing:
            lines.append(f"Means over {group} anomalies are without {', '.join(missing)}.")
    lines.append(
        f"Means over cells; {UNDEFINED} is undefined (no alarm, say), an empty field was not run, "
        "* marks a mean over fewer cells than other rows have. A failure is shown as its state."
    )
    return lines


def _by_metric(board: Board, names: Sequence[str], title: str, *, intervals: bool) -> Table:
    everywhere = board.environments, board.anomalies
    rows = [
        [str(entry)]
        + [show_value(board.mean(entry, *everywhere, n, intervals=intervals), n) for n in names]
        for entry in board.entries
    ]
    return Table(title, ["detector", *map(_title, names)], rows)


def _title(metric: str) -> str:
    base, _, suffix = metric.partition("_at_")
    return TITLES[base] + {"": "", "1pct": " at 1 %", "01pct": " at 0.1 %"}[suffix]
