"""Reports: golden Markdown, tables worked by hand, terminal output of 80 columns."""

import io
import os
from pathlib import Path

import pytest
from helpers_records import example, make_record
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from oodd_eval.cli.terminal import TerminalReporter, summary
from oodd_eval.metrics.bootstrap import bounds, drawn_cell, sample_cells
from oodd_eval.results.tables import layout
from oodd_eval.results.tables.board import Board, boards, contribution
from oodd_eval.results.tables.layout import Table
from oodd_eval.results.tables.rendering import report

GOLDEN = Path(__file__).parent / "golden"


@pytest.mark.parametrize(
    ("name", "records", "intervals"),
    [
        ("report", example(), False),
        ("report-intervals", [r for r in example() if r.detector in ("riqn", "clock")], True),
        ("report-nothing-ok", [make_record(status="error", reason="x | <b>y</b>")], False),
    ],
)
def test_markdown_is_the_golden_file(name, records, intervals):
    text = report(records, intervals=intervals)
    file = GOLDEN / f"{name}.md"
    if "OODD_EVAL_WRITE_GOLDEN" in os.environ:
        file.write_text(text, encoding="utf-8")
    assert text == file.read_text(encoding="utf-8")


def test_no_records_are_said_so():
    assert "No records" in report([])


def cells(table, row):
    return dict(zip(table.header, table.rows[row], strict=True))


def test_ranking_is_by_mean_matched_auc_with_failures_last():
    ranked = layout.separability(Board(example()))
    assert [row[0] for row in ranked.rows] == ["riqn", "persistence", "clock", "rf"]
    # riqn: iid 0.7; gravity (0.6 + 0.7) / 2 = 0.65; mean 0.675.
    assert cells(ranked, 0) == {
        "detector": "riqn", "mean": "67.5", "sensor": "70.0", "dynamics": "65.0",
        "smoothed": "50.0", "unpaired": "50.0", "ant": "67.5", "hopper": "67.5",
    }  # fmt: skip
    # One environment failed: no mean over the other pretends to be one over all.
    assert cells(ranked, 3)["mean"] == "timeout"
    assert cells(ranked, 3)["hopper"] == "72.5"


def test_table_five_has_the_papers_layout():
    table = layout.anomaly_groups(Board(example()), 1)
    detectors = ["riqn", "rf", "persistence", "clock", "AVG"]
    assert table.header == [
        "Environment", "Result",
        *(f"sensor: {d}" for d in detectors), *(f"dynamics: {d}" for d in detectors),
    ]  # fmt: skip
    assert [row[:2] for row in table.rows] == [
        ["Ant", "AUC"], ["Ant", "Delay"], ["Ant", "FAR"],
        ["Hopper", "AUC"], ["Hopper", "Delay"], ["Hopper", "FAR"],
    ]  # fmt: skip


def test_average_is_over_detectors_without_trivial_rows():
    row = cells(layout.anomaly_groups(Board(example()), 1), 3)
    # Hopper, sensor, AUC: riqn 90, rf 80; persistence and clock do not count.
    assert row["sensor: AVG"] == "85.0"
    row = cells(layout.anomaly_groups(Board(example()), 1), 0)
    assert row["sensor: rf"] == "timeout"
    assert row["sensor: AVG"] == "90.0*"


def test_a_table_says_which_rows_its_average_leaves_out():
    board = Board(example())
    note = layout.anomaly_groups(board, 1).note
    assert note == "AVG is the mean without the trivial rows: persistence, clock."
    only = Board([r for r in example() if r.detector in ("riqn", "rf")])
    assert not layout.anomaly_groups(only, 1).note
    trivial = Board([r for r in example() if r.detector == "clock"])
    assert not layout.anomaly_groups(trivial, 1).note
    one = reporter()
    one.tables(example())
    assert printed(one).count(note) == 2
    assert report(example()).count(note) == 1


def test_delay_is_over_trajectories_with_an_alarm():
    assert cells(layout.anomaly_groups(Board(example()), 1), 4)["dynamics: riqn"] == "4.0"


def test_undefined_is_a_dash_and_not_run_is_empty():
    values = {"delay": [None, None]}
    board = Board([
        make_record("riqn", values=values),
        make_record("rf", anomaly="gravity"),
    ])  # fmt: skip
    row = cells(layout.anomaly_groups(board, 1), 1)
    assert row["sensor: riqn"] == "\N{EN DASH}"
    assert row["sensor: rf"] == ""


def test_a_mean_over_fewer_cells_is_marked():
    board = Board([
        make_record("riqn"), make_record("riqn", anomaly="drift"), make_record("rf"),
    ])  # fmt: skip
    assert {row[0]: row[1] for row in layout.separability(board).rows} == {
        "riqn": "50.0",
        "rf": "50.0*",
    }


def test_seeds_are_averaged_into_one_row():
    board = Board([
        make_record(seed=0, values={"auc_matched": [0.4, 0.4]}),
        make_record(seed=1, values={"auc_matched": [0.8, 0.8]}),
    ])  # fmt: skip
    assert [row[:2] for row in layout.separability(board).rows] == [["riqn", "60.0"]]
    # Trajectories agree within each seed, so that the interval is the seeds' alone.
    value = board.mean(board.entries[0], ["hopper"], ["iid"], "auc_matched", intervals=True)
    assert (value.low, value.high) == (0.4, 0.8)


def test_interval_of_one_seed_is_the_bootstrap_over_test_trajectories():
    records = [
        make_record(anomaly=a, values={"auc_matched": v})
        for a, v in (("iid", [0.1, 0.9]), ("drift", [0.2, 0.6]))
    ]
    board = Board(records)
    value = board.mean(board.entries[0], ["hopper"], ["iid", "drift"], "auc_matched",
                       intervals=True)  # fmt: skip
    expected = bounds(
        sample_cells([drawn_cell("hopper", 0, contribution(r, "auc_matched")) for r in records]),
        0.45,
        [2],
    )
    assert (value.low, value.high) == pytest.approx(expected)
    assert value.value == pytest.approx((0.5 + 0.4) / 2)


def test_settings_and_horizons_are_rows_of_their_own():
    board = Board([
        make_record(), make_record(horizon=10), make_record(overrides={"members": 1}),
    ])  # fmt: skip
    assert [str(e) for e in board.entries] == ["riqn", "riqn[h=10]", "riqn[members=1]"]
    assert board.horizons == [1, 10]
    assert layout.anomaly_groups(board, 10).header[2:] == ["riqn", "AVG"]


def test_no_table_mixes_digests_protocols_or_limits():
    records = [make_record(), make_record(digest="cd" * 32), make_record(limit=3)]
    assert [len(b.records) for b in boards(records)] == [1, 1, 1]


def test_a_simple_row_that_wins_is_named():
    assert layout.findings(Board(example())) == [
        "rf beats riqn in mean matched AUC: 72.5 against 67.5 over 2 cells."
    ]


def test_persistence_that_wins_is_named_for_both_metrics():
    board = Board([
        make_record("riqn", values={"auc": [0.5, 0.5], "auc_matched": [0.5, 0.5]}),
        make_record("persistence", values={"auc": [0.6, 0.6], "auc_matched": [0.7, 0.7]}),
    ])  # fmt: skip
    assert layout.findings(board) == [
        "persistence beats riqn in mean matched AUC: 70.0 against 50.0 over 1 cell.",
        "persistence beats riqn in mean AUC: 60.0 against 50.0 over 1 cell.",
    ]


@pytest.mark.parametrize("simple", ["range", "mahalanobis", "rf-ewma", "comb"])
def test_every_simple_row_is_named(simple):
    board = Board([make_record(), make_record(simple, values={"auc_matched": [0.7, 0.7]})])
    assert layout.findings(board) == [
        f"{simple} beats riqn in mean matched AUC: 70.0 against 50.0 over 1 cell."
    ]


@pytest.mark.parametrize("blind", ["clock", "comb"])
def test_the_auc_of_what_knows_the_time_alone_is_no_finding(blind):
    board = Board([
        make_record("riqn", values={"auc": [0.5, 0.5]}),
        make_record(blind, values={"auc": [1.0, 1.0]}),
    ])  # fmt: skip
    assert layout.findings(board) == []


def test_comparison_is_over_common_cells_only():
    board = Board([
        make_record("riqn", values={"auc_matched": [0.6, 0.6]}),
        make_record("riqn", anomaly="drift", values={"auc_matched": [0.1, 0.1]}),
        make_record("persistence", values={"auc_matched": [0.5, 0.5]}),
    ])  # fmt: skip
    assert layout.findings(board) == []


def test_notes_name_split_digest_protocol_and_what_is_missing():
    notes = " ".join(layout.notes(Board([make_record(limit=3)])))
    assert "Split mini, digest abababababab, protocol 1, test seeds per environment: 2." in notes
    assert "first 3 trajectories" in notes
    assert "Means over sensor anomalies are without calibration, drift, shutdown." in notes


def test_a_note_says_how_many_cells_were_made_with_uncommitted_changes():
    clean, dirty = (make_record(anomaly=a) for a in ("iid", "drift"))
    clean.provenance["git_dirty"], dirty.provenance["git_dirty"] = False, True
    notes = layout.notes(Board([clean, dirty]))
    assert "Made with uncommitted changes of oodd-eval's checkout: 1 cells." in notes
    assert not any("uncommitted" in line for line in layout.notes(Board([clean])))


@given(st.text(max_size=60))
def test_no_text_breaks_a_markdown_table(text):
    record = make_record(status="error", reason=text)
    (section,) = [s for s in report([record]).split("### ") if s.startswith("Failures")]
    rows = [line for line in section.splitlines() if line.startswith("|")]
    assert len(rows) == 3
    unescaped = rows[2].replace("\\\\", "").replace("\\|", "")
    assert unescaped.count("|") == 5
    assert "<" not in unescaped.replace("\\<", "")


ALARMS = {
    "false_episodes_at_5pct": [0, 1], "early_at_5pct": [0, 0], "delay_at_5pct": [4, None],
    "missed_at_5pct": [0, 1], "found_within_20_at_5pct": [1, 0],
    "found_within_100_at_5pct": [1, 0], "found_within_100_null_at_5pct": [0, 1],
}  # fmt: skip


def test_guaranteed_alarms_stand_beside_false_episodes_with_their_interval():
    board = Board([make_record(anomaly=a, values=ALARMS) for a in ("iid", "drift")])
    table = layout.guaranteed(board)
    assert "Guaranteed alarms at 5 %" in table.title
    assert "at most 5 % of nominal episodes" in table.note
    assert cells(table, 0) == {
        "detector": "riqn", "delay": "4.0", "missed": "50.0", "found within 20": "50.0",
        "found within 100": "50.0", "found within 100 null": "50.0",
        "false episodes": "50.0 [1.3, 98.7]", "early": "0.0",
    }  # fmt: skip
    nulls = layout.guaranteed(board, nulls=True)
    assert nulls.header[-2:] == ["found within 100", "found within 100 null"]


def test_the_table_of_alarms_is_of_the_strictest_level_where_5_percent_is_not_offered():
    assert layout.guaranteed(Board([make_record()])) is None
    few = {"false_episodes_at_10pct": [0, 0], "missed_at_10pct": [0, 1]}
    assert "at 10 %" in layout.guaranteed(Board([make_record(values=few)])).title
    both = few | {"missed_at_1pct": [1, 1], "false_episodes_at_1pct": [0, 0]}
    assert "at 1 %" in layout.guaranteed(Board([make_record(values=both)])).title
    assert len(layout.all_alarms(Board([make_record(values=both | ALARMS)]))) == 3


def test_separability_and_guaranteed_alarms_come_before_the_papers_layout():
    records = [make_record(values=ALARMS), make_record("rf", values=ALARMS)]
    one = reporter()
    one.tables(records)
    for text in (printed(one), report(records)):
        places = [text.index(t) for t in ("Separability", "Guaranteed alarms", "AUC (%), delay")]
        assert places == sorted(places)


def test_brief_cells_are_marked_and_named():
    records = [make_record(anomaly="iid", brief=True), make_record(anomaly="drift")]
    board = Board(records)
    (row,) = layout.by_anomaly(board, board.entries[0]).rows
    assert row == ["Hopper", "50.0\N{DAGGER}", "50.0"]
    (note,) = [line for line in layout.notes(board) if "Brief" in line]
    assert "hopper/iid. Half" in note
    assert not any("Brief" in line for line in layout.notes(Board(records[1:])))


def test_a_transposed_table_exchanges_rows_and_columns():
    table = Table("t", ["a", "b"], [["1", "2"], ["3", "4"], ["5", "6"]])
    turned = table.transposed()
    assert (turned.header, turned.rows) == (["a", "1", "3", "5"], [["b", "2", "4", "6"]])
    assert turned.transposed() == table


def reporter(*, width=80, terminal=False, **settings):
    console = Console(
        file=io.StringIO(), width=width, force_terminal=terminal, soft_wrap=True, highlight=False,
        markup=False, _environ={},
    )  # fmt: skip
    return TerminalReporter(console, **settings)


def printed(one):
    return one.console.file.getvalue()


def test_piped_output_has_no_escapes_and_fits_80_columns():
    one = reporter()
    one.tables(example())
    one.failures(example())
    text = printed(one)
    assert "\x1b" not in text
    assert max(map(len, text.splitlines())) <= 80
    assert "TIMEOUT ant/rf[h=1,seed=0]: not done after 5 s (--timeout)" in text


def test_a_terminal_gets_colours():
    one = reporter(terminal=True)
    one.failures(example())
    assert "\x1b[31m" in printed(one)


WIDE = Table("t", [f"column {i}" for i in range(8)], [[str(i) for i in range(8)]])


def test_a_table_that_is_too_wide_is_turned():
    one = reporter(width=40)
    one.table(WIDE)
    assert max(map(len, printed(one).splitlines())) <= 40
    assert len(printed(one).splitlines()) == 11


def test_a_table_that_is_too_wide_both_ways_comes_in_parts_with_its_labels():
    rows = [[f"row {i}", *map(str, range(7))] for i in range(9)]
    one = reporter(width=40)
    one.table(Table("t", WIDE.header, rows))
    lines = printed(one).splitlines()
    assert max(map(len, lines)) <= 40
    headers = [line.split("  ") for line in lines if line.startswith("column 0")]
    assert len(headers) > 1
    assert [w.strip() for h in headers for w in h[1:] if w] == WIDE.header[1:]


def test_names_of_others_are_not_taken_for_markup():
    one = reporter()
    one.failures([make_record("[red]x", status="error", reason="[/b] oops")])
    assert "[red]x" in printed(one)
    assert "[/b] oops" in printed(one)


def test_summary_counts_states():
    assert summary(example()) == "14 ok, 2 timeout"
    assert summary([]) == "no cells"
