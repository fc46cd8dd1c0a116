"""The site as text: what is in the page, that it is safe, and that numbers are the board's."""

import json
import re
from dataclasses import replace
from pathlib import Path

import helpers_site
import numpy as np
import pytest
from oodd_leaderboard import site
from oodd_leaderboard.curve_file import read_curves
from oodd_leaderboard.reported import REPORTED, sections
from oodd_leaderboard.seasons import newest_first
from oodd_leaderboard.site.content import (
    gridded,
    part_name,
    selections,
    shipped_split,
    shown_episodes,
    site_data,
)

from oodd_eval import __version__
from oodd_eval.data.condition import rungs_of
from oodd_eval.data.split import load_split
from oodd_eval.errors import ResultsError
from oodd_eval.metrics.catalogue import METRICS, metric_info

STATIC = Path(site.__file__).parent / "static"

LINKS = {"home": "../../README.md", "submit": "../../docs/submitting.md",
         "cite": "../../docs/cite.md", "source": "../../."}  # fmt: skip

EVIL = "</script><script>alert(1)</script><!-- <b> & \u2028 @style@"


def printed(value, metric):
    return metric_info(metric).text(float("nan") if value is None else value)


@pytest.fixture(scope="module")
def files(reported, season):
    return site.files(reported, (), [season], links=LINKS)


@pytest.fixture(scope="module")
def page(files):
    return files[site.PAGE]


def embedded(page):
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    return json.loads(found[1])


def row(page, label, board=0):
    (found,) = [r for r in embedded(page)["boards"][board]["rows"] if r["label"] == label]
    return found


def part(files, label, board=0):
    """The part of a row."""
    return helpers_site.read_part(files, row(files[site.PAGE], label, board)["part"])


# -- the page -------------------------------------------------------------------------------------


def test_every_part_of_the_page_is_filled_in(page):
    assert f"Made by oodd-eval {__version__}." in page
    assert not re.search("@[a-z-]+@", re.sub("<(script|style).*?</", "", page, flags=re.DOTALL))
    assert page.count("'sha256-") == 2


def test_every_page_leads_home_to_the_board_to_submitting_and_to_the_source(page):
    (line,) = re.findall(r'<nav class="site" aria-label="Site">(.*?)</nav>', page, re.DOTALL)
    links = re.findall('href="([^"]*)">([^<]*)<', line)
    assert links == [(LINKS["home"], "Home"), ("#/", "Board"), (LINKS["submit"], "Submit"),
                     (LINKS["cite"], "Cite"), (LINKS["source"], "Source")]  # fmt: skip


def test_links_lead_to_the_checkout_that_a_site_is_in(tmp_path, monkeypatch):
    monkeypatch.setattr(site, "__file__", str(tmp_path / "site-packages" / "site.py"))
    beside = site.links(tmp_path / "my-board")
    assert beside == {"home": "../README.md", "submit": "../README.md#how-to-take-part"}
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "submitting.md").touch()
    assert site.links(tmp_path / "leaderboard") == LINKS
    found = site.links(tmp_path / "leaderboard" / "seasons" / "one")
    assert found["submit"] == "../../../../docs/submitting.md"
    monkeypatch.setattr(site, "repository", lambda: "https://example.org/x")
    assert site.links(tmp_path)["submit"] == "https://example.org/x/blob/main/docs/submitting.md"


def test_the_head_says_which_season_it_is_and_of_what_day(page, reported):
    assert "<strong>Season 2026-11, 27 November 2026.</strong>" in page
    assert "No season has ended yet" in site.files(reported)[site.PAGE]
    trial = helpers_site.season(name="small", trial=True)
    files = site.files((), (), [trial])
    assert "A trial season: no board." in files[site.PAGE]
    (board,) = embedded(files[site.PAGE])["boards"]
    assert board["title"] == "Trial small: no board"
    assert board["notice"] == "This trial lacks environments ant, arm."


def test_the_newest_season_is_first_then_trials_then_reported_tables(reported, season):
    older = helpers_site.season(name="2026-05", date="2026-05-20")
    trial = helpers_site.season(name="small", date="2026-12-01", trial=True)
    data, _ = site_data(reported, (), newest_first([trial, older, season]))
    assert [board["name"] for board in data["boards"]] == [
        "Season 2026-11", "Season 2026-05", "Trial small",
        "Reported: mini (abababab)", "Reported: mini (cdcdcdcd)",
    ]  # fmt: skip
    assert [board["notice"] for board in data["boards"]] == [
        "", "", "This trial lacks environments ant, arm.", REPORTED, REPORTED,
    ]  # fmt: skip


def test_markup_and_placeholders_in_names_stay_text(tmp_path):
    rng = np.random.default_rng(0)
    records = helpers_site.row_records("mine", rng=rng, failed=helpers_site.CELLS[:1])
    entry = helpers_site.Entry("mine", authors=EVIL, paper=EVIL, url=EVIL, licence=EVIL)
    found = sections([helpers_site.report(tmp_path, "one", records)], {"mine": entry})
    files = site.files(found)
    page = files[site.PAGE]
    assert row(page, "mine")["authors"] == EVIL
    assert part(files, "mine")["entry"]["licence"] == EVIL
    markup = re.sub(r'<script type="application/json".*?</script>', "", page, flags=re.DOTALL)
    assert "alert(1)" not in markup
    # As many elements as parts: data and script.
    assert page.count("<script") == page.count("</script>") == 2


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
    assert {a for a in addresses if not a.startswith("#/")} == {
        "data:,", "../README.md", "cells.csv.gz", *LINKS.values()
    }  # fmt: skip
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


def test_rows_have_the_ranks_and_tests_of_the_board(season, page):
    rows = embedded(page)["boards"][0]["rows"]
    assert [r["label"] for r in rows] == [str(s.entry) for s in season.ranks.standings]
    for place, (found, standing) in enumerate(zip(rows, season.ranks.standings, strict=True)):
        assert found["place"] == place
        for name in ("rank", "equal", "band", "state", "variant", "origin", "authors", "year"):
            assert found[name] == getattr(standing, name)
        for name in ("above", "first"):
            test = getattr(season.ranks, name).get(standing.entry)
            assert (found[name] is None) == (test is None)
            if test:
                assert (found[name]["row"], found[name]["told"]) == (test.first, test.told_apart)
                ends = [found[name][end] for end in ("difference", "low", "high")]
                assert ends == pytest.approx([test.difference, test.low, test.high], rel=1e-5)
    assert row(page, "oracle")["rank"] is None
    assert row(page, "broken")["state"] == "timeout in 2 of 8 cells"
    assert {r["rank"] for r in embedded(page)["boards"][1]["rows"]} == {None}


def test_a_row_says_what_it_is_and_where_it_is_from(files, page):
    found = row(page, "riqn")
    assert (found["seeds"], found["inputs"]) == ([0, 1, 2], "observations")
    assert found["cost"] == {"fit": 2.5, "step": 50, "peak": 150}
    assert found["seed_means"][0] < found["means"]["*|*"][0][2] / 1000 < found["seed_means"][1]
    entry = part(files, "mine")["entry"]
    assert (entry["requirement"], entry["sha256"], entry["licence"]) == (
        "mine-1.2-py3-none-any.whl", "12" * 32, "MIT",
    )  # fmt: skip
    board = embedded(page)["boards"][0]
    assert board["season"]["bits"] == "0123456789abcdef" * 2
    assert board["season"]["installed"]["mine"][0]["version"] == "1.2"
    assert part(files, "riqn", 1)["entry"]["reported"] == "forecasters"
    assert row(page, "riqn[h=10]", 1)["variant"] is True


def test_the_worst_environment_is_the_boards(season, page):
    board = season.ranks.board
    for standing in season.ranks.standings:
        found = row(page, str(standing.entry))["worst"]
        means = {
            e: board.mean(standing.entry, [e], board.anomalies, "auc_matched").value
            for e in board.environments
        }
        defined = {e: value for e, value in means.items() if not np.isnan(value)}
        worst = min(defined, key=defined.get)
        assert found == {"environment": worst, "value": pytest.approx(defined[worst], rel=1e-5)}


def test_the_index_has_means_and_intervals_as_they_are_printed(season, page):
    board = season.ranks.board
    data = embedded(page)["boards"][0]
    groups = {"*": board.anomalies, **{f"*{g}": board.in_group(g) for g in board.groups}}
    assert set(groups) == {"*", "*sensor", "*dynamics"}
    for standing in season.ranks.standings:
        found = row(page, str(standing.entry))["means"]
        for group, anomalies in groups.items():
            for i, metric in enumerate(data["metrics"]):
                units = 10 if metric_info(metric).unit == "steps" else 1000
                value = board.mean(standing.entry, board.environments, anomalies, metric)
                shown = found[f"*|{group}"][0][i]
                shown = None if shown is None else shown / units
                assert printed(shown, metric) == printed(value.value, metric)


def test_parts_have_every_cell_and_the_intervals_of_every_selection(season, files, page):
    board = season.ranks.board
    data = embedded(page)["boards"][0]
    compared = 0
    for metric, standing in [
        (metric, standing)
        for metric in ("auc_matched", "delay", "false_episodes_at_5pct")
        for standing in season.ranks.standings
    ]:
        found = helpers_site.read_part(files, data["parts"][metric])
        name = row(page, str(standing.entry))["part"]
        own = part(files, str(standing.entry))
        assert found["values"][name] == own["values"][data["metrics"].index(metric)]
        for (environment, anomaly), value in zip(data["cells"], found["values"][name], strict=True):
            mean = board.mean(standing.entry, [environment], [anomaly], metric)
            assert value == (None if mean.state else pytest.approx(mean.value, rel=1e-5))
        place = data["intervals"].index(metric)
        for environments, anomalies, key in [
            (board.environments, board.anomalies, "*|*"),
            (["hopper"], board.anomalies, "hopper|*"),
            (["cartpole"], board.in_group("dynamics"), "cartpole|*dynamics"),
            (board.environments, ["gravity"], "*|gravity"),
        ]:
            value = board.mean(standing.entry, environments, anomalies, metric, intervals=True)
            if value.state or (metric == "delay" and key != "*|*"):
                continue
            ends = [printed(end, metric) for end in (value.low, value.high)]
            for pair in (own["intervals"][key][place], found["intervals"][name][key]):
                assert [printed(end, metric) for end in pair] == ends
                compared += 1
    assert compared > 80


def test_selections_are_those_that_the_filters_can_make():
    cells = [("ant", "iid"), ("ant", "gravity"), ("tank", "leak")]
    found = selections(cells, {"iid": "sensor", "gravity": "dynamics"})
    assert set(found) == {
        *("*|*", "*|*sensor", "*|*dynamics", "*|iid", "*|gravity", "*|leak"),
        *("ant|*", "ant|*sensor", "ant|*dynamics", "ant|iid", "ant|gravity"),
        *("tank|*", "tank|leak"),
    }
    assert found["*|*"] == cells
    assert found["ant|*"] == cells[:2]


def test_environments_and_anomalies_of_plugins_and_strengths_have_their_names(tmp_path, page):
    records = [
        replace(record, environment="arm", anomaly="payload", strength="kept90")
        for record in helpers_site.row_records(
            "riqn", rng=np.random.default_rng(0), cells=[("hopper", "gravity")]
        )
    ]
    data, _ = site_data(sections([helpers_site.report(tmp_path, "one", records)]))
    (board,) = data["boards"]
    assert board["environments"] == {"arm": "arm"}
    assert board["anomalies"] == {
        "payload": {"title": "payload", "summary": "", "group": "dynamics"}
    }
    assert board["strengths"] == {"arm|payload": "kept90"}
    (board, *_) = embedded(page)["boards"]
    assert board["environments"] == {"cartpole": "CartPole", "hopper": "Hopper"}
    assert set(board["strengths"].values()) == {""}


def test_damaged_curves_are_named(tmp_path):
    record = helpers_site.make_record()
    found = helpers_site.report(tmp_path, "one", [record], curves=("riqn",))
    file = tmp_path / "one" / "curves.json"
    file.write_text(file.read_text().replace('"tpr":[', '"tpr":[7,'))
    with pytest.raises(ResultsError, match=r"units\[0\].roc.tpr"):
        site.files(sections([found]))


def test_every_metric_of_the_page_is_explained(page):
    data = embedded(page)
    for board in data["boards"]:
        assert set(board["intervals"]) <= set(board["metrics"])
        for metric in board["metrics"]:
            assert data["metrics"][metric]["meaning"]
            assert data["metrics"][metric]["title"][0].isupper()


def test_suites_have_tables_and_of_graded_strengths_a_line_a_row(tmp_path):
    suites = helpers_site.graded(tmp_path)
    (suite,) = embedded(site.files((), suites)[site.PAGE])["suites"]
    assert suite["split"].startswith("mini")
    labels = [line[0] for line in suite["tables"][0]["rows"]]
    assert [row["label"] for row in suite["rows"]] == labels
    assert {row["label"]: row["trivial"] for row in suite["rows"]} == {
        "rf": False, "riqn": False, "clock": True,
    }  # fmt: skip
    rungs = rungs_of("cartpole", "iid")
    for row in suite["rows"]:
        first, last = helpers_site.GRADED_ROWS[row["label"]]
        found, matched = row["points"]
        assert [point[0] for point in found] == pytest.approx(
            [rung.strength / rungs["kept99"].strength for rung in rungs.values()], rel=1e-3
        )
        assert (found[0][2], found[-1][2]) == (first, last)
        assert {point[2] for point in matched} == {0.5}


def test_undefined_values_are_null_and_a_table_on_which_everything_failed_has_metrics(tmp_path):
    record = helpers_site.make_record(values={"delay": [None, None]})
    data, parts = site_data(sections([helpers_site.report(tmp_path, "one", [record])]))
    index = data["boards"][0]["metrics"].index("delay")
    (line,) = data["boards"][0]["rows"]
    assert parts[line["part"]]["values"][index] == [None]
    assert line["means"]["*|*"][0][index] is None
    record = helpers_site.make_record(status="oom", reason="needed 9 GB")
    data, _ = site_data(sections([helpers_site.report(tmp_path, "two", [record])]))
    assert data["boards"][0]["rows"][0]["failed"] == [[0, "oom", "needed 9 GB"]]
    usual = [name for name, info in METRICS.items() if info.cells != "unpaired"]
    assert data["boards"][0]["metrics"] == usual


# -- curves as the page keeps them ----------------------------------------------------------------


def test_curves_are_those_of_the_entry_to_a_pixel(reported, files):
    source = next(s for s in reported[0].sources.values() if s.curves)
    units = read_curves(source.curves)["units"]
    kept = part(files, "riqn", 1)["curves"]
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
    assert embedded(page)["boards"][1]["episodes"] == {}
