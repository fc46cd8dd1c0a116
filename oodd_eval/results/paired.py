"""Compare two rows of some results by the paired bootstrap of their difference."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from oodd_eval.errors import ResultsError, UnknownNameError, UsageError
from oodd_eval.metrics.auc import Contribution
from oodd_eval.metrics.catalogue import RANKING, metric_info
from oodd_eval.metrics.ranking import ALPHA, Row, rank
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record
from oodd_eval.results.tables.board import contribution, grouped


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
    values: tuple[float, float]
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
        one, other = (self.first, self.second) if better else (self.second, self.first)
        return f"{one} is better than {other}"

    def __str__(self) -> str:
        """Return the figures and the verdict."""
        info = metric_info(self.metric)
        one, two, d, low, high = map(
            info.text, (*self.values, self.difference, self.low, self.high)
        )
        unit = " %" if info.unit == "percent" else ""
        return (
            f"{info.title}: {self.first} {one}, {self.second} {two}{unit}, difference {d} "
            f"[{low}, {high}], p = {self.p:.2g}, {self.cells} cells: {self.verdict}"
        )


def row_named(records: Sequence[Record], name: str) -> Setting:
    """Return the row that a detector's name, or a whole setting such as ``rf[trees=9]``, names.

    Raises `UnknownNameError` when there is none, `UsageError` when a name has several rows.
    """
    rows = {str(r.setting): r.setting for r in records}
    if name in rows:
        return rows[name]
    own = [setting for setting in rows.values() if setting.detector == name]
    if not own:
        raise UnknownNameError("row of these results", name, rows)
    if len(own) > 1:
        shown = ", ".join(map(str, own))
        raise UsageError(
            f"{name!r} names {len(own)} rows of these results, expected one of {shown}"
        )
    return own[0]


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
    if len({(r.split_digest, r.protocol, r.limit) for r in records}) > 1:
        raise ResultsError("records of several splits or limits cannot be compared: select some")
    settings = [row_named(records, name) for name in (first, second)]
    if settings[0] == settings[1]:
        raise UsageError(f"{first!r} and {second!r} are the same row")
    sign = -1.0 if info.better == "lower" else 1.0
    rows: dict[str, Row] = {}
    for setting in settings:
        seeds = grouped((r for r in records if r.setting == setting), lambda r: r.seed)
        rows[str(setting)] = {
            seed: {
                r.position: _signed(contribution(r, metric), sign)
                for r in own
                if r.ok and metric in r.per_trajectory
            }
            for seed, own in seeds.items()
        }
    common = set.intersection(
        *(
            {place for place, c in cells.items() if not math.isnan(c.value)}
            for row in rows.values()
            for cells in row.values()
        )
    )
    if not common:
        raise ResultsError(f"{first} and {second} have no cell in common with a value of {metric}")
    shared = {
        name: {
            seed: {place: cells[place] for place in sorted(common)} for seed, cells in row.items()
        }
        for name, row in rows.items()
    }
    tests = rank(shared).comparisons
    one = next(t for t in tests if (t.first, t.second) == (str(settings[0]), str(settings[1])))
    low, high = sorted((sign * one.low, sign * one.high))
    means = [
        sum(sum(c.value for c in cells.values()) / len(common) for cells in row.values()) / len(row)
        for row in shared.values()
    ]
    return PairedComparison(
        one.first,
        one.second,
        metric,
        (sign * means[0], sign * means[1]),
        sign * one.difference,
        low,
        high,
        min(t.p_holm for t in tests),
        len(common),
    )


def _signed(own: Contribution, sign: float) -> Contribution:
    return Contribution(sign * own.numerator, own.denominator)
