"""Cells of text: numbers, truth values, what is missing, and names of columns."""

import contextlib
import dataclasses
import fnmatch
import functools
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.bounded import EPISODE
from oodd_eval.errors import TrajectoryError
from oodd_eval.names import is_plain
from oodd_logs.kinds import read_texts
from oodd_logs.recording import MISSING, Column, Recording, Topic

WIDEST: Final = 2**14
"""Columns that a recording may have."""

_WORDS: Final = {**dict.fromkeys(MISSING, np.nan), "true": 1.0, "false": 0.0}
_PROBED: Final = 500  # cells of which one is a number where a column has some
_ROLE: Final = re.compile(r"(obs)(?:ervations?)?|(action|reward)s?")


def number(cell: str, decimal: str = ".") -> float:
    """Return the number in a cell, 1 or 0 of a truth value, NaN where it says that none is there.

    A point is no number's where decimals follow a comma: it may stand between thousands.

    Raises
    ------
    ValueError
        When it holds something else.
    """
    if decimal == ",":
        if "." in cell:
            raise ValueError(cell)
        cell = cell.replace(decimal, ".")
    word = cell.strip().lower()
    if word in _WORDS:
        return _WORDS[word]
    if not is_plain(cell):
        raise ValueError(cell)
    return float(cell)


def numbers(cells: Sequence[str], decimal: str = ".", *, strict: bool = False) -> Column | None:
    """Return the numbers of a column; None where a cell holds something else.

    Parameters
    ----------
    cells
        Cells of the column.
    decimal
        What stands before the decimals: a point, a comma, or, for empty, either in all cells.
    strict
        Whether texts that only a kind of columns knows are something else. They are anyway where
        no other cell is a number.
    """
    if not decimal:
        column = numbers(cells, ".", strict=strict)
        return numbers(cells, ",", strict=strict) if column is None else column
    if decimal == ".":  # the quick way for numbers alone
        with contextlib.suppress(ValueError):
            column = np.array([*map(float, cells)], np.float64)
            return column if all(map(is_plain, cells)) else None
    values: dict[str, float] = {}
    plain = True
    for cell in {*cells}:
        try:
            values[cell] = number(cell, decimal)
        except ValueError:
            plain = False
            if strict or not (known := read_texts([cell])):
                return None
            values |= known
    if not plain and not any(np.isfinite([*values.values()])):
        return None
    return np.fromiter(map(values.__getitem__, cells), np.float64, len(cells))


def mixed(cells: Column) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the numbers of a column of texts, NaN elsewhere, and which cells are other texts.

    Cells without a value are neither. Kinds of columns say which other texts are numbers. Decimals
    stand behind the mark that makes numbers of most cells, a point if both do.

    >>> mixed(np.array(["1.5", "", "open", "nan", "1,234"]))
    (array([1.5, nan, nan, nan, nan]), array([False, False,  True, False,  True]))
    """
    every = cells.tolist()
    probed = every[:: max(1, len(every) // _PROBED)]
    if not any(_number_of(cell, mark) is not None for cell in probed for mark in ".,"):
        return np.full(len(cells), np.nan), np.strings.str_len(cells) > 0
    readings = [{cell: _number_of(cell, mark) for cell in {*every}} for mark in ".,"]
    values = max(readings, key=lambda read: sum(read[cell] is not None for cell in every))
    values |= read_texts([cell for cell, value in values.items() if value is None])
    column = [values[cell] for cell in every]
    words = np.array([value is None for value in column], np.bool_)
    return np.array(column, np.float64), words


def _number_of(cell: str, decimal: str) -> float | None:
    with contextlib.suppress(ValueError):
        return number(cell, decimal)
    return None


def texts(cells: Sequence[str], what: str) -> Column:
    """Return a column of texts; `TrajectoryError` where it would take too much memory."""
    stripped = [cell.strip() for cell in cells]
    size = 4 * max(map(len, stripped), default=0) * len(stripped)
    if size > EPISODE.most:
        raise TrajectoryError(f"{what}: texts take {size} bytes, limit {EPISODE.most}")
    return np.array(stripped, dtype=np.str_)


def conventional(name: str) -> str:
    """Return a column's name in the spelling of ``obs:NAME``, ``action:NAME`` and ``reward``.

    Other cases, blanks and plurals are taken for these; a name that is no such name comes back as
    it is.

    >>> conventional("Obs: flow[l/s]"), conventional("actions:u"), conventional("obs_x")
    ('obs:flow[l/s]', 'action:u', 'obs_x')
    """
    kind, colon, inner = name.partition(":")
    role = role_of(kind.strip().lower())
    if role == "reward" and not colon:
        return role
    return f"{role}:{inner.strip()}" if role in {"obs", "action"} and inner.strip() else name


def role_of(word: str) -> str:
    """Return obs, action or reward, where a word is one of these or their plural; else nothing."""
    match = _ROLE.fullmatch(word)
    return match[1] or match[2] if match else ""


def nearest_spelling(name: str) -> str:
    """Return what a name such as ``obs_x`` or ``action-u`` should be spelled as; empty for others.

    >>> nearest_spelling("obs_x"), nearest_spelling("Actions.u"), nearest_spelling("flow")
    ('obs:x', 'action:u', '')
    """
    match = re.fullmatch(r"(obs|observations?|actions?)[ _./-]+(.*\S)", name.strip(), re.IGNORECASE)
    return f"{role_of(match[1].lower())}:{match[2]}" if match else ""


def check_width(source: object, columns: int) -> None:
    """Raise `TrajectoryError` for more columns than are looked at."""
    if columns > WIDEST:
        raise TrajectoryError(
            f"{source} has {columns} columns or more, limit {WIDEST}: write fewer, or lists"
        )


def column_names(names: Iterable[str]) -> tuple[str, ...]:
    """Return names of columns without blanks around them, each once.

    A second column of one name gets a number, and one without a name its position.

    >>> column_names(["t", " x", "x", ""])
    ('t', 'x', 'x (2)', 'column 4')
    """
    return _unique(tuple(names))


@functools.lru_cache(64)  # episodes of a file have the same
def _unique(names: tuple[str, ...]) -> tuple[str, ...]:
    plain = [" ".join(name.split()) or f"column {i}" for i, name in enumerate(names, start=1)]
    plain = [conventional(name) for name in plain]
    counts: Counter[str] = Counter()
    taken, unique = {*plain}, []
    for name in plain:
        counts[name] += 1
        label = name
        while counts[name] > 1 and (label := f"{name} ({counts[name]})") in taken:
            counts[name] += 1
        taken.add(label)
        unique.append(label)
    return tuple(unique)


def without_codes(recording: Recording, codes: Mapping[str, Sequence[float | str]]) -> Recording:
    """Return a recording in which cells with one of some numbers or texts are missing.

    A column whose other cells are numbers is one of numbers then.

    Parameters
    ----------
    recording
        The recording.
    codes
        Numbers and texts by globs of columns, with or without their topic and unit.
    """
    topics = {name: _without(name, topic, codes) for name, topic in recording.topics.items()}
    for glob, named in codes.items():
        reason = f"cells with {', '.join(map(str, named))} count as missing"
        recording.ledger.add("column", "changed", reason, name=glob)
    return dataclasses.replace(recording, topics=topics)


def _without(topic_name: str, topic: Topic, codes: Mapping[str, Sequence[float | str]]) -> Topic:
    def plain(name: str, cells: Column) -> Column:
        labels = [name, f"{topic_name}.{name}", name.partition("[")[0].rpartition(":")[2]]
        globs = [glob for glob in codes if fnmatch.filter(labels, glob)]
        named = [code for glob in globs for code in codes[glob]]
        if cells.dtype.kind == "U":
            return np.where(np.isin(cells, [str(code).strip() for code in named]), "", cells)
        figures = [code for code in named if not isinstance(code, str)]
        return np.where(np.isin(cells, figures), np.nan, cells)

    @functools.cache
    def is_worded(name: str) -> bool:
        """Tell for all rows of a column, whatever a range has, whether texts remain."""
        cells = plain(name, topic.read([name], 0, topic.rows)[name])
        return cells.dtype.kind == "U" and numbers(cells.tolist(), "") is None

    def read(names: Sequence[str], start: int, stop: int) -> dict[str, Column]:
        columns = topic.read(names, start, stop)
        for name, cells in columns.items():
            columns[name] = plain(name, cells)
            if columns[name].dtype.kind == "U" and not is_worded(name):
                column = numbers(columns[name].tolist(), "")
                columns[name] = np.full(len(cells), np.nan) if column is None else column
        return columns

    return dataclasses.replace(topic, read=read)
