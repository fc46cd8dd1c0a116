"""Detectors in processes of their own, with limits: a failing one is a status, never a crash.

The harness makes every process and every socket. A process that scores gets one group of
trajectories over a socket that no other process has, and ends with it. What goes over a socket is
JSON and arrays, nothing executable: frames of `multiprocessing.connection`, each UTF-8 JSON, or an
array as `numpy.save` writes it with pickling refused, or the numbers of rows or of
their scores.
"""

import ctypes
import io
import json
import os
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.reduction import recv_handle, send_handle
from typing import Any, Final

import numpy as np
import psutil
from numpy.typing import NDArray

from oodd_eval.data.bounded import npy_header
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import ContractError, OoddError
from oodd_eval.plugins.state import MOST_ARRAYS, MOST_BYTES, PackedState, pack

MARK: Final = "OODD_EVAL_PROCESS"  # a value that only a process and all that it starts share

LONGEST_FRAME: Final = 2**31  # bytes; a larger length was not written by a channel
LONGEST_MESSAGE: Final = 2**24  # bytes of JSON
HEADER_BYTES: Final = 4096  # of an array, at most
LOG_BYTES: Final = 64_000  # of what is printed, the last ones are kept
CHUNK: Final = 64  # trajectories that a worker scores at once
SCORED: Final = 93  # exit code of a process that has scored its group, and of no other

SCORES: Final = b"="  # before the scores of rows, so that no JSON is taken for them
COPY_SECONDS: Final = 0.01  # of a copy of a detector; what takes longer costs more than it saves

MOST_PREFIXES: Final = 2000
"""Rows of the longest episode that is scored row by row without ``update``, by its prefixes."""

# Of an array that a worker sends for a trajectory, at most so many bytes for each row are read:
# twice those of float64 scores, so that a wrong type can still be told by its name.
ROW_BYTES: Final = 16

PARENT_DEATH_SIGNAL: Final = 1  # options of prctl
CHILD_SUBREAPER: Final = 36

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

    `check` is called when the other side has ended, and may raise to say why.
    """

    def __init__(self, descriptor: int, check: Callable[[], None] = lambda: None) -> None:
        self._connection, self._check = Connection(descriptor), check
        self.send_bytes, self.close = self._connection.send_bytes, self._connection.close

    def send(self, message: dict[str, Any]) -> None:
        """Send a JSON object. Values JSON does not know are sent as their text."""
        self.send_bytes(json.dumps(message, default=repr).encode())

    def receive(self) -> dict[str, Any]:
        """Receive a JSON object; `ChannelGarbledError` when something else comes."""
        return message_of(self.receive_bytes())

    def send_array(self, array: NDArray[Any]) -> None:
        """Send an array that holds no Python objects."""
        buffer = io.BytesIO()
        np.save(buffer, array, allow_pickle=False)
        self.send_bytes(buffer.getbuffer())

    def receive_array(self, most: int = LONGEST_FRAME) -> NDArray[Any]:
        """Receive an array of at most so many bytes, header included; raise as `receive` does."""
        frame = self.receive_bytes(most)
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

    def send_state(self, packed: PackedState) -> None:
        """Send a detector's state."""
        self.send({"names": [*packed.arrays], "text": packed.text})
        for array in packed.arrays.values():
            self.send_array(array)

    def receive_state(self) -> PackedState:
        """Receive a detector's state, within its bounds; raise as `receive` does."""
        message, left, state = self.receive(), MOST_BYTES, {}
        try:
            state = {**json.loads(message["text"])}
            for name in message["names"][: MOST_ARRAYS + 1]:
                state[name] = array = self.receive_array(left + HEADER_BYTES)
                left -= array.nbytes
            return pack(state)
        except (ContractError, LookupError, TypeError, ValueError, RecursionError) as error:
            raise ChannelGarbledError(f"expected a state over the pipe: {error}") from None

    def send_descriptor(self, descriptor: int) -> None:
        """Send an open descriptor to the process on the other side."""
        send_handle(self._connection, descriptor, None)

    def receive_descriptor(self) -> int:
        """Receive a descriptor, which is this process's from now on."""
        descriptor = recv_handle(self._connection)
        os.set_inheritable(descriptor, False)
        return descriptor

    def hang_up(self) -> None:
        """End the conversation from another thread: what was sent can still be read."""
        with suppress(OSError), socket.socket(fileno=os.dup(self._connection.fileno())) as end:
            end.shutdown(socket.SHUT_RDWR)

    def receive_bytes(self, most: int = LONGEST_MESSAGE) -> bytes:
        """Receive a frame of at most so many bytes, whatever it is."""
        try:
            return self._connection.recv_bytes(most)
        except (EOFError, OSError) as error:
            self._check()
            if isinstance(error, EOFError) or self._connection.readable:
                raise ChannelClosedError(f"the other side ended: {error}") from None
            raise ChannelGarbledError(f"a message over the pipe is too long: {error}") from None


def message_of(frame: bytes) -> dict[str, Any]:
    """Return the JSON object of a frame; `ChannelGarbledError` for anything else."""
    try:
        message = json.loads(frame)
    except (ValueError, RecursionError) as error:
        raise ChannelGarbledError(f"expected JSON over the pipe: {error}") from None
    if not isinstance(message, dict):
        raise ChannelGarbledError(f"expected a JSON object over the pipe, got {message!r:.80}")
    return message


def _read_array(content: bytes) -> NDArray[Any]:
    """Read what `numpy.save` has written; anything else raises, before room is made for it."""
    file = io.BytesIO(content)
    dtype, size = npy_header(file)
    if size != len(content) - file.tell():
        raise ValueError(f"{len(content) - file.tell()} bytes for {size} of {dtype}")
    file.seek(0)
    array: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    return array


def process_control(option: int, value: int) -> None:
    """Ask the system for something about this process; only Linux can be asked."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(option, value, 0, 0, 0)


def end_with(parent: int) -> None:
    """Have the system kill this process when its parent, or the thread that made it, has ended."""
    process_control(PARENT_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)  # It had ended before the system was asked.


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
