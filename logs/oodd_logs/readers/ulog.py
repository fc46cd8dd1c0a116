"""Logs of PX4 (ULog): a topic for each message and instance, with seconds since boot."""

import contextlib
import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from oodd_eval.errors import TrajectoryError
from oodd_logs.ledger import Ledger
from oodd_logs.readers import TOPICS, Options, Reader, chosen, library
from oodd_logs.readers.cells import column_names
from oodd_logs.recording import Recording, Topic

_TIME: Final = "time"
_STAMP: Final = "timestamp"


def _open(path: Path, options: Options) -> Iterator[Recording]:
    core = library("pyulog.core")
    with path.open("rb") as file:
        if file.read(7) != core.ULog.HEADER_BYTES:
            raise TrajectoryError(f"{path} is no ULog file: it does not begin with its mark")
    said = io.StringIO()  # the library prints what is damaged
    with contextlib.redirect_stdout(said):
        log = core.ULog(str(path))
    ledger = Ledger()
    if log.file_corruption:
        damage = " ".join(said.getvalue().split())[:200]
        if not log.data_list:
            raise TrajectoryError(f"{path} is damaged: {damage}")
        ledger.add(
            "recording", "changed", "it is damaged: parts that could be read are kept", cell=damage
        )
    topics = {
        f"{data.name}_{data.multi_id}" if data.multi_id else data.name: data.data
        for data in log.data_list
    }
    selected = chosen(topics, options)
    if not selected:
        raise TrajectoryError(f"{path} has no messages")
    fields = {"dropouts": len(log.dropouts), "first_second": log.start_timestamp / 1e6}
    yield Recording(path.stem, str(path), {n: _topic(topics[n]) for n in selected}, fields, ledger)


def _topic(data: dict[str, Any]) -> Topic:
    """Return messages as a topic; ``q[0]`` becomes ``q.0``, as a unit stands in brackets."""
    columns = {re.sub(r"\[(\d+)\]", r".\1", name): values for name, values in data.items()}
    seconds = columns.pop(_STAMP) / 1e6
    named = dict(zip(column_names(columns), columns.values(), strict=True))
    return Topic.of({_TIME: seconds, **{n: c for n, c in named.items() if n != _TIME}}, _TIME)


READER: Final = Reader(
    "ulog", "a ULog file", (".ulg", ".ulog"), _open, extra="logs", options=TOPICS
)
