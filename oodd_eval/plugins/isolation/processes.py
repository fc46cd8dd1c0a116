"""Processes of their own for code that may crash, hang or leave things behind. POSIX only.

Whatever such a process starts is ended with it: its process group at once, and, on Linux, those
that left the group, found by a mark in the environment that they inherited.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Final

from oodd_eval.errors import OoddError

MARK: Final = "OODD_EVAL_PROCESS"
"""Environment variable whose value is the same in a process and all that it starts, only there."""

POLL_SECONDS: Final = 0.005
LOG_BYTES: Final = 64_000

LONGEST_REASON: Final = 600
"""Characters of a reason, at most; of a longer one, the start and the end are kept."""

_PATIENCE: Final = 5.0
"""Seconds for which processes that left the group are hunted, should they multiply."""

_SINGLE_THREAD: Final = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "BLIS_NUM_THREADS": "1",
    "VECLIB_MAXIMUM_THREADS": "1",
    "NUMEXPR_NUM_THREADS": "1",
    "LOKY_MAX_CPU_COUNT": "1",
}


class Child:
    """A module of this program, run as ``python -m MODULE DESCRIPTOR ...``.

    It has no standard input, the import path of this process, one thread for numerical libraries,
    and none of the variables that steer the harness.

    Parameters
    ----------
    module
        Its name.
    descriptors
        Handed to it, as numbers on its command line; closed here.
    """

    def __init__(self, module: str, descriptors: Sequence[int]) -> None:
        self.mark = secrets.token_hex(8)
        self.process = subprocess.Popen(  # noqa: S603  our own interpreter and module
            [sys.executable, "-P", "-m", module, *map(str, descriptors)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            pass_fds=tuple(descriptors),
            env={**_environment(), MARK: self.mark},
            start_new_session=True,
        )
        for descriptor in descriptors:
            os.close(descriptor)
        self._log = _Tail(self.process.stdout)

    @property
    def exited(self) -> bool:
        """Whether it has ended; its id is kept from others until `end` has killed its group."""
        state = os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT)
        return state is not None

    @property
    def resident_bytes(self) -> int:
        """Resident memory, 0 where that cannot be known."""
        try:
            statm = Path(f"/proc/{self.process.pid}/statm").read_text(encoding="ascii")
            return int(statm.split()[1]) * os.sysconf("SC_PAGE_SIZE")
        except (OSError, IndexError):
            return 0

    def wait_for_exit(self, *, seconds: float) -> bool:
        """Wait until it has ended; False when it has not, after so many seconds."""
        deadline = time.monotonic() + seconds
        while not self.exited:
            if time.monotonic() > deadline:
                return False
            time.sleep(POLL_SECONDS)
        return True

    def end(self) -> str:
        """Kill it with all that it has started, and return the end of what was printed."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        # Whoever was just being started is found the next time round.
        deadline = time.monotonic() + _PATIENCE
        while (strays := list(_marked(self.mark))) and time.monotonic() < deadline:
            for pid in strays:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            time.sleep(POLL_SECONDS)
        return self._log.finish()

    def death(self) -> str:
        """Say how it ended, after `end`."""
        code = self.process.returncode
        if code < 0:
            return f"was killed by {signal.Signals(-code).name}"
        return f"ended with exit code {code}"


class _Tail:
    """Read what a process prints, and keep the end of it."""

    def __init__(self, stream: IO[bytes] | None) -> None:
        if stream is None:
            raise OoddError("the process was started without a pipe for its output")
        self._stream, self._kept = stream, b""
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while part := os.read(self._stream.fileno(), 1 << 16):
            self._kept = (self._kept + part)[-LOG_BYTES:]

    def finish(self) -> str:
        # A process that escaped could hold the pipe open for ever: do not wait for it.
        self._thread.join(timeout=1.0)
        if not self._thread.is_alive():
            self._stream.close()
        return self._kept.decode(errors="replace")


def printable(reason: str) -> str:
    r"""Return a line of a foreign process as one that every terminal, file and table takes.

    Examples
    --------
    >>> printable("ValueError: \x1b[2J")
    'ValueError: \ufffd[2J'
    >>> len(printable("x" * 10**6)) <= LONGEST_REASON
    True
    """
    if len(reason) > LONGEST_REASON:
        half = LONGEST_REASON // 2 - 3
        reason = f"{reason[:half]} ... {reason[-half:]}"
    # Halves of surrogate pairs, which no file takes, are not printable either.
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in reason)


def _environment() -> dict[str, str]:
    path = os.pathsep.join(str(Path(entry).absolute()) for entry in sys.path)
    # What steers the harness is none of a detector's business; pytest tells the cell under test.
    kept = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith("OODD_EVAL_") and name != "PYTEST_CURRENT_TEST"
    }
    return {**kept, **_SINGLE_THREAD, "PYTHONPATH": path, "PYTHONHASHSEED": "0"}


def _marked(mark: str) -> Iterator[int]:
    """Return the processes whose environment holds a mark, without those that have ended."""
    wanted = f"{MARK}={mark}".encode()
    for place in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if wanted in (place / "environ").read_bytes():
                yield int(place.name)
