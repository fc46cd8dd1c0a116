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


class PairTests:
    """The bootstrap of pairs of rows with R resamples."""

    def __init__(self, rows: Mapping[str, Influences], resamples: int) -> None:
        self._rows, self.resamples = rows, resamples
        first = next(iter(rows.values()), Influences({}, np.zeros(0), ""))
        self._sizes = {name: z.size for name, z in first.shared.items()}
        # No p-value is below the chance that all seeds have the signs that they have.
        self._floor = 2.0 ** -sum(self._sizes.values())

    def test(self, row: str, others: Sequence[str], differences: Floats) -> list[Tested]:
        """Test one row against others.

        Parameters
        ----------
        row, others
            Names of rows.
        differences
            Of the row's mean to each other's: shape (others,).
        """
        effects = self._effects(row, others)
        whole = np.arange(min(FIRST, self.resamples))
        shifts = np.empty((len(others), whole.size))
        variances = np.empty_like(shifts)
        for start in range(0, whole.size, _BLOCK):
            part = slice(start, min(start + _BLOCK, whole.size))
            found = self._moments(row, others, effects, part, np.dtype(np.float64))
            shifts[:, part] = found.shifts
            variances[:, part] = np.maximum(found.squares - found.means, 0.0)
        observed = self._observed(row, others, effects, differences)
        reached = np.array([
            _reached(*three) for three in zip(shifts, variances, observed, strict=True)
        ]).reshape(-1, 2)  # fmt: skip
        totals = np.full(reached.shape, whole.size)
        equal = np.abs(differences) <= NOISE
        reached[equal] = whole.size
        rare = np.flatnonzero((reached.min(axis=1) < ENOUGH) & ~equal)
        if rare.size and whole.size < self.resamples:
            sides = (observed[rare] < 0).astype(int)
            names = [others[i] for i in rare.tolist()]
            more = self._further(row, names, effects, rare, observed[rare])
            reached[rare, sides] += more
            totals[rare, sides] = self.resamples
        p = np.maximum((1 + reached) / (totals + 1), self._floor)
        sizes = list(self._sizes.values())
        return [
            Tested(*bounds(d + own, d, sizes), *map(float, both))
            for d, own, both in zip(differences.tolist(), shifts, p, strict=True)
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
            variances += _of_mean(z.var(axis=1), z.shape[1])
        for i, other in enumerate(others):
            for own in (self._rows[row].own, self._rows[other].own):
                variances[i] += _of_mean(own.var(), own.size) if own.size else 0.0
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
        for i, other in enumerate(others):
            other_shift, other_variance = self._by_seeds(other, part)
            found.shifts[i] += shift - other_shift
            found.squares[i] += variance + other_variance
        return found

    def _by_seeds(self, row: str, part: slice) -> tuple[Floats | float, Floats | float]:
        """Return shifts by a row's detector seeds, and the variances of its mean over them."""
        z = self._rows[row].own
        if not z.size:
            return 0.0, 0.0
        drawn = _draws(self._rows[row].key, z.size, self.resamples)[:, part].astype(np.float64)
        mean = (z / z.size) @ drawn
        square = (z * z / z.size) @ drawn
        return mean, _of_mean(1.0, z.size) * np.maximum(square - mean * mean, 0.0)

    def _further(
        self, row: str, others: Sequence[str], effects: Mapping[str, Floats],
        chosen: NDArray[np.intp], observed: Floats,
    ) -> NDArray[np.int64]:  # fmt: skip
        """Count the resamples after the first that reach the differences: shape (others,).

        What may reach them is sought in single precision, and then computed in double precision.
        """
        own = {e: z[chosen] for e, z in effects.items()}
        counts = np.zeros(len(others), dtype=np.int64)
        # Of equal seeds no resample deviates.
        finite = np.isfinite(observed)
        limit = np.where(finite, observed**2, 0.0).astype(np.float32)[:, None]
        signs = np.where(finite, np.sign(observed), 0.0).astype(np.float32)[:, None]
        single = np.dtype(np.float32)
        for start in range(FIRST, self.resamples, _BLOCK):
            part = slice(start, min(start + _BLOCK, self.resamples))
            shifts, squares, means = self._moments(row, others, own, part, single)
            near = shifts * signs > 0
            shifts *= shifts
            squares *= np.float32(1 - _SINGLE)
            squares -= means
            squares *= limit
            near &= shifts >= squares
            pairs, places = np.nonzero(near)
            for i in np.unique(pairs):
                exact = self._one(row, others[i], own, i, part, places[pairs == i])
                counts[i] += _reached(*exact, observed[i])[int(observed[i] < 0)]
        return counts

    def _one(
        self, row: str, other: str, effects: Mapping[str, Floats], i: int, part: slice,
        places: NDArray[np.intp],
    ) -> tuple[Floats, Floats]:  # fmt: skip
        """Return one pair's shifts and variances in some resamples of a part."""
        shifts, variances = np.zeros(places.size), np.zeros(places.size)
        for environment, z in effects.items():
            n = z.shape[1]
            drawn = _draws(environment, n, self.resamples)[:, part][:, places].astype(np.float64)
            mean, square = (z[i] / n) @ drawn, (z[i] ** 2 / n) @ drawn
            shifts += mean
            variances += _of_mean(1.0, n) * np.maximum(square - mean * mean, 0.0)
        for sign, name in ((1, row), (-1, other)):
            shift, variance = self._by_seeds(name, part)
            if isinstance(shift, np.ndarray) and isinstance(variance, np.ndarray):
                shifts += sign * shift[places]
                variances += variance[places]
        return shifts, variances


def _reached(shifts: Floats, variances: Floats, observed: float) -> tuple[int, int]:
    """Count the resamples whose studentized shift is at least, and at most, the observed one."""
    with np.errstate(invalid="ignore", divide="ignore"):
        # Where all seeds agree to the last digit, no shift over no spread is no shift.
        studentized = np.where(np.abs(shifts) > NOISE, shifts / np.sqrt(variances), 0.0)
    slack = _ROUNDING * abs(observed) if math.isfinite(observed) else 0.0
    above = np.count_nonzero(studentized >= observed - slack)
    return int(above), int(np.count_nonzero(studentized <= observed + slack))


def _of_mean(spread: float | Floats, n: int) -> float | Floats:
    """Return the variance of a mean of n from their variance (ddof 0); one says nothing of it."""
    return spread / (n - 1) if n > 1 else spread + math.inf
