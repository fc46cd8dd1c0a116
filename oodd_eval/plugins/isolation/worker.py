"""The process that holds one detector: it receives trajectories without names and returns scores.

It never holds onsets, anomalies, twins' pairing or the name of the environment. It makes the
detector, which learns from training trajectories or takes over a state, and then does what it is
ordered over its channel, until that ends: score or explain some trajectories, score rows one by
one, tell what its voices cost, or fork. Every fork has a channel of its own, gets one group and
ends with it, so nothing that an honest detector remembers of a group reaches the next one, and two
episodes with the same seed, which agree bit for bit before the onset, never meet.

Messages have a descriptor of their own, so that nothing that a detector prints gets between them.
"""

import faulthandler
import gc
import math
import numbers
import os
import resource
import signal
import struct
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NoReturn

import numpy as np
import psutil
from numpy.typing import NDArray

from oodd_eval.data.files import flush_streams
from oodd_eval.data.trajectory import Trajectory, TrajectorySequence
from oodd_eval.errors import ContractError, TrajectoryError, UsageError
from oodd_eval.plugins.contract import (
    Detector,
    StorableDetector,
    StreamingDetector,
    copied,
    fit_detector,
    float_scores,
    make_detector,
    score_chunk,
)
from oodd_eval.plugins.discovery import describe, offer_of, printable
from oodd_eval.plugins.explanations import explain_chunk, explains
from oodd_eval.plugins.isolation import (
    CHILD_SUBREAPER,
    COPY_SECONDS,
    FIT_END_SECONDS,
    MARK,
    ROW_BYTES,
    SCORED,
    SCORES,
    Channel,
    ChannelClosedError,
    end_all,
    end_with,
    process_control,
)
from oodd_eval.plugins.state import PackedState, pack
from oodd_eval.plugins.voices import VoicedDetector, costs_of_voices

_STATUSES: Final[dict[type[BaseException], str]] = {
    MemoryError: "oom",
    NotImplementedError: "incompatible",
    ContractError: "invalid",
    ModuleNotFoundError: "unavailable",
}
"""Status of a cell by what its detector raised."""


class TrajectoryFile(TrajectorySequence):
    """Trajectories in a temporary file, read at every access: they may be larger than memory."""

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
    origin = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
    return describe(error) + ("" if isinstance(error, ContractError) else origin)


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


def serve(channel: Channel, packages: Sequence[Path] = ()) -> None:
    """Make the requested detector, have it fitted, tell of it, and do what is ordered."""
    threads, pid = psutil.Process().num_threads(), os.getpid()
    request = channel.receive()
    detector = _detector(request, packages)
    start = time.perf_counter()
    if request["restore"]:
        if not isinstance(detector, StorableDetector):
            raise ContractError("the detector has state but no restore")
        detector.restore(channel.receive_state().state())
    else:
        train, failures = (
            None if n is None else TrajectoryFile(channel.receive_trajectory() for _ in range(n))
            for n in (request["train"], request["failures"])
        )
        start = time.perf_counter()
        fit_detector(detector, train or (), lambda share: _tell(channel, pid, share), failures)
    if os.getpid() != pid:
        os._exit(1)  # The fit has forked, and one process answers.
    seconds = time.perf_counter() - start
    forks = request["forks"] and not _runs_on(threads)
    asked = request["state"] or (request["forks"] and not forks)
    state = _state(detector) if asked and not request["restore"] else None
    channel.send(
        {
            "seconds_fit": seconds,
            "warm_up": getattr(detector, "warm_up", 0),
            "explains": explains(detector),
            "voices": isinstance(detector, VoicedDetector),
            "updates": isinstance(detector, StreamingDetector),
            "forks": forks,
            "state": state is not None,
        }
    )
    if state is not None:
        channel.send_state(state)
    _obey(channel, detector)


def _tell(channel: Channel, pid: int, share: float) -> None:
    """Tell the harness which share of the fit is done; a process that the fit started is silent."""
    if os.getpid() == pid:
        channel.send({"progress": share})


def _obey(channel: Channel, detector: Detector) -> None:
    """Do what is ordered until the harness closes the channel."""
    with suppress(ChannelClosedError):
        while order := channel.receive():
            if "fork" in order:
                _fork(channel, detector)
            elif "stream" in order:
                _score_rows(channel, detector, **order)
            elif "hear" in order:
                episodes = [channel.receive_trajectory() for _ in range(order.pop("hear"))]
                costs = costs_of_voices(detector, episodes, **order)
                channel.send({"costs": costs.values() if costs else {}})
            else:
                _score(channel, detector, **order)
    _end_children()


def _detector(request: dict[str, Any], packages: Sequence[Path]) -> Detector:
    gc.disable()  # collecting would take a tenth of the time in which PyTorch is imported
    spec = offer_of(request["plugin"], request["detector"], packages).spec
    names = {"seed", "horizon", "parameters", "baseline", "roles"} & request.keys()
    detector = make_detector(spec.factory, **{name: request[name] for name in names})
    gc.enable()
    return detector


def _state(detector: Detector) -> PackedState | None:
    """Return a detector's state; None where it has none, or fails to tell it."""
    if not isinstance(detector, StorableDetector):
        return None
    try:
        return pack(detector.state())
    except BaseException:  # noqa: BLE001  a detector may raise anything; it is fitted again
        traceback.print_exc()
        return None


def _fork(channel: Channel, detector: Detector) -> None:
    """Have a fork of this process serve the channel that follows; if it fails, end like it."""
    descriptor, parent = channel.receive_descriptor(), os.getpid()
    flush_streams()  # What is printed but not written yet would be written by every fork.
    process = os.fork()
    if process == 0:
        code = 1
        try:
            end_with(parent)
            channel.close()
            channel = Channel(descriptor)
            code = _reported(channel, lambda: _obey(channel, detector)) or SCORED
        finally:
            os._exit(code)  # Whatever happens, a fork never goes on with the orders of its parent.
    os.close(descriptor)
    if (code := os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])) != SCORED:
        _end_like(code)


def _end_like(code: int) -> NoReturn:
    """Exit with the group's exit code or signal."""
    if code < 0:
        if -code != signal.SIGKILL:
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code)


def _score(channel: Channel, detector: Detector, *, score: int = 0, explain: int = 0) -> None:
    """Score, or explain, so many trajectories, and return what came of each."""
    chunk = [channel.receive_trajectory() for _ in range(score + explain)]
    start = time.perf_counter()
    returned = (explain_chunk if explain else score_chunk)(detector, chunk)
    seconds = 0.0 if explain else time.perf_counter() - start
    arrays = [np.asarray(x) if explain else float_scores(x) for x in returned]
    for trajectory, array in zip(chunk, arrays, strict=True):
        if not explain and array.nbytes > ROW_BYTES * len(trajectory):
            expected = f"expected ({len(trajectory)},): one score per observation"
            raise ContractError(f"score returned an array of shape {array.shape}, {expected}")
    channel.send({"seconds_score": seconds, "peak_rss_mb": peak_rss_mb()})
    for array in arrays:
        channel.send_array(array)


def _score_rows(
    channel: Channel, detector: Detector, *, stream: int, actions: int, width: int, room: int
) -> None:
    """Score episodes in lockstep: a row of each that runs comes when the last scores were sent.

    There are `stream` episodes, or as many of them as there are streams for, which is told first.
    """
    streams = _streams(detector, actions, stream, room)
    channel.send({"streams": len(streams)})
    for streaming in streams:
        streaming.reset()
    seconds, begun = 0.0, False
    while message := channel.receive_bytes():
        # The episode's number, the action before the observation if there is one, the observation.
        rows = np.frombuffer(message, np.float32).reshape(-1, width)
        scores, start = [SCORES], time.perf_counter()
        for row in rows:
            action = row[1 : 1 + actions].copy() if begun and actions else None
            score = streams[int(row[0])].update(row[1 + actions :].copy(), action)
            score = score.item() if isinstance(score, np.generic) else score
            if not isinstance(score, numbers.Real):
                raise ContractError(f"update returned {type(score).__name__}, expected a float")
            scores.append(struct.pack("<d", score))
        seconds, begun = seconds + time.perf_counter() - start, True
        channel.send_bytes(b"".join(scores))
    channel.send({"seconds_score": seconds, "peak_rss_mb": peak_rss_mb()})


def _streams(detector: Detector, actions: int, most: int, room: int) -> list[Any]:
    """Return what scores up to so many episodes at a time: the detector, and copies if cheap."""
    if not isinstance(detector, StreamingDetector):
        # Each prefix is scored by itself: others beside it could change its last digits.
        return [_Prefixes(detector, actions) for _ in range(most)]
    streams, process = [detector], psutil.Process()
    with suppress(UsageError):
        while len(streams) < most and process.memory_info().rss < room:
            start = time.process_time()
            another = copied(detector)
            if time.process_time() - start > COPY_SECONDS:
                break
            streams.append(another)
    return streams


class _Prefixes:
    """A detector without ``update``, run beside a robot: it scores all rows until now each time."""

    def __init__(self, detector: Detector, actions: int) -> None:
        self._detector, self._width = detector, actions

    def reset(self) -> None:
        self._observations: list[NDArray[np.float32]] = []
        self._actions = np.zeros((0, self._width), np.float32)

    def update(self, observation: NDArray[np.float32], action: NDArray[np.float32] | None) -> Any:
        if self._observations:
            self._actions = np.vstack([self._actions, np.zeros(0) if action is None else action])
        self._observations.append(observation)
        prefix = Trajectory(self._observations, self._actions)
        (returned,) = score_chunk(self._detector, [prefix])
        scores = float_scores(returned)
        if scores.shape != (len(prefix),):
            raise ContractError(f"score returned {scores.shape} for {len(prefix)} observations")
        return scores[-1]


def _runs_on(threads: int) -> bool:
    """Tell whether more threads run than there were, or a child, also after a while."""
    # The system ends a thread a moment after it was joined.
    here, end = psutil.Process(), time.monotonic() + FIT_END_SECONDS
    while here.num_threads() > threads or _children():
        if time.monotonic() > end:
            return True
        time.sleep(0.01)
    return False


def _children() -> list[psutil.Process]:
    """Return the processes that this one has started and that run, with theirs."""
    # To list them takes 10 ms, in every group; to ask whether there are any takes none.
    if hasattr(os, "waitid"):
        try:
            os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
        except ChildProcessError:
            return []
    children = []
    for child in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):
            if child.status() != psutil.STATUS_ZOMBIE:
                children.append(child)
    return children


def _end_children() -> None:
    for child in _children():
        with suppress(psutil.Error):
            child.kill()


def connect(arguments: Sequence[str]) -> tuple[Channel, list[Path]]:
    """Return the channel to the harness, from the command line of a process that it has started.

    Without a launcher, which ends by itself, a lifeline is named, too. The harness never writes to
    it: reading it ends when the harness is no more. With one, directories of packages may follow:
    they are returned, and the last on the import path from now on.
    """
    descriptors = [int(a) for a in arguments if a.isdecimal()]
    packages = arguments[len(descriptors) :]
    sys.path += packages  # No site directory: its .pth files are not read.
    for descriptor in descriptors:
        os.set_inheritable(descriptor, False)
    for lifeline in descriptors[1:]:
        _guard(lifeline)
    faulthandler.enable()
    return Channel(descriptors[0]), [*map(Path, packages)]


def _guard(lifeline: int) -> None:
    """Continue in a forked child; the parent waits and exits with the child's status."""
    # If either dies, so does the other. Processes that the child started and left behind become the
    # parent's (Linux), which ends them with the child. A thread beside a detector could not: the
    # detector may hold the interpreter's lock.
    guard = os.getpid()
    process_control(CHILD_SUBREAPER, 1)
    if (worker := os.fork()) == 0:
        end_with(guard)
        return

    def wait() -> None:
        os.read(0, 1)
        os.kill(worker, signal.SIGKILL)

    os.dup2(lifeline, 0)
    os.closerange(1, 1024)  # The worker's channel has to end with the worker.
    threading.Thread(target=wait, daemon=True).start()
    while (ended := os.wait())[0] != worker:
        pass  # It was left behind.
    while _children():
        _end_children()
    end_all(worker, os.environ[MARK])
    _end_like(os.waitstatus_to_exitcode(ended[1]))


def _reported(channel: Channel, work: Callable[[], None]) -> int:
    """Do some work and return the exit code; an error is sent to the harness."""
    code = 0
    try:
        work()
    except BaseException as error:  # noqa: BLE001  a detector may raise anything; all is reported
        with suppress(ValueError, OSError):  # The detector may have closed the stream.
            traceback.print_exc()
        status = next((s for kind, s in _STATUSES.items() if isinstance(error, kind)), "error")
        channel.send({"status": status, "reason": printable(reason_of(error))})
        code = 1
    flush_streams()
    return code


def main(arguments: Sequence[str]) -> NoReturn:
    """Serve the harness; then end the process.

    Threads and exit handlers of the detector have no say any more: the scores are sent.
    """
    channel, packages = connect(arguments)
    os._exit(_reported(channel, lambda: serve(channel, packages)))


if __name__ == "__main__":
    main(sys.argv[1:])
