"""Paired differences between rows: one computation gives an interval and its verdict.

Rows are given as the numerators and denominators of a metric, by detector seed and cell. Higher is
better. Test seeds are drawn jointly for all rows and all anomalies of an environment, and so are
calibration episodes where terms say what these change. Detector seeds are fixed: the figure is the
mean over the seeds that were run, and says nothing of further ones.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from oodd_eval.errors import ResultsError
from oodd_eval.metrics.auc import Contribution
from oodd_eval.metrics.bootstrap import bootstrap_weights, calibration_draws

ALPHA: Final = 0.05
"""Highest chance that any of the pairs that are tested together is wrongly told apart."""

MIN_RESAMPLES: Final = 10_000
RESAMPLES_PER_PAIR: Final = 400  # ten resamples beyond each end at the level of Holm's first step
NOISE: Final = 1e-12  # larger differences are no rounding: equal rows are equal anywhere

_ROUNDING: Final = 1e-9  # relative; statistics that differ by less are equal

Floats = NDArray[np.float64]
Position = tuple[str, str]  # environment and anomaly; cells of one environment share resamples
Row = Mapping[int, Mapping[Position, Contribution]]  # by detector seed and cell


@dataclass(frozen=True, slots=True)
class PairedDifference:
    """A row's mean minus another's.

    Attributes
    ----------
    first, second
        Names of the rows.
    difference
        The first's mean over all cells minus the second's.
    low, high
        Interval of the level that Holm's step asks of the pair; an end is NaN where there are too
        few test seeds for one.
    p
        Two-sided, after Holm's correction.
    """

    first: str
    second: str
    difference: float
    low: float
    high: float
    p: float

    @property
    def told_apart(self) -> bool:
        """True if the interval excludes 0, so that p is at most 0.05."""
        return self.low > 0 or self.high < 0


def differences(
    rows: Mapping[str, Row], pairs: Sequence[tuple[str, str]], *, resamples: int | None = None
) -> list[PairedDifference]:
    """Test pairs of rows together, with the same results for any order of pairs, seeds and cells.

    Parameters
    ----------
    rows
        By name.
    pairs
        Names of two rows each.
    resamples
        Number of bootstrap resamples R; by default 400 per pair, at least 10 000.

    Returns
    -------
    list of PairedDifference
        One a pair, in the order of the pairs.

    Raises
    ------
    ResultsError
        When rows differ in cells or in the number of test trajectories, or a cell has no value.

    Notes
    -----
    With d the difference of two means, s its standard error and ``t* = (d* - d) / s*`` in a
    resample, the p-value is ``2 (1 + k) / (R + 1)``, where k counts the resamples with t* beyond
    ``d / s``: the studentized bootstrap (Davison & Hinkley 1997, sections 2.4 and 4.4). Counting
    those with ``d* <= 0`` instead calls equal detectors different in one table out of six when
    there is one environment with ten test seeds. The interval inverts that test: its ends are
    ``d - t* s`` for the t* at which p reaches a level.

    That level is the one of Holm's step (1979): ``0.05 / m``, with m the number of pairs whose
    p-value is as large or larger. Pairs from the first that is not told apart on keep its level.
    So an interval leaves out 0 exactly where the corrected p-value is at most 0.05.

    No p-value is below ``2 ** (1 - N)`` with N test seeds in all environments together: if neither
    row is better, each seed's difference might as well have the other sign. Where that is above
    the level, the interval has no ends.
    """
    _check_shape(rows)
    count = resamples or max(MIN_RESAMPLES, RESAMPLES_PER_PAIR * len(pairs))
    influences = {name: _influences(rows[name]) for name in dict.fromkeys(itertools.chain(*pairs))}
    sizes = {(key, z.size) for row in influences.values() for key, z in row.of_tests.items()}
    drawn = {  # how often each of n is drawn: shape (n, R)
        key: np.ascontiguousarray(bootstrap_weights(n, key=key, resamples=count).T)
        for key, n in sorted(sizes)
    }
    tests = [_Test.of(influences[a], influences[b], drawn, count) for a, b in pairs]
    p = np.array([test.p for test in tests])
    corrected = holm(p)
    # Equal p-values share a step, so that the order of pairs changes no interval.
    steps = np.array([np.count_nonzero(p >= value) for value in p])
    if (failed := corrected > ALPHA).any():
        steps[failed] = steps[failed].max()
    return [
        PairedDifference(a, b, test.difference, *test.ends(int(step)), float(corrected_p))
        for (a, b), test, step, corrected_p in zip(pairs, tests, steps, corrected, strict=True)
    ]


class _Influences(NamedTuple):
    """A row's mean, and its shifts by each test seed, by sample, and by calibration draws."""

    # Shifts are centred on 0. Those of calibrations are by environment, none for metrics that
    # calibration does not change.

    mean: float
    of_tests: Mapping[str, Floats]
    of_calibrations: Mapping[str, Floats]


class _Test(NamedTuple):
    """The studentized bootstrap of one pair of rows; `studentized` is sorted."""

    difference: float
    error: float
    observed: float  # size of the difference in standard errors
    studentized: Floats
    p: float
    least: float  # no p-value is below

    @classmethod
    def of(
        cls, first: _Influences, second: _Influences, drawn: Mapping[str, Floats], resamples: int
    ) -> "_Test":
        difference = first.mean - second.mean
        shifts, variances, variance, seeds = np.zeros(resamples), np.zeros(resamples), 0.0, 0
        for sample in sorted({*first.of_tests, *second.of_tests}):
            effects = _minus(first.of_tests, second.of_tests, sample)
            n = effects.size
            seeds += n
            if n == 1:  # one test seed says nothing of its variance
                variance = math.inf
                continue
            mean = np.einsum("n,nr->r", effects / n, drawn[sample])
            square = np.einsum("n,nr->r", effects**2 / n, drawn[sample])
            shifts += mean
            variances += np.maximum(square - mean * mean, 0.0) / (n - 1)
            variance += float(effects.var()) / (n - 1)
        changes = np.zeros(resamples)
        for environment in sorted({*first.of_calibrations, *second.of_calibrations}):
            change = _minus(first.of_calibrations, second.of_calibrations, environment)
            changes += change[calibration_draws(environment, len(change), resamples)]
        shifts += changes
        variances += changes.var()
        error = math.sqrt(variance + float(changes.var()))
        with np.errstate(divide="ignore", invalid="ignore"):
            # 0/0 counts as 0: all seeds agree to the last digit.
            studentized = np.where(np.abs(shifts) > NOISE, shifts / np.sqrt(variances), 0.0)
            observed = abs(float(np.divide(difference, error)))
        least = 2.0 ** (1 - seeds)
        p = 1.0
        if abs(difference) > NOISE and math.isfinite(error):
            # A resample at the observed difference is beyond it.
            beyond = math.copysign(1.0, difference) * studentized >= observed * (1 - _ROUNDING)
            p = min(max(2 * (1 + np.count_nonzero(beyond)) / (resamples + 1), least), 1.0)
        return cls(difference, error, observed, np.sort(studentized), p, least)

    def ends(self, step: int) -> tuple[float, float]:
        """Return the interval of level 0.05 / step, NaN for an end that too few seeds give."""
        resamples = self.studentized.size
        ranks = np.arange(1, resamples // 2 + 1)
        beyond = np.count_nonzero(2 * ranks / (resamples + 1) * step <= ALPHA)
        if not beyond or self.least * step > ALPHA or math.isinf(self.error):
            return math.nan, math.nan
        ends = []
        for side, t in (1, self.studentized[-beyond]), (-1, self.studentized[beyond - 1]):
            width = max(side * float(t), 0.0) * self.error if self.error else 0.0
            away = side * self.difference
            end = away - width
            # As p-values do, an end takes what is equal up to rounding as equal.
            if abs(away) <= NOISE or side * t >= self.observed * (1 - _ROUNDING):
                end = min(end, 0.0)
            ends.append(side * end if math.isfinite(end) else math.nan)
        return ends[0], ends[1]


def _minus(first: Mapping[str, Floats], second: Mapping[str, Floats], key: str) -> Floats:
    """Return the difference of two rows' shifts; a row without some has none."""
    none = np.zeros(1)
    shift = first.get(key, none) - second.get(key, none)
    # Rounding alone must not look like a difference between seeds.
    return np.where(np.abs(shift) > NOISE, shift, 0.0)


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
                for sample, terms in _samples(cell, contribution):
                    n = len(contribution.numerator[terms])
                    if n != (size := sizes.setdefault(sample, n)):
                        raise ResultsError(
                            f"{name} has {n} test trajectories in {label}, expected {size}: rows "
                            "of one table are of the same split and limit"
                        )
                if math.isnan(contribution.value):
                    raise ResultsError(f"{name} has no value in {label}, so it has no rank")


def _samples(cell: Position, contribution: Contribution) -> Iterator[tuple[str, slice]]:
    """Yield the terms of each sample of test trajectories with its name, for one cell."""
    # Cells of one environment have one sample. Without twins nominal episodes are that sample, and
    # each condition has a sample of its own.
    yield cell[0], slice(contribution.nominal)
    if contribution.nominal is not None:
        yield "/".join(cell), slice(contribution.nominal, None)


def _influences(row: Row) -> _Influences:
    """Return what each drawn seed adds to the row's mean, by the samples that it has terms of."""
    # A trajectory of weight w adds w times its influence: exact for means such as a matched AUC.
    # Sorted, so that the order of records does not decide how sums are rounded.
    ordered = [(cell, row[seed][cell]) for cell in sorted(row[min(row)]) for seed in sorted(row)]
    parts: dict[str, list[Floats]] = {}
    of_calibrations: dict[str, Floats] = {}
    used = set()  # alarms on nominal episodes have no terms of others
    for cell, terms in ordered:
        residuals = terms.numerator - terms.value * terms.denominator
        influence = residuals * len(residuals) / float(terms.denominator.sum())
        for sample, of_sample in _samples(cell, terms):
            part = influence[of_sample]
            parts.setdefault(sample, []).append(part * (len(part) / len(influence)))
            if terms.denominator[of_sample].any():
                used.add(sample)
        if (changes := terms.deviations).size:
            before = of_calibrations.get(cell[0], np.zeros(len(changes)))
            of_calibrations[cell[0]] = before + changes / len(ordered)
    of_tests = {sample: np.sum(parts[sample], axis=0) / len(ordered) for sample in sorted(used)}
    mean = float(np.mean([terms.value for _, terms in ordered]))
    return _Influences(mean, of_tests, of_calibrations)
