"""Detectors in processes of their own, with limits: a failing one is a status, never a crash.

Harness and workers exchange JSON and arrays over pipes, nothing executable. A frame is an
8-byte little-endian length and that many bytes: UTF-8 JSON, or an array as `numpy.save` writes it
with pickling refused. The messages before say which of the two comes next.
"""

import io
import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any, Final

import numpy as np
import psutil
from numpy.typing import NDArray

from oodd_eval.data.bounded import npy_header
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import OoddError


class ChannelClosedError(OoddError, EOFError):
    """The other side ended before the message was complete."""


class ChannelGarbledError(OoddError, ValueError):
    """Bytes that are no message: the detector wrote into the pipe."""


MARK: Final = "OODD_EVAL_PROCESS"  # a value that only a process and all that it starts share
_PATIENCE: Final = 5.0  # seconds for which marked processes are hunted, should they multiply
END_POLL_SECONDS: Final = 0.005

LONGEST_FRAME: Final = 2**31  # bytes; a larger length was not written by a channel
LONGEST_MESSAGE: Final = 2**24  # bytes of JSON

# Of an array that a worker sends for a trajectory, at most so many bytes for each row are read:
# twice those of float64 scores, so that a wrong type can still be told by its name.
ROW_BYTES: Final = 16


class Channel:
    """A conversation over two file descriptors; -1 for the one of a direction that is not used.

    `wait` is called before every read, and may raise to give up; by default reads block.
    """

    def __init__(self, reading: int, writing: int, wait: Callable[[], None] = lambda: None) -> None:
        self._reading, self._writing, self._wait = reading, writing, wait

    def send(self, message: dict[str, Any]) -> None:
        """Send a JSON object. Values JSON does not know are sent as their text."""
        self._send_frame(json.dumps(message, default=repr).encode())

    def receive(self) -> dict[str, Any]:
        """Receive a JSON object; `ChannelGarbledError` when something else comes."""
        try:
            message = json.loads(self._receive_frame(LONGEST_MESSAGE))
        except (ValueError, RecursionError) as error:
            raise ChannelGarbledError(f"expected JSON over the pipe: {error}") from None
        if not isinstance(message, dict):
            raise ChannelGarbledError(f"expected a JSON object over the pipe, got {message!r:.80}")
        return message

    def send_array(self, array: NDArray[Any]) -> None:
        """Send an array that holds no Python objects."""
        buffer = io.BytesIO()
        np.save(buffer, array, allow_pickle=False)
        self._send_frame(buffer.getbuffer())

    def receive_array(self, most: int = LONGEST_FRAME) -> NDArray[Any]:
        """Receive an array of at most so many bytes, header included; raise as `receive` does."""
        frame = self._receive_frame(most)
        try:
            return _read_array(frame)
        except Exception as error:  # noqa: BLE001  numpy raises many kinds for a strange header
            raise ChannelGarbledError(f"expected an array over the pipe: {error}") from None

    def send_trajectory(self, trajectory: Trajectory) -> None:
        """Send what a detector may know of an episode."""
        self.send_array(trajectory.observations)
        self.send_array(trajectory.actions)

    def receive_trajectory(self) -> Trajectory:
        """Receive an episode."""
        observations = self.receive_array()
        return Trajectory(observations, self.receive_array())

    def _send_frame(self, payload: bytes | memoryview) -> None:
        for part in (len(payload).to_bytes(8, "little"), payload):
            rest = memoryview(part)
            while rest:
                rest = rest[os.write(self._writing, rest) :]

    def _receive_frame(self, most: int) -> bytes:
        length = int.from_bytes(self._receive_bytes(8), "little")
        if length > most:
            raise ChannelGarbledError(f"a message of {length} bytes was announced over the pipe")
        return self._receive_bytes(length)

    def _receive_bytes(self, n: int) -> bytes:
        parts = bytearray()
        while len(parts) < n:
            self._wait()
            part = os.read(self._reading, min(n - len(parts), 1 << 20))
            if not part:
                raise ChannelClosedError(f"the other side ended after {len(parts)} of {n} bytes")
            parts += part
        return bytes(parts)


def _read_array(content: bytes) -> NDArray[Any]:
    """Read what `numpy.save` has written; anything else raises, before room is made for it."""
    file = io.BytesIO(content)
    dtype, size = npy_header(file)
    if size != len(content) - file.tell():
        raise ValueError(f"{len(content) - file.tell()} bytes for {size} of {dtype}")
    file.seek(0)
    array: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    return array


def end_all(pid: int, mark: str) -> None:
    """Kill a process with its group, its descendants, and what has its mark in the environment."""
    strays: list[psutil.Process] = []
    with suppress(psutil.Error):
        strays = psutil.Process(pid).children(recursive=True)
    for kill in (os.killpg, os.kill):
        with suppress(ProcessLookupError, PermissionError):
            kill(pid, signal.SIGKILL)
    deadline = time.monotonic() + _PATIENCE
    strays, clean = [*strays, *_marked(mark)], 1
    # A process whose parent ended during one search is found by the next one.
    while (strays or clean < 2) and time.monotonic() < deadline:
        for stray in strays:
            with suppress(psutil.Error):
                stray.kill()
        time.sleep(END_POLL_SECONDS)
        clean = 1 if strays else clean + 1
        strays = list(_marked(mark))


def _marked(mark: str) -> Iterator[psutil.Process]:
    """Yield the other running processes whose environment holds a mark."""
    for pid in psutil.pids():
        with suppress(psutil.Error, OSError):
            process = psutil.Process(pid)
            if pid != os.getpid() and process.environ().get(MARK) == mark:
                yield process
