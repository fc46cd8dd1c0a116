"""Metrics of test data without twins: hand-worked numbers, second formulas, intervals, runs."""

import dataclasses
import itertools
import math

import h5py
import numpy as np
import pytest
from helpers_logs import UNPAIRED, log_parts, make_log_split, write_log_split
from helpers_plugins import local_spec
from helpers_split import make_split
from hypothesis import given
from hypothesis import strategies as st

from oodd_eval import evaluate, load_results, load_split
from oodd_eval.cli.main import main
from oodd_eval.data.condition import NOMINAL, Condition
from oodd_eval.data.facts import LogFacts
from oodd_eval.data.layout import content_digest, environment_digest, read_manifest, write_manifest
from oodd_eval.errors import ResultsError
from oodd_eval.metrics.alarms import GuaranteedAlarm
from oodd_eval.metrics.auc import Contribution
from oodd_eval.metrics.binomial import clopper_pearson
from oodd_eval.metrics.bootstrap import bootstrap_weights, cell_samples, drawn_cell, mean_interval
from oodd_eval.metrics.catalogue import metric_info
from oodd_eval.metrics.ranking import differences
from oodd_eval.metrics.unpaired import (
    UnpairedScores,
    row_metrics,
    separability,
    unpaired_alarms,
    volume_under_pr,
)
from oodd_eval.results.board import boards
from oodd_eval.results.evaluate import counts_of
from oodd_eval.results.record import CodedDraws, Record

NAN = math.nan
SCORE = GuaranteedAlarm(None, math.inf)
ABOVE_ONE = GuaranteedAlarm(None, 1.0)


def arrays(*rows):
    return [np.array(row, dtype=np.float64) for row in rows]


def cell(nominal, anomalous, intervals, *, tasks=None, nominal_tasks=None, clock=True):
    return UnpairedScores(
        nominal,
        anomalous,
        intervals,
        nominal_tasks or [""] * len(nominal),
        tasks or [""] * len(anomalous),
        clock,
    )


def in_interval(intervals, t):
    return not intervals or any(max(a, 0) <= t < b for a, b in intervals)


# -- second formulas, pair by pair ----------------------------------------------------------------


def brute_pool(case, weights=None):
    """auc_pool, nominal episode j counting ``weights[j]`` times."""
    weights = np.ones(len(case.nominal)) if weights is None else weights
    means = []
    for scores, intervals, task in zip(case.anomalous, case.intervals, case.tasks, strict=True):
        rows = []
        for t in range(len(scores)):
            if not in_interval(intervals, t) or np.isnan(scores[t]):
                continue
            total = below = rivals = 0
            for other, name, weight in zip(case.nominal, case.nominal_tasks, weights, strict=True):
                at = range(len(other)) if not case.clock else range(t, min(t + 1, len(other)))
                values = [other[u] for u in at if not np.isnan(other[u])]
                if name == task and values and weight:
                    rivals += 1
                    total += weight * len(values)
                    below += weight * sum((scores[t] > v) + 0.5 * (scores[t] == v) for v in values)
            if rivals >= (5 if case.clock else 1):
                rows.append(below / total)
        if rows:
            means.append(np.mean(rows))
    return np.mean(means) if means else NAN


def brute_null(case):
    drawn = {}
    for j, task in enumerate(case.nominal_tasks):
        k = case.nominal_tasks[:j].count(task)
        own = [i for i, name in enumerate(case.tasks) if name == task]
        if own:
            drawn[j] = case.intervals[own[k % len(own)]]
    values = []
    for j, intervals in drawn.items():
        others = [
            o for k, o in enumerate(case.nominal)
            if k != j and case.nominal_tasks[k] == case.nominal_tasks[j]
        ]  # fmt: skip
        one = UnpairedScores(
            others, [case.nominal[j]], [intervals], [""] * len(others), [""], case.clock
        )
        inside = intervals or ((0, len(case.nominal[j])),)
        values.append(brute_pool(dataclasses.replace(one, intervals=[inside])))
    return np.mean([v for v in values if not np.isnan(v)] or [NAN])


@st.composite
def cases(draw, *, clock=None):
    """Cells with ties, undefined first rows, tasks, lengths and labels of all kinds."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    m, n, tasks = draw(st.integers(1, 14)), draw(st.integers(1, 5)), draw(st.integers(1, 2))

    def scores():
        values = rng.integers(0, 6, size=rng.integers(4, 12)).astype(np.float64)
        values[: rng.integers(0, 3)] = NAN
        return values

    def labels(rows):
        kind, a = rng.integers(0, 4), int(rng.integers(0, rows - 2))
        return [(), ((-1, a + 1),), ((a, rows),), ((a, a + 1), (a + 1 + (a + 2 < rows), rows))][
            kind
        ]

    anomalous = [scores() for _ in range(n)]
    return UnpairedScores(
        [scores() for _ in range(m)],
        anomalous,
        [labels(len(s)) for s in anomalous],
        [str(rng.integers(tasks)) for _ in range(m)],
        [str(rng.integers(tasks)) for _ in range(n)],
        draw(st.booleans()) if clock is None else clock,
    )


@given(cases())
def test_pooled_aucs_are_those_of_all_pairs(case):
    found = separability(case, SCORE)
    assert found["auc_pool"].value == pytest.approx(brute_pool(case), nan_ok=True)
    assert found["auc_pool_null"].value == pytest.approx(brute_null(case), nan_ok=True)
    for contribution in found.values():
        assert len(contribution.numerator) == sum(case.sizes)
        assert contribution.nominal == case.sizes[0]


@given(cases())
def test_terms_of_nominal_episodes_are_what_one_more_of_them_changes(case):
    terms = separability(case, SCORE)["auc_pool"]
    total, m, step = terms.denominator.sum(), case.sizes[0], 1e-5
    for j in np.flatnonzero(terms.denominator[:m]):
        weights = np.ones(m)
        weights[j] += step
        expected = (brute_pool(case, weights) - brute_pool(case)) / step
        # The balanced sides have half of the weight each.
        influence = (terms.numerator[j] - terms.value * terms.denominator[j]) / total
        assert influence == pytest.approx(expected, abs=1e-4)


@given(cases())
def test_terms_of_the_null_are_what_one_more_nominal_episode_changes(case):
    case = dataclasses.replace(case, intervals=[((0, 4),)] * len(case.anomalous))
    terms = separability(case, SCORE)["auc_pool_null"]
    m, step = case.sizes[0], 1e-5
    # The k-th episode of a task has the rows of every other one: they are drawn alike.
    influences = (terms.numerator - terms.value * terms.denominator)[:m] / max(terms.n, 1)
    if terms.n < m:
        return
    for j in range(m):
        weights = np.ones(m)
        weights[j] += step
        shifted = 0.0
        for i in range(m):
            others = [w * (k != i) for k, w in enumerate(weights)]
            one = dataclasses.replace(
                case,
                anomalous=[case.nominal[i]],
                intervals=[((0, 4),)],
                tasks=[case.nominal_tasks[i]],
            )
            shifted += weights[i] * brute_pool(one, np.array(others))
        expected = (shifted / weights.sum() - terms.value) / step
        assert influences[j] == pytest.approx(expected, abs=1e-4)


@given(cases(), st.sampled_from([np.exp, np.cbrt, lambda x: 3 * x - 7]))
def test_a_monotone_transform_changes_no_auc(case, transform):
    other = dataclasses.replace(
        case,
        nominal=[transform(s) for s in case.nominal],
        anomalous=[transform(s) for s in case.anomalous],
    )
    found = [separability(c, SCORE) for c in (case, other)]
    for name in found[0]:
        assert np.array_equal(found[0][name].numerator, found[1][name].numerator)


@given(cases(clock=True))
def test_what_knows_the_time_alone_has_one_half_exactly(case):
    timed = dataclasses.replace(
        case,
        nominal=[np.arange(len(s), dtype=np.float64) for s in case.nominal],
        anomalous=[np.arange(len(s), dtype=np.float64) for s in case.anomalous],
    )
    found = separability(timed, SCORE)
    for name in {"auc_pool", "auc_pool_null", "auc_outcome"} & found.keys():
        if found[name].n:
            assert found[name].value == 0.5
            samples = cell_samples("arm", found[name], "slip")
            assert set(samples[~np.isnan(samples)]) == {0.5}


# -- numbers worked by hand -----------------------------------------------------------------------


def test_rows_with_fewer_than_five_nominal_episodes_are_left_out():
    nominal = arrays([0, 1, 0], [0, 2, 0], [0, 3, 0], [0, 4, 0], [0, 5])
    found = separability(cell(nominal, arrays([9, 3, 9]), [((1, 3),)]), SCORE)["auc_pool"]
    assert found.value == pytest.approx(0.5)  # row 1 alone: above 1 and 2, ties with 3
    none = separability(cell(nominal[:4], arrays([9, 3, 9]), [((1, 3),)]), SCORE)["auc_pool"]
    assert (none.n, math.isnan(none.value)) == (0, True)
    # Without a clock the scores are above 11 of 14 rows, three of these by half, and above all.
    free = cell(nominal, arrays([9, 3, 9]), [((1, 3),)], clock=False)
    lower = (11 + 0.5) / 14
    assert separability(free, SCORE)["auc_pool"].value == pytest.approx((lower + 1) / 2)


def test_an_unknown_start_counts_from_row_0_and_an_outcome_alone_all_rows():
    nominal = [np.zeros(4)] * 5
    score = arrays([1, 0, 0, -1])
    values = [
        separability(cell(nominal, score, [labels]), SCORE)["auc_pool"].value
        for labels in (((-1, 2),), ((1, 2),), ())
    ]
    assert values == [0.75, 0.5, 0.5]


def test_episodes_are_compared_inside_their_task():
    nominal = [*arrays(*[[0, 0]] * 5), *arrays(*[[9, 9]] * 5)]
    tasks = ["low"] * 5 + ["high"] * 5
    found = separability(
        cell(nominal, arrays([5, 5]), [((0, 2),)], tasks=["low"], nominal_tasks=tasks), SCORE
    )
    assert found["auc_pool"].value == 1
    assert found["auc_pool"].denominator[5:10].tolist() == [0] * 5  # of the other task
    other = cell(nominal, arrays([5, 5]), [((0, 2),)], tasks=["none"], nominal_tasks=tasks)
    assert separability(other, SCORE)["auc_pool"].n == 0


def test_auc_of_rows_is_inside_one_episode_and_needs_both_kinds():
    anomalous = arrays([0, 1, 2, 3], [5, 5], [1, 0])
    found = separability(cell([], anomalous, [((1, 3),), ((0, 2),), ()]), SCORE)["auc_rows"]
    # 1 and 2 against 0 and 3: above 0 twice, below 3 twice.
    assert found.numerator.tolist() == [0.5, 0, 0]
    assert found.denominator.tolist() == [1, 0, 0]


def test_outcomes_are_compared_up_to_the_shortest_length_of_the_task():
    nominal = arrays([0, 2, 0], [0, 4, 9, 9])
    failed = arrays([3, 0, 0, 99], [0, 0])
    found = separability(cell(nominal, failed, [(), ()]), SCORE)
    # Two rows of each: 3 and 0 against 2 and 4.
    assert found["auc_outcome"].value == pytest.approx((0.5 + 0) / 2)
    alarms = unpaired_alarms(cell(nominal, failed, [(), ()]), GuaranteedAlarm(None, 2.5), None)
    assert alarms["found_outcome"].numerator.tolist() == [0, 0, 1, 0]
    assert alarms["found_outcome_null"].numerator.tolist() == [0, 1, 0, 0]
    assert alarms["found_outcome"].value == alarms["found_outcome_null"].value == 0.5
    assert not alarms.keys() & {"missed", "delay", "events_found", "auc_rows"}


def test_nulls_count_tasks_as_often_as_these_have_anomalous_episodes():
    """What knows the time alone finds no more than its null, however failures are spread."""
    lengths = {"short": 3, "long": 9}
    nominal_tasks, tasks = ["short"] * 6 + ["long"] * 2, ["short"] + ["long"] * 5
    nominal, failed = (
        [np.arange(lengths[t], dtype=np.float64) for t in names] for names in (nominal_tasks, tasks)
    )
    rule = GuaranteedAlarm(None, 5.0)
    case = cell(nominal, failed, [()] * 6, tasks=tasks, nominal_tasks=nominal_tasks)
    alarms = unpaired_alarms(case, rule, None)
    assert alarms["found_outcome"].value == pytest.approx(5 / 6)
    assert alarms["found_outcome_null"].value == pytest.approx(5 / 6)
    assert alarms["false_episodes"].value == 2 / 8
    labelled = dataclasses.replace(case, intervals=[((2, 3),)] * 6)
    alarms = unpaired_alarms(labelled, rule, None)
    for name in ("missed", "delay", "delay_censored", "found_within_20"):
        assert alarms[name].value == pytest.approx(alarms[f"{name}_null"].value)
    # In one task all count alike.
    one = unpaired_alarms(cell(nominal, failed, [()] * 6), rule, None)["found_outcome_null"]
    assert set(one.denominator[:8]) == {1.0}


def test_delays_count_from_the_first_interval():
    anomalous = arrays(
        [0, 0, 2, 2, 0, 2], [2, 0, 0, 0], [0] * 6, [0, 0, 0, 0, 0, 9], [0, 0, 2, 0], [0, 0]
    )
    labels = [((1, 3), (5, 6)), ((2, 4),), ((4, 5),), ((1, 2),), ((-1, 2),), ((-1, 1),)]
    nominal = arrays([0] * 5, [0, 0, 0, 3, 0], [0], [5, 0, 0])
    found = unpaired_alarms(cell(nominal, anomalous, labels), ABOVE_ONE, rate=2.0)

    def terms(name):
        both = zip(found[name].numerator, found[name].denominator, strict=True)
        return [top if bottom else None for top, bottom in both]

    none = [None] * 4
    assert terms("early") == [*none, 0, 1, 0, 0, None, None]
    assert terms("delay") == [*none, 1, None, None, 4, None, None]
    assert terms("delay_censored") == [*none, 1, None, 2, 4, None, None]
    # Where the start is not known an episode can be missed, and nothing else.
    assert terms("missed") == [*none, 0, None, 1, 0, 0, 1]
    assert terms("found_within_20") == [*none, 1, None, 0, 1, None, None]
    # Nominal episodes take the known starts in turn: 1, 2, 4, 1.
    assert terms("early_null")[:4] == [0, 0, 0, 1]
    assert terms("delay_censored_null")[:4] == [4, 1, None, None]
    assert terms("found_within_100_null")[:4] == [0, 1, None, None]
    # Alarms begin at 2 and 5; at 0; never; at 5; at 2, after the interval; never.
    assert found["events_found"].numerator[4:].tolist() == [2, 0, 0, 0, 0, 0]
    assert found["events_found"].denominator[4:].tolist() == [2, 1, 1, 1, 1, 1]
    assert terms("false_episodes") == [0, 1, 0, 1] + [None] * 6
    # Two alarms in 14 rows at 2 a second.
    assert found["false_alarms_per_hour"].value == pytest.approx(2 / (14 / 2 / 3600))


def test_an_alarm_that_lasts_begins_once_and_rows_without_score_take_no_time():
    scores = arrays([NAN, 2, 2, 0, 2, 2])
    found = unpaired_alarms(cell(scores, scores, [((2, 4),)]), ABOVE_ONE, rate=1.0)
    assert found["false_alarms_per_hour"].numerator.tolist() == [2, 0]
    assert found["false_alarms_per_hour"].denominator.tolist() == [5 / 3600, 0]
    assert found["events_found"].value == 0  # it began before
    assert "false_alarms_per_hour" not in unpaired_alarms(
        cell(scores, scores, [((2, 4),)]), ABOVE_ONE, rate=None
    )


def test_row_metrics_pool_rows_with_a_score():
    anomalous = arrays([NAN, 2, 0, 2, 0], [2, 2], [5, 5])
    found = row_metrics(cell([], anomalous, [((3, 5),), ((0, 1),), ()]), ABOVE_ONE)
    # Hits 1 + 1, missed 1 + 0, false 1 + 1, quiet 1 + 0; the third is known by its outcome alone.
    assert found["f1_rows"].value == pytest.approx(2 * 2 / (2 * 2 + 2 + 1))
    assert found["far_rows"].value == pytest.approx(2 / 3)
    assert found["mar_rows"].value == pytest.approx(1 / 3)
    assert found["vus_pr"].denominator.tolist() == [1, 1, 0]
    assert row_metrics(cell([], anomalous, [(), (), ()]), ABOVE_ONE) == {}
    assert [*row_metrics(cell([], anomalous, [((3, 5),)] * 3), None)] == ["vus_pr"]


# -- VUS-PR, threshold by threshold ---------------------------------------------------------------


def slow_volume(scores, anomalous, buffer, thresholds=250):
    """The definition of TSB-AD, a threshold and a width at a time."""
    n, labels = len(scores), anomalous.astype(float)
    events, t = [], 0
    while t < n:
        if labels[t]:
            start = t
            while t < n and labels[t]:
                t += 1
            events.append((start, t - 1))
        t += 1
    areas = []
    for width in range(buffer + 1):
        half, extended = width // 2, labels.copy()
        for start, end in events:
            for t in range(end + 1, min(end + half + 1, n)):
                extended[t] += math.sqrt(1 - (t - end) / width)
            for t in range(max(start - half, 0), start):
                extended[t] += math.sqrt(1 - (start - t) / width)
        extended = np.minimum(extended, 1)
        merged = [[max(events[0][0] - half, 0), events[0][1] + half]]
        for start, end in events[1:]:
            if merged[-1][1] < start - half:
                merged.append([start - half, end + half])
            else:
                merged[-1][1] = end + half
        curve = [(0.0, 1.0)]
        for k in np.linspace(0, n - 1, thresholds).astype(int):
            alarm = scores >= sorted(scores, reverse=True)[k]
            weights = np.where(anomalous, 1.0, extended * alarm)
            positive = (labels.sum() + weights.sum()) / 2
            hits = float((weights * alarm).sum())
            touched = np.mean([alarm[a : min(b, n - 1) + 1].any() for a, b in merged])
            curve.append((min(hits / positive, 1) * touched, hits / alarm.sum()))
        areas.append(sum((r - s) * p for (s, _), (r, p) in itertools.pairwise(curve)))
    return np.mean(areas)


@pytest.mark.parametrize("seed", range(6))
def test_vus_pr_is_that_of_the_slow_formula(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(12, 90))
    truth = np.zeros(n, dtype=bool)
    for start in rng.integers(0, n, size=3):
        truth[start : start + rng.integers(1, 6)] = True
    scores = np.round(rng.normal(size=n) + truth, 1)
    expected = slow_volume(scores, truth, 12)
    assert volume_under_pr(scores, truth, 12) == pytest.approx(expected, abs=1e-12)


def test_vus_pr_of_a_perfect_score_and_of_rows_of_one_kind():
    truth = np.zeros(200, dtype=bool)
    truth[80:120] = True
    assert volume_under_pr(truth.astype(float), truth, 0) == 1.0
    assert volume_under_pr(-truth.astype(float), truth, 0) < 0.3
    assert math.isnan(volume_under_pr(np.zeros(9), np.zeros(9, dtype=bool)))
    assert math.isnan(volume_under_pr(np.zeros(9), np.ones(9, dtype=bool)))


# -- intervals of two samples ---------------------------------------------------------------------


def pool_of(nominal, anomalous):
    """auc_pool of episodes of one row each."""
    rows = [[np.array([x]) for x in part] for part in (nominal, anomalous)]
    return separability(cell(*rows, [((0, 1),)] * len(anomalous)), SCORE)["auc_pool"]


def test_resamples_vary_as_delong_says():
    rng = np.random.default_rng(5)
    nominal, anomalous = rng.normal(size=30), rng.normal(0.7, 1.5, size=50)
    pairs = (anomalous[:, None] > nominal) + 0.5 * (anomalous[:, None] == nominal)
    above, below = pairs.mean(axis=1), pairs.mean(axis=0)
    terms = pool_of(nominal, anomalous)
    assert terms.value == pytest.approx(pairs.mean())
    samples = cell_samples("arm", terms, "slip")
    # Resamples divide by n where DeLong's unbiased estimate divides by n - 1.
    assert samples.var() == pytest.approx(above.var() / 50 + below.var() / 30, rel=0.1)
    # And to first order they are those of resampled episodes.
    drawn = [bootstrap_weights(30, key="arm"), bootstrap_weights(50, key="arm/slip")]
    exact = np.einsum("ri,ij,rj->r", drawn[1], pairs, drawn[0]) / 1500
    assert np.corrcoef(samples, exact)[0, 1] > 0.99


def test_an_undefined_episode_is_left_out_of_both_sides():
    nominal = [np.array([x]) for x in (1.0, 2.0, 3.0, 4.0, 5.0)]
    anomalous = arrays([3], [NAN], [9])
    found = separability(cell(nominal, anomalous, [((0, 1),)] * 3), SCORE)["auc_pool"]
    assert found.n == 7
    assert found.value == pytest.approx((0.5 + 1) / 2)
    sides = found.denominator[:5].sum(), found.denominator[5:].sum()
    assert sides[0] == pytest.approx(sides[1])
    assert found.denominator[6] == 0


def test_at_an_end_the_smaller_sample_has_the_exact_interval():
    apart = pool_of(np.arange(6.0), np.arange(10.0, 13.0))
    ends = mean_interval([drawn_cell("arm", 0, apart, "slip")], kind="share")
    assert ends == clopper_pearson(3, 3)
    # Five conditions against the same six nominal episodes are no fifteen trials.
    several = [drawn_cell("arm", 0, apart, f"slip{k}") for k in range(5)]
    assert mean_interval(several, kind="share") == clopper_pearson(6, 6)


def test_ends_stay_in_the_range_of_the_metric():
    nearly = pool_of(np.array([0.0, 1, 2, 3, 9]), np.array([4.0, 5, 6, 10]))
    low, high = mean_interval([drawn_cell("arm", 0, nearly, "slip")], kind="share")
    assert cell_samples("arm", nearly, "slip").max() > 1
    assert 0 <= low <= nearly.value <= high <= 1


def test_nominal_draws_are_shared_between_conditions_and_anomalous_ones_are_not():
    rng = np.random.default_rng(1)
    quiet = Contribution(np.append(rng.normal(size=8), np.zeros(5)), np.repeat([1.0, 0], [8, 5]),
                         nominal=8)  # fmt: skip
    loud = Contribution(np.append(np.zeros(8), rng.normal(size=5)), np.repeat([0, 1.0], [8, 5]),
                        nominal=8)  # fmt: skip
    for terms, same in ((quiet, True), (loud, False)):
        both = [cell_samples("arm", terms, condition) for condition in ("slip", "jam")]
        assert np.array_equal(*both) == same
    cells = [drawn_cell("arm", 0, quiet, condition) for condition in ("slip", "jam")]
    assert mean_interval(cells, kind="mean") == mean_interval(cells[:1], kind="mean")


def test_no_false_alarm_has_the_exact_interval_of_poisson():
    hours = Contribution(np.zeros(4), np.array([1.0, 0.5, 0.5, 0]), nominal=3)
    low, high = mean_interval([drawn_cell("arm", 0, hours, "slip")], kind="count")
    assert (low, high) == (0.0, pytest.approx(-math.log(0.025) / 2))
    some = Contribution(np.array([1.0, 0, 2, 0]), np.array([1.0, 0.5, 0.5, 0]), nominal=3)
    low, high = mean_interval([drawn_cell("arm", 0, some, "slip")], kind="count")
    assert low < 1.5 < high


@pytest.mark.parametrize(("m", "n"), [(20, 20), (12, 40), (40, 12)])
def test_intervals_contain_the_true_auc_in_95_of_100_cases(m, n):
    rng, inside, problems = np.random.default_rng([m, n]), 0, 400
    truth = 0.5 * (1 + math.erf(1 / 2))  # P(N(1, 1) > N(0, 1))
    for _ in range(problems):
        terms = pool_of(rng.normal(size=m), rng.normal(1, 1, size=n))
        low, high = mean_interval([drawn_cell("arm", 0, terms, "slip")], kind="share")
        inside += low <= truth <= high
    # Three standard errors of 95 %, and a point for the approximation.
    assert abs(inside / problems - 0.95) < 3 * math.sqrt(0.95 * 0.05 / problems) + 0.01


# -- ranks ----------------------------------------------------------------------------------------


def rows_of(shifts, metric=pool_of, m=20, n=25):
    rng = np.random.default_rng(0)
    noise = [rng.normal(size=m), rng.normal(size=n), rng.normal(size=n)]
    return {
        name: {0: {
            ("arm", kind): metric(noise[0], noise[k] + shift)
            for k, kind in ((1, "slip"), (2, "jam"))
        }}
        for name, shift in shifts.items()
    }  # fmt: skip


def test_rows_without_twins_are_told_apart_by_both_samples():
    rows = rows_of({"good": 1.5, "poor": 0.0, "same": 1.5})
    told, equal = differences(rows, [("good", "poor"), ("good", "same")], resamples=2000)
    assert told.told_apart
    assert told.low < told.difference < told.high
    assert (equal.low, equal.high, equal.told_apart) == (0.0, 0.0, False)


def test_rows_of_other_samples_cannot_be_compared():
    rows = rows_of({"one": 1.0}) | rows_of({"two": 1.0}, m=21, n=24)
    with pytest.raises(ResultsError, match="test trajectories in arm/"):
        differences(rows, [("one", "two")])


def test_a_metric_of_anomalous_episodes_is_compared_with_one_nominal_episode():
    def delays(_, anomalous):
        both = np.append(0.0, -anomalous), np.append(0.0, np.ones(len(anomalous)))
        return Contribution(*both, nominal=1)

    rows = rows_of({"slow": 3.0, "fast": 0.0}, delays)
    (test,) = differences(rows, [("fast", "slow")], resamples=2000)
    assert test.low > 0


# -- from a split to tables -----------------------------------------------------------------------

KINDS = {"slip": [((30, 45),), ((-1, 20),), ((10, 20), (40, 50))], "fail": [()] * 4}


@pytest.fixture(scope="module")
def split(tmp_path_factory):
    facts = LogFacts(paired=False, rate=2.0)
    return make_log_split(tmp_path_factory.mktemp("logs") / "arm", facts, anomalies=KINDS)


def test_a_run_scores_an_unpaired_split_and_show_recomputes_it(split, tmp_path, capsys):
    output = tmp_path / "results"
    command = ["run", "--detector", "clock,mahalanobis", "--env", "all", "--split", str(split)]
    assert main([*command, "--output", str(output)]) == 0
    records = load_results(output, split).records
    assert len(records) == 4
    for record in records:
        n = len(KINDS[record.anomaly])
        assert record.counts == {"train": 6, "calibration": 40, "nominal": 8, "test": n}
        assert (record.paired, record.note, record.ok) == (False, "", True)
        assert all(len(terms[0]) == 8 + n for terms in record.per_trajectory.values())
        assert Record.from_json(record.to_json()) == record
        assert not {"f1_rows", "vus_pr", "auc_matched", "far"} & record.metrics.keys()
        assert all(metric_info(name).cells != "paired" for name in record.metrics)
        assert ("auc_outcome" in record.metrics) == (record.anomaly == "fail")
        assert ("auc_rows" in record.metrics) == (record.anomaly == "slip")
        assert record.value("false_alarms_per_hour_at_5pct") >= 0
    clock = [r for r in records if r.detector == "clock"]
    assert [r.value("auc_pool") for r in clock] == [0.5, 0.5]
    assert [r.value("auc_outcome") for r in clock if r.anomaly == "fail"] == [0.5]
    assert [r.value("auc_pool") for r in records if r not in clock and r.anomaly == "slip"] == [1.0]
    before = (output / "records.jsonl").read_text()
    capsys.readouterr()
    assert main(["show", str(output), "--split", str(split)]) == 0
    assert "arm" in capsys.readouterr().out
    assert (output / "records.jsonl").read_text() == before
    again = evaluate(["clock", "mahalanobis"], split, output=output)
    for first, second in zip(records, again.records, strict=True):
        assert repr(first.metrics) == repr(second.metrics)


def test_row_metrics_are_computed_when_asked_for(split, tmp_path, capsys):
    output = tmp_path / "results"
    names = {"f1_rows", "far_rows", "mar_rows", "vus_pr"}
    plain = evaluate("mahalanobis", split, anomalies="slip", output=output)
    assert not names & plain[0].metrics.keys()
    asked = evaluate("mahalanobis", split, output=output, row_metrics=True)
    assert names <= asked[1].metrics.keys()
    assert asked[1].anomaly == "slip"
    assert not names & asked[0].metrics.keys()  # there are no intervals
    assert main(["show", str(output), "--split", str(split), "--row-metrics"]) == 0
    assert "VUS-PR" in capsys.readouterr().out


def test_a_split_with_nominal_episodes_alone_has_false_alarms_alone(tmp_path):
    facts = LogFacts(paired=False, rate=10.0)
    path = make_log_split(tmp_path / "arm", facts, anomalies={}, nominal=7)
    results = evaluate(local_spec("mahalanobis"), path)
    (record,) = results.records
    assert (record.anomaly, record.group, record.condition) == ("nominal", "", NOMINAL)
    assert record.counts == {"train": 6, "calibration": 40, "nominal": 7, "test": 0}
    bases = {name.partition("_at_")[0] for name in record.metrics}
    assert bases == {"false_episodes", "false_alarms_per_hour", "threshold"}
    assert record.metrics["false_episodes_at_5pct"].n == 7


def test_a_part_without_nominal_test_episodes_is_evaluated_as_far_as_it_can_be(tmp_path):
    path = make_log_split(tmp_path / "arm", nominal=0)
    (record,) = evaluate(local_spec("mahalanobis"), path).records
    assert record.ok
    assert record.value("auc_rows") == 1.0
    assert math.isnan(record.value("auc_pool"))
    assert record.value("events_found_at_5pct") > 0


def test_levels_that_need_more_calibration_episodes_are_left_out(tmp_path):
    path = make_log_split(tmp_path / "arm", calibration=30)
    records = evaluate([local_spec("mahalanobis"), local_spec("mewma")], path).records
    levels = {r.detector: {n.partition("_at_")[2] for n in r.metrics} - {""} for r in records}
    assert levels == {"mahalanobis": {"10pct"}, "mewma": {"10pct", "5pct"}}


def test_tasks_and_the_clock_are_those_of_the_split(tmp_path):
    parts = log_parts(anomalies={"slip": [((30, 45),)] * 4})
    for part, names in (("test/nominal", "aaaaaabb"), ("test/slip", "abba")):
        parts[part] = [
            dataclasses.replace(e, task=t) for e, t in zip(parts[part], names, strict=True)
        ]
    for clock, few in ((True, False), (False, True)):
        facts = dataclasses.replace(UNPAIRED, clock=clock)
        split = write_log_split(tmp_path / f"clock{clock}", parts, facts, name=f"c{int(clock)}")
        (record,) = evaluate(local_spec("mahalanobis"), split).records
        # Task b has two nominal episodes: too few to compare rows by the clock.
        denominators = record.per_trajectory["auc_pool"][1]
        expected = [True] * 6 + [few] * 2 + [True, few, few, True]
        assert (denominators > 0).tolist() == expected
        assert record.value("auc_pool") > 0.9


def test_a_mean_over_conditions_has_an_interval(split):
    records = evaluate(local_spec("mahalanobis"), split).records
    (board,) = boards(records)
    mean = board.mean(board.entries[0], ["arm"], board.anomalies, "auc_pool", intervals=True)
    assert mean.value == pytest.approx(np.mean([r.value("auc_pool") for r in records]))
    assert mean.low < mean.value < mean.high
    false = board.mean(
        board.entries[0], ["arm"], board.anomalies, "false_episodes_at_5pct", intervals=True
    )
    # Nominal episodes are the same under both conditions, and count once; calibration adds its own.
    low, high = clopper_pearson(8 * false.value, 8)
    assert 0 <= false.low <= low < high < false.high <= 1
    records = [dataclasses.replace(r, calibration_draws=CodedDraws()) for r in records]
    plain = boards(records)[0].mean(
        board.entries[0], ["arm"], board.anomalies, "false_episodes_at_5pct", intervals=True
    )
    assert (plain.low, plain.high) == (low, high)


def test_a_limit_takes_the_first_episodes_of_each_part(split):
    (record,) = evaluate(local_spec("mahalanobis"), split, anomalies="slip", limit=2).records
    assert record.counts == {"train": 2, "calibration": 2, "nominal": 2, "test": 2}
    with load_split(split).opened() as environment:
        data = environment("arm")
        assert counts_of(data, Condition("slip"), 2) == record.counts
        assert counts_of(data, Condition("fail"), None)["test"] == 4
        assert counts_of(data, NOMINAL, None)["test"] == 0


# -- imported logs with twins ---------------------------------------------------------------------


def imported(path, shift):
    """A recorded split as one that was imported; `shift` moves all rows of one anomaly."""
    make_split(path, ("cartpole",), name="mine")
    entry = read_manifest(path)["environments"]["cartpole"]
    with h5py.File(path / "cartpole.h5", "r+") as file:
        part = file["test/drift"]
        # Rows before the onset differ now, as those of another day do, so effects are onsets.
        part["observations"][:] = part["observations"][:] + shift
        part["effects"][:] = part["onsets"][:]
        entry["groups"]["test/drift"]["sha256"] = content_digest(part)
    entry["logs"] = {**dataclasses.asdict(LogFacts()), "offsets": []}
    entry["digest"] = environment_digest(entry)
    recipe = {"name": "mine", "source": "imported"}
    write_manifest(path, recipe, {"cartpole": entry}, 0, {})
    return path


def test_made_up_twins_are_refused_with_the_reason(tmp_path):
    """Episodes of another day differ before the onset as much as after it."""
    path = imported(tmp_path / "mine", shift=4.0)
    records = evaluate(local_spec("mahalanobis"), path, anomalies="drift,gravity").records
    assert [bool(r.note) for r in records] == [True, False]
    # The others are true twins, and keep their metrics.
    assert records[1].value("auc_before") == 0.5
    assert not math.isnan(records[1].value("auc_matched"))
    withheld = {"auc_matched", "auc_unpaired", "auc_smoothed"}
    assert not withheld & records[0].metrics.keys()
    assert not withheld & records[0].per_trajectory.keys()
    assert {"auc", "auc_placebo", "delay", "far"} <= records[0].metrics.keys()
    assert records[0].value("auc_before") > 0.9
    assert f"auc_before {records[0].value('auc_before'):.3f}" in records[0].note
    assert Record.from_json(records[0].to_json()).note == records[0].note
