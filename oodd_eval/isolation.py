"""Run one detector in a process of its own, with limits, and turn every way to fail into a status.

A crash, a hang, a memory blow-up, ``sys.exit`` or a raise of the detector ends the worker, never
the harness. POSIX only; the memory limit is watched through ``/proc`` (Linux).
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from itertools import islice
from pathlib import Path
from typing import IO, Any, Final, Protocol

from oodd_eval.channel import Channel, ChannelClosedError
from oodd_eval.errors import ContractError
from oodd_eval.trajectory import Trajectory

CHUNK: Final = 64
"""Trajectories that a worker scores at once."""

POLL_SECONDS: Final = 0.05
LOG_BYTES: Final = 64_000

_SINGLE_THREAD: Final = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "BLIS_NUM_THREADS": "1",
    "VECLIB_MAXIMUM_THREADS": "1",
    "NUMEXPR_NUM_THREADS": "1",
    "LOKY_MAX_CPU_COUNT": "1",
}


@dataclass(frozen=True, slots=True)
class Request:
    """What a worker is told beside the trajectories.

    `train` is how many of them are to fit on. `load` is the directory of a fitted detector, which
    then replaces the fit; `save` the empty one where a fitted detector may save itself. Both are
    empty where there is none.
    """

    plugin: str
    detector: str
    parameters: dict[str, Any]
    seed: int
    horizon: int
    train: int
    load: str = ""
    save: str = ""


@dataclass(frozen=True, slots=True)
class Limits:
    """Wall-clock seconds and bytes of resident memory of one worker; None means no limit."""

    seconds: float | None = None
    memory: int | None = None


@dataclass(slots=True)
class Outcome:
    """What became of a fit.

    Attributes
    ----------
    status
        ``"ok"``, ``"error"``, ``"timeout"``, ``"oom"``, ``"invalid"``, ``"incompatible"`` or
        ``"unavailable"``.
    reason
        One line for a status other than ok.
    scores
        What the detector returned for each trajectory, in the order in which they were sent; not
        checked.
    warm_up
        What the detector declares.
    seconds_fit, seconds_score, peak_rss_mb
        Cost; None where the worker did not come so far.
    log
        The end of what the detector printed.
    """

    status: str = "ok"
    reason: str = ""
    scores: list[object] = field(default_factory=list)
    warm_up: object = 0
    seconds_fit: float | None = None
    seconds_score: float | None = None
    peak_rss_mb: float | None = None
    log: str = ""


class Stop(Protocol):
    """A flag that another thread sets to end the work, such as `threading.Event`."""

    def is_set(self) -> bool:
        """Whether to stop."""
        ...


class _Abort(Exception):  # noqa: N818  a signal between two functions here, never seen outside
    """The worker has to end: status and reason."""


def run_isolated(
    request: Request,
    train: Iterable[Trajectory],
    score: Iterable[Trajectory],
    *,
    limits: Limits,
    stop: Stop,
) -> Outcome:
    """Fit on `train` and score `score` in a worker process.

    Parameters
    ----------
    request
        The detector and how to make it.
    train, score
        Trajectories, read lazily and in order.
    limits
        Enforced from outside: the whole process group of the worker is killed.
    stop
        When set, the worker is killed and the outcome has the status ``"error"``.

    Returns
    -------
    Outcome
        Never raises for what the detector does; errors of reading the trajectories pass through.
    """
    to_worker, from_harness = _pipe()
    to_harness, from_worker = _pipe()
    # Closed by the system when this process is killed, which ends the worker.
    lifeline, held = _pipe()
    for_worker = (to_worker, from_worker, lifeline)
    process = subprocess.Popen(  # noqa: S603  our own interpreter and module
        [sys.executable, "-P", "-m", "oodd_eval.worker", *map(str, for_worker)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        pass_fds=for_worker,
        env=_environment(),
        start_new_session=True,
    )
    for descriptor in for_worker:
        os.close(descriptor)
    outcome = Outcome()
    log = _Tail(process.stdout)
    sender = _Sender(from_harness, request, train, score)
    watch = _Watch(process, to_harness, limits, stop)
    died = silent = False
    try:
        _converse(Channel(to_harness, None, watch), outcome)
    except _Abort as abort:
        outcome.status, outcome.reason = abort.args
    except ChannelClosedError:
        died = True
        silent = not _wait_for_exit(process, seconds=5.0)
    finally:
        _kill_group(process)
        os.close(to_harness)
        os.close(held)
        sender.join()
        outcome.log = log.finish()
    if sender.error:
        raise sender.error
    if died:
        outcome.status, outcome.reason = _death(process.returncode, outcome, silent=silent)
    return outcome


def _converse(channel: Channel, outcome: Outcome) -> None:
    """Receive what the worker has to say, message by message, into `outcome`."""
    first = channel.receive()
    if "status" in first:
        raise _Abort(first["status"], first["reason"])
    outcome.seconds_fit, outcome.warm_up = first["seconds_fit"], first["warm_up"]
    while True:
        message = channel.receive()
        if "status" in message:
            raise _Abort(message["status"], message["reason"])
        if "seconds_score" in message:
            outcome.seconds_score = message["seconds_score"]
            outcome.peak_rss_mb = message["peak_rss_mb"]
            return
        if message["type"] != "array":
            raise _Abort(
                "invalid", f"score returned {message['type']}, expected a numpy array of float64"
            )
        outcome.scores.append(channel.receive_array())


class _Watch:
    """Wait for the worker's next bytes, and give up when a limit is passed."""

    def __init__(
        self, process: subprocess.Popen[bytes], descriptor: int, limits: Limits, stop: Stop
    ) -> None:
        self._process, self._descriptor = process, descriptor
        self._limits, self._stop = limits, stop
        self._start = time.monotonic()

    def __call__(self) -> None:
        while not select.select([self._descriptor], [], [], POLL_SECONDS)[0]:
            self._check()
            if _exited(self._process):
                # A grandchild may hold the pipe open, so that its end would never come.
                if not select.select([self._descriptor], [], [], 0)[0]:
                    raise ChannelClosedError("the worker ended")
                return
        self._check()

    def _check(self) -> None:
        if self._stop.is_set():
            raise _Abort("error", "interrupted")
        seconds, memory = self._limits.seconds, self._limits.memory
        if seconds is not None and time.monotonic() - self._start > seconds:
            raise _Abort("timeout", f"not done after {seconds:g} s (--timeout)")
        if memory is not None and (used := _resident_bytes(self._process.pid)) > memory:
            raise _Abort(
                "oom",
                f"resident memory {used / 1e6:.0f} MB is over the limit of {memory / 1e6:.0f} MB "
                "(--memory)",
            )


class _Sender:
    """Send the request and the trajectories from a thread, so that nobody waits for nobody."""

    def __init__(
        self,
        descriptor: int,
        request: Request,
        train: Iterable[Trajectory],
        score: Iterable[Trajectory],
    ) -> None:
        self.error: BaseException | None = None
        self._descriptor = descriptor
        self._thread = threading.Thread(target=self._run, args=(request, train, score), daemon=True)
        self._thread.start()

    def _run(
        self, request: Request, train: Iterable[Trajectory], score: Iterable[Trajectory]
    ) -> None:
        channel = Channel(None, self._descriptor)
        try:
            channel.send(asdict(request))
            for trajectory in train:
                channel.send_trajectory(trajectory)
            for chunk in _chunks(score):
                channel.send({"score": len(chunk)})
                for trajectory in chunk:
                    channel.send_trajectory(trajectory)
            channel.send({"score": 0})
        except BrokenPipeError:
            pass  # The worker ended; the receiving side finds out why.
        except BaseException as error:  # noqa: BLE001  raised again where the caller waits
            self.error = error
        finally:
            os.close(self._descriptor)

    def join(self) -> None:
        self._thread.join()


class _Tail:
    """Read what the worker prints, and keep the end of it."""

    def __init__(self, stream: IO[bytes] | None) -> None:
        if stream is None:
            raise ContractError("the worker was started without a pipe for its output")
        self._stream, self._kept = stream, b""
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while part := os.read(self._stream.fileno(), 1 << 16):
            self._kept = (self._kept + part)[-LOG_BYTES:]

    def finish(self) -> str:
        # A process that escaped the group could hold the pipe open for ever: do not wait for it.
        self._thread.join(timeout=1.0)
        if not self._thread.is_alive():
            self._stream.close()
        return self._kept.decode(errors="replace")


def _pipe() -> tuple[int, int]:
    reading, writing = os.pipe()
    return reading, writing


def _chunks(trajectories: Iterable[Trajectory]) -> Iterator[list[Trajectory]]:
    rest = iter(trajectories)
    while chunk := list(islice(rest, CHUNK)):
        yield chunk


def _environment() -> dict[str, str]:
    """Return the harness's environment with its import path, one thread and no restriction."""
    path = os.pathsep.join(str(Path(entry).absolute()) for entry in sys.path)
    kept = {k: v for k, v in os.environ.items() if k != "OODD_EVAL_PLUGINS"}
    return {**kept, **_SINGLE_THREAD, "PYTHONPATH": path, "PYTHONHASHSEED": "0"}


def _resident_bytes(pid: int) -> int:
    try:
        pages = Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1]
    except (OSError, IndexError):
        return 0
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def _death(code: int, outcome: Outcome, *, silent: bool) -> tuple[str, str]:
    """Say how a worker ended that did not say so itself."""
    doing = "fitting" if outcome.seconds_fit is None else "scoring"
    if silent:
        return "error", f"the worker closed its pipe while {doing}, without a result"
    if code == -signal.SIGKILL:
        return "oom", f"the system killed the worker while {doing} (most likely out of memory)"
    if code < 0:
        return "error", f"the worker was killed by {signal.Signals(-code).name} while {doing}"
    return "error", f"the worker ended with exit code {code} while {doing}"


def _exited(process: subprocess.Popen[bytes]) -> bool:
    """Whether the worker has ended, without giving its id back: its group is still to be killed."""
    state = os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    return state is not None


def _wait_for_exit(process: subprocess.Popen[bytes], *, seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while not _exited(process):
        if time.monotonic() > deadline:
            return False
        time.sleep(POLL_SECONDS / 10)
    return True


def _kill_group(process: subprocess.Popen[bytes]) -> None:
    """End the worker and whatever it started; only then is the leader's id given back."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
