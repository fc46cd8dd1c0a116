"""The process that holds one detector: it receives trajectories without names and returns scores.

It never holds onsets, anomalies, twins' pairing or the name of the environment. Training
trajectories come first, in the order of the split; then, shuffled together and in chunks, the
trajectories to score. Messages have descriptors of their own, so that nothing that a detector
prints gets between them.
"""

from __future__ import annotations

import faulthandler
import math
import os
import resource
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final, NoReturn

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.trajectory import Trajectory, TrajectorySequence
from oodd_eval.errors import ContractError, TrajectoryError
from oodd_eval.plugins.contract import StorableDetector, make_detector, score_chunk
from oodd_eval.plugins.discovery import describe, offer_of
from oodd_eval.plugins.isolation import Channel

_STATUSES: Final[dict[type[BaseException], str]] = {
    MemoryError: "oom", NotImplementedError: "incompatible", ContractError: "invalid",
    ModuleNotFoundError: "unavailable",
}  # fmt: skip
"""Status of a cell by what its detector raised."""


class TrajectoryFile(TrajectorySequence):
    """Trajectories in a temporary file: a sequence that may be larger than memory.

    Every access reads the trajectory again, so that only those that somebody holds are in memory.
    """

    def __init__(self, trajectories: Iterable[Trajectory]) -> None:
        self._places: list[tuple[int, tuple[int, ...], tuple[int, ...]]] = []
        self._file = tempfile.TemporaryFile(prefix="oodd-eval-")  # noqa: SIM115  open as long as self
        for t in trajectories:
            self._places.append((self._file.tell(), t.observations.shape, t.actions.shape))
            self._file.write(t.observations.data)
            self._file.write(t.actions.data)
        self._file.flush()

    def __len__(self) -> int:
        return len(self._places)

    def _one(self, i: int) -> Trajectory:
        start, observations, actions = self._places[i]
        middle = start + 4 * math.prod(observations)
        return Trajectory(self._matrix(start, observations), self._matrix(middle, actions))

    def close(self) -> None:
        """Give the file back; nothing can be read any more."""
        self._file.close()

    def _matrix(self, start: int, shape: tuple[int, ...]) -> NDArray[np.float32]:
        # Reading at a place leaves alone the position that forked processes share.
        content = os.pread(self._file.fileno(), 4 * math.prod(shape), start)
        if len(content) != 4 * math.prod(shape):
            raise TrajectoryError("the temporary file of training trajectories was cut short")
        return np.frombuffer(content, dtype=np.float32).reshape(shape)


def reason_of(error: BaseException) -> str:
    """Return one line: what was raised, and where in the detector's own code."""
    if isinstance(error, SystemExit):
        return f"called sys.exit({error.code!r})"
    frames = traceback.extract_tb(error.__traceback__)
    place = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    return describe(error) + ("" if isinstance(error, ContractError) else place)


def peak_rss_mb() -> float:
    """Return the largest resident memory of this process so far, in MB of 10^6 bytes."""
    # Linux keeps it per program; getrusage would also count the harness this was started from.
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        kib = next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM"))
        return int(kib) * 1024 / 1e6
    except (OSError, StopIteration):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6


def serve(channel: Channel) -> None:
    """Fit the requested detector and score what comes until a chunk of zero."""
    request = channel.receive()
    train = TrajectoryFile(channel.receive_trajectory() for _ in range(request["train"]))
    spec = offer_of(request["plugin"], request["detector"]).spec

    start = time.perf_counter()
    given = {name: request[name] for name in ("seed", "horizon", "parameters")}
    detector = make_detector(spec.factory, **given)
    if not request["load"]:
        detector.fit(train)
    elif isinstance(detector, StorableDetector):
        detector.load(Path(request["load"]))
    else:
        raise ContractError("a detector that had saved itself has no load(directory) any more")
    seconds_fit = time.perf_counter() - start
    if request["save"] and isinstance(detector, StorableDetector):
        # A failure costs a later run the time of a fit, no more.
        directory = Path(request["save"])
        try:
            detector.save(directory)
        except Exception:  # noqa: BLE001  a detector may raise anything
            traceback.print_exc()
            shutil.rmtree(directory)
            directory.mkdir()
    channel.send({"seconds_fit": seconds_fit, "warm_up": getattr(detector, "warm_up", 0)})

    seconds_score = 0.0
    while size := channel.receive()["score"]:
        chunk = [channel.receive_trajectory() for _ in range(size)]
        start = time.perf_counter()
        scores = score_chunk(detector, chunk)
        seconds_score += time.perf_counter() - start
        for one in scores:
            if not isinstance(one, np.ndarray):
                channel.send({"type": type(one).__name__})
            elif one.dtype.hasobject:
                channel.send({"type": "ndarray of object"})
            else:
                channel.send({"type": "array"})
                channel.send_array(np.asarray(one))
    channel.send({"seconds_score": seconds_score, "peak_rss_mb": peak_rss_mb()})


def connect(arguments: Sequence[str]) -> Channel:
    """Return the channel to the harness, from the command line of a process that it has started.

    The harness never writes to the lifeline: reading it ends when the harness is no more, which
    ends this process and whatever it has started, too.
    """
    reading, writing, lifeline = descriptors = [int(a) for a in arguments]
    for descriptor in descriptors:
        os.set_inheritable(descriptor, False)

    def wait() -> None:
        os.read(lifeline, 1)
        os.killpg(os.getpgid(0), signal.SIGKILL)

    threading.Thread(target=wait, daemon=True).start()
    faulthandler.enable()
    return Channel(reading, writing)


def main(arguments: Sequence[str]) -> NoReturn:
    """Serve one request and end the process, whatever the detector has left running."""
    channel = connect(arguments)
    code = 0
    try:
        serve(channel)
    except BaseException as error:  # noqa: BLE001  a detector may raise anything; all is reported
        traceback.print_exc()
        status = next((s for kind, s in _STATUSES.items() if isinstance(error, kind)), "error")
        channel.send({"status": status, "reason": reason_of(error)})
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    # Threads and exit handlers of the detector have no say any more: the scores are sent.
    os._exit(code)


if __name__ == "__main__":
    main(sys.argv[1:])
