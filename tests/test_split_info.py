"""What `data info` shows, against numbers worked by hand from the synthetic split."""

import numpy as np
import pytest

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS
from oodd_eval.data.split import load_split
from oodd_eval.results.tables.split_info import (
    collect_returns,
    describe,
    group_table,
    mean_and_deviation,
    paper_returns,
    return_table,
    span,
)


@pytest.fixture
def cartpole(tiny_split):
    return load_split(tiny_split).environment("cartpole")


def test_every_group_has_a_row_with_sizes_lengths_and_returns(cartpole):
    table = group_table(cartpole, 1_230_000, "abcdef0123456789")
    assert table.title == "CartPole: 1.23 MB, policy abcdef012345"
    assert [row[0] for row in table.rows][:3] == ["train", "calibration", "test/nominal"]
    assert [row[0] for row in table.rows][3:] == [f"test/{a}" for a in ANOMALIES]
    # Rewards are 1 per nominal and 0.5 per anomalous step; lengths 60, 61, 62; s.d. sqrt(2/3).
    assert table.rows[2] == ["test/nominal", "3", "183", "60..62", "", "", "61.0 ± 0.8"]
    assert table.rows[3][-1] == "30.5 ± 0.4"
    assert table.rows[3][4] == span(cartpole.anomalous("iid").onsets)
    assert table.rows[3][5] == "0"


def test_table_2_has_our_means_above_those_of_the_paper(cartpole):
    table = return_table({"cartpole": collect_returns(cartpole)}, paper_returns())
    assert table.header == ["Environment", "", "nominal", *ANOMALIES]
    assert table.rows[0] == ["CartPole", "ours", "61.0", *["30.5"] * 8]
    # Danesh & Fern (2021), Table 2, row CartPole.
    assert table.rows[1][:4] == ["", "paper", "500.0", "448.3"]
    assert table.rows[1][-1] == "411.7"


def test_an_anomaly_that_was_not_recorded_leaves_its_cell_empty():
    table = return_table({"ant": {"nominal": np.array([1.0, 2.0])}}, paper_returns())
    assert table.rows[0] == ["Ant", "ours", "1.5", *[""] * 8]


def test_the_papers_nominal_returns_are_those_of_the_benchmark():
    assert {e: row["nominal"] for e, row in paper_returns().items()} == {
        e.id: e.paper_return for e in ENVIRONMENTS.values()
    }


def test_spans_and_deviations():
    assert span(np.array([3, 3])) == "3"
    assert span(np.array([5, 3, 4])) == "3..5"
    assert mean_and_deviation(np.array([1.0, 3.0])) == "2.0 ± 1.0"


def test_the_description_names_digest_recipe_and_every_environment(tiny_split):
    split = load_split(tiny_split)
    text = describe(split)
    assert text.startswith(f"split tiny, digest {split.digest}\n6 training, 4 calibration")
    assert "episode cap 62; seed base 9" in text
    for title in ("CartPole: 0.", "Hopper: 0.", "Table 2"):
        assert title in text
    assert "61.0" in text
