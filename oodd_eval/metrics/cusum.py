"""From scores to alarms: standardization and the one CUSUM rule that every detector shares."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Alarms = NDArray[np.bool_]

UNIT: Final = 0.01
"""Scores enter the CUSUM as this many units per standard deviation (see docs/adr/0003)."""

DRIFT: Final = 0.0018
"""The paper's drift (allowance), section 3.2."""

THRESHOLD: Final = 0.01
"""The paper's threshold, section 3.2."""


@dataclass(frozen=True, slots=True)
class Standardization:
    """Mean and standard deviation of all defined calibration scores; NaN without any.

    Scores that are all equal have that mean and the standard deviation 0, without rounding.

    Parameters
    ----------
    mean, std
        Mean and standard deviation (ddof 0), in the unit of the scores.
    """

    mean: float
    std: float

    @classmethod
    def fit(cls, scores: Iterable[Floats]) -> "Standardization":
        """Pool all defined scores of the calibration trajectories.

        Scores whose sum or whose distance from their mean is no number raise `OverflowError`.
        """
        pooled = np.concatenate([np.zeros(0), *(s[~np.isnan(s)] for s in scores)])
        if not pooled.size:
            return cls(math.nan, math.nan)
        mean = math.fsum(pooled) / pooled.size
        if pooled.min() == pooled.max():
            # The mean of equal numbers may be rounded to another one.
            return cls(float(pooled[0]), 0.0)
        with np.errstate(over="ignore"):
            far = pooled - mean
        largest = float(np.abs(far).max())
        if math.isinf(largest):
            raise OverflowError("the standard deviation of these scores is too large")
        # Squares of large numbers are infinite, of small ones 0. A power of two as the unit rounds
        # nothing.
        unit = math.ldexp(1.0, math.frexp(largest)[1] - 1)
        std = unit * math.sqrt(math.fsum((far / unit) ** 2) / pooled.size)
        return cls(mean, std)

    @property
    def numbers(self) -> list[float]:
        """Mean and standard deviation, for files."""
        return [self.mean, self.std]

    def __call__(self, scores: Floats) -> Floats:
        """Return ``x_t = 0.01 (s_t - mean) / std``; NaN stays NaN.

        Where std is 0, any score above the mean is infinitely far from all that is nominal: x_t is
        infinite there, and 0 elsewhere. Without calibration scores x_t is 0.
        """
        if not self.std > 0:
            return np.where(np.isnan(scores), np.nan, np.where(scores > self.mean, np.inf, 0.0))
        return UNIT * ((scores - self.mean) / self.std)


def cusum(
    x: Floats, *, drift: float = DRIFT, threshold: float = THRESHOLD
) -> tuple[Floats, Alarms]:
    """One-sided cumulative sum (CUSUM; Page, Biometrika 41, 1954) of standardized scores.

    ``S_t = max(0, S_{t-1} + x_t - drift)``; an alarm at every t with ``S_t > threshold``, after
    which the sum starts again at 0. A lasting small rise of the scores and a short large one both
    raise an alarm.

    Parameters
    ----------
    x : float64 array of shape (T + 1,)
        Scores as `Standardization` returns them; NaN before the first defined step.
    drift
        Allowance per step, in the unit of x. Larger: fewer false alarms, blind to smaller changes.
    threshold
        Height of an alarm, in the unit of x. Larger: fewer false alarms, longer delay.

    Returns
    -------
    statistic : float64 array of shape (T + 1,)
        ``S_t`` before the reset that an alarm brings; 0 where x is undefined.
    alarms : bool array of shape (T + 1,)

    Notes
    -----
    With the paper's drift and threshold, 0.18 and 1 standard deviation, expect an alarm at roughly
    every tenth nominal step; `oodd_eval.metrics.alarms.GuaranteedAlarm` bounds the share of nominal
    episodes with an alarm. With an infinite threshold the sum never starts again.

    Examples
    --------
    >>> statistic, alarms = cusum(np.array([np.nan, 0.5, 0.5, 2.0, 0.0]), drift=0.25, threshold=1)
    >>> statistic.tolist(), alarms.tolist()
    ([0.0, 0.25, 0.5, 2.25, 0.0], [False, False, False, True, False])
    """
    statistic = np.zeros(len(x))
    alarms = np.zeros(len(x), dtype=bool)
    total = 0.0
    # The reset makes the recursion sequential; Python floats are faster than numpy scalars.
    for t, value in enumerate((x - drift).tolist()):
        if value != value:  # noqa: PLR0124  # NaN: not defined yet
            continue
        total = total + value
        if total <= 0.0:
            total = 0.0
            continue
        statistic[t] = total
        if total > threshold:
            alarms[t] = True
            total = 0.0
    return statistic, alarms
