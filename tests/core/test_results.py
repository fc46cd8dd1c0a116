"""Results as scripts and notebooks use them: rows, comparisons, episodes, plots, and `evaluate`."""

import gc
import inspect
import re
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers_plugins import install, local_spec

from oodd_eval import DetectorSpec, evaluate, load_results, load_split
from oodd_eval.cli.main import main
from oodd_eval.errors import MissingExtraError, ResultsError, UnknownNameError, UsageError
from oodd_eval.results.collection import Results
from oodd_eval.scoring import display

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
    return evaluate([local_spec("mewma"), local_spec("range"), Size()], tiny_split, **CELLS)


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
        (Size, {"size": 1}, r"Size cannot be called as Size\(size=...\): .* 'size'"),
        (Size, {"seed": 1}, "expected no seed and horizon: they stand beside it"),
        (Size, {"scale": np.arange(2)}, "parameters is .* expected values that JSON knows"),
        (Size, [("scale", 1)], "parameters is .* expected values that JSON knows"),
        (Size(), {"scale": 2}, r"parameters \['scale'\] for an instance of Size"),
        ([Size(), Size()], {}, r"detectors \['size', 'size'\]: expected a name for each"),
        ("rangee", {}, "unknown detector 'rangee': did you mean 'range'"),
    ],
)
def test_what_is_no_detector_is_told(tiny_split, detector, parameters, message):
    with pytest.raises(UsageError, match=message):
        evaluate(detector, tiny_split, parameters=parameters)


class Bare:
    """The distance of the first sensor from its mean: two methods, and scores of float32."""

    def fit(self, nominal):
        self.mean = np.concatenate([x.observations for x in nominal])[:, 0].mean()

    def score(self, trajectory):
        return np.abs(trajectory.observations[:, 0] - self.mean)


class Listed(Bare):
    def __init__(self, horizon):
        self.horizon = horizon

    def score(self, trajectory):
        return [*map(float, super().score(trajectory))]


def test_a_class_with_fit_and_score_alone_is_enough(tiny_split, monkeypatch, tmp_path):
    code = f"{inspect.getsource(Bare)}\n@hookimpl\ndef oodd_detectors(): return offer(plugged=Bare)"
    install(monkeypatch, tmp_path, "bare", code)
    tried = [Bare, Listed, "plugged"]
    results = evaluate(tried, tiny_split, environments="hopper", anomalies="iid", seed=[0, 1])
    assert results.ok, [r.reason for r in results]
    train = load_split(tiny_split).environment("hopper").train
    mean = np.float32(np.mean(np.concatenate([x.observations[:, 0] for x in train]), dtype="f4"))
    for row in results.rows:
        episode = results.scores("hopper", "iid", row=row, seed=1)
        assert episode.scores.dtype == np.float64
        by_hand = [abs(float(o[0]) - mean) for o in episode.trajectory.observations]
        np.testing.assert_allclose(episode.scores, by_hand, atol=1e-6)


class Locked(Bare):
    """Holds what cannot be copied, from the beginning or from its fit on."""

    def __init__(self, *, early=True):
        self.fits = 0
        if early:
            self.lock = threading.Lock()

    def fit(self, nominal):
        super().fit(nominal)
        self.fits, self.lock = self.fits + 1, threading.Lock()


def test_installed_detectors_are_selected_as_on_the_command_line(tiny_split):
    one = {"environments": "cartpole", "anomalies": "iid"}
    results = evaluate(["cloc*", "comb, rang?", Size()], tiny_split, **one)
    assert [*results.rows] == ["clock", "comb", "range", "size"]
    with pytest.raises(UnknownNameError, match="unknown detector 'nope"):
        evaluate("clock,nope*", tiny_split, **CELLS)


def test_progress_says_what_is_being_fitted(tiny_split, capsys, monkeypatch):
    class Slow(Size):
        def fit(self, nominal):
            time.sleep(0.5)
            return super().fit(nominal)

    monkeypatch.setattr(display, "SILENCE", 0.1)
    cells = {"environments": "hopper", "anomalies": "iid"}
    for progress in (True, False):
        evaluate(Slow, tiny_split, **cells, progress=progress)
        told = re.search(r"^slow on hopper: fitting, \d s$", capsys.readouterr().err, re.MULTILINE)
        assert bool(told) == progress


def test_an_object_that_cannot_be_copied_says_why_and_its_class_will_do(tiny_split):
    cells = {"environments": "hopper", "anomalies": "iid"}
    with pytest.raises(UsageError, match=r"Locked cannot be copied, .* 'lock' .*: pass the class"):
        evaluate(Locked(), tiny_split, **cells)
    expected = evaluate(Bare, tiny_split, **cells)
    for detector in (Locked, Locked(early=False)):
        with pytest.warns(UserWarning, match="it is fitted again for each group") as warned:
            results = evaluate(detector, tiny_split, **cells)
        assert {Path(w.filename).name for w in warned} == {Path(__file__).name}
        for i in range(2):
            scores = [r.scores("hopper", "iid", i).scores for r in (expected, results)]
            np.testing.assert_array_equal(*scores)


@pytest.mark.parametrize(
    ("argument", "values", "expected"),
    [
        (
            "seed",
            [-1, True, "0", "0,1", 2**70, [0, 0], [], [0, -1], 0.0, None, np.array([1, 1])],
            "whole numbers of at least 0, each once",
        ),
        ("horizon", [0, -1, True, "1", 1.0, [1], None], "a whole number of at least 1"),
        ("limit", [0, True, "2", 2.0, np.float64(2), 10**18], "a whole number of at least 1"),
        ("jobs", [0, -2, False, "all", np.bool_(1)], "a whole number of at least 1"),
        ("environments", [5, [1], None], "names, or a text with commas between them"),
        ("anomalies", [b"iid", [None]], "names, or a text with commas between them"),
        ("output", [5], "a name or path"),
        ("split", [None, 7], "a name or path"),
    ],
)
def test_arguments_are_refused_by_name_before_anything_is_done(
    tiny_split, argument, values, expected
):
    for value in values:
        arguments = {"split": tiny_split, argument: value}
        message = f"{argument} is {value!r}, expected {expected}"
        with pytest.raises(UsageError) as refused:
            evaluate(Unasked, **arguments)
        assert str(refused.value) == message


class Unasked(Bare):
    def __init__(self):
        raise AssertionError("it was made although an argument is wrong")


class Weighted(Size):
    def __init__(self, *, weights):
        super().__init__(weights["a"][0])


def test_numbers_of_numpy_are_numbers(tiny_split):
    numbers = {"seed": np.arange(2), "horizon": np.int8(2), "limit": np.uint16(2)}
    python = {"seed": range(2), "horizon": 2, "limit": 2}
    weights = {"a": [np.float32(2.5), 1], "b": (np.int64(3),)}, {"a": [2.5, 1], "b": (3,)}
    found = [
        evaluate(Weighted, tiny_split, environments="hopper", parameters={"weights": own}, **chosen)
        for chosen, own in zip((numbers, python), weights, strict=True)
    ]
    assert {(r.seed, r.limit) for r in found[0]} == {(0, 2), (1, 2)}
    assert [r.identity for r in found[0]] == [r.identity for r in found[1]]
    assert str([r.metrics for r in found[0]]) == str([r.metrics for r in found[1]])


def test_seeds_and_jobs_change_no_score(tiny_split):
    one, two = (
        evaluate("random", tiny_split, environments="hopper", seed=[0, 1], jobs=jobs)
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


def test_a_text_of_results_is_what_the_terminal_shows(tiny_split, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    results = evaluate(
        ["range", "clock"], tiny_split, environments="hopper", anomalies="iid,gravity",
        output=tmp_path / "out",
    )  # fmt: skip
    assert main(["show", str(tmp_path / "out"), "--split", str(tiny_split)]) == 0
    heading, _, printed = capsys.readouterr().out.partition("\n\n")
    assert heading.startswith("split tiny, digest ")
    assert "Matched AUC" in printed
    assert "everything else: oodd-eval show" in printed
    for same in (results, load_results(tmp_path / "out", tiny_split)):
        assert printed.startswith(f"{same}\n\neverything else: ")
        assert repr(same) == f"Results(4 cells of {same[0].split}: range, clock; 4 ok)"
    assert str(results[:0]) == repr(results[:0]) == "Results(0 cells of nothing: ; no cells)"
    failed = replace(results[0], status="error", reason="no mood", metrics={})
    lines = str(Results([failed, results[1]])).splitlines()
    assert lines[:2] == [f"error: {failed.cell}: no mood", "1 ok, 1 error"]


def test_means_are_those_of_the_tables(results):
    own = [r.value("auc_matched") for r in results if r.detector == "mewma"]
    assert results.mean(row="mewma") == pytest.approx(np.mean(own))
    with pytest.raises(UsageError, match="3 rows, expected row= as one of mewma, range, size"):
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
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtraError, match="pip install pandas"):
        results.to_frame()
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'oodd-eval\[plots\]'"):
        results.plot_trajectory("hopper", "iid", row="size")


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
    found = evaluate(local_spec("range"), environments="hopper", anomalies="iid,gravity")
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


@pytest.mark.parametrize("metric", ["auc_matched", "delay_censored"])
def test_a_comparison_says_which_row_is_better_and_turns_with_its_sides(results, metric):
    one, other = (results.compare(*rows, metric) for rows in (("mewma", "size"), ("size", "mewma")))
    assert one.difference == pytest.approx(one.values[0] - one.values[1])
    assert one.difference == pytest.approx(-other.difference)
    assert (one.low, one.high) == pytest.approx((-other.high, -other.low))
    assert one.values == pytest.approx(other.values[::-1])
    assert (one.p, one.cells) == (other.p, 4)
    assert str(one).splitlines()[0] == one.verdict
    ahead = (one.difference > 0) == (metric == "auc_matched")
    clear = one.p <= 0.05 and (one.low > 0 or one.high < 0)
    better = "mewma" if ahead else "size"
    assert one.verdict.startswith(f"{better} beats" if clear else "No difference is shown")


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


def test_parameters_are_for_all_detectors_or_for_one(tiny_split):
    where = {"environments": "cartpole", "anomalies": "iid", "limit": 2}
    for parameters in ({"mewma": {"order": 2}}, {"mewma.order": 2}):
        results = evaluate(["clock", "mewma"], tiny_split, **where, parameters=parameters)
        assert results.rows == ("clock", "mewma[order=2]")
    with pytest.raises(UsageError, match=r"clock has none of that name: write mewma\.order"):
        evaluate(["clock", "mewma"], tiny_split, **where, parameters={"order": 2})
