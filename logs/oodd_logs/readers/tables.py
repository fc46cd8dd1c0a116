"""Tables of text: files with a row a line, whose cells a separator or blanks divide.

A file is read in blocks of some megabytes, and its numbers stay in memory. A file of more of these
than fit belongs into a format in which rows can be sought, such as Parquet.
"""

import codecs
import csv
import io
import itertools
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TextIO

import numpy as np

from oodd_eval.data.bounded import EPISODE, LINE_CHARACTERS
from oodd_eval.errors import TrajectoryError, UsageError
from oodd_logs.kinds import read_texts
from oodd_logs.kinds.number_marks import MARKS, has_thousands, may_have_thousands, without_marks
from oodd_logs.ledger import Ledger
from oodd_logs.readers import TRANSPOSE, Options, are_texts, is_transposed, option
from oodd_logs.readers.cells import check_width, column_names, numbers, texts
from oodd_logs.readers.packed import open_bytes, open_text, read_text, stem
from oodd_logs.recording import Column, Recording, Topic

BLANKS: Final = " "
"""Separator that stands for any number of blanks and tabs."""

OPTIONS: Final = {
    "separator": "character between cells, or a blank for any number of blanks and tabs",
    "decimal": "character before decimals: . or ,",
    "thousands": "character between thousands: . , ' or a blank; false for none",
    "encoding": "of the text, by default UTF-8, or what a byte order mark says",
    "skip": "number of lines before the header",
    "header": "false where the first line holds values, true where it holds names",
    "names": "list of names for the columns, in place of the header's",
    "units": "false where no line with units stands below the header",
    **TRANSPOSE,
}

_BLOCK: Final = 2**22  # characters
_PIECE: Final = 2**16
_SAMPLE: Final = 100  # lines from which the layout is recognised
_DECIMAL: Final = re.compile(r"[+-]?\d*([.,])\d+([eE][+-]?\d+)?")
_THREE_DIGITS: Final = re.compile(r"[+-]?[1-9]\d{0,2}([.,]\d{3})+")
_ZEROS: Final = re.compile("\0+")
_LAST: Final = ("action:", "reward", "column ")  # what a last row may lack
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
    thousands
        What stands between thousands: empty for nothing, None where columns tell.
    units
        Cells of a line with units below the header, of those of which `names` have them.
    header
        Names as they stand in the file; none where no line has any.
    """

    separator: str
    decimal: str
    encoding: str
    lines: int
    names: tuple[str, ...]
    thousands: str | None = None
    units: tuple[str, ...] = ()
    header: tuple[str, ...] = ()


def table_recording(path: Path, options: Options, separator: str = "") -> Recording:
    """Return a file as a recording with one topic.

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
    ledger = Ledger()
    if is_transposed(path, options):
        return Recording(stem(path), str(path), {"": _transposed(path, options, separator)})
    layout = layout_of(path, options, separator)
    topic = Topic.of(_table(path, layout, ledger))
    header = Counter(layout.header)
    for name in topic.names:
        plain = re.sub(r" \(\d+\)$", "", name)
        if name not in header and header[plain] > 1:
            ledger.add("column", "changed", f"{plain!r} stands twice in the header", name=name)
    if layout.units:
        said = f"units of the columns, it seems: {', '.join(layout.units)}"[:200]
        ledger.add("row", "changed", f"{said} ([read] units = false keeps the line as a row)")
    return Recording(stem(path), str(path), {"": topic}, ledger=ledger)


def _table(path: Path, layout: Layout, ledger: Ledger) -> dict[str, Column]:
    """Return the columns of a file, and say what became of its cells."""
    every = range(len(layout.names))
    worded = {*every} if layout.thousands else set[int]()
    while True:
        notes, size = Ledger(), 0
        blocks: list[list[_Cells]] = []
        for block in _blocks(path, layout, notes):
            blocks.append(block.columns(worded))
            size += 8 * len(every) * len(blocks[-1][0])
            if size > 4 * EPISODE.most:
                problem = f"{path} has more than {4 * EPISODE.most} bytes of numbers"
                raise EPISODE.failure(f"{problem}, write it as Parquet or")
        worded = {i for i in every for block in blocks if isinstance(block[i], list)}
        plain = {i: np.concatenate([[], *(b[i] for b in blocks)]) for i in every if i not in worded}
        if layout.thousands is None and layout.separator != ",":
            worded |= {i for i, column in plain.items() if may_have_thousands(column)}
        # One text, however late, makes texts of all cells of its column.
        if all(isinstance(block[i], list) for block in blocks for i in worded):
            break
    ledger.merge(notes)
    columns: dict[str, Column] = {}
    for i, name in enumerate(layout.names):
        if i in worded:
            cells = [*itertools.chain(*(block[i] for block in blocks))]
            column = _column(cells, name, layout, ledger)
            columns[name] = texts(cells, f"{path}, column {name!r}") if column is None else column
        elif name != f"column {i + 1}" or not len(plain[i]) or not np.isnan(plain[i]).all():
            columns[name] = plain[i]
    return columns


def _column(cells: list[str], name: str, layout: Layout, ledger: Ledger) -> Column | None:
    """Return the numbers of a column in which not all cells are plain ones; None for texts."""
    decimal, marks = layout.decimal, [layout.thousands or ""]
    if layout.thousands is None:
        said = {mark: has_thousands(cells, mark, decimal) for mark in ".,"}
        marks = [mark for mark in said if said[mark] and mark != layout.separator]
        for mark in [mark for mark, verdict in said.items() if verdict is None][:1]:
            reason = f"{mark!r} before three digits may stand between thousands: [read] thousands"
            ledger.add("column", "kept", reason, name=name)
    for mark in filter(None, marks):
        other = "," if mark == "." else decimal if decimal not in {"", mark} else "."
        column = numbers([without_marks(cell, mark, other) for cell in cells], other)
        if column is not None:
            reason = f"{mark!r} stands between thousands"
            rows = [i for i, cell in enumerate(cells) if without_marks(cell, mark) != cell]
            for row in rows[:1]:
                ledger.add("column", "changed", reason, name=name, row=row, cell=cells[row])
            return column
    column = numbers(cells, decimal)
    for row in np.flatnonzero(np.isnan(column)).tolist() if column is not None else ():
        if numbers([cells[row]], strict=True) is None:
            reason = "a code for what is missing"
            ledger.add("cell", "changed", reason, name=name, row=row, cell=cells[row])
    return column


def _transposed(path: Path, options: Options, separator: str) -> Topic:
    """Return a file as a topic of which each line is a column, perhaps with its name in front."""
    lines = read_text(path, _encoding(path, options)).splitlines()[_skipped(options) :]
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
    counts = sorted({*map(len, columns)})
    if len(counts) > 1:
        raise TrajectoryError(f"{path}: lines have from {counts[0]} to {counts[-1]} cells")
    return Topic.of(dict(zip(_names(options, labels, path), columns, strict=True)))


def layout_of(path: Path, options: Options, separator: str = "") -> Layout:
    """Return the layout of a file, recognised from its first lines as far as options leave it."""
    encoding = _encoding(path, options)
    raw: list[str] = []
    with open_text(path, encoding) as text:
        for line in itertools.islice(iter(lambda: _line(text, path), ""), _SAMPLE):
            raw.append(_without_zeros(line, Ledger()))
            if sum(map(len, raw)) > LINE_CHARACTERS:
                break
    first = _skipped(options)
    if mark := re.fullmatch(r'"?sep=(.)"?\s*', "".join(raw[first : first + 1])):
        separator, first = mark[1], first + 1  # as Excel writes it
    while first < len(raw) and (raw[first].startswith("#") or not raw[first].strip()):
        first += 1
    comment = next(filter(str.strip, reversed(raw[:first])), "")
    lines = raw[first:]
    separator = _separator(lines, options, separator)
    rows = _split(lines, separator)
    if not rows:
        raise TrajectoryError(f"{path} is empty, expected a line with names of columns, and rows")
    decimal = _decimal(rows, separator, options)
    head = rows[0]
    # A row of values has numbers, and perhaps times, and nothing else.
    words = [cell for cell in head if numbers([cell], decimal, strict=True) is None]
    is_data = len(words) < len(head) and all(map(_DATE.match, words)) and any(map(str.strip, head))
    header = option(options, "header", not is_data, lambda v: isinstance(v, bool), "true or false")
    names: Sequence[str] = [*map(str, range(len(head)))]
    units: list[str] = []
    if header:
        units = _units(rows, decimal) if options.get("units", True) is not False else []
        names = [_with_unit(n, u) for n, u in itertools.zip_longest(head, units, fillvalue="")]
        first += _line_of("".join(lines), 1 if units else 0, separator)
        if re.match(r"[#%]\s", names[0]):
            names = [names[0][1:], *names[1:]]
            if not names[0].strip() and [len(row) for row in rows[1:2]] == [len(names) - 1]:
                names = names[1:]
    elif comment.startswith(("#", "%")) and "header" not in options:
        above = _split([comment[1:].lstrip()], separator)[0]
        names = above if len(above) == len(head) else names
    check_width(path, len(names))
    marks = [mark for mark in (None, False, *MARKS) if mark != separator]
    expected = f"one of {', '.join(map(repr, MARKS))} that is no separator, or false"
    thousands = option(options, "thousands", None, marks.__contains__, expected)
    if thousands and decimal in {thousands, ""}:
        decimal = "," if thousands == "." else "."
    thousands = "" if thousands is False else thousands
    written = tuple(map(str.strip, head)) if header else ()
    labels = _names(options, names, path)
    return Layout(separator, decimal, encoding, first, labels, thousands, tuple(units), written)


def _units(rows: Sequence[Sequence[str]], decimal: str) -> list[str]:
    """Return the cells of a line of units below the header; none where values begin there."""

    def is_value(cell: str) -> bool:
        return bool(_DATE.match(cell)) or numbers([cell], decimal, strict=True) is not None

    units, below = [cell.strip() for cell in rows[1]] if len(rows) > 2 else [], rows[2:]
    words = [i for i, cell in enumerate(units) if cell not in {"", "-", "1"}]
    is_line = len(units) <= len(rows[0])
    if any(is_value(units[i]) or read_texts([units[i]]) for i in words):
        words = []
    columns = {i: [row[i] for row in below if i < len(row) and row[i].strip()] for i in words}
    numeric = [i for i in words if columns[i] and all(map(is_value, columns[i]))]
    repeated = any(units[i] in map(str.strip, columns[i]) for i in words)
    return units if is_line and numeric and 2 * len(numeric) >= len(words) and not repeated else []


def _with_unit(name: str, unit: str) -> str:
    """Return the name of a column with a unit in brackets, unless it has one or there is none."""
    plain = unit.strip("[]()<> ")
    return name if "[" in name or plain in {"", "-", "1"} or "[" in plain else f"{name}[{plain}]"


def _blocks(path: Path, layout: Layout, ledger: Ledger) -> Iterator["_Block"]:
    with open_text(path, layout.encoding) as file:
        for _ in range(line := layout.lines):
            _line(file, path)
        last = False
        while not last:
            # In pieces: reading reserves as much memory as it is asked for.
            pieces = [*itertools.islice(iter(lambda: file.read(_PIECE), ""), -(-_BLOCK // _PIECE))]
            last = sum(map(len, pieces)) < _BLOCK
            pieces.append(_line(file, path))
            text = "".join(_ZEROS.sub("\0", p) if "\0" in p else p for p in pieces)
            del pieces
            extra = len(text) + LINE_CHARACTERS
            # A line may end within quotes.
            while text.count('"') % 2 and len(text) < extra and (more := file.readline(2**16)):
                text += more
            parts = [_without_zeros(text, ledger)]
            del text
            if last:
                # The last row may lack cells: nothing is commanded after the last observation.
                end = len(parts[0].rstrip(f"\r\n {layout.separator}"))
                start = parts[0].rfind("\n", 0, end) + 1
                if parts[0][:start].strip() and parts[0].count('"', 0, start) % 2 == 0:
                    parts = [parts[0][:start], parts[0][start:]]
            while parts:
                part = parts.pop(0)
                if part:
                    yield _Block(path, layout, part, line, last and not parts, ledger)
                line += part.count("\n")


def _line(file: TextIO, path: Path) -> str:
    """Return a line of a file, with one zero byte for any number of them."""
    line = ""
    for piece in iter(lambda: file.readline(LINE_CHARACTERS + 1), ""):
        line += _ZEROS.sub("\0", piece)
        if line.endswith("\n") or len(line) > LINE_CHARACTERS:
            break
    if len(line) > LINE_CHARACTERS:
        raise EPISODE.failure(f"{path}: a line has more than {LINE_CHARACTERS} characters")
    return line


def _without_zeros(text: str, ledger: Ledger) -> str:
    """Return a text without zero bytes, which are where a logger lost its power.

    A line that they cut is left out; one that begins behind them is kept.
    """
    if "\0" not in text:
        return text
    kept = []
    for line in text.splitlines(keepends=True):
        plain = line.lstrip("\0")
        if "\0" in plain:
            if (head := plain.partition("\0")[0]).strip():
                ledger.add("row", "dropped", "zero bytes are in its line", cell=head)
            plain = "\n"
        kept.append(plain)
    ledger.add("file", "changed", "zero bytes are left out")
    return "".join(kept)


@dataclass(frozen=True, slots=True)
class _Block:
    """Some lines of a file, behind `line` others; perhaps the last ones."""

    path: Path
    layout: Layout
    text: str
    line: int
    last: bool
    ledger: Ledger

    def columns(self, worded: Collection[int]) -> list[_Cells]:
        """Return the cells of each column: numbers where all are, and not `worded`, else texts."""
        layout, width = self.layout, len(self.layout.names)
        if not worded and not self.last and (block := self._numbers()) is not None:
            return block
        lines = io.StringIO(self.text).readlines()
        rows = _split(lines, layout.separator)
        if self.last:
            while rows and not any(rows[-1]):
                rows.pop()
            # A row that is cut ends where it stands, and lacks more than commands.
            lacking = layout.names[len(rows[-1]) :] if rows else ()
            if not self.text.endswith("\n") and any(not n.startswith(_LAST) for n in lacking):
                cell = layout.separator.join(rows.pop())
                self.ledger.add("row", "dropped", "the last line is cut", cell=cell)
        if '"' in self.text and any("\n" in cell for row in rows for cell in row):
            plain = [line.rstrip("\r\n").split(layout.separator) for line in lines if line.strip()]
            if {*map(len, plain)} == {width}:
                rows = plain
                self.ledger.add("row", "changed", "a quote that is never closed stands for itself")
        end = len(rows) - 1 if self.last else -1
        rows = [
            row if len(row) == width else self._fitted(row, i, i == end)
            for i, row in enumerate(rows)
            if self._is_kept(row, i)
        ]
        columns: list[_Cells] = []
        for i, cells in enumerate(zip(*rows, strict=True)):
            column = None if i in worded else numbers(cells, layout.decimal, strict=True)
            columns.append([*cells] if column is None else column)
        return columns or [[] if i in worded else np.empty(0) for i in range(width)]

    def _numbers(self) -> list[_Cells] | None:
        """Return the columns of a block in which every cell is a plain number."""
        # Blocks of that kind are most there are, and NumPy reads them in half of the time.
        comma, separator = self.layout.decimal == ",", self.layout.separator
        text = self.text.replace(".", "?").replace(",", ".") if comma else self.text
        mark = None if separator == BLANKS else separator
        try:
            lines = text.split("\n")
            block = np.loadtxt(lines, delimiter=mark, comments=None, quotechar='"', ndmin=2)
        except ValueError:
            return None
        return [*block.T] if block.shape[1] == len(self.layout.names) else None

    def _is_kept(self, row: list[str], i: int) -> bool:
        """Tell whether a row is no remark between rows, nor the header again; note it."""
        header = self.layout.header
        if len(row) != len(self.layout.names) and row[0].startswith(("#", "%")):
            reason = "a remark between rows"
        elif row[0].strip() in header and sorted(map(str.strip, row)) == sorted(header):
            reason = "the header again"
            if tuple(map(str.strip, row)) != header:
                raise TrajectoryError(f"{self._position(i)} is a header of another order: split it")
        else:
            return True
        self.ledger.add("row", "dropped", reason, cell=self.layout.separator.join(row))
        return False

    def _fitted(self, row: list[str], i: int, end: bool) -> list[str]:
        """Return a row with as many cells as the header; empty cells may be missing at the end."""
        names = self.layout.names
        width = len(names)
        needed = max((k for k, n in enumerate(names, 1) if n != f"column {k}"), default=width)
        if len(row) < width and (end or len(row) >= needed):
            return row + [""] * (width - len(row))
        if len(row) > width and not any(row[width:]):
            return row[:width]
        problem = f"{self._position(i)} has {len(row)} cells, expected {width}: {', '.join(names)}"
        raise TrajectoryError(problem[:600])

    def _position(self, i: int) -> str:
        line = self.line + _line_of(self.text, i, self.layout.separator)
        return f"{self.path}, line {line}"


def _encoding(path: Path, options: Options) -> str:
    """Return the encoding that the options or the file's first bytes say."""
    encoding = options.get("encoding", "utf-8")
    try:
        codecs.lookup(encoding)
    except (LookupError, TypeError):
        raise UsageError(
            f"encoding is {encoding!r}, expected one such as utf-8 or cp1252"
        ) from None
    with open_bytes(path) as file:
        head = file.read(4096)
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    if "encoding" not in options and b"\0" in head.lstrip(b"\0").partition(b"\n")[0]:
        raise TrajectoryError(f"{path} is no text: there are zero bytes in its first line")
    return "utf-8-sig" if head.startswith(b"\xef\xbb\xbf") else str(encoding)


def _split(lines: Iterable[str], separator: str) -> list[list[str]]:
    """Return the cells of lines that have any."""
    return [cells for _, cells in _numbered(lines, separator)]


def _numbered(lines: Iterable[str], separator: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the number of the line on which a row ends, from 1 on, and its cells."""
    if separator == BLANKS:
        yield from ((i, cells) for i, line in enumerate(lines, 1) if (cells := line.split()))
        return
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    for row in reader:
        if len(row) > 1 or (row and row[0].strip()):
            yield reader.line_num, row


def _line_of(text: str, i: int, separator: str) -> int:
    """Return the number of the line on which row `i` of a text ends, from 1 on."""
    return next(itertools.islice(_numbered(io.StringIO(text), separator), i, None))[0]


def _separator(lines: Sequence[str], options: Options, default: str) -> str:
    """Return the separator of the options, of the format, or the first that fits the lines."""
    if options.get("separator", default):
        one = re.compile(r'[^"\n\r]|\\t').fullmatch
        expected = "one character, such as ';'"
        mark = option(
            options, "separator", default, lambda v: isinstance(v, str) and one(v), expected
        )
        return "\t" if mark == "\\t" else str(mark)
    sample = [line for line in lines if line.strip()]
    for candidate in (c for c in ("\t", ";", "|", ",", BLANKS) if sample and c in sample[0]):
        counts = [len(row) for row in _split(sample, candidate)]
        if counts and counts[0] > 1 and counts.count(counts[0]) >= 0.9 * len(counts) - 1:
            return candidate
    return ","


def _decimal(rows: Sequence[Sequence[str]], separator: str, options: Options) -> str:
    if "decimal" in options:
        expected = "'.' or ',', and no separator"
        marks = [mark for mark in ".," if mark != separator]
        return str(option(options, "decimal", "", marks.__contains__, expected))
    if separator == ",":
        return "."
    # A mark before three digits may stand between thousands.
    cells = {cell.strip() for row in rows for cell in row}
    matches = [_DECIMAL.fullmatch(cell) for cell in cells if not _THREE_DIGITS.fullmatch(cell)]
    decimals = {match[1] for match in matches if match}
    return "." if "." in decimals else "".join(decimals)


def _names(options: Options, names: Sequence[str], path: Path) -> tuple[str, ...]:
    labels = option(options, "names", [*names], are_texts, "a list of texts")
    if len(labels) != len(names):
        raise UsageError(
            f"{path} has {len(names)} columns, expected {len(labels)} as there are names"
        )
    return column_names(labels)


def _skipped(options: Options) -> int:
    def is_whole(value: Any) -> bool:
        return type(value) is int and value >= 0

    return int(option(options, "skip", 0, is_whole, "a whole number from 0 on"))
