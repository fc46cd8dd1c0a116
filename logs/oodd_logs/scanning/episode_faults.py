"""Faults of the stream in recorded episodes: missing, frozen, out of range, gaps.

They are scaled on all episodes, so that up to a fifth of them may have the same fault.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.baseline import Baseline
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.metrics.faults import FAR, StreamLimits, StreamScale, readings
from oodd_logs.episodes import Episode
from oodd_logs.ledger import Ledger
from oodd_logs.scanning.limits import SHORTEST
from oodd_logs.scanning.outliers import ODD_SHARE

Floats = NDArray[np.float64]

_END_ROWS: Final = 3  # at the end without a reading that are the logger's end
_END_SHARE: Final = 0.02  # of an episode that is, too
_STEPS: Final = 3.0  # usual steps that a gap is longer than, at least


@dataclass(frozen=True, slots=True)
class EpisodeFault:
    """A fault of the stream in one episode.

    Attributes
    ----------
    what
        A sensor, ``"observation"`` for all at once, ``"action"`` or ``"time"``.
    fault
        ``"missing"``, ``"broken"`` (a number that is no measurement), ``"frozen"``,
        ``"saturated"``, ``"out of range"``, ``"repeated"`` or ``"gap"``. A gap makes no episode
        odd, and a sensor that stays at an end of its range does not by itself.
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
    """An episode for detectors, and its readings minus an offset, NaN where there is none.

    Rows as they were recorded, and where a number in them is broken, stand beside.
    """

    trajectory: Trajectory
    observations: NDArray[np.float32]
    offset: Floats
    recorded: Floats
    broken: NDArray[np.bool_]

    def rows(self, judged: NDArray[Any] | None) -> Floats:
        """Return the rows in units of the logs, as they are judged, and broken numbers."""
        if judged is None:
            return self.recorded
        return np.where(self.broken, self.recorded, judged + self.offset)

    def faults(self, names: Sequence[str]) -> list[EpisodeFault]:
        """Return the first broken number of each sensor."""
        first = self.broken.argmax(axis=0)
        columns = np.flatnonzero(self.broken.any(axis=0)).tolist()
        return [EpisodeFault(names[d], "broken", int(first[d])) for d in columns]

    def account(self, ledger: Ledger, source: str, names: Sequence[str]) -> None:
        """Say which numbers are broken, and are held for detectors."""
        for fault, count in zip(
            self.faults(names), filter(None, self.broken.sum(axis=0)), strict=True
        ):
            value = self.recorded[fault.row, names.index(fault.what)]
            reason = "a broken number, beyond a million deviations"
            where: dict[str, Any] = {"name": fault.what, "source": source, "row": fault.row}
            ledger.add("cell", "held", reason, count=int(count), cell=f"{value:g}", **where)


def clean(episodes: Sequence[Episode]) -> list[CleanedEpisode]:
    """Return episodes without offsets that float32 cannot tell from, what is no reading held."""
    # Medians, so that no broken number spoils them.
    offset, spread = _usual([episode.observations for episode in episodes])
    _, commanded = _usual([episode.actions for episode in episodes])
    cleaned = []
    for episode in episodes:
        rows = episode.observations - offset
        held = _held(rows, spread), _held(episode.actions, commanded)
        good = _is_good(rows, spread)
        broken = ~good & ~np.isnan(rows)
        # Where the logger ended, readings before run back: neither missing nor frozen ones.
        ended = _is_end(rows)
        last = len(rows) - 1 - ended.sum(axis=0)
        back = np.clip(2 * last - np.arange(len(rows))[:, None], 0, len(rows) - 1)
        mirrored = np.take_along_axis(held[0], back, axis=0)
        read = np.where(good, held[0], np.where(ended, mirrored, np.nan)).astype(np.float32)
        recorded = episode.observations
        cleaned.append(
            CleanedEpisode(
                Trajectory(*(x.astype(np.float32) for x in held)), read, offset, recorded, broken
            )
        )
    return cleaned


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


def _is_good(rows: Floats, spread: Floats) -> NDArray[np.bool_]:
    """Return which values are readings: numbers, and no broken ones."""
    with np.errstate(invalid="ignore"):
        near = np.abs(rows) < np.minimum(FAR * spread, np.finfo(np.float32).max)
    good: NDArray[np.bool_] = np.isfinite(rows) & near
    return good


def _is_end(rows: Floats) -> NDArray[np.bool_]:
    """Return which cells are empty as the logger ended: few rows, and no number behind them."""
    empty = np.isnan(rows)
    run = np.where(empty.all(axis=0), 0, empty[::-1].argmin(axis=0))
    few = run <= max(_END_ROWS, _END_SHARE * len(rows))
    ended: NDArray[np.bool_] = (np.arange(len(rows), 0, -1)[:, None] <= run) & few
    return ended


def _held(rows: Floats, spread: Floats) -> Floats:
    """Return rows with the last reading in place of what is none, the next one at the beginning."""
    good = _is_good(rows, spread)
    if good.all():
        return rows
    last = np.maximum.accumulate(np.where(good, np.arange(len(rows))[:, None], -1), axis=0)
    first = np.where(good.any(axis=0), good.argmax(axis=0), 0)
    held = np.take_along_axis(rows, np.where(last < 0, first, last), axis=0)
    return np.where(good.any(axis=0), held, 0.0)


def stream_scale(
    cleaned: Sequence[CleanedEpisode], baseline: int = 0
) -> tuple[StreamScale, list[tuple[NDArray[Any], NDArray[Any] | None]]]:
    """Return scales of the faults of the stream from all episodes, up to a fifth of them odd.

    Parameters
    ----------
    cleaned
        The episodes.
    baseline
        Number of rows at the start of each that it is compared with.

    Returns
    -------
    scale : StreamScale
    readings : list of tuple
        Of each episode, and what is judged of them, as `StreamScale.surprise` takes them.
    """
    trajectories = [episode.trajectory for episode in cleaned]
    base = Baseline.fit(trajectories, baseline) if baseline else None
    seen = [(x.observations, readings(x.trajectory, base)[1]) for x in cleaned]
    judged = [rows if judged is None else judged for rows, judged in seen]
    limits = StreamLimits.fit([rows for rows, _ in seen], judged, ODD_SHARE)
    return StreamScale.fit(limits, seen, ODD_SHARE), seen


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
