"""Run one detector in a process of its own, and turn every way to fail into a status."""

import math
import signal
from collections import deque
from collections.abc import Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, Final, TypeVar

import psutil

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.plugins.isolation import (
    CHUNK,
    CLOSED_SECONDS,
    ROW_BYTES,
    ChannelClosedError,
    ChannelGarbledError,
)
from oodd_eval.plugins.isolation.child import Child, GivenUpError, Limits, Stop
from oodd_eval.plugins.isolation.sandbox import Sandbox

_FAILURES: Final = {"error", "oom", "invalid", "incompatible", "unavailable"}
"""The values that a worker reports of itself."""

_T = TypeVar("_T")
_Expected = deque[tuple[str, int]]  # of each trajectory sent: kind of the array to come, and rows


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


def run_isolated(
    request: Mapping[str, Any],
    train: Iterable[Trajectory],
    groups: Iterable[Iterable[Trajectory]],
    explained: Iterable[Iterable[Trajectory]] = (),
    *,
    limits: Limits,
    stop: Stop,
) -> Outcome:
    """Fit on `train` and score groups of trajectories, each group in a process of its own.

    A detector that explains is asked to explain the groups `explained` in the same way, last.

    The request names ``plugin`` and ``detector``, its ``parameters``, ``seed``, ``horizon`` and
    perhaps ``baseline`` (see `make_detector`), and the number of trajectories to ``train`` on.
    ``load`` is the directory of a kept fit, which replaces fitting; ``save`` is an empty directory
    where the detector may save its fit. One of the two may be empty.
    Each iterable is read once, lazily and from another thread, the next one when the one before is
    exhausted. Scores come back in the order of the groups. When `stop` says True, the worker is
    killed and the status is ``"error"``. Only errors of reading the trajectories are raised.
    """
    outcome, expected, box, inside = Outcome(), _Expected(), None, request
    with ExitStack() as stack:
        if limits.hidden is not None:
            box = stack.enter_context(closing(Sandbox(limits.hidden)))
            inside = box.taken(request)
        module = "oodd_eval.plugins.isolation.worker"
        child = stack.enter_context(closing(Child(module, limits, stop, box)))
        # From another thread, so that neither side can deadlock on a full socket.
        pool = stack.enter_context(ThreadPoolExecutor(1))
        explains: Future[bool] = Future()
        sent = pool.submit(_send, child, inside, train, groups, explained, explains, expected)
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
            if not child.wait_for_exit(seconds=CLOSED_SECONDS):
                outcome.reason = f"the worker closed its pipe while {doing}, without a result"
        finally:
            if not explains.done():
                explains.set_result(False)
            outcome.log = child.end()
        if box:
            box.give(request)
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
            if message["status"] not in _FAILURES:
                raise ValueError(message["status"])
            raise GivenUpError(message["status"], _typed(message, "reason", str))
        if outcome.seconds_fit is None:
            outcome.warm_up, answer = message["warm_up"], _typed(message, "explains", bool)
            outcome.seconds_fit = _number(message, "seconds_fit", child.elapsed)
            explains.set_result(answer)
        elif "peak_rss_mb" in message:
            peak = max(peak, _number(message, "peak_rss_mb", memory))
            if "seconds_score" in message:
                seconds += _number(message, "seconds_score", child.elapsed)
            else:
                outcome.seconds_score = min(seconds, child.elapsed)
                outcome.peak_rss_mb = max(peak, child.peak / 1e6)
        elif (kind := _typed(message, "type", str)) in arrays:
            expected_kind, rows = expected.popleft()
            if kind != expected_kind:
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


def _send(
    child: Child,
    request: Mapping[str, Any],
    train: Iterable[Trajectory],
    groups: Iterable[Iterable[Trajectory]],
    explained: Iterable[Iterable[Trajectory]],
    explains: "Future[bool]",
    expected: "_Expected",
) -> None:
    """Send all; what has to come back of a trajectory is noted before it is sent."""
    send = child.channel.send

    def send_group(group: Iterable[Trajectory], kind: str) -> None:
        send({"group": True})
        rest = iter(group)
        while chunk := list(islice(rest, CHUNK)):
            send({"score": len(chunk), "explain": kind == "explanation"})
            for trajectory in chunk:
                expected.append((kind, len(trajectory)))
                child.channel.send_trajectory(trajectory)
        send({"score": 0})

    try:
        send({**request})
        for trajectory in train:
            child.channel.send_trajectory(trajectory)
        for group in groups:
            send_group(group, "array")
        # Last, as only what comes again is anomalous: no process that scores is told so.
        for group in explained if explains.result() else ():
            send_group(group, "explanation")
        send({"group": False})
    except ConnectionError:
        pass  # The worker ended; the receiving side finds out why.
    finally:
        child.hang_up()
