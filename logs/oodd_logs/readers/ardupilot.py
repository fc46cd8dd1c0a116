"""Logs of ArduPilot (DataFlash, ``.BIN``): a topic for each message and instance.

A file defines its messages itself: FMT has the length and the fields of each, FMTU their units and
which field counts instances, as https://ardupilot.org/dev describes the format.
"""

import mmap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.bounded import open_plain
from oodd_eval.errors import TrajectoryError
from oodd_logs.ledger import Ledger
from oodd_logs.readers import TOPICS, Options, Reader, chosen
from oodd_logs.readers.cells import column_names
from oodd_logs.recording import Column, Recording, Topic

_MARK: Final = b"\xa3\x95"
_HEAD: Final = 3  # bytes: the mark, and the number of the message's kind
_TYPES: Final = {
    "b": "i1", "B": "u1", "c": "<i2", "C": "<u2", "d": "<f8", "e": "<i4",
    "E": "<u4", "f": "<f4", "g": "<f2", "h": "<i2", "H": "<u2", "i": "<i4", "I": "<u4",
    "L": "<i4", "M": "u1", "n": "S4", "N": "S16", "q": "<i8", "Q": "<u8", "Z": "S64",
}  # fmt: skip
_SCALES: Final = {"c": 100.0, "C": 100.0, "e": 100.0, "E": 100.0, "L": 1e7}
_STAMPS: Final = {"TimeUS": 1e6, "TimeMS": 1e3}
_FORMAT: Final = frozenset({"FMT", "FMTU", "UNIT", "MULT"})
_ABOUT: Final = frozenset({"PARM", "MSG", "FILE"})  # messages about the log, no rows of sensors
_PLAIN: Final = "-0?"  # multipliers of fields whose numbers are in the unit as they are


@dataclass(slots=True)
class _Message:
    """A kind of message by its definition, and where its messages are in the file."""

    name: str
    length: int
    types: str
    fields: tuple[str, ...]
    places: list[int] = field(default_factory=list)

    @property
    def dtype(self) -> Any:
        """Layout of a message behind its head; None where the definition contradicts itself."""
        if len(self.types) != len(self.fields) or not {*self.types} <= {*_TYPES}:
            return None
        layout = np.dtype([(f, _TYPES[c]) for f, c in zip(self.fields, self.types, strict=True)])
        return layout if layout.itemsize + _HEAD == self.length else None

    def rows(self, content: NDArray[np.uint8], places: Sequence[int] | NDArray[Any]) -> Any:
        """Return messages at some places as an array with their fields."""
        windows = np.lib.stride_tricks.sliding_window_view(content, self.length - _HEAD)
        return windows[np.asarray(places, np.int64) + _HEAD].view(self.dtype)[:, 0]


_FMT: Final = 128
_DEFINITION: Final = _Message("FMT", 89, "BBnNZ", ("Type", "Length", "Name", "Format", "Columns"))


def _open(path: Path, options: Options) -> Iterator[Recording]:
    with open_plain(path) as file:
        mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    content, ledger = np.frombuffer(mapped, np.uint8), Ledger()
    messages = _messages(mapped, content, ledger)
    units = _units(content, messages)
    topics: dict[str, Topic] = {}
    for number, message in messages.items():
        if not message.places or message.name in _FORMAT:
            continue
        if message.name in _ABOUT or message.dtype is None:
            reason = "about the log" if message.name in _ABOUT else "its definition is not known"
            ledger.add("column", "dropped", reason, name=message.name)
        else:
            topics |= _topics(content, message, units.get(number, {}))
    if not topics:
        raise TrajectoryError(f"{path} has no messages of ArduPilot's DataFlash format")
    named = {name: topics[name] for name in chosen(topics, options)}
    yield Recording(path.stem, str(path), named, ledger=ledger)


def _messages(mapped: mmap.mmap, content: NDArray[np.uint8], ledger: Ledger) -> dict[int, _Message]:
    """Return the kinds of messages by number, with the places of each in the file."""
    messages = {_FMT: replace(_DEFINITION, places=[])}
    at, behind, lost = 0, 0, 0  # this message, the end of the last one, bytes between messages
    while 0 <= at <= len(mapped) - _HEAD:
        message = messages.get(mapped[at + 2]) if mapped[at : at + 2] == _MARK else None
        if message is None or at + message.length > len(mapped):
            at = mapped.find(_MARK, at + 1)
            continue
        lost, behind = lost + at - behind, at + message.length
        message.places.append(at)
        if message is messages[_FMT]:
            (number, length, *texts) = message.rows(content, [at])[0].tolist()
            name, types, columns = map(_text, texts)
            fields = column_names(columns.split(",")) if columns else ()
            if length > _HEAD:
                messages.setdefault(number, _Message(name, length, types, fields))
        at = behind
    if lost:
        reason = "it is damaged: what lies between its messages is skipped"
        ledger.add("recording", "changed", reason, cell=f"{lost} bytes")
    return messages


def _units(
    content: NDArray[np.uint8], messages: Mapping[int, _Message]
) -> dict[int, dict[str, str]]:
    """Return the units of fields by number of the message; of one that counts instances, ``#``."""
    about = {message.name: message for message in messages.values() if message.dtype}
    if not {"UNIT", "FMTU"} <= {*about}:
        return {}
    labels, fields = (about[name].rows(content, about[name].places) for name in ("UNIT", "FMTU"))
    symbols = {chr(row["Id"]): _text(row["Label"]) for row in labels} | {"#": "#"}
    units = {}
    for row in (row for row in fields if row["FmtType"] in messages):
        message = messages[row["FmtType"]]
        ids = zip(
            message.fields,
            message.types,
            _text(row["UnitIds"]),
            _text(row["MultIds"]),
            strict=False,
        )
        units[int(row["FmtType"])] = {
            name: symbols.get(unit, "")
            for name, letter, unit, factor in ids
            if letter in _SCALES or factor in _PLAIN
        }
    return units


def _topics(
    content: NDArray[np.uint8], message: _Message, units: Mapping[str, str]
) -> dict[str, Topic]:
    """Return a topic for each instance of a message, the first by its name alone."""
    places = np.array(message.places)
    counted = next((name for name in message.fields if units.get(name) == "#"), "")
    numbers = message.rows(content, places)[counted] if counted else np.zeros(len(places), np.int8)
    return {
        f"{message.name}_{i}" if i else message.name: _topic(
            content, message, places[numbers == i], units
        )
        for i in np.unique(numbers).tolist()
    }


def _topic(
    content: NDArray[np.uint8], message: _Message, places: NDArray[Any], units: Mapping[str, str]
) -> Topic:
    """Return messages as a topic, whose stamps are seconds since boot."""
    columns: dict[str, tuple[str, str]] = {}  # field and its type by the name of the column
    for name, letter in zip(message.fields, message.types, strict=True):
        unit = units.get(name, "")
        label = f"{name}[{unit}]" if unit.isprintable() and unit not in {"", "#"} else name
        columns["time" if name in _STAMPS else label] = name, letter

    def read(names: Sequence[str], start: int, stop: int) -> dict[str, Column]:
        rows = message.rows(content, places[start:stop])
        return {name: _cells(rows[columns[name][0]], *columns[name]) for name in names}

    return Topic(tuple(columns), len(places), read, "time" if "time" in columns else "")


def _cells(cells: NDArray[Any], name: str, letter: str) -> Column:
    if cells.dtype.kind == "S":
        return np.array([*map(_text, cells.tolist())], np.str_)
    return cells.astype(np.float64) / _STAMPS.get(name, _SCALES.get(letter, 1.0))


def _text(cell: bytes) -> str:
    return cell.partition(b"\0")[0].decode("utf-8", "replace")


READER: Final = Reader(
    "ardupilot", "a DataFlash log of ArduPilot", (".bin",), _open, options=TOPICS
)
