"""Metrics of test data without twins: nominal episodes and anomalous ones, in any numbers.

Anomalous episodes have intervals of rows [start, stop) that are anomalous, or an outcome alone. All
comparisons stay inside a task. Terms of a metric run over the m nominal test episodes and then over
the n anomalous ones, see `Contribution`.

An AUC of two samples is no sum over episodes. Its terms are from the first two parts of its
decomposition (Hoeffding 1948; DeLong, DeLong & Clarke-Pearson, Biometrics 44, 1988): with A the
AUC, V10 the share of nominal episodes below an anomalous one and V01 the share of anomalous ones
above a nominal one, resampling ``mean(V10) + mean(V01) - A`` within both samples has the variance
of the AUC, and its value is A.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from oodd_eval.metrics.alarms import GuaranteedAlarm, from_starts
from oodd_eval.metrics.auc import Contribution, auc, mean_of

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]
Mask = NDArray[np.bool_]
Intervals = tuple[tuple[int, int], ...]
Metrics = dict[str, Contribution]

UNKNOWN: Final = -1
"""Start of an interval of which only the end is known."""

LEAST_NOMINAL: Final = 5
"""Nominal episodes that must have a row for anomalous episodes to be compared with them there."""

OUTCOME_UP_TO: Final[Mapping[str, float]] = MappingProxyType(
    {"auc_outcome": 1.0, "auc_outcome_half": 0.5, "auc_outcome_whole": math.inf}
)
"""Shares of the shortest length in the task that outcomes are compared up to, by metric."""

BUFFER: Final = 100
"""Rows of the widest buffer around intervals in ``vus_pr``."""

THRESHOLDS: Final = 250
"""Thresholds of the curves that ``vus_pr`` is the volume of."""

_BLOCK: Final = 1024  # rows that are compared at once
_SECONDS: Final = 3600.0  # of an hour


@dataclass(frozen=True, slots=True, eq=False)
class UnpairedScores:
    """Scores of one cell without twins.

    Parameters
    ----------
    nominal
        Scores of the m nominal test episodes.
    anomalous
        Scores of the n anomalous episodes.
    intervals
        For each anomalous episode its anomalous rows [start, stop); a start of -1 is not known.
        None for an episode that is known by its outcome alone.
    nominal_tasks, tasks
        Task of each nominal and of each anomalous episode.
    clock
        Whether row t of one episode may be compared with row t of another.
    recordings
        Number of the recording that each nominal and then each anomalous episode is a window of;
        empty where each is one. Intervals are over recordings.
    nominal_stream, stream
        Surprise of the stream by row of each nominal and of each anomalous episode, see
        `StreamScale`; empty where it does not count.
    """

    nominal: Sequence[Floats]
    anomalous: Sequence[Floats]
    intervals: Sequence[Intervals]
    nominal_tasks: Sequence[str]
    tasks: Sequence[str]
    clock: bool = True
    recordings: tuple[int, ...] = ()
    nominal_stream: Sequence[Floats] = ()
    stream: Sequence[Floats] = ()

    def with_statistics(self, joint: Callable[[Floats, Floats], Floats]) -> "UnpairedScores":
        """Return the cell with what alarms are of in place of scores: joint(scores, stream)."""
        parts = (self.nominal, self.nominal_stream), (self.anomalous, self.stream)
        nominal, anomalous = (
            [*map(joint, scores, stream or map(np.zeros_like, scores))] for scores, stream in parts
        )
        return replace(self, nominal=nominal, anomalous=anomalous)

    def by_task(self) -> Iterator[tuple[list[int], list[int]]]:
        """Yield the indices of nominal and of anomalous episodes, for each task with some of both.

        A task without anomalous or without nominal test episodes is left out.
        """
        for task in dict.fromkeys(self.tasks):
            nominal = [j for j, name in enumerate(self.nominal_tasks) if name == task]
            if nominal:
                yield nominal, [i for i, name in enumerate(self.tasks) if name == task]

    @property
    def sizes(self) -> tuple[int, int]:
        """Numbers of nominal and of anomalous episodes."""
        return len(self.nominal), len(self.anomalous)

    @property
    def labelled(self) -> list[int]:
        """Indices of the anomalous episodes with intervals."""
        return [i for i, intervals in enumerate(self.intervals) if intervals]

    @property
    def by_outcome(self) -> list[int]:
        """Indices of the anomalous episodes that are known by their outcome alone."""
        return [i for i, intervals in enumerate(self.intervals) if not intervals]


def anomalous_rows(intervals: Intervals, rows: int) -> Mask:
    """Return which of so many rows are anomalous: all of them where there are no intervals.

    >>> anomalous_rows(((-1, 2), (4, 5)), 6).tolist()
    [True, True, False, False, True, False]
    """
    mask = np.full(rows, not intervals)
    for start, stop in intervals:
        mask[max(start, 0) : stop] = True
    return mask


def separability(
    cell: UnpairedScores, statistic: GuaranteedAlarm, *, supervised: bool = False
) -> Metrics:
    """Return the AUCs of one cell without twins, and how good probabilities of failure are.

    ``auc_pool`` compares every anomalous row t with row t of the nominal test episodes of the task
    that have one, if there are at least five, and takes the mean over rows and then over episodes.
    Without a clock it compares with all their rows. ``auc_pool_null`` compares nominal test
    episodes with the others of their task on the rows of anomalous ones: the k-th of a task on
    those of the k-th anomalous episode, from the first again after the last. ``auc_rows`` compares
    rows inside the intervals with the other rows of their episode. ``auc_outcome`` compares largest
    statistics up to the shortest length in the task, of episodes without intervals;
    ``auc_outcome_half`` those up to half of it, and ``auc_outcome_whole`` those of whole episodes.
    ``brier_outcome`` is the mean over rows up to the shortest length of the squared distance of a
    probability of failure from the outcome, 1 or 0; mean over all of these episodes.

    Parameters
    ----------
    cell
        The scores.
    statistic
        Of the alarms; its threshold does not matter.
    supervised
        Whether the detector learns from failures. Its scores are probabilities of failure where all
        are within [0, 1].

    Returns
    -------
    dict
        Metrics by name, those left out that the cell's labels leave without meaning.
    """
    metrics = {"auc_pool": _pool(cell), "auc_pool_null": _pool_null(cell)}
    if cell.labelled:
        rows = np.full(len(cell.anomalous), np.nan)
        for i in cell.labelled:
            scores = cell.anomalous[i]
            mask = anomalous_rows(cell.intervals[i], len(scores))
            rows[i] = auc(scores[mask], scores[~mask])
        metrics["auc_rows"] = _of_anomalous(cell, mean_of(rows))
    if cell.by_outcome:
        metrics |= {n: _outcome(cell, statistic, share) for n, share in OUTCOME_UP_TO.items()}
        pooled = np.concatenate([*cell.nominal, *cell.anomalous])
        if supervised and not ((pooled < 0) | (pooled > 1)).any():
            metrics["brier_outcome"] = _brier(cell)
    return metrics


class _Comparison(NamedTuple):
    """Judged rows with the index of their episodes, and the rows that they are compared with."""

    # Both are in the order of their episodes.

    judged: Floats
    episodes: Indices
    references: Floats
    others: Indices


class _Placements(NamedTuple):
    """Mean shares of reference rows below each judged episode, and the influence of references."""

    # Shares are NaN for episodes without a row; `used` references are compared with any.

    shares: Floats
    influences: Floats
    used: Mask


def _placements(
    judged: Sequence[Floats],
    masks: Sequence[Mask],
    references: Sequence[Floats],
    *,
    clock: bool,
    same: bool = False,
) -> _Placements:
    """Compare the rows of judged episodes in their masks with those of reference episodes."""
    # If they are the `same`, judged episode k is reference k, with which it is not compared.
    masks = [mask & ~np.isnan(s) for mask, s in zip(masks, judged, strict=True)]
    if clock:
        present = np.zeros(max(map(len, (*judged, *references)), default=0), np.intp)
        for scores in references:
            present[: len(scores)] += ~np.isnan(scores)
        enough = present - same >= LEAST_NOMINAL
        masks = [mask & enough[: len(mask)] for mask in masks]
    elif not sum((~np.isnan(scores)).any() for scores in references) - same > 0:
        masks = [np.zeros_like(mask) for mask in masks]
    rows = np.array([np.count_nonzero(mask) for mask in masks], np.intp)
    sums, influences = np.zeros(len(rows)), np.zeros(len(references))
    used = np.zeros(len(references), dtype=bool)
    compare = _at_the_same_rows if clock else _at_all_rows
    for compared in compare(judged, masks, references):
        shares, changes = _shares_and_changes(compared, rows, same=same)
        sums += np.bincount(compared.episodes, shares, len(sums))
        influences += np.bincount(compared.others, changes, len(influences))
        used[compared.others] = True
    return _Placements(np.where(rows > 0, sums / np.maximum(rows, 1), np.nan), influences, used)


def _shares_and_changes(
    compared: _Comparison, rows: Indices, *, same: bool
) -> tuple[Floats, Floats]:
    """Return the share of references below each judged row, and what each reference changes."""
    # `rows` are those of each judged episode, all of which count alike.
    judged, episodes, references, reference_episodes = compared
    below, rivals = _below(judged, references), np.full(len(judged), float(len(references)))
    if same:
        # Among keys that rise from episode to episode, the rows before are those of the episodes
        # before and those below in the same one.
        ranks = np.unique(np.concatenate([judged, references]), return_inverse=True)[1]
        keys = np.concatenate([episodes, reference_episodes]) * len(ranks) + ranks
        mine, theirs = np.split(keys, [len(judged)])
        first, last = (np.searchsorted(reference_episodes, episodes, side=s) for s in _SIDES)
        below -= _below(mine, theirs) - first
        rivals -= last - first
    shares = below / rivals
    weights = 1 / (rows[episodes] * rivals)
    changes = _changes(judged, shares, weights, references)
    if same:
        start, stop = (np.searchsorted(episodes, reference_episodes, side=s) for s in _SIDES)
        # Relative to one half, so that ties everywhere give 0 without rounding.
        sums, beyond = (np.cumsum(np.append(0.0, w)) for w in (weights, weights * (shares - 0.5)))
        halves = (sums[start] + sums[stop]) / 2 - _below(theirs, mine, weights)
        changes -= halves - (beyond[stop] - beyond[start])
    return shares, changes


_SIDES: Final[tuple[Literal["left", "right"], ...]] = ("left", "right")


def _below(values: NDArray[Any], references: NDArray[Any], weights: Floats | None = None) -> Floats:
    """Return for each value the weight of the references below it, and half of those that tie."""
    order = np.argsort(references, kind="stable")
    each = np.ones(len(references)) if weights is None else weights[order]
    sums, ordered = np.concatenate([[0.0], np.cumsum(each)]), references[order]
    left, right = (np.searchsorted(ordered, values, side=side) for side in _SIDES)
    halves: Floats = (sums[left] + sums[right]) / 2
    return halves


def _changes(judged: Floats, shares: Floats, weights: Floats, references: Floats) -> Floats:
    """Return what each reference adds to the weighted shares beyond what the mean one does."""
    # Sums are taken in the order of `_below`, so that ties everywhere give 0 without rounding.
    order = np.argsort(judged, kind="stable")
    total, mean = np.cumsum(weights[order])[-1], np.cumsum((weights * shares)[order])[-1]
    changes: Floats = total - _below(references, judged, weights) - mean
    return changes


def _at_all_rows(
    judged: Sequence[Floats], masks: Sequence[Mask], references: Sequence[Floats]
) -> Iterator[_Comparison]:
    """Compare every judged row with all rows of the references."""
    values = [scores[mask] for scores, mask in zip(judged, masks, strict=True)]
    reference_values = [scores[~np.isnan(scores)] for scores in references]
    compared = _Comparison(*_pooled(values), *_pooled(reference_values))
    if len(compared.judged) and len(compared.references):
        yield compared


def _pooled(parts: Sequence[Floats]) -> tuple[Floats, Indices]:
    sizes = [len(part) for part in parts]
    return np.concatenate([np.zeros(0), *parts]), np.repeat(np.arange(len(parts)), sizes)


def _at_the_same_rows(
    judged: Sequence[Floats], masks: Sequence[Mask], references: Sequence[Floats]
) -> Iterator[_Comparison]:
    """Compare judged rows t with rows t of the references, some rows at a time."""
    last = max((len(mask) for mask in masks), default=0)
    for start in range(0, last, _BLOCK):
        block = slice(start, start + _BLOCK)
        picked = [np.where(m, s, np.nan)[block] for s, m in zip(judged, masks, strict=True)]
        rows, reference_rows = _stacked(picked), _stacked([scores[block] for scores in references])
        for t in np.flatnonzero(~np.isnan(rows).all(axis=0)):
            i, j = (np.flatnonzero(~np.isnan(matrix[:, t])) for matrix in (rows, reference_rows))
            yield _Comparison(rows[i, t], i, reference_rows[j, t], j)


def _stacked(parts: Sequence[Floats]) -> Floats:
    """Return scores as rows of a matrix, NaN beyond the end of each."""
    matrix = np.full((len(parts), _BLOCK), np.nan)
    for row, part in zip(matrix, parts, strict=True):
        row[: len(part)] = part
    return matrix


def two_sample(anomalous: Floats, influences: Floats, used: Mask) -> Contribution:
    """Return the terms of an AUC of anomalous against nominal episodes.

    Parameters
    ----------
    anomalous
        For each of n anomalous episodes the share of nominal ones below it, NaN where undefined.
    influences
        By how much each of m nominal episodes changes the mean of these, for one more of its kind.
    used
        Whether each nominal episode is compared with any.

    Returns
    -------
    Contribution
        Its value is the mean of `anomalous`. The denominators of each sample sum to the same.
    """
    defined = ~np.isnan(anomalous)
    n, m = np.count_nonzero(defined), np.count_nonzero(used)
    if not n or not m:
        empty = np.zeros(len(used) + len(anomalous))
        return Contribution(empty, empty.copy(), nominal=len(used))
    value = anomalous[defined].sum() / n
    sides = np.concatenate([value + m * influences, np.where(defined, anomalous, 0.0)])
    weights = np.concatenate([used * ((n + m) / (2 * m)), defined * ((n + m) / (2 * n))])
    # Doubling is exact, and so is a value of one half where all shares are.
    numerator = np.where(weights > 0, weights * (2 * sides - value), 0.0)
    return Contribution(numerator, weights, nominal=len(used))


def _pool(cell: UnpairedScores) -> Contribution:
    placements = []
    for nominal, anomalous in cell.by_task():
        judged = [cell.anomalous[i] for i in anomalous]
        masks = [anomalous_rows(cell.intervals[i], len(cell.anomalous[i])) for i in anomalous]
        references = [cell.nominal[j] for j in nominal]
        of_task = _placements(judged, masks, references, clock=cell.clock)
        placements.append((nominal, anomalous, of_task))
    return _of_both(cell, placements)


def _pool_null(cell: UnpairedScores) -> Contribution:
    shares, influences = np.full(len(cell.nominal), np.nan), np.zeros(len(cell.nominal))
    for nominal, anomalous in cell.by_task():
        judged = [cell.nominal[j] for j in nominal]
        masks = [
            anomalous_rows(cell.intervals[i], len(cell.nominal[j]))
            for j, i in zip(nominal, itertools.cycle(anomalous), strict=False)
        ]
        placements = _placements(judged, masks, judged, clock=cell.clock, same=True)
        shares[nominal], influences[nominal] = placements.shares, placements.influences
    defined = ~np.isnan(shares)
    # One sample judges and is judged: an odd episode adds as much here as it takes there.
    terms = mean_of(shares)
    if defined.any():
        changes = np.where(defined, influences - influences[defined].mean(), 0.0)
        terms = Contribution(terms.numerator + changes, terms.denominator)
    return _of_nominal(cell, terms)


def _outcome(cell: UnpairedScores, statistic: GuaranteedAlarm, share: float) -> Contribution:
    placements = []
    for nominal, failed, rows in _outcomes(cell):
        stop = math.ceil(share * rows) if math.isfinite(share) else None
        judged, references = (
            [np.array([statistic.largest(part[k][:stop])]) for k in indices]
            for part, indices in ((cell.anomalous, failed), (cell.nominal, nominal))
        )
        masks = [np.ones(1, dtype=bool)] * len(failed)
        of_task = _placements(judged, masks, references, clock=False)
        placements.append((nominal, failed, of_task))
    return _of_both(cell, placements)


def _brier(cell: UnpairedScores) -> Contribution:
    distances, m = [*cell.nominal, *(1 - scores for scores in cell.anomalous)], len(cell.nominal)
    squares = np.full(len(distances), np.nan)
    for nominal, failed, rows in _outcomes(cell):
        for k in (*nominal, *(m + i for i in failed)):
            squares[k] = mean_of(distances[k][:rows] ** 2).value
    return replace(mean_of(squares), nominal=m)


def _of_both(
    cell: UnpairedScores, tasks: Iterable[tuple[list[int], list[int], _Placements]]
) -> Contribution:
    """Return an AUC of the nominal and anomalous episodes of each task."""
    m, n = cell.sizes
    shares, influences, used = np.full(n, np.nan), np.zeros(m), np.zeros(m, dtype=bool)
    for nominal, anomalous, placements in tasks:
        shares[anomalous] = placements.shares
        influences[nominal], used[nominal] = placements.influences, placements.used
    defined = int(np.count_nonzero(~np.isnan(shares)))
    return two_sample(shares, influences / max(defined, 1), used)


def _outcomes(cell: UnpairedScores) -> Iterator[tuple[list[int], list[int], int]]:
    """Yield nominal and failed episodes of each task, and the number of rows that all have."""
    for nominal, anomalous in cell.by_task():
        failed = [i for i in anomalous if not cell.intervals[i]]
        episodes = [*(cell.nominal[j] for j in nominal), *(cell.anomalous[i] for i in failed)]
        if failed:
            yield nominal, failed, min(map(len, episodes))


def nominal_alarms(
    nominal: Sequence[Floats], rule: GuaranteedAlarm | Sequence[GuaranteedAlarm], rate: float | None
) -> Metrics:
    """Return false alarms of nominal test episodes at one level.

    Parameters
    ----------
    nominal
        Scores of the m episodes.
    rule
        The alarms, of each episode its own if there are several. An alarm begins where the
        statistic rises above the threshold.
    rate
        Rows in a second, for ``false_alarms_per_hour``; None leaves it out.

    Returns
    -------
    dict
        Metrics by name, without the suffix of a level.
    """
    rules = [rule] * len(nominal) if isinstance(rule, GuaranteedAlarm) else rule
    pairs = list(zip(nominal, rules, strict=True))
    metrics = {"false_episodes": mean_of([float(r.first(s) is not None) for s, r in pairs])}
    if rate:
        alarms = np.array([float(len(beginnings(s, r))) for s, r in pairs])
        rows = np.array([float(np.count_nonzero(~np.isnan(s))) for s in nominal])
        hours = rows / (rate * _SECONDS)
        metrics["false_alarms_per_hour"] = Contribution(alarms, hours)
    return metrics


def beginnings(scores: Floats, rule: GuaranteedAlarm) -> Indices:
    """Return the rows in which alarms of an episode begin.

    Parameters
    ----------
    scores
        Of the episode.
    rule
        The alarm, which lasts as long as the statistic is above the threshold.

    Returns
    -------
    int array

    Examples
    --------
    >>> beginnings(np.array([2.0, 2.0, 0.0, 3.0]), GuaranteedAlarm(None, 1.0)).tolist()
    [0, 3]
    """
    above = rule.statistic(scores) > rule.threshold
    return np.flatnonzero(above & ~np.concatenate([[False], above[:-1]]))


def unpaired_alarms(
    cell: UnpairedScores,
    rule: GuaranteedAlarm,
    rate: float | None,
    earlier: Sequence[GuaranteedAlarm] = (),
) -> Metrics:
    """Return the metrics of guaranteed alarms of one cell without twins.

    ``early``, delays, ``missed`` and ``found_within_k`` are those of `guaranteed_contributions`,
    from the start of an episode's first interval. Where that is not known only ``missed`` is
    defined. Their nulls are of nominal test episodes, the k-th of a task from the start of the k-th
    anomalous episode of the task that has one, from the first again after the last; tasks count as
    often as they have such episodes, since they differ in how often they alarm. An interval is
    found where an alarm begins in it (``events_found``). ``found_outcome`` and its null count
    alarms up to the shortest length in the task, ``balanced_outcome`` is the mean of the first and
    of what the second leaves, and ``outcome_time`` has the rows of failed episodes before the
    alarm, or the shortest length.

    Parameters
    ----------
    cell
        The scores.
    rule
        Made by `GuaranteedAlarm.fit`.
    rate
        As that of `nominal_alarms`.
    earlier
        Alarms of the nominal test episodes with a rolling calibration (`rolling_rules`); then
        `rule`, which is that of all others, is the one after them.

    Returns
    -------
    dict
        Metrics by name, without the suffix of a level; those left out that the cell's labels leave
        without meaning.
    """
    rules = list(earlier) or [rule] * len(cell.nominal)
    of_nominal = nominal_alarms(cell.nominal, rules, rate)
    metrics = {n: _of_nominal(cell, c) for n, c in of_nominal.items()}
    if cell.labelled:
        starts = [row[0][0] if row else UNKNOWN for row in cell.intervals]
        firsts = [rule.first(scores) for scores in cell.anomalous]
        delays = _from_known(firsts, cell.anomalous, starts)
        unknown = [i for i in cell.labelled if starts[i] == UNKNOWN]
        delays["missed"].numerator[unknown] = [float(firsts[i] is None) for i in unknown]
        delays["missed"].denominator[unknown] = 1.0
        quiet = [r.first(scores) for r, scores in zip(rules, cell.nominal, strict=True)]
        nulls = _from_known(quiet, cell.nominal, _drawn_starts(cell, starts))
        weights = _task_weights(cell, [i for i, start in enumerate(starts) if start != UNKNOWN])
        for name, contribution in delays.items():
            metrics[name] = _of_anomalous(cell, contribution)
            metrics[f"{name}_null"] = _of_nominal(cell, _weighted(nulls[name], weights))
        metrics["events_found"] = _of_anomalous(cell, _events(cell, rule))
    if cell.by_outcome:
        metrics |= _found_outcome(cell, rule, rules)
    return metrics


def _from_known(
    firsts: Sequence[int | None], episodes: Sequence[Floats], starts: Sequence[int]
) -> Metrics:
    """Return delays and shares of episodes with known starts; the others are undefined."""
    indices = [i for i, start in enumerate(starts) if start != UNKNOWN]
    lengths = [len(episodes[i]) for i in indices]
    metrics = from_starts(
        [firsts[i] for i in indices], lengths, lengths, [starts[i] for i in indices]
    )
    return {name: _spread(c, len(episodes), indices) for name, c in metrics.items()}


def _drawn_starts(cell: UnpairedScores, starts: Sequence[int]) -> list[int]:
    """Return a start for each nominal test episode, from the anomalous ones of its task in turn."""
    drawn = [UNKNOWN] * len(cell.nominal)
    for nominal, anomalous in cell.by_task():
        known_starts = [starts[i] for i in anomalous if starts[i] != UNKNOWN]
        for j, start in zip(nominal, itertools.cycle(known_starts), strict=False):
            drawn[j] = start
    return drawn


def _events(cell: UnpairedScores, rule: GuaranteedAlarm) -> Contribution:
    hits, events = np.zeros((2, len(cell.anomalous)))
    for i, (scores, intervals) in enumerate(zip(cell.anomalous, cell.intervals, strict=True)):
        begins = np.zeros(len(scores), dtype=bool)
        begins[beginnings(scores, rule)] = True
        events[i] = len(intervals)
        hits[i] = sum(begins[max(start, 0) : stop].any() for start, stop in intervals)
    return Contribution(hits, events)


def _found_outcome(
    cell: UnpairedScores, rule: GuaranteedAlarm, rules: Sequence[GuaranteedAlarm]
) -> Metrics:
    m, n = cell.sizes
    alarmed, quiet, times = np.full(n, np.nan), np.full(m, np.nan), np.full(n, np.nan)
    for nominal, failed, rows in _outcomes(cell):
        firsts = [rule.first(cell.anomalous[i][:rows]) for i in failed]
        alarmed[failed] = [first is not None for first in firsts]
        times[failed] = [rows if first is None else first for first in firsts]
        quiet[nominal] = [rules[j].first(cell.nominal[j][:rows]) is not None for j in nominal]
    weights = _task_weights(cell, cell.by_outcome)
    loud = _of_anomalous(cell, mean_of(alarmed))
    null = _of_nominal(cell, _weighted(mean_of(quiet), weights))
    return {
        "found_outcome": loud,
        "found_outcome_null": null,
        "balanced_outcome": _balanced(loud, null),
        "outcome_time": _of_anomalous(cell, mean_of(times)),
    }


def _balanced(loud: Contribution, null: Contribution) -> Contribution:
    """Return the mean of the share of failed episodes found and of nominal ones without alarm."""
    quiet = replace(null, numerator=null.denominator - null.numerator)
    value = (loud.value + quiet.value) / 2
    if math.isnan(value):
        return loud
    # As in `two_sample`: the denominators of both samples sum to the same, and each side's terms
    # are shifted to the value, so that resampling has the variance of the mean of both.
    total = loud.denominator.sum() + quiet.denominator.sum()
    terms = np.zeros((2, len(loud.numerator)))
    for side in (loud, quiet):
        shifted = side.numerator + (value - side.value) * side.denominator
        terms += np.array([shifted, side.denominator]) * (total / (2 * side.denominator.sum()))
    return Contribution(terms[0], terms[1], nominal=loud.nominal)


def _task_weights(cell: UnpairedScores, indices: Iterable[int]) -> Floats:
    """Return weights of nominal episodes that give tasks the shares of the anomalous `indices`."""
    # They are 1 where there is one task.
    weights, counts = np.zeros(len(cell.nominal)), {*indices}
    for nominal, anomalous in cell.by_task():
        weights[nominal] = len(counts & {*anomalous}) / len(nominal)
    counted = np.count_nonzero(weights)
    return weights * (counted / weights.sum()) if counted else weights


def _weighted(contribution: Contribution, weights: Floats) -> Contribution:
    return Contribution(contribution.numerator * weights, contribution.denominator * weights)


def row_metrics(
    cell: UnpairedScores, rule: GuaranteedAlarm | None, statistics: Sequence[Floats] = ()
) -> Metrics:
    """Return figures of published tables, over the anomalous episodes with intervals.

    Rows without a score are not judged. ``f1_rows``, ``far_rows`` and ``mar_rows`` pool the rows of
    all episodes; ``vus_pr`` is the mean of theirs, see `volume_under_pr`.

    Parameters
    ----------
    cell
        The scores.
    rule
        The alarms; None leaves out all but ``vus_pr``.
    statistics
        What alarms of anomalous episodes are of, if not their scores.

    Returns
    -------
    dict
        Metrics by name; empty without intervals.
    """
    n = len(cell.anomalous)
    counts, volumes = np.zeros((2, 2, n)), np.full(n, np.nan)  # counts by truth and alarm
    for i in cell.labelled:
        scores = cell.anomalous[i]
        judged, truth = ~np.isnan(scores), anomalous_rows(cell.intervals[i], len(scores))
        volumes[i] = volume_under_pr(scores[judged], truth[judged])
        if rule:
            alarms = rule.statistic(statistics[i] if statistics else scores) > rule.threshold
            np.add.at(counts[:, :, i], (truth[judged].astype(int), alarms[judged].astype(int)), 1)
    metrics = {"vus_pr": mean_of(volumes)} if cell.labelled else {}
    if rule and cell.labelled:
        (quiet, false), (missed, hit) = counts
        metrics |= {
            "f1_rows": Contribution(2 * hit, 2 * hit + false + missed),
            "far_rows": Contribution(false, false + quiet),
            "mar_rows": Contribution(missed, missed + hit),
        }
    return {name: _of_anomalous(cell, contribution) for name, contribution in metrics.items()}


def volume_under_pr(scores: Floats, anomalous: Mask, buffer: int = BUFFER) -> float:
    """Return VUS-PR of one episode: the area under precision and recall, buffers around intervals.

    It is that of TSB-AD (Liu & Paparrizos, NeurIPS 2024; Paparrizos et al., PVLDB 15, 2022): the
    mean over buffers of 0 to `buffer` rows in all, half of them on each side, in which labels fall
    off as a square root; recall is multiplied by the share of intervals that are touched. It takes
    ``buffer`` passes over the rows, after one sort.

    Parameters
    ----------
    scores
        One a row, all defined.
    anomalous
        Whether each row is.
    buffer
        Rows of the widest buffer.

    Returns
    -------
    float
        In [0, 1]; NaN unless there are rows of both kinds.
    """
    if anomalous.all() or not anomalous.any():
        return float("nan")
    edges = np.flatnonzero(np.diff(np.concatenate([[False], anomalous, [False]]).astype(np.int8)))
    starts, ends = edges[0::2], edges[1::2] - 1
    ordered = np.sort(scores)
    at = np.linspace(0, len(scores) - 1, THRESHOLDS).astype(int)
    levels = ordered[::-1][at]
    alarmed = len(scores) - np.searchsorted(ordered, levels, side="left")
    order = np.argsort(-scores, kind="stable")
    hits = np.cumsum(anomalous[order])[alarmed - 1].astype(np.float64)
    areas = [
        _area(scores, order, alarmed, levels, hits, _buffered(anomalous, starts, ends, width))
        for width in range(buffer + 1)
    ]
    return float(np.mean(areas))


class _Buffered(NamedTuple):
    """Labels in the buffers alone, and the first and last row of each run of buffered intervals."""

    labels: Floats
    runs: list[tuple[int, int]]
    rows: int


def _buffered(anomalous: Mask, starts: Indices, ends: Indices, width: int) -> _Buffered:
    """Return labels that fall off over half a width on each side of the intervals."""
    rows, half = len(anomalous), width // 2
    labels = np.zeros(rows)
    for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
        after = np.arange(end + 1, min(end + half + 1, rows))
        before = np.arange(max(start - half, 0), start)
        labels[after] += np.sqrt(1 - (after - end) / max(width, 1))
        labels[before] += np.sqrt(1 - (start - before) / max(width, 1))
    labels = np.where(anomalous, 0.0, np.minimum(labels, 1.0))
    apart = np.flatnonzero(ends[:-1] + half < starts[1:] - half)
    firsts = [max(int(starts[0]) - half, 0), *(int(starts[k + 1]) - half for k in apart)]
    lasts = [*(int(ends[k]) + half for k in apart), min(int(ends[-1]) + half, rows - 1)]
    return _Buffered(labels, list(zip(firsts, lasts, strict=True)), int(anomalous.sum()))


def _area(
    scores: Floats,
    order: Indices,
    alarmed: Indices,
    levels: Floats,
    hits: Floats,
    buffered: _Buffered,
) -> float:
    """Return the area under precision and recall at one width of the buffers."""
    near = np.cumsum(buffered.labels[order])[alarmed - 1]
    highest = np.sort([scores[first : last + 1].max() for first, last in buffered.runs])
    touched = (len(highest) - np.searchsorted(highest, levels, side="left")) / len(highest)
    recall = np.minimum((hits + near) / (buffered.rows + near / 2), 1.0) * touched
    precision = (hits + near) / alarmed
    return float(np.dot(np.diff(recall, prepend=0.0), precision))


def _of_nominal(cell: UnpairedScores, contribution: Contribution) -> Contribution:
    """Return terms of nominal test episodes as those of both samples."""
    m, n = cell.sizes
    return replace(_spread(contribution, m + n, range(m)), nominal=m)


def _of_anomalous(cell: UnpairedScores, contribution: Contribution) -> Contribution:
    """Return terms of anomalous episodes as those of both samples."""
    m, n = cell.sizes
    return replace(_spread(contribution, m + n, range(m, m + n)), nominal=m)


def _spread(contribution: Contribution, size: int, at: Sequence[int]) -> Contribution:
    """Return terms at some of so many indices, 0 / 0 at the others."""
    numerator, denominator = np.zeros((2, size))
    indices = np.array(at, np.intp)
    numerator[indices], denominator[indices] = contribution.numerator, contribution.denominator
    return Contribution(numerator, denominator)
