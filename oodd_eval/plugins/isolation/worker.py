"""The process that holds one detector: it receives trajectories without names and returns scores.

It never holds onsets, anomalies, twins' pairing or the name of the environment. Training
trajectories come first, in the order of the split; then the trajectories to score, in groups.

Each group is scored by a fork of the fitted process, which ends with it. So nothing that an honest
detector remembers of a group reaches the next one, and two episodes with the same seed, which agree
bit for bit before the onset, never meet. A process with further threads cannot be forked safely (a
GPU starts some), and further processes would be shared by all groups: the fit is saved, and loaded
by a fresh process for each group. Files and shared memory are not watched. When all is scored, some
groups come once more to a detector that explains, each in a process of its own as before.

Messages have a descriptor of their own, so that nothing that a detector prints gets between them.
"""

import faulthandler
import gc
import json
import math
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
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
from oodd_eval.errors import ContractError, TrajectoryError
from oodd_eval.plugins.contract import Detector, StorableDetector, make_detector, score_chunk
from oodd_eval.plugins.discovery import describe, offer_of, printable
from oodd_eval.plugins.explanations import explain_chunk, explains
from oodd_eval.plugins.isolation import FIT_END_SECONDS, MARK, ROW_BYTES, SCORED, Channel, end_all

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


def serve(channel: Channel, descriptors: Sequence[str]) -> None:
    """Fit the requested detector and have every group that comes scored by a process of its own."""
    threads, pid = psutil.Process().num_threads(), os.getpid()
    request = channel.receive()
    train = TrajectoryFile(channel.receive_trajectory() for _ in range(request["train"]))
    start = time.perf_counter()
    detector = _make_detector(request)
    if request["load"]:
        _load(detector, request["load"])
    else:
        detector.fit(train)
    if os.getpid() != pid:
        os._exit(1)  # The fit has forked, and one process answers.
    seconds_fit = time.perf_counter() - start
    saved = request["load"] or (request["save"] and _saved(detector, request["save"]))
    process: Callable[[], int] = lambda: _fork(channel, detector)  # noqa: E731
    if _runs_on(threads):
        _end_children()
        if not saved:
            raise NotImplementedError(
                "threads or processes run on after fit, which groups would share, so that the "
                "process cannot be forked, and the fit cannot be saved: end them in fit, or give "
                "the detector save and load"
            )
        order = json.dumps({**request, "load": saved, "train": 0})
        process = lambda: _start(descriptors, order)  # noqa: E731
    known = {"warm_up": getattr(detector, "warm_up", 0), "explains": explains(detector)}
    channel.send({"seconds_fit": seconds_fit, **known})
    while channel.receive()["group"]:
        if (code := process()) != SCORED:
            _end_like(code)
    channel.send({"peak_rss_mb": peak_rss_mb()})


def _runs_on(threads: int) -> bool:
    """Tell whether more threads run than there were, or a child, also after a while.

    The system ends a thread a moment after it was joined.
    """
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


def _make_detector(request: dict[str, Any]) -> Detector:
    gc.disable()  # collecting would take a tenth of the time in which PyTorch is imported
    spec = offer_of(request["plugin"], request["detector"]).spec
    arguments = {name: request[name] for name in ("seed", "horizon", "parameters")}
    detector = make_detector(spec.factory, **arguments, baseline=request.get("baseline", 0))
    gc.enable()
    return detector


def _load(detector: Detector, directory: str) -> None:
    if not isinstance(detector, StorableDetector):
        raise ContractError("the detector has save but no load")
    detector.load(Path(directory))


def _saved(detector: Detector, path: str) -> str:
    """Let a detector save itself; return the directory, or nothing where that fails."""
    if not isinstance(detector, StorableDetector):
        return ""
    directory = Path(path)
    try:
        detector.save(directory)
    except BaseException:  # noqa: BLE001  a detector may raise anything; a later run fits again
        traceback.print_exc()
        # What is left of it is not kept, as nothing is in an empty or missing directory.
        shutil.rmtree(directory, ignore_errors=True)
        with suppress(OSError):
            directory.mkdir(parents=True)
        return ""
    return path


def _fork(channel: Channel, detector: Detector) -> int:
    """Score a group in a fork of this process; return its exit code, negative for a signal."""
    flush_streams()  # What is printed but not written yet would be written by every fork.
    process = os.fork()
    if process == 0:
        code = 1
        try:
            code = _reported(channel, lambda: _score_group(channel, detector)) or SCORED
        finally:
            os._exit(code)  # Whatever happens, a fork never goes on with the loop over groups.
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def _start(descriptors: Sequence[str], order: str) -> int:
    """Score a group in a fresh process that loads the fit; return its exit code."""
    command = [sys.executable, "-P", "-m", "oodd_eval.plugins.isolation.worker", *descriptors]
    return subprocess.run(  # noqa: S603  our own interpreter and module
        [*command, order], pass_fds=[int(d) for d in descriptors], check=False
    ).returncode


def _end_like(code: int) -> NoReturn:
    """Exit with the group's exit code or signal."""
    if code < 0:
        if -code != signal.SIGKILL:
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code)


def _score_group(channel: Channel, detector: Detector) -> None:
    """Score, or explain, what comes until a chunk of zero, and end the processes of this."""
    seconds = 0.0
    while size := (order := channel.receive())["score"]:
        chunk = [channel.receive_trajectory() for _ in range(size)]
        start = time.perf_counter()
        returned = (explain_chunk if order["explain"] else score_chunk)(detector, chunk)
        seconds += 0.0 if order["explain"] else time.perf_counter() - start
        for trajectory, array in zip(chunk, returned, strict=True):
            if not isinstance(array, np.ndarray):
                channel.send({"type": type(array).__name__})
            elif array.nbytes > ROW_BYTES * len(trajectory):
                channel.send({"type": f"an array of shape {array.shape}"})
            elif array.dtype.hasobject:
                channel.send({"type": "ndarray of object"})
            else:
                channel.send({"type": "explanation" if order["explain"] else "array"})
                channel.send_array(np.asarray(array))
    _end_children()
    channel.send({"seconds_score": seconds, "peak_rss_mb": peak_rss_mb()})


def connect(arguments: Sequence[str], *, guarded: bool = True) -> Channel:
    """Return the channel to the harness, from the command line of a process that it has started.

    The harness never writes to the lifeline: reading it ends when the harness is no more. Where
    this process is `guarded`, that ends it and whatever it has started, too.
    """
    conversation, lifeline = descriptors = [int(a) for a in arguments]
    for descriptor in descriptors:
        os.set_inheritable(descriptor, False)
    if guarded:
        _guard(lifeline)
    faulthandler.enable()
    return Channel(conversation)


def _guard(lifeline: int) -> None:
    """Start a process that waits for the end of the harness, and then ends all that is marked.

    No thread could, as a detector may hold the interpreter's lock. It is nobody's child, so that it
    is not taken for one of the detector's.
    """
    worker, mark = os.getpid(), os.environ[MARK]
    if (between := os.fork()) == 0:
        try:
            os.setsid()
            if os.fork() == 0:
                os.dup2(lifeline, 0)
                os.closerange(1, 1024)  # The worker's channel has to end with the worker.
                os.read(0, 1)
                end_all(worker, mark)
        finally:
            os._exit(0)
    os.waitpid(between, 0)


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
    """Serve one request, or load a fit and score one group; then end the process.

    Threads and exit handlers of the detector have no say any more: the scores are sent.
    """
    descriptors, order = arguments[:2], arguments[2:]
    channel = connect(descriptors, guarded=not order)  # A group's process has its worker's mark.

    def group() -> None:
        request = json.loads(order[0])
        detector = _make_detector(request)
        _load(detector, request["load"])
        _score_group(channel, detector)

    if order:
        os._exit(_reported(channel, group) or SCORED)
    os._exit(_reported(channel, lambda: serve(channel, descriptors)))


if __name__ == "__main__":
    main(sys.argv[1:])
