"""Results as scripts and notebooks use them: rows, comparisons, episodes, plots, and `evaluate`."""

import gc
import re

import numpy as np
import pytest

from oodd_eval import DetectorSpec, evaluate, load_results, load_split
from oodd_eval.errors import MissingExtraError, ResultsError, UnknownNameError, UsageError

CELLS = {"environments": ["hopper", "cartpole"], "anomalies": "iid,gravity"}


class Size:
    """The largest reading of a row, in nominal standard deviations."""

    def __init__(self, scale=1.0):
        self.scale = scale

    def fit(self, nominal):
        rows = np.concatenate([x.observations for x in nominal]).astype(float)
        self.mean, self.std = rows.mean(axis=0), rows.std(axis=0) + 1e-9
        return self

    def score(self, trajectory):
        return self.scale * np.abs((trajectory.observations - self.mean) / self.std).max(axis=1)


@pytest.fixture(scope="module")
def results(tiny_split):
    return evaluate(["mewma", "range", Size()], tiny_split, **CELLS)


# What evaluate takes


def test_detectors_come_by_name_class_instance_function_and_spec(tiny_split):
    class Made(Size):
        def __init__(self, seed, horizon, scale=2.0):
            super().__init__(scale)

    def grown(seed, horizon):
        return Size(3.0)

    spec = DetectorSpec("named", lambda seed, horizon: Size(4.0), "", inputs="observations")
    tried = ["range", Made, Size(), grown, spec]
    found = evaluate(tried, tiny_split, environments="hopper", anomalies="iid")
    assert found.rows == ("range", "made", "size", "grown", "named")
    scores = [found.scores("hopper", "iid", row=name).scores for name in found.rows[1:]]
    for factor, own in zip((2, 1, 3, 4), scores, strict=True):
        np.testing.assert_allclose(own, factor * scores[1])


@pytest.mark.parametrize(
    ("detector", "parameters", "message"),
    [
        ([], {}, "no detector was named"),
        (5, {}, "5 is no detector: expected a name, a DetectorSpec, a class or function"),
        (Size, {}, r"Size cannot be called as Size\(seed=..., horizon=..., ...\): .* 'seed'"),
        (Size(), {"scale": 2}, r"parameters \['scale'\] for an instance of Size"),
        ([Size(), Size()], {}, r"detectors \['size', 'size'\]: expected a name for each"),
        ("rangee", {}, "unknown detector 'rangee': did you mean 'range'"),
    ],
)
def test_what_is_no_detector_is_told(tiny_split, detector, parameters, message):
    with pytest.raises(UsageError, match=message):
        evaluate(detector, tiny_split, parameters=parameters)


def test_seeds_and_jobs_change_no_score(tiny_split):
    one, two = (
        evaluate(["random", "range"], tiny_split, environments="hopper", seed=[0, 1], jobs=jobs)
        for jobs in (1, 2)
    )
    # As text, in which an undefined figure equals itself.
    assert str([r.metrics for r in one]) == str([r.metrics for r in two])
    assert {r.seed for r in one} == {0, 1}


def test_scores_are_kept_as_long_as_the_results(tiny_split):
    found = evaluate("range", tiny_split, environments="hopper", anomalies="iid")
    place = found._directory.path
    assert place.is_dir()
    del found
    gc.collect()
    assert not place.exists()


# What results have


def test_results_are_a_sequence_of_records(results):
    assert len(results) == len(list(results)) == 12
    assert results[0].environment == "hopper"
    assert len(results[:4]) == 4
    assert re.fullmatch(r"Results\(2 cells of tiny\S*: mewma; 2 ok\)", repr(results[:2]))
    assert results.ok
    html = results._repr_html_()
    assert "matched AUC" in html
    assert len(html) < 20_000


def test_means_are_those_of_the_tables(results):
    own = [r.value("auc_matched") for r in results if r.detector == "mewma"]
    assert results.mean(row="mewma") == pytest.approx(np.mean(own))
    with pytest.raises(UsageError, match="3 rows, expected the name of one: mewma, range, size"):
        results.mean()
    with pytest.raises(UnknownNameError, match="unknown metric 'acu'"):
        results.mean("acu", "mewma")
    with pytest.raises(UnknownNameError, match="unknown metric 'acu'"):
        results[0].value("acu")


def test_frames_have_a_line_a_cell(results, monkeypatch):
    rows = results.to_rows()
    assert [row["auc_matched"] for row in rows] == [r.value("auc_matched") for r in results]
    assert all(row.keys() == rows[0].keys() for row in rows)
    pandas = pytest.importorskip("pandas")
    assert results.to_frame().equals(pandas.DataFrame(rows))
    monkeypatch.setitem(__import__("sys").modules, "pandas", None)
    with pytest.raises(MissingExtraError, match="to_frame needs pandas: pip install pandas"):
        results.to_frame()


def test_an_episode_is_that_of_the_split_with_its_scores(results, tiny_split):
    data, i = load_split(tiny_split).environment("hopper"), 1
    found = results.scores("hopper", "gravity", i, row="size")
    known = data.anomalous("gravity")
    np.testing.assert_array_equal(found.trajectory.observations, known[i].observations)
    np.testing.assert_array_equal(found.twin.observations, data.twins[i].observations)
    assert (found.onset, found.effect) == (known.onsets[i], known.effects[i])
    detector = Size().fit(list(data.train))
    np.testing.assert_allclose(found.scores, detector.score(known[i]))
    np.testing.assert_allclose(found.twin_scores, detector.score(data.twins[i]))
    assert "index=1" in repr(found)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("ant", "iid", 0), "unknown environment of these results 'ant'"),
        (("hopper", "drift", 0), "unknown anomaly of these results in hopper 'drift'"),
        (("hopper", "iid", 99), "hopper/iid has no episode 99: expected 0 to"),
        (("hopper", "iid", -1), "hopper/iid has no episode -1"),
    ],
)
def test_an_episode_that_is_not_there_is_told(results, given, message):
    with pytest.raises(UsageError, match=message):
        results.scores(*given, row="range")
    with pytest.raises(UsageError, match=r"no detector seed 7: expected one of \[0\]"):
        results.scores("hopper", "iid", row="range", seed=7)


def test_alarms_and_delays_are_those_of_the_record():
    found = evaluate("range", environments="hopper", anomalies="iid,gravity")
    for record in found:
        own = [found.scores("hopper", record.anomaly, i) for i in range(record.counts["test"])]
        numerators, n = record.per_trajectory["missed_at_5pct"]
        delays = np.array([e.delay() for e in own])
        np.testing.assert_array_equal(~np.isnan(delays), np.array(n) > 0)
        np.testing.assert_array_equal(np.isinf(delays), np.array(numerators) > 0)
        false = [e.rule.first(e.twin_scores) is not None for e in own]
        assert np.mean(false) == record.value("false_episodes_at_5pct")
    figure = found.plot_power()
    assert figure.axes[0].lines[0].get_label() == "range"
    assert own[0].alarm == own[0].rule.first(own[0].scores)


def test_results_are_loaded_again(tiny_split, tmp_path):
    evaluate("range", tiny_split, output=tmp_path / "out", **CELLS)
    found = load_results(tmp_path / "out", tiny_split)
    assert found.rows == ("range",)
    assert found.scores("hopper", "iid").scores.shape
    for file in (tmp_path / "out" / "scores").glob("*.h5"):
        file.unlink()
    with pytest.raises(ResultsError, match="no scores that fit the split"):
        found.scores("hopper", "iid")
    with pytest.raises(ResultsError, match="no results in"):
        load_results(tmp_path)


# Comparisons


def test_a_comparison_says_which_row_is_better_and_turns_with_its_sides(results):
    one, other = results.compare("mewma", "size"), results.compare("size", "mewma")
    assert one.difference == pytest.approx(-other.difference)
    assert (one.low, one.high) == pytest.approx((-other.high, -other.low))
    assert one.values == pytest.approx(other.values[::-1])
    assert one.p == other.p
    assert one.cells == 4
    assert one.verdict == other.verdict or one.p > 0.05
    assert str(one).startswith("matched AUC: mewma ")
    lower = results.compare("mewma", "size", "delay_censored")
    assert lower.difference == pytest.approx(lower.values[0] - lower.values[1])
    assert lower.p > 0.05 or lower.verdict.startswith("mewma" if lower.difference < 0 else "size")


@pytest.mark.parametrize(
    ("rows", "metric", "message"),
    [
        (("mewma", "rf"), "auc_matched", "unknown row of these results 'rf'"),
        (("mewma", "mewma"), "auc_matched", "are the same row"),
        (("mewma", "size"), "acu", "unknown metric 'acu'"),
        (("mewma", "size"), "threshold_at_10pct", "rows cannot be compared by"),
    ],
)
def test_what_cannot_be_compared_is_told(results, rows, metric, message):
    with pytest.raises(UsageError, match=message):
        results.compare(*rows, metric)


# Plots


def test_an_episode_is_drawn_with_its_sensors_and_alarm(results):
    pytest.importorskip("matplotlib")
    figure = results.plot_trajectory("hopper", "iid", row="size")
    upper, lower = figure.axes
    assert upper.get_title().endswith("/hopper/iid::size[h=1,seed=0]")
    assert len(upper.lines) == 7
    shown = [line.get_label() for line in lower.lines]
    assert shown[:3] == ["nominal twin", "anomalous", "onset"]


def test_plots_without_matplotlib_name_the_extra(results, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "matplotlib", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'oodd-eval\[plots\]'"):
        results.plot_trajectory("hopper", "iid", row="size")


def test_parameters_are_for_all_detectors_or_for_one(tiny_split):
    where = {"environments": "cartpole", "anomalies": "iid"}
    for parameters in ({"rf": {"trees": 2}}, {"rf.trees": 2}):
        results = evaluate(["clock", "rf"], tiny_split, **where, parameters=parameters)
        assert results.rows == ("clock", "rf[trees=2]")
    with pytest.raises(UsageError, match=r"clock has none of that name: write rf\.trees"):
        evaluate(["clock", "rf"], tiny_split, **where, parameters={"trees": 2})
