"""Reasons to trust or doubt promises on a split, before a run and by the scores of one."""

from collections.abc import Iterable, Iterator
from contextlib import suppress

import numpy as np

from oodd_eval.data.parts import CALIBRATION, lengths_of
from oodd_eval.data.split import Split
from oodd_eval.metrics.promise import PromiseFinding, achieved_share
from oodd_eval.plugins.voices import VoiceCosts
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.record import Record
from oodd_eval.scoring.plan import Plan
from oodd_eval.scoring.promises import in_recorded_order, promises_of


def doubts_before(plan: Plan, split: Split) -> Iterator[tuple[str, PromiseFinding]]:
    """Yield environments of a plan with what no detector is needed to find out.

    Parameters
    ----------
    plan, split
        The plan, and the split that it was made for.

    Yields
    ------
    tuple
        Name of an environment, and something that puts promises in doubt.
    """
    with split.opened() as opened:
        for name in dict.fromkeys(unit.environment for unit in plan.units):
            kinds = {unit.alarm for unit in plan.units if unit.environment == name} - {"flag"}
            for finding in promises_of(opened(name), sorted(kinds), plan.limit) if kinds else ():
                if finding.doubt:
                    yield name, finding


def doubts_after(
    plan: Plan, split: Split, results: ResultsDirectory
) -> Iterator[tuple[str, PromiseFinding]]:
    """Yield detectors whose later calibration episodes alarm more than the earlier ones promise.

    A recorded score that is an alarm already is named, too.

    Parameters
    ----------
    plan, split, results
        The plan, the split that it was made for, and where the scores are.

    Yields
    ------
    tuple
        Name of an environment, and the share that was achieved there, or the alarm.
    """
    with split.opened() as opened:
        for unit in plan.units:
            data = opened(unit.environment)
            in_order = in_recorded_order(data)
            if unit.alarm == "flag" or not (in_order or unit.alarm == "column"):
                continue
            lengths = lengths_of({CALIBRATION: data.calibration}, plan.limit)
            scores = results.scores(unit.scores_key, lengths)
            if scores is None:
                continue
            label = unit.setting.label(unit.seed)
            calibration, recordings = scores.parts[CALIBRATION], data.recordings(CALIBRATION)
            if unit.alarm == "column" and {*np.concatenate(calibration).tolist()} <= {0.0, 1.0}:
                text = f"{label} is 0 or 1, as an alarm is: flag:{unit.columns[0]} judges it as one"
                yield unit.environment, PromiseFinding("achieved", text, doubt=True)
            if not in_order:
                continue
            recordings = recordings and recordings[: len(calibration)]
            finding = achieved_share(calibration, unit.alarm, label, recordings)
            if finding is not None and finding.doubt:
                yield unit.environment, finding


def costly_voices(records: Iterable[Record], results: ResultsDirectory) -> Iterator[str]:
    """Yield a sentence on each fit of which one voice costs the alarm more than a little.

    Parameters
    ----------
    records, results
        Records of the fits, and where the scores are.

    Yields
    ------
    str
        It begins with the environment and the row.
    """
    keys = {r.scores: f"{r.environment}, {r.setting.label(r.seed)}" for r in records if r.ok}
    for key, label in keys.items():
        with suppress(LookupError, TypeError, ValueError, AttributeError):  # anybody's file
            if sentence := str(VoiceCosts.of(results.voices(key))):
                yield f"{label}: {sentence}"
