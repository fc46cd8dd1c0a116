"""Metrics of outcomes: recomputed by independent code, their intervals, and what must hold."""

import dataclasses
import math

import numpy as np
import pytest
from helpers_logs import make_log_split
from hypothesis import given
from hypothesis import strategies as st

from oodd_eval import evaluate, load_split
from oodd_eval.data.facts import LogFacts
from oodd_eval.metrics.alarms import GuaranteedAlarm
from oodd_eval.metrics.bootstrap import cell_samples, drawn_cell, mean_interval
from oodd_eval.metrics.catalogue import metric_info
from oodd_eval.metrics.cusum import Standardization
from oodd_eval.metrics.unpaired import UnpairedScores, separability, unpaired_alarms
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.evaluate import rescore

NAN = math.nan
AUCS = ("auc_outcome", "auc_outcome_half", "auc_outcome_whole")
ALARMS = ("found_outcome", "found_outcome_null", "balanced_outcome", "outcome_time")


def arrays(*rows):
    return [np.array(row, dtype=np.float64) for row in rows]


def cell(nominal, failed, *, tasks=None, nominal_tasks=None, intervals=None):
    return UnpairedScores(
        nominal,
        failed,
        intervals or [()] * len(failed),
        nominal_tasks or [""] * len(nominal),
        tasks or [""] * len(failed),
    )


def computed(case, rule, **settings):
    """All metrics of outcomes of a cell."""
    return separability(case, rule, **settings) | unpaired_alarms(case, rule, None)


# -- definitions, episode by episode --------------------------------------------------------------


def running(scores, rule):
    """The statistic of alarms by row, in the loop of its definition."""
    if rule.standardization is None:
        return [-math.inf if math.isnan(s) else s for s in scores]
    total, sums = 0.0, []
    for s in scores:
        if math.isnan(s):
            sums.append(0.0)
            continue
        # Rounded as there, so that ties are ties.
        x = 0.01 * ((s - rule.standardization.mean) / rule.standardization.std)
        total = max(0.0, total + (x - 0.0018))
        sums.append(total)
    return sums


def defined(case, rule):
    """Every metric of outcomes by its definition, NaN where it has no value."""
    tasks = {}
    for task in set(case.tasks):
        good = [s for s, t in zip(case.nominal, case.nominal_tasks, strict=True) if t == task]
        labels = zip(case.anomalous, case.tasks, case.intervals, strict=True)
        bad = [s for s, t, intervals in labels if t == task and not intervals]
        if good and bad:
            tasks[task] = good, bad, min(len(s) for s in [*good, *bad])
    aucs, found, times, squares = {name: [] for name in AUCS}, [], [], []
    null = weight = 0.0
    for good, bad, shortest in tasks.values():
        for name, stop in zip(AUCS, (shortest, (shortest + 1) // 2, None), strict=True):
            for s in bad:
                pairs = [
                    (max(running(s, rule)[:stop]), max(running(other, rule)[:stop]))
                    for other in good
                ]
                aucs[name].append(np.mean([(a > b) + 0.5 * (a == b) for a, b in pairs]))
        for s in bad:
            alarms = [t for t in range(shortest) if running(s, rule)[t] > rule.threshold]
            found.append(bool(alarms))
            times.append(alarms[0] if alarms else shortest)
        false = [max(running(s, rule)[:shortest]) > rule.threshold for s in good]
        null, weight = null + len(bad) * np.mean(false), weight + len(bad)
        for outcome, episodes in ((0, good), (1, bad)):
            for s in episodes:
                rows = [(p - outcome) ** 2 for p in s[:shortest] if not math.isnan(p)]
                squares += [np.mean(rows)] if rows else []
    values = {name: np.mean(shares or [NAN]) for name, shares in aucs.items()}
    values["found_outcome"], values["outcome_time"] = (
        np.mean(found or [NAN]),
        np.mean(times or [NAN]),
    )
    values["found_outcome_null"] = null / weight if weight else NAN
    values["balanced_outcome"] = (values["found_outcome"] + 1 - values["found_outcome_null"]) / 2
    values["brier_outcome"] = np.mean(squares or [NAN])
    return values


@st.composite
def cells(draw):
    """Cells with ties, late first scores, and tasks without failures, successes or a name."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    m, n = draw(st.integers(1, 12)), draw(st.integers(1, 7))
    names = ["", "pick", "place"][: draw(st.integers(1, 3))]

    def scores():
        values = rng.integers(0, 5, size=rng.integers(1, 12)) / 4
        values[: rng.integers(0, 4)] = NAN
        return values

    return UnpairedScores(
        [scores() for _ in range(m)],
        [scores() for _ in range(n)],
        [((0, 1),) if rng.random() < 0.2 else () for _ in range(n)],
        [names[rng.integers(len(names))] for _ in range(m)],
        [names[rng.integers(len(names))] for _ in range(n)],
    )


RULES = (GuaranteedAlarm(None, 0.6), GuaranteedAlarm(Standardization(0.4, 0.3), 0.012))


@given(cells(), st.sampled_from(RULES))
def test_all_are_those_of_their_definitions(case, rule):
    metrics = computed(case, rule, supervised=True)
    if all(case.intervals):
        assert not {*AUCS, *ALARMS, "brier_outcome"} & metrics.keys()
        return
    for name, value in defined(case, rule).items():
        assert metrics[name].value == pytest.approx(value, nan_ok=True), name
        assert (metrics[name].nominal, len(metrics[name].numerator)) == (
            case.sizes[0],
            sum(case.sizes),
        )


@given(cells(), st.sampled_from(RULES), st.integers(0, 2**32 - 1))
def test_the_order_of_episodes_changes_nothing(case, rule, seed):
    rng = np.random.default_rng(seed)
    first, second = rng.permutation(case.sizes[0]), rng.permutation(case.sizes[1])
    mixed = UnpairedScores(
        [case.nominal[j] for j in first],
        [case.anomalous[i] for i in second],
        [case.intervals[i] for i in second],
        [case.nominal_tasks[j] for j in first],
        [case.tasks[i] for i in second],
    )
    before, after = (computed(c, rule, supervised=True) for c in (case, mixed))
    order = [*first, *(case.sizes[0] + second)]
    for name in {*AUCS, *ALARMS, "brier_outcome"} & before.keys():
        for terms in ("numerator", "denominator"):
            both = getattr(before[name], terms)[order], getattr(after[name], terms)
            assert both[1] == pytest.approx(both[0]), name


@given(cells(), st.sampled_from([0.0, 0.5, NAN]))
def test_a_score_that_is_the_same_everywhere_or_never_defined_tells_nothing(case, score):
    same = dataclasses.replace(
        case,
        nominal=[np.full(len(s), score) for s in case.nominal],
        anomalous=[np.full(len(s), score) for s in case.anomalous],
    )
    for threshold in (score, -1.0):  # no alarm, and one in every row with a score
        metrics = computed(same, GuaranteedAlarm(None, threshold), supervised=True)
        for name in {*AUCS, "balanced_outcome"} & metrics.keys():
            assert not metrics[name].n or metrics[name].value == 0.5, name
        if metrics.get("found_outcome") and metrics["found_outcome"].n:
            brier = metrics["brier_outcome"]
            late = math.isnan(score) or threshold == score
            times = defined(same, GuaranteedAlarm(None, threshold))["outcome_time"]
            assert metrics["outcome_time"].value == (pytest.approx(times) if late else 0.0)
            if math.isnan(score):
                assert not brier.n
            elif score:
                assert brier.value == 0.25


# -- numbers worked by hand -----------------------------------------------------------------------


def test_two_tasks_by_hand():
    nominal = arrays([0.1, 0.2, 0.1, 0.9], [0.1, 0.6, 0.1], [0.8] * 6)
    failed = arrays([0.3, 0.1, 0.7, 0.1, 0.1], [NAN, 0.9, 0.9, 0.9, 0.9, 0.9, 0.9, 0.9], [1, 1])
    case = cell(nominal, failed, nominal_tasks=["a", "a", "b"], tasks=["a", "b", "c"])
    metrics = computed(case, GuaranteedAlarm(None, 0.5), supervised=True)
    # Task a, 3 rows: .7 against .2 and .6; 2 rows: .3 against .2 and .6; whole: .7 against .9, .6.
    # Task b, 6 rows of both: .9 against .8. Task c has no success.
    values = {name: metrics[name].value for name in AUCS}
    assert values == {"auc_outcome": 1.0, "auc_outcome_half": 0.75, "auc_outcome_whole": 0.75}
    assert metrics["found_outcome"].value == 1.0
    # One of two in task a, the one of task b: each task has one failure.
    assert metrics["found_outcome_null"].value == 0.75
    assert metrics["balanced_outcome"].value == pytest.approx((1 + 0.25) / 2)
    assert metrics["outcome_time"].value == (2 + 1) / 2
    squares = [
        (0.01 + 0.04 + 0.01) / 3, (0.01 + 0.36 + 0.01) / 3, 0.64,
        (0.49 + 0.81 + 0.09) / 3, 0.01,
    ]  # fmt: skip
    assert metrics["brier_outcome"].value == pytest.approx(np.mean(squares))
    assert metrics["brier_outcome"].n == 5


def test_with_a_rolling_calibration_each_nominal_episode_has_its_own_threshold():
    nominal, failed = arrays([0, 1], [0, 2], [0, 3]), arrays([0, 5])
    earlier = [GuaranteedAlarm(None, threshold) for threshold in (0.5, 2.5, 4.5)]
    metrics = unpaired_alarms(cell(nominal, failed), GuaranteedAlarm(None, 4.5), None, earlier)
    assert metrics["found_outcome"].value == 1.0
    assert metrics["found_outcome_null"].value == pytest.approx(1 / 3)
    assert metrics["balanced_outcome"].value == pytest.approx((1 + 2 / 3) / 2)


def test_without_a_task_of_both_kinds_none_has_a_value():
    case = cell(arrays([0, 1]), arrays([1, 1]), nominal_tasks=["a"], tasks=["b"])
    metrics = computed(case, RULES[0], supervised=True)
    for name in (*AUCS, *ALARMS, "brier_outcome"):
        assert math.isnan(metrics[name].value), name
        assert len(metrics[name].numerator) == 2


def test_only_probabilities_of_rows_that_learn_from_failures_have_a_brier_score():
    nominal, failed = arrays([0, 1], [NAN, 0.5]), arrays([1, 1])
    assert "brier_outcome" in separability(cell(nominal, failed), RULES[0], supervised=True)
    assert "brier_outcome" not in separability(cell(nominal, failed), RULES[0])
    for above in (1.01, -0.01, math.inf):
        case = cell([*nominal, np.array([above])], failed)
        assert "brier_outcome" not in separability(case, RULES[0], supervised=True)


@given(st.integers(0, 2**32 - 1))
def test_the_length_alone_is_what_whole_episodes_give_the_clock(seed):
    rng = np.random.default_rng(seed)
    lengths = [rng.integers(2, 9, size=6), rng.integers(4, 12, size=5)]
    good, bad = ([np.arange(float(n)) for n in of_kind] for of_kind in lengths)
    metrics = separability(cell(good, bad), RULES[0])
    longer = (lengths[1][:, None] > lengths[0]) + 0.5 * (lengths[1][:, None] == lengths[0])
    assert metrics["auc_outcome_whole"].value == pytest.approx(longer.mean())
    assert metrics["auc_outcome"].value == metrics["auc_outcome_half"].value == 0.5


# -- intervals ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def example():
    """40 successful and 30 failed episodes of one task, somewhat apart."""
    rng = np.random.default_rng(5)
    nominal = [rng.beta(2, 5, size=rng.integers(20, 40)) for _ in range(40)]
    failed = [rng.beta(2.6, 4.6, size=rng.integers(30, 60)) for _ in range(30)]
    return cell(nominal, failed)


@pytest.mark.parametrize("name", [*AUCS, "balanced_outcome", "outcome_time", "brier_outcome"])
def test_intervals_are_those_of_drawing_episodes_of_both_kinds_again(example, name):
    rule, rng = GuaranteedAlarm(None, 0.65), np.random.default_rng(0)
    terms = computed(example, rule, supervised=True)[name]
    rows = min(len(s) for s in (*example.nominal, *example.anomalous))
    stop = {"auc_outcome_half": -(-rows // 2), "auc_outcome_whole": None}.get(name, rows)
    good, bad = (
        np.array([s[:stop].max() for s in part]) for part in (example.nominal, example.anomalous)
    )
    of_good, of_bad = (part > rule.threshold for part in (good, bad))
    firsts = np.array([
        next((t for t in range(rows) if s[t] > rule.threshold), rows) for s in example.anomalous
    ])  # fmt: skip
    squares = [
        np.array([np.mean((s[:rows] - y) ** 2) for s in part])
        for y, part in ((0, example.nominal), (1, example.anomalous))
    ]

    def value(j, i):
        if name in AUCS:
            return np.mean(bad[i][:, None] > good[j])
        if name == "balanced_outcome":
            return (of_bad[i].mean() + 1 - of_good[j].mean()) / 2
        if name == "outcome_time":
            return firsts[i].mean()
        return np.mean([*squares[0][j], *squares[1][i]])

    assert terms.value == pytest.approx(value(np.arange(40), np.arange(30)))
    draws = np.array([
        value(rng.integers(40, size=40), rng.integers(30, size=30)) for _ in range(4000)
    ])  # fmt: skip
    samples = cell_samples("arm", terms, "fail")
    assert samples.std() == pytest.approx(draws.std(), rel=0.06)
    kind = metric_info(f"{name}_at_5pct" if name in ALARMS else name).interval
    ends = mean_interval([drawn_cell("arm", 0, terms, "fail")], kind=kind)
    # Ends are corrected for bias and few episodes, and shares come in steps.
    low, high = np.percentile(draws, [2.5, 97.5])
    assert ends[0] == pytest.approx(low, abs=0.7 * draws.std())
    assert ends[1] == pytest.approx(high, abs=0.7 * draws.std())
    assert 0.9 < (ends[1] - ends[0]) / (high - low) < 1.25


def test_both_kinds_have_half_of_the_weight_of_balanced_accuracy(example):
    terms = computed(example, GuaranteedAlarm(None, 0.65))["balanced_outcome"]
    sides = terms.denominator[:40].sum(), terms.denominator[40:].sum()
    assert sides[0] == pytest.approx(sides[1])
    assert 0.5 < terms.value < 1


# -- in records -----------------------------------------------------------------------------------


def test_records_have_them_with_intervals_and_without_them_stay_what_they_are(tmp_path):
    facts = LogFacts(paired=False, rate=2.0)
    path = make_log_split(tmp_path / "arm", facts, anomalies={"fail": [()] * 6})
    output = tmp_path / "results"
    (record,) = evaluate("random", path, output=output).records
    levels = {f"{name}_at_5pct" for name in ALARMS}
    assert {*AUCS, *levels} <= record.metrics.keys()
    assert "brier_outcome" not in record.metrics
    for name in ("balanced_outcome_at_5pct", "outcome_time_at_5pct"):
        assert name in record.calibration_draws
        metric = record.metrics[name]
        assert metric.low <= metric.value <= metric.high
    # The same scores, declared to be learnt from failures: uniform on 0 to 1, so a third.
    supervised = dataclasses.replace(record, training="failures")
    (again,) = rescore([supervised], ResultsDirectory(output), load_split(path))
    assert again.metrics.keys() - record.metrics.keys() == {"brier_outcome"}
    assert again.value("brier_outcome") == pytest.approx(1 / 3, abs=0.05)
    assert again.metrics["brier_outcome"].n == 8 + 6
    assert type(again).from_json(again.to_json()) == again
