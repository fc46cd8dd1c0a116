"""Exact intervals of shares, and the quantiles they need, without SciPy.

Both are from the regularized incomplete beta function, by its continued fraction (Lentz's method;
Press et al., Numerical Recipes, section 6.4), inverted by bisection.
"""

import functools
import math
from collections.abc import Callable
from typing import Final

_TERMS: Final = 10_000  # most of the fraction: ten times the root of a or b are enough

_TINY: Final = 1e-300
_EXACT: Final = 1e-15


def incomplete_beta(a: float, b: float, x: float) -> float:
    """Return the regularized incomplete beta function I_x(a, b), for a, b > 0 and x in [0, 1].

    >>> round(incomplete_beta(2, 3, 0.5), 12)  # P(at least 2 of 4 with chance 1/2) = 11 / 16
    0.6875
    """
    if x <= 0.0 or x >= 1.0:
        return float(x >= 1.0)
    if x > (a + 1) / (a + b + 2):
        # The fraction converges quickly on the other side only.
        return 1 - incomplete_beta(b, a, 1 - x)
    log = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b)
    front = math.exp(log + a * math.log(x) + b * math.log1p(-x)) / a
    c, d = 1.0, _inverse(1 - (a + b) * x / (a + 1))
    result = d
    for m in range(1, _TERMS):
        even = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        odd = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        for term in (even, odd):
            d = _inverse(1 + term * d)
            c = 1 + term / c
            c = c if abs(c) > _TINY else _TINY
            result *= c * d
        if abs(c * d - 1) < _EXACT:
            break
    return front * result


def _inverse(value: float) -> float:
    return 1 / (value if abs(value) > _TINY else _TINY)


@functools.lru_cache(maxsize=4096)
def clopper_pearson(successes: float, trials: float, level: float = 0.95) -> tuple[float, float]:
    """Return the exact interval of a share (Clopper & Pearson, Biometrika 26, 1934).

    Numbers need not be whole: means over detector seeds are between the intervals of whole ones.

    >>> [round(end, 4) for end in clopper_pearson(1, 20)]
    [0.0013, 0.2487]
    """
    tail = (1 - level) / 2
    low = (
        _root(lambda x: incomplete_beta(successes, trials - successes + 1, x) - tail)
        if successes > 0
        else 0.0
    )
    high = (
        _root(lambda x: incomplete_beta(successes + 1, trials - successes, x) - (1 - tail))
        if successes < trials
        else 1.0
    )
    return low, high


@functools.lru_cache(maxsize=256)
def t_quantile(p: float, freedom: int) -> float:
    """Return a quantile, for p above one half, of Student's t distribution.

    >>> round(t_quantile(0.975, 19), 4)
    2.093
    """
    # With x = f / (f + t^2), P(|T| > t) = I_x(f / 2, 1 / 2), which rises with x.
    x = _root(lambda x: incomplete_beta(freedom / 2, 0.5, x) - 2 * (1 - p))
    return math.sqrt(freedom * (1 - x) / x)


def _root(rising: Callable[[float], float]) -> float:
    """Return where in [0, 1] a rising function passes zero, to neighbouring doubles."""
    low, high = 0.0, 1.0
    while (middle := low + (high - low) / 2) not in (low, high):
        if rising(middle) < 0:
            low = middle
        else:
            high = middle
    return high
