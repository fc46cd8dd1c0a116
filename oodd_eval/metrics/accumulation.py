"""Statistics of scores that a guaranteed alarm may watch beside their CUSUM.

All of them take the scores of an episode one by one and start anew with the next episode; their
thresholds are from calibration episodes, like that of a CUSUM (`oodd_eval.metrics.alarms`).

- ``"ewma"``: the exponentially weighted moving average of the standardized scores z, with the
  weight `WEIGHT`: ``S_t = (1 - w) S_{t-1} + w z_t`` from 0 on. It forgets: after a fault has ended
  it is down by half in 14 rows.
- ``"shiryaev-roberts"``: the sum of the likelihood ratios of a rise that began at any of the rows
  so far, ``R_t = (1 + R_{t-1}) exp(d z_t - d^2 / 2)``, for normal scores and a rise by d = `SHIFT`
  standard deviations (Shiryaev, Theory Probab. Appl. 8, 1963; Roberts, Technometrics 8, 1966). The
  rise is that which the harness's CUSUM is made for, whose drift is half of it.
- ``"e-detector"``: the mean over `BETS` of ``R_t = (1 + R_{t-1}) (1 + b (u_t - 1/2))``, where u is
  the score's rank among calibration scores as a share: a mixture of Shiryaev-Roberts e-detectors
  for the mean of a bounded variable (Shin, Ramdas and Rinaldo, "E-detectors: a nonparametric
  framework for sequential change detection", New England J. Statist. Data Sci. 2, 2024). It assumes
  no distribution, and a single score multiplies it by 1.5 at most.

The statistics of the last two are ``log(1 + R_t)``, which cannot overflow. A Shiryaev-Roberts sum
is then a CUSUM with a soft lower end: ``S_t = log(1 + exp(S_{t-1} + l_t))`` with the logarithm l of
the likelihood ratio, where a CUSUM is ``max(0, S_{t-1} + l_t)``.

Where the expectation of each factor given all earlier scores is at most 1, nominal scores take at
least A rows on average until R exceeds A (of both papers). docs/run-length.md measures how far that
holds; a guaranteed alarm does not rest on it.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final, Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from oodd_eval.metrics.cusum import DRIFT, UNIT, Standardization

Floats = NDArray[np.float64]

AlarmKind = Literal["cusum", "score", "ewma", "shiryaev-roberts", "e-detector"]
"""Statistic of the guaranteed alarms: one that the harness accumulates of the scores, or the score
itself, for a detector that accumulates by itself."""

STATISTICS: Final[tuple[AlarmKind, ...]] = get_args(AlarmKind)

NOUNS: Final[dict[AlarmKind, str]] = {
    "cusum": "a CUSUM",
    "score": "a score",
    "ewma": "an EWMA",
    "shiryaev-roberts": "a Shiryaev-Roberts sum",
    "e-detector": "an e-detector",
}
"""Statistics in sentences."""

WEIGHT: Final = 0.05
"""Weight of the newest score in the moving average."""

SHIFT: Final = 2 * DRIFT / UNIT
"""Rise of the scores, in standard deviations, that the Shiryaev-Roberts sum is made for: 0.36."""

BETS: Final = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Stakes of the e-detector: small ones for small lasting rises of the ranks, large for others."""

REFERENCE: Final = 512
"""Calibration scores that ranks are counted among, at most: their quantiles."""


class Basis(Protocol):
    """A transformation of scores that calibration episodes decide, the same at every row."""

    def __call__(self, scores: Floats) -> Floats:
        """Return what is accumulated, row by row; NaN stays NaN."""

    @property
    def numbers(self) -> list[float]:
        """The fit, for files."""


@dataclass(frozen=True, slots=True)
class Ranks:
    """Ranks of scores among those of calibration episodes, as shares.

    Parameters
    ----------
    values
        The calibration scores, or `REFERENCE` of their quantiles, in ascending order.

    Examples
    --------
    >>> ranks = Ranks.fit([np.array([np.nan, 1.0, 2.0]), np.array([2.0, 5.0])])
    >>> ranks(np.array([np.nan, 0.0, 1.0, 2.0, 9.0])).tolist()
    [nan, 0.0, 0.125, 0.5, 1.0]
    """

    values: tuple[float, ...]

    @classmethod
    def fit(cls, scores: Iterable[Floats]) -> "Ranks":
        """Pool all defined scores of the calibration episodes."""
        pooled = np.sort(np.concatenate([np.zeros(0), *(s[~np.isnan(s)] for s in scores)]))
        if len(pooled) > REFERENCE:
            middles = (np.arange(REFERENCE) + 0.5) / REFERENCE
            pooled = pooled[(middles * len(pooled)).astype(np.intp)]
        return cls(tuple(pooled.tolist()))

    @property
    def numbers(self) -> list[float]:
        """The calibration scores that ranks are counted among."""
        return list(self.values)

    def __call__(self, scores: Floats) -> Floats:
        """Return the share of calibration scores below each score, of equal ones half.

        NaN stays NaN; without calibration scores it is 1/2.
        """
        if not self.values:
            return np.where(np.isnan(scores), np.nan, 0.5)
        reference = np.array(self.values)
        counts = sum(np.searchsorted(reference, scores, side) for side in ("left", "right"))
        return np.where(np.isnan(scores), np.nan, counts / (2 * len(reference)))


def basis_of(kind: AlarmKind, scores: Sequence[Floats]) -> Standardization | Ranks | None:
    """Return what a statistic knows of calibration scores; None where it is the score itself."""
    if kind == "score":
        return None
    return Ranks.fit(scores) if kind == "e-detector" else Standardization.fit(scores)


def basis_from(kind: AlarmKind, numbers: Sequence[float]) -> Standardization | Ranks:
    """Return the basis with these numbers, as `Basis.numbers` gave them."""
    return Ranks(tuple(numbers)) if kind == "e-detector" else Standardization(*numbers)


class Accumulation:
    """A statistic of one episode as scores come in, from 0 on.

    Parameters
    ----------
    kind
        One of those above.

    Examples
    --------
    >>> ewma, ratios = Accumulation("ewma"), Accumulation("shiryaev-roberts")
    >>> [round(ewma.update(0.01 * z), 6) for z in (1.0, 1.0, 0.0)]
    [0.05, 0.0975, 0.092625]
    >>> [round(ratios.update(0.01 * z), 6) for z in (SHIFT / 2, SHIFT / 2)]  # ratios of 1
    [0.693147, 1.098612]
    """

    def __init__(self, kind: AlarmKind) -> None:
        self._step: Callable[[float], float] = {
            "ewma": self._average,
            "shiryaev-roberts": self._sum_ratios,
            "e-detector": self._bet,
        }[kind]
        self._sum = 0.0
        self._sums = [0.0] * len(BETS)

    def update(self, x: float) -> float:
        """Return the statistic after the next value of the basis; after NaN it is 0."""
        return 0.0 if math.isnan(x) else self._step(x)

    def _average(self, x: float) -> float:
        self._sum = (1 - WEIGHT) * self._sum + WEIGHT * (x / UNIT)
        return self._sum

    def _sum_ratios(self, x: float) -> float:
        self._sum = _log_of_1_plus_exp(self._sum + SHIFT * (x / UNIT) - SHIFT**2 / 2)
        return self._sum

    def _bet(self, x: float) -> float:
        sums = [
            _log_of_1_plus_exp(s + math.log1p(b * (x - 0.5)))
            for s, b in zip(self._sums, BETS, strict=True)
        ]
        self._sums, top = sums, max(sums)
        return top + math.log(sum(math.exp(s - top) for s in sums) / len(sums))


def _log_of_1_plus_exp(x: float) -> float:
    return max(x, 0.0) + math.log1p(math.exp(-abs(x)))


def accumulated(kind: AlarmKind, x: Floats) -> Floats:
    """Return the statistic of an episode row by row.

    Parameters
    ----------
    kind
        One of ``"ewma"``, ``"shiryaev-roberts"``, ``"e-detector"``.
    x : float64 array of shape (T,)
        Standardized scores as `oodd_eval.metrics.cusum.Standardization` returns them, for the
        e-detector ranks as shares; NaN where undefined.

    Returns
    -------
    float64 array of shape (T,)
        0 where x is undefined.

    Examples
    --------
    >>> accumulated("ewma", np.array([np.nan, 0.02, 0.0])).tolist()
    [0.0, 0.1, 0.095]
    """
    statistic = Accumulation(kind)
    return np.array([statistic.update(value) for value in x.tolist()], np.float64)
