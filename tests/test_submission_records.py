"""Tampered records: each is refused with a message that names the field."""

import json
import math
from dataclasses import replace

import pytest
from helpers_records import make_record
from helpers_submission import Draft, assert_refused

from oodd_eval.leaderboard.verify import records
from oodd_eval.leaderboard.verify.files import Findings
from oodd_eval.results.record import Metric

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
    d.records.append(d.records[3] | {"cell": "small/cartpole/drift::persistence[h=1,seed=1]"})


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


def guaranteed(name, top=None, bottom=None):
    """Change the terms of the first trajectory."""

    def change(d):
        sides = d.records[FIRST]["per_trajectory"][f"{name}_at_10pct"]
        for side, value in zip(sides, (0.0 if top is None else top, bottom), strict=True):
            if value is not None:
                side[0] = value
        d.consistent(FIRST, f"{name}_at_10pct")

    return change


def defined(d):
    """A trajectory without an early alarm."""
    return d.records[FIRST]["per_trajectory"]["missed_at_10pct"][1].index(1.0)


def early_and_counted(d):
    d.records[FIRST]["per_trajectory"]["early_at_10pct"][0][defined(d)] = 1.0
    d.consistent(FIRST, "early_at_10pct")


def found_otherwise(d):
    found, i = d.records[FIRST]["per_trajectory"]["found_within_100_at_10pct"][0], defined(d)
    found[i] = 1 - found[i]
    d.consistent(FIRST, "found_within_100_at_10pct")


def found_sooner(d):
    """A delay of 2 that counts in the longer span alone as not found."""
    i = defined(d)
    for name, value in (("delay", 2.0), ("delay_censored", 2.0), ("missed", 0.0),
                        ("found_within_20", 1.0), ("found_within_100", 0.0)):  # fmt: skip
        tops, bottoms = d.records[FIRST]["per_trajectory"][f"{name}_at_10pct"]
        tops[i], bottoms[i] = value, 1.0
        d.consistent(FIRST, f"{name}_at_10pct")


def counted_in_one_span(d):
    """A trajectory without matched AUC, whose twin ended, cannot count in one span alone."""
    i, r = defined(d), d.records[FIRST]["per_trajectory"]
    for name in ("auc_matched", "auc_smoothed", "auc_placebo", "auc_unpaired",
                 "found_within_100_at_10pct"):  # fmt: skip
        r[name][0][i] = r[name][1][i] = 0.0
        d.consistent(FIRST, name)


def other_twins_alarm(d):
    for i, r in enumerate(d.records[:8]):
        alarmed = r["per_trajectory"]["false_episodes_at_10pct"][0]
        alarmed[:] = [1 - k for k in alarmed]
        d.consistent(i, "false_episodes_at_10pct")


def randomness_denied_in_one(d):
    d.records[FIRST]["deterministic"] = not d.records[FIRST]["deterministic"]


def deterministic_seeds_differ(d):
    for r in d.records[:8]:
        r["deterministic"] = True
    for r in json.loads(json.dumps(d.records[:8])):
        r |= {"seed": 1, "scores": "persistence-cartpole-seed1"}
        d.records.append(r)
    top("auc_matched", 0, 0.25, consistent=True)(d)


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
        r["overrides"] = {"width": 3}
    d.records[FIRST]["overrides"] = {"width": True}


def failed_with_metrics(d):
    d.records[FIRST].update(status="timeout", reason="too slow")


def failed_without_reason(d):
    d.records[FIRST].update(status="timeout", metrics={}, per_trajectory={})


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


def two_versions(d):
    d.records[FIRST]["detector_version"] = "9.9"


def another_fits_scores(d):
    d.records[FIRST]["scores"] = d.records[OTHER]["scores"]


def two_fits_in_one(d):
    d.records[FIRST]["scores"] = "persistence-cartpole-other"


def other_counts(d):
    d.records[3]["counts"]["train"] = 7


def one_term_too_few(d):
    for side in d.records[FIRST]["per_trajectory"]["auc"]:
        side.pop()


def uneven_terms(d):
    d.records[FIRST]["per_trajectory"]["auc"][0].pop()


CASES = {
    "edited-value": (metric("auc_matched", value=0.987), "metrics.auc_matched.value"),
    "edited-low": (metric("auc_matched", low=0.0123), "metrics.auc_matched.low"),
    "edited-high": (metric("far_twin", high=0.999), "metrics.far_twin.high"),
    "edited-n": (metric("auc", n=2), "metrics.auc.n"),
    "low-above-high": (swapped_low_high, "metrics.auc_null.low"),
    "undefined-value": (metric("auc", value=None), "metrics.auc.value"),
    "auc-above-one": (top("auc_matched", 0, 1.5, consistent=True), "per_trajectory.auc_matched"),
    "value-above-one": (metric("auc", value=1.2), "metrics.auc.value"),
    "negative-rate": (metric("far", value=-0.1), "metrics.far.value"),
    "negative-delay": (metric("delay", value=-2.0), "metrics.delay.value"),
    "far-no-whole-alarms": (metric("far", value=0.0123), "metrics.far.value"),
    "endless-rate": (metric("far", value=1e308), "metrics.far.value"),
    "endless-misses": (metric("missed", value=-1e308), "metrics.missed.value"),
    "endless-delay": (metric("delay", value=1e308), "metrics.delay.value"),
    "missed-no-whole-n": (metric("missed", value=0.5), "metrics.missed.value"),
    "censored-too-small": (censored_too_small, "metrics.delay_censored.value"),
    "edited-numerator": (top("auc_matched", 1, 0.25), "metrics.auc_matched.value"),
    "fraction-of-an-alarm": (top("far", 0, 0.5, consistent=True), "per_trajectory.far"),
    "more-alarms-than-steps": (top("far_twin", 0, 1e6, consistent=True), "per_trajectory.far_twin"),
    "fraction-of-a-step": (
        top("delay_censored", 0, 1.5, consistent=True), "per_trajectory.delay_censored",
    ),
    "denominator-of-a-mean": (
        lambda d: d.records[FIRST]["per_trajectory"]["auc"][1].__setitem__(0, 2.0),
        "per_trajectory.auc",
    ),
    "missed-and-alarmed": (missed_and_alarmed, "per_trajectory.missed"),
    "censored-unlike-delay": (censored_below_delay, "per_trajectory.delay_censored"),
    "miss-counts-nothing": (miss_counts_nothing, "per_trajectory.delay_censored"),
    "misses-count-differently": (misses_that_count_differently, "per_trajectory.delay_censored"),
    "delay-beyond-a-miss": (delay_beyond_a_miss, "per_trajectory.delay_censored"),
    "auc-undefined-with-steps": (
        lambda d: [side.__setitem__(0, 0.0) for side in d.records[0]["per_trajectory"]["auc"]],
        "per_trajectory.auc",
    ),
    "one-term-too-few": (one_term_too_few, "per_trajectory.auc"),
    "uneven-terms": (uneven_terms, "per_trajectory.auc"),
    "null-term": (top("auc", 0, None), "per_trajectory.auc"),
    "no-terms": (field("per_trajectory.auc", [0.5]), "per_trajectory.auc"),
    "no-metric": (drop("metrics.auc_placebo"), "metrics.auc_placebo"),
    "unknown-metric": (
        field("metrics.auc_best", {"value": 1.0, "low": 1.0, "high": 1.0, "n": 3}),
        "metrics.auc_best",
    ),
    "half-a-level": (drop("metrics.missed_at_10pct"), "metrics.missed_at_10pct"),
    "negative-threshold": (
        metric("threshold_at_10pct", value=-0.1), "metrics.threshold_at_10pct.value",
    ),
    "threshold-with-interval": (
        metric("threshold_at_10pct", low=0.1), "metrics.threshold_at_10pct.low",
    ),
    "thresholds-of-a-fit-differ": (
        metric("threshold_at_10pct", value=123.0), "metrics.threshold_at_10pct.value",
    ),
    "twins-of-a-fit-differ": (twins_differ_within_a_fit, "per_trajectory.far_twin"),
    "early-and-counted": (early_and_counted, "per_trajectory.missed_at_10pct"),
    "late-and-uncounted": (
        guaranteed("found_within_20", bottom=0.0), "per_trajectory.found_within_20_at_10pct",
    ),
    "found-sooner-and-not-later": (found_sooner, "per_trajectory.found_within_100_at_10pct"),
    "counted-in-one-span": (counted_in_one_span, "per_trajectory.found_within_100_at_10pct"),
    "found-without-an-alarm": (found_otherwise, "per_trajectory.found_within_100_at_10pct"),
    "twin-alarms-and-is-missed": (other_twins_alarm, "per_trajectory.false_episodes_at_10pct"),
    "share-of-a-share": (
        guaranteed("false_episodes", 0.5), "per_trajectory.false_episodes_at_10pct",
    ),
    "early-undefined": (guaranteed("early", bottom=0.0), "per_trajectory.early_at_10pct"),
    "exact-interval": (
        metric("false_episodes_at_10pct", high=0.99), "metrics.false_episodes_at_10pct.high",
    ),
    "a-level-too-many": (
        lambda d: d.records[FIRST]["metrics"].update(
            missed_at_5pct=d.records[FIRST]["metrics"]["missed_at_10pct"]
        ),
        "metrics.missed_at_5pct",
    ),
    "smoothed-unlike-matched": (
        lambda d: [s.__setitem__(0, 0.0) for s in d.records[0]["per_trajectory"]["auc_smoothed"]],
        "per_trajectory.auc_smoothed",
    ),
    "two-statistics": (field("alarm", "score"), "alarm"),
    "unknown-statistic": (field("alarm", "blind"), "alarm"),
    "randomness-denied-in-one": (randomness_denied_in_one, "deterministic"),
    "deterministic-seeds-differ": (deterministic_seeds_differ, "per_trajectory"),
    "brief-in-one": (field("brief", True), "brief"),
    "number-as-brief": (field("brief", 1), "brief"),
    "text-as-number": (metric("auc", value="0.9"), "metrics.auc.value"),
    "truth-as-number": (metric("auc", value=True), "metrics.auc.value"),
    "truth-as-n": (metric("auc", n=True), "metrics.auc.n"),
    "truth-as-seed": (field("seed", False), "seed"),
    "truth-as-term": (top("auc", 0, True), "per_trajectory.auc"),
    "truth-as-protocol": (field("protocol", True), "protocol"),
    "nan-value": (metric("auc", value=float("nan")), "records.jsonl:1"),
    "infinite-value": (metric("auc", value=float("inf")), "records.jsonl:1"),
    "list-as-metrics": (field("metrics", []), "metrics"),
    "unknown-field": (field("rank", 1), "rank"),
    "missing-field": (drop("anomaly"), "anomaly"),
    "unknown-metric-field": (metric("auc", code="import os"), "metrics.auc.code"),
    "negative-cost": (field("seconds_fit", -1.0), "seconds_fit"),
    "endless-cost": (field("seconds_fit", 1e308), "seconds_fit"),
    "truth-as-cost": (field("peak_rss_mb", True), "peak_rss_mb"),
    "formula-as-inputs": (field("inputs", "=HYPERLINK(1)"), "inputs"),
    "text-as-steps": (field("steps_scored", "many"), "steps_scored"),
    "more-tests-than-can-be-drawn": (field("counts.test", 10**6), "counts.test"),
    "other-schema": (field("schema", 2), "schema"),
    "old-protocol": (field("protocol", 0), "protocol"),
    "html-in-detector": (every("detector", "<b>best</b>"), "detector"),
    "html-in-plugin": (every("plugin", "<script>:x"), "plugin"),
    "html-in-reason": (
        lambda d: d.records[0].update(
            status="error", reason="<img src=x>", metrics={}, per_trajectory={}
        ),
        "reason",
    ),
    "html-in-parameters": (field("parameters.colour", "<svg>"), "parameters.colour"),
    "deep-parameters": (field("parameters.deep", [[[[[[[1]]]]]]]), "parameters.deep"),
    "control-character-in-provenance": (field("provenance.cpu", "x\x1b[2J"), "provenance.cpu"),
    "unknown-environment": (field("environment", "../ant"), "environment"),
    "unknown-anomaly": (field("anomaly", "iid2"), "anomaly"),
    "path-as-score-key": (field("scores", "../../secret"), "scores"),
    "wrong-group": (field("group", "dynamics"), "group"),
    "cell-of-another-detector": (field("cell", "small/cartpole/iid::riqn[h=1,seed=0]"), "cell"),
    "missing-cells": (missing_cells, "anomaly"),
    "duplicate-cells": (duplicate_cells, "cell"),
    "duplicate-cells-in-disguise": (duplicate_in_disguise, "cell"),
    "another-split-in-one-record": (field("split_digest", "0" * 64), "split_digest"),
    "two-versions-of-a-detector": (two_versions, "detector_version"),
    "source-of-one-record": (
        field("plugin_source", "f" * 64), "plugin_source",
    ),
    "limited-run": (field("limit", 5), "limit"),
    "another-default": (other_default, "parameters.width"),
    "override-unlike-parameter": (override_unlike_parameter, "overrides.width"),
    "unknown-status": (field("status", "great"), "status"),
    "reason-of-success": (field("reason", "because"), "reason"),
    "failure-without-reason": (failed_without_reason, "reason"),
    "failure-with-metrics": (failed_with_metrics, "metrics"),
    "another-fits-scores": (another_fits_scores, "scores"),
    "two-score-files-of-a-fit": (two_fits_in_one, "scores"),
    "rows-without-end": (rows_without_end, "rows"),
    "one-cell-at-two-places": (on_two_devices, "cell"),
    "other-counts-in-one-record": (other_counts, "counts.train"),
    "truth-as-count": (field("counts.test", True), "counts.test"),
    "count-missing": (drop("counts.calibration"), "counts.calibration"),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_a_tampered_record_is_refused_by_its_field(submissions, tmp_path, case):
    tamper, field_name = CASES[case]
    draft = Draft(submissions.plain, tmp_path)
    tamper(draft)
    assert_refused(draft.verdict(), field_name)


@pytest.mark.parametrize(
    ("larger", "smaller", "sound"),
    [
        (1.0, 2.0, True),
        (2.0, 1.0, False),
        (1.0, None, True),
        (None, None, True),
        (None, 1.0, False),
    ],
)
def test_a_smaller_level_has_no_lower_threshold_and_null_is_infinite(larger, smaller, sound):
    thresholds = {"threshold_at_10pct": larger, "threshold_at_5pct": smaller}
    metrics = {n: Metric(math.nan if v is None else v) for n, v in thresholds.items()}
    findings = Findings()
    record = replace(make_record(), metrics=metrics)
    records._check_threshold("here", "threshold_at_5pct", record, findings)
    assert [p.field for p in findings.problems] == (
        [] if sound else ["metrics.threshold_at_5pct.value"]
    )


def counts_of_another_split(d):
    for r in d.records:
        r["counts"]["train"] = 60


def invented_remainder(d):
    """Miss, in both detectors, a trajectory that the rule had an alarm in."""
    cell, i = next(
        (cell, i)
        for cell in range(OTHER)
        for i in range(3)
        if not any(d.records[at]["per_trajectory"]["missed"][0][i] for at in (cell, cell + OTHER))
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
            r["per_trajectory"][name][1][0] = 500.0
        for i in range(len(d.records)):
            d.consistent(i, name)

    return change


def not_found_at_once(d):
    """An alarm at the effect that is said to be in rows that the twin lacks."""
    i, r = defined(d), d.records[FIRST]["per_trajectory"]
    for name in ("delay", "delay_censored", "missed", "found_within_20", "found_within_100"):
        r[f"{name}_at_10pct"][0][i], r[f"{name}_at_10pct"][1][i] = 0.0, 1.0
        d.consistent(FIRST, f"{name}_at_10pct")


AGAINST_SPLIT = {
    "found-in-shared-rows": (not_found_at_once, "per_trajectory.found_within_20_at_10pct"),
    "counts": (counts_of_another_split, "counts.train"),
    "remainder": (invented_remainder, "per_trajectory.delay_censored"),
    "steps-before-onset": (invented_steps("far"), "per_trajectory.far"),
    "steps-of-twins": (invented_steps("far_twin"), "per_trajectory.far_twin"),
    "environment-it-lacks": (
        lambda d: [r.update(environment="ant") for r in d.records],
        "environment",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", AGAINST_SPLIT)
def test_with_the_split_at_hand_invented_counts_are_refused(submissions, tmp_path, case):
    tamper, field_name = AGAINST_SPLIT[case]
    draft = Draft(submissions.plain, tmp_path)
    tamper(draft)
    assert_refused(draft.verdict(submissions.split), field_name)


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
    from oodd_eval.leaderboard.verify.files import MOST_PROBLEMS as LIMIT

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
    assert problem.where == "records.jsonl:5 (small/cartpole/wind-l2r::persistence[h=1,seed=0])"
