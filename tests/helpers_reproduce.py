"""The paper's detectors in name only: quick, causal, and different from one another."""

from helpers_plugins import install

QUICK = """
from dataclasses import dataclass
from oodd_eval.plugins.parameters import parameter

class Quick:
    '''|o_t - o_{t-h}| plus noise that shrinks with members and samples, keyed by seed.'''
    def __init__(self, name, *, seed, horizon, members=5, samples=8, **others):
        self.horizon = horizon
        self.noise = NOISE[name] / (members * min(samples, 8))
        self.seed = seed
    def fit(self, nominal):
        if SLOW: time.sleep(SLOW)
        rows = np.concatenate([x.observations for x in nominal]).astype(np.float64)
        self.std = np.maximum(rows.std(axis=0), 1e-6)
    def score(self, x):
        rows = x.observations / self.std
        scores = np.full(len(rows), np.nan)
        moved = np.abs(rows[self.horizon:] - rows[:-self.horizon]).mean(axis=1)
        noise = np.random.default_rng(self.seed).normal(size=len(rows))[self.horizon:]
        scores[self.horizon:] = moved + self.noise * noise
        return scores

NOISE = {"riqn": 0.5, "riqn-ms": 1.0, "n-riqn": 6.0, "npn": 3.0, "rf": 10.0, "mewma": 1.0,
         "mewma-a": 1.0, "rf-ewma": 9.0}
SLOW = float(os.environ.get("QUICK_SECONDS", 0))

def make(name):
    return lambda *, seed=0, horizon=1, **p: Quick(name, seed=seed, horizon=horizon, **p)

@dataclass(frozen=True)
class Sizes:
    members: int = parameter(5)
    samples: int = parameter(8)
    updates: int = parameter(1250)

@hookimpl
def oodd_detectors():
    return [DetectorSpec(n, make(n), "a test's", parameters=Sizes) for n in NOISE]
"""


def install_quick(monkeypatch, path):
    """Put the quick detectors in the place of the paper's, here and in processes started here."""
    install(monkeypatch, path, "quick", QUICK)
    monkeypatch.setenv("OODD_EVAL_PLUGINS", "quick")
    monkeypatch.setenv("PYTHONPATH", str(path))
