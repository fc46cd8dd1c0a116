"""Bags of ROS 2, directories with a database or MCAP files, and of ROS 1, files."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from oodd_eval.errors import TrajectoryError
from oodd_logs.readers import TOPICS, Options, Reader, chosen, library
from oodd_logs.readers.gathered import LISTS, recording_of
from oodd_logs.recording import Recording

_BORDER: Final = "=" * 80 + "\n"
_WORD: Final = re.compile(r"[A-Za-z0-9_/]*")


def _open(path: Path, options: Options) -> Iterator[Recording]:
    library("rosbags.typesys")
    is_ros2 = path.is_dir()
    with library(f"rosbags.rosbag{1 + is_ros2}").Reader(path) as bag:
        selected = chosen(dict.fromkeys(c.topic for c in bag.connections), options)
        store = _types(bag.connections)
        defined = {c.topic for c in bag.connections if c.msgtype in store.fielddefs}
        undefined = [name for name in selected if name not in defined]
        if len(undefined) == len(selected) or ("topics" in options and undefined):
            raise TrajectoryError(
                f"{path}: definitions of {', '.join(undefined) or 'any topic'} are missing"
            )
        readable = [name for name in selected if name in defined]
        decode = store.deserialize_cdr if is_ros2 else store.deserialize_ros1
        messages = (
            (connection.topic, stamp, decode(raw, connection.msgtype))
            for connection, stamp, raw in bag.messages(
                [c for c in bag.connections if c.topic in readable]
            )
        )
        name = path.name if is_ros2 else path.stem
        yield recording_of(path, name, readable, messages, options.get("lists", ()))


def _types(connections: Sequence[Any]) -> Any:
    """Return the types of a bag's messages: those that it defines, and those of ROS itself."""
    # The library makes code of definitions: only names and numbers may get into it.
    typesys, formats = library("rosbags.typesys"), library("rosbags.interfaces")
    defined: dict[str, Any] = {}
    without = [c for c in connections if c.msgdef.format == formats.MessageDefinitionFormat.NONE]
    for connection in (c for c in connections if c not in without):
        text = connection.msgdef.data
        if connection.msgdef.format == formats.MessageDefinitionFormat.MSG:
            defined |= typesys.get_types_from_msg(text, connection.msgtype)
        else:
            bodies = [part.partition("\n")[2] for part in text.split(_BORDER)[1:]] or [text]
            for body in bodies:
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
    "the directory of a bag of ROS 2, or a .bag file of ROS 1",
    (".bag",),
    _open,
    extra="logs",
    options=TOPICS | LISTS,
    directory_markers=("metadata.yaml",),
)
