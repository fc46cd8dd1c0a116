"""Logs of ArduPilot (DataFlash, ``.BIN``): a topic for each message and instance.

A file defines its messages itself: FMT has the length and the fields of each, FMTU says which field
counts instances, as https://ardupilot.org/dev describes the format.
"""

import mmap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

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
_TYPES: Final = {letter: f"<{letter}" for letter in "bBdfhHiIqQ"} | {
    "c": "<i2", "C": "<u2", "e": "<i4", "E": "<u4", "g": "<f2", "L": "<i4", "M": "u1",
    "n": "S4", "N": "S16", "Z": "S64",
}  # fmt: skip
_SCALES: Final = {"c": 100.0, "C": 100.0, "e": 100.0, "E": 100.0, "L": 1e7}
_STAMPS: Final = {"TimeUS": 1e6, "TimeMS": 1e3}
_FORMAT: Final = frozenset({"FMT", "FMTU", "UNIT", "MULT"})
_ABOUT: Final = frozenset({"PARM", "MSG", "FILE"})  # messages about the log, no rows of sensors
_DEFINES: Final = 128  # the number of FMT
_FMT: Final = np.dtype("u1, u1, S4, S16, S64")  # what it has behind its head


class _Message(NamedTuple):
    """A kind of message as it is defined, and where its messages are in the file."""

    name: str
    types: str
    layout: np.dtype[Any]
    places: list[int]

    def rows(self, content: NDArray[np.uint8], places: Sequence[int] | NDArray[Any]) -> Any:
        """Return messages at some places as an array with their fields."""
        windows = np.lib.stride_tricks.sliding_window_view(content, self.layout.itemsize)
        return windows[np.asarray(places, np.int64) + _HEAD].view(self.layout)[:, 0]


def _open(path: Path, options: Options) -> Iterator[Recording]:
    with open_plain(path) as file:
        mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    content, ledger = np.frombuffer(mapped, np.uint8), Ledger()
    messages = _messages(mapped, ledger)
    units: dict[int, bytes] = {}
    topics: dict[str, Topic] = {}
    for number, message in sorted(messages.items(), key=lambda pair: pair[1].name != "FMTU"):
        places = np.array(message.places)
        rows = message.rows(content, places)
        if message.name == "FMTU" and message.types == "QBNN":
            units = dict(zip(rows["FmtType"].tolist(), rows["UnitIds"].tolist(), strict=True))
        if message.name in _ABOUT:
            ledger.add("column", "dropped", "about the log", name=message.name)
        elif message.name not in _FORMAT:
            at = units.get(number, b"").find(b"#")  # the field that counts instances
            instance = rows[rows.dtype.names[at]] if 0 <= at < len(message.types) else 0 * places
            for i in np.unique(instance).tolist():
                name = f"{message.name}_{i:g}" if i else message.name
                topics[name] = _topic(content, message, places[instance == i])
    if not topics:
        raise TrajectoryError(f"{path} has no messages of ArduPilot's DataFlash format")
    selected = {name: topics[name] for name in chosen(topics, options)}
    yield Recording(path.stem, str(path), selected, ledger=ledger)


def _messages(mapped: mmap.mmap, ledger: Ledger) -> dict[int, _Message]:
    """Return the kinds of messages that there are by number, with the places of each."""
    kinds = {_DEFINES: _Message("FMT", "", _FMT, [])}
    at, behind, lost = 0, 0, 0  # this message, the end of the last one, bytes between messages
    while 0 <= at <= len(mapped) - _HEAD:
        kind = kinds.get(mapped[at + 2]) if mapped[at : at + 2] == _MARK else None
        if kind is None or at + _HEAD + kind.layout.itemsize > len(mapped):
            at = mapped.find(_MARK, at + 1)
            continue
        lost, behind = lost + at - behind, at + _HEAD + kind.layout.itemsize
        kind.places.append(at)
        if kind.layout is _FMT:
            number, length, *texts = np.frombuffer(mapped, _FMT, 1, at + _HEAD)[0].tolist()
            name, types, columns = map(_text, texts)
            pairs = zip(column_names(columns.split(",")), types, strict=False)
            layout = np.dtype([(field, _TYPES.get(letter, "V")) for field, letter in pairs])
            if layout.itemsize + _HEAD == length and len(layout.names or ()) == len(types):
                kinds.setdefault(number, _Message(name, types, layout, []))
        at = behind
    reason = "it is damaged: what lies between its messages is skipped"
    ledger.add("recording", "changed", reason, count=int(lost > 0), cell=f"{lost} bytes")
    return {number: kind for number, kind in kinds.items() if kind.places}


def _topic(content: NDArray[np.uint8], message: _Message, places: NDArray[Any]) -> Topic:
    """Return messages at some places as a topic, whose stamps are seconds since boot."""
    pairs = [*zip(message.layout.names or (), message.types, strict=True)]
    fields = {"time" if name in _STAMPS else name: (name, letter) for name, letter in pairs}

    def read(columns: Sequence[str], start: int, stop: int) -> dict[str, Column]:
        rows = message.rows(content, places[start:stop])
        return {name: _cells(rows[fields[name][0]], *fields[name]) for name in columns}

    return Topic(tuple(fields), len(places), read, "time" if "time" in fields else "")


def _cells(cells: NDArray[Any], name: str, letter: str) -> Column:
    if cells.dtype.kind == "S":
        return np.array([*map(_text, cells.tolist())], np.str_)
    return cells.astype(np.float64) / _STAMPS.get(name, _SCALES.get(letter, 1.0))


def _text(cell: bytes) -> str:
    return cell.partition(b"\0")[0].decode("utf-8", "replace")


READER: Final = Reader("ardupilot", "a log of ArduPilot", (".bin",), _open, options=TOPICS)
