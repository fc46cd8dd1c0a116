"""Run a plan: one worker per unit, several at a time, every finished unit kept at once.

The runner prints nothing. Observers (`oodd_eval.scoring.observers`) are called for every cell, and
results are the same bytes for any number of jobs.
"""

import math
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import partial
from graphlib import TopologicalSorter
from queue import SimpleQueue
from typing import Any

from oodd_eval.data.files import write_text
from oodd_eval.data.split import Split
from oodd_eval.errors import UsageError
from oodd_eval.plugins.contract import Progress
from oodd_eval.plugins.discovery import Plugins
from oodd_eval.results.directory import RecordWriter, ResultsDirectory
from oodd_eval.results.evaluate import counts_of, evaluated, with_stream
from oodd_eval.results.record import Record, gather
from oodd_eval.scoring.executors import Executor, RunSettings, check_executor, open_executor
from oodd_eval.scoring.observers import Observers
from oodd_eval.scoring.plan import Plan, Unit
from oodd_eval.scoring.unit import COSTS, Scored, UnitJob


@dataclass(frozen=True, slots=True)
class RunOutcome:
    """Records of the finished units in the order of the plan, and the number of units left.

    Units are left after an interrupt (Ctrl-C), a failure with `stop_on_failure`, or a deadline.
    """

    records: list[Record]
    interrupted: bool = False
    left: int = 0


def run(
    plan: Plan,
    split: Split,
    plugins: Plugins,
    settings: RunSettings,
    results: ResultsDirectory | None = None,
    observers: Sequence[object] = (),
) -> RunOutcome:
    """Fit and score every unit of a plan, which was made for the split.

    Scores and records are kept in `results`, from which a later run resumes; None keeps nothing.
    `observers` are objects of the program that hear of the progress, beside those that a plug-in
    offers. A failing detector is a record with another status than ``"ok"``. An executor or a
    results directory that cannot be used raises before any work; missing or damaged data raises
    `SplitError`, and what was finished is kept.
    """
    check_executor(settings.executor)
    if settings.streamed and any(unit.local for unit in plan.units):
        raise UsageError("rows are streamed to detectors of plug-ins only: name one")
    if results:
        results.prepare()
        results.note_split(split)
    executor = open_executor(settings, split, results)
    writer = RecordWriter(results)
    notify = Observers(plugins, observers).notify
    interrupted, done = False, 0
    opened = ExitStack()
    try:
        data = opened.enter_context(split.opened())
        order = sorted(range(len(plan.units)), key=lambda i: _turn(plan, plan.units[i], plugins))
        jobs = [
            UnitJob(
                plan,
                # Scores that are streamed may differ in the last digits: they are kept apart.
                replace(unit, scores_key=f"{unit.scores_key}-rows") if settings.streamed else unit,
                data(unit.environment),
                plugins.offer(unit.setting.detector),
                settings.streamed,
                settings.launcher,
            )
            for unit in map(plan.units.__getitem__, order)
        ]
        notify("oodd_run_started", plan=plan)
        origin = gather(settings.command)

        def progressed(job: int, share: float) -> None:
            notify("oodd_fit_progressed", unit=plan.units[order[job]], share=share)

        waiting = _as_they_finish(jobs, executor, settings, results, progressed)
        with closing(waiting) as finished:
            for job, scored in finished:
                if scored is None:
                    notify("oodd_unit_started", unit=plan.units[order[job]])
                    continue
                done += 1
                records = _records(jobs[job], scored, origin, settings)
                writer.add(order[job], records)
                for record in records:
                    notify("oodd_cell_finished", record=record, resumed=scored.resumed)
                if settings.stop_on_failure and scored.status != "ok":
                    break
    except KeyboardInterrupt:
        interrupted = True
    finally:
        executor.close()
        opened.close()
        writer.write()
    records = writer.records
    notify("oodd_run_finished", plan=plan, records=records, interrupted=interrupted)
    return RunOutcome(records, interrupted, len(plan.units) - done)


def _turn(plan: Plan, unit: Unit, plugins: Plugins) -> tuple[bool, bool, float]:
    """Return by which units are sorted: long ones first, that all threads end together."""
    spec = plugins.offer(unit.setting.detector).spec
    # Detectors that need further libraries train networks and forests.
    seconds = spec.seconds or 10.0 * bool(spec.requires)
    # What runs in this thread keeps others from being begun. Figures of quick ones of the first
    # environment can be seen early.
    return unit.local, seconds > 0 or unit.environment != plan.units[0].environment, -seconds


def _as_they_finish(
    jobs: Sequence[UnitJob],
    executor: Executor,
    settings: RunSettings,
    results: ResultsDirectory | None,
    progressed: Callable[[int, float], None],
) -> Generator[tuple[int, Scored | None], None, None]:
    """Yield places of jobs, with None as they begin, and with their scores as they finish."""
    # In between `progressed` is called with places and shares of their fits, in this thread, too.
    # Only a few more units are begun than are taken, so that few scores are in memory.
    end = math.inf if settings.deadline is None else time.monotonic() + settings.deadline
    # With twice as many, no thread is idle while records are made. What waits in the pool begins
    # later, however, which a deadline forbids.
    most = executor.jobs * (2 if end == math.inf else 1)
    waiting = _in_dependence(jobs, executor, settings, results)
    waiting.prepare()
    ready: list[int] = []
    events: SimpleQueue[int | tuple[int, float] | Future[tuple[int, Scored]]] = SimpleQueue()
    running = 0

    def score(index: int, progress: Progress) -> Scored:
        job = jobs[index]
        scored = executor(job, progress)
        if results:
            if scored.status == "ok" and not scored.resumed:
                conditions, limit = job.unit.conditions, job.plan.limit
                scored.file = with_stream(scored.file, job.data, conditions, limit, job.unit.alarm)
                results.write_scores(job.unit.scores_key, scored.file)
            if scored.log:
                write_text(results.log_path(job.unit.scores_key), scored.log)
        return scored

    def begin(index: int) -> tuple[int, Scored]:
        events.put(index)
        return index, score(index, lambda share: events.put((index, share)))

    pool = ThreadPoolExecutor(max_workers=executor.jobs)
    try:
        while waiting.is_active():
            ready = sorted([*ready, *waiting.get_ready()])
            while ready and running < most and time.monotonic() < end:
                index = ready.pop(0)
                if jobs[index].unit.local:
                    yield index, None
                    # In this thread, where it can be interrupted.
                    yield index, score(index, partial(progressed, index))
                    waiting.done(index)
                    ready = sorted([*ready, *waiting.get_ready()])
                else:
                    pool.submit(begin, index).add_done_callback(events.put)
                    running += 1
            if not running:
                return
            event = events.get()
            if isinstance(event, int):
                yield event, None
                continue
            if isinstance(event, tuple):
                progressed(*event)
                continue
            running -= 1
            index, scored = event.result()
            waiting.done(index)
            yield index, scored
    finally:
        executor.stop()
        pool.shutdown(wait=True, cancel_futures=True)


def _in_dependence(
    jobs: Sequence[UnitJob],
    executor: Executor,
    settings: RunSettings,
    results: ResultsDirectory | None,
) -> TopologicalSorter[int]:
    """Return the places of all jobs, those that share a fit behind the first, which makes it."""
    graph: TopologicalSorter[int] = TopologicalSorter()
    makers: dict[str, int] = {}
    for index, job in enumerate(jobs):
        graph.add(index)
        if not (executor.keeps_fits and results and (key := job.unit.fit_key)):
            continue
        kept = results.fits.has(key, fresh=settings.fresh)
        if not kept and (maker := makers.setdefault(key, index)) != index:
            graph.add(index, maker)
    return graph


def _records(
    job: UnitJob, scored: Scored, origin: dict[str, object], settings: RunSettings
) -> list[Record]:
    """Return the records of a unit's cells, in the order of its conditions."""
    plan, unit, cost = job.plan, job.unit, scored.file.cost
    # A whole number, also when it was read back from a file of floats.
    steps = int(cost["steps_scored"]) if "steps_scored" in cost else None
    device = {name: v for name, v in unit.parameters.items() if name not in unit.recorded}
    outcome: dict[str, Any] = {
        "status": scored.status,
        "reason": scored.reason,
        "steps_scored": steps,
        "paired": job.data.paired,
        "provenance": origin | device | ({"logs": [*job.data.ledger]} if job.data.ledger else {}),
        **{name: cost[name] for name in COSTS if name in cost},
    }
    records = [
        plan.blank(unit, c, counts=counts_of(job.data, c, plan.limit), **outcome)
        for c in unit.conditions
    ]
    if scored.status != "ok":
        return records
    return evaluated(
        records, scored.file, job.data, row_metrics=settings.row_metrics, streamed=settings.streamed
    )
