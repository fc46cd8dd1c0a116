"""A process of the harness's own interpreter, within limits, with all that it starts.

A crash, a hang, a memory blow-up, ``sys.exit`` or a raise of a detector ends the child, never the
harness. All that the child has started is ended with it: its process group, its descendants, and
those that left both, which a mark in the environment that they inherited gives away. POSIX only.
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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import psutil

from oodd_eval.errors import OoddError
from oodd_eval.plugins.isolation import END_POLL_SECONDS, MARK, Channel, ChannelClosedError, end_all
from oodd_eval.plugins.isolation.sandbox import PROCESSES, Sandbox

LOG_BYTES: Final = 64_000
POLL_SECONDS: Final = 0.05  # between two looks at a child that is silent
LOOK_SECONDS: Final = 0.5  # between two looks at all processes of a sandbox, which take longer

_SINGLE_THREAD: Final = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "LOKY_MAX_CPU_COUNT",
)


@dataclass(frozen=True, slots=True)
class Limits:
    """Wall-clock seconds and bytes of resident memory of one worker; None means no limit.

    With `hidden`, the worker is in a sandbox, in which these paths are not to be seen.
    """

    seconds: float | None = None
    memory: int | None = None
    hidden: tuple[str, ...] | None = None


Stop = Callable[[], bool]  # tells whether the work is to end, such as `threading.Event.is_set`


class GivenUpError(OoddError, RuntimeError):
    """A process has to end: the status and reason of its cell, and how the process ended."""

    def __init__(self, status: str, reason: str, ending: str = "") -> None:
        super().__init__(reason)
        self.status, self.reason, self.ending = status, reason, ending


class Child:
    """A module run as ``python -m MODULE READ_FD WRITE_FD LIFELINE_FD``, within limits.

    It has no standard input, the import path of this process, one thread for numerical libraries,
    and none of the variables that steer the harness. The system closes the lifeline when this
    process is killed: see `oodd_eval.plugins.isolation.worker.connect`. `sending` is the descriptor
    to write to it, for the caller to close; `channel` gives up with `GivenUpError` at a limit.
    In a sandbox, the limit of memory is for all its processes together.
    """

    def __init__(
        self, module: str, limits: Limits, stop: Stop | None = None, box: Sandbox | None = None
    ) -> None:
        reading, self.sending = os.pipe()
        self._receiving, writing = os.pipe()
        lifeline, self._held = os.pipe()
        descriptors: tuple[int, ...] = (reading, writing, lifeline)
        self._mark, self._box, self._looked = secrets.token_hex(8), box, -math.inf
        command = [sys.executable, "-P", "-m", module, *map(str, descriptors)]
        environment = {**_environment(box), MARK: self._mark}
        if box:
            command, more = box.command(command)
            descriptors = (*descriptors, more)
        self._process = subprocess.Popen(  # noqa: S603  our own interpreter and module
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            pass_fds=descriptors,
            env=environment,
            start_new_session=True,
        )
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
        if self._box:  # Its numbers mean nothing out here, and all its processes are watched.
            self.forked = forked
            return
        with contextlib.suppress(psutil.NoSuchProcess):  # It may have ended by now.
            process = psutil.Process(pid)
            if process.ppid() == self._process.pid:
                self._scoring, self.forked = process, forked
            elif process.is_running():  # While one is reaped, Linux says that its parent is 0.
                raise ValueError(pid)

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
        if self._box and self.returncode > 128:  # So bubblewrap tells of a signal.
            self.returncode = 128 - self.returncode
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
        used = self._resident_bytes() if self._box is None else self._sandboxed_bytes()
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

    def _sandboxed_bytes(self) -> int:
        """Return what all processes of the sandbox hold; what they share counts once."""
        if time.monotonic() - self._looked < LOOK_SECONDS:
            return 0
        self._looked = time.monotonic()
        with contextlib.suppress(psutil.Error):
            inside = self._seen.children(recursive=True)
            if len(inside) > PROCESSES:
                reason = f"started more than {PROCESSES} processes (--sandbox)"
                raise GivenUpError("error", reason, reason)
            held = 0
            for process in inside:
                with contextlib.suppress(psutil.Error):
                    held += int(process.memory_full_info().pss)
            return held
        return 0

    def together(self, held: Sequence[float]) -> float:
        """Return the memory of a worker and a process that scores, of what each of them holds.

        What a fork shares counts in both: the larger of the two holds all of it.
        """
        return max(held, default=0) if self.forked else sum(held)


def _killed_for_memory() -> int:
    """Return how many processes the system has killed for want of memory; 0 if it does not tell."""
    with contextlib.suppress(OSError, StopIteration, ValueError):
        told = Path("/proc/vmstat").read_text(encoding="ascii").splitlines()
        return int(next(line.split()[1] for line in told if line.startswith("oom_kill ")))
    return 0


def _environment(box: Sandbox | None) -> dict[str, str]:
    path = os.pathsep.join(str(Path(entry).absolute()) for entry in sys.path)
    # A detector must not see the harness's settings, nor the test that pytest names.
    steering = ("OODD_EVAL_", "PYTEST_CURRENT_TEST")
    own = {name: value for name, value in os.environ.items() if not name.startswith(steering)}
    kept = box.environment() if box else own
    single = dict.fromkeys(_SINGLE_THREAD, "1")
    return {**kept, **single, "PYTHONPATH": path, "PYTHONHASHSEED": "0"}
