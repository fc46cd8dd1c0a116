"""Findings on which promises of false alarms on a split rest, before any detector is fitted."""

from collections.abc import Sequence
from itertools import islice

from oodd_eval.data.baseline import Baseline, episode_means
from oodd_eval.data.parts import EnvironmentData
from oodd_eval.metrics.alarms import STATISTICS, AlarmKind
from oodd_eval.metrics.promise import EpisodeMeans, PromiseFinding, enough_episodes, promises


def promises_of(
    data: EnvironmentData, kinds: Sequence[AlarmKind] = STATISTICS, limit: int | None = None
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
    parts = []
    for part in (data.train, data.calibration, data.twins):
        recordings = data.recordings(part.group)
        means = episode_means(islice(part, limit), base)
        parts.append(EpisodeMeans(*means, recordings and recordings[:limit]))
    return promises(
        *parts,
        sensors=[quantity.name for quantity in data.sensors],
        recorded=in_recorded_order(data),
        kinds=kinds,
    )


def in_recorded_order(data: EnvironmentData) -> bool:
    """Tell whether the episodes of an environment are logs in the order of their recording."""
    return data.logs is not None and data.logs.order == "recorded"
