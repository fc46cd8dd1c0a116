"""Fitted detectors are kept by content key: scoring again never fits again."""

import numpy as np
import pytest
from helpers_plugins import install

from oodd_eval.data.split import load_split
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.plugins.state import pack
from oodd_eval.results.directory import FitStore, ResultsDirectory
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import make_plan
from oodd_eval.scoring.runner import run

pytestmark = pytest.mark.slow

PLUGIN = """
from pathlib import Path
import numpy as np
from dataclasses import dataclass
from oodd_eval import DetectorSpec, hookimpl
from oodd_eval.plugins.parameters import parameter

@dataclass(frozen=True)
class Parameters:
    scale: float = parameter(1.0)
    factor: float = parameter(1.0, decides="scores")
    device: str = parameter("cpu", decides="nothing")

LOG = Path({log!r})

class Mean:
    def __init__(self, seed=0, horizon=1, scale=1.0, factor=1.0, device="cpu"):
        self.horizon, self.factor = horizon, factor

    def fit(self, nominal):
        with LOG.open("a") as log:
            log.write("fit\\n")
        self.mean = float(np.mean([x.observations.mean() for x in nominal]))

    def score(self, x):
        return self.factor * np.abs(x.observations.astype(np.float64).mean(axis=1) - self.mean)

    def state(self):
        return {{"mean": self.mean}}

    def restore(self, state):
        with LOG.open("a") as log:
            log.write("restore\\n")
        self.mean = state["mean"]

class Forgets(Mean):
    def restore(self, state):
        raise RuntimeError("forgot how")

@hookimpl
def oodd_detectors():
    common = dict(parameters=Parameters, horizon_decides_fit=False)
    return [
        DetectorSpec("mean", Mean, "mean", **common),
        DetectorSpec("mean-too", Mean, "same fit", fit_name="mean", **common),
        DetectorSpec("forgets", Forgets, "cannot restore", **common),
    ]
"""


@pytest.fixture
def log(monkeypatch, tmp_path):
    path = tmp_path / "log"
    install(monkeypatch, tmp_path / "plugin", "means", PLUGIN.format(log=str(path)), header="")

    def events():
        lines = path.read_text().split() if path.exists() else []
        path.unlink(missing_ok=True)
        return lines

    return events


def go(directory, out, detectors=("mean",), *, fresh=False, jobs=1, **settings):
    split = load_split(directory)
    plan = make_plan(
        discover(), split=split, detectors=detectors,
        environments=split.environments[:1], **settings,
    )  # fmt: skip
    made = RunSettings(jobs=jobs, limits=Limits(60, None), fresh=fresh)
    return plan, run(plan, split, discover(), made, ResultsDirectory(out))


def test_scores_of_another_anomaly_need_no_second_fit(tiny_split, log, tmp_path):
    go(tiny_split, tmp_path / "out", anomalies=("iid",))
    assert log() == ["fit"]
    _, done = go(tiny_split, tmp_path / "out", anomalies=("iid", "drift"))
    assert log() == ["restore"]
    assert [r.status for r in done.records] == ["ok", "ok"]


def test_what_the_fit_ignores_shares_it(tiny_split, log, tmp_path):
    _, done = go(tiny_split, tmp_path / "out", ("mean", "mean-too"), horizons=(1, 2), jobs=2)
    assert sorted(log()) == ["fit", "restore", "restore", "restore"]
    assert {r.seconds_fit for r in done.records} == {done.records[0].seconds_fit}
    go(tiny_split, tmp_path / "out", parameters={"factor": 2.0})
    assert log() == ["restore"]


@pytest.mark.parametrize(
    "settings", [{"parameters": {"scale": 2.0}}, {"seeds": (1,)}, {"limit": 2}]
)
def test_what_decides_the_fit_has_a_key_of_its_own(tiny_split, log, tmp_path, settings):
    go(tiny_split, tmp_path / "out")
    log()
    go(tiny_split, tmp_path / "out", **settings)
    assert log() == ["fit"]


def test_a_restored_fit_gives_the_same_records(tiny_split, log, tmp_path):
    go(tiny_split, tmp_path / "one", anomalies=("iid",))
    _, restored = go(tiny_split, tmp_path / "one")
    _, fitted = go(tiny_split, tmp_path / "two")
    assert log() == ["fit", "restore", "fit"]
    assert [r.metrics for r in restored.records] == [r.metrics for r in fitted.records]


def test_fresh_fits_again_and_keeps_that(tiny_split, log, tmp_path):
    go(tiny_split, tmp_path / "out")
    go(tiny_split, tmp_path / "out", fresh=True)
    assert log() == ["fit", "fit"]
    go(tiny_split, tmp_path / "out", horizons=(3,))
    assert log() == ["restore"]
    # Once for what the units of a run share.
    go(tiny_split, tmp_path / "out", horizons=(1, 2), fresh=True)
    assert log() == ["fit", "restore"]


def test_a_damaged_fit_is_made_again(tiny_split, log, tmp_path):
    plan, _ = go(tiny_split, tmp_path / "out", anomalies=("iid",))
    file = tmp_path / "out" / "fitted" / f"{plan.units[0].fit_key}.npz"
    content = file.read_bytes()
    file.write_bytes(content.replace(b'"mean": ', b'"mean": 1', 1))
    assert file.read_bytes() != content
    log()
    _, done = go(tiny_split, tmp_path / "out", anomalies=("drift",))
    assert log() == ["fit"]
    assert done.records[0].ok


def test_directories_of_an_earlier_version_are_left_alone_and_named(tiny_split, log, tmp_path):
    plan, _ = go(tiny_split, tmp_path / "out", anomalies=("iid",))
    fitted = tmp_path / "out" / "fitted"
    (fitted / f"{plan.units[0].fit_key}.npz").unlink()
    old = fitted / plan.units[0].fit_key
    old.mkdir()
    (old / "fitted.json").write_text("{}")
    log()
    results = ResultsDirectory(tmp_path / "out")
    results.prepare()
    assert [note for note in results.notes if old.name in note and "deleted" in note]
    go(tiny_split, tmp_path / "out", anomalies=("drift",))
    assert log() == ["fit"]
    assert old.exists()


def test_a_detector_that_cannot_restore_itself_is_fitted(tiny_split, log, tmp_path):
    go(tiny_split, tmp_path / "out", ("forgets",), anomalies=("iid",))
    _, done = go(tiny_split, tmp_path / "out", ("forgets",), anomalies=("drift",))
    assert log() == ["fit", "fit"]
    assert done.records[0].ok
    _, done = go(tiny_split, tmp_path / "new", ("forgets",), anomalies=("iid",), horizons=(1, 2))
    assert log() == ["fit", "fit"]
    assert [r.status for r in done.records] == ["ok", "ok"]


def test_a_store_keeps_one_file_a_fit(tmp_path):
    store = FitStore(tmp_path / "fitted")
    assert store.find("k") is None
    state = {"order": np.asfortranarray(np.ones((2, 3), np.float32)), "word": ["a", None, {"b": 1}]}
    store.keep("k", pack(state), 2.5)
    assert [p.name for p in store.path.iterdir()] == ["k.npz"]
    kept = FitStore(store.path).find("k")
    assert kept.seconds_fit == 2.5
    assert kept.packed.state()["word"] == state["word"]
    array = kept.packed.arrays["order"]
    assert (array.dtype, array.shape, array.flags.f_contiguous) == (np.float32, (2, 3), True)
    assert FitStore(store.path).find("k", fresh=True) is None
