"""Faults of the stream in recorded episodes: missing, frozen, out of range, gaps.

Limits are what the other episodes do, so that up to a fifth of them may have the same fault.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from numpy.typing import NDArray
from oodd_live.stream import FAR, Stream, StreamLimits

from oodd_eval.data.trajectory import Trajectory
from oodd_logs.episodes import Episode
from oodd_logs.scanning.limits import SHORTEST
from oodd_logs.scanning.outliers import ODD_SHARE, Tail

Floats = NDArray[np.float64]

_RUN: Final = 4.0  # half of a run, in rows, that no sensor is called frozen for
_STEPS: Final = 3.0  # usual steps that a gap is longer than, at least


@dataclass(frozen=True, slots=True)
class EpisodeFault:
    """A fault of the stream in one episode.

    Attributes
    ----------
    what
        A sensor, ``"observation"`` for all at once, ``"action"`` or ``"time"``.
    fault
        ``"missing"``, ``"frozen"``, ``"out of range"``, ``"repeated"`` or ``"gap"``.
    row
        The row with which it began or, for a gap, the first one after it.
    """

    what: str
    fault: str
    row: int

    def __str__(self) -> str:
        """Return it in words."""
        return f"{self.what} {self.fault} at row {self.row}"


@dataclass(frozen=True, slots=True, eq=False)
class CleanedEpisode:
    """An episode for detectors, with what came: float64 rows minus the sensors' usual values."""

    trajectory: Trajectory
    observations: Floats


def clean(episodes: Sequence[Episode]) -> tuple[list[CleanedEpisode], Floats]:
    """Return episodes without an offset that float32 cannot tell from, and what is no reading held.

    The second value is the usual deviation of each sensor, (D,).
    """
    # Medians, so that no broken number spoils them.
    offset, spread = _usual([episode.observations for episode in episodes])
    _, commanded = _usual([episode.actions for episode in episodes])
    cleaned = []
    for episode in episodes:
        rows = episode.observations - offset
        held = _held(rows, spread), _held(episode.actions, commanded)
        cleaned.append(CleanedEpisode(Trajectory(*held), rows))
    return cleaned, spread


def _usual(parts: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Return median and robust deviation of each column, 0 and infinite where there is none."""
    rows = np.concatenate(parts)
    centre, spread = np.zeros(rows.shape[1]), np.full(rows.shape[1], np.inf)
    for d in range(rows.shape[1]):
        values = rows[np.isfinite(rows[:, d]), d]
        if len(values):
            centre[d] = np.median(values)
            low, high = np.quantile(values, [0.05, 0.95])
            spread[d] = (high - low) / 2 or np.inf
    return centre, spread


def _held(rows: Floats, spread: Floats) -> Floats:
    """Return rows with the last reading in place of what is none, the next one at the beginning."""
    with np.errstate(invalid="ignore"):
        good = np.isfinite(rows) & (
            np.abs(rows) < np.minimum(FAR * spread, np.finfo(np.float32).max)
        )
    if good.all():
        return rows
    last = np.maximum.accumulate(np.where(good, np.arange(len(rows))[:, None], -1), axis=0)
    first = np.where(good.any(axis=0), good.argmax(axis=0), 0)
    held = np.take_along_axis(rows, np.where(last < 0, first, last), axis=0)
    return np.where(good.any(axis=0), held, 0.0)


def stream_faults(
    episodes: Sequence[Episode],
    cleaned: Sequence[CleanedEpisode],
    spread: Floats,
    names: Sequence[str],
    fdr: float,
) -> list[tuple[EpisodeFault, ...]]:
    """Return the faults of each episode, by limits from the others."""
    each = [StreamLimits.fit([episode.trajectory]) for episode in cleaned]
    columns = {
        f.name: np.stack([getattr(limits, f.name) for limits in each]) for f in fields(each[0])
    }
    breaks = breaks_of(episodes)
    faults = []
    for i, (episode, rows) in enumerate(zip(episodes, cleaned, strict=True)):
        other_limits = {name: np.delete(column, i, axis=0) for name, column in columns.items()}
        p = fdr / len(episodes) / len(names)
        limits = _common(other_limits, spread, p)
        seen = _in_rows(rows.observations, episode.actions, Stream(limits), names)
        usual = _most(np.delete(breaks, i)[:, None], p)[0]
        faults.append((*seen, *gaps(episode.time, float(breaks[i]), usual)))
    return faults


def _common(other_limits: Mapping[str, Floats], spread: Floats, p: float) -> StreamLimits:
    """Return limits of the stream from those of single other episodes."""
    # The range ends as far beyond that of all others as it is wide: what moves from day to day is
    # for the p-value to judge.
    low, high = other_limits["low"].min(axis=0), other_limits["high"].max(axis=0)
    with np.errstate(invalid="ignore"):
        width = np.where(np.isfinite(low) & np.isfinite(high), high - low, np.inf)
    return StreamLimits(
        np.median(other_limits["mean"], axis=0),
        np.where(np.isfinite(spread), spread, 1.0),
        low - width,
        high + width,
        np.maximum(_most(other_limits["still"], p), _RUN),
        np.maximum(_most(other_limits["repeated"][:, None], p)[0], _RUN),
        np.median(other_limits["rest"], axis=0),
    )


def _most(longest: Floats, p: float) -> Floats:
    """Return half of what other episodes' longest runs, (n, columns), would allow."""
    # That is the longest of all but the oddest fifth of them, or more where runs vary: half of the
    # length that has so small a p-value, as the stream allows twice the limit.
    usual = np.quantile(longest, 1 - ODD_SHARE, axis=0, method="nearest")
    tails = map(Tail.fit, longest.T)
    # Where all but a few are alike, the few tell nothing of what is usual.
    varying = [t.threshold(p) / 2 if t and len(t.estimates) > 1 else 0.0 for t in tails]
    return np.maximum(usual, varying)


def _in_rows(
    rows: Floats, actions: Floats, stream: Stream, names: Sequence[str]
) -> list[EpisodeFault]:
    faults: dict[tuple[str, str], int] = {}
    for t in stream.through(rows, actions):
        for key, fault in stream.faults.items():
            what, since = (key, t) if isinstance(key, str) else (names[key], stream.suspects[key])
            faults.setdefault((what, fault), since)
    return [EpisodeFault(*key, row) for key, row in faults.items()]


def breaks_of(episodes: Sequence[Episode]) -> Floats:
    """Return the longest time without a row of each episode, in usual steps.

    Pieces of one recording follow one another: the time since the piece before counts, too.
    """
    longest = np.ones(len(episodes))
    before: tuple[str, float] | None = None  # source, and its last time
    for i, episode in enumerate(episodes):
        if episode.time is None or len(episode.time) < SHORTEST:
            continue
        steps = np.diff(episode.time)
        usual, pause = float(np.nanmedian(steps)), 0.0
        if before is not None and before[0] == episode.source:
            pause = float(episode.time[0]) - before[1]
        if usual > 0:
            longest[i] = max(float(np.nanmax(steps)), pause) / usual
        before = episode.source, float(episode.time[-1])
    return longest


def gaps(time: Floats | None, longest: float, usual: float = 1.0) -> list[EpisodeFault]:
    """Return a gap of more than three steps and twice what is usual, both in steps."""
    if time is None or longest <= max(_STEPS, 2 * usual):
        return []
    steps = np.diff(time)
    within = np.nanmax(steps) >= longest * np.nanmedian(steps)
    return [EpisodeFault("time", "gap", int(np.nanargmax(steps)) + 1 if within else 0)]
