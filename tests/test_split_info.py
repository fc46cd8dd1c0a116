"""What `data info` shows, against numbers worked by hand from the synthetic split."""

import numpy as np
import pytest

from oodd_eval.data.facts import ENVIRONMENTS, TABLE1, paper_tables
from oodd_eval.data.info import collect_returns, column_lines, describe, group_rows, return_rows
from oodd_eval.data.parts import AnomalousSet
from oodd_eval.data.split import load_split

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


def test_late_effects_and_brief_parts_are_shown(cartpole, monkeypatch):
    monkeypatch.setattr(AnomalousSet, "tails", np.array([4, 18, 25]))
    part = cartpole.anomalous("iid")
    part.effects = part.onsets + np.array([0, 12, 3])
    monkeypatch.setattr(cartpole, "anomalous", lambda _: part)
    assert group_rows(cartpole)[3][5:7] == ["+0..12", "18 brief"]


def test_sensors_and_actions_are_numbered_with_names_and_units(tiny_split):
    lines = column_lines(load_split(tiny_split).environment("cartpole"))
    assert lines == [
        "sensors: 0 cart position [m], 1 cart velocity [m/s], 2 pole angle [rad],",
        "  3 pole angular velocity [rad/s]",
        "actions: 0 push left, 1 push right",
    ]


def test_table_2_has_our_means_above_those_of_the_paper(cartpole):
    ours, theirs = return_rows({"cartpole": collect_returns(cartpole)}, KINDS)
    assert ours == ["CartPole", "ours", "61.0", *["30.5"] * 8]
    # Danesh & Fern (2021), Table 2, row CartPole.
    assert theirs[:4] == ["", "paper", "500.0", "448.3"]
    assert theirs[-1] == "411.7"


def test_an_anomaly_that_was_not_recorded_leaves_its_cell_empty():
    assert return_rows({"ant": {"nominal": np.array([1.0, 2.0])}}, KINDS)[0] == [
        "Ant", "ours", "1.5", *[""] * 8,
    ]  # fmt: skip


def test_the_papers_nominal_returns_are_those_of_the_benchmark():
    paper = paper_tables()["table2_policy_return"]
    assert all(paper[e.id]["nominal"] == e.paper_return for e in ENVIRONMENTS.values())


def test_the_description_names_digest_recipe_and_every_environment(tiny_split):
    split = load_split(tiny_split)
    text = describe(split)
    assert text.startswith(f"split tiny, digest {split.digest}\n6 training, 4 calibration")
    assert "episode cap 62; seed base 9" in text
    for title in ("CartPole: 0.", "Hopper: 0.", "Table 2", "0 thigh torque [75 N m]"):
        assert title in text
    assert "61.0" in text
