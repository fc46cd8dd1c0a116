"""Windows of one recording: thresholds, findings, draws and intervals that count it once."""

import json
import math
from statistics import NormalDist

import numpy as np
import pytest
from helpers_logs import log_parts, write_log_split

from oodd_eval import evaluate, load_results, load_split
from oodd_eval.data.layout import packed_recordings
from oodd_eval.errors import SplitError, UsageError
from oodd_eval.metrics.alarms import (
    Calibration,
    GuaranteedAlarm,
    halves,
    no_promise,
    numbered,
    rolling_rules,
    window_weights,
)
from oodd_eval.metrics.auc import Contribution, mean_of
from oodd_eval.metrics.bootstrap import drawn_cell, mean_interval, sums_of_recordings
from oodd_eval.metrics.cusum import DRIFT, UNIT
from oodd_eval.metrics.promise import EpisodeMeans, achieved_share, enough_episodes, promises
from oodd_eval.metrics.recalibration import DRAWS, Recalibration, drawn
from oodd_eval.results.board import boards
from oodd_eval.results.report import Report, flat
from oodd_eval.results.tables import UNPROMISED, Tables

SPREAD = 0.2  # of windows around their recording


def windows(rng, recordings, most=30):
    """Scores of windows that have their recording in common, and which it is."""
    scores, labels = [], []
    for k in range(recordings):
        level = rng.normal()
        for _ in range(rng.integers(1, most)):
            scores.append(level + SPREAD * rng.normal(size=1))
            labels.append(f"file {k}")
    return scores, labels


def share_above(rule):
    """Chance that a window of a further recording alarms."""
    height = rule.threshold
    if rule.standardization is not None:
        mean, std = rule.standardization.numbers
        height = mean + std * (rule.threshold + DRIFT) / UNIT
    return 1 - NormalDist(0.0, math.hypot(1.0, SPREAD)).cdf(height)


@pytest.mark.parametrize(("kind", "recordings"), [("score", 9), ("score", 24), ("cusum", 20)])
def test_the_promise_holds_for_a_window_of_a_further_recording(kind, recordings):
    rng, level = np.random.default_rng([recordings, len(kind)]), 0.10
    hierarchical, plain = [], []
    for _ in range(300):
        scores, labels = windows(rng, recordings)
        hierarchical.append(share_above(GuaranteedAlarm.fit(scores, level, kind, None, labels)))
        plain.append(share_above(GuaranteedAlarm.fit(scores, level, kind)))
    error = np.std(hierarchical) / math.sqrt(len(hierarchical))
    assert np.mean(hierarchical) <= level + 3 * error
    assert np.mean(hierarchical) > 0.05
    # Windows that count each promise more than they keep.
    assert np.mean(plain) > level + 2 * np.std(plain) / math.sqrt(len(plain))


def test_a_confidence_is_of_recordings():
    rng, kept = np.random.default_rng(3), []
    for _ in range(200):
        scores, labels = windows(rng, 25, 8)
        rule = GuaranteedAlarm.fit(scores, 0.10, "score", 0.9, labels)
        kept.append(share_above(rule) <= 0.10)
    assert np.mean(kept) >= 0.9 - 3 * math.sqrt(0.09 / 200)


@pytest.mark.parametrize("kind", ["score", "cusum"])
@pytest.mark.parametrize("confidence", [None, 0.5])
def test_one_episode_a_recording_is_what_it_was(kind, confidence):
    rng = np.random.default_rng(5)
    scores = [rng.normal(size=30) for _ in range(60)]
    plain = Calibration.fit(scores, kind)
    fitted = Calibration.fit(scores, kind, [f"file {i}" for i in range(60)])
    assert fitted.largest == plain.largest
    assert fitted.standardization == plain.standardization
    for level in (0.3, 0.10, 0.05):
        assert fitted.no_promise(level, confidence) == ""
        assert fitted.threshold(level, confidence) == plain.threshold(level, confidence)
    more = [rng.normal(size=30) for _ in range(4)]
    if confidence is None:
        rules = rolling_rules(plain, more, 0.10)
        assert rolling_rules(fitted, more, 0.10, range(60, 64)) == rules
        again = Recalibration.fit(scores, kind, "arm", [*range(60)])
        for suffix, values in Recalibration.fit(scores, kind, "arm").thresholds.items():
            assert np.array_equal(again.thresholds[suffix], values)


def test_too_few_recordings_count_windows_and_promise_nothing():
    scores = [np.array([float(i)]) for i in range(38)]
    fitted = Calibration.fit(scores, "score", ["a"] * 38)
    assert fitted.threshold(0.10) == Calibration.fit(scores, "score").threshold(0.10)
    words = "38 windows of 1 recording: no promise at 10 %; 9 recordings would"
    assert fitted.no_promise(0.10) == words
    assert "; 22 recordings would" in fitted.no_promise(0.10, 0.9)
    of_sum = Calibration.fit(scores, "cusum", ["a"] * 38)
    assert of_sum.no_promise(0.10) == words.replace("9 rec", "18 rec")
    assert (of_sum.recordings, of_sum.recording_count, of_sum.episodes) == ((0,) * 19, 1, 38)
    assert of_sum.threshold(0.10) == Calibration.fit(scores, "cusum").threshold(0.10)
    assert "0.5 % " not in no_promise(400, 30, 0.03, "score")
    with pytest.raises(UsageError, match="2 recordings of 38 episodes"):
        Calibration.fit(scores, "score", ["a", "b"])


def test_recordings_standardize_or_give_the_threshold_and_never_few_windows_it():
    assert [h.tolist() for h in halves(np.array([0, 1, 0, 2, 3]))] == [[0, 2, 3], [1, 4]]
    # One window would give no threshold.
    assert [h.tolist() for h in halves(np.array([0] * 8 + [1]))] == [[8], [*range(8)]]
    for n in range(6):
        every = np.arange(n)
        parts = [every[0::2].tolist(), every[1::2].tolist()]
        assert [h.tolist() for h in halves(every)] == parts
    assert [h.tolist() for h in halves(np.zeros(5, int))] == [[0, 2, 4], [1, 3]]


def test_windows_of_the_recording_that_joins_share_its_weight():
    calibration = Calibration.fit([np.array([float(i)]) for i in range(12)], "score")
    one = calibration.joined(100.0)
    several = calibration.joined(100.0, 12).joined(100.0, 12).joined(100.0, 12)
    assert several.recordings == (*range(12), 12, 12, 12)
    assert several.threshold(0.10) == one.threshold(0.10)
    assert several.joined(0.0).recordings[-1] == 13
    few = Calibration.fit([np.zeros(1)] * 40, "score", ["a"] * 20 + ["b"] * 20).joined(1.0)
    words = "41 windows of 3 recordings: no promise at 10 %; 9 recordings would"
    assert few.no_promise(0.10) == words
    some = Calibration.fit([np.zeros(1)] * 40, "score", [i // 4 for i in range(40)])
    with pytest.raises(UsageError, match="needs 12 episodes at 10 %, got 11"):
        some.joined(1.0).rule(0.10)


def test_import_says_how_many_recordings_a_level_takes():
    one, several = enough_episodes(38, recordings=1), enough_episodes(200, recordings=12)
    words = "38 windows of 1 recording: no promise at 10 %; 9 recordings would"
    assert str(one) == f"{words} (18 for a CUSUM of the scores)"
    assert str(several) == (
        "200 windows of 12 recordings: no promise at 10 %; 18 recordings would for a CUSUM of the "
        "scores"
    )
    assert one.doubt
    assert not enough_episodes(400, ["cusum"], 38).doubt
    assert str(enough_episodes(30, recordings=30)) == str(enough_episodes(30))


def test_findings_compare_recordings_where_there_are_enough():
    rng = np.random.default_rng(2)
    levels = np.repeat(rng.normal(size=(40, 1)), 5, axis=0)
    lengths, labels = np.full(200, 20), np.repeat(np.arange(40), 5)
    # Half of each part's windows are of other recordings: windows alone show drift too often.
    parts = [
        EpisodeMeans(levels[part], lengths[part], labels[part].tolist())
        for part in (slice(0, 60), slice(60, 160), slice(160, 200))
    ]
    found = {f.subject: f for f in promises(*parts, sensors=["a"])}
    assert "40 nominal recordings" in found["drift"].text
    alone = {f.subject: f for f in promises(*(p._replace(recordings=None) for p in parts))}
    assert found["drift"].p > alone["drift"].p
    scores = [np.array([x]) for x in levels[:, 0]]
    by_recording = achieved_share(scores, "score", "", labels.tolist())
    assert "of the 20 later calibration recordings" in by_recording.text
    assert "of the 100 later calibration episodes" in achieved_share(scores, "score").text


def test_a_drawn_recording_brings_all_its_windows():
    unit = numbered([*"aabbbccdeeeef"], 13)
    draws = drawn("arm", 6)
    windows = draws.of_windows(unit)
    for of_units, spread, row, spreads in zip(*draws, *windows, strict=True):
        expected = [np.flatnonzero(unit == k) for k in of_units]
        flat = np.concatenate(expected)
        assert row.tolist() == [*flat, *[13] * (len(row) - len(flat))]
        assert np.array_equal(spreads[: len(flat)], np.repeat(spread, [*map(len, expected)]))
    assert drawn("arm", 6).of_windows(np.arange(6)) is draws
    scores = [np.arange(k + 1.0) for k in range(13)]
    standards = Recalibration.fit(scores, "score", "arm", unit.tolist()).standards
    for i in range(DRAWS):
        pooled = np.concatenate([scores[k] for k in windows.episodes[i] if k < 13])
        assert standards.mean[i] == pytest.approx(pooled.mean())
        assert standards.std[i] == pytest.approx(pooled.std())


@pytest.mark.parametrize("kind", ["score", "cusum"])
def test_drawn_thresholds_spread_as_those_of_fresh_recordings_do(kind):
    rng, drawn_spread, fresh = np.random.default_rng(8), [], []
    for k in range(40):
        scores, labels = windows(rng, 60, 12)
        fresh.append(Calibration.fit(scores, kind, labels).threshold(0.10))
        again = Recalibration.fit(scores, kind, f"e{k}", labels)
        drawn_spread.append(again.thresholds["at_10pct"].std())
    assert 0.7 < np.mean(drawn_spread) / np.std(fresh) < 1.4


def test_equal_windows_have_the_interval_of_their_recordings():
    rng = np.random.default_rng(4)
    alarms = (rng.random(12) < 0.3).astype(float)
    times, kinds = np.full(12, 4), ("share", "exact", "mean")
    labels = tuple(np.repeat(np.arange(12), times).tolist())
    nominal = Contribution(*_terms(alarms), nominal=8)
    repeated = Contribution(*_terms(np.repeat(alarms, times)), nominal=32, recordings=labels)
    for kind in kinds:
        intervals = [
            mean_interval([drawn_cell("arm", 0, c)], kind=kind) for c in (nominal, repeated)
        ]
        assert intervals[0] == pytest.approx(intervals[1])
    assert repeated.value == pytest.approx(nominal.value)
    # A sample's only recording says nothing of others: its windows are drawn.
    terms = np.ones((2, 5))
    sums, first = sums_of_recordings(terms, 3, (0, 0, 0, 1, 2))
    assert (sums.shape, first) == ((2, 5), 3)
    sums, first = sums_of_recordings(terms, 3, (0, 0, 1, 1, 2))
    assert (sums.tolist(), first) == ([[2, 1, 1, 1]] * 2, 2)


def _terms(values):
    terms = mean_of(values)
    return terms.numerator, terms.denominator


def test_weights_of_a_recording_sum_to_one():
    weights = window_weights(numbered([*"abbccc"], 6))
    assert weights.tolist() == pytest.approx([1, 1 / 2, 1 / 2, 1 / 3, 1 / 3, 1 / 3])


# -- splits and records ---------------------------------------------------------------------------


def split_of(directory, **recordings):
    """Write a split whose episodes are windows of a few recordings."""
    parts = {"train": [0] * 6, "calibration": [0] * 40, "test/nominal": [*range(1, 5)] * 2}
    numbers = parts | {"test/slip": [5, 5, 6, 6, 7]} | recordings
    return write_log_split(directory, log_parts(), recordings=numbers)


def test_a_split_says_which_recordings_its_episodes_are_windows_of(tmp_path):
    plain = load_split(write_log_split(tmp_path / "plain", log_parts()))
    split = load_split(split_of(tmp_path / "cut"))
    assert split.digest == plain.digest
    with split.opened() as opened:
        assert opened("arm").recordings("train") == ("0",) * 6
        assert opened("arm").recordings("test/slip") == ("5", "5", "6", "6", "7")
    with plain.opened() as opened:
        assert opened("arm").recordings("train") is None


@pytest.mark.parametrize("runs", ["0x39", "0x41", "", "0x40 1", "0 x40", [0] * 40])
def test_recordings_of_other_numbers_are_refused(tmp_path, runs):
    path = split_of(tmp_path / "cut")
    manifest = json.loads((path / "manifest.json").read_text())
    assert manifest["environments"]["arm"]["recordings"]["calibration"] == "0x40"
    manifest["environments"]["arm"]["recordings"]["calibration"] = runs
    (path / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(SplitError):
        load_split(path).environment("arm")


def test_figures_without_a_promise_are_marked_everywhere(tmp_path):
    path, words = split_of(tmp_path / "cut"), "40 windows of 1 recording: no promise at"
    plain = write_log_split(tmp_path / "plain", log_parts())
    records = evaluate("mahalanobis", load_split(path), output=tmp_path / "out").records
    unmarked = evaluate("mahalanobis", load_split(plain), output=tmp_path / "plain-out").records
    (board,) = boards(records)
    for figure, other in zip(records, unmarked, strict=True):
        # Windows of the calibration count, and those of test recordings are drawn together.
        assert figure.value("false_episodes_at_5pct") == other.value("false_episodes_at_5pct")
        assert figure.recordings["nominal"] == (1, 2, 3, 4) * 2
        assert figure.from_json(figure.to_json()).recordings == figure.recordings
        assert not other.recordings
        assert "recordings" not in json.loads(other.to_json())
    table = Tables(board).headline()
    assert f"missed{UNPROMISED}" in table.header
    assert "pooled AUC" in table.header
    assert f"{UNPROMISED}: {words} 5 %; " in table.note
    assert "no share of them is promised" in table.note
    assert f"{UNPROMISED}: {words}" in " ".join(str(Report(records)).split())
    assert words in flat(records)[0]["promise"]
    assert flat(unmarked)[0]["promise"] == ""
    again = load_results(tmp_path / "out").records
    assert [r.recordings for r in again] == [r.recordings for r in records]
    board_alone = boards(unmarked)[0]
    assert UNPROMISED not in "".join(Tables(board_alone).headline().header)


def test_runs_of_recordings_are_short():
    assert packed_recordings(np.repeat([3, 0], 10**5).tolist()) == "3x100000 0x100000"
