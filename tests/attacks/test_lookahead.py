"""Look-ahead in disguise: what hides it from the check of prefixes hides it from the metric, too.

A detector that knows the future has scores with matched AUC 1. A disguise adds to these what
anybody may add: functions of time or of the scores. The check looks at differences relative to the
spread of an episode's scores, so a disguise passes where it makes scores vary by far more than what
is hidden in them. Then they hardly order episodes any more: only among scores that lie close
together, which are less than a tenth of an episode's, does the hidden part decide.
"""

import itertools

import numpy as np
import pytest

from oodd_eval.metrics.auc import auc
from oodd_eval.plugins.contract import ROLLOUT_TOLERANCE, TOLERANCE
from oodd_eval.results.evaluate import difference

ROWS = 300
T = np.arange(float(ROWS))
RNG = np.random.default_rng(5)
NOISE = RNG.normal(size=ROWS)


def plateaus(many):
    return lambda x, size: x + size * np.floor(T * many / ROWS)


DISGUISES = {
    "constant": lambda x, size: x + size,
    "factor and constant": lambda x, size: x * size - size**2,
    "a spike in the first row": lambda x, size: x + size * (T == 0),
    "a spike in every twentieth row": lambda x, size: x + size * (T % 20 == 3),
    "a spike in every ninth row": lambda x, size: x + size * (T % 9 == 3),
    "growing spikes": lambda x, size: x + size * T * (T % 12 == 0),
    "a step": lambda x, size: x + size * (T > 60),
    "9 plateaus": plateaus(9),
    "40 plateaus": plateaus(40),
    "a trend": lambda x, size: x + size * T,
    "a slow wave": lambda x, size: x + size * np.sin(T / 40),
    "a fast wave": lambda x, size: x + size * np.sin(2 * T),
    "noise drawn once": lambda x, size: x + size * NOISE,
    "exponential": lambda x, size: np.exp(np.minimum(x * np.log(size), 600)),
    "squashed": lambda x, size: np.tanh(x / size),
    "rounded": lambda x, size: np.round(x * size) / size,
    "a sum from the start": lambda x, size: np.cumsum(x) + size,
    "in a tenth of the rows": lambda x, size: np.where(T % 10 == 4, x, 0.0) + size,
    "single precision": lambda x, size: (x + size).astype(np.float32).astype(np.float64),
}
SIZES = (1e1, 1e3, 1e5, 1e7, 1e12)


def episodes(disguise, size, onset=100):
    """Scores of an anomalous episode, of what is before its onset alone, and of a nominal episode.

    Before the disguise all scores of an anomalous episode are 1 higher, also before its onset.
    """
    nominal, twin = 0.1 * RNG.normal(size=(2, ROWS))
    whole, prefix = disguise(nominal + 1.0, size), disguise(nominal, size)[:onset]
    return whole, prefix, disguise(twin, size)


@pytest.mark.parametrize("name", DISGUISES)
def test_look_ahead_that_passes_the_check_orders_nothing(name):
    for size, onset in itertools.product(SIZES, (100, 240)):
        whole, found, twin = episodes(DISGUISES[name], size, onset)
        if difference(found, whole, ROLLOUT_TOLERANCE):
            continue
        # A tenth of the episode is a larger part of the rows that count.
        most = 0.5 * ROWS / 10 / (ROWS - onset) + 0.01
        gained = auc(whole[onset:], twin[onset:]) - 0.5
        assert gained < most, (size, onset, "the check does not see it, and the metric does")


def test_most_disguises_do_not_pass_and_the_undisguised_never():
    seen = [
        bool(difference(found, whole, TOLERANCE))
        for name in DISGUISES for size in SIZES
        for whole, found, _ in [episodes(DISGUISES[name], size)]
    ]  # fmt: skip
    assert np.mean(seen) > 0.6
    whole, found, twin = episodes(lambda x, _: x, 1)
    assert difference(found, whole, ROLLOUT_TOLERANCE)
    assert auc(whole, twin) > 0.99
