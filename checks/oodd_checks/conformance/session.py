"""Run the tests of a detector in pytest: in this process, or in processes of their own.

A process of its own is given up when its detector crashes or hangs: then the check that it was at
has failed, and a new process goes on with the next one. Such a process runs this module, too, as
``python -m oodd_checks.conformance.session CHANNEL_FD LIFELINE_FD``.
"""

import os
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from types import ModuleType
from typing import Any, Final
from unittest.mock import patch

import pytest

from oodd_checks.conformance import Result, test_detector
from oodd_checks.conformance.trial import Trial
from oodd_eval.errors import ContractError, UsageError
from oodd_eval.plugins.discovery import Offer, offer_of, printable
from oodd_eval.plugins.isolation import ChannelClosedError, ChannelGarbledError
from oodd_eval.plugins.isolation.child import Child, GivenUpError, Limits
from oodd_eval.plugins.isolation.worker import connect, reason_of

CHECKS: Final[dict[str, Callable[[Trial], None]]] = {
    name.removeprefix("test_").replace("_", "-"): function
    for name, function in vars(test_detector).items()
    if name.startswith("test_")
}
"""The tests by name, in the order in which they run; a docstring says what holds."""

GATES: Final = frozenset({"factory", "fits"})  # without them no other check is possible
MOST_ENDS: Final = 3  # after so many checks that ended their process, the rest are not tried

# Nothing of the user's pytest, and nothing that prints or changes the process.
_OPTIONS: Final = (
    *("-c", os.devnull, "--noconftest", "--assert=plain", "--import-mode=importlib"),
    *("-pno:cacheprovider", "-pno:capture", "-pno:faulthandler", "-pno:logging", "-pno:terminal"),
    *("-pno:threadexception", "-pno:unraisableexception"),
)
_VARIABLES: Final = {
    "PYTEST_ADDOPTS": "",
    "PYTEST_PLUGINS": "",
    "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
}


class _Session:
    """The pytest plug-in that selects the tests and hands over what they came to."""

    def __init__(self, checks: Collection[str], listener: Callable[[Result], object]) -> None:
        self._checks, self._listener = checks, listener

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = [item for item in items if _name(item) in self._checks]

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        report = yield
        if call.when != "call":
            return report
        message, detail, error = "", "", call.excinfo and call.excinfo.value
        if report.skipped:
            message = str(error)
        elif error:
            failed = isinstance(error, AssertionError | ContractError)
            message = printable(str(error) if failed else f"the detector raised {reason_of(error)}")
            if cause := error.__cause__ if failed else error:
                lines = "".join(traceback.format_exception(cause)).splitlines()
                detail = "\n".join(map(printable, lines))
        self._listener(Result(_name(item), report.outcome, message, call.duration, detail))
        return report


def _name(item: pytest.Item) -> str:
    return item.name.removeprefix("test_").replace("_", "-")


def run_tests(
    trial: Trial, listener: Callable[[Result], object], checks: Collection[str] = tuple(CHECKS)
) -> None:
    """Run tests in this process and call `listener` with each result."""
    if not __debug__:
        raise UsageError("checks of detectors are assertions: run them without python -O")
    # A module: pytest deprecates fixtures of instances that last longer than a test.
    fixtures = ModuleType("oodd_eval_detector")
    vars(fixtures)["detector"] = pytest.fixture(scope="session", name="detector")(lambda: trial)
    plugins = [_Session(checks, listener), fixtures]
    with patch.dict(os.environ, _VARIABLES):
        code = pytest.main([*_OPTIONS, str(test_detector.__file__)], plugins)
    if code == pytest.ExitCode.INTERRUPTED:
        raise KeyboardInterrupt
    if code not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
        raise RuntimeError(f"pytest ended with {code!r}")


def supervise(
    offer: Offer, arguments: Mapping[str, Any], checks: Sequence[str], limits: Limits
) -> Iterator[Result]:
    """Run tests of a `Trial` in processes of their own, within limits; yield results."""
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
    start, ending, log, name = time.monotonic(), "", "", request["checks"][0]
    with closing(Child(__name__, limits)) as child:
        try:
            child.channel.send(request)
            for name in request["checks"]:
                start = time.monotonic()
                child.start = start
                yield _result(child.channel.receive(), name)
        except GivenUpError as error:
            ending = error.ending
        except (ChannelGarbledError, TypeError):
            ending = "wrote into the pipe to the harness"
        except (ChannelClosedError, ConnectionError):
            # A detector may have closed the pipe and gone on.
            gone = child.wait_for_exit(seconds=1.0)
            ending = "" if gone else "closed the pipe to the harness"
        else:
            return
        finally:
            log = child.end()
    message = f"the process {ending or child.death()}"
    yield Result(name, "failed", message, time.monotonic() - start, log)


def _result(message: dict[str, Any], name: str) -> Result:
    """Return the result of a check as it was sent; `TypeError` for another message."""
    if message.get("name") != name:
        raise TypeError(f"expected the result of {name}, got {message!r:.80}")
    return Result(**message)


if __name__ == "__main__":
    channel, _ = connect(sys.argv[1:])
    try:
        os.chdir(Path.cwd())
    except OSError:  # it is gone or cannot be gone back to, and pytest needs one
        os.chdir(tempfile.gettempdir())
    request = channel.receive()
    spec = offer_of(request["plugin"], request["detector"]).spec
    run_tests(
        Trial(spec, **request["arguments"]),
        lambda result: channel.send(asdict(result)),
        request["checks"],
    )
