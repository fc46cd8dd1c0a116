"""A board of logs from end to end: results, plots, curves, entries, pages and the site."""

import json
import time

import helpers_logs
import helpers_site
import numpy as np
import pytest
from helpers_records import make_record
from helpers_submission import Draft
from oodd_leaderboard import published, site
from oodd_leaderboard.curve_file import check_curves, read_curves
from oodd_leaderboard.curves import pooled_roc
from oodd_leaderboard.pages import build, differences
from oodd_leaderboard.reported import read_entries, sections
from oodd_leaderboard.submit import Statement, submit

from oodd_eval import evaluate
from oodd_eval.cli.main import main
from oodd_eval.data.facts import LogFacts, Quantity
from oodd_eval.data.layout import own_facts, write_environment, write_manifest
from oodd_eval.data.split import Split
from oodd_eval.errors import ResultsError, UsageError
from oodd_eval.metrics.alarms import GuaranteedAlarm
from oodd_eval.metrics.unpaired import UnpairedScores, separability

ROWS = ("clock", "mahalanobis", "persistence", "random", "range")
"""The rows of the board: they need no library and take no time."""

KINDS = {
    "arm": {"slip": [((30, 45),)] * 5, "wear": [((20, 60),)] * 4 + [((10, 20), (40, 60))]},
    "press": {"leak": [((25, 70),)] * 6, "jam": [((-1, 40),)] * 4},
}
"""Intervals of the episodes of each anomaly, by environment; of a jam only the end is known."""


def make_split(directory, kinds=KINDS, *, calibration=40, name="logs"):
    """Write a split without twins with an environment for each mapping of kinds."""
    directory.mkdir(parents=True)
    environments = {}
    for i, (environment, anomalies) in enumerate(kinds.items()):
        parts = helpers_logs.log_parts(
            calibration=calibration, nominal=8 + i, anomalies=anomalies, rows=70 + 5 * i
        )
        nominal = ("train", "calibration", "test/nominal")
        groups = [
            (part, helpers_logs.log_arrays(episodes, labelled=part not in nominal))
            for part, episodes in parts.items()
        ]
        environments[environment] = write_environment(
            directory / f"{environment}.h5",
            groups,
            "0" * 64,
            sensors=[Quantity(f"q{k}", "rad") for k in range(3)],
            actions=[Quantity("cmd", "V")],
            custom=own_facts(
                environment, discrete=False, groups=dict.fromkeys(anomalies, "dynamics")
            ),
            logs=LogFacts(paired=False, rate=10.0),
        )
    recipe = {"name": name, "source": "imported"}
    write_manifest(directory, recipe, environments, generator=0, versions={})
    return Split(directory)


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
def entries(split, directory, tmp_path_factory):
    """A directory of entries with one, of all rows with curves."""
    root = tmp_path_factory.mktemp("board") / "results"
    statement = Statement(id="logs", submitter="A. Tester")
    submission = submit(directory, root, statement, split=split.path)
    assert submission.verdict.ok, submission.verdict.findings.problems
    return root


@pytest.fixture(scope="module")
def small(split, tmp_path_factory):
    """An entry of two rows, to tamper with."""
    home = tmp_path_factory.mktemp("small")
    evaluate(("clock", "range"), split, output=home / "results")
    statement = Statement(id="small", submitter="A. Tester")
    written = submit(home / "results", home / "entries", statement, split=split.path, curves="none")
    assert written.verdict.ok
    return written.path


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


def test_curves_are_read_back_and_have_no_twin(entries, split):
    units = read_curves(entries / "logs" / "curves.json")["units"]
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
def test_a_wrong_field_of_curves_is_named(entries, field, value, problem):
    plain = json.loads((entries / "logs" / "curves.json").read_text())
    changed(plain["units"][0], field, value)
    with pytest.raises(ResultsError) as error:
        check_curves(plain, "curves.json")
    assert problem in str(error.value)


# Entries


def test_an_entry_is_verified(entries, split, capsys):
    assert main(["leaderboard", "verify", str(entries), "--split", str(split.path)]) == 0
    assert "valid, 20 cells" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("path", "value", "problem"),
    [
        ("environment", "Arm", "environment"),
        ("anomaly", "a b", "anomaly"),
        ("anomaly", "other", "anomaly"),
        ("group", "other", "group"),
        ("paired", True, "environment"),
        ("counts.nominal", 7, "per_trajectory"),
        ("metrics.auc_pool.value", 1.5, "metrics.auc_pool.value"),
        ("metrics.auc_pool.value", 0.123, "metrics.auc_pool.value"),
        ("metrics.auc_matched", {"value": 1.0, "low": 1.0, "high": 1.0, "n": 2}, "auc_matched"),
        ("note", "<b>", "note"),
    ],
)
def test_a_tampered_record_is_refused(small, split, tmp_path, path, value, problem):
    draft = Draft(small, tmp_path)
    changed(draft.records[0], path, value)
    verdict = draft.verdict(split.path)
    assert not verdict.ok
    assert any(problem in text.text for text in verdict.findings.problems)


def test_an_environment_counts_with_all_its_anomalies(small, split, tmp_path):
    draft = Draft(small, tmp_path)
    left_out = next(r for r in draft.records if r["anomaly"] == "leak")
    draft.records.remove(left_out)
    verdict = draft.verdict(split.path)
    assert any("press lacks leak" in p.text for p in verdict.findings.problems)


# Pages


def test_a_board_is_built_the_same_twice_and_beside_others(entries, tmp_path):
    read = read_entries(entries)
    files = build(read, tmp_path / "one")
    build(read, tmp_path / "two")
    assert not differences(tmp_path / "one", tmp_path / "two")
    (ranking,) = [name for name in files if name.endswith("-ranking.csv")]
    assert "-unpaired-" in ranking
    page = (tmp_path / "one" / "README.md").read_text()
    assert "### Ranking by pooled AUC (%)" in page
    assert "Episodes of press: 6 training, 40 calibration, 9 nominal test" in page
    assert "guaranteed alarms at 5 %: press" in page
    assert "The row *clock*" not in page
    words = page.partition("## Entries")[0].partition("## Split logs")[2].lower()
    for word in ("placebo", "matched auc", "environment | result", "false-alarm rate, sensor"):
        assert word not in words
    both = [*read, *helpers_site.example(tmp_path / "benchmark")]
    build(both, tmp_path / "both")
    assert "Ranking by matched AUC (%)" in (tmp_path / "both" / "README.md").read_text()


def test_a_run_is_placed_on_the_board_of_its_split(
    entries, directory, tmp_path, monkeypatch, capsys
):
    build(read_entries(entries), tmp_path)
    monkeypatch.setattr(published, "published_file", lambda: tmp_path / published.PUBLISHED)
    assert main(["leaderboard", "show", "--split", "logs"]) == 0
    text = capsys.readouterr().out
    assert "Ranking by separability: pooled AUC (%), higher is better" in text
    assert "Ranking by guaranteed alarms at 5 %" in text
    assert main(["leaderboard", "place", str(directory), "--detector", "range"]) == 0
    text = capsys.readouterr().out
    assert "> range" in text
    assert "It has the numbers of that row of entry logs" in " ".join(text.split())
    board = published.read_published(tmp_path / published.PUBLISHED).boards[0]
    whole = sections(read_entries(entries))[0].ranks
    assert board.ranks().ranking.ranks == whole.ranking.ranks
    assert board.ranks().alarms.ranks == whole.alarms.ranks
    other = [make_record(digest=board.conditions.split_digest)]
    with pytest.raises(UsageError, match="cannot be compared"):
        published.board_of(other, [board])
    with pytest.raises(UsageError, match="oodd-eval compare"):
        published.board_of(board.records, [])


# The site


@pytest.fixture(scope="module")
def address(entries, tmp_path_factory):
    directory = tmp_path_factory.mktemp("site")
    others = helpers_site.example(tmp_path_factory.mktemp("benchmark"))
    everything = sections([*read_entries(entries), *others])
    return helpers_site.write_site(directory, site.files(everything))


VIEWS = ("ranking", "guaranteed", "environments", "anomalies", "rows", "cost")


def go(window, place):
    window.run("location.hash = arguments[0]", place)
    time.sleep(0.2)
    window.wait_for("!document.querySelector('[aria-busy]') && !document.querySelector('.failure')")


@pytest.fixture
def board(window, address):
    """The site at the board of logs; its id, and the ids of its rows."""
    window.open("about:blank")
    window.console()
    window.open(address)
    script = """
        const boards = JSON.parse(document.getElementById("data").textContent).boards;
        const board = boards.find((b) => !b.paired);
        return [board.id, board.rows.map((row) => row.id)];
    """
    identity, rows = window.run(script)
    yield identity, rows
    assert window.console() == []


@pytest.mark.browser
@pytest.mark.parametrize("width", [1280, 390])
def test_no_view_speaks_of_twins_or_scrolls_sideways(window, board, width):
    identity, rows = board
    first, second = (window.run("return encodeURIComponent(arguments[0])", row) for row in rows[:2])
    places = [f"#/?board={identity}&view={view}" for view in VIEWS]
    places += ["#/heat", "#/cost", f"#/detector/{first}/arm/wear", f"#/detector/{first}/press/jam"]
    places += [f"#/compare/{first}/{second}"]
    with window.narrow(width):
        for place in places:
            go(window, place)
            wide, inner = window.run("return [document.documentElement.scrollWidth, innerWidth]")
            assert wide <= inner, place
            text = window.run("return document.querySelector('main').innerText").lower()
            text = text.replace("without twins", "")
            assert "undefined" not in text.replace("undefined.", ""), place
            of_metrics = text.partition("all metrics\n")[0]
            assert "twin" not in of_metrics, place
            assert "matched" not in of_metrics, place


@pytest.mark.browser
def test_the_board_of_logs_has_its_columns_filters_and_figures(window, board):
    identity, rows = board
    go(window, f"#/?board={identity}")
    titles = [text.splitlines()[0].strip("↕▼▲ ") for text in window.texts("#ranking thead th")]
    assert titles[2:] == ["Pooled AUC", "Pooled AUC null", "AUC of rows", "Wins", "Lead"]
    assert window.text("#ranking thead [aria-sort='descending'] button").startswith("Pooled AUC")
    window.choose("environment", "press")
    assert window.text("#ranking caption").startswith("Separability: press")
    window.choose("anomaly", "jam")
    assert "1 cell" in window.text("#ranking caption")
    window.choose("anomaly", "slip")  # which the press has not
    assert "0 cells" in window.text("#ranking caption")
    first = window.run("return encodeURIComponent(arguments[0])", rows[0])
    go(window, f"#/detector/{first}/arm/wear")
    window.wait_for("document.querySelectorAll('#cell svg').length >= 4")
    shaded = window.run("return document.querySelectorAll('#cell .anomalous-rows rect').length")
    assert shaded in (2, 4)  # one or two intervals, in both drawings
    assert window.run("return document.querySelectorAll('#cell .line.twin').length") == 0


@pytest.mark.browser
@pytest.mark.usefixtures("board")
def test_a_view_that_a_board_lacks_becomes_its_first(window):
    go(window, "#/?view=aucs")
    titles = window.texts("select[name=board] option")
    window.choose("board", next(title for title in titles if title.startswith("logs")))
    assert window.run("return document.querySelector('[name=view]:checked').value") == "ranking"
    assert "Split logs" in window.texts("#notes li")[0]
