"""Sections of sentences and tables of texts, and what they are on a terminal."""

import io
import itertools
import math
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

    On a terminal each row has the colour of its position in `colours`, if there are any. A table
    that is too wide has headings and labels of several lines. If it still is, an `undivided`
    one gives way to the first of `narrower` that fits, and then loses its intervals from the right;
    any other comes in parts of its columns.
    """

    title: str
    header: list[str]
    rows: list[list[str]]
    labels: int = 1
    note: str = ""
    colours: Sequence[str] = ()
    undivided: bool = False
    narrower: Sequence["Table"] = ()

    @property
    def alignment(self) -> tuple[str, ...]:
        """``"left"`` or ``"right"`` for every column, as tabulate takes it."""
        return tuple("left" if i < self.labels else "right" for i in range(len(self.header)))

    def columns(self, indices: Sequence[int]) -> "Table":
        """Return the table with these columns only."""
        rows = [[row[i] for i in indices] for row in self.rows]
        return replace(self, header=[self.header[i] for i in indices], rows=rows)


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
    """Print the verdict, tables, findings and notes of sections: what is read last stands last.

    Several sections have their titles.
    """
    for section in sections:
        if len(sections) > 1:
            print_prose(section.title, console, "bold")
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
    """Print one table within a width, by default the console's, its rows as rows."""
    print_prose(table.title, console, "bold")
    for part in _fitting(table, width or console.width):
        rule, *lines = _lines_of(part)
        colours = part.colours or [""] * len(part.rows)
        for row, colour in zip((part.header, *part.rows), ("", *colours), strict=True):
            n = 1 + max(text.count("\n") for text in row)
            console.print(Text("\n".join([*lines[:n], *[rule] * (row is part.header)]), colour))
            del lines[:n]
        console.print("")
    if table.note:
        print_prose(table.note + "\n", console, "dim")


def _lines_of(table: Table) -> list[str]:
    """Return a rule, and the lines of header and rows, no column wider than its texts."""
    layout: dict[str, Any] = {"colalign": table.alignment, "disable_numparse": True}
    lines = tabulate([table.header, *table.rows], tablefmt="simple", **layout).splitlines()
    return [line.rstrip() for line in lines[:-1]]


def _fitting(table: Table, width: int) -> list[Table]:
    """Return what of a table fits: its first shape that does, or parts of its columns."""
    shapes = [table, *table.narrower]
    if table.undivided:  # intervals lose their spaces, and at last one after the other goes
        last, columns = shapes[-1], range(shapes[-1].labels, len(shapes[-1].header))
        shapes = [s for t in shapes for s in (t, _cut(t, t.labels, r"(\[\S+), ", r"\1,"))]
        shapes += [_cut(last, i, r" \[[^\]]*\]", "") for i in reversed(columns)]
    for shape in itertools.chain(*((shape, _wrapped(shape, width)) for shape in shapes)):
        if len(_lines_of(shape)[0]) <= width:
            return [shape]
    parts = [labels := [*range(shape.labels)]]
    for column in range(shape.labels, len(shape.header)):
        wider = [*parts[-1], column]
        fits = len(_lines_of(shape.columns(wider))[0]) <= width
        if shape.undivided or fits or parts[-1] == labels:
            parts[-1] = wider
        else:
            parts.append([*labels, column])
    return [shape.columns(part) for part in parts]


def _cut(table: Table, first: int, pattern: str, by: str) -> Table:
    """Return a table with what matches a pattern replaced, from a first column on."""
    figures = [[re.sub(pattern, by, text) for text in row[first:]] for row in table.rows]
    rows = [[*r[:first], *f] for r, f in zip(table.rows, figures, strict=True)]
    return replace(table, rows=rows)


def _wrapped(table: Table, width: int) -> Table:
    """Return a table whose headings and labels take several lines where they are long.

    Words of headings are divided where they are wider than the column's figures and `_NARROW`.
    """
    columns = [[row[i] for row in table.rows] for i in range(len(table.header))]
    room = [max(11 if i < table.labels else _NARROW, *map(len, c)) for i, c in enumerate(columns)]
    header = [_lines(text, n) for text, n in zip(table.header, room, strict=True)]
    sizes = [*map(len, _lines_of(replace(table, header=header))[0].split())]
    for i in sorted(range(table.labels), key=sizes.__getitem__, reverse=True):
        # In an undivided table labels get what is left, but no word is divided for them.
        pieces = [len(piece) for text in columns[i] for piece in _PARTS.split(text) if piece]
        left = width - sum(sizes) + sizes[i] - 2 * (len(sizes) - 1)
        least = min(max(pieces, default=0), width // 3)
        sizes[i] = min(sizes[i], max(left, least) if table.undivided else width // 3)
        columns[i] = [_lines(text, sizes[i]) for text in columns[i]]
    return replace(table, header=header, rows=[[*row] for row in zip(*columns, strict=True)])


def _lines(text: str, room: int) -> str:
    """Return text in lines of a room; longer words are divided evenly, with hyphens."""

    def divided(word: re.Match[str]) -> str:
        n = math.ceil(len(word[0]) / (room - 1)) if len(word[0]) > room else 1
        return "-".join(textwrap.wrap(word[0], math.ceil(len(word[0]) / n)))

    wrapper = textwrap.TextWrapper(room)
    wrapper.wordsep_re = _PARTS
    return "\n".join(wrapper.wrap(_WORD.sub(divided, text)))


_NARROW: Final = 6
"""Width of a column that headings are wrapped to where its figures are narrower."""

_PARTS: Final = re.compile(r"(\s+)|(?<=[-\[,:.=])(?=[^-\[,:.=\s])|(?<=[a-z])(?=[A-Z\d])")
"""Ends of lines are between words, and in names behind what separates their parts."""

_WORD: Final = re.compile(r"[^\W\d_]+")
