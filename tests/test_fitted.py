"""Fitted detectors are kept by content key: scoring again never fits again."""

import json

import pytest
from helpers_plugins import install

from oodd_eval.data.split import load_split
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.results.directory import FitStore, ResultsDirectory
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import make_plan
from oodd_eval.scoring.runner import run

pytestmark = pytest.mark.slow

PLUGIN = """
import json, os
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

    def save(self, directory):
        (directory / "mean.json").write_text(json.dumps(self.mean))

    def load(self, directory):
        with LOG.open("a") as log:
            log.write("load\\n")
        self.mean = json.loads((directory / "mean.json").read_text())

class Forgets(Mean):
    def load(self, directory):
        raise RuntimeError("forgot how")

@hookimpl
def oodd_detectors():
    common = dict(parameters=Parameters, horizon_decides_fit=False)
    return [
        DetectorSpec("mean", Mean, "mean", **common),
        DetectorSpec("mean-too", Mean, "same fit", fit_name="mean", **common),
        DetectorSpec("forgets", Forgets, "cannot load", **common),
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
    assert log() == ["load"]
    assert [r.status for r in done.records] == ["ok", "ok"]


def test_what_the_fit_ignores_shares_it(tiny_split, log, tmp_path):
    _, done = go(tiny_split, tmp_path / "out", ("mean", "mean-too"), horizons=(1, 2), jobs=2)
    assert sorted(log()) == ["fit", "load", "load", "load"]
    assert {r.seconds_fit for r in done.records} == {done.records[0].seconds_fit}
    go(tiny_split, tmp_path / "out", parameters={"factor": 2.0})
    assert log() == ["load"]


@pytest.mark.parametrize(
    "settings", [{"parameters": {"scale": 2.0}}, {"seeds": (1,)}, {"limit": 2}]
)
def test_what_decides_the_fit_has_a_key_of_its_own(tiny_split, log, tmp_path, settings):
    go(tiny_split, tmp_path / "out")
    log()
    go(tiny_split, tmp_path / "out", **settings)
    assert log() == ["fit"]


def test_a_loaded_fit_gives_the_same_records(tiny_split, log, tmp_path):
    go(tiny_split, tmp_path / "one", anomalies=("iid",))
    _, loaded = go(tiny_split, tmp_path / "one")
    _, fitted = go(tiny_split, tmp_path / "two")
    assert log() == ["fit", "load", "fit"]
    assert [r.metrics for r in loaded.records] == [r.metrics for r in fitted.records]


def test_fresh_fits_again_and_keeps_that(tiny_split, log, tmp_path):
    go(tiny_split, tmp_path / "out")
    go(tiny_split, tmp_path / "out", fresh=True)
    assert log() == ["fit", "fit"]
    go(tiny_split, tmp_path / "out", horizons=(3,))
    assert log() == ["load"]


def test_fresh_fits_once_what_the_units_of_a_run_share(tiny_split, log, tmp_path):
    go(tiny_split, tmp_path / "out", anomalies=("iid",))
    log()
    go(tiny_split, tmp_path / "out", anomalies=("iid",), horizons=(1, 2), fresh=True)
    assert log() == ["fit", "load"]


@pytest.mark.parametrize("damage", ["bytes", "index", "gone"])
def test_a_damaged_fit_is_made_again(tiny_split, log, tmp_path, damage):
    plan, _ = go(tiny_split, tmp_path / "out", anomalies=("iid",))
    key = plan.units[0].fit_key
    place = tmp_path / "out" / "fitted" / key
    match damage:
        case "bytes":
            (place / "mean.json").write_text("123.0")
        case "index":
            (place / "fitted.json").write_text("{}")
        case "gone":
            (place / "mean.json").unlink()
    log()
    _, done = go(tiny_split, tmp_path / "out", anomalies=("drift",))
    assert log() == ["fit"]
    assert done.records[0].ok


def test_a_detector_that_cannot_load_itself_is_fitted(tiny_split, log, tmp_path):
    go(tiny_split, tmp_path / "out", ("forgets",), anomalies=("iid",))
    _, done = go(tiny_split, tmp_path / "out", ("forgets",), anomalies=("drift",))
    assert log() == ["fit", "fit"]
    assert done.records[0].ok


def test_a_fit_of_the_same_run_that_cannot_be_loaded_is_made_again(tiny_split, log, tmp_path):
    _, done = go(tiny_split, tmp_path / "out", ("forgets",), anomalies=("iid",), horizons=(1, 2),
                 fresh=True)  # fmt: skip
    assert log() == ["fit", "fit"]
    assert [r.status for r in done.records] == ["ok", "ok"]


def test_a_store_keeps_whole_directories_only(tmp_path):
    store = FitStore(tmp_path / "fitted")
    assert store.find("k") is None
    with store.filling() as room:
        (room / "a").write_text("1")
        store.keep("k", room, 2.5)
    found = store.find("k")
    assert found is not None
    assert found.seconds_fit == 2.5
    assert json.loads((found.path / "fitted.json").read_text())["files"].keys() == {"a"}
    with store.filling() as room:
        store.keep("empty", room, 1.0)
    assert store.find("empty") is None
    assert [p.name for p in store.path.iterdir()] == ["k"]
