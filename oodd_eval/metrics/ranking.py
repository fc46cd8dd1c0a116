"""Ranks, ties and win rates of the rows of one table.

A row is better than another when the paired bootstrap over test seeds says so after Holm's
correction. Ranks count the primary rows that are better: one row a detector, so that variants of
one detector push nobody down. Primary rows that share a tie group cannot be told apart.

Rows are given as the numerators and denominators of a metric, per detector seed and cell. Higher
is better.
"""

import itertools
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.errors import ResultsError
from oodd_eval.metrics.auc import Contribution
from oodd_eval.metrics.pairs import NOISE, Influences, PairTests

ALPHA: Final = 0.05
"""Highest chance that a table calls any row better that is not (family-wise error rate)."""

MIN_RESAMPLES: Final = 10_000  # least number of bootstrap resamples
RESAMPLES_PER_PAIR: Final = 50  # no p-value is below 1 / (R + 1): R has to grow with the pairs
OWN_SEEDS: Final = "detector seeds"  # source of noise that a row's own detector seeds are

Floats = NDArray[np.float64]
Place = tuple[str, str]  # environment and anomaly; cells of one environment share their resamples
Row = Mapping[int, Mapping[Place, Contribution]]  # by detector seed and cell


@dataclass(frozen=True, slots=True)
class PairTest:
    """The test of one ordered pair of rows: whether the first is better than the second.

    The difference is that of their means over all cells, with its paired 95 % interval; `p` is the
    one-sided p-value of "not better", and `p_holm` the same after Holm's correction.
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
    """Ranked rows of one table: ranks by row, tie groups of primary rows, and the tests.

    A rank is 1 + the number of primary rows that are significantly better. Tests are of all ordered
    pairs with a primary row.
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
        Number of bootstrap resamples R; by default at least 10 000 and 50 per ordered pair.

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

    Holm's correction is over all ordered pairs of primary rows. A variant's tests are corrected as
    if it were the one further primary row, so that its rank is the one that it would have.

    Test seeds are drawn jointly for all rows and anomalies of an environment, so that differences
    are paired. Several detector seeds of a row are drawn, too, independently of other rows; the two
    sources of noise are added.
    """
    names = sorted(rows)
    _check_shape(rows)
    first = [name for name in names if primary is None or name in primary]
    variants = [name for name in names if name not in first]
    most = math.comb(len(first), 2) + (len(first) if variants else 0)
    count = resamples or max(MIN_RESAMPLES, RESAMPLES_PER_PAIR * 2 * most)
    influences = {name: _influences(name, rows[name]) for name in names}
    engine = PairTests(influences, count)
    means = {name: _mean(rows[name]) for name in names}

    def tests(of: Sequence[tuple[str, Sequence[str]]]) -> list[list[PairTest]]:
        apart = [np.array([means[one] - means[other] for other in others]) for one, others in of]
        groups = [(*names, own) for names, own in zip(of, apart, strict=True)]
        found: list[list[PairTest]] = []
        for (one, others, differences), tested in zip(groups, engine.test(groups), strict=True):
            found.append([])
            for other, d, t in zip(others, differences.tolist(), tested, strict=True):
                found[-1].append(PairTest(one, other, d, t.low, t.high, t.p, math.nan))
                found[-1].append(PairTest(other, one, -d, -t.high, -t.low, t.p_reverse, math.nan))
        return found

    primaries = [(name, first[i + 1 :]) for i, name in enumerate(first[:-1])]
    found = tests([*primaries, *((name, first) for name in variants if first)])
    among = [test for own in found[: len(primaries)] for test in own]
    comparisons = _corrected(among, [])
    for own in found[len(primaries) :]:
        comparisons += _corrected(own, among)
    better = {(c.first, c.second) for c in comparisons if c.better}
    ranks = {name: 1 + sum((other, name) in better for other in first) for name in names}
    order = sorted(names, key=lambda name: (ranks[name], -means[name], name))
    ranks = {name: ranks[name] for name in order}
    apart = {pair for pair in better if pair[0] in first and pair[1] in first}
    groups = tie_groups([name for name in order if name in first], apart)
    return Ranking(ranks, groups, comparisons, count)


def _corrected(tests: Sequence[PairTest], others: Sequence[PairTest]) -> list[PairTest]:
    """Return tests with Holm's correction over them and others together."""
    p = holm(np.array([c.p for c in (*tests, *others)]))
    return [replace(c, p_holm=float(own)) for c, own in zip(tests, p, strict=False)]


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
    groups = [frozenset(names)] if names else []
    for pair in sorted(better):
        split = [g for g in groups if not g.issuperset(pair)]
        split += [g - {one} for g in groups if g.issuperset(pair) for one in pair]
        groups = [g for g in set(split) if not any(g < other for other in split)]
    # By position, since names have an order of their own.
    positions = sorted(sorted(map(names.index, group)) for group in groups)
    return [tuple(names[i] for i in group) for group in positions]


def win_rates(values: Mapping[str, Mapping[Place, float]]) -> dict[tuple[str, str], float]:
    """Return the share of cells in which a row's value is higher than another's, for all pairs.

    Shares are over the cells that both have, equal values counting one half, so that a pair's two
    rates sum to 1; NaN without common cells.

    >>> win_rates({"a": {("ant", "iid"): 0.9, ("ant", "drift"): 0.5},
    ...            "b": {("ant", "iid"): 0.8, ("ant", "drift"): 0.5}})["a", "b"]
    0.75
    """
    rates = {}
    for row, other in itertools.permutations(values, 2):
        common = [(values[row][c], values[other][c]) for c in values[row] if c in values[other]]
        defined = [x - y for x, y in common if not math.isnan(x) and not math.isnan(y)]
        wins = [0.5 if abs(d) <= NOISE else float(d > 0) for d in defined]
        rates[row, other] = sum(wins) / len(wins) if wins else math.nan
    return rates


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
                where, n = "/".join(cell), len(contribution.numerator)
                if n != (size := sizes.setdefault(cell[0], n)):
                    raise ResultsError(
                        f"{name} has {n} test trajectories in {where}, expected {size}: rows of "
                        "one table are of the same split and limit"
                    )
                if math.isnan(contribution.value):
                    raise ResultsError(f"{name} has no value in {where}, so it has no rank")


def _mean(row: Row) -> float:
    # Sorted, so that the order of records does not decide how the sum is rounded.
    return float(np.mean([row[s][c].value for s in sorted(row) for c in sorted(row[s])]))


def _influences(name: str, row: Row) -> Influences:
    """Return what every drawn thing adds to the row's mean, centred.

    A trajectory of weight w adds w times its influence: exact for means such as a matched AUC.
    """
    seeds, cells = sorted(row), sorted(row[min(row)])
    shared = {}
    for environment, members in itertools.groupby(cells, key=lambda cell: cell[0]):
        parts = [_influence(row[seed][cell]) for cell in members for seed in seeds]
        shared[environment] = np.sum(parts, axis=0) / (len(seeds) * len(cells))
    own = np.zeros(0)
    if len(seeds) > 1:
        means = np.array([np.mean([row[seed][cell].value for cell in cells]) for seed in seeds])
        own = means - means.mean()
        own = np.where(np.abs(own) > NOISE, own, 0.0)
    return Influences(shared, own, f"{OWN_SEEDS} of {name}")


def _influence(contribution: Contribution) -> Floats:
    residuals = contribution.numerator - contribution.value * contribution.denominator
    return residuals * len(residuals) / float(contribution.denominator.sum())


def _letter(index: int) -> str:
    """Return a, b, ..., z, a1, b1, ... for 0, 1, ..., 25, 26, 27, ..."""
    turn, letter = divmod(index, 26)
    return chr(ord("a") + letter) + (str(turn) if turn else "")
