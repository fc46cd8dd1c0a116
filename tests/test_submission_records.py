"""Tampered records: each is refused with a message that names the field."""

import json

import pytest
from helpers_submission import Draft, assert_refused

FIRST = 0
"""The first record: persistence on cartpole, iid."""

OTHER = 8
"""The same cell of another detector: random."""


def metric(name, **changes):
    return lambda d: d.records[FIRST]["metrics"][name].update(changes)


def top(name, index, value, *, consistent=False):
    """Change a numerator, and with it value and interval if that is to stay consistent."""

    def change(d):
        d.records[FIRST]["per_trajectory"][name][0][index] = value
        if consistent:
            d.consistent(FIRST, name)

    return change


def field(name, value):
    def change(d):
        inner = d.records[FIRST]
        *parents, last = name.split(".")
        for parent in parents:
            inner = inner[parent]
        inner[last] = value

    return change


def drop(name):
    def change(d):
        inner = d.records[FIRST]
        *parents, last = name.split(".")
        for parent in parents:
            inner = inner[parent]
        del inner[last]

    return change


def every(name, value):
    return lambda d: [r.update({name: value}) for r in d.records]


def missing_cells(d):
    del d.records[2]


def duplicate_cells(d):
    d.records.append(d.records[3])


def duplicate_in_disguise(d):
    again = json.loads(json.dumps(d.records[3]))
    d.records.append(again | {"cell": again["cell"].replace("seed=0", "seed=1")})


def swapped_low_high(d):
    m = d.records[FIRST]["metrics"]["auc_null"]
    m["low"], m["high"] = m["high"], m["low"]


def missed_and_alarmed(d):
    r = d.records[FIRST]
    i = r["per_trajectory"]["delay"][1].index(1.0)
    r["per_trajectory"]["missed"][0][i] = 1.0
    d.consistent(FIRST, "missed")


def censored_below_delay(d):
    r = d.records[FIRST]
    i = r["per_trajectory"]["delay"][1].index(1.0)
    r["per_trajectory"]["delay"][0][i] += 3.0
    d.consistent(FIRST, "delay")


def censored_too_small(d):
    late = next(r["metrics"] for r in d.records if (r["metrics"]["delay"]["value"] or 0) > 0)
    late["delay_censored"]["value"] = 0.0


def miss_counts_nothing(d):
    r = d.records[FIRST]["per_trajectory"]
    r["missed"][0][0], r["delay"][0][0], r["delay"][1][0] = 1.0, 0.0, 0.0
    r["delay_censored"][0][0] = 0.0
    for name in ("missed", "delay", "delay_censored"):
        d.consistent(FIRST, name)


def misses_that_count_differently(d):
    for i, steps in ((FIRST, 7.0), (OTHER, 9.0)):
        r = d.records[i]["per_trajectory"]
        r["missed"][0][0], r["delay"][0][0], r["delay"][1][0] = 1.0, 0.0, 0.0
        r["delay_censored"][0][0] = steps
        for name in ("missed", "delay", "delay_censored"):
            d.consistent(i, name)


def delay_beyond_a_miss(d):
    misses_that_count_differently(d)
    r = d.records[OTHER]["per_trajectory"]
    r["missed"][0][0], r["delay"][1][0] = 0.0, 1.0
    r["delay"][0][0] = r["delay_censored"][0][0] = 7.0
    for name in ("missed", "delay", "delay_censored"):
        d.consistent(OTHER, name)


def twins_differ_within_a_fit(d):
    r = d.records[FIRST]["per_trajectory"]["far_twin"]
    r[0][0] = r[0][0] + 1
    d.consistent(FIRST, "far_twin")


def other_default(d):
    for r in d.records:
        r["parameters"] = {"width": 3}
    d.records[FIRST]["parameters"] = {"width": 4}


def override_unlike_parameter(d):
    for r in d.records:
        r["parameters"] = {"width": 3}
        r["provenance"]["overrides"] = {"width": 3}
        r["cell"] = r["cell"].replace("]", ",width=3]")
    d.records[FIRST]["provenance"]["overrides"] = {"width": True}


def failed_with_metrics(d):
    d.records[FIRST].update(status="timeout", reason="too slow")


def failed_without_reason(d):
    d.records[FIRST].update(status="timeout", metrics={}, per_trajectory={})


def rows_without_end(d):
    """Many rows, each of another width."""
    first = d.records[:8]
    for width in range(64):
        for r in json.loads(json.dumps(first)):
            r["parameters"] = r["provenance"]["overrides"] = {"width": width}
            r["cell"] = r["cell"].replace("]", f",width={width}]")
            d.records.append(r)


def on_two_devices(d):
    """The same fit again, on an accelerator."""
    for r in json.loads(json.dumps(d.records[:8])):
        r["parameters"] = r["provenance"]["overrides"] = {"device": "cuda"}
        r["cell"] = r["cell"].replace("]", ",device=cuda]")
        d.records.append(r)


def two_versions(d):
    d.records[FIRST]["detector_version"] = "9.9"


def another_fits_scores(d):
    d.records[FIRST]["provenance"]["scores"] = d.records[OTHER]["provenance"]["scores"]


def two_fits_in_one(d):
    d.records[FIRST]["provenance"]["scores"] = "persistence-cartpole-other"


def other_counts(d):
    d.records[3]["counts"]["train"] = 7


def one_term_too_few(d):
    for side in d.records[FIRST]["per_trajectory"]["auc"]:
        side.pop()


def uneven_terms(d):
    d.records[FIRST]["per_trajectory"]["auc"][0].pop()


CASES = {
    # values and intervals
    "edited-value": (metric("auc_matched", value=0.987), "metrics.auc_matched.value", "gives"),
    "edited-low": (metric("auc_matched", low=0.0123), "metrics.auc_matched.low", "bootstrap"),
    "edited-high": (metric("far_twin", high=0.999), "metrics.far_twin.high", "bootstrap"),
    "edited-n": (metric("auc", n=2), "metrics.auc.n", "is 2, but per_trajectory gives 3"),
    "low-above-high": (swapped_low_high, "metrics.auc_null.low", "above high"),
    "undefined-value": (metric("auc", value=None), "metrics.auc.value", "is nan"),
    "auc-above-one": (
        top("auc_matched", 0, 1.5, consistent=True), "per_trajectory.auc_matched",
        "trajectory 0 has the numerator 1.5, expected an AUC within [0, 1]",
    ),
    "value-above-one": (metric("auc", value=1.2), "metrics.auc.value", "within [0, 1]"),
    "negative-rate": (metric("far", value=-0.1), "metrics.far.value", "within [0, 1]"),
    "negative-delay": (metric("delay", value=-2.0), "metrics.delay.value", "at least 0"),
    "far-no-whole-alarms": (metric("far", value=0.0123), "metrics.far.value", "whole number of"),
    "endless-rate": (metric("far", value=1e308), "metrics.far.value", "within [0, 1]"),
    "endless-misses": (metric("missed", value=-1e308), "metrics.missed.value", "within [0, 1]"),
    "endless-delay": (metric("delay", value=1e308), "metrics.delay.value", "per_trajectory gives"),
    "missed-no-whole-n": (metric("missed", value=0.5), "metrics.missed.value", "times n = 3"),
    "censored-too-small": (
        censored_too_small, "metrics.delay_censored.value",
        "expected at least (1 - missed) * delay",
    ),
    # terms
    "edited-numerator": (top("auc_matched", 1, 0.25), "metrics.auc_matched.value", "gives"),
    "fraction-of-an-alarm": (
        top("far", 0, 0.5, consistent=True), "per_trajectory.far", "whole number of alarms",
    ),
    "more-alarms-than-steps": (
        top("far_twin", 0, 1e6, consistent=True), "per_trajectory.far_twin", "numerator 1000000.0",
    ),
    "fraction-of-a-step": (
        top("delay_censored", 0, 1.5, consistent=True), "per_trajectory.delay_censored",
        "whole number of steps",
    ),
    "denominator-of-a-mean": (
        lambda d: d.records[FIRST]["per_trajectory"]["auc"][1].__setitem__(0, 2.0),
        "per_trajectory.auc", "has the denominator 2.0, expected 0 or 1",
    ),
    "missed-and-alarmed": (missed_and_alarmed, "per_trajectory.missed", "both missed and alarmed"),
    "censored-unlike-delay": (
        censored_below_delay, "per_trajectory.delay_censored", "but its delay is",
    ),
    "miss-counts-nothing": (
        miss_counts_nothing, "per_trajectory.delay_censored", "expected at least 1",
    ),
    "misses-count-differently": (
        misses_that_count_differently, "per_trajectory.delay_censored", "remainder of the episode",
    ),
    "delay-beyond-a-miss": (
        delay_beyond_a_miss, "per_trajectory.delay_censored", "observations are left",
    ),
    "auc-undefined-with-steps": (
        lambda d: [side.__setitem__(0, 0.0) for side in d.records[0]["per_trajectory"]["auc"]],
        "per_trajectory.auc", "far counts",
    ),
    "one-term-too-few": (one_term_too_few, "per_trajectory.auc", "counts.test is 3"),
    "uneven-terms": (uneven_terms, "per_trajectory.auc", "2 numerators and 3 denominators"),
    "null-term": (top("auc", 0, None), "per_trajectory.auc", "numerator 0 is None"),
    "no-terms": (
        field("per_trajectory.auc", [0.5]), "per_trajectory.auc", "expected a list of numerators",
    ),
    "no-metric": (drop("metrics.auc_placebo"), "metrics.auc_placebo", "is missing"),
    "unknown-metric": (
        field("metrics.auc_best", {"value": 1.0, "low": 1.0, "high": 1.0, "n": 3}),
        "metrics.auc_best", "no metric that is expected",
    ),
    "half-a-calibrated-rule": (
        drop("metrics.missed_at_1pct"), "metrics.missed_at_1pct", "is missing",
    ),
    "negative-threshold": (
        metric("threshold_at_1pct", value=-0.1), "metrics.threshold_at_1pct.value", "at least 0",
    ),
    "threshold-with-interval": (
        metric("threshold_at_1pct", low=0.1), "metrics.threshold_at_1pct.low", "no interval",
    ),
    "thresholds-of-a-fit-differ": (
        metric("threshold_at_1pct", value=123.0), "metrics.threshold_at_1pct.value",
        "of the same fit",
    ),
    "twins-of-a-fit-differ": (
        twins_differ_within_a_fit, "per_trajectory.far_twin", "same fit on the same twins",
    ),
    "pooled-above-one": (metric("fpr95", value=1.5), "metrics.fpr95.value", "within [0, 1]"),
    "pooled-undefined": (metric("fpr95", value=None), "metrics.fpr95.value", "is null"),
    # types
    "text-as-number": (metric("auc", value="0.9"), "metrics.auc.value", "is '0.9'"),
    "truth-as-number": (metric("auc", value=True), "metrics.auc.value", "is True"),
    "truth-as-n": (metric("auc", n=True), "metrics.auc.n", "is True"),
    "truth-as-seed": (field("seed", False), "seed", "is False"),
    "truth-as-term": (top("auc", 0, True), "per_trajectory.auc", "is True"),
    "truth-as-protocol": (field("protocol", True), "protocol", "is True"),
    "nan-value": (metric("auc", value=float("nan")), "records.jsonl:1", "NaN is no JSON number"),
    "infinite-value": (metric("auc", value=float("inf")), "records.jsonl:1", "Infinity"),
    "list-as-metrics": (field("metrics", []), "metrics", "expected a JSON object"),
    "unknown-field": (field("rank", 1), "rank", "is no field"),
    "missing-field": (drop("anomaly"), "anomaly", "is missing"),
    "unknown-metric-field": (metric("auc", code="import os"), "metrics.auc.code", "is no field"),
    "negative-cost": (field("seconds_fit", -1.0), "seconds_fit", "expected at least 0"),
    "endless-cost": (field("seconds_fit", 1e308), "seconds_fit", "at most 1e+09"),
    "truth-as-cost": (field("peak_rss_mb", True), "peak_rss_mb", "is True"),
    "formula-as-inputs": (
        field("provenance.inputs", "=HYPERLINK(1)"), "provenance.inputs", "expected observations",
    ),
    "text-as-steps": (field("provenance.steps_scored", "many"), "provenance.steps_scored", "whole"),
    "more-tests-than-can-be-drawn": (
        field("counts.test", 10**6), "counts.test", "at most 2000",
    ),
    "other-schema": (field("schema", 2), "schema", "is 2, expected 1"),
    "old-protocol": (field("protocol", 0), "protocol", "is 0, expected 1"),
    # names
    "html-in-detector": (every("detector", "<b>best</b>"), "detector", "<b>best</b>"),
    "html-in-plugin": (every("plugin", "<script>:x"), "plugin", "expected 'distribution:plug-in'"),
    "html-in-reason": (
        lambda d: d.records[0].update(
            status="error", reason="<img src=x>", metrics={}, per_trajectory={}
        ),
        "reason", "contains '<'",
    ),
    "html-in-parameters": (
        field("parameters.colour", "<svg>"), "parameters.colour", "contains '<'",
    ),
    "deep-parameters": (
        field("parameters.deep", [[[[[[[1]]]]]]]), "parameters.deep", "levels deep",
    ),
    "control-character-in-provenance": (
        field("provenance.cpu", "x\x1b[2J"), "provenance.cpu", "control character",
    ),
    "unknown-environment": (field("environment", "../ant"), "environment", "is '../ant'"),
    "unknown-anomaly": (field("anomaly", "iid2"), "anomaly", "is 'iid2'"),
    "path-as-score-key": (
        field("provenance.scores", "../../secret"), "provenance.scores", "is '../../secret'",
    ),
    # consistency
    "wrong-group": (field("group", "dynamics"), "group", "iid belongs to 'sensor'"),
    "cell-of-another-detector": (
        field("cell", "small/cartpole/iid::riqn[h=1,seed=0]"), "cell", "but its fields make",
    ),
    "missing-cells": (missing_cells, "anomaly", "cartpole lacks drift"),
    "duplicate-cells": (duplicate_cells, "cell", "is there twice"),
    "duplicate-cells-in-disguise": (duplicate_in_disguise, "cell", "but its fields make"),
    "another-split-in-one-record": (
        field("split_digest", "0" * 64), "split_digest", "an entry has one split_digest",
    ),
    "two-versions-of-a-detector": (two_versions, "detector_version", "one source"),
    "source-of-one-record": (
        field("provenance.plugin_source", "f" * 64), "provenance.plugin_source", "one source",
    ),
    "limited-run": (field("provenance.limit", 5), "provenance.limit", "uses all trajectories"),
    "another-default": (other_default, "parameters.width", "not among provenance.overrides"),
    "override-unlike-parameter": (
        override_unlike_parameter, "provenance.overrides.width", "parameters.width is 3",
    ),
    "unknown-status": (field("status", "great"), "status", "is 'great'"),
    "reason-of-success": (field("reason", "because"), "reason", "must be empty"),
    "failure-without-reason": (failed_without_reason, "reason", "say why"),
    "failure-with-metrics": (failed_with_metrics, "metrics", "must be empty"),
    "another-fits-scores": (another_fits_scores, "provenance.scores", "of the same fit"),
    "two-score-files-of-a-fit": (two_fits_in_one, "provenance.scores", "of the same fit"),
    "rows-without-end": (rows_without_end, "rows", "are 66, expected at most 64"),
    "one-cell-at-two-places": (on_two_devices, "cell", "is there twice"),
    "other-counts-in-one-record": (other_counts, "counts.train", "has 6 trajectories"),
    "truth-as-count": (field("counts.test", True), "counts.test", "is True"),
    "count-missing": (drop("counts.calibration"), "counts.calibration", "is missing"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_a_tampered_record_is_refused_by_its_field(submissions, tmp_path, case):
    tamper, field_name, message = CASES[case]
    draft = Draft(submissions.plain, tmp_path)
    tamper(draft)
    assert_refused(draft.verdict(), field_name, message)


def counts_of_another_split(d):
    for r in d.records:
        r["counts"]["train"] = 60


def invented_remainder(d):
    """Miss, in both detectors, a trajectory that every rule had an alarm in."""
    suffixes = ("", "_at_1pct")
    cell, i = next(
        (cell, i)
        for cell in range(OTHER)
        for i in range(3)
        if not any(
            d.records[at]["per_trajectory"][f"missed{s}"][0][i]
            for at in (cell, cell + OTHER)
            for s in suffixes
        )
    )
    for at in (cell, cell + OTHER):
        r = d.records[at]["per_trajectory"]
        r["missed"][0][i], r["delay"][0][i], r["delay"][1][i] = 1.0, 0.0, 0.0
        r["delay_censored"][0][i] = 55.0
        for name in ("missed", "delay", "delay_censored"):
            d.consistent(at, name)


def invented_steps(name):
    def change(d):
        for r in d.records:
            for suffix in ("", "_at_1pct"):
                r["per_trajectory"][name + suffix][1][0] = 500.0
        for i in range(len(d.records)):
            for suffix in ("", "_at_1pct"):
                d.consistent(i, name + suffix)

    return change


AGAINST_SPLIT = {
    "counts": (counts_of_another_split, "counts.train", "the split has 6 trajectories"),
    "remainder": (
        invented_remainder, "per_trajectory.delay_censored", "observations from its onset on",
    ),
    "steps-before-onset": (invented_steps("far"), "per_trajectory.far", "500 scored steps"),
    "steps-of-twins": (invented_steps("far_twin"), "per_trajectory.far_twin", "500 scored steps"),
    "environment-it-lacks": (
        lambda d: [
            r.update(environment="ant", cell=r["cell"].replace("cartpole", "ant"))
            for r in d.records if r["environment"] == "cartpole"
        ],
        "environment", "is 'ant', but the split has",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", AGAINST_SPLIT)
def test_with_the_split_at_hand_invented_counts_are_refused(submissions, tmp_path, case):
    tamper, field_name, message = AGAINST_SPLIT[case]
    draft = Draft(submissions.plain, tmp_path)
    tamper(draft)
    assert_refused(draft.verdict(submissions.split), field_name, message)


@pytest.mark.parametrize("case", sorted(set(AGAINST_SPLIT) - {"environment-it-lacks"}))
def test_without_the_split_these_inventions_are_consistent(submissions, tmp_path, case):
    draft = Draft(submissions.plain, tmp_path)
    AGAINST_SPLIT[case][0](draft)
    assert draft.verdict().ok


def test_a_consistent_lie_passes_as_reported_only(submissions, tmp_path):
    draft = Draft(submissions.plain, tmp_path)
    top("auc_matched", 0, 0.75, consistent=True)(draft)
    verdict = draft.verdict(submissions.split)
    assert verdict.ok
    assert not verdict.rescored


def test_every_problem_is_found_and_not_only_the_first(submissions, tmp_path):
    draft = Draft(submissions.plain, tmp_path)
    draft.records[0]["group"] = "dynamics"
    draft.records[5]["metrics"]["auc"]["value"] = 0.123
    draft.entry["created"] = "yesterday"
    verdict = draft.verdict()
    assert {p.field for p in verdict.findings.problems} == {
        "created", "group", "metrics.auc.value"
    }  # fmt: skip


def test_problems_beyond_the_limit_are_counted(submissions, tmp_path):
    from oodd_eval.leaderboard.verify.findings import LIMIT

    draft = Draft(submissions.plain, tmp_path)
    for record in draft.records:
        for stored in record["metrics"].values():
            stored["value"] = -1.0
    findings = draft.verdict().findings
    assert len(findings.problems) == LIMIT < findings.count


def test_a_message_names_line_and_cell(submissions, tmp_path):
    draft = Draft(submissions.plain, tmp_path)
    draft.records[4]["metrics"]["auc"]["n"] = 9
    (problem,) = draft.verdict().findings.problems
    assert problem.where == f"records.jsonl:5 ({draft.records[4]['cell']})"
