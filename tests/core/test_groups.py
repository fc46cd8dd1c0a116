"""Groups of trajectories are scored apart: nothing that a detector remembers leads to a partner."""

import tempfile

import h5py
import numpy as np
import pytest
from helpers_plugins import install

from oodd_eval import evaluate, load_split
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import make_plan
from oodd_eval.scoring.runner import run

pytestmark = pytest.mark.slow

PLUGIN = '''
import hashlib, os, signal, subprocess, sys, threading, time
from concurrent.futures import ThreadPoolExecutor
import numpy as np
import psutil
from oodd_eval import DetectorSpec, hookimpl


class Plain:
    def __init__(self, *, seed, horizon): pass
    def fit(self, nominal): self.scale = float(abs(nominal[0].observations).mean())
    def score(self, x): return abs(x.observations).sum(axis=1).astype(float) / self.scale


class Remembers(Plain):
    """Counts the trajectories that it has scored; never the same score twice."""
    seen = 0
    def score(self, x):
        Remembers.seen += 1
        return np.full(len(x), float(Remembers.seen))


class Threads(Plain):
    def fit(self, nominal):
        super().fit(nominal)
        threading.Thread(target=time.sleep, args=(600,), daemon=True).start()


class ThreadsSaved(Threads):
    def state(self): return {"scale": self.scale}
    def restore(self, state): self.scale = state["scale"]


class Pool(Plain):
    """Joins its threads, whose last moments the system takes its time for."""
    def fit(self, nominal):
        super().fit(nominal)
        with ThreadPoolExecutor(16) as pool: list(pool.map(time.sleep, [0.001] * 64))


class Helped(Plain):
    """Leaves a process of its fit, and one of every group."""
    def fit(self, nominal):
        super().fit(nominal)
        self.helper = subprocess.Popen(["sleep", "600"])
    def score(self, x):
        if not hasattr(self, "alone"):
            ours = [p for p in psutil.process_iter() if os.getpgid(p.pid) == os.getpgid(0)]
            states = [p.status() for p in ours if p.name() == "sleep"]
            self.alone = set(states) <= {psutil.STATUS_ZOMBIE}
            self.own = subprocess.Popen(["sleep", "600"])
        return np.full(len(x), 0.0) if self.alone else super().score(x)


class HelpedSaved(Helped):
    def state(self): return {"scale": self.scale}
    def restore(self, state): self.scale = state["scale"]


class Talks(Plain):
    def fit(self, nominal):
        super().fit(nominal)
        print("fitted once", end="")
    def score(self, x): return np.full(len(x), np.inf)


class SavedDies(ThreadsSaved):
    def score(self, x): raise ValueError("no")


class Grows(Plain):
    """As large in the process that fits as in each that scores, and neither too large alone."""
    def fit(self, nominal):
        super().fit(nominal)
        self.much = np.ones(25_000_000)
    def score(self, x):
        self.much = np.ones(25_000_000)
        time.sleep(5)


class Acts(Plain):
    def fit(self, nominal): self.widths = {x.action_dim for x in nominal}
    def score(self, x): return np.full(len(x), float(max(self.widths | {x.action_dim})))


@hookimpl
def oodd_detectors():
    made = {"plain": Plain, "remembers": Remembers, "threads": Threads,
            "threads-saved": ThreadsSaved, "acts": Acts,
            "pool": Pool, "helped": Helped, "helped-saved": HelpedSaved, "talks": Talks,
            "saved-dies": SavedDies, "grows": Grows}
    both = DetectorSpec("acts-both", Acts, "", inputs="observations+actions")
    return [*(DetectorSpec(name, one, "") for name, one in made.items()), both]
'''


@pytest.fixture
def plugin(monkeypatch, tmp_path):
    install(monkeypatch, tmp_path / "plugin", "groups", PLUGIN, header="")


def first(detector, split, **settings):
    records = evaluate(detector, split, environments="hopper", anomalies="iid,drift", **settings)
    return records[0]


def test_state_that_outlives_an_episode_orders_nothing(plugin, tiny_split):
    assert first("remembers", tiny_split).value("auc_matched") == 0.5


def test_a_fit_with_running_threads_is_loaded_anew_for_every_group(plugin, tiny_split, tmp_path):
    plain = first("plain", tiny_split)
    assert repr(first("threads-saved", tiny_split).metrics) == repr(plain.metrics)
    for _ in range(2):  # fitted and saved, then loaded
        kept = first("threads-saved", tiny_split, output=tmp_path / "out")
        assert repr(kept.metrics) == repr(plain.metrics)
        for file in (tmp_path / "out" / "scores").glob("*.h5"):
            file.unlink()


def test_threads_and_no_saved_fit_are_incompatible(plugin, tiny_split):
    record = first("threads", tiny_split)
    assert record.status == "incompatible"
    assert "cannot be forked" in record.reason


def test_threads_that_were_joined_are_waited_for(plugin, tiny_split):
    record = first("pool", tiny_split)
    assert record.ok, record.reason


def test_processes_of_a_fit_or_a_group_are_shared_by_no_groups(plugin, tiny_split):
    record = first("helped", tiny_split)
    assert record.status == "incompatible"
    assert "threads or processes run on after fit" in record.reason
    # None of those that were started before is found by any group.
    assert first("helped-saved", tiny_split).value("auc_matched") == 0.5


def test_a_fit_that_was_saved_to_be_loaded_leaves_no_file(
    plugin, tiny_split, tmp_path, monkeypatch
):
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    for detector, status in (("saved-dies", "error"), ("threads-saved", "ok"), ("plain", "ok")):
        assert first(detector, tiny_split).status == status
        assert not list(tmp_path.glob("oodd-eval-*"))


def test_what_a_fit_prints_is_printed_once(plugin, tiny_split, tmp_path):
    assert first("talks", tiny_split, output=tmp_path / "out").status == "invalid"
    (log,) = (tmp_path / "out" / "logs").iterdir()
    assert log.read_text().count("fitted once") == 1


def limited(detector, split, memory):
    opened = load_split(split)
    plan = make_plan(discover(), split=opened,
                     detectors=[detector], environments=["hopper"], anomalies=["iid"])  # fmt: skip
    settings = RunSettings(jobs=1, limits=Limits(60, memory))
    return run(plan, opened, discover(), settings, None).records[0]


def test_memory_of_a_group_and_its_worker_counts_together(plugin, tiny_split):
    record = limited("grows", tiny_split, 400_000_000)
    assert (record.status, "over the limit of 400 MB" in record.reason) == ("oom", True)


def test_actions_are_withheld_from_whoever_does_not_declare_them(plugin, tiny_split):
    split = load_split(tiny_split)
    shown = {}
    for name in ("acts", "acts-both"):
        results = tiny_split.parent / f"out-{name}"
        evaluate(name, split, environments="hopper", anomalies="iid", output=results)
        (file,) = (results / "scores").glob("*.h5")
        with h5py.File(file) as scores:
            shown[name] = float(np.max(scores["test/iid/scores"][:]))
    width = split.environment("hopper").train[0].action_dim
    assert shown == {"acts": 0.0, "acts-both": float(width)}
