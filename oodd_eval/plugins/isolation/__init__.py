"""Detectors in processes of their own, with limits: a failing one is a status, never a crash.

Harness and workers exchange JSON and arrays over a socket, nothing executable: frames of
`multiprocessing.connection`, each UTF-8 JSON, or an array as `numpy.save` writes it with pickling
refused. The messages before say which of the two comes next.
"""

import io
import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, Final

import numpy as np
import psutil
from numpy.typing import NDArray

from oodd_eval.data.bounded import npy_header
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import OoddError

MARK: Final = "OODD_EVAL_PROCESS"  # a value that only a process and all that it starts share

LONGEST_FRAME: Final = 2**31  # bytes; a larger length was not written by a channel
LONGEST_MESSAGE: Final = 2**24  # bytes of JSON
LOG_BYTES: Final = 64_000  # of what is printed, the last ones are kept
CHUNK: Final = 64  # trajectories that a worker scores at once
PROCESSES: Final = 256  # at most, in a sandbox
SCORED: Final = 93  # exit code of a process that has scored its group, and of no other

# Of an array that a worker sends for a trajectory, at most so many bytes for each row are read:
# twice those of float64 scores, so that a wrong type can still be told by its name.
ROW_BYTES: Final = 16

POLL_SECONDS: Final = 0.05  # between two looks at a process
LOOK_SECONDS: Final = 0.5  # between two looks at all that it has started, which take longer
END_POLL_SECONDS: Final = 0.005
HUNT_SECONDS: Final = 5.0  # for which marked processes are hunted, should they multiply
CLOSED_SECONDS: Final = 5.0  # for which a worker that has closed its channel may take to end
FIT_END_SECONDS: Final = 1.0  # that threads and processes of a fit have to end


class ChannelClosedError(OoddError, EOFError):
    """The other side ended before the message was complete."""


class ChannelGarbledError(OoddError, ValueError):
    """Bytes that are no message: the detector wrote into the channel."""


class Channel:
    """A conversation over a socket, which it closes.

    `check` is called after every frame that was read, and may raise to give up.
    """

    def __init__(self, descriptor: int, check: Callable[[], None] = lambda: None) -> None:
        self._connection, self._check = Connection(descriptor), check
        self.close = self._connection.close

    def send(self, message: dict[str, Any]) -> None:
        """Send a JSON object. Values JSON does not know are sent as their text."""
        self._connection.send_bytes(json.dumps(message, default=repr).encode())

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
        self._connection.send_bytes(buffer.getbuffer())

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

    def _receive_frame(self, most: int) -> bytes:
        try:
            frame = self._connection.recv_bytes(most)
        except (EOFError, OSError) as error:
            self._check()
            if isinstance(error, EOFError) or self._connection.readable:
                raise ChannelClosedError(f"the other side ended: {error}") from None
            raise ChannelGarbledError(f"a message over the pipe is too long: {error}") from None
        self._check()
        return frame


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
    deadline = time.monotonic() + HUNT_SECONDS
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
