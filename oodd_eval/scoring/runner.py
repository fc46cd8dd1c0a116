"""Carry out a plan: one worker per unit, several at a time, every finished unit kept at once.

The runner prints nothing. Observers (`oodd_eval.plugins.hooks`) hear of every cell, and results are the
same bytes for any number of jobs.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import closing
from dataclasses import dataclass, field

from oodd_eval.data.split import EnvironmentData, Split
from oodd_eval.plugins.discovery import Plugins
from oodd_eval.plugins.isolation.supervisor import Limits
from oodd_eval.results import provenance
from oodd_eval.results.directory import ResultsDirectory, unit_key
from oodd_eval.results.evaluate import make_records
from oodd_eval.results.keeping import Keeper
from oodd_eval.results.record import Record
from oodd_eval.scoring.executors import LOCAL as LOCAL_EXECUTOR
from oodd_eval.scoring.executors import Executor, Orders, available_cores, opener
from oodd_eval.scoring.executors.turns import Turns
from oodd_eval.scoring.plan import Plan
from oodd_eval.scoring.unit import LOCAL, Scored, UnitJob

__all__ = ["Run", "Settings", "available_cores", "run"]


@dataclass(frozen=True, slots=True)
class Settings:
    """How to run, without influence on any metric.

    Attributes
    ----------
    jobs
        Units at a time; None means one per core, or per thread of a cluster.
    limits
        Of each unit's worker.
    fresh
        Whether to fit again what the results directory has already.
    stop_on_failure
        Whether to end the run at the first cell that is not ok.
    executor
        Where units are carried out: ``"local"`` or ``"dask://HOST:PORT"``.
    """

    jobs: int | None = None
    limits: Limits = field(default_factory=Limits)
    fresh: bool = False
    stop_on_failure: bool = False
    executor: str = LOCAL_EXECUTOR


@dataclass(frozen=True, slots=True)
class Run:
    """What a run came to: records in the order of the plan, and whether it was interrupted."""

    records: list[Record]
    interrupted: bool = False


def run(
    plan: Plan,
    split: Split,
    plugins: Plugins,
    settings: Settings,
    results: ResultsDirectory | None = None,
) -> Run:
    """Fit and score every unit of a plan.

    Parameters
    ----------
    plan
        What to do.
    split
        The data; `plan` was made for it.
    plugins
        Detectors, and the observers that hear of the progress.
    settings
        How to do it.
    results
        Where to keep scores and records, and to resume from; None keeps nothing.

    Returns
    -------
    Run
        A failing detector is a record with another status than ``"ok"``. An interrupted run has the
        records of the units that were finished.

    Raises
    ------
    UsageError, ExecutorError
        Before any work, when the executor does not exist.
    OutputError
        Before any work, when `results` cannot be written to.
    SplitError
        When data is missing or damaged; what was finished is kept.
    """
    open_executor = opener(settings.executor)
    keeper = Keeper(results)
    keeper.prepare()
    executor = open_executor(Orders(split, settings.limits, results, settings.fresh), settings.jobs)
    data: dict[str, EnvironmentData] = {}
    interrupted = False
    try:
        for environment in dict.fromkeys(unit.environment for unit in plan.units):
            data[environment] = split.environment(environment)
        plugins.notify("oodd_run_started", plan=plan)
        _carry_out(plan, data, plugins, settings, executor, keeper)
    except KeyboardInterrupt:
        interrupted = True
    finally:
        executor.close()
        for opened in data.values():
            opened.close()
        keeper.write()
    records = keeper.records
    plugins.notify("oodd_run_finished", plan=plan, records=records, interrupted=interrupted)
    return Run(records, interrupted)


def _carry_out(
    plan: Plan,
    data: dict[str, EnvironmentData],
    plugins: Plugins,
    settings: Settings,
    executor: Executor,
    keeper: Keeper,
) -> None:
    """Carry out the units, make records of each, and tell the observers."""
    origin = provenance.gather()
    jobs = [
        UnitJob(plan, unit, data[unit.environment], plugins.offer(unit.detector))
        for unit in plan.units
    ]

    def score(job: UnitJob) -> Scored:
        scored = executor(job)
        if job.offer.plugin != LOCAL:
            keeper.keep(unit_key(plan, job.unit, job.offer), scored)
        return scored

    with closing(_as_they_finish(jobs, score, executor)) as outcomes:
        for index, scored in outcomes:
            job, source = jobs[index], {}
            if job.offer.plugin != LOCAL:
                key = unit_key(plan, job.unit, job.offer)
                source = {"plugin_source": key.source, "scores": key.text}
            records = make_records(plan, job.unit, job.offer, job.data, scored, origin, **source)
            keeper.add(index, records)
            for record in records:
                plugins.notify("oodd_cell_finished", record=record, resumed=scored.resumed)
            if settings.stop_on_failure and scored.status != "ok":
                return


def _as_they_finish(
    jobs: Sequence[UnitJob], score: Callable[[UnitJob], Scored], executor: Executor
) -> Generator[tuple[int, Scored], None, None]:
    """Yield places of jobs and their scores as they finish.

    A job is begun only when one of those before it has been taken, so that the scores of a few
    units are in memory, however many there are.
    """
    pool = ThreadPoolExecutor(max_workers=executor.jobs)
    elsewhere = [(i, job) for i, job in enumerate(jobs) if job.offer.plugin != LOCAL]
    turns = Turns(elsewhere, executor.fit_of)

    def turn() -> tuple[int, Scored]:
        with turns.take() as (index, job):
            return index, score(job)

    running: list[Future[tuple[int, Scored]]] = []
    waiting = enumerate(jobs)
    try:
        while True:
            # Twice as many as are carried out at a time: nobody waits while records are made.
            while len(running) < 2 * executor.jobs and (entry := next(waiting, None)):
                index, job = entry
                if job.offer.plugin == LOCAL:
                    yield index, score(job)  # in this thread, where it can be interrupted
                else:
                    running.append(pool.submit(turn))
            if not running:
                return
            finished, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in [f for f in running if f in finished]:
                running.remove(future)
                yield future.result()
    finally:
        executor.stop()
        turns.stop()
        pool.shutdown(wait=True, cancel_futures=True)
