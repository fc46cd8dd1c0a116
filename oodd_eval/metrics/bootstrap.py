"""Intervals from one bootstrap over test trajectories, paired where shared.

One weight matrix says how often each test trajectory is drawn in each resample. All anomalies and
detectors of an environment use the same one, so that differences between them are paired. Sums are
taken in a fixed order, without a matrix library, so that an interval does not depend on what is
computed beside it.

Without twins, nominal and anomalous episodes are drawn apart: nominal ones with weights that all
cells of an environment share, anomalous ones with those of the environment and the condition.

Percentiles of the resamples are corrected for bias, skewness and few trajectories, see `bounds`.
Shares that no trajectory contradicts (all 0 or all 1), for which resamples say nothing, and the
share of nominal episodes with an alarm have exact binomial intervals (`metrics.binomial`).
"""

import functools
import itertools
import math
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from oodd_eval.metrics.auc import Contribution
from oodd_eval.metrics.binomial import clopper_pearson, t_quantile
from oodd_eval.metrics.catalogue import IntervalKind

RESAMPLES: Final = 2000
LEVEL: Final = 0.95

Weights = NDArray[np.float64]
Floats = NDArray[np.float64]
Samples = NDArray[np.float64]  # A number in every resample: shape (R,), NaN where it is undefined

_NORMAL: Final = NormalDist()

_DIGITS: Final = 4  # of an end to which draws of the calibration have added

_NOISE: Final = 1e-12  # relative difference that is taken for rounding


def bootstrap_weights(n: int, *, key: str = "", resamples: int = RESAMPLES) -> Weights:
    """Return counts of each of n trajectories in each resample: shape (resamples, n).

    The same key, such as an environment, gives the same weights, and so the same intervals.
    """
    if not n:
        return np.zeros((resamples, 0))
    rng = np.random.default_rng([0, zlib.crc32(key.encode()), n])
    # In this order sums over trajectories take half as long.
    return rng.multinomial(n, np.full(n, 1 / n), size=resamples).astype(np.float64, order="F")


@functools.lru_cache(maxsize=64)
def shared_weights(key: str, n: int) -> Weights:
    """Return the weights of n test trajectories of an environment, kept for the next cell."""
    weights = bootstrap_weights(n, key=key)
    weights.setflags(write=False)
    return weights


def resampled(contribution: Contribution, weights: Weights) -> Samples:
    """Return a metric in every resample; NaN where its denominator is 0."""
    if contribution.median:
        return _medians(contribution, weights)
    numerator: Samples = np.einsum("rn,n->r", weights, contribution.numerator)
    return numerator / _total(contribution.denominator, weights)


def cell_samples(environment: str, contribution: Contribution, condition: str = "") -> Samples:
    """Return the resamples of one cell, with the weights that its environment shares.

    The condition decides how anomalous episodes without twins are drawn.
    """
    n, m = len(contribution.numerator), contribution.nominal
    if m is None:
        return resampled(contribution, shared_weights(environment, n))
    numerator, denominator = (
        _drawn(terms[:m], shared_weights(environment, m))
        + _drawn(terms[m:], shared_weights(f"{environment}/{condition}", n - m))
        for terms in (contribution.numerator, contribution.denominator)
    )
    return np.divide(numerator, np.where(denominator > 0, denominator, np.nan))


def _drawn(terms: Floats, weights: Weights) -> Samples:
    """Return a sum of terms in every resample; those of none, or all 0, need no weights."""
    if not terms.any():
        return np.zeros(len(weights))
    drawn: Samples = np.einsum("rn,n->r", weights, terms)
    return drawn


def _total(denominator: Floats, weights: Weights) -> Samples:
    """Return a denominator in every resample, NaN for 0."""
    total = np.einsum("rn,n->r", weights, denominator)
    return np.where(total > 0, total, np.nan)


def _medians(contribution: Contribution, weights: Weights) -> Samples:
    """Return the median in every resample: the mean of the two middle ones among even numbers."""
    indices = np.flatnonzero(contribution.denominator)
    indices = indices[np.argsort(contribution.numerator[indices], kind="stable")]
    drawn = np.cumsum(weights.T[indices], axis=0)
    total = drawn[-1] if indices.size else np.zeros(len(weights))
    # The k-th of all that are drawn, from 0, is the first with more than k up to it.
    low, high = ((drawn <= k).sum(axis=0) for k in ((total - 1) // 2, total // 2))
    ordered = np.append(contribution.numerator[indices], np.nan)  # with none drawn, k is beyond
    return np.asarray((ordered[low] + ordered[high]) / 2)


class CellSum(NamedTuple):
    """The sum of a metric over some cells of a detector seed in every resample."""

    seed: int
    samples: Samples
    cells: int


@dataclass(frozen=True, eq=False)
class DrawnCells:
    """A metric of cells of one environment, which share its weights.

    Attributes
    ----------
    environment, seeds
        The environment, and the detector seed of each cell.
    numerators, denominators
        Terms of shape (cells, n), see `Contribution`.
    median
        Whether values are medians; then denominators are 1 or 0.
    nominal
        Number of nominal test episodes that terms begin with; None where episodes have twins.
    condition
        That of all of these cells, where episodes have no twins.
    deviations
        Of each cell's value in the resamples of calibration episodes, see `Contribution`.
    """

    environment: str
    seeds: Sequence[int]
    numerators: Floats
    denominators: Floats
    median: bool = False
    nominal: int | None = None
    condition: str = ""
    deviations: Sequence[Floats] = ()

    @functools.cached_property
    def values(self) -> list[float]:
        """The metric of each cell, NaN where it is undefined."""
        if self.median:
            terms = zip(self.numerators, self.denominators, strict=True)
            return [Contribution(*both, self.median).value for both in terms]
        totals = self.denominators.sum(axis=1)
        values: list[float] = (
            self.numerators.sum(axis=1) / np.where(totals == 0, np.nan, totals)
        ).tolist()
        return values

    @property
    def sizes(self) -> list[int]:
        """The number of trajectories that contribute to each cell, of the smaller of two samples.

        A sample of which no cell has a term is none.
        """
        samples = [np.count_nonzero(s, axis=1) for s in self._samples if s.any()]
        sizes: list[int] = np.min(samples or [np.zeros(len(self.seeds), int)], axis=0).tolist()
        return sizes

    @property
    def _samples(self) -> list[Floats]:
        """Denominators of each sample."""
        if self.nominal is None:
            return [self.denominators]
        return [self.denominators[:, : self.nominal], self.denominators[:, self.nominal :]]

    @property
    def compared(self) -> bool:
        """True where the metric compares nominal with anomalous episodes."""
        return len(self._samples) > 1 and all(s.any() for s in self._samples)

    @property
    def sample(self) -> tuple[str, str]:
        """Name of the sample whose sizes count: cells of one name have the same episodes.

        Nominal episodes are the same under all conditions.
        """
        anomalous = self.nominal is not None and self._samples[1].any()
        return self.environment, self.condition if anomalous else ""

    def only(self, cells: Sequence[int]) -> "DrawnCells":
        """Return the cells at some indices."""
        seeds = [self.seeds[i] for i in cells]
        terms = self.numerators[list(cells)], self.denominators[list(cells)]
        deviations = [self.deviations[i] for i in cells] if self.deviations else ()
        return replace(
            self, seeds=seeds, numerators=terms[0], denominators=terms[1], deviations=deviations
        )

    @functools.cached_property
    def sums(self) -> list[CellSum]:
        """Sums over cells of each seed in every resample.

        Ratios with the same denominators are added before they are resampled: many metrics have
        those of all anomalies in common.
        """
        groups: dict[object, list[int]] = {}
        for i, seed in enumerate(self.seeds):
            key = i if self.median else (seed, self.denominators[i].tobytes())
            groups.setdefault(key, []).append(i)
        added = np.array([self.numerators[cells].sum(axis=0) for cells in groups.values()])
        sums = []
        for numerator, cells in zip(added, groups.values(), strict=True):
            terms = Contribution(
                numerator, self.denominators[cells[0]], self.median, nominal=self.nominal
            )
            samples = cell_samples(self.environment, terms, self.condition)
            sums.append(CellSum(self.seeds[cells[0]], samples, len(cells)))
        return sums


def drawn_cell(
    environment: str, seed: int, contribution: Contribution, condition: str = ""
) -> DrawnCells:
    """Return one cell of a detector seed; the condition matters where episodes have no twins."""
    terms = np.array([[contribution.numerator], [contribution.denominator]])
    terms, nominal = sums_of_recordings(terms, contribution.nominal, contribution.recordings)
    median, deviations = contribution.median, [contribution.deviations]
    both = terms[0], terms[1]
    return DrawnCells(environment, [seed], *both, median, nominal, condition, deviations)


def sums_of_recordings(
    terms: Floats, nominal: int | None, recordings: Sequence[int]
) -> tuple[Floats, int | None]:
    """Return the sums of terms over the windows of each recording, which is drawn as one.

    Parameters
    ----------
    terms
        Shape (..., n), those of nominal test episodes first.
    nominal
        The number of these; None where episodes have twins.
    recordings
        See `Contribution`.

    Returns
    -------
    tuple
        Sums of shape (..., recordings), and the number of those that are nominal. Windows of a
        sample's only recording stay: it says nothing of others.
    """
    if nominal is None or not recordings:
        return terms, nominal
    sums = []
    for part in (slice(nominal), slice(nominal, None)):
        present, unit = np.unique(np.array(recordings[part], np.intp), return_inverse=True)
        if len(present) == 1:
            present = unit = np.arange(len(unit))
        order = np.argsort(unit, kind="stable")
        starts = np.flatnonzero(np.diff(unit[order], prepend=-1))
        sums.append(np.add.reduceat(terms[..., part][..., order], starts, axis=-1))
    return np.concatenate(sums, axis=-1), sums[0].shape[-1]


def mean_interval(cells: Sequence[DrawnCells], *, kind: IntervalKind) -> tuple[float, float]:
    """Return the 95 % interval of a mean over those of one detector's cells that define the metric.

    Kind ``"mean"``: see `bounds`. ``"share"``: the same, but where all trajectories are at one end
    of [0, 1], the exact interval for that many trajectories. ``"exact"``: a share of nominal
    twins, which are the same for all anomalies of an environment, with its exact interval.
    ``"count"``: a number of events over a time; where there are none, Poisson's exact interval.

    The exact interval of a share that is 0 everywhere holds for any independent trajectories of
    several environments with values in [0, 1]: with means p_i the chance of none is at most the
    product of 1 - p_i, which is at most (1 - p) ** n with p their mean.

    Where nominal and anomalous episodes are two samples the smaller one counts, and the terms of an
    AUC may leave its range in a resample, so that the ends of a share are clipped to [0, 1].

    Where the calibration episodes decide the metric, too, their noise is added: the distances of
    the ends from the value, which are independent, as squares (Zou & Donner, Stat. Med. 27, 2008).
    """
    sizes: dict[tuple[str, str], int] = {}
    for c in cells:
        for n in filter(None, c.sizes):
            sizes[c.sample] = min(sizes.get(c.sample, n), n)
    if not sizes:
        return math.nan, math.nan
    value = mean_over_cells(pair for c in cells for pair in zip(c.seeds, c.values, strict=True))
    low, high = _of_test_seeds(cells, kind, value, sizes)
    below, above = _of_calibration(cells)
    if below or above:
        low, high = (
            float(f"{end:.{_DIGITS}g}")
            for end in (
                value - math.hypot(value - low, below),
                value + math.hypot(high - value, above),
            )
        )
        # A rounded end may have come past the value.
        low, high = max(min(low, value), 0.0), max(high, value)
        return low, high if kind in ("mean", "count") else min(high, 1.0)
    return low, high


def _of_test_seeds(
    cells: Sequence[DrawnCells],
    kind: IntervalKind,
    value: float,
    sizes: Mapping[tuple[str, str], int],
) -> tuple[float, float]:
    """Return the interval that the choice of test trajectories gives."""
    if kind == "exact":
        low, high = _exact(cells)
        # The mean over cells and the share of all twins differ where environments do in size.
        return min(low, value), max(high, value)
    if kind == "count" and not value:
        return 0.0, _most_events(cells)
    if kind == "share" and value in (0.0, 1.0):
        total = _trials(cells, sizes)
        return clopper_pearson(value * total, total, LEVEL)
    low, high = bounds(sample_cells(cells), value, list(sizes.values()))
    if kind == "share" and any(c.nominal is not None for c in cells):
        return max(low, 0.0), min(high, 1.0)
    return low, high


def _of_calibration(cells: Sequence[DrawnCells]) -> tuple[float, float]:
    """Return how far calibration noise goes below a mean over cells (negative) and above it."""
    if not any(changes.size for c in cells for changes in c.deviations):
        return 0.0, 0.0
    changes = np.sort(calibration_samples(cells))
    low, high = (_percentile(changes, (1 + side * LEVEL) / 2) for side in (-1, 1))
    return min(low, 0.0), max(high, 0.0)


def calibration_samples(cells: Sequence[DrawnCells]) -> Samples:
    """Return by how much calibration changes a mean over cells in every resample.

    Cells of one environment share the draws; environments are drawn apart. Those of one alone are
    its draws as they are.
    """
    defined: dict[int, int] = {}
    for c in cells:
        for seed, value in zip(c.seeds, c.values, strict=True):
            defined[seed] = defined.get(seed, 0) + (not math.isnan(value))
    seeds = sum(n > 0 for n in defined.values())
    totals: dict[tuple[str, int], Floats] = {}
    for c in cells:
        for seed, value, change in zip(c.seeds, c.values, c.deviations, strict=False):
            if change.size and not math.isnan(value):
                key = c.environment, len(change)
                part = change / (seeds * defined[seed])
                totals[key] = totals.get(key, np.zeros(len(part))) + part
    if len(totals) < 2:
        return next(iter(totals.values()), np.zeros(1))
    samples = np.zeros(RESAMPLES)
    for (environment, draws), total in totals.items():
        samples += total[calibration_draws(environment, draws, RESAMPLES)]
    return samples


@functools.lru_cache(maxsize=128)
def calibration_draws(environment: str, draws: int, resamples: int) -> NDArray[np.intp]:
    """Return which resample of an environment's calibration episodes each resample takes.

    Each is taken as often as any other: shape (resamples,).
    """
    rng = np.random.default_rng([zlib.crc32(f"draws of {environment}".encode()), draws])
    order = rng.permutation(resamples) % draws
    order.setflags(write=False)
    return order


def _trials(cells: Sequence[DrawnCells], sizes: Mapping[tuple[str, str], int]) -> int:
    """Return the number of independent trajectories behind some cells."""
    # Where all conditions of an environment are compared with the same nominal episodes, there are
    # no more than of these.
    totals: dict[str, int] = {}
    for (environment, _), n in sizes.items():
        totals[environment] = totals.get(environment, 0) + n
    for c in cells:
        if c.nominal is not None and c.compared and c.environment in totals:
            totals[c.environment] = min(totals[c.environment], c.nominal)
    return sum(totals.values())


def bounds(values: Samples, value: float, sizes: Sequence[int]) -> tuple[float, float]:
    """Return the 95 % interval of a number from its resamples, NaN left out, and its value.

    The percentiles are those of the bias-corrected accelerated bootstrap (BCa; Efron, J. Am. Stat.
    Assoc. 82, 1987), with two changes. Its acceleration is a sixth of the skewness of the
    resamples, which for means is what the jackknife gives and needs nothing but resamples. And
    its normal quantile is widened as Student's interval of a mean is: resamples spread as if the
    variance were divided by n, not n - 1 (Hesterberg, Am. Stat. 69, 2015). `sizes` are the numbers
    of trajectories in the environments that it is a mean over.
    """
    undefined = np.isnan(values)
    defined = values[~undefined] if undefined.any() else values
    if not defined.size:
        return math.nan, math.nan
    near = _NOISE * max(1.0, abs(value))
    deviations = defined - defined.mean()
    spread = float(np.sqrt(np.mean(deviations**2)))
    if spread <= near:
        return value, value
    deviations /= spread
    acceleration = float(np.mean(deviations * deviations * deviations)) / 6
    below = np.count_nonzero(defined < value - near)
    equal = np.count_nonzero(np.abs(defined - value) <= near)
    # Neither end: the normal quantile of 0 or 1 is infinite.
    share = (below + equal / 2 + 0.5) / (defined.size + 1)
    bias = _NORMAL.inv_cdf(share)
    width = _quantile(tuple(sizes))
    ordered = np.sort(defined)
    low, high = (
        _percentile(ordered, _corrected(side * width, bias, acceleration)) for side in (-1, 1)
    )
    # A value may lie outside where a mean of ratios is undefined in some resamples.
    return min(low, value), max(high, value)


def _percentile(ordered: Samples, share: float) -> float:
    """Return a percentile as NumPy's default does, which takes longer for a few thousand values."""
    rank = share * (len(ordered) - 1)
    first = min(int(rank), len(ordered) - 1)
    low, high = ordered[first], ordered[min(first + 1, len(ordered) - 1)]
    return float(low + (rank - first) * (high - low))


def _corrected(quantile: float, bias: float, acceleration: float) -> float:
    shifted = bias + quantile
    stretch = 1 - acceleration * shifted
    if stretch <= 0:
        return float(quantile > 0)
    return _NORMAL.cdf(bias + shifted / stretch)


@functools.lru_cache(maxsize=256)
def _quantile(sizes: tuple[int, ...]) -> float:
    """Return the number of standard errors of the resamples that an interval extends."""
    several = [n for n in sizes if n > 1]
    if not several:
        return _NORMAL.inv_cdf((1 + LEVEL) / 2)
    freedom = sum(n - 1 for n in several)
    return t_quantile((1 + LEVEL) / 2, freedom) * math.sqrt(sum(several) / freedom)


def _most_events(cells: Sequence[DrawnCells]) -> float:
    """Return the upper end of a mean rate over environments, none of which had an event."""
    times: dict[str, float] = {}
    for c in cells:
        for time in filter(None, c.denominators.sum(axis=1).tolist()):
            times[c.environment] = min(times.get(c.environment, time), time)
    # With rates r over times t the chance of no event is exp(-sum(r t)).
    return -math.log((1 - LEVEL) / 2) / (len(times) * min(times.values()))


def _exact(cells: Sequence[DrawnCells]) -> tuple[float, float]:
    """Count every twin of an environment once, and average over detector seeds."""
    counts: dict[str, dict[int, tuple[float, float]]] = {}
    for c in cells:
        terms = (x.sum(axis=1).tolist() for x in (c.numerators, c.denominators))
        for seed, size, *both in zip(c.seeds, c.sizes, *terms, strict=True):
            if size:
                # Windows of one recording count as one, with the share that alarms.
                counts.setdefault(c.environment, {})[seed] = both[0] * (size / both[1]), float(size)
    alarmed, episodes = (
        math.fsum(sum(pair[i] for pair in seeds.values()) / len(seeds) for seeds in counts.values())
        for i in (0, 1)
    )
    return clopper_pearson(alarmed, episodes, LEVEL)


def nan_mean(values: Iterable[float]) -> float:
    """Return the mean of the values that are not NaN; NaN without any."""
    defined = [v for v in values if not math.isnan(v)]
    return math.fsum(defined) / len(defined) if defined else math.nan


def mean_over_cells(values: Iterable[tuple[int, float]]) -> float:
    """Return the mean of a metric over cells where it is defined, given as detector seed and value.

    It is the mean that `sample_cells` resamples: over seeds, of each seed's mean over its cells.
    """
    by_seed: dict[int, list[float]] = {}
    for seed, value in values:
        by_seed.setdefault(seed, []).append(value)
    return nan_mean(map(nan_mean, by_seed.values()))


def mean_samples(parts: Sequence[Samples]) -> Samples:
    """Return the mean of several numbers in every resample, over those that are defined there."""
    if len(parts) == 1:
        return parts[0]
    stacked = np.array(parts)
    total: Samples = stacked.sum(axis=0)
    if not np.isnan(total).any():
        return np.divide(total, len(stacked))
    defined = ~np.isnan(stacked)
    count = defined.sum(axis=0)
    total = np.where(defined, stacked, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def sample_cells(cells: Sequence[DrawnCells]) -> Samples:
    """Return the resamples of a mean over at least one cell; a seed's mean is over its own cells.

    Test trajectories are resampled, the same ones in all cells of an environment; detector seeds
    are fixed. Differences, sums and `mean_samples` of what this returns for several detectors or
    anomalies are paired.
    """
    by_seed: dict[int, list[CellSum]] = {}
    for cell_sum in itertools.chain.from_iterable(c.sums for c in cells):
        by_seed.setdefault(cell_sum.seed, []).append(cell_sum)
    return mean_samples([_mean_of(by_seed[seed]) for seed in sorted(by_seed)])


def _mean_of(sums: Sequence[CellSum]) -> Samples:
    """Return the mean over cells in every resample."""
    if len(sums) == 1:  # the interval of a cell, of which there are tens of thousands
        return sums[0].samples / sums[0].cells
    total, count = np.zeros((2, len(sums[0].samples)))
    for _, samples, cells in sums:
        undefined = np.isnan(samples)
        if undefined.any():
            total += np.where(undefined, 0.0, samples)
            count += np.where(undefined, 0, cells)
        else:
            total += samples
            count += cells
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
