"""Cost of a network per sensor beside one trunk with a head per sensor: CPU seconds.

``python benchmarks/bench_trunk.py``. RIQN on the mini split, with few updates, since the time of a
fit grows with them; scoring is that of the test part. For the AUCs run ``oodd-eval run --detector
riqn --env cartpole,acrobot,hopper --param trunk=per-feature`` and with ``trunk=shared``.
"""

import functools
import time

import torch
from oodd_riqn import riqn
from tabulate import tabulate

from oodd_eval import load_split
from oodd_eval.data.facts import TABLE1

UPDATES = 30


def seconds(call):
    start = time.process_time()
    call()
    return time.process_time() - start


def main():
    torch.set_num_threads(1)
    split, table = load_split("mini"), []
    for name in ("cartpole", "acrobot", "hopper"):
        data = split.environment(name)
        train, test = list(data.train), [t for a in TABLE1 for t in data.anomalous(a)]
        steps = sum(t.transitions for t in test)
        made = {
            t: riqn(seed=0, horizon=1, trunk=t, updates=UPDATES) for t in ("shared", "per-feature")
        }
        fit = {t: seconds(functools.partial(d.fit, train)) for t, d in made.items()}
        score = {
            t: 1e6 * seconds(functools.partial(d.score_many, test)) / steps for t, d in made.items()
        }
        ratios = [f"{v['per-feature'] / v['shared']:.1f}" for v in (fit, score)]
        table.append(
            [name, train[0].observation_dim, *fit.values(), ratios[0], *score.values(), ratios[1]]
        )
    header = [
        "",
        "sensors",
        "fit shared",
        "per-feature",
        "times",
        "score shared",
        "per-feature",
        "times",
    ]
    print(tabulate(table, header, floatfmt=".1f"))
    print(f"seconds for {UPDATES} updates, and microseconds a scored step")


if __name__ == "__main__":
    main()
