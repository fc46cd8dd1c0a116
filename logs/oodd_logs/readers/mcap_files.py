"""MCAP files: channels of JSON, and of ROS 2 messages with their definitions."""

import contextlib
import io
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

from oodd_eval.data.bounded import EPISODE
from oodd_eval.errors import OoddError
from oodd_logs.ledger import Ledger
from oodd_logs.readers import TOPICS, Options, Reader, chosen, library
from oodd_logs.readers.gathered import LISTS, RECOVERED, readable_topics, recording_of
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
            named = [r for r in _records(path) if hasattr(r, "id")]
            channels = {r.id: r for r in named if hasattr(r, "message_encoding")}
            schemas = {r.id: r for r in named if hasattr(r, "encoding")}
            ledger.add("recording", "changed", RECOVERED)
        else:
            channels, schemas = summary.channels, summary.schemas
            for chunk in summary.chunk_indexes:
                _check_chunk(path, chunk.uncompressed_size)
        selected = chosen(dict.fromkeys(c.topic for c in channels.values()), options)
        decoders: dict[int, Callable[[bytes], Any]] = {}
        unread: dict[str, str] = {}
        for channel in (c for c in channels.values() if c.topic in selected):
            schema, encoding = schemas.get(channel.schema_id), channel.message_encoding
            with contextlib.redirect_stderr(io.StringIO()):  # it prints what it cannot read
                decoder = ros2.decoder_for(encoding, schema)
            decoder = json.loads if encoding == "json" else decoder
            if decoder is None:
                unread[channel.topic] = encoding
            else:
                decoders[channel.id] = decoder
        topics = readable_topics(path, options, selected, unread, ledger)
        if summary is None:
            messages = (record for record in _records(path) if hasattr(record, "publish_time"))
        else:
            messages = (message for _, _, message in reader.iter_messages(topics))
        decoded = (
            (channels[m.channel_id].topic, m.log_time, decoders[m.channel_id](m.data))
            for m in messages
            if m.channel_id in decoders and channels[m.channel_id].topic in topics
        )
        yield recording_of(path, options, topics, decoded, ledger)


def _check_chunk(path: Path, size: int) -> None:
    if size > EPISODE.most:
        raise EPISODE.failure(f"{path} has a chunk of {size} bytes")


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
