"""MCAP files: channels of JSON, and of ROS 2 messages with their definitions."""

import contextlib
import io
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

from oodd_eval.data.bounded import EPISODE
from oodd_eval.errors import OoddError, TrajectoryError
from oodd_logs.ledger import Ledger
from oodd_logs.readers import TOPICS, Options, Reader, chosen, library
from oodd_logs.readers.gathered import LISTS, recording_of
from oodd_logs.recording import Recording


def _open(path: Path, options: Options) -> Iterator[Recording]:
    reading, ros2 = library("mcap.reader"), library("mcap_ros2.decoder").DecoderFactory()
    ledger = Ledger()
    with path.open("rb") as file:
        reader = reading.SeekingReader(file, record_size_limit=EPISODE.most)
        try:
            summary = reader.get_summary()
        except library("mcap.exceptions").McapError:
            summary = None
        if summary is None:
            channels, schemas = _recovered_channels(path)
            ledger.add(
                "recording", "changed", "it was not closed: recovered up to where it breaks off"
            )
        else:
            channels, schemas = summary.channels, summary.schemas
            for chunk in summary.chunk_indexes:
                _check_chunk(path, chunk.uncompressed_size)
        selected = chosen(dict.fromkeys(c.topic for c in channels.values()), options)
        decoders: dict[int, Callable[[bytes], Any]] = {}
        unread: dict[str, str] = {}
        for channel in (c for c in channels.values() if c.topic in selected):
            schema = schemas.get(channel.schema_id)
            with contextlib.redirect_stderr(io.StringIO()):  # it prints what it cannot read
                decoder = ros2.decoder_for(channel.message_encoding, schema)
            decoder = json.loads if channel.message_encoding == "json" else decoder
            if decoder is None:
                unread[channel.topic] = channel.message_encoding
            else:
                decoders[channel.id] = decoder
        if not decoders or ("topics" in options and unread):
            raise TrajectoryError(
                f"{path} has {', '.join(f'{t} ({e})' for t, e in unread.items()) or 'no channels'}"
                ", expected channels of JSON, or of ROS 2 with their definitions"
            )
        for topic, encoding in unread.items():
            ledger.add("column", "dropped", f"messages of {encoding} are not read", name=topic)
        readable = [topic for topic in selected if topic not in unread]
        if summary is None:
            messages = (record for record in _records(path) if hasattr(record, "log_time"))
        else:
            messages = (message for _, _, message in reader.iter_messages(readable))
        decoded = (
            (channels[m.channel_id].topic, m.log_time, decoders[m.channel_id](m.data))
            for m in messages
            if m.channel_id in decoders
        )
        lists = options.get("lists", ())
        yield recording_of(path, path.stem, readable, decoded, lists=lists, ledger=ledger)


def _check_chunk(path: Path, size: int) -> None:
    if size > EPISODE.most:
        raise EPISODE.failure(f"{path} has a chunk of {size} bytes")


def _recovered_channels(path: Path) -> tuple[dict[int, Any], dict[int, Any]]:
    """Return the channels and schemas of a file without its summary, by their numbers."""
    channels, schemas = dict[int, Any](), dict[int, Any]()
    for record in _records(path):
        if hasattr(record, "message_encoding"):
            channels[record.id] = record
        elif hasattr(record, "encoding"):
            schemas[record.id] = record
    return channels, schemas


def _records(path: Path) -> Iterator[Any]:
    """Yield the records of a file up to where it breaks."""
    stream = library("mcap.stream_reader")
    with path.open("rb") as file:
        reader = stream.StreamReader(file, emit_chunks=True, record_size_limit=EPISODE.most)
        try:
            for record in reader.records:
                if hasattr(record, "uncompressed_size") and hasattr(record, "data"):
                    _check_chunk(path, record.uncompressed_size)
                    yield from stream.breakup_chunk(record)
                else:
                    yield record
        except OoddError:
            raise
        except Exception:  # noqa: BLE001  the library raises many kinds for what is cut
            return


READER: Final = Reader(
    "mcap", "an MCAP file", (".mcap",), _open, extra="logs", options=TOPICS | LISTS
)
