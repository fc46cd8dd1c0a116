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
    that is too wide has headings and labels of several lines. If it still is, one that is `whole`
    gives way to the first of `narrower` that fits, and then loses its intervals from the right;
    any other comes in parts of its columns.
    """

    title: str
    header: list[str]
    rows: list[list[str]]
    labels: int = 1
    note: str = ""
    colours: Sequence[str] = ()
    whole: bool = False
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
        rows = [part.header, *part.rows]
        colours = ["", "", *(part.colours or [""] * len(part.rows))]
        lines = iter(_lines_of(part))
        for n, colour in zip([_height(rows[0]), 1, *map(_height, rows[1:])], colours, strict=True):
            console.print(Text("\n".join(itertools.islice(lines, n)), colour))
        console.print("")
    if table.note:
        print_prose(table.note + "\n", console, "dim")


def _height(row: Sequence[str]) -> int:
    return 1 + max(text.count("\n") for text in row)


def _lines_of(table: Table) -> list[str]:
    """Return the lines of a table with a rule below its header, no column wider than its texts."""
    texts = [table.header, *table.rows]
    layout: dict[str, Any] = {"colalign": table.alignment, "disable_numparse": True}
    rule, *lines, _ = tabulate(texts, tablefmt="simple", **layout).splitlines()
    n = _height(table.header)
    return [line.rstrip() for line in (*lines[:n], rule, *lines[n:])]


def _fitting(table: Table, width: int) -> list[Table]:
    """Return what of a table fits: its first shape that does, or parts of its columns."""
    shapes = [table, *table.narrower]
    for i in reversed(range(table.labels, len(table.header)) if table.whole else ()):
        bare = [
            [*r[:i], *(_INTERVAL.sub("", text) for text in r[i : i + 1]), *r[i + 1 :]]
            for r in shapes[-1].rows
        ]
        shapes.append(replace(shapes[-1], rows=bare))
    for shape in itertools.chain(*((shape, _wrapped(shape, width)) for shape in shapes)):
        if _width(shape) <= width:
            return [shape]
    parts = [[*range(shape.labels)]]
    for column in range(shape.labels, len(shape.header)):
        wider = [*parts[-1], column]
        if shape.whole or len(wider) == shape.labels + 1 or _width(shape.columns(wider)) <= width:
            parts[-1] = wider
        else:
            parts.append([*range(shape.labels), column])
    return [shape.columns(part) for part in parts]


def _wrapped(table: Table, width: int) -> Table:
    """Return a table whose headings and labels take several lines where they are long.

    Words of headings are divided where they are wider than the column's figures and `_NARROW`.
    """
    columns = [[row[i] for row in table.rows] for i in range(len(table.header))]
    room = [max(11 if i < table.labels else _NARROW, *map(len, c)) for i, c in enumerate(columns)]
    header = [_lines(text, n) for text, n in zip(table.header, room, strict=True)]
    sizes = [
        max(map(len, "\n".join([h, *c]).split("\n"))) for h, c in zip(header, columns, strict=True)
    ]
    for i in sorted(range(table.labels), key=sizes.__getitem__, reverse=True):
        # Of a whole table labels get what other columns leave, but no word is divided for them.
        pieces = [len(piece) for text in columns[i] for piece in _PARTS.split(text) if piece]
        left = width - sum(sizes) + sizes[i] - 2 * (len(sizes) - 1)
        least = min(max(pieces, default=0), width // 3)
        sizes[i] = min(sizes[i], max(left, least) if table.whole else width // 3)
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

_PARTS: Final = re.compile(r"(\s+)|(?<=[-\[,:.=])(?=[^-\[,:.=\s])|(?<=[a-z])(?=[A-Z])")
"""Ends of lines are between words, and in names behind what separates their parts."""

_WORD: Final = re.compile(r"[^\W\d_]+")

_INTERVAL: Final = re.compile(r" \[[^\]]*\]")


def _width(table: Table) -> int:
    return max(map(len, _lines_of(table)))
