"""From a statistic to the share of nominal rows in which it is as large."""

from __future__ import annotations

from typing import Final

import numpy as np
from oodd_common.charts import Floats

from oodd_eval.plugins.state import Arrays, take

TAIL: Final = 0.1
"""Share of the largest nominal values, in which their tail is fitted."""
KNOTS: Final = np.linspace(0.0, 1.0 - TAIL, 181)
"""Shares of nominal values between which values are interpolated."""
EXCEEDANCES: Final = 200
"""Values in the tail that weigh as much as the other members' scales."""
LEAST_SCALE: Final = 0.02
"""Least scale of a tail, relative to where it begins: what never got larger may still do so."""
SMALLEST: Final = 1e-9
"""Statistics below this are none."""


class SurpriseScale:
    """Surprise of a statistic: minus the natural logarithm of its p-value on nominal rows.

    Below the upper tenth the share is counted; beyond it values have an exponential tail. Its scale
    is the median excess over the logarithm of two, which few odd rows among the nominal ones do not
    move, where a mean would.
    """

    def fit(self, values: Floats) -> None:
        """Learn from values of nominal rows that the statistic was not fitted on, (N,)."""
        self.knots_ = np.quantile(values, KNOTS)
        excess = values[values > self.knots_[-1]] - self.knots_[-1]
        self.exceedances = len(excess)
        scale = float(np.median(excess) / np.log(2)) if len(excess) else 0.0
        self.scale_ = np.array(max(scale, LEAST_SCALE * max(abs(float(self.knots_[-1])), SMALLEST)))

    def draw(self, common: float) -> None:
        """Draw the scale towards a common one, relative to where the tail begins.

        The more, the fewer values it is estimated from.
        """
        weight = self.exceedances / (self.exceedances + EXCEEDANCES)
        self.scale_ = np.array(float(self.scale_) * (common / self.relative()) ** (1 - weight))

    def relative(self) -> float:
        """Return the scale of the tail relative to where it begins."""
        return float(self.scale_) / max(abs(float(self.knots_[-1])), SMALLEST)

    def __call__(self, values: Floats) -> Floats:
        """Return surprises, at least 0: (N,) to (N,)."""
        shares = np.interp(values, self.knots_, KNOTS)
        beyond = np.maximum(values - self.knots_[-1], 0.0) / self.scale_
        surprises: Floats = beyond - np.log1p(-shares)
        return surprises

    def arrays(self) -> Arrays:
        """Return what `restore` takes."""
        return {"knots": self.knots_, "scale": self.scale_}

    def restore(self, arrays: Arrays) -> None:
        """Take over a fit."""
        self.knots_ = take(arrays, "knots", KNOTS.shape)
        self.scale_ = take(arrays, "scale", (), "+")
