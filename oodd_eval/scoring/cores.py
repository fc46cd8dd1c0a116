"""Cores that this process may use: of its affinity, its cgroups, its batch job and its limits.

A batch job or a container has a share of its machine. Jobs beyond that share wait for each other,
and jobs beyond a limit on processes or open files fail.
"""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

_PROCESSES: Final = 16
"""Processes and threads of a job: a worker, the process that watches it, threads of libraries."""
_FILES: Final = 10
"""Descriptors that a job takes in this process: pipes, a log, a file of results."""


def available_cores(root: Path = Path("/")) -> int:
    """Return the number of cores, at least 1, that this process may keep busy.

    Parameters
    ----------
    root
        Directory that holds ``proc`` and ``sys``.
    """
    bound = hasattr(os, "sched_getaffinity")  # not on macOS
    cores = len(os.sched_getaffinity(0)) if bound else os.cpu_count() or 1
    return max(1, int(min(cores, *_limits(), *_grants(root))))


def _limits() -> Iterator[float]:
    """Yield the cores of a task of SLURM, and the jobs for which open files and processes last."""
    import resource  # noqa: PLC0415  POSIX only

    # Not every SLURM binds a task to its cores.
    with contextlib.suppress(KeyError, ValueError):
        yield int(os.environ["SLURM_CPUS_PER_TASK"])
    for limit, each in ((resource.RLIMIT_NOFILE, _FILES), (resource.RLIMIT_NPROC, _PROCESSES)):
        most, _ = resource.getrlimit(limit)
        if most != resource.RLIM_INFINITY:
            yield most / each


def _grants(root: Path) -> Iterator[float]:
    """Yield the cores, and the jobs for which processes last, of this process's cgroups."""
    for directory in _cgroups(root):
        quota = _numbers(directory / "cpu.max")  # "max 100000" without a limit
        if len(quota) != 2:  # version 1 of cgroups; -1 without a limit
            files = (directory / "cpu.cfs_quota_us", directory / "cpu.cfs_period_us")
            quota = [number for file in files for number in _numbers(file)]
        if len(quota) == 2 and min(quota) > 0:
            yield quota[0] / quota[1]
        yield from (most / _PROCESSES for most in _numbers(directory / "pids.max"))


def _cgroups(root: Path) -> Iterator[Path]:
    """Yield directories of the cgroups of this process, and of those that they are in."""
    # Inside a container a cgroup may be named as from outside; its top is there in any case.
    lines = []
    with contextlib.suppress(OSError):
        lines = (root / "proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    for line in lines:
        _, controllers, group = line.split(":", 2)
        home = root / "sys/fs/cgroup" / controllers
        path = home / group.lstrip("/")
        yield from (p for p in (path, *path.parents) if p.is_relative_to(home))


def _numbers(file: Path) -> list[float]:
    """Return the numbers in a small file of the kernel, none where there is no such file."""
    with contextlib.suppress(OSError, ValueError):
        return [float(word) for word in file.read_text(encoding="utf-8").split()]
    return []
