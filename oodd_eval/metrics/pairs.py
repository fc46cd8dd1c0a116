"""Tests of many pairs of rows by the studentized bootstrap, for `oodd_eval.metrics.ranking`.

Rows are given by the influences of test seeds on their means. All pairs share the draws of test
seeds, so that sums over resamples are products of matrices. Matrix libraries differ in the last
bits between machines: a count of resamples therefore takes what is equal up to rounding as equal.
"""

import functools
import itertools
import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from oodd_eval.metrics.bootstrap import bootstrap_weights, bounds

NOISE: Final = 1e-12  # larger differences are no rounding: equal rows are equal anywhere

FIRST: Final = 30_000
"""Resamples that every pair has. Intervals are of these, and p-values of `ENOUGH` / `FIRST` up."""

ENOUGH: Final = 100  # resamples beyond the difference, with which a p-value needs no further ones

_BLOCK: Final = 4096  # resamples at a time, in one thread
_ROUNDING: Final = 1e-9  # relative; statistics that differ by less are equal
_SINGLE: Final = 1e-3  # relative; far more than single precision loses
_WEAK: Final = 1e-2  # studentized differences below which single precision tells too little

Floats = NDArray[np.float64]
Singles = NDArray[np.floating]
Bools = NDArray[np.bool_]
Counts = NDArray[np.unsignedinteger]


class Influences(NamedTuple):
    """Shifts of a row's mean by each drawn thing, centred on 0.

    `shared` is by environment, of its test seeds, `own` of the row's detector seeds, empty where
    there is one; `key` names their draws.
    """

    shared: Mapping[str, Floats]
    own: Floats
    key: str


class Tested(NamedTuple):
    """The 95 % interval of a difference, and the p-values of "not better" and of "not worse"."""

    low: float
    high: float
    p: float
    p_reverse: float


@functools.lru_cache(maxsize=256)
def _draws(key: str, n: int, resamples: int) -> Counts:
    """Return how often each of n is drawn, in little memory: shape (n, R)."""
    weights = bootstrap_weights(n, key=key, resamples=resamples)
    drawn = np.ascontiguousarray(weights.T, dtype=np.min_scalar_type(n))
    drawn.setflags(write=False)
    return drawn


class _Group:
    """A row and others, with what is counted of their pairs.

    `effects` are the influences on the differences of all test seeds, shape (others, seeds), and
    `observed` the studentized differences, 0 where nobody knows the noise. `counts` are the
    resamples beyond the observed difference, and those not beyond it, of each pair.
    """

    def __init__(
        self, row: int, others: NDArray[np.intp], effects: Floats, observed: Floats
    ) -> None:
        self.row, self.others, self.effects, self.observed = row, others, effects, observed
        self.counts = np.zeros((2, len(others)), dtype=np.int64)

    def only(self, places: NDArray[np.intp]) -> "_Group":
        """Return the group with some of the others, nothing counted."""
        return _Group(self.row, self.others[places], self.effects[places], self.observed[places])


class _Part(NamedTuple):
    """Some resamples: how often test seeds are drawn, and shifts and variances by detector seeds.

    Shapes are (seeds, resamples) and (2, rows, resamples).
    """

    drawn: Counts
    own: Floats


class PairTests:
    """The bootstrap of pairs of rows with R resamples.

    On which side of the observed difference a resample is, is told in single precision where that
    suffices, and else in double precision.
    """

    def __init__(self, rows: Mapping[str, Influences], resamples: int) -> None:
        self.resamples = resamples
        self._places = {name: i for i, name in enumerate(rows)}
        self._rows = list(rows.values())
        shared = self._rows[0].shared if rows else {}
        self._sizes = {name: z.size for name, z in shared.items()}
        ends = itertools.accumulate(self._sizes.values(), initial=0)
        self._slices = [slice(*both) for both in itertools.pairwise(ends)]
        self._influences = np.array([np.concatenate([*r.shared.values()]) for r in self._rows])
        # No p-value is below the chance that all seeds have the signs that they have.
        self._floor = 2.0 ** -sum(self._sizes.values())

    def test(self, groups: Sequence[tuple[str, Sequence[str], Floats]]) -> list[list[Tested]]:
        """Test rows against others.

        A group is a row's name, the names of others, and the differences of its mean to theirs.
        """
        if not any(others for _, others, _ in groups):
            return [[] for _ in groups]
        # These products are small: threads of a matrix library would wait for one another.
        with threadpool_limits(1, user_api="blas"):
            return self._tested(groups)

    def _tested(self, groups: Sequence[tuple[str, Sequence[str], Floats]]) -> list[list[Tested]]:
        total = min(FIRST, self.resamples)
        first = [self._group(*group) for group in groups]
        self._count(first, 0, total)
        rare = []
        for group in first:
            group.counts[:, group.observed == 0] = total
            few = group.counts[0] < ENOUGH if total < self.resamples else np.zeros(0, dtype=bool)
            rare.append(np.flatnonzero(few))
        further = [group.only(places) for group, places in zip(first, rare, strict=True)]
        self._count(further, total, self.resamples)
        shifts, sizes = self._shifts(total), list(self._sizes.values())
        found = []
        for group, places, more, (*_, differences) in zip(
            first, rare, further, groups, strict=True
        ):
            totals = np.full(group.counts.shape, total)
            totals[0, places] = self.resamples
            group.counts[0, places] += more.counts[0]
            p = np.maximum((1 + group.counts) / (totals + 1), self._floor)
            own = shifts[group.row] - shifts[group.others]
            found.append(
                [
                    Tested(*bounds(d + one, d, sizes), *(both if side >= 0 else both[::-1]))
                    for d, one, both, side in zip(
                        differences, own, p.T.tolist(), group.observed, strict=True
                    )
                ]
            )
        return found

    def _group(self, row: str, others: Sequence[str], differences: Floats) -> _Group:
        """Return a group with the studentized differences of its pairs."""
        place, places = self._places[row], np.array([self._places[o] for o in others], np.intp)
        effects = self._influences[place] - self._influences[places]
        # Rounding alone must not look like a difference between seeds.
        effects = np.where(np.abs(effects) > NOISE, effects, 0.0)
        variances = np.zeros(len(others))
        for n, own in zip(self._sizes.values(), self._slices, strict=True):
            variances += effects[:, own].var(axis=1) * _of_mean(1.0, n) if n > 1 else math.inf
        for i, other in enumerate(places):
            for own_seeds in (self._rows[place].own, self._rows[other].own):
                size = own_seeds.size
                variances[i] += _of_mean(float(own_seeds.var()), size) if size else 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            observed = np.divide(differences, np.sqrt(variances))
        return _Group(place, places, effects, np.where(np.abs(differences) > NOISE, observed, 0.0))

    def _part(self, start: int, stop: int) -> _Part:
        """Return some of the resamples."""
        part = slice(start, stop)
        drawn = [_draws(e, n, self.resamples)[:, part] for e, n in self._sizes.items()]
        own = np.zeros((2, len(self._rows), stop - start))
        for i, row in enumerate(self._rows):
            if row.own.size:
                counts = _draws(row.key, row.own.size, self.resamples)[:, part]
                own[:, i] = _mean_and_variance(row.own, counts.astype(np.float64))
        return _Part(np.concatenate(drawn), own)

    def _shifts(self, total: int) -> Floats:
        """Return the shifts of all rows' means in the first resamples: shape (rows, total).

        Sums are taken in a fixed order, so that an interval depends on its two rows alone.
        """
        found = np.empty((len(self._rows), total))
        weights = self._influences / np.repeat([*self._sizes.values()], [*self._sizes.values()])
        for start in range(0, total, _BLOCK):
            part = self._part(start, stop := min(start + _BLOCK, total))
            drawn = part.drawn.astype(np.float64)
            for i, own in enumerate(weights):
                found[i, start:stop] = np.einsum("n,nr->r", own, drawn) + part.own[0, i]
        return found

    def _count(self, groups: Sequence[_Group], start: int, stop: int) -> None:
        """Add resamples to the counts of the pairs whose noise is known."""
        tested = [(g, self._terms(g)) for g in groups if g.observed.any()]
        if not tested:
            return
        own = ((r.key, r.own.size) for r in self._rows if r.own.size)
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            drawn = {*self._sizes.items(), *own}
            list(pool.map(lambda key: _draws(*key, self.resamples), drawn))

            def block(begin: int) -> list[NDArray[np.int64]]:
                part = self._part(begin, min(begin + _BLOCK, stop))
                single = _Part(part.drawn.astype(np.float32), part.own.astype(np.float32))
                return [self._counted(*both, part, single) for both in tested]

            for found in pool.map(block, range(start, stop, _BLOCK)):
                for (group, _), counts in zip(tested, found, strict=True):
                    group.counts += counts

    def _counted(
        self, group: _Group, terms: tuple[Singles, Singles, Singles], part: _Part, single: _Part
    ) -> NDArray[np.int64]:
        """Return the counts of a group's pairs in a part of the resamples."""
        sure, near = self._sides(group, terms, single)
        beyond = sure.sum(axis=1)
        counts = np.array([beyond, single.own.shape[2] - beyond])
        pairs, places = np.nonzero(near)
        if pairs.size:
            exact = *self._chosen(group, part, pairs, places), group.observed[pairs]
            # On the other side of the observed one, or equal to it.
            for i, factor in enumerate((1 - _ROUNDING, 1 + _ROUNDING)):
                reached = pairs[_beyond(*exact, factor)]
                own = np.bincount(reached, minlength=len(beyond))
                counts[i] += own if i == 0 else -own
        return counts

    def _terms(self, group: _Group) -> tuple[Singles, Singles, Singles]:
        """Return the factors of draws in shifts, their squares, and variances, see `_sides`."""
        shifts, means, squares = (np.empty_like(group.effects) for _ in range(3))
        for n, own in zip(self._sizes.values(), self._slices, strict=True):
            z = group.effects[:, own]
            shifts[:, own], means[:, own] = z / n, z / n * math.sqrt(_of_mean(1.0, n))
            squares[:, own] = z * z * _of_mean(1 / n, n)
        return shifts.astype(np.float32), means.astype(np.float32), squares.astype(np.float32)

    def _sides(
        self, group: _Group, terms: tuple[Singles, Singles, Singles], part: _Part
    ) -> tuple[Bools, Bools]:
        """Tell which resamples are beyond the observed differences, and which are too near to tell.

        One is beyond where the square of its shift exceeds the variance times the square of the
        observed, studentized difference.
        """
        known = np.where(np.isfinite(group.observed), group.observed, 0.0)
        sign, square = (x.astype(np.float32)[:, None] for x in (np.sign(known), known * known))
        shifts = terms[0] @ part.drawn
        shifts += part.own[0, group.row] - part.own[0, group.others]
        right = shifts * sign > 0
        squares = terms[2] @ part.drawn
        squares += part.own[1, group.row] + part.own[1, group.others]
        squares *= square
        np.multiply(shifts, shifts, out=shifts)
        excess = shifts - squares
        for own in self._slices:
            mean = terms[1][:, own] @ part.drawn[own]
            np.multiply(mean, mean, out=mean)
            mean *= square
            excess += mean
        squares *= np.float32(_SINGLE)
        near = right & (np.abs(excess) <= squares)
        near |= ((group.observed != 0) & (np.abs(known) < _WEAK))[:, None]
        return right & (excess > 0) & ~near, near

    def _chosen(
        self, group: _Group, part: _Part, pairs: NDArray[np.intp], places: NDArray[np.intp]
    ) -> tuple[Floats, Floats]:
        """Return shifts and variances of pairs at places of a part, as many of both."""
        shifts = part.own[0, group.row, places] - part.own[0, group.others[pairs], places]
        variances = part.own[1, group.row, places] + part.own[1, group.others[pairs], places]
        for own in self._slices:
            drawn = part.drawn[own][:, places].T.astype(np.float64)
            mean, variance = _mean_and_variance(group.effects[pairs, own], drawn, "kn,kn->k")
            shifts += mean
            variances += variance
        return shifts, variances


def _mean_and_variance(z: Floats, drawn: Floats, product: str = "n,nr->r") -> tuple[Floats, Floats]:
    """Return the mean of z in each resample, and the variance of that mean."""
    n = z.shape[-1]
    mean = np.einsum(product, z, drawn) / n
    square = np.einsum(product, z * z, drawn) / n
    return mean, np.maximum(square - mean * mean, 0.0) * _of_mean(1.0, n)


def _beyond(
    shifts: Floats, variances: Floats, observed: Floats, factor: float = 1 - _ROUNDING
) -> NDArray[np.bool_]:
    """Tell which studentized shifts reach a multiple of an observed one on its own side of 0."""
    with np.errstate(invalid="ignore", divide="ignore"):
        # Where all seeds agree to the last digit, no shift over no spread is no shift.
        studentized = np.where(np.abs(shifts) > NOISE, shifts / np.sqrt(variances), 0.0)
        beyond = studentized * np.sign(observed) >= np.abs(observed) * factor
    return np.asarray(beyond)


def _of_mean(spread: float, n: int) -> float:
    """Return the variance of a mean of n from their variance (ddof 0); one says nothing of it."""
    return spread / (n - 1) if n > 1 else math.inf
