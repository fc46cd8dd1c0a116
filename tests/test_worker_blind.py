"""A detector cannot see the answer: a spy searches its worker from inside and finds nothing.

That the spy would find it is shown by a harness that leaks on purpose, in every way at once.
"""

import hashlib
import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from helpers_plugins import HEADER, install
from helpers_split import make_split
from helpers_spy import SPY, Findings, vectors

from oodd_eval import evaluate, load_split
from oodd_eval.data.facts import ANOMALIES
from oodd_eval.data.parts import lengths_of, parts_of
from oodd_eval.metrics.auc import auc
from oodd_eval.plugins.contract import PROBES, probes
from oodd_eval.plugins.isolation import supervisor as isolation
from oodd_eval.scoring.unit import shuffled

pytestmark = pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="looks into /proc")

SEED = 424242
# Names that no docstring in the worker has, nor Python (its easter egg is "antigravity").
CHOSEN = "wind-l2r,wind-r2l"


class Secrets:
    """What must not be seen, of a split with trajectories so long that onsets are rare numbers."""

    def __init__(self, directory):
        self.path = make_split(
            directory / "verysecret", ("cartpole",), train=2, calibration=2, test=2,
            length=9000, seed_base=871,
        )  # fmt: skip
        split = load_split(self.path)
        data = split.environment("cartpole")
        onsets = [int(n) for n in data.anomalous("wind-l2r").onsets]
        # Who was handed a trajectory knows its length.
        lengths = {n + known for n in (9000, 9001, 9002) for known in (0, 1)}
        seeds = [871_000_000 + offset + i for offset in (300_000, 600_000) for i in range(2)]
        self.texts = [
            *CHOSEN.split(","), "cartpole", "verysecret", "test/nominal", split.digest,
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


@pytest.fixture(scope="module")
def findings(secrets, tmp_path_factory):
    """What is seen in two runs of the command line: in the second, the kept fit is loaded."""
    place = tmp_path_factory.mktemp("spied")
    with pytest.MonkeyPatch.context() as patch:
        seen = spy_in(place, patch)
        for anomalies in (CHOSEN.partition(",")[0], CHOSEN):
            subprocess.run(
                [sys.executable, "-m", "oodd_eval", "run", "--detector", "spy", "--env",
                 "cartpole", "--anomaly", anomalies, "--split", secrets.path, "--seed", str(SEED)],
                env={**os.environ, "PYTHONPATH": str(place / "plugin"), "OODD_EVAL_PLUGINS": "spy",
                     "OODD_EVAL_DATA": str(secrets.path.parent)},
                capture_output=True, text=True, check=True, timeout=300,
            )  # fmt: skip
    return Findings(seen)


def test_a_worker_holds_no_secret_anywhere(findings, secrets):
    assert findings.whens == [
        "made", "fit", "save", "score", "score", "made", "load", "score", "score",
    ]  # fmt: skip
    assert secrets.seen_in(findings) == {}
    # The spy is no fool: it sees what it was told, in all places where it looked.
    told = findings.places_of(
        ["spy", "oodd_eval.plugins.isolation.worker", "SPY_OUTPUT=", "oodd-results", "/dev/null"],
        [SEED],
        {"a trajectory": secrets.twin[:50].tobytes()},
    )
    assert told["frames"] >= {"spy", "oodd-results", SEED}
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
    asdict, popen = isolation.asdict, subprocess.Popen

    def told(request):
        return asdict(request) | {"environment": "cartpole", "onsets": secrets.onsets}

    with (secrets.path / "cartpole.h5").open("rb") as split:

        def start(command, **settings):
            if "oodd_eval.plugins.isolation.worker" in command:
                command = [command[0], "-X", f"data={secrets.path}", *command[1:]]
                settings["pass_fds"] += (split.fileno(),)
                settings["env"]["SPLIT"] = str(secrets.path)
                settings["cwd"] = secrets.path
            return popen(command, **settings)

        monkeypatch.setattr(isolation, "asdict", told)
        monkeypatch.setattr(isolation.subprocess, "Popen", start)
        records = evaluate("spy", split=secrets.path, environments="cartpole", anomalies="wind-l2r")
    assert [record.status for record in records] == ["ok"], records[0].reason
    found = secrets.seen_in(Findings(spying))
    onsets = {n for n in secrets.onsets if n > 1000}
    assert onsets
    assert found["frames"] >= {"cartpole", *onsets}
    assert found["objects"] >= {"cartpole", "verysecret", *onsets}
    assert found["memory"] >= {"cartpole", "verysecret"}
    for place in ("arguments", "environment", "descriptors", "directory"):
        assert "verysecret" in found[place]


def test_the_spy_finds_arrays_of_secrets_in_memory(secrets, monkeypatch, tmp_path):
    """The same search, where the plug-in holds onsets, seeds and rewards in arrays."""
    arrays = {"onsets": secrets.onsets, "seeds": [871_600_000, 871_600_001],
              "rewards": np.full(100, 0.5, np.float32)}  # fmt: skip
    np.savez(tmp_path / "planted.npz", **arrays)
    planted = f"KEPT = dict(np.load({str(tmp_path / 'planted.npz')!r}))\n"
    seen = spy_in(tmp_path, monkeypatch, planted)
    evaluate("spy", split=secrets.path, environments="cartpole", anomalies="wind-l2r")
    found = secrets.seen_in(Findings(seen))
    assert found["memory"] >= {"onsets as int64", "seeds as int64", "rewards as float32"}
    assert found["objects"] == {871_600_000, 871_600_001, *(n for n in secrets.onsets if n > 1000)}


# In which order, and of what length

NOMINAL = {"calibration", "test/nominal"}


def arrived_from(findings, split, environment):
    """Return part and number of what arrived to be scored, in order."""
    parts = parts_of(split.environment(environment), tuple(ANOMALIES))
    known = {digest(x): (part, i) for part, xs in parts.items() for i, x in enumerate(xs)}
    assert len(known) == sum(len(xs) for xs in parts.values())
    return [known[found] for found, *_ in whole(findings)]


def whole(findings):
    """Return what arrived to be scored first: all but the prefixes that come at the end."""
    return findings.arrived("score")[:-PROBES]


def digest(x):
    return hashlib.sha256(x.observations.tobytes() + x.actions.tobytes()).hexdigest()


def betrayal(order):
    """Say in which ways an order of parts and numbers tells which are anomalous; empty if not.

    Bounds are five standard deviations of a random order.
    """
    labels = np.array([part not in NOMINAL for part, _ in order])
    where = np.arange(len(order), dtype=float)
    n, m = labels.sum(), (~labels).sum()
    found = []
    if abs(auc(where[labels], where[~labels]) - 0.5) > 5 * np.sqrt((n + m + 1) / (12 * n * m)):
        found.append("by position")
    alike = np.mean([a[0] == b[0] for a, b in pairwise(order)])
    if alike > 0.5:
        found.append("by neighbours of the same part")
    related = np.mean([a[1] == b[1] for a, b in pairwise(order)])
    if related > 0.5:
        found.append("by neighbours of the same seed")
    return found


@pytest.fixture(scope="module")
def mini(tmp_path_factory):
    """What arrived of the split `mini`, where anomalies end episodes early."""
    with pytest.MonkeyPatch.context() as patch:
        seen = spy_in(tmp_path_factory.mktemp("mini"), patch)
        evaluate("spy", environments="cartpole")
    return Findings(seen)


def test_trajectories_arrive_in_an_order_that_tells_nothing(mini):
    order = arrived_from(mini, load_split("mini"), "cartpole")
    assert len(order) == len(set(order)) == 20 + 10 + 8 * 10
    assert betrayal(order) == []
    by_part = sorted(order, key=lambda one: (one[0] not in NOMINAL, one))
    assert betrayal(by_part) == ["by position", "by neighbours of the same part"]
    by_seed = sorted(order, key=lambda one: (one[1], hash(one[0]) % 7))
    assert "by neighbours of the same seed" in betrayal(by_seed)


def test_trajectories_arrive_whole_and_in_one_form(mini):
    """No end is cut at an onset or where the twin ends, and nothing is padded."""
    split = load_split("mini")
    order = arrived_from(mini, split, "cartpole")
    sets = parts_of(split.environment("cartpole"), tuple(ANOMALIES))
    lengths = [length for _, length, _ in whole(mini)]
    assert lengths == [int(sets[part].lengths[i]) + 1 for part, i in order]
    assert len(set(lengths)) > 10
    forms = {str(form) for when in ("fit", "score") for *_, form in mini.arrived(when)}
    assert len(forms) == 1, forms


def test_at_the_end_come_prefixes_of_some_of_them(mini):
    split = load_split("mini")
    sets = parts_of(split.environment("cartpole"), tuple(ANOMALIES))
    chosen = probes(lengths_of(sets, None), f"{split.digest}|cartpole|0")
    expected = [digest(sets[p.part][p.index][: p.rows]) for p in chosen]
    assert [found for found, *_ in mini.arrived("score")[-PROBES:]] == expected


def test_training_trajectories_arrive_in_the_order_of_the_split(mini):
    train = load_split("mini").environment("cartpole").train
    assert [found for found, *_ in mini.arrived("fit")] == [digest(x) for x in train]


def test_every_part_is_equally_likely_at_every_position():
    counts = {"calibration": 20, "test/nominal": 10, "test/iid": 10, "test/gravity": 10}
    places = {part: [] for part in counts}
    for key in range(400):
        for place, (part, _) in enumerate(shuffled(counts, str(key))):
            places[part].append(place)
    # The mean of 4000 places among 50 has a standard deviation of 14.4 / 63 = 0.23.
    for part, found in places.items():
        assert abs(np.mean(found) - 24.5) < 5 * 0.23, part


@pytest.mark.parametrize("other", ["digest|hopper|0", "digest|cartpole|1", "other|cartpole|0"])
def test_the_order_of_one_unit_tells_nothing_of_another(other):
    counts = {"calibration": 20, "test/nominal": 10, "test/iid": 10}
    one, two = shuffled(counts, "digest|cartpole|0"), shuffled(counts, other)
    assert sorted(one) == sorted(two)
    # Of 40 places, one is the same on average.
    assert sum(a == b for a, b in zip(one, two, strict=True)) < 8
