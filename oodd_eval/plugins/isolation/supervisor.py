"""Run one detector in a process of its own, with limits, and turn every way to fail into a status.

A crash, a hang, a memory blow-up, ``sys.exit`` or a raise of the detector ends the worker, never
the harness. All that the worker has started is ended with it: its process group, its descendants,
and those that left both, which a mark in the environment that they inherited gives away. POSIX
only.
"""

import contextlib
import math
import os
import secrets
import select
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, Final, TypeVar

import psutil

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import OoddError
from oodd_eval.plugins.isolation import (
    END_POLL_SECONDS,
    MARK,
    ROW_BYTES,
    Channel,
    ChannelClosedError,
    ChannelGarbledError,
    end_all,
)

LOG_BYTES: Final = 64_000

_SINGLE_THREAD: Final = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS", "NUMEXPR_NUM_THREADS", "LOKY_MAX_CPU_COUNT",
)  # fmt: skip

CHUNK: Final = 64  # trajectories that a worker scores at once

_TOLD: Final = {"error", "oom", "invalid", "incompatible", "unavailable"}  # by a worker, of itself

_T = TypeVar("_T")
_Expected = deque[tuple[str, int]]  # of each trajectory sent: kind of the array to come, and rows

POLL_SECONDS: Final = 0.05  # between two looks at a worker that is silent


@dataclass(frozen=True, slots=True)
class Limits:
    """Wall-clock seconds and bytes of resident memory of one worker; None means no limit."""

    seconds: float | None = None
    memory: int | None = None


@dataclass(slots=True)
class Outcome:
    """Scores of a fit, or the way in which it failed.

    `status` is as in a record, with a reason of one line unless ok. `scores`, `warm_up` and what is
    kept of explanations, if it has `explained`, are the detector's own, and checked only for their
    number and size. Costs are None when the worker ended before they were known; what it told of
    them is held within what this process knows. `log` is the end of the detector's output.
    """

    status: str = "ok"
    reason: str = ""
    scores: list[object] = field(default_factory=list)
    explained: list[object] = field(default_factory=list)
    warm_up: object = 0
    seconds_fit: float | None = None
    seconds_score: float | None = None
    peak_rss_mb: float | None = None
    log: str = ""


Stop = Callable[[], bool]  # tells whether the work is to end, such as `threading.Event.is_set`


class GivenUpError(OoddError, RuntimeError):
    """A process has to end: the status and reason of its cell, and what is told of the process."""

    def __init__(self, status: str, reason: str, told: str = "") -> None:
        super().__init__(reason)
        self.status, self.reason, self.told = status, reason, told


class Child:
    """A module run as ``python -m MODULE READ_FD WRITE_FD LIFELINE_FD``, within limits.

    It has no standard input, the import path of this process, one thread for numerical libraries,
    and none of the variables that steer the harness. The system closes the lifeline when this
    process is killed: see `oodd_eval.plugins.isolation.worker.connect`. `sending` is the descriptor
    to write to it, for the caller to close; `channel` gives up with `GivenUpError` at a limit.
    """

    def __init__(self, module: str, limits: Limits, stop: Stop | None = None) -> None:
        reading, self.sending = os.pipe()
        self._receiving, writing = os.pipe()
        lifeline, self._held = os.pipe()
        descriptors = reading, writing, lifeline
        self._mark = secrets.token_hex(8)
        self._process = subprocess.Popen(  # noqa: S603  our own interpreter and module
            [sys.executable, "-P", "-m", module, *map(str, descriptors)],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            pass_fds=descriptors, env={**_environment(), MARK: self._mark},
            start_new_session=True,
        )  # fmt: skip
        for descriptor in descriptors:
            os.close(descriptor)
        self.channel = Channel(self._receiving, self.sending, self._wait)
        self._limits, self._stop, self.forked = limits, stop, True
        self._seen = self._scoring = psutil.Process(self._process.pid)
        self._printed, self.peak, self._killed = b"", 0, _killed_for_memory()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self.start_clock()

    def start_clock(self) -> None:
        """Count the seconds of the limit from now on."""
        self._start = time.monotonic()

    @property
    def elapsed(self) -> float:
        """Seconds of the limit that are used up."""
        return time.monotonic() - self._start

    def watch(self, pid: int, *, forked: bool) -> None:
        """Hold a process of it to the limit of memory, too; `ValueError` when it is none of its."""
        with contextlib.suppress(psutil.NoSuchProcess):  # It may have ended by now.
            process = psutil.Process(pid)
            if process.ppid() != self._process.pid:
                raise ValueError(pid)
            self._scoring, self.forked = process, forked

    @property
    def exited(self) -> bool:
        """Tell whether it has ended; its id is not given to others until `end` was called."""
        try:
            return bool(self._seen.status() == psutil.STATUS_ZOMBIE)
        except psutil.NoSuchProcess:
            return True

    def wait_for_exit(self, *, seconds: float) -> bool:
        """Wait until it has ended; return False when it has not, after so many seconds."""
        deadline = time.monotonic() + seconds
        while not self.exited:
            if time.monotonic() > deadline:
                return False
            time.sleep(END_POLL_SECONDS)
        return True

    def end(self) -> str:
        """Kill it with all that it has started, and return the end of what was printed."""
        end_all(self._process.pid, self._mark)
        self.returncode = self._process.wait()
        # A process that escaped could hold the pipe open for ever: do not wait for it.
        self._reader.join(timeout=1.0)
        os.close(self._receiving)
        os.close(self._held)
        return self._printed.decode(errors="replace")

    def _read(self) -> None:
        """Read what is printed, and keep the end of it."""
        if self._process.stdout:
            with self._process.stdout as pipe:
                while part := os.read(pipe.fileno(), 1 << 16):
                    self._printed = (self._printed + part)[-LOG_BYTES:]

    def death(self) -> str:
        """Say how it ended, after `end`."""
        if self.returncode < 0:
            return f"was killed by {signal.Signals(-self.returncode).name}"
        return f"ended with exit code {self.returncode}"

    @property
    def out_of_memory(self) -> bool:
        """Tell whether it was killed while the system killed processes for want of memory."""
        return self.returncode == -signal.SIGKILL and _killed_for_memory() > self._killed

    def _wait(self) -> None:
        """Wait for the next bytes, and give up when a limit is passed."""
        while not self._ready(POLL_SECONDS):
            self._check()
            if self.exited:
                # A grandchild may hold the pipe open, so that its end would never come.
                if not self._ready(0):
                    raise ChannelClosedError("the process ended")
                return
        self._check()

    def _ready(self, seconds: float) -> bool:
        return bool(select.select([self._receiving], [], [], seconds)[0])

    def _check(self) -> None:
        if self._stop and self._stop():
            raise GivenUpError("error", "interrupted")
        seconds, memory = self._limits.seconds, self._limits.memory
        if seconds is not None and self.elapsed > seconds:
            reason = f"not done after {seconds:g} s (--timeout)"
            raise GivenUpError("timeout", reason, f"was {reason}")
        used = self._resident_bytes()
        self.peak = max(self.peak, used)
        if memory is not None and used > memory:
            held, most = f"{used / 1e6:.0f} MB", f"{memory / 1e6:.0f} MB (--memory)"
            reason = f"resident memory {held} is over the limit of {most}"
            raise GivenUpError("oom", reason, f"held {held}, more than {most}")

    def _resident_bytes(self) -> int:
        held = []
        for process in {self._seen, self._scoring}:
            with contextlib.suppress(psutil.Error):
                held.append(int(process.memory_info().rss))
        return int(self.together(held))

    def together(self, held: Sequence[float]) -> float:
        """Return the memory of a worker and a process that scores, of what each of them holds.

        What a fork shares counts in both: the larger of the two holds all of it.
        """
        return max(held, default=0) if self.forked else sum(held)


def run_isolated(
    request: Mapping[str, Any], train: Iterable[Trajectory],
    groups: Iterable[Iterable[Trajectory]], explained: Iterable[Iterable[Trajectory]] = (), *,
    limits: Limits, stop: Stop,
) -> Outcome:  # fmt: skip
    """Fit on `train` and score groups of trajectories, each group in a process of its own.

    A detector that explains is asked to explain the groups `explained` in the same way, last.

    The request names ``plugin`` and ``detector``, its ``parameters``, ``seed`` and ``horizon``, and
    the number of trajectories to ``train`` on. ``load`` is the directory of a kept fit, which
    replaces fitting; ``save`` is an empty directory where the detector may save its fit. One of the
    two may be empty.
    Each iterable is read once, lazily and from another thread, the next one when the one before is
    exhausted. Scores come back in the order of the groups. When `stop` says True, the worker is
    killed and the status is ``"error"``. Only errors of reading the trajectories are raised.
    """
    child, outcome = Child("oodd_eval.plugins.isolation.worker", limits, stop), Outcome()
    expected: _Expected = deque()
    # From another thread, so that neither side can deadlock on a full pipe.
    with ThreadPoolExecutor(1) as pool:
        explains: Future[bool] = Future()
        parts = _noted("array", groups, expected), _noted("explanation", explained, expected)
        sent = pool.submit(_send, child, request, train, *parts, explains)
        try:
            _converse(child, outcome, explains, expected)
        except GivenUpError as error:
            outcome.status, outcome.reason = error.status, error.reason
        except (ChannelGarbledError, LookupError, TypeError, ValueError, OverflowError):
            outcome.status = "error"
            outcome.reason = "the detector wrote into the pipe between worker and harness"
        except ChannelClosedError:
            doing = "fitting" if outcome.seconds_fit is None else "scoring"
            outcome.status = "error"
            if not child.wait_for_exit(seconds=5.0):
                outcome.reason = f"the worker closed its pipe while {doing}, without a result"
        finally:
            if not explains.done():
                explains.set_result(False)
            outcome.log = child.end()
    sent.result()
    if outcome.status == "error" and not outcome.reason:
        outcome.reason = f"the worker {child.death()} while {doing}"
        if child.out_of_memory:
            outcome.status = "oom"
            outcome.reason = f"the system ran out of memory and killed the worker while {doing}"
        elif child.returncode == -signal.SIGKILL:
            outcome.reason += f", not by oodd-eval; it held {child.peak / 1e6:.0f} MB or more"
    return outcome


def _converse(
    child: Child, outcome: Outcome, explains: "Future[bool]", expected: "_Expected"
) -> None:
    """Receive the worker's messages into `outcome` until the last one; raise for any other."""
    channel, seconds, peak = child.channel, 0.0, 0.0
    arrays = {"array": outcome.scores, "explanation": outcome.explained}
    memory = psutil.virtual_memory().total / 1e6
    while outcome.seconds_score is None:
        message = channel.receive()
        if "status" in message:
            if message["status"] not in _TOLD:
                raise ValueError(message["status"])
            raise GivenUpError(message["status"], _typed(message, "reason", str))
        if outcome.seconds_fit is None:
            outcome.warm_up, told = message["warm_up"], _typed(message, "explains", bool)
            outcome.seconds_fit = _number(message, "seconds_fit", child.elapsed)
            explains.set_result(told)
        elif "pid" in message:
            child.watch(_typed(message, "pid", int), forked=_typed(message, "forked", bool))
        elif "peak_rss_mb" in message:
            held = _number(message, "peak_rss_mb", memory)
            if "seconds_score" in message:
                seconds += _number(message, "seconds_score", child.elapsed)
                peak = max(peak, held)
            else:
                outcome.seconds_score = min(seconds, child.elapsed)
                outcome.peak_rss_mb = max(child.together([peak, held]), child.peak / 1e6)
        elif (kind := _typed(message, "type", str)) in arrays:
            wanted, rows = expected.popleft()
            if kind != wanted:
                raise ValueError(kind)
            arrays[kind].append(channel.receive_array(4096 + ROW_BYTES * rows))
        else:
            wrong = f"score returned {kind}, expected a numpy array of float64"
            raise GivenUpError("invalid", wrong)


def _typed(message: Mapping[str, Any], name: str, kind: type[_T]) -> _T:
    """Return a value of a message; raise for one of another type."""
    if type(value := message[name]) is not kind:
        raise TypeError(name)
    return value


def _number(message: Mapping[str, Any], name: str, most: float) -> float:
    """Return a number of a message, and at most what is possible; `ValueError` for no amount."""
    value = message[name]
    if type(value) not in (int, float) or not 0 <= value < math.inf:
        raise ValueError(name)
    return float(min(value, most))


def _noted(
    kind: str, groups: Iterable[Iterable[Trajectory]], expected: "_Expected"
) -> Iterator[Iterator[Trajectory]]:
    """Yield groups; what has to come back of a trajectory is noted when it is read, to be sent."""

    def noted(trajectory: Trajectory) -> Trajectory:
        expected.append((kind, len(trajectory)))
        return trajectory

    return (map(noted, group) for group in groups)


def _send(
    child: Child, request: Mapping[str, Any], train: Iterable[Trajectory],
    groups: Iterable[Iterable[Trajectory]], explained: Iterable[Iterable[Trajectory]],
    explains: "Future[bool]",
) -> None:  # fmt: skip
    channel = child.channel
    try:
        channel.send({**request})
        for trajectory in train:
            channel.send_trajectory(trajectory)
        for group in groups:
            _send_group(channel, group, explain=False)
        # Last, as only what comes again is anomalous: no process that scores is told so.
        for group in explained if explains.result() else ():
            _send_group(channel, group, explain=True)
        channel.send({"group": False})
    except BrokenPipeError:
        pass  # The worker ended; the receiving side finds out why.
    finally:
        os.close(child.sending)


def _send_group(channel: Channel, group: Iterable[Trajectory], *, explain: bool) -> None:
    channel.send({"group": True})
    for chunk in _chunks(group):
        channel.send({"score": len(chunk), "explain": explain})
        for trajectory in chunk:
            channel.send_trajectory(trajectory)
    channel.send({"score": 0})


def _chunks(trajectories: Iterable[Trajectory]) -> Iterator[list[Trajectory]]:
    rest = iter(trajectories)
    while chunk := list(islice(rest, CHUNK)):
        yield chunk


def _killed_for_memory() -> int:
    """Return how many processes the system has killed for want of memory; 0 if it does not tell."""
    with contextlib.suppress(OSError, StopIteration, ValueError):
        told = Path("/proc/vmstat").read_text(encoding="ascii").splitlines()
        return int(next(line.split()[1] for line in told if line.startswith("oom_kill ")))
    return 0


def _environment() -> dict[str, str]:
    path = os.pathsep.join(str(Path(entry).absolute()) for entry in sys.path)
    # A detector must not see the harness's settings, nor the test that pytest names.
    steering = ("OODD_EVAL_", "PYTEST_CURRENT_TEST")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(steering)}
    single = dict.fromkeys(_SINGLE_THREAD, "1")
    return {**kept, **single, "PYTHONPATH": path, "PYTHONHASHSEED": "0"}
