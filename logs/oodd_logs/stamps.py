"""Time stamps of recordings: checked, cut at gaps, laid on an even grid."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.errors import TrajectoryError, UsageError

GAP_STEPS: Final = 20
"""A gap is a step of more than so many usual ones, unless a recipe says how many seconds."""

_TOLERANCE: Final = 1e-3  # share of a step by which a stamp may miss the grid
_MOST_ROWS: Final = 100  # rows of the grid for one row that was logged
_UNEVEN: Final = 0.1  # share of a step by which steps of an even recording may differ

Times = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Stretch:
    """Rows between two gaps, and for each topic the row that holds at each of them.

    Parameters
    ----------
    rows
        Number of rows.
    sources
        Numbers of the rows of each topic, int64 of shape (rows,).
    positions
        What anomalous rows are looked up in: seconds, or numbers of rows without stamps.
    tolerance
        By how much a position may be behind.
    """

    rows: int
    sources: Mapping[str, NDArray[np.int64]]
    positions: NDArray[Any]
    tolerance: float = 0.0

    def begin_and_step(self, start: int, stop: int) -> tuple[float, float]:
        """Return time of the first row and seconds between rows, NaN without stamps."""
        if self.positions.dtype.kind != "f":
            return float("nan"), float("nan")
        times = self.positions[start:stop]
        return float(times[0]), float((times[-1] - times[0]) / max(1, len(times) - 1))


@dataclass(frozen=True, slots=True)
class Steps:
    """Times between neighbouring rows.

    Parameters
    ----------
    usual
        Median of those above zero, 0 without any.
    shortest, longest
        Of those above zero.
    after
        Row before the longest step.
    gaps
        Number of steps of more than `GAP_STEPS` usual ones.
    falls, repeats
        Number of rows that are earlier than the row before, and of those at the same time.
    """

    usual: float
    shortest: float
    longest: float
    after: int
    gaps: int
    falls: int
    repeats: int

    @classmethod
    def of(cls, times: Times, rows: NDArray[np.int64] | None = None) -> "Steps":
        """Measure them.

        Parameters
        ----------
        times
            Stamps in any unit, none missing.
        rows
            Numbers of the rows; only steps between neighbouring ones count. By default all do.
        """
        numbers = np.arange(len(times)) if rows is None else rows
        neighbours = np.diff(numbers) == 1
        steps, before = np.diff(times)[neighbours], numbers[:-1][neighbours]
        rising = steps[steps > 0]
        usual = float(np.median(rising)) if len(rising) else 0.0
        return cls(
            usual,
            float(rising.min(initial=np.inf)),
            float(steps.max(initial=0.0)),
            int(before[steps.argmax()]) if len(steps) else 0,
            int((steps > GAP_STEPS * usual).sum()),
            int((steps < 0).sum()),
            int((steps == 0).sum()),
        )


def check_stamps(times: Times, numbers: NDArray[np.int64], source: str, *, resampled: bool) -> None:
    """Raise `TrajectoryError` when stamps fall, or stay where rows are taken as they are.

    Parameters
    ----------
    times
        Seconds.
    numbers
        Numbers of the rows.
    source
        What messages call the recording.
    resampled
        Whether rows are resampled: then the later of two rows with one stamp holds.
    """
    steps = np.diff(times)
    for i in np.flatnonzero(steps < 0 if resampled else steps <= 0)[:1].tolist():
        problem, advice = "as", "rate resamples them"
        if steps[i] < 0:
            problem, advice = "before", "sort the rows, or cut them there with gap in a recipe"
        raise TrajectoryError(
            f"{source}: row {numbers[i + 1]} is stamped {times[i + 1]:.6f} s, {problem} row "
            f"{numbers[i]} ({times[i]:.6f} s), expected stamps that rise: {advice}"
        )


def set_forward(times: Times, gap: float) -> Times:
    """Return stamps that rise where a clock was set back: rows from there on are two gaps later.

    Parameters
    ----------
    times
        Seconds, NaN where a row has no stamp.
    gap
        Longest step within a stretch.

    Examples
    --------
    >>> set_forward(np.array([0.0, 1.0, 0.5, 1.5]), 3.0)
    array([0., 1., 7., 8.])
    """
    present = np.isfinite(times)
    steps = np.diff(times[present], prepend=times[present][:1])
    if not (steps < 0).any():
        return times
    risen = times.copy()
    risen[present] += np.where(steps < 0, 2 * gap - steps, 0.0).cumsum()
    return risen


def cut_at_gaps(
    stamps: Mapping[str, Times], gap: float | None, rate: float | None, source: str
) -> list[tuple[float, float]]:
    """Return first and last stamp of each stretch without a gap in any topic.

    A topic is silent from its last row before a gap on; of several topics its value holds for as
    long as a gap may last, while others have rows.

    Parameters
    ----------
    stamps
        Seconds of the rows of each topic, in order.
    gap
        Longest step within a stretch; None refuses steps of more than `GAP_STEPS` usual ones of
        the topic, or of the rows that are made where these are slower, 0 cuts there.
    rate
        Rows in a second that are made; None for rows as they are.
    source
        What messages call the recording.

    Raises
    ------
    TrajectoryError
        When there is a gap, and nothing said what to do.
    UsageError
        When `gap` is shorter than the usual step of a topic.
    """
    edges, sides = [], []
    for topic, times in stamps.items():
        of_topic = f" in topic {topic!r}" if len(stamps) > 1 else ""
        steps = Steps.of(times)
        most = gap or GAP_STEPS * max(steps.usual, 1 / rate if rate else 0.0) or np.inf
        if gap is None and steps.longest > most:
            after, usual = times[steps.after] - times[0], f"steps are {steps.usual:g} s"
            raise TrajectoryError(
                f"{source} has a gap of {steps.longest:g} s after {after:g} s{of_topic}, where "
                f"{usual}: in a recipe, gap = {most:g} cuts the recording at longer gaps, and gap "
                f"= {steps.longest * 1.01:.3g} takes it as it is"
            )
        if of_topic and most < steps.usual:
            expected = f"steps{of_topic} are {steps.usual:g} s, expected a gap of more"
            raise UsageError(f"{source}: {expected}, not {most:g} s")
        cuts = np.flatnonzero(np.diff(times) > most)
        following = np.nextafter(np.append(times[cuts + 1], np.inf), -np.inf)
        ends = np.minimum(times[np.append(cuts, len(times) - 1)] + most, following)
        edges += [times[np.append(0, cuts + 1)], ends]
        sides += [np.ones(len(ends)), -np.ones(len(ends))]
    moments, change = np.concatenate(edges), np.concatenate(sides)
    order = np.lexsort((-change, moments))
    moments, speaking = moments[order], change[order].cumsum()
    stretches = []
    for i in np.flatnonzero(speaking == len(stamps)).tolist():
        first, end = moments[i : i + 2]
        lasts = [times[np.searchsorted(times, end, side="right") - 1] for times in stamps.values()]
        stretches.append((float(first), float(max(lasts))))
    return stretches


def on_grid(
    stamps: Mapping[str, Times], first: float, last: float, rate: float, source: str
) -> Stretch:
    """Return an even grid over a stretch: at each time the last row at or before it holds.

    Parameters
    ----------
    stamps
        Seconds by topic, in order.
    first, last
        Of a stretch, at whose beginning every topic has had a row.
    rate
        Rows in a second.
    source
        What messages call the recording.

    Returns
    -------
    Stretch
    """
    count = int((last - first) * rate + _TOLERANCE) + 1
    logged = sum(len(times) for times in stamps.values())
    if count > _MOST_ROWS * max(logged, 10):
        raise TrajectoryError(
            f"{source} lasts {last - first:g} s by its stamps: {count} rows at rate = {rate:g} of "
            f"{logged} that were logged: is their unit right, as in time = 'NAME[ms]'?"
        )
    grid, tolerance = first + np.arange(count) / rate, _TOLERANCE / rate
    edges = grid + tolerance
    sources = {t: np.searchsorted(times, edges, side="right") - 1 for t, times in stamps.items()}
    return Stretch(count, sources, grid, tolerance)


def even_rate(recordings: Sequence[Steps]) -> float | None:
    """Return rows in a second where shortest and longest steps are nearly the usual one."""
    usual = float(np.median([steps.usual for steps in recordings] or [np.nan]))
    extremes = [x for steps in recordings for x in (steps.shortest, steps.longest)]
    even = extremes and all(abs(step - usual) <= _UNEVEN * usual for step in extremes)
    return 1.0 / usual if even else None
