"""What `calibrate` promises on seven machines with three scores each, and what a hand sweep costs.

``python benchmarks/score_thresholds.py [--draws 500] [--logs 40] [--alarm threshold] [--hold 1]``
prints a table. In each draw so many healthy logs of a machine calibrate, and further healthy ones
are counted that alarm; an interval is of the mean over draws. The expectation is of ranks alone:
``1 - k / (n + 1)`` at the k-th smallest of n largest values, ``1 / (n + 1)`` above all of them. A
machine with counts has equal values, and may stay below.
"""

import argparse
import math
from fractions import Fraction

import numpy as np
from oodd_monitors import calibrate

ROWS = 120
WARM = 40  # rows before a log begins, in which a machine forgets its start
LEVELS = (0.05, 0.10)


def _recursion(noise, *coefficients):
    """Autoregressive rows along the last axis."""
    rows = np.zeros_like(noise)
    for t in range(noise.shape[-1]):
        rows[..., t] = noise[..., t]
        for lag, coefficient in enumerate(coefficients, 1):
            if t >= lag:
                rows[..., t] += coefficient * rows[..., t - lag]
    return rows


def arm(rng, shape):
    """A damped joint: two lags, Gaussian noise."""
    return _recursion(rng.normal(size=shape), 1.5, -0.7)


def drone(rng, shape):
    """Gusts with heavy tails."""
    return _recursion(rng.standard_t(2.5, size=shape), 0.6)


def valve(rng, shape):
    """Two regimes that switch, skewed steps."""
    switches = rng.random(shape) < 0.03
    regime = (np.cumsum(switches, axis=-1) + rng.integers(2, size=(*shape[:-1], 1))) % 2
    return _recursion((rng.gamma(0.7, size=shape) - 0.7) * (1 + 3 * regime), 0.5)


def pump(rng, shape):
    """Counts, whose rate wanders."""
    rate = np.exp(1 + 0.4 * _recursion(0.4 * rng.normal(size=shape), 0.9))
    return rng.poisson(rate).astype(float)


def battery(rng, shape):
    """Long memory without drift, and a level of its own in each log."""
    level = 2 * rng.normal(size=(*shape[:-1], 1))
    return level + _recursion(rng.normal(size=shape), 0.98)


def mill(rng, shape):
    """Batches: a gain of its own in each log, and heating up within it."""
    gain = np.exp(rng.normal(size=(*shape[:-1], 1)))
    return gain * (np.sqrt(np.arange(shape[-1])) + _recursion(rng.laplace(size=shape), 0.3))


def engine(rng, shape):
    """Calm and wild phases: the variance remembers itself."""
    noise, rows = rng.normal(size=shape), np.zeros(shape)
    variance = np.ones(shape[:-1])
    for t in range(shape[-1]):
        rows[..., t] = np.sqrt(variance) * noise[..., t]
        variance = 0.05 + 0.15 * rows[..., t] ** 2 + 0.8 * variance
    return rows


MACHINES = {f.__name__: f for f in (arm, drone, valve, pump, battery, mill, engine)}


def innovation(signal, rest):
    """What the row before does not foretell, in absolute value; none at the first row."""
    x, y = rest[..., :-1].ravel(), rest[..., 1:].ravel()
    slope, level = np.polyfit(x, y, 1)
    score = np.full(signal.shape, np.nan)
    score[..., 1:] = np.abs(signal[..., 1:] - level - slope * signal[..., :-1])
    return score


def residual(signal, rest):
    """Distance from what is usual in that row."""
    return np.abs(signal - rest.mean(axis=tuple(range(rest.ndim - 1))))


def running_error(signal, rest):
    """Mean of the squared innovations since the log began."""
    squares = innovation(signal, rest)[..., 1:] ** 2
    score = np.full(signal.shape, np.nan)
    score[..., 1:] = np.cumsum(squares, axis=-1) / np.arange(1, squares.shape[-1] + 1)
    return score


SCORES = {f.__name__: f for f in (innovation, residual, running_error)}


def scores_of(machine, score, rng, logs):
    """Scores of healthy logs, by a model that other healthy logs fitted."""
    signal = MACHINES[machine](rng, (logs + 20, WARM + ROWS))[..., WARM:]
    return SCORES[score](signal[20:], signal[:20])


def shares(machine, score, *, draws, logs, further=100, alarm="threshold", hold=1, seed=0):
    """Shares of further healthy logs that alarm, by draw: at each level, and above a hand sweep."""
    names = sorted(MACHINES), sorted(SCORES)
    number = [names[0].index(machine), names[1].index(score)]
    rows = []
    for draw in range(draws):
        rng = np.random.default_rng([seed, *number, draw])
        values = scores_of(machine, score, rng, logs + further)
        row = []
        for level in LEVELS:
            calibration = calibrate(values[:logs], level, alarm=alarm, hold=hold)
            largest = np.array([calibration.statistic(s).max() for s in values[logs:]])
            row.append(np.mean(largest > calibration.threshold))
        rows.append([*row, np.mean(largest > calibration.sweep[0])])
    return np.array(rows)


def expected(n, level):
    """Chance that a further log exceeds the threshold, by ranks of n + 1 exchangeable numbers."""
    return Fraction(math.floor((n + 1) * level + 1e-9), n + 1)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=500)
    parser.add_argument("--logs", type=int, default=40)
    parser.add_argument("--further", type=int, default=100)
    parser.add_argument("--alarm", default="threshold")
    parser.add_argument("--hold", type=int, default=1)
    options = parser.parse_args()
    n = options.logs // 2 if options.alarm == "cusum" else options.logs
    exact = [*(100 * float(expected(n, level)) for level in LEVELS), 100 / (n + 1)]
    print(
        f"{options.draws} draws, {options.logs} healthy logs, {options.alarm}, hold {options.hold}:"
    )
    print("percent of further healthy logs with an alarm, and 95 % interval over draws\n")
    head = ("at 5 %", "at 10 %", "above a hand sweep")
    print(f"{'machine':8} {'score':14}", *(f"{title:>22}" for title in head))
    print(f"{'ranks say':23}", *(f"{share:22.2f}" for share in exact))
    for machine in MACHINES:
        for score in SCORES:
            values = 100 * shares(machine, score, **vars(options))
            mean, half = (
                values.mean(axis=0),
                1.96 * values.std(axis=0, ddof=1) / math.sqrt(len(values)),
            )
            cells = (
                f"{m:.2f} ({m - h:.2f} to {m + h:.2f})" for m, h in zip(mean, half, strict=True)
            )
            print(f"{machine:8} {score:14}", *(f"{cell:>22}" for cell in cells), flush=True)


if __name__ == "__main__":
    main()
