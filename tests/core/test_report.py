"""Reports: every table in every format, numbers worked by hand, terminal output of 80 columns."""

import csv
import io
import itertools
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser

import helpers_browser
import numpy as np
import pytest
from helpers_records import example, make_record
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from oodd_eval.cli.main import main
from oodd_eval.cli.reporter import TerminalReporter, print_report
from oodd_eval.data.facts import TABLE1
from oodd_eval.metrics.bootstrap import bounds, drawn_cell, sample_cells
from oodd_eval.metrics.catalogue import PAPER
from oodd_eval.metrics.recalibration import PairedScores
from oodd_eval.prose import Table, print_prose, print_sections, print_table
from oodd_eval.results import tables
from oodd_eval.results.board import Board, boards, contribution
from oodd_eval.results.comparison import write_reference
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.evaluate import Rules, cell_metrics
from oodd_eval.results.render import FORMATS
from oodd_eval.results.report import Report, findings_of
from oodd_eval.results.standings import compare_rows, verdict_of, with_interval
from oodd_eval.results.tables import Tables, why_undefined


def rendered(records, name="markdown", **settings):
    return FORMATS[name].render(Report(records, **settings))


def markdown_tables(text):
    """Tables by title: header, alignment row, rows."""
    tables = {}
    for part in text.split("\n### ")[1:]:
        title, _, rest = part.partition("\n\n")
        lines = [line for line in rest.split("\n\n")[0].splitlines() if line.startswith("|")]
        rows = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
        tables.setdefault(title, rows)
    return tables


def cells(table, row):
    return dict(zip(table.header, table.rows[row], strict=True))


TITLES = {  # by the start of a title: columns of labels, and one number: row, column, text
    "Matched AUC and guaranteed alarms at 5 % (%)": (1, "riqn", "worst environment", "ant 67.5"),
    "Matched AUC (%) by group and environment": (1, "riqn", "mean", "67.5"),
    "Guaranteed alarms at 5 % (delays in steps": (1, "riqn", "delay if found", "8.0"),
    f"{PAPER} (delays in steps, the rest as shares)": (1, "riqn", "delay", "3.2"),
    f"{PAPER}. AUC (%), delay (steps), false-alarm rate (FAR), sen": (2, "Hopper", "AVG", "85.0"),
    f"{PAPER}. AUC (%), delay (steps), false-alarm rate (FAR), dyn": (2, "Hopper", "riqn", "80.0"),
    "All metrics of separability (%), mean over cells": (1, "riqn", "AUC", "85.0"),
    "riqn: matched AUC": (1, "Hopper", "gravity", "65.0"),
    "rf: matched AUC": (1, "Ant", "iid", "timeout"),
    "persistence: matched AUC": (1, "Ant", "gravity", "50.0"),
    "clock: matched AUC": (1, "Ant", "gravity", "45.0"),
    "Failures": (4, "ant", "state", "timeout"),
}


def test_markdown_has_every_table_with_its_columns_and_numbers():
    text = rendered(example())
    tables = markdown_tables(text)
    assert text.startswith(
        "# Results\n\n## Split mini\n\n**riqn is first of four and cannot be told from"
    )
    assert "\n\nCells: 16, of which 14 ok and 2 failed.\n\n" in text
    assert len(tables) == len(TITLES)
    for start, (labels, label, column, number) in TITLES.items():
        ((header, sides, *rows),) = [t for title, t in tables.items() if title.startswith(start)]
        assert [side[0] for side in sides] == [":"] * labels + ["-"] * (len(header) - labels)
        row = next(row for row in rows if row[0] == label)
        assert row[header.index(column)] == number, start
    intervals = markdown_tables(rendered(example(), intervals=True))
    # The seed's two trajectories: 0.7 in both of iid, 0.6 and 0.7 of gravity.
    row = next(t for title, t in intervals.items() if title.startswith("Matched AUC (%) by"))[2]
    assert re.fullmatch(r"67\.5 \\\[6\d\.\d, (67\.5|[67]\d\.\d)\]", row[1])
    assert "No records" in rendered([])


def test_a_reference_with_chosen_metrics_has_no_tables_of_dashes(tmp_path):
    """Tables with undefined values say why, and without any metric that all failed."""
    kept = tmp_path / "records.jsonl"
    write_reference([r for r in example() if r.ok], kept, keep=["found_within_20_at_5pct"])
    text = rendered(ResultsDirectory(tmp_path).records())
    assert [*markdown_tables(text)] == ["Guaranteed alarms at 5 % (%)"]
    assert text.count("Guaranteed alarms at 5 % (%)") == 1  # in the overview and of all levels
    undefined = [make_record("x", values={"auc_matched": [None, None]})]
    assert "Undefined for x: " in rendered(undefined)
    failed = [make_record("x", status="error", reason="none")]
    assert any(title.startswith("Matched AUC") for title in markdown_tables(rendered(failed)))


class _Html(HTMLParser):
    def __init__(self):
        super().__init__()
        self.tags, self.texts = [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)

    def handle_data(self, data):
        self.texts.append(data)


@pytest.mark.parametrize("name", ["markdown", "html", "latex"])
def test_formats_for_people_have_the_same_titles_and_cells(name):
    records = [*example(), make_record("x", status="error", reason="a <b>&_$ | {c}")]
    text = rendered(records, name)
    report = Report(records)
    if name == "html":
        parser = _Html()
        parser.feed(text)
        assert parser.tags.count("table") == len(report.sections[0].tables)
        text = " ".join(parser.texts)
    assert text.index("riqn") < text.index("Cells: ")  # the verdict comes first
    for table in report.sections[0].tables:
        assert table.rows[0][-1].partition(" [")[0].rstrip("*") in text
        assert table.title.partition("%")[0].rstrip("( ") in text
    assert "<b>" in text if name == "html" else "<b>" not in text.replace("\\<b\\>", "")


@pytest.mark.browser
@pytest.mark.skipif(helpers_browser.programs() is None, reason="no Chromium and chromedriver")
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_a_report_in_html_is_a_page_for_every_width(theme, tmp_path):
    records = [*example(), make_record("x", status="error", reason="because-" * 40)]
    page = tmp_path / "report.html"
    page.write_text(rendered(records, "html"), encoding="utf-8")
    with helpers_browser.launch(tmp_path) as browser, browser.colours(theme), browser.narrow(390):
        browser.open(page.as_uri())
        assert browser.run("return [document.title, document.documentElement.lang]") == [
            Report(records).title,
            "en",
        ]
        assert browser.run("return document.querySelector('table').scrollWidth") > 390
        assert browser.defects(390) == []


def test_latex_is_plain_tabulars_with_escaped_text():
    records = [make_record("a_b", status="error", reason="50 % of {x} & y^2 [z] \\ ~ Δ <b>")]
    text = rendered(records, "latex")
    assert r"50 \% of \{x\} \& y\textasciicircum{}2 {[}z{]} \textbackslash{}" in text
    assert r"\textasciitilde{} $\Delta$ \textless{}b\textgreater{}" in text
    assert r"a\_b" in text
    assert text.count(r"\begin{tabular}{") == text.count(r"\end{tabular}")
    assert "rule" not in text
    assert text.isascii()


def test_formats_for_programs_have_a_line_a_cell():
    records = [make_record(values={"far": [None, None]}), make_record("rf", status="oom")]
    lines = list(csv.DictReader(io.StringIO(rendered(records, "csv"))))
    objects = json.loads(rendered(records, "json"))
    assert [line["row"] for line in lines] == [o["row"] for o in objects] == ["riqn", "rf"]
    assert (lines[0]["auc"], objects[0]["auc"], objects[0]["far"]) == ("0.5", 0.5, None)
    assert (lines[1]["auc"], objects[1]["auc"], lines[0]["far"]) == ("", None, "")


@pytest.mark.parametrize("name", FORMATS)
def test_show_prints_every_format(name, tmp_path, capsys):
    text = "".join(r.to_json() + "\n" for r in example())
    (tmp_path / "records.jsonl").write_text(text)
    assert main(["show", str(tmp_path), "--stored", f"--{name}"]) == 1  # a cell failed
    assert capsys.readouterr().out == rendered(example(), name)
    assert main(["show", str(tmp_path), "--stored", "--detector", "rf", f"--{name}"]) == 1
    assert name in ("csv", "json") or "by group and" not in capsys.readouterr().out


def test_sentences_on_the_terminal_are_wrapped_without_spaces_at_their_ends(capsys):
    sentence = "A mean over fewer cells than the split has there is marked."
    for width in (20, 40):
        print_prose(sentence, Console(width=width))
        lines = capsys.readouterr().out.splitlines()
        assert " ".join(lines) == sentence
        assert all(len(line) <= width and line == line.rstrip() for line in lines)


def test_a_format_is_one_function(monkeypatch):
    from oodd_eval.results.render import renders

    monkeypatch.setattr("oodd_eval.results.render.FORMATS", dict(FORMATS))
    added = renders("titles", "titles")(lambda r: ",".join(t.title for t in r.sections[0].tables))
    assert added(Report(example())).startswith("Matched AUC and guaranteed alarms at 5 %")


@given(st.text(max_size=60))
def test_no_text_breaks_a_markdown_table(text):
    record = make_record(status="error", reason=text)
    (section,) = [s for s in rendered([record]).split("### ") if s.startswith("Failures")]
    rows = [line for line in section.splitlines() if line.startswith("|")]
    assert len(rows) == 3
    unescaped = rows[2].replace("\\\\", "").replace("\\|", "")
    assert unescaped.count("|") == 5
    assert "<" not in unescaped.replace("\\<", "")


def test_many_findings_are_folded_and_few_are_not():
    net = make_record("net", values={"auc": [0.4, 0.4], "auc_matched": [0.4, 0.4]})
    simple = ("random", "range", "mahalanobis", "manifold", "rf", "rf-ewma", "persistence")
    better = {"auc": [0.6, 0.6], "auc_matched": [0.6, 0.6]}
    records = [net, *(make_record(name, values=better) for name in simple)]
    assert "<details><summary><b>" in rendered(records)
    few = rendered([net, records[1]])
    assert "<details>" not in few
    assert few.count("**random has a higher mean ") == 2


# Tables


def test_the_headline_has_five_columns_in_the_order_of_all_tables():
    records = [
        make_record(d, e, a, values=ALARMS | {"auc_matched": [v, v]})
        for d, v in (("rf", 0.6), ("pe", 0.9))
        for e, a in (("ant", "iid"), ("hopper", "drift"))
    ]
    table = Tables(Board(records)).headline()
    assert table.header == [
        "detector", "matched AUC", "worst environment", "found within 20", "missed",
        "false episodes",
    ]  # fmt: skip
    assert [row[0] for row in table.rows] == ["pe", "rf"]
    assert table.rows[0][1:5] == ["90.0 [90.0, 90.0]", "ant 90.0", "50.0", "50.0"]
    assert table.rows[0][5] == "50.0 [6.8, 93.2]"
    assert max(map(len, printed_table(table, 100))) <= 100
    # With one environment there is a column an anomaly.
    one = [make_record("rf", "ant", a, values={"auc_matched": [0.6] * 2}) for a in ("iid", "drift")]
    assert Tables(Board(one)).headline().header == ["detector", "matched AUC", "iid", "drift"]
    titles = {t.title: [r[0] for r in t.rows if r[0] in ("riqn", "persistence", "clock", "rf")]
              for t in Report(example(), detail="full").sections[0].tables}  # fmt: skip
    orders = {tuple(order) for title, order in titles.items() if len(order) == 4}
    assert orders == {("riqn", "persistence", "clock", "rf")}


def test_the_delay_of_fewer_than_ten_finds_has_no_interval():
    for finds, expected in ((9, False), (10, True)):
        delays = [float(i) if i < finds else None for i in range(12)]
        board = Board([make_record(values={"delay_at_5pct": delays})])
        over = board.entries[0], ["hopper"], ["iid"]
        value = board.mean(*over, "delay_at_5pct", intervals=True)
        assert value.value == pytest.approx((finds - 1) / 2)
        assert math.isfinite(value.low) == expected


def test_separability_is_by_mean_matched_auc_with_failures_last():
    table = Tables(Board(example())).separability()
    assert [row[0] for row in table.rows] == ["riqn", "persistence", "clock", "rf"]
    # riqn: iid 0.7; gravity (0.6 + 0.7) / 2 = 0.65; mean 0.675.
    assert cells(table, 0) == {
        "detector": "riqn", "mean": "67.5", "sensor": "70.0", "dynamics": "65.0", "ant": "67.5",
        "hopper": "67.5",
    }  # fmt: skip
    # One environment failed: no mean over the other pretends to be one over all.
    assert (cells(table, 3)["mean"], cells(table, 3)["hopper"]) == ("timeout", "72.5")


def test_table_five_has_the_papers_layout_and_averages_without_trivial_rows():
    sensor, dynamics = Tables(Board(example())).anomaly_groups()
    assert sensor.header == ["Environment", "Result", "riqn", "persistence", "clock", "rf", "AVG"]
    assert [row[:2] for row in sensor.rows] == [
        [e, m] for e in ("Ant", "Hopper") for m in ("AUC", "Delay", "FAR")
    ]
    # Hopper, sensor, AUC: riqn 90, rf 80; persistence and clock do not count.
    assert cells(sensor, 3)["AVG"] == "85.0"
    assert (cells(sensor, 0)["rf"], cells(sensor, 0)["AVG"]) == ("timeout", "90.0*")
    assert "persistence, clock" in sensor.note
    # Over trajectories with an alarm.
    assert cells(dynamics, 4)["riqn"] == "4.0"
    for detectors in (("riqn", "rf"), ("clock",)):
        board = Board([r for r in example() if r.detector in detectors])
        assert not Tables(board).anomaly_groups()[0].note


def test_no_table_mixes_digests_protocols_or_limits():
    records = [make_record(), make_record(digest="cd" * 32), make_record(limit=3)]
    assert [len(b.records) for b in boards(records)] == [1, 1, 1]
    assert len(Report(records).sections) == 3


# Means


def test_means_over_seeds_over_fewer_cells_and_with_intervals():
    board = Board([
        make_record(seed=0, values={"auc_matched": [0.4, 0.4]}),
        make_record(seed=1, values={"auc_matched": [0.8, 0.8]}),
        make_record("rf"), make_record("rf", anomaly="drift"),
    ])  # fmt: skip
    texts = {row[0]: row[1] for row in Tables(board).separability().rows}
    assert texts == {"riqn": "60.0*", "rf": "50.0"}  # one of two cells is marked
    # Trajectories agree within each seed, and seeds are fixed.
    value = board.mean(board.entries[0], ["hopper"], ["iid"], "auc_matched", intervals=True)
    assert (value.low, value.high) == pytest.approx((0.6, 0.6))
    assert board.seed_means(board.entries[0], "auc_matched") == [0.4, 0.8]
    (seeds,) = Tables(board).seeds().rows
    assert seeds == ["riqn", "2", "40.0", "80.0"]
    records = [
        make_record(anomaly=a, values={"auc_matched": v})
        for a, v in (("iid", [0.1, 0.9]), ("drift", [0.2, 0.6]))
    ]
    board = Board(records)
    over = ["hopper"], ["iid", "drift"]
    value = board.mean(board.entries[0], *over, "auc_matched", intervals=True)
    drawn = [drawn_cell("hopper", 0, contribution(r, "auc_matched")) for r in records]
    assert (value.low, value.high) == pytest.approx(bounds(sample_cells(drawn), 0.45, [2]))
    assert value.value == pytest.approx((0.5 + 0.4) / 2)


# Findings and notes


@pytest.mark.parametrize("simple", ["range", "mahalanobis", "rf-ewma", "comb", "clock"])
def test_every_simple_row_that_wins_is_named_for_both_metrics(simple):
    assert tables.findings(Board(example())) == [
        "rf has a higher mean matched AUC than riqn (67.5 against 72.5)."
    ]
    rows = [make_record(), make_record(simple, values={"auc": [0.6] * 2, "auc_matched": [0.7] * 2})]
    first, *second = tables.findings(Board(rows))
    assert first == f"{simple} has a higher mean matched AUC than riqn (50.0 against 70.0)."
    # The AUC of what knows the time is no finding.
    assert bool(second) == (simple not in ("comb", "clock"))


def test_notes_name_the_split_and_what_is_missing():
    records = [make_record(limit=3), make_record(anomaly="drift", limit=3)]
    records[1].provenance["git_dirty"] = True
    notes = " ".join(tables.notes(Board(records)))
    facts = "digest abababababab", "first 3 trajectories", "calibration, shutdown", ": 1 cell."
    assert all(fact in notes for fact in facts)
    assert "uncommitted" not in " ".join(tables.notes(Board(records[:1])))


ALARMS = {
    "false_episodes_at_5pct": [0, 1], "early_at_5pct": [0, 0], "delay_at_5pct": [4, None],
    "delay_censored_at_5pct": [4, 36],
    "missed_at_5pct": [0, 1], "found_within_20_at_5pct": [1, 0],
    "found_within_100_at_5pct": [1, 0], "found_within_100_null_at_5pct": [0, 1],
}  # fmt: skip


def test_guaranteed_alarms_stand_beside_their_nulls():
    board = Board([make_record(anomaly=a, values=ALARMS) for a in ("iid", "drift")])
    (table,) = Tables(board).all_alarms()
    assert cells(table, 0) == {
        "detector": "riqn", "false episodes": "50.0 [1.3, 98.7]", "early": "0.0",
        "delay censored": "20.0", "delay if found": "4.0", "missed": "50.0",
        "found within 20": "50.0", "found within 100": "50.0", "found within 100 null": "50.0",
    }  # fmt: skip
    assert "whole remainder" in table.note
    assert table.header[-2:] == ["found within 100", "found within 100 null"]


def test_alarms_are_of_the_strictest_level_where_5_percent_is_not_offered():
    assert Tables(Board([make_record()])).all_alarms() == []
    few = {"false_episodes_at_10pct": [0, 0], "missed_at_10pct": [0, 1]}
    assert "at 10 %" in Tables(Board([make_record(values=few)])).headline().title
    both = few | {"missed_at_1pct": [1, 1], "false_episodes_at_1pct": [0, 0]}
    assert "at 1 %" in Tables(Board([make_record(values=both)])).headline().title
    assert len(Tables(Board([make_record(values=both | ALARMS)])).all_alarms()) == 3


def test_brief_cells_are_marked_and_named():
    records = [make_record(anomaly="iid", brief=True), make_record(anomaly="drift")]
    board = Board(records)
    (row,) = Tables(board).by_anomaly(board.entries[0]).rows
    assert row == ["Hopper", "50.0\N{DAGGER}", "50.0"]
    (note,) = [line for line in tables.notes(board) if "Brief" in line]
    assert "hopper/iid" in note


# The verdict


def rows(metric="auc_matched", environment="cartpole", **values):
    """One record a detector, `values` being those of twelve episodes."""
    return [make_record(d, environment, values={metric: v}) for d, v in values.items()]


def own(detector, environment="cartpole", **fields):
    """One record of a row that oodd-eval does not ship."""
    return replace(make_record(detector, environment, **fields), plugin="somebody:theirs")


BASE = [0.5 + i / 100 for i in range(12)]  # of twelve episodes
RAISED = [v + 0.1 for v in BASE]  # all differ by a tenth, so that every resample does


def test_the_verdict_says_where_the_first_row_that_was_named_stands():
    records = rows(mewma=BASE, rf=RAISED, clock=[0.5] * 12)
    behind = "mewma is second of three, 10.0 points [10.0, 10.0] behind rf in matched AUC."
    (section,) = Report(records).sections
    assert section.verdict == behind
    assert str(Report(records)).splitlines()[0] == behind
    ahead = "rf is first of three, 10.0 points [10.0, 10.0] ahead of mewma in matched AUC."
    assert verdict_of(Board([records[1], records[0], records[2]])) == ahead
    last = verdict_of(Board(records[::-1]))
    assert last.startswith("clock is third of three, 5.5 points [")
    assert last.endswith("] behind mewma in matched AUC.")
    many = [make_record(f"row{i:02}", values={"auc_matched": [i / 20] * 12}) for i in range(13)]
    assert verdict_of(Board(many)).startswith("row00 is number 13 of 13, 5.0 points [")


@pytest.mark.parametrize("plugin", ["mine:mine", "local:", "oodd-eval:adapters"])
def test_the_verdict_is_about_the_row_that_is_not_shipped(plugin):
    """One of another distribution, a class of a script, or what an adapter makes."""
    name = "sklearn:Ridge" if plugin.startswith("oodd-eval") else "jumps"
    theirs = replace(rows(**{name: [0.55] * 12})[0], plugin=plugin)
    records = [*rows(mewma=BASE, rf=RAISED), theirs]
    assert verdict_of(Board(records)).startswith(f"{name} is third of three")
    # Of several the best.
    other = replace(rows(other=[0.9] * 12)[0], plugin="mine:mine")
    assert verdict_of(Board([*records, other])).startswith("other is first of four")


def test_the_verdict_has_the_numbers_of_the_comparison():
    values = {"mewma": [0.5, 0.6, 0.7] * 4, "rf": [0.75, 0.7, 0.7, 0.8] * 3}
    compared = compare_rows(records := rows(**values), "mewma", "rf")
    assert compared.difference < 0
    ends = f"{-100 * compared.high:.1f}, {-100 * compared.low:.1f}"
    amount = f"{-100 * compared.difference:.1f} points [{ends}]"
    assert amount == compared.amount
    assert verdict_of(Board(records)) == (
        f"mewma is second of two, {amount} behind rf in matched AUC."
    )
    assert compared.verdict == f"rf beats mewma by {amount} in matched AUC on CartPole."
    for first, second in (("rf", "mewma"), ("mewma", "rf")):
        assert compare_rows(records, first, second).verdict == compared.verdict
    # Where lower is better, the row with the smaller mean is.
    steps = {d: [10 * v for v in of_row] for d, of_row in values.items()}
    sooner = compare_rows(rows("delay_censored_at_5pct", **steps), *steps, "delay_censored_at_5pct")
    assert sooner.verdict.startswith("mewma beats rf by 1.4 steps [0.")
    assert sooner.verdict.endswith("] in delay censored at 5 % on CartPole.")
    both = [*rows(mewma=BASE, rf=RAISED), *rows(environment="ant", mewma=BASE, rf=RAISED)]
    assert compare_rows(both, "rf", "mewma").verdict.endswith(
        "] in matched AUC on CartPole and Ant."
    )


def test_no_difference_is_shown_where_the_interval_includes_zero():
    # Half of the episodes are a tenth better, the others a tenth worse: the mean difference is 0.
    records = rows(mewma=[0.6, 0.7] * 6, rf=[0.7, 0.6] * 6)
    compared = compare_rows(records, "rf", "mewma")
    assert compared.low < 0 < compared.high
    ends = f"[-{100 * compared.high:.1f}, {100 * compared.high:.1f}]"
    assert verdict_of(Board(records)).startswith(
        f"mewma is first of two and cannot be told from rf: 0.0 points {ends}"
    )
    assert compared.verdict.startswith("No difference is shown between rf and mewma in matched")
    assert compared.verdict.endswith(f": 0.0 points {ends}, p = 1.")
    assert str(compared).count("p = ") == 1
    # Four test seeds are too few for any verdict: the interval has no ends.
    few = compare_rows(rows(mewma=[0.5] * 4, rf=[0.7] * 4), "rf", "mewma")
    assert few.verdict.startswith("No difference is shown between rf and mewma")
    assert "20.0 points (no interval: too few test episodes), p = 0.12." in few.verdict


@given(
    st.floats(-0.01, 0.01), st.floats(0, 0.02), st.floats(0, 0.02), st.sampled_from(["auc", "far"])
)
def test_an_interval_and_its_verdict_never_contradict_each_other(middle, below, above, metric):
    """As printed, the interval leaves out 0 just where the rows are told apart."""
    low, high = middle - below, middle + above
    text = with_interval(middle, low, high, metric)
    ends = [float(end) for end in re.search(r"\[(.*), (.*)\]", text).groups()]
    told = low > 0 or high < 0
    least = min(abs(low), abs(high)) * (100 if metric == "auc" else 1)
    if told and least >= 0.00005:
        assert ends[0] > 0 or ends[1] < 0
    if not told:
        assert ends[0] <= 0 <= ends[1]


def test_the_verdict_on_one_row_is_its_headline_in_words():
    values = {"auc_matched": [0.8, 0.9], "missed_at_5pct": [0, 1]}
    board = Board([make_record(values=values | {"false_episodes_at_5pct": [0, 0]})])
    assert verdict_of(board) == (
        "riqn on Hopper: matched AUC 85.0 %, missed 50.0 %, false episodes 0.0 %."
    )
    assert verdict_of(Board([make_record(status="oom")])) == ""


def test_rows_that_failed_or_know_more_than_nominal_episodes_are_no_rivals():
    values = {"mewma": [0.5] * 12, "rf": [0.6] * 12}
    oracle = make_record(
        "oracle", "cartpole", values={"auc_matched": [0.9] * 12}, training="oracle"
    )
    failed = make_record("pe", "cartpole", status="timeout")
    text = verdict_of(Board([*rows(**values), oracle, failed]))
    assert text.startswith("mewma is second of three ranked rows, 10.0 points")
    assert text.endswith("behind rf in matched AUC.")
    # A row that failed has no place.
    theirs = own("jumps", status="error", reason="no mood")
    text = verdict_of(Board([*rows(**values), theirs, own("jumps", anomaly="drift")]))
    assert text == "jumps has no place: error."
    assert verdict_of(Board([*rows(**values), theirs])) == "jumps has no place: error."
    assert verdict_of(Board([failed, *rows(**values)])) == "pe has no place: timeout."
    assert verdict_of(Board([failed, theirs])) == "jumps has no place: error."
    alone = verdict_of(Board([rows(**values)[0], failed]))
    assert alone == "mewma is first of two: pe has no figure beside it."
    # One that lacks a cell is compared over what both have, and said to be.
    more = [*rows(**values), *(r for d in values for r in [make_record(d, "ant", values=FLAT)])]
    text = verdict_of(Board([*more, own("jumps", values={"auc_matched": [0.9] * 12})]))
    assert text.startswith("jumps is third of three, 40.0 points [")
    assert text.endswith("] ahead of mewma in matched AUC, over the 1 cell that both have.")


def test_a_row_of_which_every_cell_failed_costs_no_report():
    failed = own("jumps", status="timeout", reason="not done")
    (section,) = Report([failed, *rows(mewma=BASE, rf=RAISED)]).sections
    assert section.verdict == "jumps has no place: timeout."
    both = [*rows(mewma=BASE), make_record("pe", "cartpole", status="oom")]
    assert verdict_of(Board(both)) == "mewma is first of two: pe has no figure beside it."
    assert verdict_of(Board(both[::-1])) == "pe has no place: oom."
    none = [replace(r, status="oom", metrics={}, per_trajectory={}) for r in both]
    assert verdict_of(Board(none)) == "mewma has no place: oom."


@pytest.mark.parametrize("training", ["simulation", "anomalies", "external", "oracle"])
def test_an_own_row_that_knows_more_is_said_not_to_be_ranked(training):
    theirs = replace(own("jumps", values={"auc_matched": RAISED}), training=training)
    text = verdict_of(Board([*rows(mewma=BASE), theirs]))
    assert text.startswith("jumps, not ranked for what it knows, would be first of two, 10.0 poin")


def test_a_difference_over_other_cells_than_the_tables_is_said_to_be():
    """Cells without a figure, and cells that the table leaves out."""
    undefined = {"auc_matched": [None] * 12}
    values = {"mewma": BASE, "rf": RAISED}
    ants = [
        make_record("mewma", "ant", values=undefined),
        make_record("rf", "ant", values={"auc_matched": [0.9] * 12}),
    ]
    text = verdict_of(Board([*rows(**values), *ants]))
    assert text.endswith("behind rf in matched AUC, over the 1 cell that both have.")
    # Two of five rows have a cell more, which then is not expected of any.
    more = rows(environment="ant", mewma=RAISED, rf=BASE)
    others = rows(a=[0.1] * 12, b=[0.1] * 12, c=[0.1] * 12)
    board = Board([*rows(**values), *more, *others])
    assert verdict_of(board).endswith(", over the 2 cells that both have.")
    assert verdict_of(Board(rows(**values))).endswith("behind rf in matched AUC.")


def test_rows_that_learn_from_failures_are_a_band_of_their_own():
    """They stand below the others, however good, and verdicts compare rows of one band."""
    ranked = rows(mewma=BASE, rf=RAISED)
    taught = rows(a=[v + 0.3 for v in BASE], b=[v + 0.4 for v in BASE])
    taught = [replace(r, training="failures") for r in taught]
    for mine, text in (
        (ranked[0], "mewma is second of two ranked rows, 10.0 points [10.0, 10.0] behind rf in"),
        (ranked[1], "rf is first of two ranked rows, 10.0 points [10.0, 10.0] ahead of mewma in"),
        (taught[0], "a is second of two rows that learn from failures, 10.0 points [10.0, 10.0]"),
    ):
        records = [mine, *(r for r in [*taught, *ranked] if r is not mine)]
        (section,) = Report(records).sections
        assert section.verdict.startswith(text)
        for table in (t for t in section.tables if t.header[0] == "detector"):
            names = [row[0].split()[0] for row in table.rows]
            assert names == ["rf", "mewma", "b", "a"], table.title
        by_anomaly = [t.title.partition(":")[0] for t in section.tables if "by anomaly" in t.title]
        assert by_anomaly in ([], ["rf", "mewma", "b", "a"])


def test_equal_rows_are_not_told_apart_and_none_is_behind():
    text = verdict_of(Board(rows(rf=BASE, mewma=BASE)))
    assert text.startswith("rf is second of two and cannot be told from mewma: 0.0 points [0.0, 0.")
    for metric in ("auc_matched", "delay_censored_at_5pct"):
        assert compare_rows(
            rows(metric, rf=BASE, mewma=BASE), "rf", "mewma", metric
        ).first_is_better


def test_an_interval_has_digits_until_both_of_its_ends_are_told_from_zero():
    assert with_interval(0.002, 0.0004, 0.0036, "auc") == "0.20 points [0.04, 0.36]"
    assert with_interval(-0.002, -0.0036, -0.0004, "auc") == "-0.20 points [-0.36, -0.04]"
    assert with_interval(0.001, -0.0004, 0.0036, "auc") == "0.1 points [0.0, 0.4]"


def test_the_worst_place_is_the_one_with_the_lowest_mean():
    means = {"ant": 0.7, "hopper": 0.9, "cartpole": 0.6}
    records = [make_record("rf", e, values={"auc_matched": [v] * 2}) for e, v in means.items()]
    records += [make_record("pe", e, values={"auc_matched": [1 - v] * 2}) for e, v in means.items()]
    front = Tables(Board(records)).headline()
    column = front.header.index("worst environment")
    assert [row[column] for row in front.rows] == ["cartpole 60.0", "hopper 10.0"]
    for environments in (["ant", "hopper"], ["ant"]):
        of_some = Tables(Board([r for r in records if r.environment in environments])).headline()
        assert ("worst environment" in of_some.header) == (len(environments) > 1)


FLAT = {"auc_matched": [0.5] * 12}


# Figures that are undefined


def calibrated(detector, episodes, alarm="cusum", level="5", environment="hopper", **more):
    values = {f"{name}_at_{level}pct": v for name, v in (("missed", [0, 1]), ("early", [0, 0]))}
    values |= {f"false_episodes_at_{level}pct": [0, 0], **more}
    record = make_record(detector, environment, values=values, alarm=alarm)
    return replace(record, counts={"test": 2, "calibration": episodes})


def test_a_level_that_calibration_episodes_are_too_few_for_is_named():
    # A CUSUM standardizes with half of them: 2 x 19 are needed at 5 %, 2 x 9 at 10 %.
    few, strict = calibrated("rf", 30, level="10"), calibrated("pe", 40)
    assert "at most 10 % (30 calibration episodes; 38 " in Tables(Board([few])).headline().note
    mixed = Board([few, calibrated("pe", 30, "score")])
    table = Tables(mixed).headline()
    assert "at 5 %" in table.title
    assert [cells(table, 1)[name] for name in ("missed", "false episodes")] == ["\N{EN DASH}"] * 2
    assert "\N{EN DASH}: 30 calibration episodes; 38 needed" in table.note
    assert "Undefined for rf: false episodes, early, missed (30" in (
        Tables(mixed).all_alarms()[-1].note
    )
    (section,) = Report([few], level="at_10pct").sections
    chosen = next(t for t in section.tables if "Guaranteed" in t.title)
    assert ("at 10 %" in chosen.title, "calibration" in chosen.note) == (True, False)
    (section,) = Report([strict], level="at_1pct", detail="brief").sections
    assert not [t for t in section.tables if "Guaranteed" in t.title]
    assert "pe: guaranteed alarms at 1 % (40" in section.tables[0].note
    (section,) = Report([strict], level="at_1pct").sections
    assert any("pe: guaranteed alarms at 1 % (40" in text for text in section.findings)
    # Without any level there is no table, and the report says why.
    none = replace(calibrated("rf", 17), metrics={}, per_trajectory={})
    assert Tables(Board([none])).all_alarms() == []
    assert "(17 calibration episodes" in " ".join(findings_of(Board([none])))


@pytest.mark.parametrize(
    ("episodes", "alarm", "needed"),
    [(37, "cusum", 38), (38, "cusum", 0), (18, "score", 19), (19, "score", 0)],
)
def test_the_number_of_calibration_episodes_is_a_reason_where_it_is_one(episodes, alarm, needed):
    record = calibrated("pe", episodes, alarm)
    note = Tables(Board([record])).headline().note
    if not needed:
        assert "calibration" not in note
        return
    text = why_undefined(replace(record, metrics={}, per_trajectory={}), "missed_at_5pct")
    assert text.startswith(f"{episodes} calibration episodes; {needed} needed at 5 %")


def test_the_reason_of_a_dash_stands_below_its_table():
    records = [calibrated("pe", 40, delay=[None, None]), calibrated("rf", 40)]
    notes = [t.note for t in Report(records).sections[0].tables]
    assert any("pe: delay (no episode has an alarm" in note for note in notes)
    assert "pe, rf" not in " ".join(notes)


NOTHING, RISING = np.full(60, np.nan), np.linspace(0, 1, 60)


@pytest.mark.parametrize(
    ("anomalous", "twin", "effect"),
    [
        (NOTHING, NOTHING, 30),
        (RISING, RISING, 30),
        (RISING * 0, RISING * 0, 30),  # no alarm
        (RISING + 9, RISING + 9, 30),  # an alarm before the effect
        (RISING, RISING[:20], 30),  # the twin ends before the effect
        (RISING, RISING, 0),
    ],
)
def test_all_that_a_cell_leaves_undefined_has_its_reason(anomalous, twin, effect):
    rules = Rules.fit([RISING] * 40)
    cell = PairedScores([anomalous], [twin], [effect], [effect])
    metrics, _ = cell_metrics(cell, rules, environment="arm")
    record = replace(make_record(), metrics=metrics)
    undefined = [name for name in metrics if np.isnan(metrics[name].value)]
    assert undefined
    assert all(why_undefined(record, name) for name in undefined)
    assert not any(why_undefined(record, name) for name in metrics.keys() - {*undefined})


# The terminal


def console(*, width=80, terminal=False):
    return Console(
        file=io.StringIO(), width=width, force_terminal=terminal, soft_wrap=True, highlight=False,
        markup=False, _environ={},
    )  # fmt: skip


def reporter(**settings):
    return TerminalReporter(console(**settings))


def printed(one):
    return one.console.file.getvalue()


def printed_table(table, width, **settings):
    screen = console(width=width, **settings)
    print_table(table, screen)
    return screen.file.getvalue().splitlines()


def test_piped_output_has_no_escapes_and_fits_80_columns(tmp_path):
    one = reporter()
    print_report(Report(example(), detail="brief"), one.console, tmp_path)
    one.failures(example())
    text = printed(one)
    assert "\x1b" not in text
    lines = [line for line in text.splitlines() if not line.startswith("everything else: ")]
    assert max(map(len, lines)) <= 80
    assert "TIMEOUT ant/rf[h=1,seed=0]: not done after 5 s (--timeout)" in text
    order = [text.index(t) for t in ("riqn is first of", "Matched AUC and guaranteed alarms")]
    assert order == sorted(order)
    assert not text[: order[0]].strip()
    assert PAPER not in text
    one = reporter()
    print_report(Report(example(), detail="brief", paper=True), one.console, tmp_path)
    assert PAPER in printed(one)
    screen = reporter(terminal=True)
    screen.failures(example())
    assert "\x1b[31m" in printed(screen)


WIDE = [f"column {i}" for i in range(8)]


def test_a_heading_is_divided_before_its_number():
    names = [f"loss{n}" for n in (1, 5, 10, 25, 100)]
    printed = printed_table(Table("", ["detector", *names], [["mewma", *["1.0"] * 5]]), 44)
    assert [line.split() for line in printed[1:3]] == [["detector", *names[:4], "loss"], ["100"]]


@pytest.mark.parametrize("rows", [1, 9])
def test_a_table_that_is_too_wide_comes_in_parts_with_its_labels(rows):
    texts = [[f"row {i}", *map(str, range(123456, 123463))] for i in range(rows)]
    lines = printed_table(Table("t", WIDE, texts), 40)
    assert max(map(len, lines)) <= 40
    rules = [line.split() for line in lines if line.startswith("---")]
    assert len(rules) > 1
    assert sum(len(rule) - 1 for rule in rules) == len(WIDE) - 1
    for i in range(rows):
        assert sum(line.startswith(f"row {i}") for line in lines) == len(rules)


def five_columns(kinds=("iid",), environments=("ant", "lunarlander"), names=("persistence", "rf")):
    """Rows with all five columns, whose intervals are wide."""
    values = ALARMS | {"auc_matched": [0.123, 0.987], "missed_at_5pct": [0, 0]}
    return [make_record(d, e, a, values=values) for d in names for e in environments for a in kinds]


EIGHT = [*TABLE1]


@pytest.mark.parametrize(
    ("records", "width", "columns", "intervals"),
    [
        (five_columns(), 120, ["worst environment"], 2),
        (five_columns(names=["mewma", "rf"]), 80, ["worst environment"], 2),
        (five_columns(), 80, ["worst environment"], 2),
        (five_columns(), 60, ["worst environment"], 0),
        (five_columns(EIGHT, ["hopper"], ["mewma"]), 150, EIGHT, 2),
        (five_columns(EIGHT, ["hopper"], ["mewma"]), 120, EIGHT, 2),
        (five_columns(EIGHT, ["hopper"], ["mewma"]), 80, ["worst anomaly"], 2),
        (five_columns(["iid", "drift"], ["hopper"]), 80, ["iid", "drift"], 2),
        (five_columns(["iid"], ["hopper"]), 80, [], 2),
        (
            five_columns(["iid", "drift", "gravity"], ["hopper"], ["rf"]),
            80,
            ["iid", "drift", "gravity"],
            2,
        ),
    ],
)
def test_the_headline_is_one_table_whose_rows_are_detectors(records, width, columns, intervals):
    """Headings are of several lines where they must be, and intervals are the last to go."""
    table = Tables(Board(records)).headline()
    title, *lines = printed_table(replace(table, note=""), width)
    assert title == table.title
    assert max(map(len, lines)) <= width
    rule = next(i for i, line in enumerate(lines) if line.startswith("---"))
    ends = itertools.accumulate(len(dashes) + 2 for dashes in lines[rule].split("  "))
    starts = [0, *ends]
    headings = [
        "".join(line[i:j].strip() + "/" for line in lines[:rule]).rstrip("/")
        for i, j in itertools.pairwise(starts)
    ]
    flat = [re.sub("-/+", "", h).replace("/", " ").replace("- ", "") for h in headings]
    expected = ["detector", "matched AUC", *columns, "found within 20", "missed", "false episodes"]
    assert [re.sub("[^a-zA-Z0-9]", "", h) for h in flat] == [
        re.sub("[^a-zA-Z0-9]", "", h) for h in expected
    ]
    rows = [line for line in lines[rule + 1 :] if line]
    assert [row.split()[0] for row in rows] == [str(s) for s in Board(records).entries]
    assert all(row.count("[") == intervals for row in rows)


def test_intervals_that_are_asked_for_are_all_shown():
    table = Tables(Board(five_columns()), intervals=True).headline()
    lines = printed_table(table, 80)
    assert max(map(len, lines)) <= 80
    assert sum(line.count("[") for line in lines) == sum("[" in t for r in table.rows for t in r)


def test_a_run_ends_with_one_table_and_at_most_three_notes():
    several = [
        *example(),
        make_record("oracle", "ant", limit=None, training="oracle"),
        make_record("pe", "cartpole", values={"delay_at_5pct": [None, None]}),
    ]
    for records in (example(), several, [replace(r, limit=3) for r in several], five_columns()):
        (section,) = Report(records, detail="brief").sections
        assert len(section.tables) == 1
        assert not section.findings
        assert not section.notes
        assert 1 <= len(section.tables[0].note.splitlines()) <= 3
    (section,) = Report([replace(r, limit=3) for r in several], detail="brief").sections
    notes = section.tables[0].note.splitlines()
    assert "first 3 trajectories" in notes[0]
    assert "*: " in notes[1]
    assert "oracle" in notes[1]
    # All of it is in the report of the run.
    text = rendered(several)
    assert "has a higher mean" in text
    assert "Undefined for" in text
    assert "FAR" in text
    # Sections of several splits say which they are of.
    shown = console()
    print_sections(Report([*example(), make_record(digest="cd" * 32)]).sections, shown)
    assert shown.file.getvalue().count("Split mini\n") == 2


def test_names_of_others_are_not_taken_for_markup():
    one = reporter()
    one.failures([make_record("[red]x", status="error", reason="[/b] oops")])
    assert "[red]x" in printed(one)
    assert "[/b] oops" in printed(one)
