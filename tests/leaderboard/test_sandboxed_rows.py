"""Rows that are streamed into a sandbox: a state is handed over, and a prefix is scored anew."""

import shutil

import pytest
from helpers_plugins import install
from oodd_leaderboard.sandbox.launcher import Sandbox

from oodd_eval import load_split
from oodd_eval.data.parts import lengths_of, parts_of
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import make_plan
from oodd_eval.scoring.runner import run

pytestmark = pytest.mark.skipif(not shutil.which("bwrap"), reason="needs bubblewrap")

PLUGIN = """
class Whole(Good):
    def score(self, x): return np.full(len(x), float(len(x)))

class Unfit(Good):
    def reset(self): pass
    def update(self, observation, action=None): return 1.0
    def restore(self, state): raise ValueError("no such state")
    def state(self): return {"x": np.ones(3)}

@hookimpl
def oodd_detectors(): return offer(whole=Whole, unfit=Unfit)
"""


def test_rows_in_a_sandbox_are_scored_or_fail_with_a_reason(tiny_split, monkeypatch, tmp_path):
    install(monkeypatch, tmp_path / "plugin", "streamed", PLUGIN)
    split, plugins = load_split(tiny_split), discover()
    plan = make_plan(plugins, split=split, detectors=["whole", "unfit"],
                     environments=["cartpole"], anomalies=["iid"])  # fmt: skip
    settings = RunSettings(jobs=1, limits=Limits(120), launcher=Sandbox(()), streamed=True)
    results = ResultsDirectory(tmp_path / "out")
    whole, unfit = run(plan, split, plugins, settings, results).records
    assert whole.ok, whole.reason
    lengths = lengths_of(parts_of(split.environment("cartpole"), ["iid"]), None)
    for part, sequences in results.scores(whole.scores, lengths).parts.items():
        for found, n in zip(sequences, lengths[part], strict=True):
            assert found.tolist() == [row + 1.0 for row in range(n)]
    assert (unfit.status, "ValueError: no such state" in unfit.reason) == ("error", True)
