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
    """Print one table within a width, by default the console's, its rows as rows."""
    print_prose(table.title, console, "bold")
    for part in _fitting(table, width or console.width):
        header, *rows = _aligned(part)
        rule = "  ".join("-" * n for n in _widths(part))
        colours = [*part.colours] or [""] * len(rows)
        console.print(Text("\n".join([*header, rule])))
        for lines, colour in zip(rows, colours, strict=True):
            console.print(Text("\n".join(lines), colour))
        console.print("")
    if table.note:
        print_prose(table.note + "\n", console, "dim")


def _fitting(table: Table, width: int) -> list[Table]:
    """Return what of a table fits: its first shape that does, or parts of its columns."""
    shapes = [table, *table.narrower]
    for column in reversed(range(table.labels, len(table.header)) if table.whole else ()):
        bare = [
            [_bare(text) if i == column else text for i, text in enumerate(row)]
            for row in shapes[-1].rows
        ]
        shapes += [replace(shapes[-1], rows=bare)] * (bare != shapes[-1].rows)
    for shape in shapes:
        for candidate in (shape, *(_wrapped(shape, width, room) for room in _ROOMS)):
            if _width(candidate) <= width:
                return [candidate]
    if table.whole:
        return [candidate]
    labels = list(range(table.labels))
    parts = [labels]
    for column in range(table.labels, len(table.header)):
        wider = [*parts[-1], column]
        if parts[-1] == labels or _width(candidate.columns(wider)) <= width:
            parts[-1] = wider
        else:
            parts.append([*labels, column])
    return [candidate.columns(part) for part in parts]


def _bare(text: str) -> str:
    """Return a figure without its interval."""
    return _INTERVAL.sub("", text)


def _wrapped(table: Table, width: int, room: int) -> Table:
    """Return a table whose headings and labels take several lines where they are long.

    Words of headings are divided where they are wider than the column's figures and the room.
    """
    columns = [[row[i] for row in table.rows] for i in range(len(table.header))]
    figures = [max(map(len, column), default=0) for column in columns]
    header = [
        _lines(text, width // 3 if i < table.labels else max(figures[i], room))
        for i, text in enumerate(table.header)
    ]
    wide = [max(w, *map(len, h.split("\n"))) for w, h in zip(figures, header, strict=True)]
    for i in sorted(range(table.labels), key=wide.__getitem__, reverse=True):
        # Of a whole table labels get what other columns leave, but no word is divided for them.
        pieces = [len(piece) for text in columns[i] for piece in _PARTS.split(text) if piece]
        left = width - sum(wide) + wide[i] - 2 * (len(wide) - 1)
        least = min(max(pieces, default=0), width // 3)
        wide[i] = min(wide[i], max(left, least) if table.whole else width // 3)
        columns[i] = [_lines(text, wide[i]) for text in columns[i]]
    return replace(table, header=header, rows=[[*row] for row in zip(*columns, strict=True)])


def _lines(text: str, room: int) -> str:
    """Return text in lines of a room; longer words are divided, those of letters with a hyphen."""
    wrapper = textwrap.TextWrapper(max(room, 1))
    wrapper.wordsep_re = _PARTS
    return "\n".join(wrapper.wrap(_WORD.sub(lambda word: _divided(word[0], room), text)))


def _divided(word: str, room: int) -> str:
    """Return a word that is too long for a room with hyphens between even parts of it."""
    if len(word) <= room or room < _ROOMS[-1]:
        return word
    size = math.ceil(len(word) / math.ceil(len(word) / (room - 1)))
    return "-".join(word[i : i + size] for i in range(0, len(word), size))


_ROOMS: Final = (11, 6)
"""Widths of columns that headings are wrapped to where figures are narrower, as tried."""

_PARTS: Final = re.compile(r"(\s+)|(?<=[-\[,:.=])(?=[^-\[,:.=\s])|(?<=[a-z])(?=[A-Z])")
"""Ends of lines are between words, and in names behind what separates their parts."""

_WORD: Final = re.compile(r"[^\W\d_]+")

_INTERVAL: Final = re.compile(r" \[[^\]]*\]")


def _widths(table: Table) -> list[int]:
    lines = zip(table.header, *table.rows, strict=True)
    return [max(len(line) for text in column for line in text.split("\n")) for column in lines]


def _width(table: Table) -> int:
    return sum(_widths(table)) + 2 * (len(table.header) - 1)


def _aligned(table: Table) -> list[list[str]]:
    """Return the lines of the header and of every row, columns two spaces apart."""
    widths, lines = _widths(table), []
    for row in (table.header, *table.rows):
        columns = [
            [line.ljust(n) if i < table.labels else line.rjust(n) for line in text.split("\n")]
            for i, (text, n) in enumerate(zip(row, widths, strict=True))
        ]
        parts = itertools.zip_longest(*columns)
        lines.append(
            [
                "  ".join(
                    " " * n if text is None else text for text, n in zip(part, widths, strict=True)
                ).rstrip()
                for part in parts
            ]
        )
    return lines
