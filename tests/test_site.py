"""The site as text: what is in the page, that it is safe, and that numbers are the board's."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import helpers_site
import pytest

from oodd_eval import site
from oodd_eval.benchmark import ANOMALIES, ENVIRONMENTS
from oodd_eval.errors import OutputError, ResultsError
from oodd_eval.report.leaderboard import sections
from oodd_eval.site.data import WITH_INTERVALS, site_data
from oodd_eval.site.selections import selection_intervals, selections
from oodd_eval.submission.format import read_entries

GOLDEN = Path(__file__).parent / "golden" / "site-index.html"
STATIC = Path(site.__file__).parent / "static"


@pytest.fixture(scope="module")
def entries(tmp_path_factory):
    return helpers_site.example(tmp_path_factory.mktemp("results"))


@pytest.fixture(scope="module")
def page(entries):
    return site.page(entries)


def embedded(page, name="data"):
    start = f'<script type="application/json" id="{name}">'
    found = re.search(rf"{start}(.*?)</script>", page, re.DOTALL)
    return json.loads(found[1])


def row(data, label, board=0):
    (found,) = [r for r in data["boards"][board]["rows"] if r["label"] == label]
    return found


# -- the page -------------------------------------------------------------------------------------


def test_page_is_the_golden_file(entries, monkeypatch):
    monkeypatch.setattr(site, "__version__", "0.0.0")
    text = site.page(entries)
    if "OODD_EVAL_WRITE_GOLDEN" in os.environ:
        GOLDEN.write_text(text, encoding="utf-8")
    assert text == GOLDEN.read_text(encoding="utf-8")


def test_the_same_entries_give_the_same_page_in_any_order(entries, page):
    assert site.page(list(reversed(entries))) == page


def test_render_writes_one_file(entries, page, tmp_path):
    path = site.render(entries, tmp_path / "deep" / "site")
    assert path.read_text(encoding="utf-8") == page
    assert [p.name for p in path.parent.iterdir()] == ["index.html"]


def test_a_page_that_cannot_be_written_is_said_so(entries, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        site.render(entries, tmp_path / "file" / "site")


def test_a_page_without_entries_is_a_page():
    assert embedded(site.page([]))["boards"] == []


def test_nothing_is_left_to_fill_in(page):
    assert not re.search(r"@[a-z-]+@", re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL))


def test_placeholders_in_names_stay_as_they_are(tmp_path):
    record = helpers_site.describe(helpers_site.make_record("riqn", reason="@style@"))
    helpers_site.write_entry(tmp_path, "one", [record], caption="@script@ @data@")
    page = site.page(read_entries(tmp_path))
    assert embedded(page)["boards"][0]["rows"][0]["entries"][0]["caption"] == "@script@ @data@"


def test_markup_in_an_entry_cannot_end_the_data(tmp_path):
    evil = "</script><script>alert(1)</script><!-- <b> & \u2028"
    helpers_site.write_entry(tmp_path, "one", [helpers_site.make_record()], caption=evil)
    page = site.page(read_entries(tmp_path))
    assert embedded(page)["boards"][0]["rows"][0]["entries"][0]["caption"] == evil
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
    code = "import sys, oodd_eval, oodd_eval.cli; sys.exit('oodd_eval.site' in sys.modules)"
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
        found = row(data, standing.entry.label)
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
    assert found["entries"][0]["caption"] == "Three members instead of five."
    assert row(embedded(page), "clock")["trivial"] is True
    assert row(embedded(page), "rf")["seeds"] == [0, 1]


def test_cells_hold_values_and_intervals_in_the_order_of_the_metrics(entries, page):
    data = embedded(page)
    board = data["boards"][0]
    (entry,) = [e for e in entries if e.meta.id == "third-party"]
    by_cell = {(r.environment, r.anomaly): r for r in entry.records}
    cells = row(data, "mine[window=3]")["cells"]
    assert [(c["environment"], c["anomaly"]) for c in cells] == [
        (e, a) for e in ENVIRONMENTS for a in ANOMALIES if (e, a) in by_cell
    ]
    for cell in cells:
        record = by_cell[cell["environment"], cell["anomaly"]]
        if not record.ok:
            assert (cell["status"], cell["reason"]) == ("timeout", "not done after 5 s")
            assert "values" not in cell
            continue
        for i, metric in enumerate(board["metrics"]):
            assert cell["values"][i] == pytest.approx(record.value(metric), rel=1e-4)
            assert cell["n"][i] == record.metrics[metric].n


def test_intervals_of_selections_are_the_boards(entries, page):
    board = sections(entries)[0].ranks.board
    data = embedded(page)
    compared = 0
    for standing in sections(entries)[0].ranks.standings:
        found = row(data, standing.entry.label)["intervals"]
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
                    assert found[key][metric] == pytest.approx([value.low, value.high], rel=1e-4)
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
    curves = embedded(page, f"curves-{one['curves']}")
    assert set(curves) == {
        f"{e}/{a}" for e in ("cartpole", "hopper")
        for a in ("iid", "drift", "gravity", "components")
    }  # fmt: skip
    assert curves["hopper/iid"] != embedded(page, f"curves-{ten['curves']}")["hopper/iid"]


def test_damaged_curves_are_named(tmp_path):
    record = helpers_site.make_record()
    helpers_site.write_entry(tmp_path, "one", [record], curves=("riqn",))
    file = tmp_path / "one" / "curves.json"
    file.write_text(file.read_text().replace('"tpr":[', '"tpr":[7,'))
    with pytest.raises(ResultsError, match=r"units\[0\].roc.tpr"):
        site.page(read_entries(tmp_path))


def test_every_metric_of_the_page_is_explained(page):
    data = embedded(page)
    for board in data["boards"]:
        for metric in (*board["metrics"], *board["intervals"]):
            assert data["metrics"][metric]["meaning"]
            assert data["metrics"][metric]["title"][0].isupper()
    assert set(data["boards"][0]["intervals"]) <= set(WITH_INTERVALS)


def test_the_papers_digits_are_those_of_its_table(page):
    paper = embedded(page)["paper"]
    assert paper["acrobot"]["auc"]["sensor"]["rf"] == 79.16
    assert set(paper) == set(ENVIRONMENTS)


def test_undefined_values_are_null(tmp_path):
    record = helpers_site.make_record(values={"delay": [None, None]})
    helpers_site.write_entry(tmp_path, "one", [record])
    data, _ = site_data(read_entries(tmp_path))
    index = data["boards"][0]["metrics"].index("delay")
    assert data["boards"][0]["rows"][0]["cells"][0]["values"][index] is None


@pytest.mark.slow
def test_a_site_of_twelve_detectors_and_all_cells_is_below_five_megabytes(tmp_path):
    entries = helpers_site.full(tmp_path)
    page = site.page(entries)
    assert len(embedded(page)["boards"][0]["rows"]) == 12
    assert len(page.encode()) < 5e6
