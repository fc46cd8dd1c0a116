"""Rows that are streamed into a sandbox: a state is handed over, and a prefix is scored anew."""

import shutil

import pytest
from helpers_boxed import boxed_run
from helpers_plugins import write_plugin

from oodd_eval import load_split
from oodd_eval.data.parts import lengths_of, parts_of
from oodd_eval.results.directory import ResultsDirectory

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


def test_rows_in_a_sandbox_are_scored_or_fail_with_a_reason(tiny_split, tmp_path):
    write_plugin(tmp_path / "plugin", "streamed", PLUGIN)
    whole, unfit = boxed_run(tmp_path / "plugin", tiny_split, tmp_path / "out", ["whole", "unfit"],
                             anomalies=["iid"], streamed=True)  # fmt: skip
    results, split = ResultsDirectory(tmp_path / "out"), load_split(tiny_split)
    assert whole.ok, whole.reason
    lengths = lengths_of(parts_of(split.environment("cartpole"), ["iid"]), None)
    for part, sequences in results.scores(whole.scores, lengths).parts.items():
        for found, n in zip(sequences, lengths[part], strict=True):
            assert found.tolist() == [row + 1.0 for row in range(n)]
    assert (unfit.status, "ValueError: no such state" in unfit.reason) == ("error", True)
