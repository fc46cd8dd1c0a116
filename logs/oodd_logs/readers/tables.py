"""Tables of text: files with a row a line, whose cells a separator or blanks divide.

A file is read in blocks of some megabytes, and its numbers stay in memory. A file of more of these
than fit belongs into a format in which rows can be sought, such as Parquet.
"""

import codecs
import csv
import io
import itertools
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from oodd_eval.data.bounded import EPISODE, LINE_CHARACTERS
from oodd_eval.errors import TrajectoryError, UsageError
from oodd_logs.readers import TRANSPOSE, Options
from oodd_logs.readers.cells import column_names, number, numbers, texts
from oodd_logs.recording import Column, Topic

BLANKS: Final = " "
"""Separator that stands for any number of blanks and tabs."""

OPTIONS: Final = {
    "separator": "character between cells, or a blank for any number of blanks and tabs",
    "decimal": "character before decimals: . or ,",
    "encoding": "of the text, by default UTF-8, or what a byte order mark says",
    "skip": "number of lines before the header",
    "header": "false where the first line holds values, true where it holds names",
    "names": "list of names for the columns, in place of the header's",
    **TRANSPOSE,
}

_BLOCK: Final = 2**22  # characters
_PIECE: Final = 2**16
_SAMPLE: Final = 100  # lines from which the layout is recognised
_DECIMAL_COMMA: Final = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
_DECIMAL_POINT: Final = re.compile(r"[+-]?\d*\.\d+([eE][+-]?\d+)?")
_DATE: Final = re.compile(r"\d{4}-\d\d-\d\d|\d\d?:\d\d")

_Cells = Column | list[str]


@dataclass(frozen=True, slots=True)
class Layout:
    """Layout of a file of text.

    Parameters
    ----------
    separator
        Character between cells, or `BLANKS`.
    decimal
        What stands before decimals; empty where the first lines have none.
    encoding
        Of the file.
    lines
        Lines before the first row.
    names
        Names of the columns.
    """

    separator: str
    decimal: str
    encoding: str
    lines: int
    names: tuple[str, ...]

    def split(self, lines: Sequence[str]) -> list[list[str]]:
        """Return the cells of lines; lines without any are left out."""
        return _split(lines, self.separator)


def table(path: Path, options: Options, separator: str = "") -> Topic:
    """Return the rows of a file as a topic.

    Parameters
    ----------
    path
        The file.
    options
        Values of `OPTIONS`.
    separator
        That of the format where the options do not say one; it is recognised by default.

    Raises
    ------
    UsageError
        When an option is wrong.
    TrajectoryError
        When rows have different numbers of cells, or the file is no text.
    """
    layout = layout_of(path, options, separator)
    blocks = _columns(path, layout)
    worded = {i for block in blocks for i, cells in enumerate(block) if isinstance(cells, list)}
    if worded and len(blocks) > 1:
        # One text, however late, makes texts of all cells of its column.
        blocks = _columns(path, layout, worded)
    columns: dict[str, Column] = {}
    for i, name in enumerate(layout.names):
        parts: list[Any] = [block[i] for block in blocks]
        if i in worded:
            columns[name] = texts([*itertools.chain(*parts)], f"{path}, column {name!r}")
        else:
            column = np.concatenate([np.empty(0), *parts])
            if name != f"column {i + 1}" or not len(column) or not np.isnan(column).all():
                columns[name] = column
    return Topic.of(columns)


def transposed_table(path: Path, options: Options, separator: str = "") -> Topic:
    """Return a file as a topic of which each line is a column, perhaps with its name in front."""
    encoding = _encoding(path, options)
    if path.stat().st_size > EPISODE.most // 4:
        raise EPISODE.failure(f"{path} has more than {EPISODE.most // 4} bytes and is transposed")
    lines = path.read_text(encoding).splitlines()[_whole(options, "skip") :]
    lines = [line for line in lines if line.strip() and not line.startswith("#")]
    mark = _separator(lines[:_SAMPLE], options, separator)
    decimal = _decimal(_split(lines[:_SAMPLE], mark), mark, options)
    columns: list[Column] = []
    labels: list[str] = []
    for line, cells in enumerate(_split(lines, mark), start=1):
        labelled = numbers(cells[:1], decimal) is None
        labels.append(cells[0] if labelled else str(len(labels)))
        values = cells[labelled:]
        column = numbers(values, decimal)
        columns.append(texts(values, f"{path}, line {line}") if column is None else column)
    names = _names(options, labels, len(labels), path)
    if len({*map(len, columns)}) > 1:
        counts = sorted({*map(len, columns)})
        raise TrajectoryError(f"{path}: lines have from {counts[0]} to {counts[-1]} cells")
    return Topic.of(dict(zip(names, columns, strict=True)))


def layout_of(path: Path, options: Options, separator: str = "") -> Layout:
    """Return the layout of a file, recognised from its first lines as far as options leave it."""
    encoding = _encoding(path, options)
    with path.open(encoding=encoding) as text:
        raw = []
        for line in iter(lambda: text.readline(LINE_CHARACTERS + 1), ""):
            raw.append(_bounded(line, path))
            if len(raw) == _SAMPLE or sum(map(len, raw)) > LINE_CHARACTERS:
                break
    first = _whole(options, "skip")
    if len(raw) > first and (mark := re.fullmatch(r'"?sep=(.)"?\s*', raw[first])):
        separator, first = mark[1], first + 1  # as Excel writes it
    while first < len(raw) and (raw[first].startswith("#") or not raw[first].strip()):
        first += 1
    comment = next((line for line in raw[first - 1 :: -1] if line.strip()), "") if first else ""
    lines = raw[first:]
    mark_of_cells = _separator(lines, options, separator)
    rows = _split(lines, mark_of_cells)
    if not rows:
        raise TrajectoryError(f"{path} is empty, expected a line with names of columns, and rows")
    decimal = _decimal(rows, mark_of_cells, options)
    head = rows[0]
    # A row of values has numbers, and perhaps times, and nothing else.
    words = [cell for cell in head if numbers([cell], decimal) is None]
    is_data = len(words) < len(head) and all(map(_DATE.match, words)) and any(map(str.strip, head))
    header = options.get("header", not is_data)
    if not isinstance(header, bool):
        raise UsageError(f"header is {header!r}, expected true or false")
    names: Sequence[str] = [*map(str, range(len(head)))]
    if header:
        names = head
        # Names may have line ends within quotes.
        reader = csv.reader(lines, delimiter=mark_of_cells)
        next(reader, None)
        first += 1 if mark_of_cells == BLANKS else max(1, reader.line_num)
    elif comment.startswith(("#", "%")) and "header" not in options:
        above = _split([comment[1:].lstrip()], mark_of_cells)[0]
        names = above if len(above) == len(head) else names
    if header and re.match(r"[#%]\s", names[0]):
        names = [names[0][1:], *names[1:]]
        if not names[0].strip() and [len(row) for row in rows[1:2]] == [len(names) - 1]:
            names = names[1:]
    return Layout(mark_of_cells, decimal, encoding, first, _names(options, names, len(names), path))


def _columns(path: Path, layout: Layout, worded: Collection[int] = ()) -> list[list[_Cells]]:
    """Return the columns of each block: numbers where all of its cells are, and not `worded`."""
    blocks, size = [], 0
    for block in _blocks(path, layout):
        columns = block.columns(worded)
        size += 8 * len(columns) * len(columns[0])
        if size > 4 * EPISODE.most:
            problem = f"{path} has more than {4 * EPISODE.most} bytes of numbers"
            raise EPISODE.failure(f"{problem}, write it as Parquet or")
        blocks.append(columns)
    return blocks


def _blocks(path: Path, layout: Layout) -> Iterator["_Block"]:
    with path.open(encoding=layout.encoding) as file:
        for _ in range(line := layout.lines):
            file.readline(LINE_CHARACTERS + 1)
        last = False
        while not last:
            # In pieces: reading reserves as much memory as it is asked for.
            pieces = iter(lambda: file.read(_PIECE), "")
            text = "".join(itertools.islice(pieces, -(-_BLOCK // _PIECE)))
            text += _bounded(file.readline(LINE_CHARACTERS + 1), path)
            extra = len(text) + LINE_CHARACTERS
            # A line may end within quotes.
            while text.count('"') % 2 and len(text) < extra and (more := file.readline(2**16)):
                text += more
            last = len(text) < _BLOCK
            if text:
                yield _Block(path, layout, text, line, last)
            line += text.count("\n")


@dataclass(frozen=True, slots=True)
class _Block:
    """Some lines of a file, behind `line` others; perhaps the last ones."""

    path: Path
    layout: Layout
    text: str
    line: int
    last: bool

    def columns(self, worded: Collection[int]) -> list[_Cells]:
        """Return the cells of each column: numbers where all are, and not `worded`, else texts."""
        fast = None if worded else self._numbers()
        if fast is not None:
            return fast
        rows = self.layout.split(io.StringIO(self.text).readlines())
        if self.last:
            while rows and not any(rows[-1]):
                rows.pop()
        width = len(self.layout.names)
        if {*map(len, rows)} - {width}:
            rows = [
                row if len(row) == width else self._fitted(row, i, self.last and i == len(rows) - 1)
                for i, row in enumerate(rows)
            ]
        columns: list[_Cells] = []
        for i, cells in enumerate(zip(*rows, strict=True)):
            column = None if i in worded else numbers(cells, self.layout.decimal)
            columns.append([*cells] if column is None else column)
        return columns or [np.empty(0) for _ in range(width)]

    def _numbers(self) -> list[_Cells] | None:
        """Return the columns of a block where every cell but the last row's is a plain number."""
        # Rows of that kind are most there are, and NumPy reads them in half of the time. The last
        # row may lack cells: nothing is commanded after the last observation.
        body, newline, end = self.text.rstrip("\n").rpartition("\n")
        layout, width = self.layout, len(self.layout.names)
        try:
            (row,) = layout.split([end])
            cells = [number(cell, layout.decimal) for cell in row + [""] * (width - len(row))]
            source = body
            if layout.decimal == ",":
                source = body.replace(".", "?").replace(",", ".")
            delimiter = None if layout.separator == BLANKS else layout.separator
            above = np.empty((0, width))
            if newline:
                above = np.loadtxt(
                    source.split("\n"), delimiter=delimiter, comments=None, quotechar='"', ndmin=2
                )
        except ValueError:
            return None
        if not any(row) or len(cells) != width or above.shape[1] != width:
            return None
        return [*np.concatenate([above, [cells]]).T]

    def _fitted(self, row: list[str], i: int, end: bool) -> list[str]:
        """Return a row with as many cells as the header; empty cells may be missing at the end."""
        names = self.layout.names
        width = len(names)
        needed = max((k for k, n in enumerate(names, 1) if n != f"column {k}"), default=width)
        if len(row) < width and (end or len(row) >= needed):
            return row + [""] * (width - len(row))
        if len(row) > width and not any(row[width:]):
            return row[:width]
        number_of_line = self.line + _line_of(self.text, i, self.layout.separator)
        raise TrajectoryError(
            f"{self.path}, line {number_of_line} has {len(row)} cells, expected {width}: "
            f"{', '.join(names)}"[:600]
        )


def _bounded(line: str, path: Path) -> str:
    if len(line) > LINE_CHARACTERS:
        raise EPISODE.failure(f"{path}: a line has more than {LINE_CHARACTERS} characters")
    return line


def _encoding(path: Path, options: Options) -> str:
    """Return the encoding that the options or the file's first bytes say."""
    encoding = options.get("encoding", "utf-8")
    try:
        codecs.lookup(encoding)
    except (LookupError, TypeError):
        raise UsageError(
            f"encoding is {encoding!r}, expected one such as utf-8 or cp1252"
        ) from None
    with path.open("rb") as file:
        head = file.read(4096)
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    if "encoding" not in options and b"\0" in head:
        raise TrajectoryError(f"{path} is no text: there are zero bytes in its first line")
    return "utf-8-sig" if head.startswith(b"\xef\xbb\xbf") else str(encoding)


def _split(lines: Sequence[str], separator: str) -> list[list[str]]:
    if separator == BLANKS:
        return [cells for line in lines if (cells := line.split())]
    rows = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    return [row for row in rows if row and (len(row) > 1 or row[0].strip())]


def _line_of(text: str, i: int, separator: str) -> int:
    """Return the number of the line on which row `i` of a text ends, from 1 on."""
    lines = io.StringIO(text).readlines()
    if separator == BLANKS:
        return [n for n, line in enumerate(lines, start=1) if line.split()][i]
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    filled = (row for row in reader if row and (len(row) > 1 or row[0].strip()))
    next(itertools.islice(filled, i, None))
    return reader.line_num


def _separator(lines: Sequence[str], options: Options, default: str) -> str:
    """Return the separator of the options, of the format, or the first that fits the lines."""
    separator = options.get("separator", default)
    if separator == "\\t":
        return "\t"
    if separator:
        if not isinstance(separator, str) or len(separator) != 1 or separator in '"\n\r':
            expected = "one character, such as ';'"
            raise UsageError(f"separator is {separator!r}, expected {expected}")
        return separator
    sample = [line for line in lines if line.strip()]
    for candidate in (c for c in ("\t", ";", "|", ",", BLANKS) if sample and c in sample[0]):
        counts = [len(row) for row in _split(sample, candidate)]
        if counts and counts[0] > 1 and counts.count(counts[0]) >= 0.9 * len(counts) - 1:
            return candidate
    return ","


def _decimal(rows: Sequence[Sequence[str]], separator: str, options: Options) -> str:
    decimal = options.get("decimal")
    if decimal is not None:
        if decimal not in {".", ","} or decimal == separator:
            raise UsageError(f"decimal is {decimal!r}, expected '.' or ',', and no separator")
        return str(decimal)
    cells = {cell.strip() for row in rows for cell in row}
    points = any(map(_DECIMAL_POINT.fullmatch, cells))
    if points or separator == ",":
        return "."
    return "," if any(map(_DECIMAL_COMMA.fullmatch, cells)) else ""


def _names(options: Options, names: Sequence[str], count: int, path: Path) -> tuple[str, ...]:
    option_names = options.get("names")
    if option_names is None:
        return column_names(names)
    if not isinstance(option_names, list) or not all(
        isinstance(name, str) for name in option_names
    ):
        raise UsageError(f"names are {option_names!r}, expected a list of texts")
    if len(option_names) != count:
        raise UsageError(
            f"{path} has {count} columns, expected {len(option_names)} as there are names"
        )
    return column_names(option_names)


def _whole(options: Options, name: str) -> int:
    value = options.get(name, 0)
    if type(value) is not int or value < 0:
        raise UsageError(f"{name} is {value!r}, expected a whole number from 0 on")
    return value
