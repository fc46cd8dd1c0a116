"""Run one detector in processes of its own, and turn every way to fail into a status."""

import math
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field
from itertools import chain, islice
from typing import Any, Final, TypeAlias

import numpy as np
import psutil
from numpy.typing import NDArray

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.plugins.contract import PROGRESS_SECONDS, Progress, ignore_progress
from oodd_eval.plugins.isolation import (
    CHUNK,
    CLOSED_SECONDS,
    HEADER_BYTES,
    LOG_BYTES,
    MOST_PREFIXES,
    ROW_BYTES,
    SCORES,
    Channel,
    ChannelClosedError,
    ChannelGarbledError,
    message_of,
)
from oodd_eval.plugins.isolation.child import Child, GivenUpError, Launcher, Limits, Stop
from oodd_eval.plugins.state import PackedState
from oodd_eval.plugins.voices import VoiceCosts

_FAILURES: Final = {"error", "oom", "invalid", "incompatible", "unavailable"}
"""The values that a worker reports of itself."""


@dataclass(slots=True)
class Outcome:
    """Scores of a fit, or the way in which it failed.

    `status` is as in a record, with a reason of one line unless ok. `scores`, `warm_up` and what is
    kept of explanations, if it `explains`, are the detector's own, and checked only for their
    number and size, as are costs of `voices` for their form. `state` is that of the fit, checked,
    where it was asked for and there is one. Costs are None when the worker ended before they were
    known; what it told of them is held within what this process knows. `log` is the end of the
    detector's output.
    """

    status: str = "ok"
    reason: str = ""
    scores: list[object] = field(default_factory=list)
    explains: bool = False
    explained: list[object] = field(default_factory=list)
    voices: dict[str, Any] = field(default_factory=dict)
    warm_up: object = 0
    state: PackedState | None = None
    seconds_fit: float | None = None
    seconds_score: float | None = None
    peak_rss_mb: float | None = None
    log: str = ""


Explained: TypeAlias = Callable[[Outcome], Iterable[Iterable[Trajectory]]]
"""A function that returns, when all is scored, groups of trajectories to be explained."""


def run_isolated(
    request: Mapping[str, Any],
    train: Sequence[Trajectory],
    groups: Iterable[Iterable[Trajectory]],
    explained: Explained | None = None,
    heard: Iterable[Trajectory] = (),
    *,
    limits: Limits,
    stop: Stop,
    failures: Sequence[Trajectory] | None = None,
    launcher: Launcher | None = None,
    state: PackedState | None = None,
    keep: bool = False,
    streamed: bool = False,
    progress: Progress = ignore_progress,
) -> Outcome:
    """Fit on `train` and score groups of trajectories, each group in a process of its own.

    A detector that learns from failed episodes is handed `failures`, too.

    A group's process is a fork of the fitted one. Where there can be none, as threads run on after
    the fit or a launcher starts each process, it is a fresh one, which takes over the state of the
    fit; with a launcher, a detector without a state is fitted again in each. A detector that
    explains is asked to explain the groups that `explained` returns in the same way, and one with
    voices for what these cost on the nominal episodes `heard`, last.

    The request names ``plugin`` and ``detector``, its ``parameters``, ``seed``, ``horizon`` and
    perhaps ``baseline`` and ``roles`` (see `make_detector`) and ``hearing`` (`costs_of_voices`).
    `state` is that of an earlier fit, which replaces fitting; with `keep`, the outcome has that of
    this one. `streamed` hands over one row of each episode at a time, and waits for the scores
    before the next.
    `progress` is called with the share of the fit that is done, as far as the detector tells, and
    with 1 at its end.

    Groups are read once and lazily. Scores come back in their order. When `stop` says True, the
    worker is killed and the status is ``"error"``. Only errors of reading the trajectories are
    raised.
    """
    settings = limits, stop, launcher, state, keep, streamed, progress
    unit = _UnitRun(request, train, failures, *settings)
    try:
        unit.run(groups, explained, heard)
    except GivenUpError as error:
        unit.outcome.status, unit.outcome.reason = error.status, error.reason
    return unit.outcome


@dataclass(slots=True)
class _UnitRun:
    """The processes of one unit, one after the other, and what they come to."""

    request: Mapping[str, Any]
    train: Sequence[Trajectory]
    failures: Sequence[Trajectory] | None
    limits: Limits
    stop: Stop
    launcher: Launcher | None
    state: PackedState | None
    keep: bool
    streamed: bool
    progress: Progress
    outcome: Outcome = field(default_factory=Outcome)
    start: float = field(default_factory=time.monotonic)
    seconds: float = 0.0
    peak: float = 0.0
    updates: bool = False
    voices: bool = False
    streams: int = CHUNK

    def run(
        self,
        groups: Iterable[Iterable[Trajectory]],
        explained: Explained | None,
        heard: Iterable[Trajectory],
    ) -> None:
        """Fit and score; `GivenUpError` for any failure."""
        with ExitStack() as stack:
            fitted = None
            if not (self.launcher and self.state):
                fitted = stack.enter_context(self._process())
                if not self._fit(fitted, forks=not self.launcher):
                    stack.close()
                    fitted = None
            for group in groups:
                self._group(fitted, group, "stream" if self.streamed else "score")
            # Explain last: only anomalous episodes are explained, and a scoring process must not
            # learn which.
            if explained and self.outcome.explains:
                for group in explained(self.outcome):
                    self._group(fitted, group, "explain")
            if self.voices and heard:
                self._group(fitted, heard, "hear")
        self.outcome.seconds_score = min(self.seconds, time.monotonic() - self.start)
        self.outcome.peak_rss_mb = self.peak

    def _group(self, fitted: Child | None, group: Iterable[Trajectory], order: str) -> None:
        """Have a process of its own score, explain or hear a group."""
        work = {"stream": self._stream, "hear": self._hear}.get(order, self._score)
        with ExitStack() as stack:
            if fitted:
                channel = stack.enter_context(closing(fitted.fork()))
            else:
                child = stack.enter_context(self._process())
                self._fit(child, forks=False)
                channel = child.channel
            work(channel, group, order)

    @contextmanager
    def _process(self) -> Iterator[Child]:
        """Start a process, and end it after use; `GivenUpError` says how it failed."""
        module, gone = "oodd_eval.plugins.isolation.worker", None
        with closing(Child(module, self.limits, self.stop, self.launcher)) as child:
            child.start = self.start
            try:
                yield child
            except ChannelGarbledError as error:
                self.outcome.log += f"{error}\n"
                reason = "the detector wrote into the pipe between worker and harness"
                raise GivenUpError("error", reason) from None
            except (ChannelClosedError, ConnectionError):
                child.check()
                gone = child.wait_for_exit(seconds=CLOSED_SECONDS)
            finally:
                self.outcome.log = (self.outcome.log + child.end())[-LOG_BYTES:]
                self.peak = max(self.peak, child.peak / 1e6)
            if gone is not None:
                doing = "fitting" if self.outcome.seconds_fit is None else "scoring"
                raise _ended(child, doing, gone=gone)

    def _fit(self, child: Child, *, forks: bool) -> bool:
        """Have a process fit, or take over the state; return whether groups can be forks of it."""
        state, channel, outcome = self.state, child.channel, self.outcome
        with suppress(ConnectionError):  # It has ended; what it said tells why.
            failed = None if self.failures is None else len(self.failures)
            train = () if state else (self.train, self.failures or ())
            wants = state is None and outcome.seconds_fit is None and (self.keep or not forks)
            order = {"train": len(self.train), "failures": failed, "restore": state is not None}
            channel.send({**self.request, **order, "forks": forks, "state": wants})
            if state:
                channel.send_state(state)
            for trajectory in chain.from_iterable(train):
                channel.send_trajectory(trajectory)
        message, latest = _receive(channel), -math.inf
        while "progress" in message:
            share = _number(message, "progress", 1.0)
            # An honest worker does not tell more often.
            if time.monotonic() - latest > PROGRESS_SECONDS / 2:
                latest = time.monotonic()
                self.progress(share)
            message = _receive(channel)
        seconds = _number(message, "seconds_fit", child.elapsed)
        self.progress(1.0)
        outcome.seconds_fit = seconds if outcome.seconds_fit is None else outcome.seconds_fit
        outcome.warm_up = _value(message, "warm_up", object)
        outcome.explains, self.updates, can_fork, follows, self.voices = (
            _value(message, name, bool)
            for name in ("explains", "updates", "forks", "state", "voices")
        )
        if follows:
            outcome.state = self.state = channel.receive_state()
        if forks and not can_fork and not self.state:
            raise GivenUpError(
                "incompatible",
                "threads or processes run on after fit, which groups would share, so that the "
                "process cannot be forked, and there is no state to hand over: end them in fit, or "
                "give the detector state and restore",
            )
        return bool(can_fork)

    def _score(self, channel: Channel, group: Iterable[Trajectory], order: str) -> None:
        arrays = self.outcome.explained if order == "explain" else self.outcome.scores
        rest = iter(group)
        while chunk := list(islice(rest, CHUNK)):
            with suppress(ConnectionError):
                channel.send({order: len(chunk)})
                for trajectory in chunk:
                    channel.send_trajectory(trajectory)
            self._cost(channel)
            for trajectory in chunk:
                rows = len(trajectory) + trajectory.observation_dim + trajectory.action_dim
                arrays.append(channel.receive_array(HEADER_BYTES + ROW_BYTES * rows))

    def _hear(self, channel: Channel, group: Iterable[Trajectory], order: str) -> None:
        episodes = [*group]
        with suppress(ConnectionError):
            channel.send({order: len(episodes), **self.request["hearing"]})
            for trajectory in episodes:
                channel.send_trajectory(trajectory)
        if costs := _value(_receive(channel), "costs", dict):
            self.outcome.voices = VoiceCosts.of(costs).values()

    def _stream(self, channel: Channel, group: Iterable[Trajectory], order: str) -> None:
        """Send episodes in lockstep: a row of each, and the next ones when all scores are there."""
        rest, episodes = iter(group), list[Trajectory]()
        while episodes := [*episodes, *islice(rest, max(0, self.streams - len(episodes)))]:
            n, width = max(map(len, episodes)), episodes[0].action_dim
            if not self.updates and n > MOST_PREFIXES:
                reason = f"an episode has {n} rows, and without update at most {MOST_PREFIXES} are "
                raise GivenUpError("incompatible", reason + "scored row by row")
            memory = self.limits.memory or psutil.virtual_memory().total
            columns = 1 + width + episodes[0].observation_dim
            shape = {"actions": width, "width": columns, "room": memory // 4}
            most = min(len(episodes), self.streams)
            channel.send({order: most, **shape})
            streams = _value(_receive(channel), "streams", int)
            if not 1 <= streams <= most:
                raise ChannelGarbledError(f"{streams} streams for {most} episodes")
            if streams < most:
                self.streams = streams
            self.outcome.scores += _in_lockstep(channel, episodes[:streams])
            self._cost(channel)
            episodes = episodes[streams:]

    def _cost(self, channel: Channel) -> None:
        """Receive what scoring has cost."""
        message = _receive(channel)
        memory = psutil.virtual_memory().total / 1e6
        self.seconds += _number(message, "seconds_score", time.monotonic() - self.start)
        self.peak = max(self.peak, _number(message, "peak_rss_mb", memory))


def _in_lockstep(channel: Channel, episodes: Sequence[Trajectory]) -> list[NDArray[np.float64]]:
    """Send rows of episodes until all have ended; return the scores."""
    # Before an episode's first row there is no action.
    rows = []
    for i, x in enumerate(episodes):
        parts = [np.full((len(x), 1), i), np.pad(x.actions, ((1, 0), (0, 0))), x.observations]
        rows.append(np.hstack(parts, dtype=np.float32, casting="unsafe"))
    scores, t = [np.empty(len(x)) for x in rows], 0
    while running := [i for i, x in enumerate(rows) if t < len(x)]:
        channel.send_bytes(b"".join(rows[i][t].tobytes() for i in running))
        frame = channel.receive_bytes()
        if frame[:1] != SCORES or len(frame) != 1 + 8 * len(running):
            _checked(message_of(frame))
            raise ChannelGarbledError("a message in place of scores")
        for i, score in zip(running, np.frombuffer(frame, "<f8", offset=1), strict=True):
            scores[i][t] = score
        t += 1
    channel.send_bytes(b"")
    return scores


def _ended(child: Child, doing: str, *, gone: bool) -> GivenUpError:
    """Return how a process has failed that closed its channel without a result."""
    if not gone:
        return GivenUpError("error", f"the worker closed its pipe while {doing}, without a result")
    if child.out_of_memory:
        reason = f"the system ran out of memory and killed the worker while {doing}"
        return GivenUpError("oom", reason)
    reason = f"the worker {child.death()} while {doing}"
    if child.returncode == -signal.SIGKILL:
        reason += f", not by oodd-eval; it held {child.peak / 1e6:.0f} MB or more"
    return GivenUpError("error", reason)


def _receive(channel: Channel) -> dict[str, Any]:
    return _checked(channel.receive())


def _checked(message: dict[str, Any]) -> dict[str, Any]:
    """Return a message that reports no failure; `GivenUpError` for one that does."""
    if "status" in message:
        status, reason = (_value(message, name, str) for name in ("status", "reason"))
        if status not in _FAILURES:
            raise ChannelGarbledError(f"status {status!r:.80}")
        raise GivenUpError(status, reason)
    return message


def _value(message: Mapping[str, Any], name: str, kind: type[Any]) -> Any:
    """Return a value of a message; raise for a missing one, or one of another type."""
    if name not in message or (kind is not object and type(message[name]) is not kind):
        raise ChannelGarbledError(f"{name} in {message!r:.80}")
    return message[name]


def _number(message: Mapping[str, Any], name: str, most: float) -> float:
    """Return a number of a message, and at most what is possible; raise for no amount."""
    value = _value(message, name, object)
    if type(value) not in (int, float) or not 0 <= value < math.inf:
        raise ChannelGarbledError(f"{name} = {value!r:.80}")
    return float(min(value, most))
