"""The site as text: what is in the page, that it is safe, and that numbers are the board's."""

import json
import re
from pathlib import Path

import helpers_site
import numpy as np
import pytest
from oodd_leaderboard import site
from oodd_leaderboard.curve_file import read_curves
from oodd_leaderboard.reported import REPORTED, read_entries, sections
from oodd_leaderboard.site.content import (
    WITH_INTERVALS,
    gridded,
    part_name,
    selections,
    shipped_split,
    shown_episodes,
    site_data,
)

from oodd_eval import __version__
from oodd_eval.data.condition import rungs_of
from oodd_eval.data.facts import ENVIRONMENTS, TABLE1
from oodd_eval.data.split import load_split
from oodd_eval.errors import ResultsError
from oodd_eval.metrics.catalogue import METRICS, NAMES, metric_info

STATIC = Path(site.__file__).parent / "static"


def printed(value, metric):
    return metric_info(metric).text(float("nan") if value is None else value)


def page_of(entries):
    return site.files(sections(entries))[site.PAGE]


@pytest.fixture(scope="module")
def files(entries):
    return site.files(sections(entries))


@pytest.fixture(scope="module")
def page(files):
    return files[site.PAGE]


def embedded(page):
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    return json.loads(found[1])


def row(data, label, board=0):
    (found,) = [r for r in data["boards"][board]["rows"] if r["label"] == label]
    return found


def part(files, label, board=0):
    """The part of a row."""
    return helpers_site.read_part(files, row(embedded(files[site.PAGE]), label, board)["part"])


@pytest.fixture(scope="module")
def graded(tmp_path_factory):
    return helpers_site.graded(tmp_path_factory.mktemp("board"))


# -- the page -------------------------------------------------------------------------------------


def test_every_part_of_the_page_is_filled_in(page):
    assert f"Made by oodd-eval {__version__}." in page
    assert not re.search("@[a-z-]+@", re.sub("<(script|style).*?</", "", page, flags=re.DOTALL))
    assert page.count("'sha256-") == 2


def test_the_same_entries_give_the_same_files_in_any_order(entries, files):
    assert site.files(sections(list(reversed(entries)))) == files


def test_placeholders_in_names_stay_as_they_are(tmp_path):
    record = helpers_site.describe(helpers_site.make_record("riqn", reason="@style@"))
    helpers_site.write_entry(tmp_path, "one", [record], caption="@script@ @data@")
    page = page_of(read_entries(tmp_path))
    assert embedded(page)["boards"][0]["rows"][0]["caption"] == "@script@ @data@"


def test_markup_in_an_entry_cannot_end_the_data(tmp_path):
    evil = "</script><script>alert(1)</script><!-- <b> & \u2028"
    helpers_site.write_entry(tmp_path, "one", [helpers_site.make_record()], caption=evil)
    files = site.files(sections(read_entries(tmp_path)))
    page = files[site.PAGE]
    assert embedded(page)["boards"][0]["rows"][0]["caption"] == evil
    assert "alert(1)" not in re.sub(r'<script type="application/json".*?</script>', "", page,
                                    flags=re.DOTALL)  # fmt: skip
    # As many elements as parts: data and script.
    assert page.count("<script") == page.count("</script>") == 2
    assert part(files, "riqn")["entry"]["caption"] == evil


@pytest.mark.parametrize("evil", ["'); alert(1); ('", "\\'); alert(1); //", "\\", "\n\u2028"])
def test_a_data_file_is_one_call_with_text(evil):
    text = site.data_file("x-1", {"a": evil, evil: 1})
    assert helpers_site.read_part({"data/x-1.js": text}, "x-1") == {"a": evil, evil: 1}
    # Outside of escapes there are two quotes for the name and two for the text.
    assert len(re.findall(r"(?<!\\)(?:\\\\)*'", text)) == 4
    assert "\n" not in text[:-1]


@pytest.mark.parametrize("name", ["../x", "A B", "\u00e4", "x" * 300, ""])
def test_names_of_data_files_are_safe_and_differ(name):
    assert re.fullmatch(r"[a-z0-9-]{1,60}", part_name(name))
    assert part_name(name) != part_name(name + " ")


def test_policy_names_the_only_style_and_script_by_digest(page):
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', page)
    rules = dict(part.strip().split(" ", 1) for part in policy.split(";"))
    assert rules["default-src"] == "'none'"
    (style,) = re.findall(r"<style>(.*?)</style>", page, re.DOTALL)
    (script,) = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    assert rules["style-src"] == site._digest(style)
    assert rules["script-src"] == f"'self' file: {site._digest(script)}"
    assert not re.search(r"""\s(?:style|on[a-z]+)=["']""", page.partition("<script")[0])


def test_nothing_is_fetched(page):
    markup = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    addresses = re.findall(r'(?:src|href)="([^"]*)"', markup)
    assert [a for a in addresses if not a.startswith("#/")] == [
        "data:,", "../README.md", "cells.csv.gz", "https://arxiv.org/abs/2107.04982"
    ]  # fmt: skip
    assert not re.search(r"url\(|@import", markup)


@pytest.mark.parametrize("name", site.SCRIPTS)
def test_scripts_never_read_text_as_markup(name):
    source = (STATIC / name).read_text()
    assert not re.search(
        r"innerHTML|outerHTML|insertAdjacent|document\.write|(?<!-)\beval\b", source
    )
    assert not re.search(r"\bfetch\(|XMLHttpRequest|import\(|WebSocket", source)


def test_every_static_file_is_used():
    assert {p.name for p in STATIC.iterdir()} == {*site.SCRIPTS, "style.css", "page.html"}


# -- the data -------------------------------------------------------------------------------------


def test_boards_never_mix_digests(page):
    boards = embedded(page)["boards"]
    assert [b["digest"] for b in boards] == ["ab" * 32, "cd" * 32]
    assert [[r["label"] for r in b["rows"]] for b in boards] == [
        ["riqn", "riqn[h=10]", "rf", "persistence", "clock", "mine[window=3]"],
        ["rf"],
    ]
    assert len({b["id"] for b in boards}) == 2


def test_rows_have_the_ranks_of_the_board(entries, page):
    section = sections(entries)[0]
    data = embedded(page)
    for standing in section.ranks.standings:
        found = row(data, str(standing.entry))
        assert (found["rank"], found["ties"], found["state"]) == (
            standing.rank, standing.ties, standing.state,
        )  # fmt: skip
    assert row(data, "mine[window=3]")["rank"] is None
    assert row(data, "mine[window=3]")["state"] == "timeout in 2 of 8 cells"


def test_a_row_says_what_it_is(page):
    found = row(embedded(page), "riqn[h=10]")
    assert (found["horizon"], found["inputs"], found["trivial"]) == (10, "observations+actions", 0)
    assert found["cost"] == {"fit": 2.5, "step": 50, "peak": 150}
    assert found["caption"] == "Three members instead of five."
    assert row(embedded(page), "clock")["trivial"] is True
    assert row(embedded(page), "rf")["seeds"] == [0, 1]


def test_cells_hold_values_and_intervals_in_the_order_of_the_metrics(entries, files):
    data = embedded(files[site.PAGE])
    board = data["boards"][0]
    (entry,) = [e for e in entries if e.meta.id == "third-party"]
    by_cell = {(r.environment, r.anomaly): r for r in entry.records}
    cells = part(files, "mine[window=3]")["cells"]
    assert [(c["environment"], c["anomaly"]) for c in cells] == [
        (e, a) for e in ENVIRONMENTS for a in TABLE1 if (e, a) in by_cell
    ]
    for cell in cells:
        record = by_cell[cell["environment"], cell["anomaly"]]
        if not record.ok:
            assert (cell["status"], cell["reason"]) == ("timeout", "not done after 5 s")
            assert "values" not in cell
            continue
        for i, metric in enumerate(board["metrics"]):
            assert cell["values"][i] == pytest.approx(record.value(metric), rel=1e-4)
        for i, metric in enumerate(board["intervals"]):
            shown = [printed(cell[end][i], metric) for end in ("low", "high")]
            one = record.metrics[metric]
            assert shown == [printed(end, metric) for end in (one.low, one.high)]


def test_the_index_has_means_and_intervals_as_they_are_printed(entries, page):
    board = sections(entries)[0].ranks.board
    data = embedded(page)["boards"][0]
    groups = {"all": board.anomalies, **{g: board.in_group(g) for g in ("sensor", "dynamics")}}
    for standing in sections(entries)[0].ranks.standings:
        found = row(embedded(page), str(standing.entry))["means"]
        for group, anomalies in groups.items():
            for i, metric in enumerate(data["metrics"]):
                units = 10 if metric_info(metric).unit == "steps" else 1000
                value = board.mean(standing.entry, board.environments, anomalies, metric)
                shown = found[group][0][i]
                shown = None if shown is None else shown / units
                assert printed(shown, metric) == printed(value.value, metric)


def test_the_part_of_a_metric_has_every_cell(entries, files):
    board = sections(entries)[0].ranks.board
    data = embedded(files[site.PAGE])["boards"][0]
    for metric in ("auc_matched", "delay"):
        found = helpers_site.read_part(files, data["parts"][metric])
        for standing in sections(entries)[0].ranks.standings:
            own = found["values"][row(embedded(files[site.PAGE]), str(standing.entry))["part"]]
            for (environment, anomaly), value in zip(data["cells"], own, strict=True):
                mean = board.mean(standing.entry, [environment], [anomaly], metric)
                expected = None if mean.state else pytest.approx(mean.value, rel=1e-5)
                assert value == expected


def test_intervals_of_selections_are_the_boards(entries, files):
    board = sections(entries)[0].ranks.board
    data = embedded(files[site.PAGE])
    compared = 0
    for standing in sections(entries)[0].ranks.standings:
        found = part(files, str(standing.entry))["intervals"]
        for environments, anomalies, key in [
            (board.environments, board.anomalies, "all|all"),
            (board.environments, board.in_group("sensor"), "all|sensor"),
            (["hopper"], board.anomalies, "hopper|all"),
            (["hopper"], board.anomalies, "bullet|all"),
            (["cartpole"], board.in_group("dynamics"), "cartpole|dynamics"),
            (board.environments, ["gravity"], "all|gravity"),
            (["hopper"], ["gravity"], "hopper|gravity"),
        ]:
            summary = key in ("all|all", "all|sensor", "all|dynamics")
            for metric in ("auc_matched", *(("delay", "far_twin") if summary else ())):
                value = board.mean(standing.entry, environments, anomalies, metric, intervals=True)
                if value.state or value.cells == 1:
                    assert key not in found
                else:
                    shown = found[key][data["boards"][0]["intervals"].index(metric)]
                    ends = [printed(end, metric) for end in (value.low, value.high)]
                    assert [printed(end, metric) for end in shown] == ends
                    compared += 1
    assert compared > 50
    assert "hopper|gravity" in part(files, "rf")["intervals"]


def test_selections_are_those_that_the_filters_can_make():
    cells = [(e, a) for e in ("ant", "hopper") for a in ("iid", "gravity")]
    found = selections(cells)
    assert set(found) == {
        f"{e}|{g}"
        for e in ("all", "bullet", "ant", "hopper")
        for g in ("all", "sensor", "dynamics", "iid", "gravity")
    }  # fmt: skip
    assert found["hopper|sensor"] == [("hopper", "iid")]
    assert found["all|all"] == cells
    found = selections([("ant", "iid"), ("hopper", "gravity")])  # those without cells are left out
    assert "ant|dynamics" not in found
    assert found["all|dynamics"] == [("hopper", "gravity")]


def test_damaged_curves_are_named(tmp_path):
    record = helpers_site.make_record()
    helpers_site.write_entry(tmp_path, "one", [record], curves=("riqn",))
    file = tmp_path / "one" / "curves.json"
    file.write_text(file.read_text().replace('"tpr":[', '"tpr":[7,'))
    with pytest.raises(ResultsError, match=r"units\[0\].roc.tpr"):
        page_of(read_entries(tmp_path))


def test_every_metric_of_the_page_is_explained(page):
    data = embedded(page)
    for board in data["boards"]:
        for metric in (*board["metrics"], *board["intervals"]):
            assert data["metrics"][metric]["meaning"]
            assert data["metrics"][metric]["title"][0].isupper()
    assert set(data["boards"][0]["intervals"]) <= set(WITH_INTERVALS)
    assert set(WITH_INTERVALS) <= set(NAMES)


def test_the_papers_digits_are_those_of_its_table(page):
    paper = embedded(page)["paper"]
    assert paper["acrobot"]["auc"]["sensor"]["rf"] == 79.16
    assert set(paper) == set(ENVIRONMENTS)


def test_weaker_anomalies_have_a_table_and_a_line_a_row(entries, graded):
    (power,) = embedded(site.files(sections(entries), graded)[site.PAGE])["power"]
    assert power["split"].startswith("mini")
    overview = power["tables"][0]
    assert [line[0] for line in overview["rows"]] == ["rf", "riqn", "clock"]
    assert [row["label"] for row in power["rows"]] == ["rf", "riqn", "clock"]
    assert [row["trivial"] for row in power["rows"]] == [False, False, True]
    rungs = rungs_of("cartpole", "iid")
    for row in power["rows"]:
        first, last = helpers_site.GRADED_ROWS[row["label"]]
        found, matched = row["points"]
        assert [point[0] for point in found] == pytest.approx(
            [rung.strength / rungs["kept99"].strength for rung in rungs.values()], rel=1e-3
        )
        assert (found[0][2], found[-1][2]) == (first, last)
        assert {point[2] for point in matched} == {0.5}
        lost = [1 - rung.kept for rung in rungs.values() if rung.kept == rung.kept]
        assert [p[1] for p in found if p[1] is not None] == pytest.approx(lost, abs=1e-3)
    assert embedded(page_of(entries))["power"] == []


def test_undefined_values_are_null_and_a_board_on_which_everything_failed_has_its_metrics(tmp_path):
    record = helpers_site.make_record(values={"delay": [None, None]})
    helpers_site.write_entry(tmp_path / "some", "one", [record])
    data, parts = site_data(sections(read_entries(tmp_path / "some")))
    index = data["boards"][0]["metrics"].index("delay")
    (line,) = data["boards"][0]["rows"]
    assert parts[line["part"]]["cells"][0]["values"][index] is None
    assert line["means"]["all"][0][index] is None
    record = helpers_site.make_record(status="oom", reason="needed 9 GB")
    helpers_site.write_entry(tmp_path / "none", "one", [record])
    data, _ = site_data(sections(read_entries(tmp_path / "none")))
    usual = [name for name, info in METRICS.items() if info.cells != "unpaired"]
    assert data["boards"][0]["metrics"] == usual
    assert set(usual) == set(data["metrics"])


def test_an_entry_says_its_source(tmp_path):
    record = helpers_site.make_record()
    named = {"distribution": "oodd-eval", "plugin": "riqn", "version": "1"}
    plugins = [
        {"distribution": "oodd-x", "plugin": "x", "version": "2", "source_digest": "ef" * 32},
        named | {"source_digest": "12" * 32},
    ]
    root = tmp_path / "results"
    helpers_site.write_entry(root, "one", [record], plugins=plugins)
    files = site.files(sections(read_entries(root)))
    assert REPORTED in files[site.PAGE]
    found = part(files, "riqn")
    assert found["entry"]["source_digest"] == "12" * 32


# -- curves as the page keeps them ----------------------------------------------------------------


def test_curves_are_those_of_the_entry_to_a_pixel(entries, files):
    units = read_curves(entries[0].curves)["units"]
    kept = part(files, "riqn")["curves"]
    compared = 0
    for unit in (unit for unit in units if unit["cell"].endswith("::riqn[h=1,seed=0]")):
        cell, example = kept[f"{unit['environment']}/{unit['anomaly']}"], unit["example"]
        assert (cell["roc"], cell["delay_far"]) == (unit["roc"], unit["delay_far"])
        for names, step in (
            (("scores", "twin"), cell["example"]["score_step"]),
            (("cusum", "twin_cusum"), cell["example"]["cusum_step"]),
        ):
            largest = max(abs(v) for name in names for v in example[name] if v is not None)
            for name in names:
                shown = [v if v is None else v * step for v in cell["example"][name]]
                assert shown == pytest.approx(example[name], abs=largest / 250)
                compared += len(shown)
        plain = ("index", "auc_matched", "onset", "length", "start", "alarms", "twin_alarms")
        assert {n: cell["example"][n] for n in plain} == {n: example[n] for n in plain}
    assert compared > 8 * 4 * 90


@pytest.mark.parametrize(
    ("largest", "step"), [(1.0, 0.002), (2.49, 0.005), (2.5, 0.01), (1000.0, 2.0)]
)
def test_steps_are_round_and_about_a_pixel(largest, step):
    example = {"scores": [largest, -largest], "twin": [None], "cusum": [0.01], "twin_cusum": [0.0]}
    found = gridded(example)
    assert found["score_step"] == step
    assert found["scores"] == [round(largest / step), -round(largest / step)]
    assert 250 <= found["scores"][0] <= 625


def test_numbers_for_a_logarithmic_scale_stay_as_they_are_and_none_have_a_step_too():
    example = {"scores": [0.123, 31.0, 0.1], "twin": [0.5], "cusum": [0.0], "twin_cusum": [0.0]}
    found = gridded(example)
    assert (found["score_step"], found["scores"]) == (None, [0.123, 31.0, 0.1])
    assert gridded(example | {"scores": [0.123, 30.0, 0.1]})["score_step"] == 0.1
    found = gridded({"scores": [None], "twin": [], "cusum": [], "twin_cusum": []})
    assert (found["scores"], found["score_step"]) == ([None], 0.002)


# -- sensors --------------------------------------------------------------------------------------


def test_sensors_of_shown_episodes_are_the_splits():
    split = load_split("mini")
    assert shipped_split(split.digest).path == split.path
    found = shown_episodes(split, "hopper", [("gravity", 1), ("gravity", 1)])
    data = split.environment("hopper")
    own, twin = data.anomalous("gravity")[1].observations, data.twins[1].observations
    names = [sensor.name for sensor in data.sensors]
    (sensors,) = found.values()
    assert list(found) == ["gravity/1"]
    assert len({sensor["name"] for sensor in sensors}) == 3
    for sensor in sensors:
        d = next(i for i, name in enumerate(names) if sensor["name"].startswith(name))
        for values, whole in ((own, sensor["own"]), (twin, sensor["twin"])):
            shown = np.array(whole) * sensor["step"]
            assert np.abs(shown - values[:, d]).max() <= sensor["step"] / 2 + 1e-9
        assert np.ptp(np.concatenate([own, twin])[:, d]) / sensor["step"] > 200


def test_no_sensors_of_a_split_that_is_not_in_the_package(page):
    assert shipped_split("ab" * 32) is None
    assert embedded(page)["boards"][0]["episodes"] == {}
