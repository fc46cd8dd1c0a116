"""Boards without twins: tables, rankings, results, plots, curves, entries and the site."""

import csv
import io
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from helpers_records import make_record
from rich.console import Console

from oodd_eval.cli.main import main
from oodd_eval.errors import ResultsError
from oodd_eval.metrics.catalogue import UNDEFINED
from oodd_eval.prose import print_sections
from oodd_eval.results.board import Board, boards
from oodd_eval.results.record import Metric
from oodd_eval.results.render import FORMATS
from oodd_eval.results.report import Report, findings_of, flat
from oodd_eval.results.standings import compare_rows
from oodd_eval.results.strengths import StrengthTables, thresholds
from oodd_eval.results.tables import Tables


def log_record(
    detector,
    environment="arm",
    anomaly="slip",
    *,
    nominal=6,
    episodes=4,
    values=None,
    group="",
    calibration=40,
    **fields,
):
    """A record without twins: each metric has one value over its sample's episodes.

    A list has one for each of them. Metrics of nominal episodes are false episodes and alarms.
    """
    columns = {}
    for name, value in (values or {}).items():
        of_nominal = name.startswith(("false_", "auc_pool_null")) or "_null" in name
        terms = np.zeros((2, nominal + episodes))
        sample = slice(None, nominal) if of_nominal else slice(nominal, None)
        terms[0, sample], terms[1, sample] = value, 1.0
        columns[name] = terms
    metrics = {n: Metric(t[0].sum() / t[1].sum(), n=int(t[1].sum())) for n, t in columns.items()}
    base = make_record(detector, digest="cd" * 32)
    counts = {"train": 6, "calibration": calibration, "nominal": nominal, "test": episodes}
    facts = {
        "counts": counts,
        "split": "logs",
        "group": group,
        "paired": False,
        "metrics": metrics,
        "per_trajectory": columns,
        "brief": False,
        "alarm": "cusum",
    }
    return replace(base, environment=environment, anomaly=anomaly, **facts | fields)


def labelled(pool, rows, level="at_5pct", **more):
    """Metrics of a cell whose anomalous rows are known."""
    alarms = {
        "events_found": 0.75, "delay": 4.0, "delay_censored": 8.0, "found_within_100": 0.5,
        "missed": 0.25, "false_episodes": [0, 0, 0, 0, 0, 1], "early": 0.0,
        "false_alarms_per_hour": 2.0,
    }  # fmt: skip
    values = {"auc_pool": pool, "auc_pool_null": 0.5, "auc_rows": rows}
    return values | {f"{name}_{level}": value for name, value in alarms.items()} | more


def two_environments(**more):
    """Three detectors; the arm has one kind of anomaly, the press two."""
    return [
        log_record(detector, environment, anomaly, values=labelled(pool, rows, **more))
        for detector, rows in (("mewma", 0.8), ("rf", 0.6), ("clock", 0.7))
        for environment, anomaly, pool in (
            ("arm", "slip", 0.9 if detector == "mewma" else 0.5),
            ("press", "leak", 0.5),
            ("press", "jam", 0.6 if detector == "mewma" else 0.5),
        )
    ]


def table_titled(records, start, detail="brief"):
    report = Report(records, detail=detail)
    whole = start == ALL
    (table,) = [
        t for s in report.sections for t in s.tables
        if (t.title == start if whole else t.title.startswith(start))
    ]  # fmt: skip
    return table


BY = "Pooled AUC (%) by group and environment"
ALL = "Scores and alarms (%, but for steps) at 5 %"


def column(table, name):
    return {row[0]: row[table.header.index(name)] for row in table.rows}


# Tables


def test_the_headline_has_its_columns_in_order_and_those_that_no_record_has_are_left_out():
    front = table_titled(two_environments(), "Pooled AUC and guaranteed alarms at 5 %")
    assert front.header == ["detector", "pooled AUC", "worst environment", "missed",
                            "false episodes"]  # fmt: skip
    assert [row[2] for row in front.rows] == ["press 55.0", "arm 50.0", "arm 50.0"]
    table = table_titled(two_environments(), ALL, "full")
    assert table.header == [
        "detector", "pooled AUC", "null", "AUC of rows", "events found", "delay censored (steps)",
        "found within 100", "missed", "false episodes (≤ 5 %)", "early", "false alarms per hour",
    ]  # fmt: skip
    assert [row[0] for row in table.rows] == ["mewma", "clock", "rf"]
    assert column(table, "pooled AUC") == {"mewma": "66.7", "rf": "50.0", "clock": "50.0"}
    assert re.fullmatch(r"16\.7 \[\d.*, \d.*\]", column(table, "false episodes (≤ 5 %)")["rf"])
    fewer = labelled(0.5, 0.6)
    del fewer["false_alarms_per_hour_at_5pct"]
    header = table_titled([log_record("rf", values=fewer)], ALL, "full").header
    assert header == [name for name in table.header if "hour" not in name]


def test_ten_percent_is_shown_and_ranks_where_five_is_not_offered():
    records = [
        log_record(d, values=labelled(pool, 0.6, "at_10pct"), calibration=30)
        for d, pool in (("mewma", 0.9), ("rf", 0.6))
    ]
    board = Board(records)
    assert (board.ranking, board.alarm_ranking) == ("auc_pool", "delay_censored_at_10pct")
    table = table_titled(records, "Pooled AUC and guaranteed alarms at 10 %", "full")
    assert "at most 10 % (30 calibration episodes; 38 needed at 5 %)" in table.note
    assert not [text for text in findings_of(board) if "calibration" in text]
    # One row with a statistic that takes half as many episodes does not leave the others blank.
    both = labelled(0.7, 0.6) | labelled(0.7, 0.6, "at_10pct")
    one = log_record("pe", values=both, calibration=30, alarm="score")
    assert Board([*records, one]).alarm_ranking == "delay_censored_at_10pct"
    assert Board([one]).alarm_ranking == "delay_censored_at_5pct"
    # What is said of that row alone has the level that it has among the others, or that is asked.
    for level in ("", "at_5pct"):
        (section,) = Report([*records, one], detector="pe", level=level).sections
        assert section.verdict.startswith("pe on arm: pooled AUC 70.0 %, missed 25.0 %")
    strict = Report(records, level="at_1pct").sections[0].tables[0]
    assert strict.title == "Pooled AUC (%)"


def test_environments_and_groups_stand_apart():
    table = table_titled(two_environments(), BY, "full")
    assert table.header == ["detector", "mean", "arm", "press"]
    assert table.rows[0] == ["mewma", "66.7", "90.0", "55.0"]
    wide = Report(two_environments(), detail="full").sections[0].tables
    assert {t.title.rpartition(": ")[2] for t in wide} >= {"arm", "press"}
    one = [r for r in two_environments() if r.environment == "arm"]
    # One environment has no such table, one group no column, and one anomaly no table of them.
    single = [t.title for t in Report([r for r in one if r.detector == "rf"]).sections[0].tables]
    assert not [title for title in single if "by anomaly" in title]
    for records in (one, [replace(r, group="dynamics") for r in one]):
        titles = [t.title for t in Report(records).sections[0].tables]
        assert not [title for title in titles if title.startswith(BY)]
    groups = {"jam": "sensor", "leak": "dynamics"}
    grouped = [replace(r, group=groups.get(r.anomaly, "")) for r in two_environments()]
    assert Board(grouped).groups == {"sensor": ["jam"], "dynamics": ["leak"]}
    header = table_titled(grouped, BY, "full").header
    assert header[2:] == ["sensor", "dynamics", "arm", "press"]


@pytest.mark.parametrize(
    ("pool", "rows", "timed", "named"),
    [
        (0.5, [0.6] * 5, 0.7, True),
        (0.5, [0.7] * 5, 0.7, True),  # as well
        (0.5, [0.8] * 5, 0.7, False),
        (0.5, [0.9, 0.1, 0.4, 0.6, 0.5], 0.7, False),  # at chance
        (0.55, [0.6] * 5, 0.7, False),  # clock = false: rows share no number
    ],
)
def test_a_row_that_the_time_alone_equals_within_episodes_is_named(pool, rows, timed, named):
    records = [
        log_record("range", values=labelled(0.5, rows), episodes=5),
        log_record("clock", values=labelled(pool, timed), episodes=5),
    ]
    sentences = [s for s in findings_of(Board(records)) if s.startswith("clock, ")]
    assert bool(sentences) == named
    assert all(f"range ({100 * rows[0]:.1f} against 70.0)" in s for s in sentences)
    assert not [s for s in findings_of(Board(records[:1])) if "time alone" in s]


def outcome(auc, found):
    return {
        "auc_pool": 0.5, "auc_pool_null": 0.5, "auc_outcome": auc, "found_outcome_at_5pct": found,
        "found_outcome_null_at_5pct": 0.0, "false_episodes_at_5pct": 0.0,
    }  # fmt: skip


def test_outcomes_are_one_table_with_the_clock_in_it_and_rank():
    records = [
        log_record(d, values=outcome(auc, found))
        for d, auc, found in (("clock", 0.5, 0.0), ("mewma", 0.9, 0.5))
    ]
    (front,) = Report(records, detail="brief").sections[0].tables
    assert front.header == ["detector", "AUC of outcomes", "found outcome", "false episodes"]
    table = table_titled(records, ALL, "full")
    assert table.header[3:6] == ["AUC of outcomes", "false episodes (≤ 5 %)", "found outcome"]
    assert column(table, "AUC of outcomes") == {"mewma": "90.0", "clock": "50.0"}
    assert Board(records).ranking == "auc_outcome"
    assert "The row clock shows" in table.note
    # Guaranteed alarms without delays speak of none.
    titles = [table.title for table in Tables(Board(records)).all_alarms()]
    assert titles
    assert not [title for title in titles if "delay" in title]


def with_lengths(auc, found, half, whole, **more):
    """Metrics of a cell of outcomes with all that is known of it."""
    values = {
        "auc_outcome_half": half, "auc_outcome_whole": whole,
        "balanced_outcome_at_5pct": (1 + found) / 2, "outcome_time_at_5pct": 12.0,
    }  # fmt: skip
    return outcome(auc, found) | values | more


def banded():
    """A column, two supervised rows, one of which is the best of all, and the clock."""
    rows = [
        log_record("clock", values=with_lengths(0.5, 0.0, 0.5, 0.85)),
        log_record("chunk", values=with_lengths(0.7, 0.4, 0.6, 0.8)),
        log_record("range", values=with_lengths([0.4, 0.7, 0.5, 0.4], 0.2, 0.5, 0.9)),
    ]
    taught = {"logistic": (0.9, [0.1, 0.2, 0.3, 0.2]), "tdqc": (0.45, 0.25)}
    return rows + [
        log_record(
            name, values=with_lengths(auc, 0.5, auc, auc, brier_outcome=brier), training="failures"
        )
        for name, (auc, brier) in taught.items()
    ]


def test_the_table_of_outcomes_has_every_figure_that_records_have():
    table = table_titled(banded(), ALL, "full")
    assert {
        "AUC of outcomes", "AUC at half time", "AUC of whole episodes", "found outcome",
        "found outcome null", "balanced accuracy", "outcome delay (steps)", "brier score",
    } <= {*table.header}  # fmt: skip
    assert column(table, "brier score") == {
        "chunk": UNDEFINED, "clock": UNDEFINED, "range": UNDEFINED,
        "logistic §": "0.200", "tdqc §": "0.250",
    }  # fmt: skip
    assert "brier score = squared distance of a probability of failure" in table.note
    assert "brier score (scores are no probabilities that were learnt from failures)" in table.note
    assert column(table, "balanced accuracy")["chunk"] == "70.0"
    front = table_titled(banded(), "AUC of outcomes and guaranteed alarms", "brief")
    assert front.header[1:] == ["AUC of outcomes", "found outcome", "balanced accuracy",
                                "false episodes"]  # fmt: skip
    wide = Report(banded(), detail="full").sections[0].tables
    (separability,) = [t for t in wide if t.title.startswith("All metrics")]
    assert "Brier score" not in separability.header
    (alarms,) = [t for t in wide if t.title.startswith("Guaranteed alarms at 5 %")]
    assert "delays in steps" in alarms.title


def test_rows_that_learn_from_failures_stand_below_the_others_with_a_mark():
    records = banded()
    order = ["chunk", "clock", "range", "logistic §", "tdqc §"]
    for shuffled in (records, records[::-1]):
        (section,) = Report(shuffled, detail="full").sections
        for table in section.tables:
            names = [row[0] for row in table.rows]
            assert names in (order, order[-2:]) or " by anomaly" in table.title, table.title
    assert "§: learns" in table_titled(records, "AUC of outcomes and", "brief").note
    # The first row is compared with the others, though a supervised one has the largest figure.
    verdict = Report(records, detail="full").sections[0].verdict
    assert verdict.startswith("clock is second of three ranked rows")
    assert "chunk" in verdict
    # Where one row is left, no other band is put beside it.
    (alone,) = Report([r for r in records if r.detector in ("chunk", "tdqc", "logistic")]).sections
    assert alone.verdict.startswith("chunk on arm: ")
    (taught,) = Report([r for r in records if r.training == "failures"]).sections
    assert taught.verdict.startswith("logistic is first of two")
    assert "tdqc" in taught.verdict
    (mine,) = Report(
        [replace(r, plugin="x:x") if r.detector == "tdqc" else r for r in records]
    ).sections
    assert mine.verdict.startswith("tdqc is second of two rows that learn from failures")
    # With a value in fewer cells than the others it still is below them.
    apart = [
        *records,
        *(replace(r, environment="press") for r in records if r.training == "nominal"),
    ]
    (section,) = Report(apart, detail="brief").sections
    assert [row[0] for row in section.tables[0].rows][3:] == order[3:]


def test_a_comparison_with_a_row_that_learns_from_failures_says_so():
    records = banded()
    text = str(compare_rows(records, "logistic", "chunk"))
    assert "logistic learns from failures, the other does not." in text
    assert "logistic learns" in compare_rows(records, "clock", "logistic").verdict
    for pair in (("logistic", "tdqc"), ("chunk", "clock")):
        assert "learns" not in str(compare_rows(records, *pair))
    sentences = findings_of(Board(records))
    named = [s for s in sentences if "tdqc" in s or "logistic" in s]
    assert named
    for sentence in named:
        assert sentence.count("tdqc, trained on failures (") == sentence.count("tdqc")
        assert sentence.count("logistic, trained on failures (") == sentence.count("logistic")


def test_formats_mark_rows_that_learn_from_failures():
    report = Report(banded())
    rows = list(csv.DictReader(io.StringIO(FORMATS["csv"].render(report))))
    kinds = {row["row"]: row["training"] for row in rows}
    assert {kinds.pop("logistic"), kinds.pop("tdqc")} == {"failures"}
    assert {*kinds.values()} == {"nominal"}
    objects = json.loads(FORMATS["json"].render(report))
    assert [o["training"] for o in objects] == ["nominal"] * 3 + ["failures"] * 2
    for name in ("markdown", "html", "latex"):
        text = FORMATS[name].render(report)
        assert "logistic §" in text
        assert "§: learns from failures" in text
    # Without such rows formats are what they were.
    assert "training" not in flat(banded()[:3])[0]
    assert "§" not in str(Report(banded()[:3], detail="full"))


def test_the_clock_is_named_where_it_tells_failures_as_well():
    (whole, equal) = [s for s in findings_of(Board(banded())) if s.startswith("clock, which")]
    assert "in AUC of whole episodes, which then is the length" in whole
    assert "chunk (80.0 against 85.0)" in whole
    assert "range (" not in whole
    assert "tdqc, trained on failures (45.0 against 85.0)" in whole
    assert "in AUC of outcomes, at equal time" in equal
    assert "range (50.0 against 50.0), tdqc, trained on failures (45.0 against 50.0)." in equal
    # One sentence says it, not two.
    assert not [s for s in findings_of(Board(banded())) if s.startswith("clock has a higher mean")]
    better = log_record("chunk", values=with_lengths(0.7, 0.4, 0.6, 0.9))
    assert not [s for s in findings_of(Board([banded()[0], better])) if "clock" in s]
    # Of records without whole episodes nothing new is said.
    old = [log_record(d, values=outcome(a, 0.1)) for d, a in (("clock", 0.5), ("chunk", 0.5))]
    assert not [s for s in findings_of(Board(old)) if "clock" in s]


def test_nominal_episodes_alone_have_false_alarms_and_no_rank():
    values = {"false_episodes_at_5pct": [0, 0, 0, 0, 0, 1], "false_alarms_per_hour_at_5pct": 1.5}
    records = [log_record(d, anomaly="nominal", episodes=0, values=values) for d in ("mewma", "rf")]
    (section,) = Report(records, detail="brief").sections
    assert [table.header for table in section.tables] == [["detector", "false episodes"]]
    note = section.tables[0].note
    assert not any(word in note for word in ("chance", "missed"))
    table = table_titled(records, ALL, "full")
    assert table.header == ["detector", "false episodes (≤ 5 %)", "false alarms per hour"]
    assert re.fullmatch(r"16\.7 \[.*\]", table.rows[0][1])
    for name, layout in FORMATS.items():
        assert layout.render(Report(records)), name


def test_a_board_may_have_cells_of_every_kind():
    values = {"false_episodes_at_5pct": 0.0, "false_alarms_per_hour_at_5pct": 1.5}
    kinds = [
        ("arm", "slip", labelled(0.9, 0.8)),
        ("pick", "failure", outcome(0.7, 0.5)),
        ("idle", "nominal", values),
    ]
    records = [log_record(d, e, a, values=v) for d in ("mewma", "clock") for e, a, v in kinds]
    titles = {d: [t.title for t in Report(records, detail=d).sections[0].tables] for d in DETAILS}
    assert titles["brief"] == ["Pooled AUC and guaranteed alarms at 5 % (%)"]
    places = ["", ": arm", ": pick", ": idle"]
    assert [t for t in titles["full"] if t.startswith(ALL)] == [f"{ALL}{at}" for at in places]
    idle = table_titled(records, f"{ALL}: idle", "full")
    assert idle.header == ["detector", "false episodes (≤ 5 %)", "false alarms per hour"]
    apart = table_titled(records, BY, "full")
    assert apart.header == ["detector", "mean", "arm", "pick"]


DETAILS = ("brief", "full")


def test_metrics_of_rows_stand_in_a_table_of_their_own():
    extra = {"f1_rows": 0.5, "far_rows": 0.1, "mar_rows": 0.4, "vus_pr": 0.6}
    records = two_environments(**extra)
    table = table_titled(records, "Metrics of rows")
    assert len(table.header) == 1 + len(extra)
    assert table.header[-1] == "VUS-PR"
    whole = table_titled(records, "All metrics", detail="full")
    assert not [name for name in whole.header if "rows" in name and name != "AUC of rows"]
    titles = [t.title for t in Report(two_environments()).sections[0].tables]
    assert not [title for title in titles if "Metrics of rows" in title]


def test_formats_for_programs_say_magnitude_pairing_and_notes():
    records = [*two_environments(), make_record(magnitude=0.5, note="no twins")]
    lines = list(csv.DictReader(io.StringIO(FORMATS["csv"].render(Report(records)))))
    objects = json.loads(FORMATS["json"].render(Report(records)))
    assert {"magnitude", "paired", "note"} <= flat(records)[0].keys()
    assert (lines[0]["paired"], lines[0]["magnitude"], lines[0]["note"]) == ("False", "", "")
    assert [objects[-1][n] for n in ("paired", "magnitude", "note")] == [True, 0.5, "no twins"]


def test_a_note_is_a_finding_with_its_cells_and_rows():
    records = [
        make_record(d, anomaly=a, note="withheld: they are no twins")
        for d in ("rf", "riqn")
        for a in ("iid", "drift")
    ]
    (sentence,) = [s for s in findings_of(Board(records)) if "withheld" in s]
    assert sentence.startswith("hopper/iid, hopper/drift (rf, riqn): ")
    assert sentence in Report(records).sections[0].findings


def test_records_with_and_without_twins_are_never_in_one_board():
    mixed = [*two_environments(), make_record(digest="cd" * 32)]
    assert sorted(len(board.records) for board in boards(mixed)) == [1, 9]
    with pytest.raises(ResultsError, match="several splits"):
        compare_rows(mixed, "mewma", "rf")


def test_strengths_have_the_unit_that_the_split_names():
    shares = {"0.1": 0.0, "0.2": 0.5, "0.4": 1.0}
    records = [
        make_record("mine", "arm", "drift", strength=name, magnitude=float(name),
                    values={"found_within_100_at_5pct": [share, share]})
        for name, share in shares.items()
    ]  # fmt: skip
    of_board = StrengthTables(Board(records), units={"drift": "rad"})
    tables = of_board.overview()
    assert [t.header[-1] for t in tables if "by anomaly" in t.title] == ["drift (rad)"]
    row = records[0].setting, thresholds(records)[records[0].setting]
    assert of_board.by_place(*row).header == ["Environment", "drift (rad)"]
    assert StrengthTables(Board(records)).by_place(*row).header[1] == "drift"
    unpaired = [
        log_record("mine", strength=n, magnitude=float(n), values=labelled(s, 0.6))
        for n, s in (("1", 0.6), ("2", 0.8))
    ]
    (table,) = StrengthTables(Board(unpaired)).overview()
    assert table.rows == [["mine", "60.0", "80.0"]]


NAMES = ("pyod.models.ensembles:VeryLongDetectorNameOfSomebody", "mewma", "mewma-a", "rf", "clock")


@pytest.mark.parametrize("width", [60, 80, 120, 200])
def test_tables_fit_every_terminal_with_whole_names(width):
    records = [
        replace(r, detector=name, horizon=h, overrides=o, parameters=o)
        for name, h, o in [(name, 1, {}) for name in NAMES]
        + [("mewma", 10, {}), ("mewma", 1, {"shrink": "ledoit-wolf", "window": 30})]
        for r in two_environments()
        if r.detector == "mewma"
    ]
    screen = Console(file=io.StringIO(), width=width, soft_wrap=True, highlight=False, markup=False)
    print_sections(Report(records, detail="full").sections, screen)
    text = screen.file.getvalue()
    assert max(map(len, text.splitlines())) <= width
    assert text.count("NameOf") >= 1
    labels = {str(r.setting) for r in records}
    for table in Report(records, detail="full").sections[0].tables:
        assert {row[0] for row in table.rows} == labels or " by anomaly" in table.title
    if width >= 80:
        assert "mewma[h=10]" in text


def test_show_prints_stored_records_and_one_detector(tmp_path, capsys):
    lines = "".join(r.to_json() + "\n" for r in two_environments())
    (tmp_path / "records.jsonl").write_text(lines)
    show = ["show", str(tmp_path), "--stored"]
    for options, title in (
        ([], "Pooled AUC and guaranteed alarms at 5 %"),
        (["--wide"], ALL),
        (["--detector", "rf"], "rf: pooled AUC (%) by anomaly"),
        (["--detector", "rf", "--metric", "auc_rows"], "rf: AUC of rows (%) by anomaly"),
    ):
        assert main([*show, *options]) == 0
        assert title in capsys.readouterr().out
    assert main([*show, "--paper"]) == 4  # it is for splits with twins
    assert "--paper" in capsys.readouterr().err


def test_compare_reads_records_without_twins_and_writes_junit(tmp_path, capsys):
    worse = [
        log_record(r.detector, r.environment, r.anomaly, values=labelled(0.2, 0.2))
        for r in two_environments()
    ]
    files = {"now": two_environments(), "worse": worse}
    for name, records in files.items():
        (tmp_path / f"{name}.jsonl").write_text("".join(r.to_json() + "\n" for r in records))
    now, later, xml = (str(tmp_path / name) for name in ("now.jsonl", "worse.jsonl", "out.xml"))
    assert main(["compare", now, "--against", now, "--junit", xml]) == 0
    fail = ["--fail", "auc_pool:-0.01", "--junit", xml]
    assert main(["compare", later, "--against", now, *fail]) == 1
    text = (tmp_path / "out.xml").read_text()
    assert len(re.findall("<failure", text)) == len(worse)
    assert "logs/press/jam::mewma[h=1,seed=0]" in text
    for by in ("group", "mean"):
        assert main(["compare", now, "--against", now, "--by", by]) == 0
    capsys.readouterr()
    assert main(["compare", now, "mewma", "rf"]) == 0
    assert "pooled AUC: mewma 66.7 %, rf 50.0 %" in capsys.readouterr().out


def test_alarms_are_shown_where_no_row_can_be_ranked():
    """Of few nominal test episodes none is compared: no row is picked to speak for the others."""
    values = {"missed_at_5pct": 0.25, "false_episodes_at_5pct": 0.5}
    records = [log_record(name, values=values) for name in ("flag:x[0]", "column:abs(x)")]
    (section,) = Report(records, detail="brief").sections
    (table,) = section.tables
    assert [row[0] for row in table.rows] == ["column:abs(x)", "flag:x[0]"]
    assert not section.verdict
    (alone,) = Report(records[:1], detail="brief").sections
    assert alone.verdict == "flag:x[0] on arm: missed 25.0 %, false episodes 50.0 %."
