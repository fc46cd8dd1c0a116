"""The site as text: what is in the page, that it is safe, and that numbers are the board's."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import helpers_site
import pytest

from oodd_eval import __version__
from oodd_eval.data.facts import ENVIRONMENTS, TABLE1
from oodd_eval.data.ladder import rungs_of
from oodd_eval.errors import ResultsError
from oodd_eval.leaderboard import site
from oodd_eval.leaderboard.entry import read_entries
from oodd_eval.leaderboard.sections import sections
from oodd_eval.leaderboard.site import gridded, packed
from oodd_eval.leaderboard.site.data import (
    WITH_INTERVALS,
    selection_intervals,
    selections,
    site_data,
)
from oodd_eval.metrics.catalogue import METRICS, NAMES, metric_info
from oodd_eval.results.curve_file import read_curves

GOLDEN = Path(__file__).parent / "golden" / "site-index.html"
COMMITTED = Path(__file__).parents[1] / "leaderboard" / "site" / site.PAGE
STATIC = Path(site.__file__).parent / "static"


def printed(value, metric):
    return metric_info(metric).text(float("nan") if value is None else value)


def page_of(entries):
    return site.page(sections(entries))


@pytest.fixture(scope="module")
def entries(tmp_path_factory):
    return helpers_site.example(tmp_path_factory.mktemp("results"))


@pytest.fixture(scope="module")
def page(entries):
    return page_of(entries)


def embedded(page, name="data"):
    start = f'<script type="application/json" id="{name}">'
    found = re.search(rf"{start}(.*?)</script>", page, re.DOTALL)
    return json.loads(found[1])


def row(data, label, board=0):
    (found,) = [r for r in data["boards"][board]["rows"] if r["label"] == label]
    return found


@pytest.fixture(scope="module")
def graded(tmp_path_factory):
    return helpers_site.graded(tmp_path_factory.mktemp("board"))


# -- the page -------------------------------------------------------------------------------------


def test_page_is_the_golden_file(page):
    text = page.replace(f"Made by oodd-eval {__version__}.", "Made by oodd-eval 0.0.0.")
    if "OODD_EVAL_WRITE_GOLDEN" in os.environ:
        GOLDEN.write_text(text, encoding="utf-8")
    assert text == GOLDEN.read_text(encoding="utf-8")


def test_the_same_entries_give_the_same_page_in_any_order(entries, page):
    assert page_of(list(reversed(entries))) == page


def test_a_page_without_entries_is_a_page():
    assert embedded(site.page([]))["boards"] == []


def test_nothing_is_left_to_fill_in(page):
    assert not re.search(r"@[a-z-]+@", re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL))


def test_placeholders_in_names_stay_as_they_are(tmp_path):
    record = helpers_site.describe(helpers_site.make_record("riqn", reason="@style@"))
    helpers_site.write_entry(tmp_path, "one", [record], caption="@script@ @data@")
    page = page_of(read_entries(tmp_path))
    assert embedded(page)["boards"][0]["rows"][0]["entry"]["caption"] == "@script@ @data@"


def test_markup_in_an_entry_cannot_end_the_data(tmp_path):
    evil = "</script><script>alert(1)</script><!-- <b> & \u2028"
    helpers_site.write_entry(tmp_path, "one", [helpers_site.make_record()], caption=evil)
    page = page_of(read_entries(tmp_path))
    assert embedded(page)["boards"][0]["rows"][0]["entry"]["caption"] == evil
    assert "alert(1)" not in re.sub(r'<script type="application/json".*?</script>', "", page,
                                    flags=re.DOTALL)  # fmt: skip
    # As many elements as parts: data and script; this entry has no curves.
    assert page.count("<script") == page.count("</script>") == 2


def test_policy_names_the_only_style_and_script_by_digest(page):
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', page)
    rules = dict(part.strip().split(" ", 1) for part in policy.split(";"))
    assert rules["default-src"] == "'none'"
    (style,) = re.findall(r"<style>(.*?)</style>", page, re.DOTALL)
    (script,) = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    assert (rules["style-src"], rules["script-src"]) == (site._digest(style), site._digest(script))
    assert not re.search(r"""\s(?:style|on[a-z]+)=["']""", page.partition("<script")[0])


def test_nothing_is_fetched(page):
    markup = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    assert re.findall(r'(?:src|href)="([^"]*)"', markup) == ["data:,", "#/"]
    assert not re.search(r"url\(|@import", markup)


@pytest.mark.parametrize("name", site.SCRIPTS)
def test_scripts_never_read_text_as_markup(name):
    source = (STATIC / name).read_text()
    assert not re.search(r"innerHTML|outerHTML|insertAdjacent|document\.write|\beval\b", source)
    assert not re.search(r"\bfetch\(|XMLHttpRequest|import\(|WebSocket", source)


def test_every_static_file_is_used():
    assert {p.name for p in STATIC.iterdir()} == {*site.SCRIPTS, "style.css", "page.html"}


def test_all_static_files_are_short():
    for path in STATIC.iterdir():
        assert len(path.read_text().splitlines()) <= 400


def test_importing_the_harness_does_not_import_the_site():
    site = "oodd_eval.leaderboard.site"
    code = f"import sys, oodd_eval, oodd_eval.cli.main; sys.exit({site!r} in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


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
        assert found["trust"] == section.trust[standing.entry]
    assert row(data, "mine[window=3]")["rank"] is None
    assert row(data, "mine[window=3]")["state"] == "timeout in 2 of 8 cells"


def test_a_row_says_what_it_is(page):
    found = row(embedded(page), "riqn[h=10]")
    assert (found["horizon"], found["inputs"], found["trivial"]) == (10, "observations+actions", 0)
    assert found["cost"] == {"fit": 2.5, "step": 50, "peak": 150}
    assert found["entry"]["caption"] == "Three members instead of five."
    assert row(embedded(page), "clock")["trivial"] is True
    assert row(embedded(page), "rf")["seeds"] == [0, 1]


def test_cells_hold_values_and_intervals_in_the_order_of_the_metrics(entries, page):
    data = embedded(page)
    board = data["boards"][0]
    (entry,) = [e for e in entries if e.meta.id == "third-party"]
    by_cell = {(r.environment, r.anomaly): r for r in entry.records}
    cells = row(data, "mine[window=3]")["cells"]
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


def test_intervals_of_selections_are_the_boards(entries, page):
    board = sections(entries)[0].ranks.board
    data = embedded(page)
    compared = 0
    for standing in sections(entries)[0].ranks.standings:
        found = row(data, str(standing.entry))["intervals"]
        for environments, anomalies, key in [
            (board.environments, board.anomalies, "all|all"),
            (board.environments, board.in_group("sensor"), "all|sensor"),
            (["hopper"], board.anomalies, "hopper|all"),
            (["hopper"], board.anomalies, "bullet|all"),
            (["cartpole"], board.in_group("dynamics"), "cartpole|dynamics"),
            (board.environments, ["gravity"], "all|gravity"),
            (["hopper"], ["gravity"], "hopper|gravity"),
        ]:
            for metric in ("auc_matched", "delay", "far_twin"):
                value = board.mean(standing.entry, environments, anomalies, metric, intervals=True)
                if value.state or value.cells == 1:
                    assert key not in found
                else:
                    shown = found[key][data["boards"][0]["intervals"].index(metric)]
                    ends = [printed(end, metric) for end in (value.low, value.high)]
                    assert [printed(end, metric) for end in shown] == ends
                    compared += 1
    assert compared > 80
    assert "hopper|gravity" in row(data, "rf")["intervals"]


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


def test_selections_without_cells_are_left_out():
    found = selections([("ant", "iid"), ("hopper", "gravity")])
    assert "ant|dynamics" not in found
    assert found["all|dynamics"] == [("hopper", "gravity")]


def test_no_interval_without_the_metric(entries):
    records = [r for r in entries[0].records if r.detector == "rf"]
    assert selection_intervals(records, "no_such", selections([("hopper", "iid")])) == {}


def test_curves_are_those_of_the_row(page):
    data = embedded(page)
    one, ten = row(data, "riqn"), row(data, "riqn[h=10]")
    assert {one["curves"], ten["curves"]} == {0, 1}
    assert row(data, "rf")["curves"] is None
    curves = embedded(page, f"curves-{one['curves']}")["cells"]
    assert set(curves) == {
        f"{e}/{a}" for e in ("cartpole", "hopper")
        for a in ("iid", "drift", "gravity", "components")
    }  # fmt: skip
    assert curves["hopper/iid"] != embedded(page, f"curves-{ten['curves']}")["cells"]["hopper/iid"]


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
    (power,) = embedded(site.page(sections(entries), graded))["power"]
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


def test_undefined_values_are_null(tmp_path):
    record = helpers_site.make_record(values={"delay": [None, None]})
    helpers_site.write_entry(tmp_path, "one", [record])
    data, _ = site_data(sections(read_entries(tmp_path)))
    index = data["boards"][0]["metrics"].index("delay")
    assert data["boards"][0]["rows"][0]["cells"][0]["values"][index] is None


def test_a_board_on_which_everything_failed_has_its_metrics(tmp_path):
    record = helpers_site.make_record(status="oom", reason="needed 9 GB")
    helpers_site.write_entry(tmp_path, "one", [record])
    data, _ = site_data(sections(read_entries(tmp_path)))
    assert data["boards"][0]["metrics"] == list(METRICS)
    assert set(METRICS) == set(data["metrics"])


def test_an_entry_says_who_granted_its_trust_and_its_source(tmp_path):
    record = helpers_site.make_record()
    named = {"distribution": "oodd-eval", "plugin": "riqn", "version": "1"}
    plugins = [
        {"distribution": "oodd-x", "plugin": "x", "version": "2", "source_digest": "ef" * 32},
        named | {"source_digest": "12" * 32},
    ]
    root = tmp_path / "results"
    helpers_site.write_entry(root, "one", [record], trust="re-run", plugins=plugins)
    found = row(site_data(sections(read_entries(root)))[0], "riqn")
    assert found["trust"] == "re-run"
    assert found["entry"]["grant"] == {
        "by": "C. Hecker", "day": "2026-11-22", "how": "fresh seeds",
    }  # fmt: skip
    assert found["entry"]["source_digest"] == "12" * 32


# -- curves as the page keeps them ----------------------------------------------------------------


def test_unpacked_curves_are_those_of_the_entry_to_a_pixel(entries, page):
    units = read_curves(entries[0].curves)["units"]
    one = row(embedded(page), "riqn")
    kept = embedded(page, f"curves-{one['curves']}")
    compared = 0
    for unit in units:
        if not unit["cell"].endswith("::riqn[h=1,seed=0]"):
            continue
        cell = kept["cells"][f"{unit['environment']}/{unit['anomaly']}"]
        for part in ("roc", "delay_far"):
            shown = {name: kept["lists"][place] for name, place in cell[part].items()}
            assert shown == unit[part]
        example = unit["example"]
        for names, step in (
            (("scores", "twin"), cell["example"]["score_step"]),
            (("cusum", "twin_cusum"), cell["example"]["cusum_step"]),
        ):
            largest = max(abs(v) for name in names for v in example[name] if v is not None)
            same = cell["example"][f"same_{names[0]}"]
            assert same >= example["onset"] - example["start"]
            for name in names:
                kept_here = cell["example"][name]
                if name == names[1]:
                    kept_here = [*cell["example"][names[0]][:same], *kept_here]
                shown = [v if v is None else v * step for v in kept_here]
                assert shown == pytest.approx(example[name], abs=largest / 250)
                compared += len(shown)
        plain = ("index", "auc_matched", "onset", "length", "start", "alarms", "twin_alarms")
        assert {n: cell["example"][n] for n in plain} == {n: example[n] for n in plain}
    assert compared > 8 * 4 * 90


def test_lists_that_cells_share_are_kept_once():
    example = {"scores": [1.0], "twin": [1.0], "cusum": [0.0], "twin_cusum": [0.0]}
    one = {"roc": {"fpr": [0, 1], "tpr": [0.5, 1]}, "delay_far": {"far": [0, 1]}, "seed": 0}
    found = packed({"ant/iid": one | {"example": example}, "ant/drift": one | {"example": example}})
    assert found["lists"] == [[0, 1], [0.5, 1]]
    assert found["cells"]["ant/iid"]["roc"] == {"fpr": 0, "tpr": 1}
    assert found["cells"]["ant/drift"]["delay_far"] == {"far": 0}


def test_a_twin_keeps_only_what_differs():
    example = {"scores": [None, 1, 2, 3], "twin": [None, 1, 2.5, 3, 1],
               "cusum": [0, 0, 0], "twin_cusum": [0]}  # fmt: skip
    one = {"roc": {}, "delay_far": {}, "example": example}
    found = packed({"ant/iid": one})["cells"]["ant/iid"]["example"]
    assert (found["same_scores"], found["same_cusum"], found["twin_cusum"]) == (2, 1, [])
    assert [v * found["score_step"] for v in found["twin"]] == [2.5, 3, 1]


@pytest.mark.parametrize(
    ("largest", "step"), [(1.0, 0.002), (2.49, 0.005), (2.5, 0.01), (5.0, 0.02), (1000.0, 2.0)]
)
def test_steps_are_round_and_about_a_pixel(largest, step):
    example = {"scores": [largest, -largest], "twin": [None], "cusum": [0.01], "twin_cusum": [0.0]}
    found = gridded(example)
    assert found["score_step"] == step
    assert found["scores"] == [round(largest / step), -round(largest / step)]
    assert 250 <= found["scores"][0] <= 625


def test_numbers_for_a_logarithmic_scale_stay_as_they_are():
    example = {"scores": [0.123, 31.0, 0.1], "twin": [0.5], "cusum": [0.0], "twin_cusum": [0.0]}
    found = gridded(example)
    assert (found["score_step"], found["scores"]) == (None, [0.123, 31.0, 0.1])
    assert gridded(example | {"scores": [0.123, 30.0, 0.1]})["score_step"] == 0.1


def test_an_example_without_defined_scores_is_kept():
    found = gridded({"scores": [None], "twin": [], "cusum": [], "twin_cusum": []})
    assert (found["scores"], found["score_step"]) == ([None], 0.002)


# -- size -----------------------------------------------------------------------------------------


def test_a_full_site_of_two_splits_is_below_five_megabytes(monkeypatch):
    data, curves = helpers_site.full()
    assert len(curves) == sum(len(b["rows"]) for b in data["boards"]) == 28
    assert all(len(r["cells"]) == 56 for b in data["boards"] for r in b["rows"])
    monkeypatch.setattr(site, "site_data", lambda *_: (data, curves))
    assert len(site.page([]).encode()) < 5e6


def test_the_committed_site_is_below_five_megabytes():
    if not COMMITTED.exists():
        pytest.skip("no leaderboard/site/index.html in this checkout")
    assert COMMITTED.stat().st_size < 5e6
