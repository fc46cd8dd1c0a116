"""Checks in a process of their own: a detector that crashes or hangs fails a check, no more.

The process tells of every check before and after it. When it ends in between, the check it was at
has failed, and a new process goes on with the next one.
"""

from __future__ import annotations

import os
import select
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Final

from oodd_eval.plugins.conformance.report import Result
from oodd_eval.plugins.isolation.messages import Channel, ChannelClosedError, ChannelGarbledError
from oodd_eval.plugins.isolation.processes import Child

GATES: Final = frozenset({"factory", "fits"})
"""Checks without which no other one can be carried out."""

MOST_DEATHS: Final = 3
"""After so many checks that ended their process, the rest are not tried."""

_POLL_SECONDS: Final = 0.05


@dataclass(frozen=True, slots=True)
class CheckRequest:
    """What a process is told: the detector, how to make it, and the names of the checks."""

    plugin: str
    detector: str
    parameters: dict[str, Any]
    horizon: int
    seed: int
    checks: list[str]


@dataclass(frozen=True, slots=True)
class CheckLimits:
    """Wall-clock seconds of one check, and bytes of resident memory; None means no limit."""

    seconds: float | None = None
    memory: int | None = None


def supervise(request: CheckRequest, limits: CheckLimits) -> Iterator[Result]:
    """Carry out checks in processes of their own and return what each came to, one by one.

    Parameters
    ----------
    request
        What to check.
    limits
        Enforced from outside.
    """
    rest, deaths = list(request.checks), 0
    while rest:
        died = ""
        for result in _one_process(replace(request, checks=list(rest)), limits):
            yield result
            rest.remove(result.name)
            died = result.name
        deaths += 1
        if died in GATES or deaths == MOST_DEATHS:
            reason = f"not tried: check '{died}' ended its process"
            yield from (Result(name, "skipped", reason) for name in rest)
            return


def _one_process(request: CheckRequest, limits: CheckLimits) -> Iterator[Result]:
    """Give results until all are there, or the process has ended: then the last one says how."""
    to_child, from_here = os.pipe()
    to_here, from_child = os.pipe()
    child = Child("oodd_eval.plugins.conformance", (to_child, from_child))
    watch = _Watch(child, to_here, limits)
    channel = Channel(to_here, from_here, watch)
    ending = log = name = ""
    try:
        channel.send(asdict(request))
        for name in request.checks:
            watch.begin()
            yield _result(channel.receive(), name)
    except _LimitPassedError as passed:
        ending = str(passed)
    except ChannelGarbledError:
        ending = "wrote into the pipe to the harness"
    except (ChannelClosedError, BrokenPipeError):
        # A detector may have closed the pipe and gone on.
        gone = child.wait_for_exit(seconds=1.0)
        ending = "" if gone else "closed the pipe to the harness"
    else:
        return
    finally:
        log = child.end()
        os.close(to_here)
        os.close(from_here)
    yield Result(name, "failed", f"the process {ending or child.death()}", watch.elapsed, log)


class _LimitPassedError(Exception):
    """A process is over a limit; the message says over which one."""


class _Watch:
    """Wait for the next bytes of a process, and give up when a limit is passed."""

    def __init__(self, child: Child, descriptor: int, limits: CheckLimits) -> None:
        self._child, self._descriptor, self._limits = child, descriptor, limits
        self.begin()

    def begin(self) -> None:
        """Start the clock of a check."""
        self._start = time.perf_counter()

    @property
    def elapsed(self) -> float:
        """Seconds since then."""
        return time.perf_counter() - self._start

    def __call__(self) -> None:
        while not select.select([self._descriptor], [], [], _POLL_SECONDS)[0]:
            seconds, memory = self._limits.seconds, self._limits.memory
            if seconds is not None and self.elapsed > seconds:
                raise _LimitPassedError(f"was not done after {seconds:g} s (--timeout)")
            used = self._child.resident_bytes
            if memory is not None and used > memory:
                raise _LimitPassedError(
                    f"held {used / 1e6:.0f} MB, more than {memory / 1e6:.0f} MB (--memory)"
                )
            if self._child.exited and not select.select([self._descriptor], [], [], 0)[0]:
                raise ChannelClosedError("the process ended")


def _result(message: dict[str, Any], name: str) -> Result:
    """Return the result of a check as it was sent."""
    if set(message) != {field.name for field in fields(Result)} or message["name"] != name:
        raise ChannelGarbledError(f"expected the result of {name}, got {message!r:.80}")
    return Result(**message)
