"""Recorded columns as detectors: names, scores row by row, the kit, and logs from end to end."""

import numpy as np
import pytest
from oodd_checks.testing import run_checks
from oodd_columns import oodd_detector_from_spec
from oodd_logs import import_frames

from oodd_eval import Trajectory, evaluate
from oodd_eval.errors import FittedStateError, TrajectoryError, UsageError
from oodd_eval.metrics.alarms import GuaranteedAlarm
from oodd_eval.plugins.contract import copied, make_detector
from oodd_eval.plugins.discovery import discover

VALUES = np.array([0.5, -2.0, 0.0, 1e-30, 3.25, -1.0], np.float32)
SCORES = {
    "column:x": VALUES.tolist(),
    "column:-x": [-0.5, 2.0, 0.0, -float(VALUES[3]), -3.25, 1.0],
    "column:|x|": [0.5, 2.0, 0.0, float(VALUES[3]), 3.25, 1.0],
    "column:-abs(x)": [-0.5, -2.0, 0.0, -float(VALUES[3]), -3.25, -1.0],
    "flag:x": [1, 1, 0, 1, 1, 1],
    "mean:x": [0.5, -0.75, -0.5, -0.375, 0.35, 0.125],
    "mean:|x|": [0.5, 1.25, 2.5 / 3, 0.625, 1.15, 6.75 / 6],
}


def made(name, baseline=0):
    """Make a detector as the harness does."""
    spec = discover().offer(name).spec
    return make_detector(spec.factory, seed=3, horizon=4, parameters={}, baseline=baseline)


def of(values):
    return Trajectory(np.reshape(values, (-1, 1)))


@pytest.mark.parametrize("name", SCORES)
@pytest.mark.parametrize("baseline", [0, 3])
def test_scores_of_an_episode_and_row_by_row_are_the_recorded_numbers(name, baseline):
    detector = made(name, baseline)
    scores = detector.score(of(VALUES))
    assert scores.dtype == np.float64
    assert scores == pytest.approx(SCORES[name], rel=1e-12, abs=0)
    if not name.startswith("mean"):
        assert scores.tolist() == SCORES[name]
    detector.fit([of([9.0, 8.0])])
    for _ in range(2):  # a second episode begins anew
        detector.reset()
        twin = copied(detector)
        rows = [(detector.update(row), twin.update(row, None)) for row in of(VALUES).observations]
        assert np.array(rows).T.tolist() == [scores.tolist()] * 2


def test_the_mean_of_many_rows_is_that_of_the_stream_bit_for_bit():
    values = np.random.default_rng(0).normal(1e3, 1.0, 5000).astype(np.float32)
    detector = made("mean:x")
    scores = detector.score(of(values))
    assert [detector.update(row) for row in values[:, None]] == scores.tolist()
    assert scores[-1] == pytest.approx(float(values.astype(np.float64).mean()), rel=1e-12)


@pytest.mark.parametrize(
    ("name", "canonical", "column", "alarm"),
    [
        ("column:chunk_mse", "column:chunk_mse", "chunk_mse", "column"),
        ("column:|vel_innov[0]|", "column:abs(vel_innov[0])", "vel_innov[0]", "column"),
        ("column:abs(vel innov)", "column:abs(vel innov)", "vel innov", "column"),
        ("column:-/imu/data.x", "column:-/imu/data.x", "/imu/data.x", "column"),
        ("column:-|x|", "column:-abs(x)", "x", "column"),
        ("mean:-x", "mean:-x", "x", "column"),
        ("flag:fault", "flag:fault", "fault", "flag"),
        ("column:abs", "column:abs", "abs", "column"),
    ],
)
def test_a_name_says_the_column_and_how_it_counts(name, canonical, column, alarm):
    plugins = discover()
    spec = plugins.offer(name).spec
    assert (spec.name, spec.columns, spec.alarm) == (canonical, (column,), alarm)
    assert (spec.training, spec.inputs, spec.adapts) == ("nominal", "observations", "baseline")
    assert spec.deterministic
    assert plugins.offer(canonical).spec.name == canonical
    assert column in spec.summary


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("column:", "expected column:NAME, -NAME or abs"),
        ("column:-", "names no column"),
        ("mean:||", "expected mean:NAME"),
        ("column:|x", "names no column"),
        ("column:a:b", r'scores = \["new = old"\]'),
        ("column:größe", "names no column"),
        ("column:" + "x" * 121, "names no column"),
        ("flag:-x", "expected flag:NAME of letters"),
        ("flag:abs(x)", "expected flag:NAME of letters"),
    ],
)
def test_a_text_that_is_no_name_of_a_column_is_refused(name, message):
    with pytest.raises(UsageError, match=message):
        discover().offer(name)


def test_names_of_other_plugins_are_left_to_them():
    assert oodd_detector_from_spec("sklearn:IsolationForest") is None
    assert oodd_detector_from_spec("columns:x") is None
    forms = {name: form for name, _, form in discover().spec_forms()}
    assert forms["columns"].startswith("column:NAME, mean:NAME, flag:NAME: ")


def test_more_columns_than_one_are_refused():
    detector = made("column:x")
    with pytest.raises(TrajectoryError, match="got 2 columns, expected 1"):
        detector.score(Trajectory(np.zeros((3, 2))))
    with pytest.raises(TrajectoryError, match="got 2 columns, expected 1"):
        detector.update(np.zeros(2))
    with pytest.raises(TrajectoryError, match="not finite"):
        detector.update(np.array([np.nan]))


def test_a_state_of_another_detector_is_refused():
    detector = made("column:x")
    made("flag:y").restore(detector.state())  # there is nothing in it
    with pytest.raises(FittedStateError, match="column/1"):
        detector.restore({"kind": "mewma/1", "settings": {}})


@pytest.mark.parametrize("name", SCORES)
@pytest.mark.parametrize("horizon", [1, 4])
def test_the_kit_passes_it(name, horizon):
    report = run_checks(discover().offer(name).spec, horizon=horizon)
    assert report.ok, report
    skipped = {result.name for result in report.results if result.status == "skipped"}
    assert {"gross-anomaly", "baseline", "not-fitted"} <= skipped
    assert sum(result.status == "passed" for result in report.results) == 23


def recordings(n, seed, slip=False):
    """Tables of a sensor, an innovation with a heavy tail, and a filter's own alarm."""
    rng = np.random.default_rng(seed)
    for _ in range(n):
        innovation = rng.standard_t(3, size=80) + 12.0 * slip * (np.arange(80) >= 40)
        yield {
            "height": rng.normal(size=80),
            "innov": innovation,
            "tripped": 1.0 * (innovation > 9),
        }


def test_a_recorded_score_keeps_its_promise_from_logs_to_figures(tmp_path):
    calibration, nominal = [*recordings(39, 1)], [*recordings(20, 2)]
    slips = [*recordings(6, 3, slip=True)]
    split = import_frames(
        "flights", train=[*recordings(5, 0)], calibration=calibration,
        test={"nominal": nominal, "slip": slips}, onset=40,
        scores=["innov", "tripped"], output=tmp_path / "split", report=len,
    )  # fmt: skip
    column, flag = evaluate(["column:innov", "flag:tripped"], split)
    rows = {name: [x["innov"].astype(np.float32).astype(float) for x in part] for name, part in
            (("calibration", calibration), ("nominal", nominal), ("slip", slips))}  # fmt: skip
    # The 38th of 39 largest numbers: at most 2 of 40 healthy logs are above.
    threshold = sorted(x.max() for x in rows["calibration"])[37]
    assert column.metrics["threshold_at_5pct"].value == threshold
    assert GuaranteedAlarm.fit(rows["calibration"], 0.05, "column").threshold == threshold
    false = np.mean([x.max() > threshold for x in rows["nominal"]])
    assert column.metrics["false_episodes_at_5pct"].value == false
    firsts = [
        int(np.argmax(x > threshold)) if (x > threshold).any() else None for x in rows["slip"]
    ]
    late = [first for first in firsts if first is None or first >= 40]
    missed = np.mean([first is None for first in late])
    assert column.metrics["missed_at_5pct"].value == pytest.approx(missed)
    tripped = np.mean([(x["tripped"] > 0).any() for x in nominal])
    assert flag.metrics["false_episodes_at_5pct"].value == pytest.approx(tripped)
    assert (
        flag.metrics["false_episodes_at_5pct"].value
        == flag.metrics["false_episodes_at_10pct"].value
    )
