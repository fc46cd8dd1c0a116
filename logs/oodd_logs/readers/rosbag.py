"""Bags of ROS 2, directories with a database or MCAP files, and of ROS 1, files."""

import contextlib
import functools
import io
import itertools
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from oodd_eval.data.bounded import EPISODE
from oodd_eval.errors import TrajectoryError
from oodd_logs.ledger import Ledger
from oodd_logs.readers import TOPICS, Options, Reader, chosen, in_order, library
from oodd_logs.readers.gathered import LISTS, RECOVERED, readable_topics, recording_of
from oodd_logs.recording import Recording

_BORDER: Final = "=" * 80 + "\n"
_WORD: Final = re.compile(r"[A-Za-z0-9_/]*")


Messages = Callable[[Sequence[Any]], Iterator[tuple[Any, int, bytes]]]
"""Called with connections; yields these, nanoseconds, and messages."""


def _open(path: Path, options: Options) -> Iterator[Recording]:
    library("rosbags.typesys")
    databases = sorted(path.glob("*.db3"), key=lambda file: in_order(file.name))
    if path.suffix.lower() == ".db3":
        databases = [path]
    with contextlib.ExitStack() as stack:
        if not databases or (path / "metadata.yaml").exists():
            bag = library(f"rosbags.rosbag{1 + path.is_dir()}").Reader(path)
            try:
                bag.open()
            except Exception:
                if path.is_dir() and not databases:
                    raise
            else:
                stack.callback(bag.close)
                yield _recording(path, options, bag.connections, bag.messages, Ledger())
                return
        ledger = Ledger()
        ledger.add("recording", "changed", RECOVERED)
        if not databases:
            yield _recording(path, options, *_unindexed(path), ledger)
        # Parts of one recording are numbered.
        for _, files in itertools.groupby(databases, lambda file: re.sub(r"_\d+$", "", file.stem)):
            parts = []
            for file in files:
                parts.append(library("rosbags.rosbag2.storage_sqlite3").Sqlite3Reader(file))
                parts[-1].open()
                stack.callback(parts[-1].close)
            source = file if len(parts) < len(databases) else path
            connections = [c for part in parts for c in part.connections]
            messages = functools.partial(_joined, parts)
            yield _recording(source, options, connections, messages, ledger)


def _recording(
    path: Path, options: Options, connections: Sequence[Any], read: Messages, ledger: Ledger
) -> Recording:
    """Return the messages of a bag, by its connections."""
    selected = chosen(dict.fromkeys(c.topic for c in connections), options)
    store = _types(connections)
    defined = {c.topic for c in connections if c.msgtype in store.fielddefs}
    undefined = {name: "without a definition" for name in selected if name not in defined}
    topics = readable_topics(path, options, selected, undefined, ledger)
    decode = store.deserialize_ros1 if path.suffix.lower() == ".bag" else store.deserialize_cdr
    messages = read([c for c in connections if c.topic in topics])
    decoded = ((c.topic, stamp, decode(raw, c.msgtype)) for c, stamp, raw in messages)
    return recording_of(path, options, topics, decoded, ledger)


def _joined(parts: Sequence[Any], connections: Sequence[Any]) -> Iterator[tuple[Any, int, bytes]]:
    """Yield the messages of databases, each up to where it breaks."""
    for part in parts:
        owned = [c for c in connections if c in part.connections]
        with contextlib.suppress(library("apsw").Error):
            yield from part.messages(owned) if owned else ()


def _unindexed(path: Path) -> tuple[list[Any], Messages]:
    """Return the connections and messages of a bag of ROS 1 without its index, read in a row."""
    rosbag = library("rosbags.rosbag1.reader")

    def messages(selected: Sequence[Any] | None) -> Iterator[tuple[Any, int, bytes]]:
        """Yield messages of some connections; those without any for None, with the stamp -1."""
        bag, connections = rosbag.Reader(path), dict[int, Any]()
        names = {connection.id for connection in selected or ()}
        with path.open("rb") as file:
            if not file.readline(100).startswith(b"#ROSBAG V2.0"):
                raise TrajectoryError(f"{path} is no bag of version 2.0")
            files: list[Any] = [file]
            with contextlib.suppress(rosbag.ReaderError, OSError, EOFError, ValueError):
                while True:
                    if files[-1] is not file and files[-1].tell() == len(files[-1].getbuffer()):
                        files.pop()
                    stream = files[-1]
                    start, header = stream.tell(), rosbag.Header.read(stream)
                    kind = header.get_uint8("op")
                    if kind == rosbag.RecordType.CONNECTION:
                        stream.seek(start)
                        bag.bio = stream
                        connection = bag.read_connection()
                        connections[connection.id] = connection
                        if selected is None:
                            yield connection, -1, b""
                        continue
                    size = rosbag.read_uint32(stream)
                    EPISODE.check(str(path), np.dtype("u1"), size)
                    content = rosbag.read_bytes(stream, size)
                    if kind == rosbag.RecordType.MSGDATA and header.get_uint32("conn") in names:
                        owner = connections[header.get_uint32("conn")]
                        yield owner, header.get_time("time"), content
                    elif kind == rosbag.RecordType.CHUNK:
                        EPISODE.check(str(path), np.dtype("u1"), header.get_uint32("size"))
                        unpack = rosbag.decompressors[header.get_string("compression")]
                        files.append(io.BytesIO(unpack(content)))

    return [*{c.id: c for c, _, _ in messages(None)}.values()], messages


def _types(connections: Sequence[Any]) -> Any:
    """Return the types of a bag's messages: those that it defines, and those of ROS itself."""
    # The library makes code of definitions: only names and numbers may get into it.
    typesys, formats = library("rosbags.typesys"), library("rosbags.interfaces")
    defined: dict[str, Any] = {}
    without = False
    for connection in connections:
        text, form = connection.msgdef.data, connection.msgdef.format
        without |= form == formats.MessageDefinitionFormat.NONE
        if form == formats.MessageDefinitionFormat.MSG:
            defined |= typesys.get_types_from_msg(text, connection.msgtype)
        elif form == formats.MessageDefinitionFormat.IDL:
            for body in [part.partition("\n")[2] for part in text.split(_BORDER)[1:]] or [text]:
                defined |= typesys.get_types_from_idl(body)
    for name, (constants, members) in defined.items():
        _check_words((name, [constant[:2] for constant in constants], members))
        if any(type(value) not in {bool, int, float, str} for _, _, value in constants):
            raise TrajectoryError(f"the definition of {name} has a constant of no plain type")
    stores = typesys.Stores
    store = typesys.get_typestore(stores.LATEST if without else stores.EMPTY)
    store.register({k: v for k, v in defined.items() if k not in store.fielddefs})
    return store


def _check_words(value: Any) -> None:
    """Raise `TrajectoryError` where a definition has anything but names and numbers."""
    if isinstance(value, list | tuple):
        for inner in value:
            _check_words(inner)
    elif not isinstance(value, int) and not (isinstance(value, str) and _WORD.fullmatch(value)):
        raise TrajectoryError(f"a definition of messages has the name {value!r:.80}")


READER: Final = Reader(
    "rosbag",
    "the directory or .db3 file of a bag of ROS 2, or a .bag file of ROS 1",
    (".bag", ".db3"),
    _open,
    extra="logs",
    options=TOPICS | LISTS,
    directory_markers=("metadata.yaml", "*.db3"),
)
