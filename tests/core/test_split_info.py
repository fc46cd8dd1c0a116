"""What `data info` shows, against numbers worked by hand from the synthetic splits."""

import dataclasses
import json
import tomllib
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from helpers_logs import UNPAIRED, log_parts, make_log_split, write_log_split
from helpers_split import make_group

from oodd_eval.cli.main import main
from oodd_eval.data.description import collect_returns, describe, group_rows, log_rows, return_rows
from oodd_eval.data.facts import ENVIRONMENTS, LICENCE, SPLITS, TABLE1, LogFacts
from oodd_eval.data.layout import read_manifest, write_environment, write_manifest
from oodd_eval.data.parts import NOMINAL
from oodd_eval.data.split import load_split

ROOT = Path(__file__).parents[2]
KINDS = ("nominal", *TABLE1)


@pytest.fixture
def cartpole(tiny_split):
    return load_split(tiny_split).environment("cartpole")


def test_every_group_has_a_row_with_sizes_lengths_and_returns(cartpole):
    rows = group_rows(cartpole)
    assert [row[0] for row in rows][:3] == ["train", "calibration", "test/nominal"]
    assert [row[0] for row in rows][3:] == [f"test/{a}" for a in TABLE1]
    # Rewards are 1 per nominal and 0.5 per anomalous step; lengths 60, 61, 62; s.d. sqrt(2/3).
    assert rows[2] == ["test/nominal", "3", "183", "60..62", *[""] * 4, "61.0 ± 0.8"]
    onsets = cartpole.anomalous("iid").onsets
    assert rows[3][4] in (f"{onsets.min()}..{onsets.max()}", str(onsets.min()))
    tail = sorted([60, 61, 62] - onsets)[1]
    assert rows[3][5:] == ["+0", str(tail), "0", "30.5 ± 0.4"]


def test_table_2_has_our_means_above_those_of_the_paper(cartpole):
    ours, theirs = return_rows({"cartpole": collect_returns(cartpole)}, KINDS)
    assert ours == ["CartPole", "ours", "61.0", *["30.5"] * 8]
    # Danesh & Fern (2021), Table 2, row CartPole.
    assert theirs[:4] == ["", "paper", "500.0", "448.3"]
    assert theirs[-1] == "411.7"


def test_the_description_names_digest_recipe_and_every_environment(tiny_split):
    split = load_split(tiny_split)
    text = describe(split)
    assert text.startswith(f"split tiny, digest {split.digest}\n6 training, 4 calibration")
    assert "episode cap 62; seed base 9" in text
    for title in ("CartPole: 0.", "Hopper: 0.", "Table 2", "0 thigh torque [75 N m]"):
        assert title in text
    assert "61.0" in text


FACTS = dataclasses.replace(
    UNPAIRED, clock=False, baseline=20, rate=50.0, order="shuffled", offsets=(5.4e6, 0.0, 0.0),
    source="https://example.org/arm", licence="CC BY 4.0", citation="Someone, 2024",
)  # fmt: skip
SLIPS = [((30, 45),), ((10, 20), (30, 40)), ((-1, 12),), ()]


@pytest.fixture
def logs(tmp_path):
    """A split of logs; episode i of an anomaly has 60 + i % 3 rows."""
    return make_log_split(tmp_path / "arm", FACTS, anomalies={"slip": SLIPS, "leak": [()] * 2})


def test_parts_of_logs_have_rows_intervals_outcomes_and_tasks(logs, tmp_path):
    rows = {row[0]: row[1:] for row in log_rows(load_split(logs).environment("arm"))}
    assert list(rows) == ["train", "calibration", "test/nominal", "test/leak", "test/slip"]
    assert rows["train"] == ["6", "", "366", "60..62", "", "", "", ""]
    # 15 + 20 + 12 rows of the three episodes with intervals, which have 60 + 61 + 62.
    assert rows["test/slip"] == ["4", "", "243", "60..62", "4", "47 (26%)", "1", ""]
    assert rows["test/leak"] == ["2", "", "121", "60..61", "0", "", "2", ""]
    parts = log_parts()
    parts["train"] = [
        dataclasses.replace(episode, task=f"task {i % 2}")
        for i, episode in enumerate(parts["train"])
    ]
    told = log_rows(load_split(write_log_split(tmp_path / "tasks", parts)).environment("arm"))
    assert [row[2] for row in told] == ["2", "", "", ""]


def test_the_description_of_logs_says_what_is_known_of_them(logs, tmp_path):
    text = describe(load_split(logs))
    plain = describe(load_split(make_log_split(tmp_path / "plain")))
    for nothing in ("source", "licence", "rate:", "baseline", "offsets", "outcome only"):
        assert nothing not in plain
    lines = {
        "6 training, 40 calibration and 8 nominal test episodes; imported", "order: shuffled",
        "source: https://example.org/arm", "licence: CC BY 4.0", "citation: Someone, 2024",
        "rate: 50 rows/s", "offsets: subtracted in float64: q0 5400000",
    }  # fmt: skip
    assert lines <= {*text.splitlines()}
    assert "first 20 rows" in text
    for nothing in ("Table 2", "±", "return", "policy", "arm arm", "redraws", "tasks"):
        assert nothing not in text


def test_pairs_of_logs_have_onsets_and_no_returns(tmp_path):
    info = ENVIRONMENTS["cartpole"]
    groups = {part: make_group("cartpole", range(3), 60) for part in NOMINAL}
    groups["test/iid"] = make_group("cartpole", range(3), 60, "iid")
    for arrays in groups.values():
        arrays["rewards"] = np.zeros_like(arrays["rewards"])
    entry = write_environment(
        tmp_path / "cartpole.h5", groups.items(), "imported", sensors=info.sensors,
        actions=info.actions, logs=LogFacts(paired=True, source="the shed"),
    )  # fmt: skip
    recipe = {"name": "shed", "source": "imported"}
    write_manifest(tmp_path, recipe, {"cartpole": entry}, generator=0, versions={})
    text = describe(load_split(tmp_path))
    header = next(line for line in text.splitlines() if line.startswith("group"))
    assert header.split() == ["group", "trajectories", "transitions", "length", "onset", "effect",
                              "tail", "redraws"]  # fmt: skip
    assert "source: the shed" in text
    for nothing in ("Table 2", "±", "policy"):
        assert nothing not in text


def test_the_command_examines_the_promise_of_logs_and_their_labels(logs, capsys):
    assert main(["data", "info", str(logs)]) == 0
    assert "40 calibration episodes" in capsys.readouterr().out
    assert main(["data", "verify", str(logs)]) == 0
    assert "6 of 6 groups" in capsys.readouterr().out
    with h5py.File(logs / "arm.h5", "r+") as file:
        file["test/slip/intervals"][0] = (31, 45)
    assert main(["data", "verify", str(logs)]) == 1
    assert "test/slip" in capsys.readouterr().out


def test_imported_environments_are_listed_and_described(logs, capsys, monkeypatch):
    monkeypatch.setenv("OODD_EVAL_DATA", str(logs.parent))
    assert main(["list", "envs"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1].split(maxsplit=3)[:3] == ["arm", "split", "arm"]
    assert main(["info", "arm"]) == 0
    page = capsys.readouterr().out
    for text in ("q0 (rad)", "CC BY 4.0", "40 episodes", "data info arm"):
        assert text in page
    assert main(["info", "aarm"]) == 4
    assert "did you mean 'arm'" in capsys.readouterr().err


def test_licence_is_the_same_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["license"] == LICENCE
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["license"] == LICENCE
    assert (ROOT / "LICENSE").read_text().startswith(f"{LICENCE} License")
    split = load_split("mini")
    assert split.manifest["licence"] == LICENCE
    assert f"\nlicence {LICENCE}\n" in describe(split)


def test_the_licence_of_a_published_split_is_in_its_manifest_and_not_in_its_digest(tmp_path):
    entries = load_split("mini").manifest["environments"]
    write_manifest(tmp_path, SPLITS["mini"], entries, 2, {})
    manifest = read_manifest(tmp_path)
    assert manifest["licence"] == LICENCE
    assert manifest["digest"] == load_split("mini").digest
    older = {key: value for key, value in manifest.items() if key != "licence"}
    (tmp_path / "manifest.json").write_text(json.dumps(older))
    assert read_manifest(tmp_path)["digest"] == manifest["digest"]
