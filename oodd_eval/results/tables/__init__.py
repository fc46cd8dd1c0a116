"""Tables of texts, and the columns of means that most of them have."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from oodd_eval.metrics.catalogue import metric_info
from oodd_eval.results.board import Board, Value
from oodd_eval.results.identity import Setting

BRIEF: Final = "\N{DAGGER}"
"""Marks the figures of brief cells."""


@dataclass(frozen=True, slots=True)
class Table:
    """A titled table of texts, the first `labels` columns set to the left, with a note below it.

    On a terminal each row has the colour of its position in `colours`, if there are any.
    """

    title: str
    header: list[str]
    rows: list[list[str]]
    labels: int = 1
    note: str = ""
    colours: Sequence[str] = ()

    @property
    def alignment(self) -> tuple[str, ...]:
        """``"left"`` or ``"right"`` for every column, as tabulate takes it."""
        return tuple("left" if i < self.labels else "right" for i in range(len(self.header)))

    def columns(self, indices: Sequence[int]) -> "Table":
        """Return the table with these columns only."""
        rows = [[row[i] for i in indices] for row in self.rows]
        return replace(self, header=[self.header[i] for i in indices], rows=rows)

    def transposed(self) -> "Table":
        """Return the table with rows and columns exchanged."""
        whole = [list(column) for column in zip(self.header, *self.rows, strict=True)]
        return replace(self, header=whole[0], rows=whole[1:], labels=1, colours=())


def show_value(value: Value, metric: str) -> str:
    """Return a mean as printed: a number, a dash where undefined, a failure's state, or nothing.

    A star marks a mean in which expected cells are missing, a dagger one of brief cells only.
    """
    if not value.cells:
        return ""
    number = metric_info(metric).text
    text = value.state or number(value.value)
    if not math.isnan(value.low):
        text += f" [{number(value.low)}, {number(value.high)}]"
    return text + "*" * value.partial + BRIEF * value.brief


class Mean(NamedTuple):
    """A column: the mean of a metric over some of a board's cells."""

    title: str
    metric: str
    environments: Sequence[str]
    anomalies: Sequence[str]
    intervals: bool = False


def texts(board: Board, entry: Setting, columns: Iterable[Mean]) -> list[str]:
    """Return a row's means as printed, one a column."""
    return [
        show_value(board.mean(entry, environments, anomalies, metric, intervals=intervals), metric)
        for _, metric, environments, anomalies, intervals in columns
    ]
