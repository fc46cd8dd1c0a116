"""Cheats in a re-run: each has the honest detector's figures, or none at all."""

import shutil

import adversaries
import numpy as np
import pytest
from helpers_plugins import install_adversaries
from helpers_split import make_split
from oodd_leaderboard.verify.rerun import differences

from oodd_eval.data.split import load_split, split_places
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import make_plan
from oodd_eval.scoring.runner import run

pytestmark = pytest.mark.skipif(not shutil.which("bwrap"), reason="needs bubblewrap")

ENVIRONMENT = "cartpole"
PLAYED = [
    "sly-look-ahead", "sly-look-ahead-prefix", "sly-company-home", "sly-company-fit-map",
    "sly-abstract-socket", "sly-calibration-first", "sly-burglar",
    "sly-memorised", "sly-mapped-state", "sly-takes-over", "sly-answers-early",
]  # fmt: skip
METRICS = ("auc_matched", "found_within_20_at_5pct")


def play(home, names, directory, *, rerun):
    """Run detectors on a split, as a plain run or as a re-run does; their records by name."""
    split, output = load_split(directory), home / ("again" if rerun else "plain")
    plan = make_plan(
        discover(), split=split, detectors=names, environments=[ENVIRONMENT],
        anomalies=["iid", "drift", "gravity"],
    )  # fmt: skip
    hidden = (*split_places(split), str(output)) if rerun else None
    settings = RunSettings(limits=Limits(300, 2 * 10**9, hidden), streamed=rerun)
    records = run(plan, split, discover(), settings, ResultsDirectory(output)).records
    return {name: [r for r in records if r.detector == name] for name in names}


def splits(home):
    """Return a published split, whose twins an adversary has in a table, and one of other seeds."""
    sizes = {"train": 4, "calibration": 40, "test": 40}  # few groups
    published = make_split(home / "published", (ENVIRONMENT,), **sizes, seed_base=11, name="one")
    drawn = make_split(home / "drawn", (ENVIRONMENT,), **sizes, seed_base=12, name="other")
    return published, drawn


def table_of(directory):
    """Return the module in which an adversary keeps the twins of a split."""
    cells = bytearray(adversaries.CELLS)
    for twin in load_split(directory).environment(ENVIRONMENT).twins:
        adversaries.remember(twin.observations, np.array([0, len(twin) - 1]), cells)
    known = np.flatnonzero(np.frombuffer(cells, np.uint8)).astype("<u4")
    return f"CELLS = {known.tobytes().hex()!r}\n"


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """Records in a re-run of all that play, and in a plain run of the memorising one."""
    home = tmp_path_factory.mktemp("adversaries")
    published, drawn = splits(home)
    with pytest.MonkeyPatch.context() as patch:
        install_adversaries(patch, home / "plugin")
        (home / "plugin" / "oodd_adversaries_table.py").write_text(table_of(published))
        again = play(home, [adversaries.BASE, *PLAYED], drawn, rerun=True)
        plain = play(home, [adversaries.BASE, "sly-memorised"], published, rerun=False)
    adversaries.sweep()
    return plain, again


@pytest.mark.parametrize("name", PLAYED)
def test_a_cheat_gains_nothing_in_a_rerun(played, name):
    _, again = played
    for mine, honest in zip(again[name], again[adversaries.BASE], strict=True):
        assert honest.ok, honest.reason
        for metric in METRICS if mine.ok else ():
            assert mine.value(metric) <= honest.metrics[metric].high, (mine.anomaly, metric)


@pytest.mark.parametrize("name", ["sly-memorised", "sly-look-ahead", "sly-company-home"])
def test_scores_of_a_rerun_are_those_of_the_honest_detector(played, name):
    _, again = played
    for mine, honest in zip(again[name], again[adversaries.BASE], strict=True):
        assert repr(mine.metrics["auc_matched"]) == repr(honest.metrics["auc_matched"]), mine.reason


def test_a_memorised_board_is_refused(played):
    plain, again = played
    claimed, honest = (plain[name] for name in ("sly-memorised", adversaries.BASE))
    assert all(r.value("auc_matched") > 0.99 for r in claimed)
    compared = differences({ENVIRONMENT: (claimed, again["sly-memorised"])})
    assert any(d.refused and d.metric == "auc_matched" for d in compared)
    compared = differences({ENVIRONMENT: (honest, again[adversaries.BASE])})
    assert not any(d.refused for d in compared)
