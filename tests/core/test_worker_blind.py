"""A detector cannot see the answer: a spy searches its worker from inside and finds nothing.

That the spy would find it is shown by a harness that leaks on purpose, in every way at once.
"""

import hashlib
import importlib.metadata
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers_plugins import HEADER, install
from helpers_split import make_split
from helpers_spy import SPY, Findings, vectors

from oodd_eval import evaluate, load_split
from oodd_eval.data.facts import TABLE1
from oodd_eval.data.parts import parts_of
from oodd_eval.plugins.isolation import child
from oodd_eval.scoring import unit

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="looks into /proc"),
]

SEED = 424242
# Names that no docstring in the worker has, nor Python (its easter egg is "antigravity").
CHOSEN = "wind-l2r,wind-r2l"
ENVIRONMENT = "lunarlander"


class Secrets:
    """What must not be seen, of a split with trajectories so long that onsets are rare numbers."""

    def __init__(self, directory):
        self.path = make_split(
            directory / "verysecret", (ENVIRONMENT,), train=2, calibration=2, test=2,
            length=9000, seed_base=871,
        )  # fmt: skip
        split = load_split(self.path)
        data = split.environment(ENVIRONMENT)
        onsets = [int(n) for n in data.anomalous("wind-l2r").onsets]
        # Who was handed a trajectory knows its length.
        lengths = {n + known for n in (9000, 9001, 9002) for known in (0, 1)}
        seeds = [871_000_000 + offset + i for offset in (300_000, 600_000) for i in range(2)]
        self.texts = [
            *CHOSEN.split(","), ENVIRONMENT, "verysecret", "test/nominal", split.digest,
            *map(str, seeds),
        ]  # fmt: skip
        self.numbers = {*seeds, *(n for n in onsets if n > 1000)} - lengths
        self.patterns = {
            **vectors("onsets", onsets),
            **vectors("seeds", seeds[2:]),
            # Rewards of the synthetic split are 0.5 in anomalous trajectories.
            **{f"rewards as {d}": np.full(16, 0.5, d).tobytes() for d in ("float32", "float64")},
        }
        self.onsets = onsets
        self.twin = data.twins[0].observations

    def seen_in(self, findings):
        return findings.places_of(self.texts, self.numbers, self.patterns)


@pytest.fixture(scope="module")
def secrets(tmp_path_factory):
    return Secrets(tmp_path_factory.mktemp("where"))


def spy_in(place, monkeypatch, planted=""):
    """Install the spy, with a working directory without secrets; return where it writes."""
    for name in ("seen", "work"):
        (place / name).mkdir()
    monkeypatch.setenv("SPY_OUTPUT", str(place / "seen"))
    monkeypatch.chdir(place / "work")
    install(monkeypatch, place / "plugin", "spy", planted + SPY, header=HEADER)
    return place / "seen"


@pytest.fixture
def spying(monkeypatch, tmp_path):
    return spy_in(tmp_path, monkeypatch)


def metadata_without_readme(place):
    """Put the package's metadata where it is found first; its README names every environment.

    A worker reads the metadata to find plug-ins, and parts of it stay in freed memory.
    """
    installed = importlib.metadata.distribution("oodd-eval")
    shown = place / "oodd_eval-0.dist-info"
    shown.mkdir()
    for name, text in (
        ("METADATA", installed.read_text("METADATA").partition("\n\n")[0]),
        ("entry_points.txt", installed.read_text("entry_points.txt")),
    ):
        (shown / name).write_text(text, encoding="utf-8")


@pytest.fixture(scope="module")
def findings(secrets, tmp_path_factory):
    """What is seen in two runs of the command line: in the second, the kept fit is loaded."""
    place = tmp_path_factory.mktemp("spied")
    with pytest.MonkeyPatch.context() as patch:
        seen = spy_in(place, patch)
        metadata_without_readme(place / "plugin")
        for anomalies in (CHOSEN.partition(",")[0], CHOSEN):
            subprocess.run(
                [sys.executable, "-m", "oodd_eval", "run", "--detector", "spy", "--env",
                 ENVIRONMENT, "--anomaly", anomalies, "--split", secrets.path, "--seed", str(SEED)],
                env={**os.environ, "PYTHONPATH": str(place / "plugin"), "OODD_EVAL_PLUGINS": "spy",
                     "OODD_EVAL_DATA": str(secrets.path.parent)},
                capture_output=True, text=True, check=True, timeout=300,
            )  # fmt: skip
    return Findings(seen)


def test_a_worker_holds_no_secret_anywhere(findings, secrets):
    assert findings.whens == [
        "made", "fit", "state", "score", "score", "made", "restore", "score", "score",
    ]  # fmt: skip
    assert secrets.seen_in(findings) == {}
    # The spy is no fool: it sees what it was told, in all places where it looked.
    told = findings.places_of(
        ["spy", "oodd_eval.plugins.isolation.worker", "SPY_OUTPUT=", "oodd-results", "/dev/null"],
        [SEED],
        {"a trajectory": secrets.twin[:50].tobytes()},
    )
    assert told["frames"] >= {"spy", SEED}
    assert told["objects"] >= {"spy", "oodd_eval.plugins.isolation.worker", SEED}
    assert told["memory"] >= {"spy", "a trajectory"}
    assert told["arguments"] == {"oodd_eval.plugins.isolation.worker"}
    assert "SPY_OUTPUT=" in told["environment"]
    assert told["directory"] >= {"oodd-results"}
    assert "/dev/null" in told["descriptors"]


def test_nothing_of_the_harness_or_of_pytest_is_in_the_environment(findings):
    steering = ["OODD_EVAL_DATA", "OODD_EVAL_PLUGINS", "PYTEST_CURRENT"]
    assert "environment" not in findings.places_of(steering)
    assert findings.places_of(["OODD_EVAL_PROCESS"])["environment"]


def test_the_spy_finds_what_a_harness_leaks(spying, secrets, monkeypatch):
    """The same search, where the harness tells too much in every way there is."""
    run_isolated, popen = unit.run_isolated, subprocess.Popen

    def told(request, *trajectories, **settings):
        leak = {"environment": ENVIRONMENT, "onsets": secrets.onsets}
        return run_isolated(request | leak, *trajectories, **settings)

    with (secrets.path / f"{ENVIRONMENT}.h5").open("rb") as split:

        def start(command, **settings):
            if "oodd_eval.plugins.isolation.worker" in command:
                command = [command[0], "-X", f"data={secrets.path}", *command[1:]]
                settings["pass_fds"] = [*settings["pass_fds"], split.fileno()]
                settings["env"]["SPLIT"] = str(secrets.path)
                settings["cwd"] = secrets.path
            return popen(command, **settings)

        monkeypatch.setattr(unit, "run_isolated", told)
        monkeypatch.setattr(child.subprocess, "Popen", start)
        records = evaluate(
            "spy", split=secrets.path, environments=ENVIRONMENT, anomalies="wind-l2r"
        )
    assert [record.status for record in records] == ["ok"], records[0].reason
    found = secrets.seen_in(Findings(spying))
    onsets = {n for n in secrets.onsets if n > 1000}
    assert onsets
    assert found["frames"] >= {ENVIRONMENT, *onsets}
    assert found["objects"] >= {ENVIRONMENT, "verysecret", *onsets}
    assert found["memory"] >= {ENVIRONMENT, "verysecret"}
    for place in ("arguments", "environment", "descriptors", "directory"):
        assert "verysecret" in found[place]


def test_the_spy_finds_arrays_of_secrets_in_memory(secrets, monkeypatch, tmp_path):
    """The same search, where the plug-in holds onsets, seeds and rewards in arrays."""
    arrays = {"onsets": secrets.onsets, "seeds": [871_600_000, 871_600_001],
              "rewards": np.full(100, 0.5, np.float32)}  # fmt: skip
    np.savez(tmp_path / "planted.npz", **arrays)
    planted = f"KEPT = dict(np.load({str(tmp_path / 'planted.npz')!r}))\n"
    seen = spy_in(tmp_path, monkeypatch, planted)
    evaluate("spy", split=secrets.path, environments=ENVIRONMENT, anomalies="wind-l2r")
    found = secrets.seen_in(Findings(seen))
    assert found["memory"] >= {"onsets as int64", "seeds as int64", "rewards as float32"}
    assert found["objects"] == {871_600_000, 871_600_001, *(n for n in secrets.onsets if n > 1000)}


# In which order, and of what length


def digest(x):
    x = x.without_actions()
    return hashlib.sha256(x.observations.tobytes() + x.actions.tobytes()).hexdigest()


@pytest.fixture(scope="module")
def mini(tmp_path_factory):
    """What arrived of the split `mini` in a run."""
    with pytest.MonkeyPatch.context() as patch:
        seen = spy_in(tmp_path_factory.mktemp("mini"), patch)
        evaluate("spy", environments=ENVIRONMENT)
        return Findings(seen)


def test_trajectories_arrive_whole_and_in_one_form(mini):
    """No end is cut at an onset or where the twin ends, nothing is padded, no action is shown."""
    data = load_split("mini").environment(ENVIRONMENT)
    assert [found for found, *_ in mini.arrived("fit")] == [digest(x) for x in data.train]
    sets = parts_of(data, TABLE1)
    assert [found for found, *_ in mini.arrived("score")] == [
        digest(x) for part in sets.values() for x in part
    ]
    forms = {str(form) for when in ("fit", "score") for *_, form in mini.arrived(when)}
    assert len(forms) == 1, forms
