"""Checks in processes of their own: a detector that crashes or hangs fails a check, no more.

The process sends every result when it has it. When it ends in between, the check it was at has
failed, and a new process goes on with the next one. Such a process runs this module, too, as
``python -m oodd_eval.plugins.conformance.supervise READ_FD WRITE_FD LIFELINE_FD``.
"""

import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any, Final

from oodd_eval.plugins.conformance import Result, carry_out
from oodd_eval.plugins.conformance.trial import Trial
from oodd_eval.plugins.discovery import Offer, offer_of
from oodd_eval.plugins.isolation import ChannelClosedError, ChannelGarbledError
from oodd_eval.plugins.isolation.child import Child, GivenUpError, Limits
from oodd_eval.plugins.isolation.worker import connect

GATES: Final = frozenset({"factory", "fits"})  # without them no other check is possible
MOST_ENDS: Final = 3  # after so many checks that ended their process, the rest are not tried


def supervise(
    offer: Offer, arguments: Mapping[str, Any], checks: Sequence[str], limits: Limits
) -> Iterator[Result]:
    """Carry out checks of a `Trial` in processes of their own, within limits; yield results."""
    request = {"plugin": offer.plugin, "detector": offer.spec.name, "arguments": arguments}
    last = ""
    for _ in range(MOST_ENDS):
        for result in _one_process({**request, "checks": checks}, limits):
            yield result
            checks, last = checks[1:], result.name
        if not checks or last in GATES:
            break
    for name in checks:
        yield Result(name, "skipped", f"not tried: check '{last}' ended its process")


def _one_process(request: dict[str, Any], limits: Limits) -> Iterator[Result]:
    """Yield results until all are there, or the process has ended: then the last one says how."""
    child = Child("oodd_eval.plugins.conformance.supervise", limits)
    start, ending, log, name = time.perf_counter(), "", "", request["checks"][0]
    try:
        child.channel.send(request)
        for name in request["checks"]:
            start = time.perf_counter()
            child.start_clock()
            yield _result(child.channel.receive(), name)
    except GivenUpError as error:
        ending = error.told
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
        os.close(child.sending)
    message = f"the process {ending or child.death()}"
    yield Result(name, "failed", message, time.perf_counter() - start, log)


def _result(message: dict[str, Any], name: str) -> Result:
    """Return the result of a check as it was sent."""
    if set(message) != {field.name for field in fields(Result)} or message["name"] != name:
        raise ChannelGarbledError(f"expected the result of {name}, got {message!r:.80}")
    return Result(**message)


def serve(command_line: Sequence[str]) -> None:
    """Carry out one request in this process and send the results."""
    channel = connect(command_line)
    request = channel.receive()
    trial = Trial(offer_of(request["plugin"], request["detector"]).spec, **request["arguments"])
    for result in carry_out(trial, request["checks"]):
        channel.send(asdict(result))


if __name__ == "__main__":
    serve(sys.argv[1:])
