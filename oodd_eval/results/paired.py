"""Compare two rows of some results by the paired bootstrap of their difference."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from oodd_eval.errors import ResultsError, UnknownNameError, UsageError
from oodd_eval.metrics.bootstrap import nan_mean
from oodd_eval.metrics.catalogue import RANKING, metric_info
from oodd_eval.metrics.ranking import ALPHA, rank
from oodd_eval.results.board import Conditions
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record
from oodd_eval.results.standings import terms_of


@dataclass(frozen=True, slots=True)
class PairedComparison:
    """One row beside another.

    Attributes
    ----------
    first, second
        The rows.
    metric
        What is compared.
    values
        Means of both over the cells.
    difference, low, high
        Of the first's mean to the second's, with its paired 95 % interval.
    p
        The smaller of the two one-sided p-values, that of "not better" and that of "not worse",
        after Holm's correction for both.
    cells
        Cells that both rows have, over which the means are.
    """

    first: str
    second: str
    metric: str
    values: tuple[float, ...]
    difference: float
    low: float
    high: float
    p: float
    cells: int

    @property
    def verdict(self) -> str:
        """One sentence: which row is better, or that nothing tells them apart."""
        if self.p > ALPHA:
            return f"{self.first} and {self.second} cannot be told apart"
        sign = -1 if metric_info(self.metric).better == "lower" else 1
        better = self.difference * sign > 0
        order = (self.first, self.second) if better else (self.second, self.first)
        return "{} is better than {}".format(*order)

    def __str__(self) -> str:
        """Return the figures and the verdict."""
        info = metric_info(self.metric)
        figures = *self.values, self.difference, self.low, self.high
        first, second, difference, low, high = map(info.text, figures)
        unit = " %" if info.unit == "percent" else ""
        return (
            f"{info.title}: {self.first} {first}, {self.second} {second}{unit}, difference "
            f"{difference} [{low}, {high}], p = {self.p:.2g}, {self.cells} cells: {self.verdict}"
        )


def row_named(records: Sequence[Record], name: str) -> Setting:
    """Return the row that a detector's name, or a whole setting such as ``rf[trees=9]``, names.

    Raises `UnknownNameError` when there is none, `UsageError` when a name has several rows.
    """
    rows = {str(r.setting): r.setting for r in records}
    if name in rows:
        return rows[name]
    named = [setting for setting in rows.values() if setting.detector == name]
    if not named:
        raise UnknownNameError("row of these results", name, rows)
    if len(named) > 1:
        choice = ", ".join(map(str, named))
        raise UsageError(
            f"{name!r} names {len(named)} rows of these results, expected one of {choice}"
        )
    return named[0]


def compare(
    records: Sequence[Record], first: str, second: str, metric: str = RANKING
) -> PairedComparison:
    """Compare two rows of one board over the cells in which both have a value.

    Rows are named as tables print them; the metric is any that is a mean over trajectories.

    Raises
    ------
    UnknownNameError, UsageError
        For a row or a metric that the records do not have, or a row that is named twice.
    ResultsError
        When the rows have no cell in common, or records of several boards.
    """
    info = metric_info(metric)
    if info.interval == "" or info.median or not info.better:
        raise UsageError(
            f"rows cannot be compared by {metric!r}: expected a mean over trajectories with a "
            "better side, such as auc_matched"
        )
    if len({Conditions.of(r) for r in records}) > 1:
        raise ResultsError("records of several splits or limits cannot be compared: select some")
    settings = [row_named(records, name) for name in (first, second)]
    if settings[0] == settings[1]:
        raise UsageError(f"{first!r} and {second!r} are the same row")
    rows = {s: terms_of((r for r in records if r.setting == s), metric) for s in settings}
    defined = (
        {cell for cell, terms in cells.items() if not math.isnan(terms.value)}
        for row in rows.values()
        for cells in row.values()
    )
    common = sorted(set.intersection(*defined))
    if not common:
        raise ResultsError(f"{first} and {second} have no cell in common with a value of {metric}")
    shared = {
        str(setting): {seed: {cell: cells[cell] for cell in common} for seed, cells in row.items()}
        for setting, row in rows.items()
    }
    one, other = shared
    tests = {(test.first, test.second): test for test in rank(shared).comparisons}
    test = tests[one, other]
    means = (
        nan_mean(nan_mean(c.value for c in row.values()) for row in shared[name].values())
        for name in shared
    )
    # Where lower is better, the terms have their sign turned.
    sign = -1.0 if info.better == "lower" else 1.0
    low, high = sorted((sign * test.low, sign * test.high))
    values = tuple(sign * mean for mean in means)
    p = min(t.p_holm for t in tests.values())
    return PairedComparison(
        one, other, metric, values, sign * test.difference, low, high, p, len(common)
    )
