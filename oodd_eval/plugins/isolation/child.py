"""A process of the harness's own interpreter, within limits, with all that it starts.

A crash, a hang, a memory blow-up, ``sys.exit`` or a raise of a detector ends the child, never the
harness. All that the child has started is ended with it: its process group, its descendants, and
those that left both, which a mark in the environment that they inherited gives away. POSIX only.
"""

import contextlib
import math
import os
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import psutil

from oodd_eval.errors import OoddError
from oodd_eval.plugins.isolation import (
    END_POLL_SECONDS,
    LOG_BYTES,
    LOOK_SECONDS,
    MARK,
    POLL_SECONDS,
    Channel,
    end_all,
)

_SINGLE_THREAD: Final = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "LOKY_MAX_CPU_COUNT",
)

# Where pyarrow is installed, pandas and scikit-learn import it, and its allocator keeps a thread
# that would run on after a fit: a process with threads cannot be forked.
_QUIET_ALLOCATOR: Final = {"JE_ARROW_MALLOC_CONF": "background_thread:false"}


@dataclass(frozen=True, slots=True)
class Limits:
    """Wall-clock seconds and bytes of resident memory of one worker; None means no limit."""

    seconds: float | None = None
    memory: int | None = None


class Launcher(Protocol):
    """Starts processes of workers in a place of their own, such as a sandbox.

    What it has started ends with it, and it ends with this process.
    """

    @property
    def processes(self) -> int:
        """Number of processes that a worker and all that it has started may be at a time."""

    @property
    def packages(self) -> Sequence[str]:
        """Directories of packages there, which a worker appends to its import path."""

    @property
    def elsewhere(self) -> Mapping[str, Any]:
        """Facts in JSON's values from which another machine makes an equal launcher.

        ``maker`` names a function as ``module:name``. Called with the other facts and ``memory``,
        it returns a launcher and the plug-ins there.
        """

    def wrap(self, command: Sequence[str]) -> tuple[list[str], list[int]]:
        """Return the command that runs another one there, and descriptors that it reads."""

    def environment(self) -> dict[str, str]:
        """Return the variables that a worker has there beside those of the harness."""


Stop = Callable[[], bool]  # tells whether the work is to end, such as `threading.Event.is_set`


class GivenUpError(OoddError, RuntimeError):
    """A process has to end: the status and reason of its cell, and how the process ended."""

    def __init__(self, status: str, reason: str, ending: str = "") -> None:
        super().__init__(reason)
        self.status, self.reason, self.ending = status, reason, ending


class Child:
    """A module run as ``python -m MODULE CHANNEL_FD [LIFELINE_FD]``, within limits.

    It has no standard input, one thread for numerical libraries, and none of the variables that
    steer the harness. Without a launcher it has the import path of this process and a lifeline,
    which the system closes when this process is killed: see
    `oodd_eval.plugins.isolation.worker.connect`. With one it has the import path of the
    environment, and what the launcher names for it.
    A thread keeps the limits; the limit of memory is for the process with all that it has started,
    and seconds count from `start`, which may be set.
    After a limit was passed, or the process has ended, what was sent can still be read, and its
    channels then raise.
    """

    def __init__(
        self,
        module: str,
        limits: Limits,
        stop: Stop | None = None,
        launcher: Launcher | None = None,
    ) -> None:
        self.start = time.monotonic()
        self._limits, self._stop = limits, stop
        self._verdict: GivenUpError | None = None
        self.channel, remote = self._channel_pair()
        self._channels = [self.channel]
        lifeline, self._held = os.pipe()
        passed = [remote] if launcher else [remote, lifeline]
        self._mark, self._looked = secrets.token_hex(8), -math.inf
        self._launcher = launcher
        command = [sys.executable, "-P", "-m", module, *map(str, passed)]
        environment = {**_environment(launcher), MARK: self._mark}
        if launcher:
            # Isolated as by -I, which would also drop the seed of hashes: the import path has no
            # directory of the user's and none of a variable, nor the working directory.
            command[1:1] = ["-s"]
            command, arguments = launcher.wrap([*command, *launcher.packages])
            passed += arguments
        self._process = subprocess.Popen(  # noqa: S603  our own interpreter and module
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            pass_fds=passed,
            env=environment,
            start_new_session=True,
        )
        for descriptor in {*passed, lifeline}:
            os.close(descriptor)
        self._seen = psutil.Process(self._process.pid)
        self._family = [self._seen]
        self._printed, self.peak, self._killed = b"", 0, _killed_for_memory()
        self._ended = threading.Event()
        self._threads = [threading.Thread(target=f, daemon=True) for f in (self._read, self._watch)]
        for thread in self._threads:
            thread.start()

    @property
    def elapsed(self) -> float:
        """Seconds of the limit that are used up."""
        return time.monotonic() - self.start

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

    def fork(self) -> Channel:
        """Have a worker fork, and return the channel of that process, in place of the last one."""
        channel, remote = self._channel_pair()
        self._channels[1:] = [channel]
        with contextlib.suppress(ConnectionError):  # It has ended, as the channel will tell.
            self.channel.send({"fork": True})
            self.channel.send_descriptor(remote)
        os.close(remote)
        return channel

    def check(self) -> None:
        """Raise `GivenUpError` when a limit was passed."""
        if self._verdict:
            raise self._verdict

    def _channel_pair(self) -> tuple[Channel, int]:
        """Return a channel, and the descriptor of its other end for one other process."""
        here, there = socket.socketpair()
        return Channel(here.detach(), self.check), there.detach()

    def end(self) -> str:
        """Kill it with all that it has started, and return the end of what was printed."""
        self._ended.set()
        end_all(self._process.pid, self._mark)
        self.returncode = self._process.wait()
        # Launchers report a signal as shells do.
        if self._launcher and 128 < self.returncode <= 128 + signal.NSIG:
            self.returncode = 128 - self.returncode
        # A process that escaped could hold the output open for ever: do not wait for it.
        for thread in self._threads:
            thread.join(timeout=1.0)
        os.close(self._held)
        return self._printed.decode(errors="replace")

    def close(self) -> None:
        """Close all channels."""
        for channel in self._channels:
            channel.close()

    def _read(self) -> None:
        """Read what is printed, and keep the end of it."""
        if self._process.stdout:
            with self._process.stdout as pipe:
                while part := os.read(pipe.fileno(), 1 << 16):
                    self._printed = (self._printed + part)[-LOG_BYTES:]

    def _watch(self) -> None:
        """Hang up when a limit is passed, or when the process has ended."""
        # A process that it has started may hold a channel open, or send half a frame.
        while not self._ended.wait(POLL_SECONDS):
            if not self.exited:
                self._verdict = self._verdict or self._judge()
                if not self._verdict:
                    continue
            for channel in self._channels:
                channel.hang_up()

    def death(self) -> str:
        """Say how it ended, after `end`."""
        if self.returncode < 0:
            names = {member.value: member.name for member in signal.Signals}  # not of all there are
            return f"was killed by {names.get(-self.returncode, f'signal {-self.returncode}')}"
        return f"ended with exit code {self.returncode}"

    @property
    def out_of_memory(self) -> bool:
        """Tell whether it was killed while the system killed processes for want of memory."""
        return self.returncode == -signal.SIGKILL and _killed_for_memory() > self._killed

    def _judge(self) -> GivenUpError | None:
        if self._stop and self._stop():
            return GivenUpError("error", "interrupted")
        seconds, memory = self._limits.seconds, self._limits.memory
        if seconds is not None and self.elapsed > seconds:
            reason = f"not done after {seconds:g} s (--timeout)"
            return GivenUpError("timeout", reason, f"was {reason}")
        used, processes = self._used()
        self.peak = max(self.peak, used)
        if memory is not None and used > memory:
            held, most = f"{used / 1e6:.0f} MB", f"{memory / 1e6:.0f} MB (--memory)"
            reason = f"resident memory {held} is over the limit of {most}"
            return GivenUpError("oom", reason, f"held {held}, more than {most}")
        if self._launcher and processes > self._launcher.processes:
            reason = f"started more than {self._launcher.processes} processes (--sandbox)"
            return GivenUpError("error", reason, reason)
        return None

    def _used(self) -> tuple[int, int]:
        """Return resident bytes and the number of its processes, now and then of all."""
        # What processes share counts once. In between, the largest counts.
        looks, held = time.monotonic() - self._looked > LOOK_SECONDS, 0
        if looks:
            self._looked = time.monotonic()
            with contextlib.suppress(psutil.Error):
                self._family = [self._seen, *self._seen.children(recursive=True)]
        for process in self._family:
            with contextlib.suppress(psutil.Error):
                if looks:
                    info = process.memory_full_info()
                    held += int(getattr(info, "pss", info.uss))
                else:
                    held = max(held, int(process.memory_info().rss))
        return held, len(self._family)


def _killed_for_memory() -> int:
    """Return how many processes the system has killed for want of memory; 0 if it does not tell."""
    with contextlib.suppress(OSError, StopIteration, ValueError):
        lines = Path("/proc/vmstat").read_text(encoding="ascii").splitlines()
        return int(next(line.split()[1] for line in lines if line.startswith("oom_kill ")))
    return 0


def _environment(launcher: Launcher | None) -> dict[str, str]:
    # A detector must not see the harness's settings, nor the test that pytest names.
    steering = ("OODD_EVAL_", "PYTEST_CURRENT_TEST")
    variables = {n: value for n, value in os.environ.items() if not n.startswith(steering)}
    path = os.pathsep.join(str(Path(entry).absolute()) for entry in sys.path)
    kept = launcher.environment() if launcher else {**variables, "PYTHONPATH": path}
    single = dict.fromkeys(_SINGLE_THREAD, "1")
    return {**kept, **single, **_QUIET_ALLOCATOR, "PYTHONHASHSEED": "0"}
