"""MCAP files: channels of JSON, and of ROS 2 messages with their definitions."""

import contextlib
import io
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

from oodd_eval.data.bounded import EPISODE
from oodd_eval.errors import TrajectoryError
from oodd_logs.readers import TOPICS, Options, Reader, chosen, library
from oodd_logs.readers.gathered import LISTS, recording_of
from oodd_logs.recording import Recording


def _open(path: Path, options: Options) -> Iterator[Recording]:
    reading, ros2 = library("mcap.reader"), library("mcap_ros2.decoder").DecoderFactory()
    with path.open("rb") as file:
        reader = reading.SeekingReader(file, record_size_limit=EPISODE.most)
        summary = reader.get_summary()
        if summary is None:
            raise TrajectoryError(f"{path} has no summary: was it closed? Try: mcap recover")
        for chunk in summary.chunk_indexes:
            if chunk.uncompressed_size > EPISODE.most:
                raise EPISODE.failure(f"{path} has a chunk of {chunk.uncompressed_size} bytes")
        selected = chosen(dict.fromkeys(c.topic for c in summary.channels.values()), options)
        decoders: dict[int, Callable[[bytes], Any]] = {}
        unread: dict[str, str] = {}
        for channel in (c for c in summary.channels.values() if c.topic in selected):
            schema = summary.schemas.get(channel.schema_id)
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
        readable = [topic for topic in selected if topic not in unread]
        messages = (
            (channel.topic, message.log_time, decoders[channel.id](message.data))
            for _, channel, message in reader.iter_messages(readable)
        )
        yield recording_of(path, path.stem, readable, messages, options.get("lists", ()))


READER: Final = Reader(
    "mcap", "an MCAP file", (".mcap",), _open, extra="logs", options=TOPICS | LISTS
)
