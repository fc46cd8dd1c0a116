"""Reasons to trust or doubt promises on a split, before a run and by the scores of one."""

from collections.abc import Iterator, Sequence
from itertools import islice

from oodd_eval.data.baseline import Baseline, episode_means
from oodd_eval.data.parts import CALIBRATION, EnvironmentData, lengths_of
from oodd_eval.data.split import Split
from oodd_eval.metrics.accumulation import AlarmKind
from oodd_eval.metrics.alarms import USUAL
from oodd_eval.metrics.promise import (
    EpisodeMeans,
    PromiseFinding,
    achieved_share,
    enough_episodes,
    promises,
)
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.scoring.plan import Plan


def promises_of(
    data: EnvironmentData, kinds: Sequence[AlarmKind] = USUAL, limit: int | None = None
) -> list[PromiseFinding]:
    """Return what speaks for and against promises that rest on an environment of a split.

    Episodes that were recorded by a simulator are exchangeable by construction: of them only the
    number counts.

    Parameters
    ----------
    data
        The environment.
    kinds
        Statistics that are to be thresholds of.
    limit
        Number of episodes of each part that are used; None for all.

    Returns
    -------
    list of PromiseFinding
    """
    if data.logs is None:
        return [enough_episodes(len(data.calibration.lengths[:limit]), kinds)]
    rows = data.baseline
    base = Baseline.fit(islice(data.train, limit), rows) if rows else None
    parts = (islice(part, limit) for part in (data.train, data.calibration, data.twins))
    train, calibration, nominal = (EpisodeMeans(*episode_means(part, base)) for part in parts)
    return promises(
        train,
        calibration,
        nominal,
        sensors=[quantity.name for quantity in data.sensors],
        recorded=_in_recorded_order(data),
        kinds=kinds,
    )


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
            kinds = sorted({unit.alarm for unit in plan.units if unit.environment == name})
            for finding in promises_of(opened(name), kinds, plan.limit):
                if finding.doubt:
                    yield name, finding


def doubts_after(
    plan: Plan, split: Split, results: ResultsDirectory
) -> Iterator[tuple[str, PromiseFinding]]:
    """Yield detectors whose later calibration episodes alarm more than the earlier ones promise.

    Parameters
    ----------
    plan, split, results
        The plan, the split that it was made for, and where the scores are.

    Yields
    ------
    tuple
        Name of an environment, and the share that was achieved there.
    """
    with split.opened() as opened:
        for unit in plan.units:
            data = opened(unit.environment)
            if not _in_recorded_order(data):
                continue
            lengths = lengths_of({CALIBRATION: data.calibration}, plan.limit)
            scores = results.scores(unit.scores_key, lengths)
            if scores is None:
                continue
            label = unit.setting.label(unit.seed)
            finding = achieved_share(scores.parts[CALIBRATION], unit.alarm, label)
            if finding is not None and finding.doubt:
                yield unit.environment, finding


def _in_recorded_order(data: EnvironmentData) -> bool:
    return data.logs is not None and data.logs.order == "recorded"
