"""Seconds that the random forests take on a part as large as the mini split's largest environment.

``python -m pytest benchmarks/bench_rf.py``: 40 training trajectories and 110 to score, of 300
transitions and 28 sensors each.
"""

import numpy as np
import pytest
from oodd_rf import make_rf

from oodd_eval import Trajectory


def episodes(n, seed):
    rng = np.random.default_rng(seed)
    times = 0.3 * np.arange(301)[:, None]
    for _ in range(n):
        rows = np.sin(times * rng.uniform(0.5, 2, 28) + rng.uniform(0, 6, 28))
        yield Trajectory(rows + 0.05 * rng.normal(size=rows.shape), np.zeros((300, 1)))


TRAIN, TEST = list(episodes(40, 0)), list(episodes(110, 1))


def test_fit(benchmark):
    rf = benchmark.pedantic(lambda: make_rf().fit(TRAIN), rounds=1)
    nodes = sum(t.node_count for m in rf.members_ for t in m.trees)
    benchmark.extra_info["megabytes"] = round(nodes * (64 + 8 * 28) / 1e6)
    assert benchmark.extra_info["megabytes"] < 200


@pytest.mark.parametrize("horizon", [1, 10])
def test_score(benchmark, horizon):
    rf = make_rf(horizon=horizon).fit(TRAIN)
    scores = benchmark.pedantic(rf.score_many, args=(TEST,), rounds=1)
    benchmark.extra_info["steps"] = sum(len(s) for s in scores)
    assert all(np.isfinite(s[horizon:]).all() for s in scores)
