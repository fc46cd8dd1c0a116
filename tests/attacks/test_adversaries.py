"""Cheats in sandboxes, row by row: each scores as the honest detector does, or fails."""

import shutil

import adversaries
import pytest
from helpers_boxed import boxed_run
from helpers_plugins import install_adversaries, write_adversaries
from helpers_split import make_split

from oodd_eval import evaluate

pytestmark = pytest.mark.skipif(not shutil.which("bwrap"), reason="needs bubblewrap")

ENVIRONMENT = "cartpole"
HONEST_SCORES = ["sly-memorised", "sly-look-ahead", "sly-company-home", "sly-company-fit-map"]
PLAYED = [
    *HONEST_SCORES, "sly-look-ahead-prefix", "sly-abstract-socket", "sly-process-number",
    "sly-calibration-first", "sly-burglar", "sly-mapped-state", "sly-reads-ahead",
    "sly-takes-over", "sly-answers-early",
]  # fmt: skip
METRICS = ("auc_matched", "found_within_20_at_5pct")


def by_name(records):
    return {
        name: [r for r in records if r.detector == name] for name in (adversaries.BASE, *PLAYED)
    }


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """Records of a plain run on a published split, and of a sandboxed one on other seeds."""
    home = tmp_path_factory.mktemp("adversaries")
    sizes = {"train": 4, "calibration": 40, "test": 15}  # few groups
    published, other = (
        make_split(home / name, (ENVIRONMENT,), **sizes, seed_base=base, name=name)
        for name, base in (("published", 11), ("other", 12))
    )
    names, anomalies = [adversaries.BASE, *PLAYED], ["iid", "gravity"]
    write_adversaries(home / "plugin", published)
    boxed = boxed_run(
        home / "plugin", other, home / "boxed", names, anomalies=anomalies, streamed=True
    )
    with pytest.MonkeyPatch.context() as patch:
        install_adversaries(patch, home / "plugin")
        plain = evaluate("sly-memorised", published, anomalies=anomalies, output=home / "plain")
    adversaries.sweep()
    return by_name(plain), by_name(boxed)


@pytest.mark.parametrize("name", PLAYED)
def test_a_cheat_gains_nothing_in_a_sandbox(played, name):
    _, boxed = played
    for mine, honest in zip(boxed[name], boxed[adversaries.BASE], strict=True):
        assert honest.ok, honest.reason
        for metric in METRICS if mine.ok else ():
            assert mine.value(metric) <= honest.metrics[metric].high, (mine.anomaly, metric)
        if name in HONEST_SCORES:
            assert repr(mine.metrics["auc_matched"]) == repr(honest.metrics["auc_matched"])


def test_a_memorised_split_would_win_on_its_own_seeds(played):
    plain, _ = played
    assert all(r.value("auc_matched") > 0.99 for r in plain["sly-memorised"])
