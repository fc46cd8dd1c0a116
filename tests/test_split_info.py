"""What `data info` shows, against numbers worked by hand from the synthetic split."""

import pytest

from oodd_eval.data.facts import TABLE1
from oodd_eval.data.info import collect_returns, describe, group_rows, return_rows
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
