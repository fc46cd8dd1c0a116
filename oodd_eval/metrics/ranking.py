"""Ranks, ties and win rates of the rows of one table.

A row is better than another when the paired bootstrap over test seeds says so after Holm's
correction. Ranks count the primary rows that are better: one row a detector, so that variants of
one detector push nobody down. Primary rows that share a tie group cannot be told apart.

Rows are given as the numerators and denominators of a metric, per detector seed and cell. Higher
is better. They are tested by the influences of test seeds on their means: all pairs share the draws
of test seeds. Matrix libraries differ in the last bits between machines, so that a count of
resamples takes what is equal up to rounding as equal.
"""

import itertools
import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from oodd_eval.errors import ResultsError
from oodd_eval.metrics.auc import Contribution
from oodd_eval.metrics.binomial import incomplete_beta
from oodd_eval.metrics.bootstrap import bootstrap_weights, bounds, calibration_draws

ALPHA: Final = 0.05
"""Highest chance that a table calls any row better that is not (family-wise error rate)."""

MIN_RESAMPLES: Final = 10_000  # least number of bootstrap resamples
MOST_RESAMPLES: Final = 30_000
RESAMPLES_PER_PAIR: Final = 50  # no counted p-value is below 1 / (R + 1): R grows with the pairs
ENOUGH: Final = 100  # resamples beyond the difference that a counted p-value has where R is bounded
NOISE: Final = 1e-12  # larger differences are no rounding: equal rows are equal anywhere
DETECTOR_SEEDS: Final = "detector seeds"  # source of noise that a row's detector seeds are

_BLOCK: Final = 1024  # resamples at a time
_ROUNDING: Final = 1e-9  # relative; statistics that differ by less are equal

Floats = NDArray[np.float64]
Position = tuple[str, str]  # environment and anomaly; cells of one environment share resamples
Row = Mapping[int, Mapping[Position, Contribution]]  # by detector seed and cell


@dataclass(frozen=True, slots=True)
class PairTest:
    """The test of one ordered pair of rows: whether the first is better than the second.

    Attributes
    ----------
    first, second
        Names of the rows.
    difference, low, high
        Of the first's mean over all cells to the second's, with its paired 95 % interval.
    p, p_holm
        One-sided p-value of "not better", and the same after Holm's correction.
    """

    first: str
    second: str
    difference: float
    low: float
    high: float
    p: float
    p_holm: float

    @property
    def better(self) -> bool:
        """True when the first row is significantly better than the second."""
        return self.p_holm <= ALPHA


@dataclass(frozen=True, slots=True)
class Ranking:
    """Ranked rows of one table.

    Attributes
    ----------
    ranks
        By row, best first: 1 + the number of primary rows that are significantly better.
    groups
        Tie groups of primary rows.
    comparisons
        Tests of all ordered pairs with a primary row.
    resamples
        Number of bootstrap resamples.
    """

    ranks: dict[str, int]
    groups: list[tuple[str, ...]]
    comparisons: list[PairTest]
    resamples: int

    def letters(self, row: str) -> str:
        """Return the letters of the tie groups that a row shares with others, such as ``"ab"``."""
        shared = [group for group in self.groups if len(group) > 1]
        return "".join(_letter(i) for i, group in enumerate(shared) if row in group)


def rank(
    rows: Mapping[str, Row], primary: Collection[str] | None = None, *, resamples: int | None = None
) -> Ranking:
    """Rank the rows of one table, in the same way for any order of rows, seeds and cells.

    Parameters
    ----------
    rows
        By name.
    primary
        Names of the rows that push others down; None means all. The other rows are variants, which
        are compared with primary rows only.
    resamples
        Number of bootstrap resamples R; by default 50 per ordered pair, at least 10 000 and at most
        30 000.

    Returns
    -------
    Ranking

    Raises
    ------
    ResultsError
        When rows differ in cells or in the number of test trajectories, or a cell has no value.

    Notes
    -----
    With d the difference of two rows' means over cells and s its standard error, the one-sided
    p-value of "not better" is ``(1 + k) / (R + 1)``, where k counts the resamples in which
    ``(d* - d) / s*`` is at least ``d / s``: the studentized bootstrap (Davison & Hinkley 1997,
    section 4.4). Counting the resamples with ``d* <= 0`` instead calls equal detectors different in
    one table out of six when there is one environment with ten test seeds. No p-value is below
    ``2 ** -N`` with N test seeds in all environments together: if neither row is better, each
    seed's difference might as well have the other sign.

    Holm's correction for the pairs of many rows needs smaller p-values than 30 000 resamples can
    count. With more than 24 primary rows, one of fewer than 100 resamples is extrapolated from
    the 1000th and the 100th largest ``(d* - d) / s*`` along the tail of Student's t distribution.

    Holm's correction is over all ordered pairs of primary rows. A variant's tests are corrected as
    if it were the one further primary row, so that its rank is the one that it would have.

    Test seeds are drawn jointly for all rows and anomalies of an environment, so that differences
    are paired. Several detector seeds of a row are drawn, too, independently of other rows, and
    where terms say what the calibration episodes change, so are these, jointly as test seeds are.
    The sources of noise are added.
    """
    names = sorted(rows)
    _check_shape(rows)
    first = [name for name in names if primary is None or name in primary]
    variants = [name for name in names if name not in first]
    pairs = math.comb(len(first), 2) + (len(first) if variants else 0)
    expected = resamples or max(MIN_RESAMPLES, RESAMPLES_PER_PAIR * 2 * pairs)
    count = min(expected, max(MOST_RESAMPLES, resamples or 0))
    means = {name: _mean(rows[name]) for name in names}
    used = _used(rows)
    bootstrap = _PairBootstrap(
        {name: _influences(name, rows[name], used) for name in names},
        count,
        extended=expected > count,
    )

    def tests(name: str, other_names: Sequence[str]) -> list[PairTest]:
        results = []
        differences = np.array([means[name] - means[other] for other in other_names])
        tested = bootstrap.test(name, other_names, differences) if other_names else []
        for other, d, t in zip(other_names, differences.tolist(), tested, strict=True):
            results.append(PairTest(name, other, d, t.low, t.high, t.p, math.nan))
            results.append(PairTest(other, name, -d, -t.high, -t.low, t.p_reverse, math.nan))
        return results

    among = [test for i, name in enumerate(first) for test in tests(name, first[i + 1 :])]
    comparisons = _corrected(among, [])
    for name in variants:
        comparisons += _corrected(tests(name, first), among)
    better = {(c.first, c.second) for c in comparisons if c.better}
    ranks = {name: 1 + sum((other, name) in better for other in first) for name in names}
    order = sorted(names, key=lambda name: (ranks[name], -means[name], name))
    ranks = {name: ranks[name] for name in order}
    apart = {pair for pair in better if pair[0] in first and pair[1] in first}
    groups = tie_groups([name for name in order if name in first], apart)
    return Ranking(ranks, groups, comparisons, count)


class _Influences(NamedTuple):
    """Shifts of a row's mean by each test seed and each detector seed, centred on 0."""

    # `of_tests` is by sample, see `_samples`; `of_detectors` is empty where there is one detector
    # seed, and `key` names the draws of these. `of_calibrations` is by environment, empty for
    # metrics that calibration does not change.

    of_tests: Mapping[str, Floats]
    of_detectors: Floats
    key: str
    of_calibrations: Mapping[str, Floats]


class _Tested(NamedTuple):
    """The 95 % interval of a difference, and the p-values of "not better" and of "not worse"."""

    low: float
    high: float
    p: float
    p_reverse: float


class _PairBootstrap:
    """The bootstrap of pairs of rows with R resamples."""

    # Where it is `extended`, p-values that are too small to be counted follow Student's tail.

    def __init__(
        self, rows: Mapping[str, _Influences], resamples: int, *, extended: bool = False
    ) -> None:
        self.resamples, self.extended = resamples, extended
        self._index = {name: i for i, name in enumerate(rows)}
        self._rows = list(rows.values())
        shared = self._rows[0].of_tests if rows else {}
        self._sizes = {sample: z.size for sample, z in shared.items()}
        ends = itertools.accumulate(self._sizes.values(), initial=0)
        self._columns = [slice(*both) for both in itertools.pairwise(ends)]
        self._n = np.repeat([*self._sizes.values()], [*self._sizes.values()])
        self._influences = np.array([np.concatenate([*r.of_tests.values()]) for r in self._rows])
        self._drawn = np.concatenate(
            [np.zeros((0, resamples)), *(_draws(e, n, resamples) for e, n in self._sizes.items())]
        )
        # Sums are taken in a fixed order, so that an interval depends on its two rows alone.
        self._shifts = np.zeros((len(rows), resamples))
        self._variances = np.zeros((len(rows), resamples))
        calibrated = any(row.of_calibrations for row in self._rows)
        self._calibrations = np.zeros((len(rows), resamples if calibrated else 0))
        for i, row in enumerate(self._rows):
            self._shifts[i] = np.einsum("n,nr->r", self._influences[i] / self._n, self._drawn)
            if n := row.of_detectors.size:
                drawn = _draws(row.key, n, resamples)
                mean = np.einsum("n,nr->r", row.of_detectors, drawn) / n
                square = np.einsum("n,nr->r", row.of_detectors**2, drawn) / n
                self._shifts[i] += mean
                self._variances[i] = np.maximum(square - mean * mean, 0.0) / (n - 1)
            for environment, changes in row.of_calibrations.items():
                taken = calibration_draws(environment, len(changes), resamples)
                self._calibrations[i] += changes[taken]
            if calibrated:
                self._shifts[i] += self._calibrations[i]

    def test(self, name: str, other_names: Sequence[str], differences: Floats) -> list[_Tested]:
        """Test a row against other rows, given the differences of its mean to theirs."""
        row, columns = self._index[name], np.array([self._index[other] for other in other_names])
        effects = self._influences[row] - self._influences[columns]
        # Rounding alone must not look like a difference between seeds.
        effects = np.where(np.abs(effects) > NOISE, effects, 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            observed = differences / np.sqrt(self._observed_variances(row, columns, effects))
        observed = np.where(np.abs(differences) > NOISE, observed, 0.0)
        # These products are small: threads of a matrix library would wait for one another.
        with threadpool_limits(1, user_api="blas"):
            studentized = self._studentized(row, columns, effects)
        signs, sizes = np.sign(observed)[:, None], np.abs(observed)[:, None]
        studentized = np.where(signs < 0, -studentized, studentized)
        # A resample at the observed difference is beyond it for both sides.
        beyond = np.count_nonzero(studentized >= sizes * (1 - _ROUNDING), axis=1)
        within = np.count_nonzero(~(studentized >= sizes * (1 + _ROUNDING)), axis=1)
        counts = np.where(observed == 0, self.resamples, [beyond, within])
        p = (1 + counts) / (self.resamples + 1)
        if self.extended:
            for rare in np.flatnonzero(counts[0] < ENOUGH):
                p[0, rare] = self._extended(studentized[rare], abs(observed[rare]))
        # No p-value is below the chance that all seeds have the signs that they have.
        p = np.maximum(p, 2.0 ** -len(self._n))
        tests = []
        for i, (d, sides) in enumerate(zip(differences, p.T.tolist(), strict=True)):
            samples = d + (self._shifts[row] - self._shifts[columns[i]])
            low, high = bounds(samples, d, list(self._sizes.values()))
            tests.append(_Tested(low, high, *(sides if observed[i] >= 0 else sides[::-1])))
        return tests

    def _observed_variances(self, row: int, columns: NDArray[np.intp], effects: Floats) -> Floats:
        """Return the variances of differences; infinite where one test seed says nothing of it."""
        if 1 in self._sizes.values():
            return np.full(len(columns), np.inf)
        variances = np.zeros(len(columns))
        for n, part in zip(self._sizes.values(), self._columns, strict=True):
            variances += effects[:, part].var(axis=1) / (n - 1)
        for i, column in enumerate(columns):
            for z in (self._rows[row].of_detectors, self._rows[column].of_detectors):
                variances[i] += float(z.var()) / (z.size - 1) if z.size else 0.0
        return variances + self._of_calibrations(row, columns)

    def _of_calibrations(self, row: int, columns: NDArray[np.intp]) -> Floats:
        """Return the variances that the calibration episodes give to differences of a row."""
        if not self._calibrations.size:
            return np.zeros(len(columns))
        changes = self._calibrations
        return np.array([(changes[row] - changes[column]).var() for column in columns])

    def _studentized(self, row: int, columns: NDArray[np.intp], effects: Floats) -> Floats:
        """Return shifts over their standard errors in every resample: shape (columns, R)."""
        freedom = np.maximum(self._n - 1, 1)
        squares = effects**2 / (self._n * freedom)
        means = effects / (self._n * np.sqrt(freedom))
        studentized = np.empty((len(columns), self.resamples))
        of_calibrations = self._of_calibrations(row, columns)[:, None]
        for start in range(0, self.resamples, _BLOCK):
            block = slice(start, start + _BLOCK)
            variances = squares @ self._drawn[:, block]
            for part in self._columns:
                mean = means[:, part] @ self._drawn[part, block]
                mean *= mean
                variances -= mean
            variances = np.maximum(variances, 0.0)
            variances += self._variances[row, block] + self._variances[columns, block]
            variances += of_calibrations
            shifts = self._shifts[row, block] - self._shifts[columns, block]
            with np.errstate(divide="ignore", invalid="ignore"):
                # 0/0 counts as 0: all seeds agree to the last digit.
                ratios = np.where(np.abs(shifts) > NOISE, shifts / np.sqrt(variances), 0.0)
            studentized[:, block] = ratios
        return studentized

    def _extended(self, studentized: Floats, observed: float) -> float:
        """Return a p-value too small to be counted."""
        # Between the p-values at the `ENOUGH`-th and the ten times `ENOUGH`-th largest resample,
        # its logarithm is taken to be linear in that of Student's tail, but never steeper than
        # this.
        last = len(studentized) - 1
        places = [last - ENOUGH, last - 10 * ENOUGH]
        near, far = (self._tail(t) for t in np.sort(studentized)[places])
        slope = min(math.log(10) / math.log(far / near), 1.0) if far > near else 1.0
        share: float = (self._tail(observed) / near) ** slope
        return share * (1 + ENOUGH) / (self.resamples + 1)

    def _tail(self, t: float) -> float:
        """Return the chance of more than t, from 0 on, in Student's distribution."""
        freedom = max(len(self._n) - len(self._sizes), 1)
        return incomplete_beta(freedom / 2, 0.5, freedom / (freedom + t * t)) / 2


def _draws(key: str, n: int, resamples: int) -> Floats:
    """Return how often each of n is drawn: shape (n, R)."""
    return np.ascontiguousarray(bootstrap_weights(n, key=key, resamples=resamples).T)


def _corrected(tests: Sequence[PairTest], other_tests: Sequence[PairTest]) -> list[PairTest]:
    """Return tests with Holm's correction over them and other tests together."""
    p = holm(np.array([c.p for c in (*tests, *other_tests)]))
    return [replace(c, p_holm=float(corrected)) for c, corrected in zip(tests, p, strict=False)]


def holm(p: Floats) -> Floats:
    """Return p-values after Holm's step-down correction for the number of them (Holm, 1979).

    The i-th smallest of m p-values (i from 1) is multiplied by ``m - i + 1``; a corrected value is
    at least as large as those of smaller p-values, and at most 1. Calling significant what is at
    most alpha keeps the chance of any false call at alpha, whatever the dependence.

    >>> holm(np.array([0.01, 0.04, 0.03, 0.005])).round(3).tolist()
    [0.03, 0.06, 0.06, 0.02]
    """
    order = np.argsort(p, kind="stable")
    factors = np.arange(p.size, 0, -1)
    corrected = np.empty_like(p)
    corrected[order] = np.minimum(np.maximum.accumulate(p[order] * factors), 1.0)
    return corrected


def tie_groups(names: Sequence[str], better: Iterable[tuple[str, str]]) -> list[tuple[str, ...]]:
    """Return the largest sets of rows of which no two can be told apart, in the rows' order.

    "Cannot be told apart" is not transitive: the first may be better than the third while the
    second is told apart from neither. Then there are two groups, with the second row in both.
    Significant pairs are (better, worse).

    >>> tie_groups(["a", "b", "c"], [("a", "c")])
    [('a', 'b'), ('b', 'c')]
    """
    alike = {name: {*names} - {name} for name in names}
    for better_name, worse_name in better:
        alike[better_name].discard(worse_name)
        alike[worse_name].discard(better_name)
    groups = _cliques(alike, [], {*names}, set()) if names else ()
    # By position, since names have an order of their own.
    positions = sorted(sorted(map(names.index, group)) for group in groups)
    return [tuple(names[i] for i in group) for group in positions]


def _cliques(
    alike: Mapping[str, set[str]], group: list[str], more: set[str], done: set[str]
) -> Iterator[list[str]]:
    """Yield the largest groups of rows that are all alike (Bron & Kerbosch, 1973, with pivots)."""
    # They are those with `group`, some of `more`, and none of `done`, in which groups were yielded.
    if not more and not done:
        yield group
        return
    pivot = max(more | done, key=lambda name: len(alike[name] & more))
    for name in more - alike[pivot]:
        yield from _cliques(alike, [*group, name], more & alike[name], done & alike[name])
        more.remove(name)
        done.add(name)


def win_rates(values: Mapping[str, Mapping[Position, float]]) -> dict[tuple[str, str], float]:
    """Return the share of cells in which a row's value is higher than another's, for all pairs.

    Shares are over the cells that both have, equal values counting one half, so that a pair's two
    rates sum to 1; NaN without common cells.

    >>> win_rates({"a": {("ant", "iid"): 0.9, ("ant", "drift"): 0.5},
    ...            "b": {("ant", "iid"): 0.8, ("ant", "drift"): 0.5}})["a", "b"]
    0.75
    """
    cells = sorted({cell for row in values.values() for cell in row})
    every = np.array([[row.get(c, math.nan) for c in cells] for row in values.values()])
    rates = {}
    for (i, row), (j, other) in itertools.combinations(enumerate(values), 2):
        differences = every[i] - every[j]
        defined = differences[~np.isnan(differences)]
        equal = int(np.count_nonzero(np.abs(defined) <= NOISE))
        wins = int(np.count_nonzero(defined > NOISE)) + 0.5 * equal
        n = defined.size
        rates[row, other] = wins / n if n else math.nan
        rates[other, row] = (n - wins) / n if n else math.nan
    return rates


class Lead(NamedTuple):
    """Number of environments that can be left out with a row's mean staying above the next."""

    held: int
    environments: int

    def __str__(self) -> str:
        """Return both numbers, such as ``6/7``."""
        return f"{self.held}/{self.environments}"


def leads(rows: Mapping[str, Row]) -> dict[str, Lead]:
    """Return the leads of rows, in their order, over the next one; the last row has none.

    There are none over a single environment.
    """
    totals = {}
    for name, row in rows.items():
        by_environment: dict[str, list[float]] = {}
        for cells in row.values():
            for cell in sorted(cells):
                by_environment.setdefault(cell[0], []).append(cells[cell].value)
        totals[name] = {e: (math.fsum(v), len(v)) for e, v in by_environment.items()}
    results = {}
    for name, other in itertools.pairwise(rows):
        environments = totals[name].keys()
        held = 0
        for left_out in environments if len(environments) > 1 else ():
            means = [
                math.fsum(total for e, (total, _) in totals[r].items() if e != left_out)
                / sum(n for e, (_, n) in totals[r].items() if e != left_out)
                for r in (name, other)
            ]
            held += means[0] > means[1] + NOISE
        if len(environments) > 1:
            results[name] = Lead(held, len(environments))
    return results


def _check_shape(rows: Mapping[str, Row]) -> None:
    """Refuse rows that cannot be compared."""
    sizes: dict[str, int] = {}
    expected = {cell for row in rows.values() for cells in row.values() for cell in cells}
    for name, row in rows.items():
        for seed, cells in row.items():
            if cells.keys() != expected:
                raise ResultsError(
                    f"{name} has {len(cells)} cells with seed {seed}, expected {len(expected)}: "
                    "only rows with all cells are ranked"
                )
            for cell, contribution in cells.items():
                label = "/".join(cell)
                for sample, terms in _samples(cell, contribution).items():
                    n = len(contribution.numerator[terms])
                    if n != (size := sizes.setdefault(sample, n)):
                        raise ResultsError(
                            f"{name} has {n} test trajectories in {label}, expected {size}: rows "
                            "of one table are of the same split and limit"
                        )
                if math.isnan(contribution.value):
                    raise ResultsError(f"{name} has no value in {label}, so it has no rank")


def _mean(row: Row) -> float:
    # Sorted, so that the order of records does not decide how the sum is rounded.
    return float(np.mean([row[s][c].value for s in sorted(row) for c in sorted(row[s])]))


def _samples(cell: Position, contribution: Contribution) -> dict[str, slice]:
    """Return the terms of each sample of test trajectories by its name, for one cell."""
    # Cells of one environment have one sample. Without twins nominal episodes are that sample, and
    # each condition has a sample of its own.
    if contribution.nominal is None:
        return {cell[0]: slice(None)}
    return {cell[0]: slice(contribution.nominal), "/".join(cell): slice(contribution.nominal, None)}


def _influences(name: str, row: Row, used: Collection[str]) -> _Influences:
    """Return what each drawn seed adds to the row's mean, centred, by the samples that are used."""
    # A trajectory of weight w adds w times its influence: exact for means such as a matched AUC.
    seeds, cells = sorted(row), sorted(row[min(row)])
    parts: dict[str, list[Floats]] = {}
    for cell in cells:
        for seed in seeds:
            influence = _influence(row[seed][cell])
            for sample, terms in _samples(cell, row[seed][cell]).items():
                part = influence[terms]
                parts.setdefault(sample, []).append(part * (len(part) / len(influence)))
    of_tests = {
        sample: np.sum(parts[sample], axis=0) / (len(seeds) * len(cells))
        for sample in parts
        if sample in used
    }
    of_detectors = np.zeros(0)
    if len(seeds) > 1:
        means = np.array([np.mean([row[seed][cell].value for cell in cells]) for seed in seeds])
        of_detectors = means - means.mean()
        of_detectors = np.where(np.abs(of_detectors) > NOISE, of_detectors, 0.0)
    of_calibrations: dict[str, Floats] = {}
    for cell, seed in itertools.product(cells, seeds):
        if (changes := row[seed][cell].deviations).size:
            part = changes / (len(seeds) * len(cells))
            of_calibrations[cell[0]] = of_calibrations.get(cell[0], np.zeros(len(part))) + part
    return _Influences(of_tests, of_detectors, f"{DETECTOR_SEEDS} of {name}", of_calibrations)


def _used(rows: Mapping[str, Row]) -> set[str]:
    """Return the samples that any row has a term of: alarms on nominal episodes have no others."""
    used: set[str] = set()
    for row in rows.values():
        for cells in row.values():
            for cell, contribution in cells.items():
                for sample, terms in _samples(cell, contribution).items():
                    if sample not in used and contribution.denominator[terms].any():
                        used.add(sample)
    return used


def _influence(contribution: Contribution) -> Floats:
    residuals = contribution.numerator - contribution.value * contribution.denominator
    return residuals * len(residuals) / float(contribution.denominator.sum())


def _letter(index: int) -> str:
    """Return a, b, ..., z, a1, b1, ... for 0, 1, ..., 25, 26, 27, ..."""
    turn, letter = divmod(index, 26)
    return chr(ord("a") + letter) + (str(turn) if turn else "")
