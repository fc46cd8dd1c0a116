"""Speed of RIQN beside a slow loop, the released code and the processor: one thread.

``python benchmarks/bench_riqn.py``. Every figure is measured in turns with the others, several
times, and medians are printed, so that a busy machine slows all of them alike: read the ratios.

The slow loop is the obvious way to score: one step, one member and one sample after the other, each
a product of a vector and a matrix. The released code was timed once, on a machine like the one that
`RELEASED` names; its rates are the yardstick that the project set itself, and not measured here.

What bounds the speed: at horizon 1 the GRU's products over time, 64 x 192 for as many rows as there
are trajectories; at larger horizons products of 1024 x 64 x 64, and between them passes over
their results, which add up to most of the time.
"""

import functools
import statistics
import time
from dataclasses import replace

import numpy as np
import torch
from oodd_riqn import riqn
from oodd_torch.forecast import Forecaster, quantile_levels
from oodd_torch.network import GRID, Architecture, Ensemble
from oodd_torch.training import train
from tabulate import tabulate

from oodd_eval import Trajectory

MEMBERS, SAMPLES, SENSORS = 5, 8, 6
"""The paper's ensemble and sampling sizes, on Acrobot."""

RELEASED = {1: 92.0, 10: 5.4}
"""Scored steps per second of the released code on Acrobot: two-core server at 2.x GHz."""

RELEASED_TRAINING = 27_000.0
"""Transitions per second of the released training, batch 128, one quantile, no gradient in time."""

ROUNDS = 5


class Walker:
    """The slow loop as it would run on a robot: memory carried along, one step at a time.

    Every member and every sample is a pass of its own over single vectors, and the cosine embedding
    is computed anew for each.
    """

    def __init__(self, made, *, horizon, samples, mean_sampling, seed):
        if mean_sampling or made.architecture.per_feature or made.architecture.window > 1:
            raise ValueError("the walker knows riqn with a shared trunk only")
        self.made, self.horizon, self.samples, self.seed = made, horizon, samples, seed
        self.weights = [{n: p[e] for n, p in made.named_parameters()} for e in range(made.members)]

    def errors(self, rows, count):
        """Return the first `count` errors of a trajectory of standardized observations."""
        a, h = self.made.architecture, self.horizon
        rows = torch.tensor(rows)
        memories = [torch.zeros(a.units) for _ in self.weights]
        found = []
        for t in range(count):
            drawn = quantile_levels(
                self.seed, range(t + h, t + h + 1), h, len(self.weights), self.samples, a.features
            )
            total = 0.0
            for e, p in enumerate(self.weights):
                newest = rows[t]
                f, memories[e] = gru_step(p, newest, memories[e])
                for m in range(self.samples):
                    o, g, memory = newest, f, memories[e]
                    for k in range(h):
                        if k:
                            g, memory = gru_step(p, o, memory)
                        linear = o @ self.made.base[:-1] + self.made.base[-1]
                        o = linear + self.made.unit * change(p, g, memory, drawn[0, k, e, m])
                    total += float((rows[t + h] - o).abs().mean())
            found.append(total / len(self.weights) / self.samples)
        return np.array(found)


def gru_step(p, observation, memory):
    h = len(memory)
    f = torch.relu(observation @ p["first"] + p["first_bias"][0])
    gates, recurrent = f @ p["gru_in"] + p["gru_in_bias"][0], memory @ p["gru"] + p["gru_bias"][0]
    reset = torch.sigmoid(gates[:h] + recurrent[:h])
    update = torch.sigmoid(gates[h : 2 * h] + recurrent[h : 2 * h])
    candidate = torch.tanh(gates[2 * h :] + reset * recurrent[2 * h :])
    return f, (1 - update) * candidate + update * memory


def change(p, f, memory, index):
    z = torch.relu(memory @ p["second"] + p["second_bias"][0]) + f
    tau = (torch.from_numpy(index.astype(np.float32))[:, None] + 0.5) / GRID
    cosines = torch.cos(torch.pi * torch.arange(len(p["cosine"])) * tau)
    phi = torch.relu(cosines @ p["cosine"] + p["cosine_bias"][0])  # (D, H)
    return ((z * phi) * p["out"].T).sum(1) + p["out_bias"][0]


def episodes(n, length=300, seed=0):
    rng = np.random.default_rng(seed)
    times = 0.3 * np.arange(length + 1)[:, None]
    rows = [
        np.sin(times * rng.uniform(0.5, 2, SENSORS) + rng.uniform(0, 6, SENSORS)) for _ in range(n)
    ]
    return [Trajectory(r + 0.05 * rng.normal(size=r.shape), np.zeros((length, 1))) for r in rows]


def flops_forward(architecture, levels):
    """Multiplications and additions of one step of one member's forward pass at N levels."""
    a, h = architecture, architecture.units
    gru = 2 * 2 * h * 3 * h if a.recurrent else 0
    return 2 * a.window * a.features * h + gru + 2 * h * h + 2 * h * a.features * levels


def flops_scoring(architecture, horizon):
    """The same for one scored step of the ensemble: one pass, then M rollouts of h - 1 steps."""
    a = architecture
    rolled = flops_forward(a, 1) * SAMPLES * (horizon - 1)
    return MEMBERS * (flops_forward(a, SAMPLES) + rolled)


def peak():
    """Floating-point operations per second of large matrix products."""
    a = torch.randn(1024, 1024)
    start = time.perf_counter()
    for _ in range(10):
        a @ a
    return 10 * 2 * 1024**3 / (time.perf_counter() - start)


def rate(call, steps):
    start = time.perf_counter()
    call()
    return steps / (time.perf_counter() - start)


def network():
    generators = [torch.Generator().manual_seed(i) for i in range(MEMBERS)]
    still = np.eye(SENSORS + 1, SENSORS, dtype=np.float32)
    made = Ensemble(Architecture(SENSORS), generators, still, np.full(SENSORS, 0.5, np.float32))
    with torch.no_grad():
        made.out.normal_(0, 0.3, generator=generators[0])
    return made.requires_grad_(requires_grad=False)


def scoring(horizon):
    """Return rates of scoring: fast, slow, and the peak, each in every round."""
    made = network()
    rows = [e.observations for e in episodes(64 if horizon == 1 else 12)]
    options = {"horizon": horizon, "samples": SAMPLES, "mean_sampling": False, "seed": 0}
    forecaster = Forecaster(made, **options)
    steps = sum(len(r) - horizon for r in rows)
    few = 30 if horizon == 1 else 4
    walker = Walker(made, **options)
    (expected, *_) = forecaster.errors(rows[:2])
    np.testing.assert_allclose(walker.errors(rows[0], few), expected[:few], atol=1e-5)
    for _ in range(ROUNDS):
        yield (
            rate(lambda: forecaster.errors(rows), steps),
            rate(lambda: walker.errors(rows[0], few), few),
            peak(),
        )


def training():
    """Return transitions per second and member of training, and the peak, in every round."""
    rows = [e.observations for e in episodes(64)]
    schedule = riqn(seed=0, horizon=1).schedule
    quick = replace(schedule, updates=60)
    for _ in range(ROUNDS):
        made = network().requires_grad_()
        rngs = [np.random.default_rng(i) for i in range(MEMBERS)]
        transitions = MEMBERS * quick.updates * schedule.batch * schedule.chunk
        call = functools.partial(train, made, rows, rows[:1], quick, rngs)
        yield rate(call, transitions), peak()


def line(name, rounds, work, released, *, slow=False):
    """Return a row of the table from the rates of all rounds: fast, slow or nothing, and peak."""
    fast = statistics.median(r[0] for r in rounds)
    share = statistics.median(r[0] * work / r[-1] for r in rounds)
    times = f"{statistics.median(r[0] / r[1] for r in rounds):,.0f}" if slow else ""
    gigaflops = f"{fast * work / 1e9:.1f}"
    return [
        name,
        f"{fast:,.0f}",
        times,
        f"{fast / released:,.1f}",
        f"{work / 1e6:.2f}",
        gigaflops,
        f"{share:.0%}",
    ]


def main():
    torch.set_num_threads(1)
    architecture = Architecture(SENSORS)
    rows = [
        line(
            f"score, Δ = {h}",
            list(scoring(h)),
            flops_scoring(architecture, h),
            RELEASED[h],
            slow=True,
        )
        for h in (1, 10)
    ]
    rounds = list(training())
    # A backward pass costs two forward passes.
    work = 3 * flops_forward(architecture, riqn(seed=0, horizon=1).schedule.levels)
    rows.append(line("train one member", rounds, work, RELEASED_TRAINING))
    header = ["", "steps/s", "x slow loop", "x released", "MFLOP/step", "GFLOP/s", "of peak"]
    print(tabulate(rows, header, disable_numparse=True, stralign="right"))
    print(f"peak of matrix products: {statistics.median(r[-1] for r in rounds) / 1e9:.0f} GFLOP/s")


if __name__ == "__main__":
    main()
