"""Find the odd ones among recorded episodes, with their odd rows and sensors.

Each episode is judged by fits that have not seen it, in two passes: the second one leaves out the
fifth that the first one found most suspicious. Faults of the stream and figures of whole episodes
count beside the detector's statistic, by how rare they are.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from fnmatch import fnmatchcase
from functools import cached_property
from typing import Any, Final, Literal, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from oodd_live.handle import has_actions
from oodd_live.nominal import sensor_names
from oodd_live.watchdog import Watchdog

from oodd_eval.arrays import as_numbers
from oodd_eval.data.bounded import without_nan
from oodd_eval.data.facts import Role, roles_of
from oodd_eval.errors import UnknownNameError, UsageError
from oodd_eval.metrics.alarms import AlarmKind, GuaranteedAlarm, window_weights
from oodd_eval.metrics.cusum import Standardization
from oodd_eval.names import counted
from oodd_eval.plugins.contract import AnyDetector
from oodd_logs.episodes import EVERY, Episode
from oodd_logs.frames import scanned_frames
from oodd_logs.ledger import Ledger
from oodd_logs.scanning.episode_faults import (
    CleanedEpisode,
    EpisodeFault,
    breaks_of,
    clean,
    gaps,
    stream_scale,
)
from oodd_logs.scanning.evidence import (
    SCORE,
    EpisodeEvidence,
    Finding,
    Peers,
    Readings,
    evidence_of,
)
from oodd_logs.scanning.figures import compare_figures
from oodd_logs.scanning.fits import Fit, thinned
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
    surprise,
)
from oodd_logs.scanning.watched import watched

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
        Of the stream: those that are as rare as what makes an episode odd. Gaps and saturated
        sensors are listed, too, and make none odd.
    band
        Whether it is odd (``"surely"``), or to be looked at.
    position
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
    position: int = 1
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
            "position": self.position,
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
        return sorted(self.episodes, key=lambda scanned: scanned.position)

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
_QUICK: Final = {"forecast": "linear"}  # of it: networks would be fitted ten times

_FEW: Final = 0.001  # p-value of faults that are shown where episodes are too few to be odd
_ROWS: Final = 50_000  # of all episodes, from which on the first pass takes every so many
_GLANCE: Final = 10_000  # rows of the first ranking of all


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

    Most of them have to be nominal: up to a fifth may be odd without hiding one another. Each is
    judged by fits that have not seen it: by one of five, from 20 episodes on in a second pass, too,
    which leaves out the most suspicious fifth.

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
        default, ``forecast`` is ``"linear"`` unless it is given: networks would be fitted ten
        times.
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
    ledger = Ledger() if ledger is None else ledger
    recorded, sensors = _recorded(episodes, sensors, ledger)
    widths = sorted({episode.observations.shape[1] for episode in recorded})
    if len(widths) != 1:
        raise UsageError(f"episodes have {widths} sensors, expected the same number in all")
    names, roles = sensor_names(sensors, widths[0]), roles_of(sensors or ())
    if "score" in roles and watchdog is None:
        recorded, names, roles = _without_scores(recorded, sensors or ())
    recorded, notes = _cut(recorded, window)
    shortest = baseline + SHORTEST
    usable = [episode for episode in recorded if len(episode.observations) >= shortest]
    if len(usable) < len(recorded):
        count = len(recorded) - len(usable)
        notes.append(f"Left out: {counted(count, 'episode(s)')} of fewer than {shortest} rows.")
    if not usable:
        raise UsageError(f"no episode of at least {shortest} rows: nothing to judge")
    confirmed = _confirmed(usable, fine)
    if watchdog is not None:
        evidence = watched(watchdog, usable, names)
        comparison = _by_calibration(evidence, watchdog, confirmed, fdr)
        terms = _Terms("a watchdog", fdr, first, notes, ledger, confirmed)
        notes.insert(
            0, f"{counted(len(usable), 'episode(s)')}, judged by a watchdog: {watchdog.promise}."
        )
        return _verdict(evidence, watchdog.sensors, comparison, terms)
    if len(usable) < SHORTEST:
        rows = len(usable[0].observations)
        raise UsageError(
            f"a single episode of {rows} rows cannot be judged by others: record more, cut it into "
            f"windows (--window, window=) of {max(SHORTEST, rows // ENOUGH)} rows, say, or judge "
            "it by a saved watchdog"
        )
    cleaned = clean(usable)
    arguments = {**(_QUICK if detector == SCANNER else {}), **(parameters or {})}
    actions = has_actions([episode.trajectory for episode in cleaned])
    fit = Fit(detector, seed, horizon, arguments, baseline, roles, actions)
    handle = fit.handle()
    name = handle.state["name"] or type(handle.detector).__name__
    terms = _Terms(f"{name}, fitted on the other episodes", fdr, first, notes, ledger, confirmed)
    passes = _Passes(usable, cleaned, fit, handle.alarm, jobs, progress)
    evidence = passes.evidence(names, first)
    for scanned, episode in zip(cleaned, usable, strict=True):
        scanned.account(ledger, episode.source, names)
    fits = f"{min(FITS, len(usable))} fits"
    if len(usable) >= ENOUGH:
        fits = f"two passes of {FITS} fits"
    how = "each episode is judged by fits that have not seen it."
    notes.insert(0, f"{counted(len(usable), 'episode(s)')}, {fits}: {how}")
    recordings = len({episode.recording for episode in usable})
    if recordings < min(len(usable), LEAST):
        windows = f"{len(usable)} windows of {counted(recordings, 'recording(s)')}"
        notes.append(
            f"{windows}: they are judged as if each were a recording, and no false discovery rate "
            f"is kept; {LEAST} recordings would do."
        )
    scan = _verdict(evidence, names, _by_others(evidence, passes.peers, confirmed, fdr), terms)
    if progress is not None:
        progress("judged by both passes", [one.episode.name for one in scan.ranked])
    return scan


def _confirmed(episodes: Sequence[Episode], fine: Sequence[str]) -> list[int]:
    """Return the numbers of episodes that are named as fine."""
    numbers: set[int] = set()
    for pattern in fine:
        matches = {
            i
            for i, name in enumerate(episode.name for episode in episodes)
            # A recording stands for its windows.
            if pattern in {name, name.partition("[")[0]} or fnmatchcase(name, pattern)
        }
        if not matches:
            raise UnknownNameError("episode", pattern, [episode.name for episode in episodes])
        numbers |= matches
    return sorted(numbers)


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


def _without_scores(
    episodes: Sequence[Episode], columns: Sequence[Any]
) -> tuple[list[Episode], list[str], tuple[Role, ...]]:
    """Return episodes without what monitors computed, names and roles of the sensors."""
    kept = [i for i, column in enumerate(columns) if getattr(column, "role", "") != "score"]
    sensors = [columns[i] for i in kept]
    stripped = [replace(e, observations=e.observations[:, kept]) for e in episodes]
    return stripped, sensor_names(sensors, len(kept)), roles_of(sensors)


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


@dataclass(frozen=True, eq=False)
class _Passes:
    """Two passes of fits over episodes."""

    episodes: Sequence[Episode]
    cleaned: Sequence[CleanedEpisode]
    fit: Fit
    kind: AlarmKind
    jobs: int
    progress: Progress | None

    @cached_property
    def peers(self) -> list[Peers]:
        """What each episode is compared with."""
        everything = range(len(self.episodes))
        return [Peers.of(self.episodes, i, everything) for i in everything]

    def evidence(self, names: Sequence[str], first: int) -> list[EpisodeEvidence]:
        """Judge the episodes, and explain the first of the ranking."""
        count, trajectories = len(self.episodes), [x.trajectory for x in self.cleaned]
        scale, seen = stream_scale(self.cleaned, self.fit.baseline)
        readings = [Readings.of(scale, *read) for read in seen]
        stream = [reading.surprise for reading in readings]
        rows = [x.rows(judged) for x, (_, judged) in zip(self.cleaned, seen, strict=True)]
        figures = compare_figures(rows, [episode.task for episode in self.episodes])
        beside = np.array([x.max() for x in stream]), np.array([x.distance for x in figures])
        if self.progress is not None:
            self._ranked(_GLANCE, 2, beside)
        apart, explained = list[int](), [*range(count)]
        if count >= ENOUGH:
            ranked = self._ranked(_ROWS, FITS, beside)
            # Of fewer, fits need all: what they lack makes nominal ones odder than it hides.
            apart, explained = ranked[: math.floor(ODD_SHARE * count)], ranked[:first]
        outcomes = self.fit.cross(trajectories, apart, [*apart, *explained], jobs=self.jobs)
        statistics = self._statistics([scores for scores, _ in outcomes])
        breaks = breaks_of(self.episodes)
        usual = float(np.quantile(breaks, 1 - ODD_SHARE, method="nearest"))
        return [
            EpisodeEvidence(
                episode,
                outcomes[i][0],
                statistics[i],
                outcomes[i][1],
                (*self.cleaned[i].faults(names), *gaps(episode.time, float(breaks[i]), usual)),
                trajectories[i],
                self.fit.baseline,
                readings[i],
                stream[i],
                figures[i],
            )
            for i, episode in enumerate(self.episodes)
        ]

    def _ranked(self, most: int, folds: int, beside: tuple[Floats, Floats]) -> list[int]:
        """Rank episodes by cross-fits on at most so many rows of all, the oddest first."""
        trajectories = [x.trajectory for x in self.cleaned]
        if (step := math.ceil(sum(map(len, trajectories)) / most)) > 1:
            trajectories = [thinned(x, step) for x in trajectories]
        outcomes = self.fit.thinned(step).cross(trajectories, folds=folds, jobs=self.jobs)
        statistics = self._statistics([scores for scores, _ in outcomes])
        largest = np.array([np.nanmax(x, initial=-math.inf) for x in statistics])
        _, excesses = evidence_of(largest, *beside, self.peers)
        order = np.argsort(-excesses.max(axis=1), kind="stable")
        words = f"ranked by {counted(folds, 'fit(s)')}"
        if self.progress is not None:
            self.progress(words, [self.episodes[i].name for i in order])
        return [int(i) for i in order]

    def _statistics(self, scores: Sequence[Floats]) -> list[Floats]:
        """Return the statistics of the episodes' scores."""
        if self.kind == "score":
            return [GuaranteedAlarm(None, math.inf).statistic(x) for x in scores]
        # A CUSUM standardizes them with the median of its peers' means and of their deviations,
        # which no odd episode among them spoils.
        fitted = [Standardization.fit([x]) for x in scores]
        pairs = np.array([(x.mean, x.std) for x in fitted])
        alarms = [
            GuaranteedAlarm(Standardization(*map(float, np.nanmedian(pairs[i], axis=0))), math.inf)
            for i in (others.numbers for others in self.peers)
        ]
        return [alarm.statistic(x) for alarm, x in zip(alarms, scores, strict=True)]


@dataclass(frozen=True, slots=True, eq=False)
class _Terms:
    """What a verdict is made by."""

    judge: str
    fdr: float
    first: int
    notes: list[str]
    ledger: Ledger
    fine: Sequence[int]


@dataclass(frozen=True, slots=True, eq=False)
class _Comparison:
    """Comparison of episodes with one another, with those that are confirmed, or with others."""

    # Surprises and excesses of score, stream and figures, (N, 3); ranks among what is compared
    # with, the fewest of these, and whether they are kept apart; if exact, ranks are the p-values.
    # The statistic with a surprise, which depends on the episode.

    surprises: Floats
    excesses: Floats
    tails: Sequence[Tail | None]
    ranks: Floats
    units: int
    is_apart: bool
    exact: bool
    threshold: Callable[[int, float], float]
    above_fine: Sequence[bool]
    limit: float = math.nan


def _by_calibration(
    evidence: Sequence[EpisodeEvidence], watchdog: Watchdog, fine: Sequence[int], fdr: float
) -> _Comparison:
    """Compare with a watchdog's calibration episodes, or with its threshold alone."""
    calibration, largest = watchdog.calibration, np.array([one.largest for one in evidence])
    limit, count = watchdog.rule.threshold, len(evidence)
    if calibration is None:
        surprises = np.column_stack([np.zeros(count), *[np.full(count, -math.inf)] * 2])
        nothing: tuple[list[None], Floats] = [None] * count, np.full(count, math.nan)
        below = [False] * count
        return _Comparison(
            surprises, surprises, *nothing, 0, True, False, lambda *_: limit, below, limit
        )
    numbers = np.array(calibration.recordings)
    recordings = len({*numbers.tolist()})
    # Windows count where recordings are too few.
    weights = window_weights(numbers if recordings + 1 >= LEAST else np.arange(len(numbers)))
    reference = np.array(calibration.largest), weights
    units, tail = round(float(weights.sum())), Tail.fit(*reference)
    exact = (units + 1) * fdr >= count - len(fine) and units <= recordings
    exact &= not calibration.rolling

    def threshold(_: int, needed: float) -> float:
        if exact:
            return rank_threshold(math.exp(-needed), *reference)
        return math.nan if tail is None else float(tail.value(needed))

    score = np.array([surprise(x, *reference) for x in largest.tolist()])
    ranks = np.array([rank_p(x, *reference) for x in largest.tolist()])
    surprises = np.column_stack([score, *[np.full(count, -math.inf)] * 2])
    apart = True, exact, threshold, [False] * count
    return _Comparison(surprises, surprises, [tail] * count, ranks, units, *apart, limit)


def _by_others(
    evidence: Sequence[EpisodeEvidence], peers: Sequence[Peers], fine: Sequence[int], fdr: float
) -> _Comparison:
    """Compare episodes with the others, or with those that are confirmed if these are enough."""
    episodes, count = [one.episode for one in evidence], len(evidence)
    reference = peers
    if is_apart := len({episodes[i].recording for i in fine}) >= LEAST:
        reference = [Peers.of(episodes, i, fine) for i in range(count)]
    # A confirmed episode, which is not tested, has one fewer to be compared with.
    tested = sorted({*range(count)} - {*fine}) or fine
    units = min(reference[i].units for i in tested)
    exact = is_apart and (units + 1) * fdr >= len(tested)
    largest = np.array([one.largest for one in evidence])
    stream = np.array([one.stream.max() for one in evidence])
    distances = np.array([one.figure.distance if one.figure else 0.0 for one in evidence])
    # Ranks are exact where all are compared alike.
    compared = peers if exact else reference
    surprises, excesses = evidence_of(largest, stream, distances, compared)
    best, rank = surprises.max(axis=1), excesses.max(axis=1)
    tails = [Tail.fit(largest[x.numbers], x.weights) for x in compared]
    ranks = [rank_p(x, best[y.numbers], y.weights) for x, y in zip(best, reference, strict=True)]

    def threshold(i: int, needed: float) -> float:
        others, tail = reference[i], tails[i]
        if exact:
            p = math.exp(-needed)
            needed = rank_threshold(p, best[others.numbers], others.weights)
        return math.nan if tail is None else float(tail.value(needed - SCORE))

    above = [
        is_apart and bool(x > rank[y.numbers].max()) for x, y in zip(rank, reference, strict=True)
    ]
    return _Comparison(
        surprises, excesses, tails, np.array(ranks), units, is_apart, exact, threshold, above
    )


def _verdict(
    evidence: Sequence[EpisodeEvidence],
    names: Sequence[str],
    comparison: _Comparison,
    terms: _Terms,
) -> Scan:
    """Call episodes odd, rank all, and look for rows and sensors."""
    count, fine, fdr = len(evidence), {*terms.fine}, terms.fdr
    largest, best = np.array([x.largest for x in evidence]), comparison.surprises.max(axis=1)
    tested = np.array([i not in fine for i in range(count)])
    p = comparison.ranks if comparison.exact else np.minimum(np.exp(-best), 1.0)
    q, critical = np.full(count, math.nan), math.nan
    has_p_values, above_limit = comparison.units + 1 >= LEAST, largest > comparison.limit
    if has_p_values and tested.any():
        q[tested], critical = q_values(p[tested]), critical_p(p[tested], fdr)
    elif not has_p_values:
        p = q
    called = q <= fdr
    mixed = not comparison.is_apart and bool(called.sum() > ODD_SHARE * tested.sum())
    notes = [*terms.notes, *_remarks(comparison, int(called.sum()) if mixed else 0, len(fine))]
    order = np.lexsort((-largest, -comparison.excesses.max(axis=1), ~called, ~tested)).tolist()
    positions = {i: position for position, i in enumerate(order, 1)}
    needed = -math.log(critical if critical > 0 else _FEW)
    sums = np.stack([one.sums for one in evidence])
    scanned = []
    for i, one in enumerate(evidence):
        odd, suspicious = bool(called[i]) and not mixed, bool(called[i]) or comparison.above_fine[i]
        band: Band = "surely" if odd else "fine"
        if not odd and tested[i] and (positions[i] <= terms.first or suspicious or above_limit[i]):
            band = "look at"
        surprises, tail = comparison.surprises[i], comparison.tails[i]
        threshold = comparison.threshold(i, needed) if has_p_values else comparison.limit
        joint = one.joint(tail, float(surprises[1]))
        faults = one.listed(needed, names)
        limits = threshold if odd else math.inf, -math.inf if tail is None else tail.start
        finding = one.finding(
            surprises if odd else comparison.excesses[i],
            joint,
            limits,
            sums.sum(axis=0) - sums[i],
            faults,
            names,
        )
        detail = finding if band != "fine" else Finding(None, None, (), {}, finding.reason)
        as_rare = -math.inf
        if tail is not None and math.isfinite(surprises[2]):
            as_rare = float(tail.value(surprises[2] - SCORE))
        scanned.append(
            ScannedEpisode(
                one.episode,
                one.scores,
                joint,
                float(np.nanmax(np.append(joint, as_rare), initial=-math.inf)),
                float(comparison.ranks[i]),
                float(p[i]),
                float(q[i]),
                threshold,
                odd,
                detail.row,
                detail.since,
                detail.intervals,
                detail.sensors,
                faults,
                band,
                positions[i],
                finding.reason,
            )
        )
    return Scan(scanned, names, terms.judge, fdr, notes, terms.ledger, mixed)


def _remarks(comparison: _Comparison, mixed: int, fine: int) -> Iterator[str]:
    """Yield what is to be known about a comparison."""
    fewest = comparison.units + 1
    if fewest < LEAST:
        limited = math.isfinite(comparison.limit)
        deciding = "the watchdog's threshold says which to look at" if limited else "none is called"
        yield (
            f"{fewest} episodes are too few to judge one by the others, which takes {LEAST} and "
            f"works well from {ENOUGH} on: {deciding}. Record more, or cut long ones (window)."
        )
    elif comparison.exact:
        whose = "confirmed" if fine else "calibration"
        yield (
            f"The {fewest - 1} {whose} episodes are enough for p-values by rank, which keep "
            "the false discovery rate whatever the distribution."
        )
    if mixed:
        yield (
            f"{mixed} episodes stand out, more than a fifth: these episodes are of several kinds, "
            "and none is sure. Scan one kind at a time, or name some that are fine (--fine)."
        )
