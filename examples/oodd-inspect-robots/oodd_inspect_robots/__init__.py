"""Scorers for inspect-robots that judge a trial with a watchdog, and a sink that records trials.

The sink writes trials as rows that `oodd-eval data import` and `oodd-eval calibrate` read. The
scorers feed a watchdog that was fitted on nominal trials the same rows, one after the other.
"""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from inspect_robots.errors import ConfigError
from inspect_robots.log import EvalSpec
from inspect_robots.logging import NullSink
from inspect_robots.rollout import TrialRecord
from inspect_robots.scene import Target
from inspect_robots.scorer import Score, is_affirmative_verdict
from oodd_live import Reading, Watchdog


def _numbers(values: Mapping[str, object], prefix: str = "") -> dict[str, float]:
    """Return the numbers among some values; those of an array as NAME_0, NAME_1 and so on."""
    found = {}
    for name, value in values.items():
        array = np.asarray(value)
        if array.dtype.kind in "iuf":  # neither flags nor texts
            for index, number in zip(np.ndindex(array.shape), array.flat, strict=True):
                found["_".join([f"{prefix}{name}", *map(str, index)])] = float(number)
    return found


def rows(record: TrialRecord) -> list[dict[str, float]]:
    """Return a trial as rows: what was observed, and the command that followed; the last has none.

    Readings are called ``obs:NAME``, commands ``action:NAME``. Numbers in ``Action.meta`` stand in
    the row of the command, those in ``StepResult.info`` in the row of the result.
    """
    if not record.steps:
        return []
    table = [_numbers(record.steps[0].observation.state, "obs:")]
    for step in record.steps:
        command = {str(i): value for i, value in enumerate(np.ravel(step.action.data))}
        table[-1] |= _numbers(command, "action:") | _numbers(step.action.meta)
        table.append(_numbers(step.result.observation.state, "obs:") | _numbers(step.result.info))
    return table


class TrialFile(NullSink):
    """A sink that adds each completed trial to a file, as a line of JSON with fields and rows."""

    def __init__(self, path: str | Path = "trials.jsonl") -> None:
        self.path, self.task = Path(path), ""

    def on_eval_start(self, spec: EvalSpec) -> None:
        """Remember the name of the task."""
        self.task = spec.task

    def on_trial_end(self, record: TrialRecord) -> None:
        """Write the trial, unless it was broken off."""
        if record.status == "success" and record.steps:
            judged = is_affirmative_verdict(record.operator_judgement)
            trial = {"task": self.task, "scene": record.scene_id, "epoch": record.epoch}
            trial["success"] = judged or record.termination_reason == "success"
            with self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps({**trial, "steps": rows(record)}) + "\n")


@dataclass(frozen=True, eq=False)
class AlarmScorer:
    """Whether a watchdog alarms in a trial; the mean over trials is the share with an alarm.

    With `column` the watchdog judges that recorded number, otherwise the sensors that it knows.
    """

    watchdog: Watchdog
    column: str = ""
    name = "oodd_alarm"

    def __call__(self, record: TrialRecord, target: Target | None) -> Score:
        """Score a trial; the explanation has the first alarm and the promise."""
        table = rows(record)
        first, promise = self._first_alarm(table), self.watchdog.promise
        row = len(table) if first is None else first.t
        facts = {"first_alarm": None if first is None else row, "promise": promise}
        explanation = f"{first or f'{row} rows: no alarm'} (promise: {promise})"
        return Score(self._value(row, alarmed=first is not None), explanation, facts)

    def _value(self, row: int, *, alarmed: bool) -> float:
        return float(alarmed)

    def _first_alarm(self, table: list[dict[str, float]]) -> Reading | None:
        watchdog, action = self.watchdog.copy(), None
        for row in table:
            if self.column:
                reading = watchdog.update(row.get(self.column, np.nan))
            else:
                sensors = {name: row.get(f"obs:{name}", np.nan) for name in watchdog.sensors}
                reading = watchdog.update(sensors, action)
                action = [value for name, value in row.items() if name.startswith("action:")]
            if reading.alarm:
                return reading
        return None


class QuietRowsScorer(AlarmScorer):
    """Rows before the first alarm of a trial; all of its rows where there is none."""

    name = "oodd_quiet_rows"

    def _value(self, row: int, *, alarmed: bool) -> float:
        return row


def alarm(watchdog: str | Path | Watchdog = "", column: str = "") -> AlarmScorer:
    """Return the scorer of a watchdog or its file; without one, of those that the shell names."""
    return AlarmScorer(*_chosen(watchdog, column))


def quiet_rows(watchdog: str | Path | Watchdog = "", column: str = "") -> QuietRowsScorer:
    """Return the scorer of the rows before an alarm, of the same watchdog as `alarm`."""
    return QuietRowsScorer(*_chosen(watchdog, column))


def _chosen(watchdog: str | Path | Watchdog, column: str) -> tuple[Watchdog, str]:
    if not (watchdog := watchdog or os.environ.get("OODD_WATCHDOG", "")):
        raise ConfigError("no watchdog: set OODD_WATCHDOG to a file that Watchdog.save wrote")
    loaded = watchdog if isinstance(watchdog, Watchdog) else Watchdog.load(watchdog)
    return loaded, column or os.environ.get("OODD_COLUMN", "")
