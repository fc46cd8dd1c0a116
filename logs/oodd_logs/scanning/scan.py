"""Find the odd ones among recorded episodes, with their odd rows and sensors.

Each episode is judged by a detector that was fitted on others, and its largest statistic by theirs.
Faults of the stream, such as frozen sensors, count as the statistic that would be as rare.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from fnmatch import fnmatchcase
from multiprocessing import get_context
from typing import Any, Final, Literal, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from oodd_live.handle import DetectorHandle, has_actions
from oodd_live.nominal import sensor_names
from oodd_live.watchdog import Watchdog

from oodd_eval.arrays import as_numbers
from oodd_eval.data.baseline import Baseline
from oodd_eval.data.bounded import without_nan
from oodd_eval.data.facts import roles_of
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import ContractError, OoddError, UnknownNameError, UsageError
from oodd_eval.metrics.alarms import AlarmKind, GuaranteedAlarm, joined, numbered, window_weights
from oodd_eval.metrics.cusum import Standardization
from oodd_eval.metrics.faults import StreamScale
from oodd_eval.names import counted
from oodd_eval.plugins.contract import AnyDetector
from oodd_eval.plugins.explanations import ExplainingDetector, Explanation, checked_explanation
from oodd_logs.episodes import EVERY, Episode
from oodd_logs.frames import scanned_frames
from oodd_logs.ledger import Ledger
from oodd_logs.marks import runs_of
from oodd_logs.scanning.episode_faults import (
    CleanedEpisode,
    EpisodeFault,
    breaks_of,
    clean,
    gaps,
    stream_scale,
)
from oodd_logs.scanning.limits import FITS, SHORTEST, WINDOWS
from oodd_logs.scanning.outliers import (
    ENOUGH,
    LEAST,
    ODD_SHARE,
    Tail,
    critical_p,
    q_values,
    rank_p,
    rank_threshold,
)

Floats = NDArray[np.float64]

Band = Literal["surely", "look at", "fine"]
"""Under the promised rate; among the first of the ranking, or above all fine ones; the rest."""

Progress = Callable[[str, Sequence[str]], None]
"""Takes what is done, in words, and the names of episodes, the oddest first, as far as known."""


@dataclass(frozen=True, slots=True, eq=False)
class ScannedEpisode:
    """Verdict of a scan on one episode.

    Attributes
    ----------
    episode
        As it was recorded.
    scores, statistic
        By row, of shape (R,); NaN and minus infinity where there is none.
    largest
        The largest statistic.
    rank_p
        Its conformal p-value: the rank among the others, ties counted against the episode.
    p, q
        P-value, from the tail beyond the others' median, and Benjamini and Hochberg's q-value; NaN
        where the others are too few.
    threshold
        Of the statistic, which makes an episode odd; NaN where the others are too few.
    odd
        Whether it is odd, by its q-value.
    row, since
        First row with a statistic above the threshold, and the row with which that began as seen
        then; None where the statistic stays below.
    intervals
        Rows [start, stop) with a statistic above the threshold.
    sensors
        Share of each sensor in the evidence at that row, by name, the largest first.
    faults
        Of the stream: those that would make an episode odd, and gaps, which do not.
    band
        Whether it is odd (``"surely"``), or to be looked at.
    place
        In the ranking; 1 is the oddest.
    reason
        What is oddest about it, in a clause.
    """

    episode: Episode
    scores: Floats
    statistic: Floats
    largest: float
    rank_p: float
    p: float
    q: float
    threshold: float
    odd: bool
    row: int | None
    since: int | None
    intervals: tuple[tuple[int, int], ...]
    sensors: Mapping[str, float]
    faults: tuple[EpisodeFault, ...]
    band: Band = "fine"
    place: int = 1
    reason: str = ""

    @property
    def first(self) -> int | None:
        """The first odd row; None where there is none."""
        return self.since

    @property
    def alarms(self) -> NDArray[np.bool_]:
        """True for each odd row, shape (R,): in the intervals."""
        rows = np.zeros(len(self.scores), dtype=np.bool_)
        for start, stop in self.intervals:
            rows[start:stop] = True
        return rows

    @property
    def suspects(self) -> list[str]:
        """Names of sensors with a fault, else of those with most evidence, which come first."""
        faulty = list(dict.fromkeys(f.what for f in self.faults if f.fault != "gap"))
        named = [name for name, share in self.sensors.items() if share >= 1 / len(self.sensors)]
        return faulty or named[:3]

    @property
    def label(self) -> str:
        """Labels of the episode in its logs, by which nothing here is judged."""
        episode = self.episode
        parts = [episode.kind] if episode.kind else []
        parts += [f"{max(start, 0)} to {stop}" for start, stop in episode.intervals]
        parts += ["failure"] if episode.outcome is False and not episode.kind else []
        return ", ".join(parts)

    def as_json(self) -> dict[str, Any]:
        """Return the episode as values for JSON, which docs/how-to/scan.md describes.

        Returns
        -------
        dict
            With None in place of what is undefined or infinite.
        """
        time, first = self.episode.time, self.first
        figures = ("p", "q", "rank_p", "largest", "threshold")
        values = {
            "name": self.episode.name,
            "source": self.episode.source,
            "rows": len(self.scores),
            "odd": self.odd,
            "band": self.band,
            "place": self.place,
            "reason": self.reason,
            **{name: getattr(self, name) for name in figures},
            "first_odd_row": first,
            "first_odd_time": None if time is None or first is None else time[first],
            "alarm_row": self.row,
            "intervals": self.intervals,
            "suspects": self.suspects,
            "sensors": self.sensors,
            "faults": [asdict(fault) for fault in self.faults],
            "label": self.label,
        }
        return cast("dict[str, Any]", without_nan(values))


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """Result of `scan_episodes`.

    Attributes
    ----------
    episodes
        In the order of the recorded ones.
    sensors
        Their names.
    judge
        What the episodes were judged by, in words.
    fdr
        Of the episodes that are odd by their q-value, the largest share that is nominal, as far as
        the tail is as light as assumed.
    notes
        What is to be known about it, a sentence each.
    ledger
        What became of the logs on their way here.
    kinds_mixed
        Whether more than a fifth would be called odd: the episodes are of several kinds then, and
        none is odd.
    """

    episodes: Sequence[ScannedEpisode]
    sensors: Sequence[str]
    judge: str
    fdr: float
    notes: Sequence[str]
    ledger: Ledger = field(default_factory=Ledger)
    kinds_mixed: bool = False

    @property
    def ranked(self) -> list[ScannedEpisode]:
        """All episodes, the oddest first."""
        return sorted(self.episodes, key=lambda scanned: scanned.place)

    @property
    def odd(self) -> list[ScannedEpisode]:
        """The odd episodes, in recorded order."""
        return [scanned for scanned in self.episodes if scanned.odd]

    def as_json(self) -> dict[str, Any]:
        """Return the scan as values for JSON, which docs/how-to/scan.md describes.

        Returns
        -------
        dict
            With None in place of what is undefined or infinite.
        """
        return {
            "schema": "oodd-eval/scan/2",
            "judge": self.judge,
            "fdr": self.fdr,
            "sensors": list(self.sensors),
            "notes": list(self.notes),
            "ledger": self.ledger.as_json(),
            "kinds_mixed": self.kinds_mixed,
            "odd": [scanned.episode.name for scanned in self.odd],
            "ranked": [scanned.episode.name for scanned in self.ranked],
            "episodes": [scanned.as_json() for scanned in self.episodes],
        }


SCANNER: Final = "panel"
"""Detector that scans where none is named."""
_QUICK: Final = {"forecast": "linear"}  # of it: networks would be fitted 20 times

_FEW: Final = 0.001  # p-value of faults that are shown where episodes are too few to be odd

Outcome = tuple[Floats, Explanation | None]
"""Answer of a detector about one episode: scores, and an explanation if it gives any."""


def scan_episodes(
    episodes: Sequence[Any],
    *,
    sensors: Sequence[Any] | None = None,
    detector: AnyDetector = SCANNER,
    watchdog: Watchdog | None = None,
    fdr: float = 0.1,
    window: int | None = None,
    baseline: int = 0,
    seed: int = 0,
    horizon: int = 1,
    parameters: Mapping[str, Any] | None = None,
    jobs: int = 1,
    fine: Sequence[str] = (),
    first: int = 10,
    progress: Progress | None = None,
    ledger: Ledger | None = None,
) -> Scan:
    """Tell which of some recorded episodes are odd, and which of their rows and sensors.

    Most of them have to be nominal: up to a fifth may be odd without hiding one another. With up
    to 20 episodes each is judged by a fit on all others; more are judged in 20 groups.

    Parameters
    ----------
    episodes
        In recorded order: episodes as recipes read them, arrays of shape (R, D) with NaN for what
        is missing, or data frames and the like as `import_frames` takes them. A single one is cut
        into windows.
    sensors
        Names, or quantities with names and roles; default all columns, "sensor 0" and so on where
        they have no names.
    detector
        Name of an installed detector, a class or function that makes one, or an unfitted one.
        ``"panel"`` is `panel-a` where episodes have actions; ``parameters={"actions": "no"}``
        leaves them out.
    watchdog
        Judges all episodes in place of a detector that is fitted on them.
    fdr
        False discovery rate: of the episodes that are called odd, the largest share that is
        nominal, on average. It rests on an assumed tail, and on nothing where a watchdog has
        calibration episodes enough: at least the number of episodes over `fdr`, less one.
    window
        Rows of the windows that the episodes are cut into; by default they are not.
    baseline
        Number of rows at the start of every episode that are nominal. They are not judged, and
        each sensor's mean and spread over them are brought to those of the other episodes.
    seed, horizon, parameters
        For the factory of a named detector, the class or the function. Of `panel`, which is the
        default, ``forecast`` is ``"linear"`` unless it is given: networks would be fitted 20 times.
    jobs
        Fits at a time, in processes of their own where more than 1.
    fine
        Names of episodes that a person confirmed, or patterns such as ``"run-0*"``: the others are
        compared with these, which are never odd.
    first
        Number of episodes that are to be looked at: the first of the ranking.
    progress
        Called when there is a first ranking, and after each pass.
    ledger
        What became of the logs so far.

    Returns
    -------
    Scan

    Raises
    ------
    UsageError
        When an argument is wrong, or no episode is long enough.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> logs = [rng.normal(size=(200, 3)) for _ in range(20)]
    >>> logs[7][120:, 1] += 4
    >>> [odd] = scan_episodes(logs, sensors=["speed", "torque", "current"]).odd
    >>> odd.episode.name, abs(odd.first - 120) <= 3, odd.suspects
    ('episode 7', True, ['torque'])
    """
    if not 0 < fdr < 1:
        raise UsageError(f"fdr={fdr!r}, expected a share between 0 and 1")
    ledger = ledger or Ledger()
    recorded, sensors = _recorded(episodes, sensors, ledger)
    widths = sorted({episode.observations.shape[1] for episode in recorded})
    if len(widths) != 1:
        raise UsageError(f"episodes have {widths} sensors, expected the same number in all")
    names, roles = sensor_names(sensors, widths[0]), roles_of(sensors or ())
    recorded, notes = _cut(recorded, window)
    shortest = baseline + SHORTEST
    usable = [episode for episode in recorded if len(episode.observations) >= shortest]
    if len(usable) < len(recorded):
        count = len(recorded) - len(usable)
        notes.append(f"Left out: {counted(count, 'episode(s)')} of fewer than {shortest} rows.")
    if not usable:
        raise UsageError(f"no episode of at least {shortest} rows: nothing to judge")
    triage = fine, first, ledger
    if watchdog is not None:
        return _scan_with(watchdog, usable, names, fdr, notes, triage)
    if len(usable) < SHORTEST:
        rows = len(usable[0].observations)
        raise UsageError(
            f"a single episode of {rows} rows cannot be judged by others: record more, cut it into "
            f"windows (--window, window=) of {max(SHORTEST, rows // FITS)} rows, say, or judge it "
            "by a saved watchdog"
        )
    cleaned = clean(usable)
    defaults = _QUICK if detector == SCANNER else {}
    trajectories = [episode.trajectory for episode in cleaned]
    arguments = {**defaults, **(parameters or {})}
    actions = has_actions(trajectories)
    fit = _Fit(detector, seed, horizon, arguments, baseline, roles, actions)
    handle = fit.handle()
    folds = [range(k, len(usable), FITS) for k in range(min(FITS, len(usable)))]
    training = [[x for i, x in enumerate(trajectories) if i not in fold] for fold in folds]
    left_out = [[trajectories[i] for i in fold] for fold in folds]
    if jobs == 1:
        answers = [*map(fit.judge, training, left_out)]
    else:
        with ProcessPoolExecutor(min(jobs, len(folds)), get_context("spawn")) as pool:
            answers = [*pool.map(fit.judge, training, left_out)]
    numbers = itertools.chain(*folds)
    outcomes = dict(zip(numbers, itertools.chain(*answers), strict=True))
    scores = [outcomes[i][0] for i in range(len(usable))]
    judged = _with_faults(usable, cleaned, handle.alarm, scores, baseline)
    judged = [replace(one, explanation=outcomes[i][1]) for i, one in enumerate(judged)]
    how = "each episode is judged by a fit that has not seen it."
    notes.insert(0, f"{counted(len(usable), 'episode(s)')}, {counted(len(folds), 'fit(s)')}: {how}")
    recordings = len({episode.recording for episode in usable})
    if recordings < min(len(usable), LEAST):
        windows = f"{len(usable)} windows of {counted(recordings, 'recording(s)')}"
        notes.append(
            f"{windows}: they are judged as if each were a recording, and no false discovery rate "
            f"is kept; {LEAST} recordings would do."
        )
    name = handle.state["name"] or type(handle.detector).__name__
    terms = _Terms(f"{name}, fitted on the other episodes", fdr, notes)
    scan = _banded(_verdict(judged, names, terms), *triage)
    if progress is not None:
        progress("judged", [scanned.episode.name for scanned in scan.ranked])
    return scan


def _banded(scan: Scan, fine: Sequence[str], first: int, ledger: Ledger) -> Scan:
    """Return the scan with bands, places and reasons."""

    def oddness(scanned: ScannedEpisode) -> tuple[float, float]:
        return math.inf if math.isnan(scanned.p) else scanned.p, -scanned.largest

    places = {id(s): k for k, s in enumerate(sorted(scan.episodes, key=oddness), 1)}
    mixed = len(scan.odd) > ODD_SHARE * len(scan.episodes) and len(scan.episodes) >= LEAST
    episodes = []
    for scanned in scan.episodes:
        confirmed = any(fnmatchcase(scanned.episode.name, pattern) for pattern in fine)
        odd, place = scanned.odd and not (mixed or confirmed), places[id(scanned)]
        band: Band = "surely" if odd else "fine"
        if not odd and not confirmed and (place <= first or scanned.odd):
            band = "look at"
        clauses = [f"{f.fault} {f.what} from row {f.row}" for f in scanned.faults]
        clauses += [f"{name} from row {scanned.since}" for name in scanned.suspects[:1]]
        clauses += [f"a statistic of {scanned.largest:.3g}"]
        episodes.append(replace(scanned, odd=odd, band=band, place=place, reason=clauses[0]))
    return replace(scan, episodes=episodes, ledger=ledger, kinds_mixed=mixed)


def _with_faults(
    episodes: Sequence[Episode],
    cleaned: Sequence[CleanedEpisode],
    kind: AlarmKind,
    scores: Sequence[Floats],
    baseline: int,
) -> "list[_Judged]":
    """Join the statistics of scores and faults of the stream, each scaled on the other episodes."""
    statistics = [_statistic(kind, scores, _peers(episodes, i), i) for i in range(len(episodes))]
    largest = np.array([np.nanmax(statistic, initial=-math.inf) for statistic in statistics])
    scale, read = stream_scale(cleaned, baseline)
    breaks = breaks_of(episodes)
    usual = float(np.quantile(breaks, 1 - ODD_SHARE, method="nearest"))
    judged = []
    for i, (episode, statistic) in enumerate(zip(episodes, statistics, strict=True)):
        # Either may take one half of what is odd by chance.
        surprise = np.maximum(scale.surprise(*read[i]) - math.log(2), 0.0)
        tail = Tail.fit(*_reference(largest, episodes, i))
        joint = statistic if tail is None else joined(statistic, tail.value(surprise))
        readings = _Readings(scale, ~(joint <= statistic), *read[i])
        pauses = tuple(gaps(episode.time, float(breaks[i]), usual))
        rest = cleaned[i].trajectory, baseline, readings
        judged.append(_Judged(episode, scores[i], joint, None, pauses, *rest))
    return judged


def _recorded(
    episodes: Sequence[Any], sensors: Sequence[Any] | None, ledger: Ledger
) -> tuple[list[Episode], Sequence[Any] | None]:
    """Return episodes with their sensors; add what became of frames to the ledger."""
    source = scanned_frames(episodes, sensors or ())
    if source is None:
        return [_as_episode(episode, i) for i, episode in enumerate(episodes)], sensors
    with source:
        ledger.merge(source.ledger)
        return [*source.episodes(EVERY)], sensors or source.sensors


def _as_episode(episode: Episode | ArrayLike, number: int) -> Episode:
    if isinstance(episode, Episode):
        return episode if episode.recording is not None else replace(episode, recording=number)
    name = f"episode {number}"
    rows = as_numbers(episode, f"{name}: ")
    if rows.ndim != 2 or 0 in rows.shape:
        raise UsageError(f"{name} has shape {rows.shape}, expected (rows, sensors)")
    return Episode(name, name, rows, np.empty((len(rows) - 1, 0)), None, recording=number)


def _cut(episodes: list[Episode], window: int | None) -> tuple[list[Episode], list[str]]:
    """Return windows of the episodes, the last of each maybe shorter, and what to say of it."""
    notes = []
    if window is None and len(episodes) == 1 and len(episodes[0].observations) >= WINDOWS * LEAST:
        window = len(episodes[0].observations) // WINDOWS
        notes = [f"A single recording, cut into windows of {window} rows (window=)."]
    if window is None:
        return episodes, notes
    if window < SHORTEST:
        raise UsageError(f"window={window}, expected at least {SHORTEST} rows")
    return [
        _rows(episode, start, start + window)
        for episode in episodes
        for start in range(0, len(episode.observations), window)
    ], notes


def _rows(episode: Episode, start: int, stop: int) -> Episode:
    inside = [(max(a, start) - start, min(b, stop) - start) for a, b in episode.intervals if a >= 0]
    return replace(
        episode,
        name=f"{episode.name}[{start}:{start + len(episode.observations[start:stop])}]",
        observations=episode.observations[start:stop],
        actions=episode.actions[start : stop - 1],
        rewards=None,
        intervals=tuple((a, b) for a, b in inside if a < b),
        time=None if episode.time is None else episode.time[start:stop],
    )


def _scan_with(
    watchdog: Watchdog,
    episodes: list[Episode],
    names: list[str],
    fdr: float,
    notes: list[str],
    triage: tuple[Sequence[str], int, Ledger],
) -> Scan:
    """Let a watchdog judge all episodes, row by row as beside a robot."""
    unknown = [name for name in watchdog.sensors if name not in names]
    if unknown:
        raise UnknownNameError("sensor of the logs", unknown[0], names)
    order = [names.index(name) for name in watchdog.sensors]
    episodes = [
        replace(episode, observations=episode.observations[:, order]) for episode in episodes
    ]
    breaks = breaks_of(episodes)
    judged = [
        _watched(watchdog.copy(), episode, float(longest), rows.trajectory)
        for episode, longest, rows in zip(episodes, breaks, clean(episodes), strict=True)
    ]
    notes.insert(
        0, f"{counted(len(episodes), 'episode(s)')}, judged by a watchdog: {watchdog.promise}."
    )
    terms = _Terms("a watchdog", fdr, notes, watchdog.rule.threshold)
    if (calibration := watchdog.calibration) is not None:
        reference = _Reference.of(np.array(calibration.largest), np.array(calibration.recordings))
        windows = reference.units > len({*calibration.recordings})
        enough = (reference.units + 1) * fdr >= len(episodes) and not windows
        terms = replace(terms, reference=reference, exact=enough and not calibration.rolling)
    return _banded(_verdict(judged, watchdog.sensors, terms), *triage)


def _watched(
    watchdog: Watchdog, episode: Episode, longest: float, trajectory: Trajectory
) -> "_Judged":
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
    return _Judged(episode, scores, statistic, Explanation(shares, onsets), seen, trajectory)


@dataclass(frozen=True, slots=True)
class _Fit:
    """A function that makes a detector for one fit."""

    detector: AnyDetector
    seed: int
    horizon: int
    parameters: Mapping[str, Any]
    baseline: int
    roles: tuple[str, ...]
    actions: bool

    def handle(self) -> DetectorHandle:
        """Return a new detector."""
        return DetectorHandle.make(
            self.detector,
            None,
            self.seed,
            self.horizon,
            self.parameters,
            self.baseline,
            self.roles,
            actions=self.actions,
        )

    def judge(
        self, training: Sequence[Trajectory], episodes: Sequence[Trajectory]
    ) -> list[Outcome]:
        """Fit on training episodes and judge others."""
        handle = self.handle()
        detector = handle.detector
        base = Baseline.fit(training, self.baseline) if self.baseline else None
        hidden = 0 if handle.adapts else self.baseline
        try:
            detector.fit([handle.visible(x, base) for x in training])
            outcomes: list[Outcome] = []
            for x in episodes:
                scores, explanation = handle.scores(x, base), None
                if isinstance(detector, ExplainingDetector):
                    visible = handle.visible(x, base)
                    shares, onsets = checked_explanation(detector.explain(visible), visible)
                    shares = np.pad(shares, ((hidden, 0), (0, 0)), constant_values=np.nan)
                    onsets = np.where(onsets < 0, -1, onsets + hidden)
                    onsets = np.pad(onsets, (hidden, 0), constant_values=-1)
                    explanation = Explanation(shares, onsets)
                outcomes.append((scores, explanation))
        except OoddError:
            raise
        except Exception as error:
            name = type(detector).__name__
            failure = f"detector {name} raised {type(error).__name__}: {error}"
            raise ContractError(f"{failure} (fitted on {len(training)} episodes)") from error
        return outcomes


class _Readings(NamedTuple):
    """Readings of an episode, and where their faults are rarer than its score."""

    scale: StreamScale
    decides: NDArray[np.bool_]
    rows: NDArray[Any]
    judged: NDArray[Any] | None

    def faults(self, surprise: float, names: Sequence[str]) -> list[EpisodeFault]:
        """Return those that are at least as surprising."""
        named = self.scale.faults(self.rows, self.judged, surprise + math.log(2))
        return [
            EpisodeFault(names[d] if d >= 0 else "observation", fault, row)
            for d, fault, row in named
        ]


@dataclass(frozen=True, slots=True, eq=False)
class _Judged:
    """One episode with what a detector and the stream say about it."""

    # Of the trajectory the first `baseline` rows are what readings are compared with.

    episode: Episode
    scores: Floats
    statistic: Floats
    explanation: Explanation | None
    faults: tuple[EpisodeFault, ...]
    trajectory: Trajectory
    baseline: int = 0
    readings: _Readings | None = None

    @property
    def evidence(self) -> Floats:
        """Readings and their steps, (2, R, D), for what a detector does not explain."""
        rows = self.trajectory.observations.astype(np.float64)
        if self.baseline:
            rows -= rows[: self.baseline].mean(axis=0)
        return np.stack([rows, np.diff(rows, axis=0, prepend=rows[:1])])

    @property
    def sums(self) -> Floats:
        """Number, sum and sum of squares of readings and of steps, (3, 2, D)."""
        evidence = self.evidence
        sums: Floats = np.stack([np.ones_like(evidence), evidence, evidence**2]).sum(axis=2)
        return sums


@dataclass(frozen=True, slots=True, eq=False)
class _Terms:
    """Comparison of statistics: with those of `reference`, by default of the other episodes."""

    # If `exact`, these are enough for p-values by rank. Where they are too few for any, what is
    # above the limit is odd.

    judge: str
    fdr: float
    notes: list[str]
    limit: float = math.nan
    reference: "_Reference | None" = None
    exact: bool = False


class _Reference(NamedTuple):
    """Largest statistics that one is compared with, and their weights: see `window_weights`."""

    largest: Floats
    weights: Floats

    @classmethod
    def of(cls, largest: Floats, numbers: NDArray[np.intp]) -> "_Reference":
        """Let windows of a recording count once, unless recordings are too few to judge by."""
        is_enough = len({*numbers.tolist()}) + 1 >= LEAST
        return cls(largest, window_weights(numbers) if is_enough else np.ones(len(largest)))

    @property
    def units(self) -> int:
        """Number of recordings, or of windows that count as such."""
        return round(float(self.weights.sum()))


def _verdict(judged: Sequence[_Judged], names: Sequence[str], terms: _Terms) -> Scan:
    """Compare the episodes' largest statistics, and look for rows and sensors."""
    episodes = [judgement.episode for judgement in judged]
    largest = np.array([np.nanmax(judgement.statistic, initial=-math.inf) for judgement in judged])
    references = [terms.reference] * len(episodes) if terms.reference else []
    for i in range(len(episodes) if terms.reference is None else 0):
        references.append(_reference(largest, episodes, i))
    tails = [Tail.fit(*reference) for reference in references]
    ranks = np.array(
        [rank_p(x, *reference) for x, reference in zip(largest, references, strict=True)]
    )
    p = ranks.copy()
    for i, tail in enumerate(tails):
        if tail is not None and largest[i] > tail.start and not terms.exact:
            p[i] = tail.p(largest[i])
    fewest = min(reference.units for reference in references) + 1
    notes, has_p_values = [*terms.notes], fewest >= LEAST
    if not has_p_values:
        p[:] = math.nan
        deciding = "nothing decides"
        if terms.limit > 0:
            deciding = "the watchdog's threshold decides"
        notes.append(
            f"{fewest} episodes are too few to judge one by the others, which takes {LEAST} and "
            f"works well from {ENOUGH} on: here {deciding}. Record more, or cut long ones "
            "(window)."
        )
    elif terms.exact:
        notes.append(
            f"The {fewest - 1} calibration episodes are enough for p-values by rank, which keep "
            "the false discovery rate whatever the distribution."
        )
    q = q_values(p) if has_p_values else p
    critical = critical_p(p, terms.fdr) if has_p_values else math.nan
    surprising = -math.log(critical if has_p_values else _FEW)
    sums = np.stack([judgement.sums for judgement in judged])
    scanned = []
    for i, judgement in enumerate(judged):
        tail, threshold = tails[i], terms.limit
        if has_p_values:
            threshold = math.nan if tail is None else tail.threshold(critical)
            if terms.exact:
                threshold = rank_threshold(critical, *references[i])
        rejected = bool(q[i] <= terms.fdr if has_p_values else largest[i] > terms.limit)
        # Rounding of the threshold may leave nothing but the largest statistic.
        above = runs_of(rejected & (judgement.statistic >= np.fmin(threshold, largest[i])))
        faults = judgement.faults
        if judgement.readings is not None:
            faults = (*judgement.readings.faults(surprising, names), *faults)
        row = since = None
        shares: dict[str, float] = {}
        if rejected:
            row = above[0][0]
            other_sums = np.delete(sums, i, axis=0).sum(axis=0)
            usual = -math.inf if tail is None else tail.start
            since, values = _blame(judgement, usual, above[0], other_sums)
            if judgement.readings is not None and judgement.readings.decides[row]:
                since, values = _faulty(faults, names, row, (since, values))
            order = np.argsort(-values, kind="stable").tolist()
            shares = {names[d]: float(values[d]) for d in order}
        scanned.append(
            ScannedEpisode(
                judgement.episode,
                judgement.scores,
                judgement.statistic,
                float(largest[i]),
                float(ranks[i]),
                float(p[i]),
                float(q[i]),
                threshold,
                rejected,
                row,
                since,
                tuple(above),
                shares,
                faults,
            )
        )
    return Scan(scanned, names, terms.judge, terms.fdr, notes)


def _faulty(
    faults: Sequence[EpisodeFault], names: Sequence[str], row: int, blamed: tuple[int, Floats]
) -> tuple[int, Floats]:
    """Return since when faults last, and equal shares of faulty sensors; else what is blamed."""
    causes = [fault for fault in faults if fault.fault != "gap" and fault.row <= row]
    if not causes:
        return blamed
    faulty = np.array([float(name in {fault.what for fault in causes}) for name in names])
    shares = faulty / faulty.sum() if faulty.any() else blamed[1]
    return min(fault.row for fault in causes), shares


def _peers(episodes: Sequence[Episode], i: int) -> list[int]:
    """Return what an episode is compared with: others of its task where these suffice, else all."""
    candidates = [j for j in range(len(episodes)) if j != i]
    same = [j for j in candidates if episodes[j].task == episodes[i].task]
    return same if len(same) + 1 >= LEAST else candidates


def _reference(largest: Floats, episodes: Sequence[Episode], i: int) -> _Reference:
    """Return the peers' statistics: of other recordings where these suffice, else of windows."""
    peers = _peers(episodes, i)
    others = [j for j in peers if episodes[j].recording != episodes[i].recording]
    numbers = numbered([episodes[j].recording for j in others], len(others))
    if len({*numbers.tolist()}) + 1 < LEAST:
        others, numbers = peers, np.arange(len(peers))
    return _Reference.of(largest[others], numbers)


def _statistic(kind: AlarmKind, scores: Sequence[Floats], peers: Sequence[int], i: int) -> Floats:
    """Return the statistic of an episode's scores."""
    # A CUSUM standardizes them with the median of its peers' means and of their deviations, which
    # no odd episode among them spoils.
    standardization = None
    if kind == "cusum":
        standardizations = (Standardization.fit([scores[j]]) for j in peers)
        mean, std = np.nanmedian([[s.mean, s.std] for s in standardizations], axis=0)
        standardization = Standardization(float(mean), float(std))
    return GuaranteedAlarm(standardization, math.inf).statistic(scores[i])


def _blame(
    judged: _Judged, usual: float, interval: tuple[int, int], other_sums: Floats
) -> tuple[int, Floats]:
    """Return the row with which an excursion began, and the share of each sensor in it, (D,)."""
    # It is above the threshold in the interval; before it the statistic was above what is usual.
    row, stop = interval
    if judged.explanation is not None and judged.explanation.onsets[row] >= 0:
        return int(judged.explanation.onsets[row]), judged.explanation.shares[row]
    quiet = np.flatnonzero(judged.statistic[:row] <= usual)
    since = int(quiet[-1]) + 1 if len(quiet) else 0
    n, total, squares = other_sums[:, :, None]
    # A single episode has no others.
    mean = total / np.maximum(n, 1.0)
    std = np.sqrt(np.maximum(squares / np.maximum(n, 1.0) - mean**2, 0.0))
    least = 1e-6 * np.maximum(1.0, np.abs(mean))
    # Readings, or their steps if these are farther from those of the others.
    deviations = (np.abs(judged.evidence - mean) / np.maximum(std, least)).max(axis=0)
    of_excursion = (deviations[since:stop] ** 2).mean(axis=0)
    return since, of_excursion / (of_excursion.sum() or 1.0)
