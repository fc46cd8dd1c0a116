"""Reported rows of logs from end to end: results, plots, curves, pages."""

import json
import shutil

import helpers_logs
import numpy as np
import pytest
from oodd_leaderboard import published
from oodd_leaderboard.curve_file import check_curves, make_curves, read_curves, write_curves
from oodd_leaderboard.curves import pooled_roc
from oodd_leaderboard.pages import build, read_leaderboard

from oodd_eval import evaluate
from oodd_eval.cli.main import main
from oodd_eval.data.facts import LogFacts
from oodd_eval.data.split import Split
from oodd_eval.errors import ResultsError, UsageError
from oodd_eval.metrics.alarms import GuaranteedAlarm
from oodd_eval.metrics.unpaired import UnpairedScores, separability
from oodd_eval.results.directory import ResultsDirectory

ROWS = ("clock", "mahalanobis", "persistence", "random", "range")
"""The rows of the board: they need no library and take no time."""

KINDS = {
    "arm": {"slip": [((30, 45),)] * 5, "wear": [((20, 60),)] * 4 + [((10, 20), (40, 60))]},
    "press": {"leak": [((25, 70),)] * 6, "jam": [((-1, 40),)] * 4},
}
"""Intervals of the episodes of each anomaly, by environment; of a jam only the end is known."""


def make_split(directory, kinds=KINDS, *, calibration=40):
    """Write a split without twins with an environment for each mapping of kinds."""
    environments = {}
    for i, (environment, anomalies) in enumerate(kinds.items()):
        parts = helpers_logs.log_parts(
            calibration=calibration, nominal=8 + i, anomalies=anomalies, rows=70 + 5 * i
        )
        facts = LogFacts(paired=False, rate=10.0)
        environments[environment] = helpers_logs.write_log_environment(
            directory, parts, facts, environment=environment
        )
    return Split(helpers_logs.write_log_manifest(directory, environments, name="logs"))


@pytest.fixture(scope="module")
def split(tmp_path_factory):
    return make_split(tmp_path_factory.mktemp("logs") / "split")


@pytest.fixture(scope="module")
def directory(split, tmp_path_factory):
    directory = tmp_path_factory.mktemp("results")
    evaluate(ROWS, split, output=directory, row_metrics=True)
    return directory


@pytest.fixture(scope="module")
def results(split, directory):
    return evaluate(ROWS, split, output=directory, row_metrics=True)


@pytest.fixture(scope="module")
def leaderboard(split, directory, tmp_path_factory):
    """A leaderboard's directory with the rows as reported ones, and their curves."""
    home = tmp_path_factory.mktemp("leaderboard")
    target = home / "results" / "logs"
    target.mkdir(parents=True)
    shutil.copy(directory / "records.jsonl", target)
    source = ResultsDirectory(directory)
    write_curves(make_curves(source.records(), source, split), target / "curves.json")
    return home


# Results and plots


def test_results_use_the_metric_that_their_board_ranks_by(results):
    assert results.mean(row="mahalanobis") == results.mean("auc_pool", "mahalanobis")
    assert results.mean(row="clock") == 0.5
    compared = results.compare("mahalanobis", "random")
    assert compared.metric == "auc_pool"
    assert compared.verdict.startswith("mahalanobis beats random by ")
    assert compared.verdict.endswith("] in pooled AUC on arm and press.")
    page = results._repr_html_()
    assert "pooled AUC" in page
    assert "placebo" not in page
    row = results.to_rows()[0]
    assert (row["paired"], row["note"], row["magnitude"]) == (False, "", None)
    assert 0 <= row["vus_pr"] <= 1


def test_an_episode_has_its_intervals_and_no_twin(results, split):
    episode = results.scores("arm", "wear", 4, row="mahalanobis")
    assert episode.intervals == ((10, 20), (40, 60))
    assert (episode.onset, episode.effect) == (10, 10)
    assert episode.twin is episode.twin_scores is None
    assert len(episode.scores) == len(episode.trajectory.observations)
    assert np.isnan(episode.delay(of_twin=True))
    assert episode.delay() == episode.alarm - 10
    unknown = results.scores("press", "jam", row="mahalanobis")
    assert unknown.onset is None
    assert np.isnan(unknown.delay())
    with pytest.raises(UsageError, match="has no episode 5"):
        results.scores("arm", "wear", 5, row="mahalanobis")


@pytest.fixture
def axes(results):
    pytest.importorskip("matplotlib")

    def draw(*arguments, **settings):
        return results.plot_trajectory(*arguments, **settings).axes

    return draw


def spans(axis):
    """First and last row of each shaded part of an axis."""
    boxes = [patch.get_extents().transformed(axis.transData.inverted()) for patch in axis.patches]
    return [(round(box.x0), round(box.x1)) for box in boxes]


def test_a_plot_shades_the_anomalous_rows_and_draws_no_twin(axes):
    upper, lower = axes("arm", "wear", 4, row="mahalanobis")
    assert spans(upper) == spans(lower) == [(10, 20), (40, 60)]
    assert not [
        line for axis in (upper, lower) for line in axis.lines if line.get_linestyle() == "--"
    ]
    labels = lower.get_legend_handles_labels()[1]
    assert labels.count("anomalous rows") == 1
    assert any(label.startswith("alarm at row") for label in labels)
    assert "threshold at 5 %" in labels
    assert "twin" not in " ".join([*labels, upper.get_ylabel()])
    # The last sensor is the one that the anomaly moves.
    assert upper.get_legend_handles_labels()[1][0] == "q2"


def test_a_plot_marks_an_unknown_start(axes):
    _, lower = axes("press", "jam", row="clock")
    assert spans(lower) == [(0, 40)]
    assert [patch.get_hatch() for patch in lower.patches] == ["//"]
    assert "anomalous, start unknown" in lower.get_legend_handles_labels()[1]


def test_power_has_one_line_a_row_without_twins(results):
    pytest.importorskip("matplotlib")
    (axis,) = results.plot_power("mahalanobis", "range").axes
    assert len(axis.lines) == 2
    assert "first anomalous row" in axis.get_xlabel()
    assert "twin" not in axis.get_xlabel()


def test_few_calibration_episodes_are_drawn_at_ten_percent(tmp_path):
    pytest.importorskip("matplotlib")
    few = make_split(tmp_path / "few", {"arm": {"slip": [((30, 45),)] * 5}}, calibration=20)
    drawn = evaluate("range", few, output=tmp_path / "results")
    assert drawn.scores("arm", "slip").level == 0.1
    _, lower = drawn.plot_trajectory("arm", "slip").axes
    assert "threshold at 10 %" in lower.get_legend_handles_labels()[1]


# Curves


def test_the_area_below_a_pooled_curve_is_the_pooled_auc():
    rng = np.random.default_rng(0)
    nominal = [rng.integers(0, 6, size=n).astype(float) for n in (50, 60, 55, 60, 60, 60, 58)]
    anomalous = [rng.integers(1, 8, size=n).astype(float) for n in (60, 50, 70)]
    nominal[0][:3] = np.nan
    anomalous[0][:12] = np.nan
    intervals = [((10, 30),), ((-1, 20), (40, 45)), ()]
    for clock in (True, False):
        cell = UnpairedScores(nominal, anomalous, intervals, [""] * 7, [""] * 3, clock)
        expected = separability(cell, GuaranteedAlarm(None, 1.0))["auc_pool"].value
        grid = np.linspace(0, 1, 20_001)
        areas, curve = pooled_roc(cell, grid)
        assert np.mean(areas) == pytest.approx(expected, abs=1e-12)
        assert np.trapezoid(curve, grid) == pytest.approx(expected, abs=1e-4)
        assert (np.diff(curve) >= 0).all()


def test_curves_are_read_back_and_have_no_twin(leaderboard):
    units = read_curves(leaderboard / "results" / "logs" / "curves.json")["units"]
    assert len(units) == 4 * len(ROWS)
    assert not [
        key
        for unit in units
        for part in ("delay_far", "example")
        for key in unit[part]
        if "twin" in key or "null" in key
    ]
    jam = next(u for u in units if u["anomaly"] == "jam" and u["detector"] == "mahalanobis")
    assert jam["example"]["intervals"] == [[-1, 40]]
    assert not jam["delay_far"]["far"]
    slip = next(u for u in units if u["anomaly"] == "slip" and u["detector"] == "mahalanobis")
    assert slip["roc"]["tpr"][-1] == 1
    assert slip["delay_far"]["far"][0] >= slip["delay_far"]["far"][-1] == 0
    start = slip["example"]["start"]
    assert start <= 30 < start + len(slip["example"]["scores"])


def changed(record, path, value):
    *parents, last = path.split(".")
    for name in parents:
        record = record[name]
    record[last] = value


@pytest.mark.parametrize(
    ("field", "value", "problem"),
    [
        ("environment", "../arm", "units[0].environment"),
        ("example.intervals", [[30, 20]], "units[0].example.intervals[0]"),
        ("example.intervals", [[30, 10**6]], "units[0].example.intervals[0]"),
        ("example.twin", [0.0], "units[0].example.twin"),
        ("delay_far.null_censored", [0.0], "units[0].delay_far.null_censored"),
        ("paired", True, "units[0]"),
    ],
)
def test_a_wrong_field_of_curves_is_named(leaderboard, field, value, problem):
    plain = json.loads((leaderboard / "results" / "logs" / "curves.json").read_text())
    changed(plain["units"][0], field, value)
    with pytest.raises(ResultsError) as error:
        check_curves(plain, "curves.json")
    assert problem in str(error.value)


# Pages


def test_a_page_says_nothing_of_twins(leaderboard, tmp_path):
    files = build(read_leaderboard(leaderboard), tmp_path)
    (table,) = [name for name in files if name.startswith("tables/")]
    assert "-unpaired" in table
    page = (tmp_path / "README.md").read_text()
    assert "### Pooled AUC and guaranteed alarms at 5 % (%)" in page
    assert "Episodes of press: 6 training, 40 calibration, 9 nominal test" in page
    words = page.partition("## Reported on logs")[2].partition("## How to take part")[0].lower()
    for word in ("placebo", "matched auc", "false-alarm rate, sensor"):
        assert word not in words


def test_a_run_is_placed_beside_the_rows_of_its_split(
    leaderboard, directory, tmp_path, monkeypatch, capsys
):
    build(read_leaderboard(leaderboard), tmp_path)
    monkeypatch.setattr(published, "published_file", lambda: tmp_path / published.PUBLISHED)
    assert main(["leaderboard", "show", "--split", "logs"]) == 0
    assert "Pooled AUC" in capsys.readouterr().out
    assert main(["leaderboard", "place", str(directory), "--detector", "range"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "> range" in text
    assert "The board has that row with the same numbers" in text
