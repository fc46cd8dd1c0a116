"""Carry out a plan: one worker per unit, several at a time, every finished unit kept at once.

The runner prints nothing. Observers (`oodd_eval.hookspecs`) hear of every cell, and results are the
same bytes for any number of jobs.
"""

from __future__ import annotations

import os
import threading
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from typing import Any

from oodd_eval import provenance
from oodd_eval.evaluation import make_records
from oodd_eval.isolation import Limits
from oodd_eval.plan import Plan, Unit
from oodd_eval.plugins import Offer, Plugins
from oodd_eval.records import Record
from oodd_eval.results import ResultsDirectory, unit_key
from oodd_eval.scoring import LOCAL, Scored, UnitJob
from oodd_eval.splits import Split


def available_cores() -> int:
    """Return the number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True, slots=True)
class Settings:
    """How to run, without influence on any metric.

    Attributes
    ----------
    jobs
        Units at a time.
    limits
        Of each unit's worker.
    fresh
        Whether to fit again what the results directory has already.
    stop_on_failure
        Whether to end the run at the first cell that is not ok.
    """

    jobs: int = field(default_factory=available_cores)
    limits: Limits = field(default_factory=Limits)
    fresh: bool = False
    stop_on_failure: bool = False


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
    OutputError
        Before any work, when `results` cannot be written to.
    SplitError
        When data is missing or damaged; what was finished is kept.
    """
    if results:
        results.prepare()
    needed = dict.fromkeys(unit.environment for unit in plan.units)
    data = {environment: split.environment(environment) for environment in needed}
    plugins.notify("oodd_run_started", plan=plan)
    finished: dict[int, list[Record]] = {}
    stop = threading.Event()
    origin = provenance.gather()
    interrupted = False
    pool = ThreadPoolExecutor(max_workers=settings.jobs)
    futures: dict[Future[Scored], int] = {}
    try:
        for index, unit in enumerate(plan.units):
            job = UnitJob(plan, unit, data[unit.environment], plugins.offer(unit.detector))
            submit = _now if job.offer.plugin == LOCAL else pool.submit
            future = submit(job, settings.limits, stop, results, fresh=settings.fresh)
            futures[future] = index
        for future in as_completed(futures):
            index = futures.pop(future)  # with it go its scores, once they are kept
            unit = plan.units[index]
            offer = plugins.offer(unit.detector)
            scored = future.result()
            key = _keep(plan, unit, offer, scored, results)
            finished[index] = make_records(
                plan, unit, offer, data[unit.environment], scored, {**origin, **key}
            )
            for record in finished[index]:
                plugins.notify("oodd_cell_finished", record=record, resumed=scored.resumed)
            if settings.stop_on_failure and scored.status != "ok":
                break
    except KeyboardInterrupt:
        interrupted = True
    finally:
        stop.set()
        pool.shutdown(wait=True, cancel_futures=True)
        records = [record for index in sorted(finished) for record in finished[index]]
        if results and records:
            results.merge_records(records)
        for environment in data.values():
            environment.close()
    plugins.notify("oodd_run_finished", plan=plan, records=records, interrupted=interrupted)
    return Run(records, interrupted)


def _now(job: UnitJob, *arguments: Any, **settings: Any) -> Future[Scored]:
    """Do a job in this thread, where it can be interrupted; return it as a finished future."""
    future: Future[Scored] = Future()
    future.set_result(job(*arguments, **settings))
    return future


def _keep(
    plan: Plan, unit: Unit, offer: Offer, scored: Scored, results: ResultsDirectory | None
) -> dict[str, str]:
    """Store what a unit came to; return the provenance that leads there."""
    if offer.plugin == LOCAL:
        return {}
    key = unit_key(plan, unit, offer)
    if results and scored.status == "ok" and not scored.resumed:
        results.write_scores(key.text, scored.file)
    if results and scored.log:
        results.write_log(key.text, scored.log)
    return {"plugin_source": key.source, "scores": key.text}
