"""Episodes of logs that a saved watchdog judges."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from oodd_live.watchdog import Watchdog

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import UnknownNameError
from oodd_eval.plugins.explanations import Explanation
from oodd_logs.episodes import Episode
from oodd_logs.scanning.episode_faults import EpisodeFault, breaks_of, clean, gaps
from oodd_logs.scanning.evidence import EpisodeEvidence


def watched(
    watchdog: Watchdog, episodes: Sequence[Episode], names: Sequence[str]
) -> list[EpisodeEvidence]:
    """Let a watchdog judge all episodes, row by row as beside a robot.

    Parameters
    ----------
    watchdog
        Which finds its sensors by name.
    episodes
        With the sensors `names`.
    names
        Of the sensors.

    Returns
    -------
    list of EpisodeEvidence
    """
    unknown = [name for name in watchdog.sensors if name not in names]
    if unknown:
        raise UnknownNameError("sensor of the logs", unknown[0], names)
    order = [names.index(name) for name in watchdog.sensors]
    episodes = [
        replace(episode, observations=episode.observations[:, order]) for episode in episodes
    ]
    return [
        _watched(watchdog.copy(), episode, float(longest), cleaned.trajectory)
        for episode, longest, cleaned in zip(
            episodes, breaks_of(episodes), clean(episodes), strict=True
        )
    ]


def _watched(
    watchdog: Watchdog, episode: Episode, longest: float, trajectory: Trajectory
) -> EpisodeEvidence:
    rows, sensors = episode.observations.shape
    scores, statistic = np.full((2, rows), np.nan)
    shares, onsets = np.full((rows, sensors), np.nan), np.full(rows, -1)
    faults: dict[tuple[str, str], int] = {}
    actions = [None, *episode.actions] if episode.actions.shape[1] else [None] * rows
    times = [None] * rows
    if episode.time is not None and watchdog.settings.rate is not None:
        times = episode.time.tolist()
    for t, (row, action) in enumerate(zip(episode.observations, actions, strict=True)):
        reading = watchdog.update(row, action, times[t])
        scores[t], statistic[t] = reading.score, reading.statistic
        if reading.onset is not None:
            onsets[t] = reading.onset
            shares[t] = [reading.sensors.get(name, 0.0) for name in watchdog.sensors]
        for key in reading.faults.items():
            faults.setdefault(key, t)
    seen = *(EpisodeFault(*key, t) for key, t in faults.items()), *gaps(episode.time, longest)
    return EpisodeEvidence(
        episode, scores, statistic, Explanation(shares, onsets), seen, trajectory
    )
