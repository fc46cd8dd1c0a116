"""Regression checks: tolerances, verdicts, reference files, exit codes, JUnit XML and Markdown."""

import dataclasses
import json
import math
from xml.etree import ElementTree as ET

import pytest
from helpers_records import PAIRED, make_record
from hypothesis import given
from hypothesis import strategies as st

from oodd_eval.cli import main as cli
from oodd_eval.errors import UsageError
from oodd_eval.metrics.catalogue import NAMES
from oodd_eval.results.comparison import (
    NothingInCommonError,
    RecordSet,
    Tolerance,
    compare,
    parse_tolerance,
    read_record_set,
    worse_side,
    write_reference,
)
from oodd_eval.results.record import Metric, same_terms
from oodd_eval.results.render.tabular import junit
from oodd_eval.results.render.text import markdown_section
from oodd_eval.results.report import change, comparison_section

NAN = math.nan
AUC = parse_tolerance("auc:-0.01")
DELAY = parse_tolerance("delay:+10%")


def record(anomaly="iid", *, detector="rf", environment="hopper", status="ok", **metrics):
    """One record whose metrics are these, and 0.5 for those not named."""
    one = make_record(
        detector, environment, anomaly, status=status, reason="broke" * (status != "ok")
    )
    if status != "ok":
        return one
    changed = one.metrics | {k: Metric(v) for k, v in metrics.items()}
    return dataclasses.replace(one, metrics=changed)


def against(now, reference, *tolerances, **settings):
    """Compare lists of records."""
    return compare(RecordSet.of(now), RecordSet.of(reference), tolerances, **settings)


def verdicts(*arguments, **settings):
    return [d.verdict for d in against(*arguments, **settings).differences]


def only(*arguments, **settings):
    (found,) = against(*arguments, **settings).differences
    return found


def markdown(comparison):
    return markdown_section(comparison_section(comparison))


def flat(text):
    """Lines with single blanks."""
    return [" ".join(line.split()) for line in text.splitlines()]


def parsed(text):
    return ET.fromstring(text)  # noqa: S314  written a line above


# Tolerances


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("auc:-0.01", Tolerance("auc", "-", 0.01)),
        ("auc:0.01", Tolerance("auc", "-", 0.01)),
        ("delay:+10%", Tolerance("delay", "+", 10, percent=True)),
        ("missed_at_1pct:+.5", Tolerance("missed_at_1pct", "+", 0.5)),
        ("delay_null:2.", Tolerance("delay_null", "±", 2)),
        ("auc_null:0.1", Tolerance("auc_null", "±", 0.1)),
        ("auc_null:-0.1", Tolerance("auc_null", "-", 0.1)),
        (" missed:0 ", Tolerance("missed", "+", 0)),
    ],
)
def test_tolerances_are_read(text, expected):
    assert parse_tolerance(text) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        *((t, "expected METRIC") for t in
          ("auc", "auc:", "auc:-", "auc:--1", "auc:1e-3", "auc:nan", "auc:1%%", ":1", "auc=1")),
        ("auc_mached:1", "did you mean 'auc_m"),
        ("auc:+0.01", "higher is better, .* write 'auc:-0.01'"),
        ("delay:-10%", r"lower is better, .* write 'delay:\+10%'"),
    ],
)  # fmt: skip
def test_other_forms_unknown_metrics_and_signs_on_the_better_side_are_refused(text, message):
    with pytest.raises(UsageError, match=message):
        parse_tolerance(text)


def test_every_metric_has_its_worse_side():
    falling = {"auc", "auc_matched", "auc_smoothed", "auc_unpaired", "sensor_named_at_5pct",
               "found_within_20_at_5pct", "found_within_100_at_1pct"}  # fmt: skip
    assert {worse_side(m) for m in falling} == {"-"}
    assert {worse_side(m) for m in ("delay", "missed", "far", "false_episodes_at_5pct")} == {"+"}
    beside = [m for m in NAMES if any(word in m for word in ("null", "placebo", "threshold"))]
    assert {worse_side(m) for m in [*beside, "of_another_version"]} == {"±"}


# Verdicts


@pytest.mark.parametrize(
    ("tolerance", "reference", "now", "verdict", "fails"),
    [
        (AUC, 0.9, 0.9, "same", False),
        (AUC, 0.9, 0.9 - 5e-7, "same", False),
        (AUC, 0.9, 0.895, "within", False),
        (AUC, 0.9, 0.89, "within", False),  # as a float the difference is above 0.01
        (AUC, 0.9, 0.88, "worse", True),
        (AUC, 0.9, 0.905, "within", False),
        (AUC, 0.9, 0.92, "better", False),
        (DELAY, 10.0, 11.0, "within", False),
        (DELAY, 10.0, 11.1, "worse", True),
        (DELAY, 10.0, 8.9, "better", False),
        (DELAY, 0.0, 0.1, "worse", True),
        (parse_tolerance("auc_null:0.1"), 0.5, 0.7, "worse", True),
        (parse_tolerance("auc_null:0.1"), 0.5, 0.3, "worse", True),
        (parse_tolerance("auc_null:+0.1"), 0.5, 0.3, "better", False),
        (AUC, NAN, NAN, "same", False),
        (AUC, 0.9, NAN, "undefined", True),
        (DELAY, NAN, 3.0, "undefined", True),
    ],
)
def test_a_figure_against_its_reference(tolerance, reference, now, verdict, fails):
    name = tolerance.metric
    found = only([record(**{name: now})], [record(**{name: reference})], tolerance)
    assert (found.verdict, found.fails) == (verdict, fails)


def test_a_missing_or_failing_cell_of_the_reference_fails():
    reference = [record("iid"), record("drift"), record("gravity")]
    now = [
        record("iid", auc=0.1),
        record("iid"),
        record("drift", status="timeout"),
        record("components"),
    ]
    found = against(now, reference, AUC, two_sided=True)
    # Of several records of a cell the last counts; a cell in the results alone is new.
    assert [(d.verdict, d.fails) for d in found.differences] == [
        ("same", False), ("failed", True), ("missing", True), ("new", False),
    ]  # fmt: skip
    assert found.differences[1].reason == "timeout: broke"
    with pytest.raises(UsageError, match="'missed_at_1pct' is not in records"):
        against(now, reference, parse_tolerance("missed_at_1pct:0.1"))
    # What failed in the reference already does not fail.
    failed = [record("iid", status="oom"), record("drift", status="oom")]
    later = [record("iid", status="error"), record("drift")]
    assert verdicts(later, failed, AUC) == ["same", "recovered"]
    assert not against(later, failed, AUC).failures
    assert len(against(later, failed, AUC, two_sided=True).failures) == 1


def test_without_tolerances_nothing_with_a_worse_side_may_get_worse():
    changed = record(auc=0.4, auc_null=0.9, delay=0.4, far=0.6)
    found = against([changed], [record()])
    judged = {m for m in PAIRED if worse_side(m) != "±"}
    assert {d.tolerance.metric for d in found.differences} == judged
    assert {d.tolerance.metric for d in found.failures} == {"auc", "far"}


# Means


def test_means_by_group_and_over_all():
    names = ("iid", "drift", "gravity")
    reference = [record(a, auc=0.9) for a in names]
    now = [record("iid", auc=0.87), record("drift", auc=0.92), record("gravity", auc=0.83)]
    found = against(now, reference, AUC, by="group").differences
    assert [(d.scope, round((d.now - d.reference), 6), d.verdict) for d in found] == [
        ("hopper/sensor", -0.005, "within"), ("hopper/dynamics", -0.07, "worse"),
    ]  # fmt: skip
    whole = only(now, reference, AUC, by="mean")
    assert (whole.scope, whole.now, whole.verdict) == ("mean", pytest.approx(2.62 / 3), "worse")


def test_a_mean_says_which_share_of_its_cells_is_lost_or_turned():
    reference = [record("iid"), record("drift")]
    lost = only([record("iid")], reference, AUC, by="mean")
    assert (lost.verdict, lost.reason[:12], lost.fails) == ("missing", "1 of 2 cells", True)
    turned = only([record("iid", auc=NAN), record("drift")], reference, AUC, by="mean")
    assert (turned.verdict, turned.reason[-15:]) == ("undefined", "in 1 of 2 cells")


# What cannot be compared


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"split_digest": "cd" * 32}, "digest abababababab, .* digest cdcdcdcdcdcd"),
        ({"protocol": 2}, "protocol 1; .* protocol 2"),
        ({"limit": 5}, "protocol 1; .* limit 5"),
        ({"detector": "npn"}, r"hopper/iid::rf\S+\) is in records \(which .*:npn"),
    ],
)
def test_other_digests_protocols_limits_and_cells_have_nothing_in_common(changes, message):
    other = dataclasses.replace(record(), **changes)
    with pytest.raises(NothingInCommonError, match=message):
        against([other], [record()], AUC)
    # Of several splits the common one is compared, and the others are named.
    comparison = against([record(), other], [record()], AUC)
    assert comparison.differences[0].verdict == "same"
    assert len(comparison.notes) == ("detector" not in changes)


# Reference files


def test_a_reference_has_a_record_per_line_in_the_benchmarks_order_and_no_more(tmp_path):
    one = dataclasses.replace(
        record("iid"), seconds_fit=2.0, provenance={"python": "3.11", "time": "now"}, scores="key"
    )
    write_reference([record("drift"), one], tmp_path / "a.jsonl")
    write_reference([one, record("drift")], tmp_path / "b.jsonl")
    text = (tmp_path / "a.jsonl").read_text()
    assert text == (tmp_path / "b.jsonl").read_text()
    first, second = map(json.loads, text.splitlines())
    assert (first["anomaly"], second["anomaly"]) == ("iid", "drift")
    assert (first["plugin"], first["split_digest"]) == ("oodd-eval:rf", "ab" * 32)
    assert (first["per_trajectory"], first["seconds_fit"], first["scores"]) == ({}, None, "")
    assert first["provenance"] == {"python": "3.11"}


# A subset of the reference


@pytest.mark.parametrize(
    ("detectors", "environments", "outside"),
    [(["rf"], ["ant", "hopper"], 8), (["rf", "npn"], ["hopper"], 6), (["rf"], ["hopper"], 10)],
)
def test_detectors_and_environments_that_were_not_run_are_summed_up_in_one_line(
    detectors, environments, outside
):
    reference = [
        record(a, detector=d, environment=e)
        for d in ("rf", "npn", "riqn") for e in ("ant", "hopper") for a in ("iid", "drift")
    ]  # fmt: skip
    now = [r for r in reference if r.detector in detectors and r.environment in environments]
    found = against(now[1:], reference, AUC)
    lost = [d for d in found.differences if d.verdict == "missing"]
    # They fail as before, but only what is missing from within is listed.
    assert len(lost) == len(found.failures) == len(reference) - len(now) + 1
    ((row,),) = (table.rows for table in comparison_section(found).tables)
    assert row[0] == f"{now[0].environment}/{now[0].anomaly}"
    (note,) = found.notes
    assert f"{len(reference) - len(now)} cells" in note
    assert all(name in note for name in {"npn", "riqn"} - set(detectors))


# The command


@pytest.fixture
def run(tmp_path, capsys, monkeypatch):
    """Call the command line beside two results directories, the same and worse."""
    monkeypatch.chdir(tmp_path)
    same = [record("iid", auc=0.9), record("gravity", auc=0.8), record("iid", environment="ant")]
    worse = [record("iid", auc=0.7), record("gravity", auc=0.9), record("iid", environment="ant")]
    for name, records in (("same", same), ("worse", worse)):
        (tmp_path / name).mkdir()
        text = "".join(r.to_json() + "\n" for r in records)
        (tmp_path / name / "records.jsonl").write_text(text)
    write_reference(same, tmp_path / "reference.jsonl")

    def call(*arguments):
        code = cli.main(["compare", *arguments])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


@pytest.mark.parametrize("reference", ["same", "same/records.jsonl", "reference.jsonl"])
@pytest.mark.parametrize("results", ["same", "reference.jsonl"])
def test_identical_results_are_exit_code_0_and_one_line(run, results, reference):
    code, out, err = run(results, "--against", reference)
    assert (code, err) == (0, "")
    judged = sum(worse_side(m) != "±" for m in PAIRED)
    assert out == f"3 cells compared in {judged} metrics: {3 * judged} same.\n"


def test_a_regression_is_exit_code_1_and_a_table(run):
    code, out, _ = run("worse", "--against", "reference.jsonl", "--fail", "auc:-0.01")
    assert code == 1
    rows = flat(out)
    assert "hopper/iid auc 0.9000 0.7000 ↓ 0.2 -0.01 worse" in rows
    assert "hopper/gravity auc 0.8000 0.9000 ↑ 0.1 -0.01 better" in rows
    assert "3 cells compared in auc: 1 same, 1 better, 1 worse." in out
    assert "Regression check failed: 1 of 3 figures" in out
    assert "\x1b" not in out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("none --against same", "no results or reference at 'none'"),
        ("same --against none.json", "no results or reference at 'none.json'"),
        ("same --against same --fail ac:1", "did you mean 'auc'"),
        ("same --against same --fail auc:1 --fail auc:2", "two tolerances"),
        ("same", "nothing to do"),
        ("same --against same --by x", "'x'"),
        (
            "same --against same --junit reference.jsonl/j.xml",
            "'reference.jsonl/j.xml' cannot be written",
        ),
    ],
)
def test_what_cannot_be_done_is_exit_code_4(run, arguments, message):
    code, _, err = run(*arguments.split())
    assert code == 4
    assert message in err


def test_nothing_in_common_is_exit_code_5_with_the_reason(run):
    code, _, err = run("same", "--against", "same", "-k", "walker2d")
    assert code == 5
    assert "no cell is selected in same" in err
    assert run("same", "--write-reference", "r.json", "-k", "walker2d")[0] == 5


def test_a_reference_is_written_of_the_selected_cells_and_replaced(run):
    code, out, _ = run("same", "--write-reference", "new.json", "-k", "hopper")
    assert (code, out) == (0, "2 cells written to new.json\n")
    assert run("worse", "--against", "new.json", "--fail", "auc:0.5")[0] == 0
    assert "1 new cell is not in the reference" in run("same", "--against", "new.json")[1]
    again = ("--against", "reference.jsonl", "--fail", "auc:-0.01")
    assert run("worse", *again, "--write-reference", "reference.jsonl")[0] == 4  # it is read
    assert run("worse", "--write-reference", "reference.jsonl")[0] == 0
    assert run("worse", *again)[0] == 0


def test_quiet_prints_the_summary_and_verbose_all_figures(run):
    assert run("worse", "--against", "same", "-q")[1].count("\n") == 1
    assert run("same", "--against", "same", "-v", "--fail", "auc:0")[1].count("same") >= 3


# JUnit XML and Markdown

ODD = 'a]]>&<b>"\x00\x1b\ufffe\U0001f600|`é'

SCHEMA = {
    "testsuites": ({"name", "time", "tests", "failures", "errors"}, {"testsuite"}),
    "testsuite": ({"name", "tests", "failures", "errors", "time", "skipped"}, {"testcase"}),
    "testcase": ({"name", "classname", "time"}, {"failure", "skipped"}),
    "failure": ({"type", "message"}, set()),
    "skipped": ({"message"}, set()),
}
"""Attributes and children that junit-10.xsd allows, as far as they are used."""


def odd_comparison():
    reference = [record("iid"), record("drift"), record("gravity")]
    now = [record("iid", auc=0.2), record("drift", status="error"), record("components")]
    odd = [dataclasses.replace(r, detector=ODD, reason=ODD) for r in reference]
    return against(
        [dataclasses.replace(r, detector=ODD, reason=ODD) for r in now], odd,
        AUC, DELAY,
    )  # fmt: skip


def test_junit_has_the_layout_that_services_read():
    root = parsed(junit(odd_comparison()))
    assert root.tag == "testsuites"
    for element in root.iter():
        attributes, children = SCHEMA[element.tag]
        assert set(element.attrib) == attributes
        assert {child.tag for child in element} <= children
    for element in (root, *root):
        cases = list(element.iter("testcase"))
        assert int(element.get("tests")) == len(cases) == 8
        assert int(element.get("failures")) == len(list(element.iter("failure"))) == 5
    assert len(list(root.iter("skipped"))) == int(root[0].get("skipped")) == 2


@given(st.text(max_size=30))
def test_junit_is_well_formed_whatever_the_names(text):
    odd = dataclasses.replace(record(), detector=text, reason=text)
    failed = dataclasses.replace(odd, status="error", metrics={})
    parsed(junit(against([failed], [odd], AUC)))


def test_markdown_says_verdict_summary_tables_and_conditions():
    now = [record(auc=0.2), record("drift", auc=0.495)]
    text = markdown(against(now, [record(), record("drift")], AUC))
    assert "failed: 1 of 2 figures" in text.splitlines()[0]
    shown, folded = text.split("<details>")
    assert "| hopper/iid | auc | 0.5000 | 0.2000 | ↓ 0.3 | -0.01 | worse |" in flat(shown)
    assert "| hopper/drift | auc | 0.5000 | 0.4950 | ↓ 0.005 | -0.01 | within |" in flat(folded)
    assert "digest abababababab, protocol 1" in text.splitlines()[-1]
    same = markdown(against([record()], [record()], AUC))
    assert "passed" in same.splitlines()[0]
    assert "|" not in same


def test_a_failing_cell_takes_one_row_of_the_table():
    text = markdown(odd_comparison())
    assert "<b>" not in text
    assert r"\<b\>" in text
    assert change(only([record(delay=12.5)], [record(delay=10.0)], DELAY)) == "↑ 2.5 (+25.0%)"
    (found,) = comparison_section(odd_comparison()).tables
    assert found.colours == ["red"] * 3
    assert [(row[0], row[1], row[-1]) for row in found.rows] == [
        ("hopper/iid", "auc", "worse"),
        ("hopper/drift", "all", "failed"),
        ("hopper/gravity", "all", "missing"),
    ]
    assert list(dict.fromkeys(len(row) for row in found.rows)) == [len(found.header)]


@pytest.mark.parametrize(("ending", "magic"), [("gz", b"\x1f\x8b"), ("xz", b"\xfd7zXZ")])
def test_a_reference_keeps_the_terms_of_chosen_metrics_alone(tmp_path, ending, magic):
    values = {"auc_matched": [0.8, 0.6], "far_twin": [0.1, 0.2]}
    record = make_record("rf", "ant", "iid", values=values)
    other = make_record("rf", "ant", "drift", values={"auc": [0.5, 0.5]})
    place = tmp_path / f"kept.jsonl.{ending}"
    # Records need not have all of them: logs with labelled rows have other metrics than outcomes.
    write_reference([record, other], place, keep=["auc_matched", "auc_rows"])
    assert place.read_bytes().startswith(magic)
    kept = next(r for r in read_record_set(place).records if r.anomaly == "iid")
    assert [*kept.metrics] == [*kept.per_trajectory] == ["auc_matched"]
    assert same_terms(kept.per_trajectory, {"auc_matched": record.per_trajectory["auc_matched"]})
    write_reference([record], tmp_path / "whole.jsonl")
    (whole,) = read_record_set(tmp_path / "whole.jsonl").records
    assert ({*whole.metrics}, whole.per_trajectory) == ({*record.metrics}, {})
