"""Run one detector in a process of its own, with limits, and turn every way to fail into a status.

A crash, a hang, a memory blow-up, ``sys.exit`` or a raise of the detector ends the worker, never
the harness. POSIX only; the memory limit is watched through ``/proc`` (Linux).
"""

from __future__ import annotations

import os
import select
import signal
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from itertools import chain, islice
from typing import Any, Final, Protocol

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.plugins.isolation.messages import Channel, ChannelClosedError, ChannelGarbledError
from oodd_eval.plugins.isolation.processes import Child

CHUNK: Final = 64
"""Trajectories that a worker scores at once."""

POLL_SECONDS: Final = 0.05


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
    again: Iterable[Trajectory] = (),
    *,
    limits: Limits,
    stop: Stop,
) -> Outcome:
    """Fit on `train`, score `score` and then `again` in a worker process.

    Parameters
    ----------
    request
        The detector and how to make it.
    train, score, again
        Trajectories, read lazily and in order. `again` never shares a chunk with `score`, so that
        its company changes no digit there.
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
    child = Child("oodd_eval.plugins.isolation.worker", for_worker)
    outcome = Outcome()
    sender = _Sender(from_harness, request, train, chain(_chunks(score), _chunks(again)))
    watch = _Watch(child, to_harness, limits, stop)
    died = silent = False
    try:
        _converse(Channel(to_harness, None, watch), outcome)
    except _Abort as abort:
        outcome.status, outcome.reason = abort.args
    except (ChannelGarbledError, KeyError):
        outcome.status = "error"
        outcome.reason = "the detector wrote into the pipe between worker and harness"
    except ChannelClosedError:
        died = True
        silent = not child.wait_for_exit(seconds=5.0)
    finally:
        outcome.log = child.end()
        os.close(to_harness)
        os.close(held)
        sender.join()
    if sender.error:
        raise sender.error
    if died:
        outcome.status, outcome.reason = _death(child, outcome, silent=silent)
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

    def __init__(self, child: Child, descriptor: int, limits: Limits, stop: Stop) -> None:
        self._child, self._descriptor = child, descriptor
        self._limits, self._stop = limits, stop
        self._start = time.monotonic()

    def __call__(self) -> None:
        while not select.select([self._descriptor], [], [], POLL_SECONDS)[0]:
            self._check()
            if self._child.exited:
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
        if memory is not None and (used := self._child.resident_bytes) > memory:
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
        chunks: Iterable[list[Trajectory]],
    ) -> None:
        self.error: BaseException | None = None
        self._descriptor = descriptor
        self._thread = threading.Thread(
            target=self._run, args=(request, train, chunks), daemon=True
        )
        self._thread.start()

    def _run(
        self, request: Request, train: Iterable[Trajectory], chunks: Iterable[list[Trajectory]]
    ) -> None:
        channel = Channel(None, self._descriptor)
        try:
            channel.send(asdict(request))
            for trajectory in train:
                channel.send_trajectory(trajectory)
            for chunk in chunks:
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


def _pipe() -> tuple[int, int]:
    reading, writing = os.pipe()
    return reading, writing


def _chunks(trajectories: Iterable[Trajectory]) -> Iterator[list[Trajectory]]:
    rest = iter(trajectories)
    while chunk := list(islice(rest, CHUNK)):
        yield chunk


def _death(child: Child, outcome: Outcome, *, silent: bool) -> tuple[str, str]:
    """Say how a worker ended that did not say so itself."""
    doing = "fitting" if outcome.seconds_fit is None else "scoring"
    if silent:
        return "error", f"the worker closed its pipe while {doing}, without a result"
    if child.process.returncode == -signal.SIGKILL:
        return "oom", f"the system killed the worker while {doing} (most likely out of memory)"
    return "error", f"the worker {child.death()} while {doing}"
