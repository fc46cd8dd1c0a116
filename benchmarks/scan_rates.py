"""How often a scan calls an episode odd where none is, and how odd one must be to be called so.

``python benchmarks/scan_rates.py [--scans 300] [--fdr 0.1]`` draws largest statistics of n episodes
from known distributions, without any detector. First it prints the share of scans with an odd
episode among those that have none; then the multiple of the median of a further episode that nine
in ten scans call odd, where the others' are normal: 6 with a standard deviation of 1.3.
"""

import argparse
import sys

import numpy as np
from oodd_logs.scanning.outliers import Tail, q_values

FAMILIES = {
    "normal": lambda rng, n: np.abs(rng.normal(3, 1, n)),
    "Gumbel": lambda rng, n: 10 + rng.gumbel(size=n),
    "exponential": lambda rng, n: rng.exponential(size=n),
    "log-normal": lambda rng, n: rng.lognormal(sigma=1.0, size=n),
    "cube of exponential": lambda rng, n: rng.exponential(size=n) ** 3,
    "Pareto, exponent 3": lambda rng, n: 1 + rng.pareto(3, n),
    "Cauchy": lambda rng, n: np.abs(rng.standard_cauchy(n)),
}
SIZES = (8, 12, 20, 60, 200)


def p_of(statistics, index):
    """Return the p-value of one episode against all others."""
    tail = Tail.fit(np.delete(statistics, index))
    return tail.p(float(statistics[index])) if tail else 1.0


def odd(statistics, fdr):
    """Return whether each episode of a scan is called odd."""
    return q_values(np.array([p_of(statistics, i) for i in range(len(statistics))])) <= fdr


def false_share(draw, n, scans, fdr):
    """Return the share of scans without an odd episode in which one is called odd."""
    rngs = (np.random.default_rng([n, k]) for k in range(scans))
    return np.mean([odd(draw(rng, n), fdr).any() for rng in rngs])


def multiple(n, scans, fdr):
    """Return from which multiple of the median on nine in ten odd episodes are called odd."""
    for times in np.arange(1.5, 20, 0.5):
        called = 0
        for k in range(scans):
            nominal = np.random.default_rng([n, k]).normal(6, 1.3, n - 1)
            called += odd(np.append(nominal, times * np.median(nominal)), fdr)[-1]
        if called >= 0.9 * scans:
            return times
    return np.inf


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--scans", type=int, default=300)
    parser.add_argument("--fdr", type=float, default=0.1)
    options = parser.parse_args()
    print(f"share of scans with a false discovery, in %, of {options.scans} at {options.fdr}")
    print(f"{'':22}" + "".join(f"{n:>8}" for n in SIZES))
    for name, draw in FAMILIES.items():
        shares = [false_share(draw, n, options.scans, options.fdr) for n in SIZES]
        print(f"{name:22}" + "".join(f"{100 * share:8.1f}" for share in shares))
    times = [multiple(n, options.scans // 3, options.fdr) for n in SIZES[:-1]]
    print("multiple of the median" + "".join(f"{value:8.1f}" for value in times))
    return 0


if __name__ == "__main__":
    sys.exit(main())
