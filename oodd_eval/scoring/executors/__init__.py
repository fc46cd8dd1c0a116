"""Executors: where units run. In workers of this machine, or on an existing Dask cluster."""

import threading
from dataclasses import dataclass, field
from typing import Final
from urllib.parse import urlsplit

from oodd_eval.data.split import Split
from oodd_eval.errors import UsageError
from oodd_eval.plugins.contract import Progress, ignore_progress
from oodd_eval.plugins.isolation.child import Launcher, Limits
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.scoring.cores import available_cores
from oodd_eval.scoring.unit import Scored, UnitJob

LOCAL: Final = "local"  # the executor where none is named


@dataclass(frozen=True, slots=True)
class RunSettings:
    """Settings of a run that change no metric.

    `jobs` are units at a time (None: one per core, or per thread of a cluster), `limits` those of
    each worker. A `launcher`, such as a sandbox, starts the workers. `fresh` fits
    again what the results directory has. `executor` is ``"local"`` or ``"dask://HOST:PORT"``. After
    `deadline` seconds nothing new is begun. `command` is the command line, for the provenance of
    records. `streamed` hands a detector one row at a time and waits for its score before the next;
    no command asks for it. `row_metrics` adds metrics that are computed on request.
    """

    jobs: int | None = None
    limits: Limits = field(default_factory=Limits)
    launcher: Launcher | None = None
    fresh: bool = False
    stop_on_failure: bool = False
    executor: str = LOCAL
    deadline: float | None = None
    command: str = ""
    streamed: bool = False
    row_metrics: bool = False


class Executor:
    """Runs units, here each in a worker process of its own; called from several threads at a time.

    `jobs` are units at a time. Where it `keeps_fits`, units with one fit key share the fit that the
    first one keeps.
    """

    def __init__(
        self, settings: RunSettings, results: ResultsDirectory | None, stopping: threading.Event
    ) -> None:
        self.jobs = settings.jobs or available_cores()
        self.keeps_fits = results is not None
        self._settings, self._results, self._stopping = settings, results, stopping

    def __call__(self, job: UnitJob, progress: Progress = ignore_progress) -> Scored:
        """Score a unit, or find its scores in an earlier run's results.

        `progress` hears which share of the fit is done, in the thread that calls.
        """
        limits, fresh = self._settings.limits, self._settings.fresh
        stop = self._stopping.is_set
        return job(limits, stop, self._results, fresh=fresh, progress=progress)

    def stop(self) -> None:
        """Give up what is under way: calls return soon, or raise, and no process is left."""
        self._stopping.set()

    def close(self) -> None:
        """Release what is held, once no call is under way."""


def open_executor(
    settings: RunSettings, split: Split, results: ResultsDirectory | None
) -> Executor:
    """Return the executor that the settings name."""
    if settings.executor == LOCAL:
        return Executor(settings, results, threading.Event())
    from oodd_eval.scoring.executors.dask import DaskExecutor  # noqa: PLC0415  an extra

    return DaskExecutor(f"tcp://{urlsplit(settings.executor).netloc}", settings, split, results)


def check_executor(name: str) -> None:
    """Raise `UsageError` unless a name is ``local`` or ``dask://HOST:PORT``."""
    if name == LOCAL:
        return
    try:
        address = urlsplit(name)
        complete = address.scheme == "dask" and address.hostname and address.port
    except ValueError:
        complete = False
    if not complete or address.path or address.query or address.fragment:
        raise UsageError(
            f"--executor {name!r}, expected 'local' or 'dask://HOST:PORT', the address of a Dask "
            "scheduler"
        )
