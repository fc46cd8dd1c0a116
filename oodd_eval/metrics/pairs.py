"""Tests of many pairs of rows by the studentized bootstrap, for `oodd_eval.metrics.ranking`.

Rows are given by the influences of test seeds on their means. All pairs share the draws of test
seeds, so that sums over resamples are products of matrices. Matrix libraries differ in the last
bits between machines: a count of resamples therefore takes what is equal up to rounding as equal.
"""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from oodd_eval.metrics.bootstrap import bootstrap_weights, bounds

NOISE: Final = 1e-12  # larger differences are no rounding: equal rows are equal anywhere

FIRST: Final = 30_000
"""Resamples that every pair has. Intervals are of these, and p-values of `ENOUGH` / `FIRST` up."""

ENOUGH: Final = 100  # resamples beyond the difference, with which a p-value needs no further ones

_BLOCK: Final = 1024  # resamples at a time: what is computed stays in the processor's cache
_ROUNDING: Final = 1e-9  # relative; statistics that differ by less are equal
_SINGLE: Final = 1e-3  # relative; far more than single precision loses

Array = NDArray[np.floating]
Floats = NDArray[np.float64]
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


class _Moments(NamedTuple):
    """Of some pairs in some resamples: shifts d* - d, and two terms whose difference is s* ** 2."""

    shifts: Array
    squares: Array
    means: Array


class _Group(NamedTuple):
    """A row and others: the counts of resamples beyond the difference, and not beyond it.

    `rare` are the places of the pairs that need further resamples, whose names and influences are
    `others` and `effects`.
    """

    row: str
    others: Sequence[str]
    effects: Mapping[str, Floats]
    observed: Floats
    counts: NDArray[np.int64]
    ends: list[tuple[float, float]]
    rare: NDArray[np.intp]


class PairTests:
    """The bootstrap of pairs of rows with R resamples."""

    def __init__(self, rows: Mapping[str, Influences], resamples: int) -> None:
        self._rows, self.resamples = rows, resamples
        self._seeds: dict[tuple[str, int], tuple[Floats, Floats]] = {}
        first = next(iter(rows.values()), Influences({}, np.zeros(0), ""))
        self._sizes = {name: z.size for name, z in first.shared.items()}
        # No p-value is below the chance that all seeds have the signs that they have.
        self._floor = 2.0 ** -sum(self._sizes.values())

    def test(self, groups: Sequence[tuple[str, Sequence[str], Floats]]) -> list[list[Tested]]:
        """Test rows against others.

        Parameters
        ----------
        groups
            Of a row's name, the names of others, and the differences of its mean to theirs: shape
            (others,).
        """
        found = [self._first(*group) for group in groups]
        self._count_further([group for group in found if group.rare.size])
        self._seeds.clear()
        return [self._tested(group) for group in found]

    def _first(self, row: str, others: Sequence[str], differences: Floats) -> _Group:
        """Return what the first resamples say of a row and others."""
        effects = self._effects(row, others)
        total = min(FIRST, self.resamples)
        shifts = np.empty((len(others), total))
        variances = np.empty_like(shifts)
        for start in range(0, total, _BLOCK):
            part = slice(start, min(start + _BLOCK, total))
            found = self._moments(row, others, effects, part, np.dtype(np.float64))
            shifts[:, part] = found.shifts
            variances[:, part] = np.maximum(found.squares - found.means, 0.0)
        observed = self._observed(row, others, effects, differences)
        beyond = _beyond(shifts, variances, observed[:, None])
        # On the other side of the observed one, or equal to it.
        reverse = ~_beyond(shifts, variances, observed[:, None], 1 + _ROUNDING)
        counts = np.stack([beyond.sum(axis=1), reverse.sum(axis=1)])
        # A difference of 0, or one whose noise nobody knows.
        counts[:, (np.abs(differences) <= NOISE) | (observed == 0)] = total
        few = np.flatnonzero(counts[0] < ENOUGH) if total < self.resamples else np.arange(0)
        sizes = list(self._sizes.values())
        ends = [bounds(d + own, d, sizes) for d, own in zip(differences, shifts, strict=True)]
        names = [others[i] for i in few.tolist()]
        own = {e: z[few] for e, z in effects.items()}
        return _Group(row, names, own, observed, counts, ends, few)

    def _tested(self, group: _Group) -> list[Tested]:
        totals = np.full(group.counts.shape, min(FIRST, self.resamples))
        totals[0, group.rare] = self.resamples
        p = np.maximum((1 + group.counts) / (totals + 1), self._floor)
        return [
            Tested(*ends, *(both if side >= 0 else both[::-1]))
            for ends, both, side in zip(group.ends, p.T.tolist(), group.observed, strict=True)
        ]

    def _effects(self, row: str, others: Sequence[str]) -> dict[str, Floats]:
        """Return the influences on the differences by environment: shape (others, n)."""
        own = self._rows[row].shared
        found = {e: z - np.array([self._rows[o].shared[e] for o in others]) for e, z in own.items()}
        # Rounding alone must not look like a difference between seeds.
        return {e: np.where(np.abs(z) > NOISE, z, 0.0) for e, z in found.items()}

    def _observed(
        self, row: str, others: Sequence[str], effects: Mapping[str, Floats], differences: Floats
    ) -> Floats:
        """Return the studentized differences: shape (others,)."""
        variances = np.zeros(len(others))
        for z in effects.values():
            n = z.shape[1]
            variances += z.var(axis=1) * _of_mean(1.0, n) if n > 1 else math.inf
        for i, other in enumerate(others):
            for own in (self._rows[row].own, self._rows[other].own):
                variances[i] += _of_mean(float(own.var()), own.size) if own.size else 0.0
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.divide(differences, np.sqrt(variances)))

    def _moments(
        self, row: str, others: Sequence[str], effects: Mapping[str, Floats], part: slice,
        precision: np.dtype[np.floating],
    ) -> _Moments:  # fmt: skip
        """Return the moments of pairs in a part of the resamples: shapes (others, resamples)."""
        shape = len(others), part.stop - part.start
        found = _Moments(*(np.zeros(shape, precision) for _ in range(3)))
        for environment, z in effects.items():
            n = z.shape[1]
            if n == 1:  # one seed says nothing of the noise
                found.squares[...] += math.inf
                continue
            drawn = _draws(environment, n, self.resamples)[:, part].astype(precision)
            mean = (z / n).astype(precision) @ drawn
            found.shifts[...] += mean
            np.multiply(mean, mean, out=mean)
            mean *= precision.type(_of_mean(1.0, n))
            found.means[...] += mean
            found.squares[...] += (z * z * _of_mean(1 / n, n)).astype(precision) @ drawn
        shift, variance = self._by_seeds(row, part)
        theirs = [self._by_seeds(other, part) for other in others]
        found.shifts[...] += shift - np.array([own for own, _ in theirs])
        found.squares[...] += variance + np.array([own for _, own in theirs])
        return found

    def _by_seeds(self, row: str, part: slice) -> tuple[Floats, Floats]:
        """Return shifts by a row's detector seeds, and the variances of its mean over them."""
        if (row, part.start) not in self._seeds:
            z = self._rows[row].own
            found = np.zeros(part.stop - part.start), np.zeros(part.stop - part.start)
            if z.size:
                drawn = _draws(self._rows[row].key, z.size, self.resamples)[:, part]
                found = _mean_and_variance(z, drawn.astype(np.float64))
            self._seeds[row, part.start] = found
        return self._seeds[row, part.start]

    def _count_further(self, groups: Sequence[_Group]) -> None:
        """Add the resamples after the first that reach the differences to the counts.

        What may reach them is sought in single precision, and then computed in double precision.
        """
        single = np.dtype(np.float32)
        for start in range(FIRST, self.resamples, _BLOCK):
            part = slice(start, min(start + _BLOCK, self.resamples))
            self._seeds.clear()  # of other resamples
            for row, others, effects, all_observed, all_counts, _, rare in groups:
                observed = np.where(np.isfinite(all_observed), all_observed, 0.0)[rare]
                shifts, squares, means = self._moments(row, others, effects, part, single)
                signs = np.sign(observed).astype(single)[:, None]
                near = shifts * signs > 0
                shifts *= shifts
                squares *= np.float32(1 - _SINGLE)
                squares -= means
                squares *= (observed**2).astype(single)[:, None]
                near &= shifts >= squares
                pairs, places = np.nonzero(near)
                if pairs.size:
                    exact = self._chosen(row, others, effects, part, pairs, places)
                    reached = pairs[_beyond(*exact, observed[pairs])]
                    all_counts[0, rare] += np.bincount(reached, minlength=len(others))

    def _chosen(
        self, row: str, others: Sequence[str], effects: Mapping[str, Floats], part: slice,
        pairs: NDArray[np.intp], places: NDArray[np.intp],
    ) -> tuple[Floats, Floats]:  # fmt: skip
        """Return shifts and variances of pairs at places of a part, as many of both."""
        shifts, variances = (x[places] for x in self._by_seeds(row, part))
        theirs = np.array([self._by_seeds(other, part) for other in others])
        shifts = shifts - theirs[pairs, 0, places]
        variances = variances + theirs[pairs, 1, places]
        for environment, z in effects.items():
            drawn = _draws(environment, z.shape[1], self.resamples)[:, part][:, places]
            mean, variance = _mean_and_variance(z[pairs], drawn.T.astype(np.float64), "kn,kn->k")
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
