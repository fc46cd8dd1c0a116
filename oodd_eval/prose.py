"""Sections of sentences and tables of texts, and what they are on a terminal."""

import io
import itertools
import re
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from rich.console import Console
from rich.text import Text
from tabulate import tabulate


@dataclass(frozen=True, slots=True)
class Table:
    """A titled table of texts, the first `labels` columns set to the left, with a note below it.

    On a terminal each row has the colour of its position in `colours`, if there are any, and
    `wrap` lets headings and names take several lines where the table is too wide.
    """

    title: str
    header: list[str]
    rows: list[list[str]]
    labels: int = 1
    note: str = ""
    colours: Sequence[str] = ()
    wrap: bool = False

    @property
    def alignment(self) -> tuple[str, ...]:
        """``"left"`` or ``"right"`` for every column, as tabulate takes it."""
        return tuple("left" if i < self.labels else "right" for i in range(len(self.header)))

    def columns(self, indices: Sequence[int]) -> "Table":
        """Return the table with these columns only."""
        rows = [[row[i] for i in indices] for row in self.rows]
        return replace(self, header=[self.header[i] for i in indices], rows=rows)

    def transposed(self) -> "Table":
        """Return the table with rows and columns exchanged.

        Of several labels a first one stands where it changes: a group of columns has its name once.
        """
        columns = [list(column) for column in zip(self.header, *self.rows, strict=True)]
        header = columns[0]
        if self.labels > 1:
            pairs = itertools.pairwise(header)
            header = [header[0], *("" if text == before else text for before, text in pairs)]
        return replace(self, header=header, rows=columns[1:], labels=1, colours=())


@dataclass(frozen=True, slots=True)
class Section:
    """Part of a report.

    Attributes
    ----------
    title
        Plain text, as all texts are: a renderer escapes what its format needs.
    facts
        Sentences below the title.
    findings
        Sentences that nobody should miss.
    tables
        Tables in their order.
    folded
        Further tables, which a format that can fold text folds away, under `fold`.
    notes
        Sentences below the tables.
    verdict
        The one sentence that comes first, such as which row is better.
    """

    title: str
    facts: Sequence[str] = ()
    findings: Sequence[str] = ()
    tables: Sequence[Table] = ()
    fold: str = ""
    folded: Sequence[Table] = ()
    notes: Sequence[str] = ()
    verdict: str = ""


def grid(table: Table, layout: str, escape: Callable[[str], str] = str) -> str:
    """Return header and rows of a table in one of tabulate's layouts."""
    return str(
        tabulate(
            [[escape(cell) for cell in row] for row in table.rows],
            [escape(name) for name in table.header],
            layout,
            colalign=table.alignment if table.rows else None,
            disable_numparse=True,
        )
    )


def print_prose(text: str, console: Console, style: str = "") -> None:
    """Print a sentence, wrapped between words; no line ends with a space."""
    for line in Text(text, style).wrap(console, console.width):
        line.rstrip()
        console.print(line)


def print_sections(sections: Sequence[Section], console: Console) -> None:
    """Print the verdict, tables, findings and notes of sections: what is read last stands last."""
    for section in sections:
        if section.verdict:
            print_prose(section.verdict + "\n", console, "bold")
        for table in section.tables:
            print_table(table, console)
        for sentence in section.findings:
            print_prose(sentence, console, "yellow")
        for line in section.notes:
            print_prose(line, console, "dim")
        if section.notes:
            console.print("")


def terminal_text(sections: Sequence[Section]) -> str:
    """Return what `print_sections` prints, as wide as the terminal, without colours."""
    text = io.StringIO()
    plain: dict[str, Any] = {"highlight": False, "markup": False, "soft_wrap": True}
    print_sections(sections, Console(file=text, color_system=None, force_jupyter=False, **plain))
    return text.getvalue()


def print_table(table: Table, console: Console, width: int = 0) -> None:
    """Print one table within a width, by default the console's: as it is, turned, or in parts."""
    if table.wrap:
        print_prose(table.title, console, "bold")
    else:
        console.print(Text(table.title, "bold"))
    for part in _fitting(table, width or console.width):
        lines = grid(part, "simple").splitlines()
        colours = ["", "", *(part.colours or [""] * (len(lines) - 2))]
        for line, colour in zip(lines, colours, strict=True):
            console.print(Text(line, colour))
        console.print("")
    if table.note:
        print_prose(table.note + "\n", console, "dim")


def _fitting(table: Table, width: int) -> list[Table]:
    """Return the table, the table turned, or parts of its columns, whichever first fits."""
    candidates = [table, table.transposed()]
    if table.wrap:
        wrapped = [_wrapped(candidate, width) for candidate in candidates]
        candidates = [table, wrapped[0], candidates[1], wrapped[1]]
        table = wrapped[0]
    for candidate in candidates:
        if _width(candidate) <= width:
            return [candidate]
    labels = list(range(table.labels))
    parts = [labels]
    for column in range(table.labels, len(table.header)):
        wider = [*parts[-1], column]
        if parts[-1] == labels or _width(table.columns(wider)) <= width:
            parts[-1] = wider
        else:
            parts.append([*labels, column])
    return [table.columns(part) for part in parts]


def _wrapped(table: Table, width: int) -> Table:
    """Return a table whose headings and labels take several lines where they are long."""
    most = max(_NARROW, width // 3)

    def lines(text: str, room: int) -> str:
        wrapper = textwrap.TextWrapper(room, break_long_words=room >= most)
        wrapper.wordsep_re = _PARTS
        return "\n".join(wrapper.wrap(text))

    columns = [[row[i] for row in table.rows] for i in range(len(table.header))]
    longest = [max(map(len, column), default=0) for column in columns]
    header = [
        lines(text, most if i < table.labels else max(longest[i], _NARROW))
        for i, text in enumerate(table.header)
    ]
    rows = [
        [lines(text, most) if i < table.labels else text for i, text in enumerate(row)]
        for row in table.rows
    ]
    return replace(table, header=header, rows=rows)


_NARROW: Final = 9
"""Width of a column that headings are wrapped to where its figures are narrower."""

_PARTS: Final = re.compile(r"(\s+|[^-\[,:.=\s]*[-\[,:.=]+)")
"""Ends of lines are between words, and in names behind what separates their parts."""


def _width(table: Table) -> int:
    return max(map(len, grid(table, "simple").splitlines()), default=0)
