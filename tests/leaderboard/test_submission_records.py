"""Tampered records: each is refused with a message that names the field."""

import json
from dataclasses import replace

import pytest
from helpers_submission import Draft, assert_refused
from oodd_leaderboard.verify import records as checks
from oodd_leaderboard.verify.entry_files import MOST_PROBLEMS, Findings

from oodd_eval.metrics import catalogue
from oodd_eval.results.record import Record

FIRST = 0
"""The first record: persistence on cartpole, iid."""


def metric(name, **changes):
    return lambda d: d.records[FIRST]["metrics"][name].update(changes)


def term(name, value, *, side=0):
    """Change the first trajectory's term."""

    def change(d):
        d.records[FIRST]["per_trajectory"][name][side][0] = value

    return change


def parent(d, name):
    """Return the object that holds a field, and the field's last name."""
    holder = d.records[FIRST]
    *parents, last = name.split(".")
    for key in parents:
        holder = holder[key]
    return holder, last


def field(name, value):
    def change(d):
        holder, last = parent(d, name)
        holder[last] = value

    return change


def drop(*names):
    def change(d):
        for name in names:
            holder, last = parent(d, name)
            del holder[last]

    return change


def every(name, value):
    return lambda d: [r.update({name: value}) for r in d.records]


def failed(**fields):
    return lambda d: d.records[FIRST].update(status="timeout", **fields)


def rows_without_end(d):
    """Many rows, each of another width."""
    first = d.records[:8]
    for width in range(64):
        for r in json.loads(json.dumps(first)):
            r["parameters"] = r["overrides"] = {"width": width}
            d.records.append(r)


def on_two_devices(d):
    """The same fit again, on an accelerator."""
    for r in json.loads(json.dumps(d.records[:8])):
        r["provenance"]["device"] = "cuda"
        d.records.append(r)


def one_term_too_few(d):
    for side in d.records[FIRST]["per_trajectory"]["auc"]:
        side.pop()


NO_METRICS = {"metrics": {}, "per_trajectory": {}}
UNKNOWN = {"value": 1.0, "low": 1.0, "high": 1.0, "n": 3}

CASES = {
    "edited-value": (metric("auc_matched", value=0.987), "metrics.auc_matched.value"),
    "undefined-value": (metric("auc", value=None), "metrics.auc.value"),
    "endless-delay": (metric("delay", value=1e308), "metrics.delay.value"),
    "edited-numerator": (term("auc_matched", 0.25), "metrics.auc_matched.value"),
    "something-of-nothing": (term("auc", 0.0, side=1), "per_trajectory.auc"),
    "one-term-too-few": (one_term_too_few, "per_trajectory.auc"),
    "uneven-terms": (
        lambda d: d.records[FIRST]["per_trajectory"]["auc"][0].pop(), "per_trajectory.auc",
    ),
    "no-terms": (field("per_trajectory.auc", [0.5]), "per_trajectory.auc"),
    "draws-of-nothing": (
        field("calibration_draws", {"nothing": [0.1, "UV"]}), "calibration_draws.nothing"
    ),
    "draws-beyond-the-range": (
        field("calibration_draws", {"missed_at_5pct": [1.0, "Uz"]}),
        "calibration_draws.missed_at_5pct",
    ),
    "draws-of-marks": (field("calibration_draws", {"far": [0.1, "<"]}), "calibration_draws.far[1]"),
    "terms-alone": (drop("metrics.auc_placebo"), "per_trajectory.auc_placebo"),
    "no-ranking-metric": (
        drop("metrics.auc_matched", "per_trajectory.auc_matched"), "metrics.auc_matched",
    ),
    "unknown-metric": (field("metrics.auc_best", UNKNOWN), "metrics.auc_best"),
    "a-level-too-many": (field("metrics.missed_at_5pct", UNKNOWN), "per_trajectory.missed_at_5pct"),
    "number-as-brief": (field("brief", 1), "brief"),
    "text-as-number": (metric("auc", value="0.9"), "metrics.auc.value"),
    "truth-as-seed": (field("seed", False), "seed"),
    "nan-value": (metric("auc", value=float("nan")), "records.jsonl:1"),
    "unknown-field": (field("rank", 1), "rank"),
    "missing-field": (drop("anomaly"), "anomaly"),
    "unknown-metric-field": (metric("auc", code="import os"), "metrics.auc.code"),
    "negative-cost": (field("seconds_fit", -1.0), "seconds_fit"),
    "formula-as-inputs": (field("inputs", "=HYPERLINK(1)"), "inputs"),
    "more-tests-than-can-be-drawn": (field("counts.test", 10**6), "counts"),
    "other-schema": (field("schema", 2), "schema"),
    "old-protocol": (field("protocol", 0), "protocol"),
    "html-in-detector": (every("detector", "<b>best</b>"), "detector"),
    "html-in-reason": (failed(reason="<img src=x>", **NO_METRICS), "reason"),
    "html-in-parameters": (field("parameters.colour", "<svg>"), "parameters.colour"),
    "deep-parameters": (field("parameters.deep", [[[[[[[1]]]]]]]), "parameters.deep"),
    "control-character-in-provenance": (field("provenance.cpu", "x\x1b[2J"), "provenance.cpu"),
    "unknown-environment": (field("environment", "../ant"), "environment"),
    "path-as-score-key": (field("scores", "../../secret"), "scores"),
    "wrong-group": (field("group", "dynamics"), "group"),
    "duplicate-cells": (lambda d: d.records.append(d.records[3]), "cell"),
    "one-cell-on-two-devices": (on_two_devices, "cell"),
    "another-split-in-one-record": (field("split_digest", "0" * 64), "split_digest"),
    "two-versions-of-a-detector": (field("detector_version", "9.9"), "plugins"),
    "limited-run": (field("limit", 5), "limit"),
    "failure-with-metrics": (failed(reason="too slow"), "metrics"),
    "rows-without-end": (rows_without_end, "rows"),
    "count-missing": (drop("counts.calibration"), "counts"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_a_tampered_record_is_refused_by_its_field(submissions, tmp_path, case):
    tamper, field_name = CASES[case]
    draft = Draft(submissions.plain, tmp_path)
    tamper(draft)
    assert_refused(draft.verdict(), field_name)


AGAINST_SPLIT = {
    "environment": (every("environment", "ant"), "environment"),
    "strength": (field("strength", "x"), "anomaly"),
}


@pytest.mark.parametrize("case", AGAINST_SPLIT)
def test_with_the_split_at_hand_cells_that_it_lacks_are_refused(submissions, tmp_path, case):
    tamper, field_name = AGAINST_SPLIT[case]
    draft = Draft(submissions.plain, tmp_path)
    tamper(draft)
    assert_refused(draft.verdict(submissions.split), field_name)


@pytest.mark.parametrize(
    ("counts", "refused"),
    [({"train": 40, "calibration": 40, "test": 10}, []), ({"test": 9}, ["counts"])],
)
def test_records_of_a_published_split_have_its_sizes(submissions, counts, refused):
    line = (submissions.plain / "records.jsonl").read_text().splitlines()[FIRST]
    record = Record.from_json(line)
    changes = {"counts": counts, "status": "error", "reason": "too slow", **NO_METRICS}
    findings = Findings()
    checks.check_record("here", replace(record, split="mini", **changes), findings)
    assert [p.field for p in findings.problems] == refused


def test_an_entry_of_before_a_metric_was_added_stays_valid(submissions, tmp_path, monkeypatch):
    """An entry may lack any metric but those that boards rank by."""
    lacking = {"auc_smoothed", "far", "found_within_20_at_10pct", "threshold_at_10pct"}
    draft = Draft(submissions.plain, tmp_path)
    for record in draft.records:
        for part in ("metrics", "per_trajectory", "calibration_draws"):
            record[part] = {n: v for n, v in record[part].items() if n not in lacking}
    verdict = draft.verdict()
    assert verdict.ok, [p.text for p in verdict.findings.problems]


def test_a_metric_is_judged_by_the_range_that_its_table_has(submissions, tmp_path, monkeypatch):
    """The facts of a metric decide, not its name."""
    facts = replace(catalogue.METRICS["auc"], name="gain", range=(-1.0, 1.0), interval="mean")
    monkeypatch.setattr(catalogue, "METRICS", {**catalogue.METRICS, "gain": facts})
    for module in (catalogue, checks):
        monkeypatch.setattr(module, "NAMES", (*catalogue.NAMES, "gain"))
    for value, sound in ((-0.5, True), (-9.0, False)):
        draft = Draft(submissions.plain, tmp_path / str(value))
        draft.records[FIRST]["per_trajectory"]["gain"] = [[value, 0.5, 0.5], [1.0, 1.0, 1.0]]
        draft.consistent(FIRST, "gain")
        assert draft.verdict().ok == sound


def test_an_environment_counts_with_all_its_anomalies(submissions, tmp_path):
    draft = Draft(submissions.plain, tmp_path)
    left_out = draft.records.pop(2)
    verdict = draft.verdict(submissions.split)
    problems = [problem.text for problem in verdict.findings.problems]
    assert any(f"cartpole lacks {left_out['anomaly']}" in text for text in problems), problems


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("level", ["at_10pct"])
def test_alarms_before_the_effect_that_the_twins_lack_are_refused(
    submissions, tmp_path, level, side
):
    draft = Draft(submissions.plain, tmp_path)
    name = (f"early_{level}", f"early_null_{level}")[side]
    terms = draft.records[FIRST]["per_trajectory"][name][0]
    terms[1] = 1.0 - terms[1]
    draft.consistent(FIRST, name)
    assert_refused(draft.verdict(), "per_trajectory", "cartpole/test/iid[1]")


def test_every_problem_is_found_and_not_only_the_first(submissions, tmp_path):
    draft = Draft(submissions.plain, tmp_path)
    draft.records[0]["group"] = "dynamics"
    draft.records[5]["metrics"]["auc"]["value"] = 0.123
    draft.entry["created"] = "yesterday"
    fields = {p.field for p in draft.verdict().findings.problems}
    assert fields == {"created", "group", "metrics.auc.value"}


def test_problems_beyond_the_limit_are_counted(submissions, tmp_path):
    draft = Draft(submissions.plain, tmp_path)
    for record in draft.records:
        for stored in record["metrics"].values():
            stored["value"] = -1.0
    findings = draft.verdict().findings
    assert len(findings.problems) == MOST_PROBLEMS < findings.count


def test_a_message_names_line_and_cell(submissions, tmp_path):
    draft = Draft(submissions.plain, tmp_path)
    draft.records[4]["metrics"]["auc"]["n"] = 9
    (problem,) = draft.verdict().findings.problems
    assert problem.where == "records.jsonl:5 (small/cartpole/wind-l2r::persistence[h=1,seed=0])"
