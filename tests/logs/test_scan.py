"""Scans: odd episodes with rows and sensors, faults of the stream, pages, viewers, the command."""

import re
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from oodd_live import Watchdog
from oodd_live.handle import DetectorHandle
from oodd_logs import scan_episodes
from oodd_logs.episodes import Episode
from oodd_logs.scanning.outliers import (
    ENOUGH,
    LEAST,
    Tail,
    critical_p,
    q_values,
    rank_p,
    rank_threshold,
    surprise,
)

from oodd_eval.data.facts import Quantity
from oodd_eval.errors import UnknownNameError, UsageError
from oodd_eval.metrics.binomial import clopper_pearson

ROOT = Path(__file__).parents[2]
SENSORS = ["speed", "torque", "current"]


def logs(seed=0, n=20, rows=150, sensors=3):
    """Episodes of a stable linear process, each about an offset of its own."""
    rng = np.random.default_rng(seed)
    episodes = []
    for _ in range(n):
        x = np.zeros((rows, sensors))
        for t in range(1, rows):
            x[t] = 0.8 * x[t - 1] + rng.normal(size=sensors)
        episodes.append(x + 0.5 * rng.normal(size=sensors))
    return episodes


def episode(rows, name="one", time=None, **facts):
    rows = np.asarray(rows, dtype=float)
    return Episode(name, "log.csv", rows, np.empty((len(rows) - 1, 0)), None, time=time, **facts)


def p_values(largest):
    values = [(one, np.delete(largest, i)) for i, one in enumerate(largest)]
    return np.exp([-surprise(*value) for value in values])


# The arithmetic


def test_a_tail_worked_by_hand():
    # Of nine others the fifth is the median, 1; the cube roots of the rest are 1, 2, 4 and 8 beyond
    # it. All have the mean 15 / 4; with the largest fifth of nine censored at 2, 7 / 2 of 2.
    others = np.array([0.1, 0.2, 0.3, 0.4, 1.0, 8.0, 27.0, 125.0, 729.0])
    tail = Tail.fit(others)
    assert (tail.start, tail.share) == (1.0, 0.5)
    assert tail.estimates == (pytest.approx((15 / 4, 4)), pytest.approx((7 / 2, 2)))
    every, censored = (1 + 10 / 15) ** -4, (1 + 10 / 7) ** -2
    p = np.exp(-tail.surprise([11.0**3, 1.0, 1.001]))
    assert p[:2] == pytest.approx([2 * 0.5 * min(every, censored), 1.0])
    assert 0.9 < p[2] < 1.0


def test_statistic_and_p_value_agree():
    for shift in (0.0, -40.0):
        others = np.random.default_rng(2).normal(size=40) + shift
        tail = Tail.fit(others)
        assert tail.surprise(tail.value([1.0, 4.6, 14.0])) == pytest.approx([1.0, 4.6, 14.0])


@pytest.mark.parametrize("others", [np.ones(30), np.arange(LEAST - 2.0), np.full(30, -np.inf)])
def test_no_tail_of_ties_or_of_few(others):
    assert Tail.fit(others) is None


@pytest.mark.parametrize("n", [8, 20, 60])
def test_p_values_are_valid_and_nearly_exact_for_cubes(n):
    """From one estimate alone they are exact: the share of them up to each level is that level."""
    rng, draws = np.random.default_rng(n), 4000
    surprises = np.empty((3, draws))
    for i in range(draws):
        largest = rng.exponential(size=n) ** 3
        tail = Tail.fit(largest[1:])
        alone = [Tail(tail.start, tail.share, (one,)) for one in tail.estimates]
        surprises[:, i] = [one.surprise(largest[0]) for one in (tail, alone[0], alone[-1])]
    for level in (0.2, 0.05, 0.01):
        both, *counts = ((np.exp(-one) <= level).sum() for one in surprises)
        for count in counts:
            low, high = clopper_pearson(int(count), draws, 0.999)
            assert low <= level <= high
        assert clopper_pearson(int(both), draws, 0.999)[0] <= level
        assert clopper_pearson(int(both), draws, 0.999)[1] >= level / 2


def test_q_values_by_hand():
    p = np.array([0.04, 0.01, 0.5, 0.012])
    assert q_values(p) == pytest.approx([0.04 * 4 / 3, 0.024, 0.5, 0.024])
    assert critical_p(p, 0.03) == pytest.approx(0.03 * 2 / 4)
    assert critical_p(np.ones(4), 0.1) == pytest.approx(0.1 / 4)


def test_ranks_alone_reject_nothing():
    """The reason for a tail: the k-th smallest of n ranks among all is k / n."""
    largest = np.array([*range(1, 50), 1e9])
    p = np.array([rank_p(one, np.delete(largest, i)) for i, one in enumerate(largest)])
    assert q_values(p).min() == pytest.approx(1.0)
    assert q_values(p_values(largest))[-1] < 0.01


@pytest.mark.parametrize("draw", ["cube", "gumbel", "lognormal"])
def test_false_discoveries_are_as_rare_as_promised(draw):
    """Without an odd episode any rejection is a false discovery."""
    rng, runs = np.random.default_rng(7), 400
    draws = {
        "cube": lambda: rng.exponential(size=20) ** 3,
        "gumbel": lambda: rng.gumbel(size=20) + 6,
        "lognormal": lambda: np.exp(rng.normal(size=20)),
    }
    wrong = sum((q_values(p_values(draws[draw]())) <= 0.1).any() for _ in range(runs))
    assert clopper_pearson(wrong, runs, 0.99)[0] <= 0.1


def test_heavy_tails_break_what_is_promised():
    """As docs/adr/0021-scan-tail.md says: the tail is assumed, and a power law is beyond it."""
    rng = np.random.default_rng(7)
    wrong = sum((q_values(p_values(rng.pareto(3, size=60) + 1)) <= 0.1).any() for _ in range(200))
    assert clopper_pearson(wrong, 200, 0.99)[0] > 0.1


def test_ranks_among_others_keep_the_promise_whatever_the_tail():
    """Five episodes against 49 that are kept apart: the smallest rank is 1 / 50 = 0.1 / 5."""
    rng, wrong, runs = np.random.default_rng(7), 0, 2000
    for _ in range(runs):
        largest = rng.pareto(1, size=54)
        p = np.array([rank_p(one, largest[5:]) for one in largest[:5]])
        odd = q_values(p) <= 0.1
        assert (odd == (largest[:5] >= rank_threshold(critical_p(p, 0.1), largest[5:]))).all()
        wrong += odd.any()
    low, high = clopper_pearson(wrong, runs, 0.999)
    assert low <= 0.1
    assert high >= 0.05


def test_a_fifth_of_odd_episodes_does_not_hide_itself():
    rng = np.random.default_rng(3)
    found = 0
    for _ in range(50):
        largest = rng.gumbel(size=30) + 6
        largest[:5] *= 15
        found += (q_values(p_values(largest))[:5] <= 0.1).sum()
    assert found >= 0.95 * 50 * 5


# Odd episodes


def test_the_odd_one_is_named_with_row_and_sensor():
    named = rows = 0
    for seed in range(3):
        episodes = logs(seed)
        episodes[5][90:, 1] += 12
        scan = scan_episodes(episodes, sensors=SENSORS, detector="mewma")
        assert [one.episode.name for one in scan.odd] == ["episode 5"]
        (odd,) = scan.odd
        assert odd.intervals[0][0] == odd.row
        assert odd.statistic[odd.row] >= odd.threshold
        assert (odd.statistic[: odd.row] < odd.threshold).all()
        assert sum(odd.sensors.values()) == pytest.approx(1)
        named += odd.suspects[0] == "torque"
        rows += abs(odd.first - 90) <= 3
    assert named == 3
    assert rows >= 2


def test_clean_logs_have_odd_episodes_as_rarely_as_promised():
    runs = 40
    scans = [
        scan_episodes(logs(seed, n=12, rows=80), fdr=0.1, detector="mewma")
        for seed in range(100, 100 + runs)
    ]
    assert not any(one.faults for scan in scans for one in scan.episodes)
    wrong = sum(bool(scan.odd) for scan in scans)
    assert clopper_pearson(wrong, runs, 0.99)[0] <= 0.1


def test_labels_decide_nothing_and_stand_beside():
    episodes = [episode(x, f"e{i}") for i, x in enumerate(logs())]
    plain = scan_episodes(episodes, detector="mewma")
    labelled = [episode(x, f"e{i}", kind="leak", intervals=((3, 9),)) for i, x in enumerate(logs())]
    scan = scan_episodes(labelled, detector="mewma")
    assert [one.p for one in scan.episodes] == [one.p for one in plain.episodes]
    assert {one.label for one in scan.episodes} == {"leak, 3 to 9"}
    assert {one.label for one in plain.episodes} == {""}
    assert scan_episodes([episode(logs()[0], outcome=False)] * 2).episodes[0].label == "failure"


class Spy:
    """A detector that scores the distance from the mean, and knows what it was fitted on."""

    fits: ClassVar = []

    def fit(self, nominal):
        self.seen = {float(x.observations[0, 0]) for x in nominal}
        self.fits.append(self.seen)
        self.mean = np.concatenate([x.observations for x in nominal]).mean(axis=0)

    def score(self, trajectory):
        assert float(trajectory.observations[0, 0]) not in self.seen
        return np.abs(trajectory.observations - self.mean).sum(axis=1).astype(np.float64)


@pytest.mark.parametrize(("n", "detector"), [(9, Spy), (20, Spy()), (33, Spy())])
def test_nothing_is_judged_by_a_fit_that_has_seen_it(n, detector):
    Spy.fits.clear()
    episodes = logs(n=n, rows=30)
    episodes[4][10:] += 500
    scan = scan_episodes(episodes, detector=detector)
    assert f"{'two passes of ' * (n >= ENOUGH)}5 fits" in scan.notes[0]
    # The second pass leaves out the fifth that the first one found most suspicious.
    assert len(Spy.fits) == (10 if n >= ENOUGH else 5)
    assert n < ENOUGH or all(
        float(np.float32(episodes[4][0, 0])) not in fit for fit in Spy.fits[5:]
    )
    assert len(set.union(*Spy.fits[-5:])) == n - n // 5 * (n >= ENOUGH)
    assert scan.episodes[4].odd  # by a CUSUM of its scores
    first = [float(np.float32(x[0, 0])) for x in episodes]
    assert len({*first}) == n


class Explaining(Spy):
    def explain(self, trajectory):
        rows = np.tile([0.1, 0.2, 0.7], (len(trajectory), 1))
        return rows, np.minimum(np.arange(len(trajectory)), 3)


def test_explanations_of_the_detector_count():
    episodes = logs(rows=40)
    for x in episodes:  # A range that the fault does not leave.
        x[5:7, 0] = 300, -300
    episodes[2][20:, 0] += 200
    (odd,) = scan_episodes(episodes, sensors=SENSORS, detector=Explaining()).odd
    assert odd.sensors == {"current": 0.7, "torque": 0.2, "speed": 0.1}
    assert (odd.since, odd.first) == (3, 3)


class Broken(Spy):
    def fit(self, nominal):
        raise ZeroDivisionError("ratio")


def test_processes_give_what_one_gives():
    episodes = logs(n=8, rows=40)
    one, two = (scan_episodes(episodes, detector="mewma", jobs=jobs) for jobs in (1, 2))
    assert [e.as_json() for e in one.episodes] == [e.as_json() for e in two.episodes]


def test_baseline_rows_take_the_day_off():
    """Days differ by far more than the fault, which a baseline shows."""
    rng = np.random.default_rng(5)
    episodes = [x + 60 * rng.normal(size=3) for x in logs(5)]
    episodes[8][100:, 2] += 12
    (odd,) = scan_episodes(episodes, sensors=SENSORS, baseline=40, detector="mewma").odd
    assert (odd.episode.name, odd.suspects[0]) == ("episode 8", "current")
    assert abs(odd.first - 100) <= 5
    assert np.isnan(odd.scores[:40]).all()


def test_rows_that_a_detector_adapts_to_are_not_judged(monkeypatch):
    class Loud:
        def fit(self, nominal):
            assert {len(x) for x in nominal} == {150}

        def score(self, trajectory):
            return np.abs(trajectory.observations).sum(axis=1) + 1e6 * (np.arange(150) < 40)

    handle = DetectorHandle(Loud(), "score", actions=True, adapts=True, state={"name": "loud"})
    monkeypatch.setattr("oodd_logs.scanning.fits.Fit.handle", lambda _: handle)
    for one in scan_episodes(logs(5), sensors=SENSORS, baseline=40).episodes:
        assert np.isnan(one.scores[:40]).all()
        assert one.largest < 1e5


def test_a_single_recording_is_cut_into_windows():
    recording = np.concatenate(logs(n=1, rows=2000))
    recording[1230:1260, 1] += 40
    scan = scan_episodes([recording], sensors=SENSORS, detector="mewma")
    assert len(scan.episodes) == 40
    # The change ends ten rows into the next window.
    first_rows = {odd.episode.name: odd.first for odd in scan.odd}
    assert first_rows.keys() <= {"episode 0[1200:1250]", "episode 0[1250:1300]"}
    assert abs(first_rows["episode 0[1200:1250]"] - 30) <= 2
    assert "50 rows" in " ".join(scan.notes)


def test_windows_keep_labels_times_and_the_rest():
    one = episode(np.random.default_rng(0).normal(size=(25, 2)), time=np.arange(25.0),
                  intervals=((8, 13),))  # fmt: skip
    parts = [x.episode for x in scan_episodes([one, one], window=10, detector="range").episodes][:3]
    assert [len(x.observations) for x in parts] == [10, 10, 5]
    assert [x.intervals for x in parts] == [((8, 10),), ((0, 3),), ()]
    assert [x.name for x in parts] == ["one[0:10]", "one[10:20]", "one[20:25]"]
    assert parts[1].time[0] == 10.0


def test_few_episodes_are_said_to_be_few():
    episodes = logs(n=LEAST - 1)
    episodes[1][50:] += 8
    scan = scan_episodes(episodes, detector="mewma")
    assert not scan.odd
    assert f"takes {LEAST}" in " ".join(scan.notes)
    assert scan.episodes[0].as_json()["p"] is None
    together = scan_episodes(episodes + logs(1, n=13), detector="mewma")
    assert together.episodes[1].odd


@pytest.mark.parametrize(
    ("episodes", "arguments", "message"),
    [
        (logs(n=9), {"fdr": 0.0}, "fdr=0.0"),
        (logs(n=9), {"window": 1}, "window=1"),
        (logs(n=9), {"sensors": ["a"]}, "1 names of sensors"),
        (logs(n=9), {"baseline": 200}, "no episode of at least"),
        (logs(n=9), {"detector": Broken()}, "Broken raised ZeroDivisionError"),
        ([np.zeros(3)], {}, "shape (3,)"),
        ([np.zeros((5, 2)), np.zeros((5, 3))], {}, "[2, 3] sensors"),
        ([], {}, "[] sensors"),
        (logs(n=1, rows=9), {}, "a single episode of 9 rows"),
    ],
)
def test_wrong_arguments(episodes, arguments, message):
    kind = ValueError if "detector" in arguments else UsageError
    with pytest.raises(kind, match=re.escape(message)):
        scan_episodes(episodes, **arguments)


def test_tasks_are_compared_among_themselves():
    rng = np.random.default_rng(0)
    loud = [episode(100 * rng.normal(size=(60, 2)), f"l{i}", task="loud") for i in range(10)]
    quiet = [episode(rng.normal(size=(60, 2)), f"q{i}", task="quiet") for i in range(12)]
    quiet[3].observations[30:] += 60
    scan = scan_episodes([*loud, *quiet], detector="mahalanobis")
    assert [one.episode.name for one in scan.odd] == ["q3"]


# Ranks, bands and what somebody confirmed


def noise(n, seed=0, rows=40):
    """Episodes of white noise, by name."""
    rng = np.random.default_rng(seed)
    return [episode(rng.normal(size=(rows, 3)), f"run-{i:02}") for i in range(n)]


def quick(episodes, **arguments):
    return scan_episodes(episodes, sensors=SENSORS, detector="mahalanobis", **arguments)


def test_confirmed_episodes_are_the_calibration_and_never_called():
    """Ranks among 20 of them are exact for two others, and not small enough for three."""
    episodes = noise(23)
    for i in (3, 20):  # also a confirmed one
        episodes[i].observations[20:, 1] += 50
    two, three = (quick(episodes[:n], fine=["run-0*", "run-1?"]) for n in (22, 23))
    alone = quick(episodes[:22])
    assert {one.episode.name for one in alone.odd} == {"run-03", "run-20"}
    for scan in (two, three):
        assert {one.band for one in scan.episodes[:20]} == {"fine"}
        assert {one.position for one in scan.episodes[20:]} == {*range(1, len(scan.episodes) - 19)}
        assert np.isnan([one.q for one in scan.episodes[:20]]).all()
    odd, other = two.episodes[20:]
    assert "20 confirmed episodes are enough" in " ".join(two.notes)
    # One confirmed episode is as odd.
    assert odd.p == odd.rank_p
    assert odd.p in {1 / 21, 2 / 21}
    assert other.p == other.rank_p == pytest.approx(round(other.p * 21) / 21)
    assert other.p > odd.p
    assert "enough for p-values by rank" not in " ".join(three.notes)
    assert three.episodes[20].p != three.episodes[20].rank_p


def test_ranks_among_confirmed_episodes_by_hand():
    """The loudest of 22 is above all 20 that are confirmed, the third above all but one."""
    (base,) = noise(1)
    loudness = np.random.default_rng(0).permutation(np.geomspace(1, 1e4, 22))
    order = np.argsort(-loudness)
    episodes = [episode(base.observations * x, f"run-{i:02}") for i, x in enumerate(loudness)]
    tested = int(order[0]), int(order[2])
    scan = quick(episodes, fine=[f"run-{i:02}" for i in range(22) if i not in tested])
    assert [scan.episodes[i].p for i in tested] == pytest.approx([1 / 21, 2 / 21])
    assert [scan.episodes[i].band for i in tested] == ["surely", "surely"]
    assert [one.episode.name for one in scan.ranked[:2]] == [f"run-{i:02}" for i in tested]


def test_confirmed_episodes_are_named_or_matched():
    episodes = noise(12)
    episodes[5].observations[20:, 1] += 50
    assert [one.episode.name for one in quick(episodes).odd] == ["run-05"]
    for fine in (["run-05"], ["run-0[3-6]"], ["run-11", "*5"]):
        scan = quick(episodes, fine=fine)
        assert scan.episodes[5].band == "fine"
        assert not scan.odd
    assert quick(episodes, fine=["run-04"]).episodes[5].odd
    windows = quick(episodes, window=20, fine=["run-05"])
    assert {one.band for one in windows.episodes if "run-05" in one.episode.name} == {"fine"}
    for wrong in ("run-5", "x*"):
        with pytest.raises(UnknownNameError, match=re.escape(wrong)):
            quick(episodes, fine=["run-01", wrong])


@pytest.mark.parametrize(("count", "mixed"), [(4, False), (5, True)])
def test_more_than_a_fifth_are_several_kinds(count, mixed):
    episodes = noise(24)
    for i in range(count):
        episodes[5 * i].observations[20:, i % 3] += 50
    scan = quick(episodes, first=2)
    standing_out = {f"run-{5 * i:02}" for i in range(count)}
    assert scan.kinds_mixed == mixed
    assert {one.episode.name for one in scan.ranked[:count]} == standing_out
    assert {one.band for one in scan.ranked[:count]} == {"look at" if mixed else "surely"}
    assert {one.band for one in scan.ranked[count:]} == {"fine"}
    assert (f"{count} episodes stand out" in " ".join(scan.notes)) == mixed
    assert scan.as_json()["odd"] == ([] if mixed else sorted(standing_out))


@pytest.mark.parametrize(("fdr", "band"), [(0.1, "surely"), (1e-9, "look at")])
def test_a_skipped_step_is_missing_from_the_figures(fdr, band):
    """No row is unusual where a peak is left out; the ranking needs no p-value."""
    rng, rows = np.random.default_rng(0), np.arange(80)
    episodes = []
    for i in range(30):
        x = 0.05 * rng.normal(size=(80, 3))
        x += np.sin(rows / 16)[:, None]
        if i != 17:
            x[:, 1] += 2 * np.exp(-(((rows - 45 - rng.normal()) / 5) ** 2))
        episodes.append(episode(x, f"run-{i:02}"))
    scan = quick(episodes, first=3, fdr=fdr)
    oddest = scan.ranked[0]
    assert (oddest.episode.name, oddest.band) == ("run-17", band)
    assert oddest.reason.startswith("largest of torque is ")
    assert (oddest.suspects, oddest.first) == (["torque"], None)
    assert [one.position for one in scan.ranked] == [*range(1, 31)]
    assert [one.band for one in scan.ranked[1:]] == ["look at"] * 2 + ["fine"] * 27


@pytest.mark.parametrize(
    ("rows", "value", "faults", "odd"),
    [
        (slice(-10, None), "missing", [], False),  # the logger's end
        (slice(20, 30), "missing", ["missing"], True),
        (slice(20, 50), "largest", ["saturated"], False),  # a beam that meets nothing
        (slice(20, 50), "usual", ["frozen"], True),
    ],
)
def test_an_end_of_a_log_or_of_a_range_makes_nothing_odd(rows, value, faults, odd):
    episodes = [episode(x, f"e{i}") for i, x in enumerate(logs(n=24, rows=500))]
    column = episodes[7].observations[:, 1]
    column[rows] = {"missing": np.nan, "largest": column.max(), "usual": column[20]}[value]
    scan = quick(episodes)
    assert [one.episode.name for one in scan.odd] == ["e7"] * odd
    assert [f.fault for f in scan.episodes[7].faults if f.what == "torque"] == faults


@pytest.mark.parametrize("n", [2, LEAST - 1, LEAST])
def test_nothing_is_surely_odd_without_a_p_value(n):
    episodes = noise(n)
    episodes[1].observations[10:, 1] += 1e5
    scan = quick(episodes, first=1)
    oddest = scan.ranked[0]
    assert np.isnan([one.p for one in scan.episodes]).all() == (n < LEAST)
    assert oddest.band == ("surely" if n >= LEAST else "look at")
    assert n < LEAST - 1 or oddest.episode.name == "run-01"


# Faults of the stream


def test_an_offset_that_float32_cannot_tell():
    episodes = [x * [0.02, 1, 1] + [5.4e6, 0, 0] for x in logs()]
    episodes[3][100:, 0] += 0.3
    (odd,) = scan_episodes(episodes, sensors=SENSORS, detector="mewma").odd
    assert (odd.episode.name, odd.suspects) == ("episode 3", ["speed"])


FAULTS = {
    "missing": ("torque", "missing"),
    "missing now and then": ("torque", "missing"),
    "wild": ("torque", "broken"),
    "frozen": ("torque", "frozen"),
    "repeated": ("observation", "repeated"),
    "out of range": ("torque", "out of range"),
    "gap": ("time", "gap"),
}
"""What is named with which fault."""


@pytest.fixture(scope="module")
def broken():
    """A scan of 30 episodes, of which one has each fault from row 60 on."""
    episodes = [episode(x, f"e{i}", time=0.1 * np.arange(150)) for i, x in enumerate(logs(n=30))]
    for fault, one in zip(FAULTS, episodes[6:], strict=False):
        rows, time = one.observations, one.time
        if fault == "missing":
            rows[60:70, 1] = np.nan
        elif fault == "missing now and then":
            rows[60:90:3, 1] = np.nan
        elif fault == "wild":
            rows[60:70, 1] = 1e30
        elif fault == "frozen":
            rows[60:90, 1] = rows[60, 1]
        elif fault == "repeated":
            rows[60:90] = rows[60]
        elif fault == "out of range":
            rows[60:70, 1] = 900.0
        elif fault == "gap":
            time[60:] += 7.0
    return scan_episodes(episodes, sensors=SENSORS, detector="mahalanobis")


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_of_the_stream(fault, broken):
    names = [f"e{6 + i}" for i in range(len(FAULTS))]
    assert [one.episode.name for one in broken.episodes if one.faults] == names
    found, (what, name) = broken.episodes[6 + [*FAULTS].index(fault)], FAULTS[fault]
    (seen,) = [f for f in found.faults if f.fault == name]
    assert seen.what == what
    assert 60 <= seen.row <= {"missing": 62, "repeated": 72}.get(name, 66)
    # Gaps are said, and decide nothing: a recording is cut there.
    assert found.odd == (name != "gap")
    assert (what in found.suspects) == found.odd


def test_a_gap_between_pieces_of_one_recording():
    pieces = [episode(x, f"e{i}", time=20.0 * i + 0.1 * np.arange(150))
              for i, x in enumerate(logs())]  # fmt: skip
    assert not any(
        one.faults for one in scan_episodes(pieces, detector="range").episodes
    )  # so are all of them
    close = [episode(x, f"e{i}", time=15.0 * i + 500 * (i > 7) + 0.1 * np.arange(150))
             for i, x in enumerate(logs())]  # fmt: skip
    scan = scan_episodes(close, detector="range")
    faults = {one.episode.name: one.faults for one in scan.episodes if one.faults}
    assert {n: (f.what, f.fault, f.row) for n, (f,) in faults.items()} == {"e8": ("time", "gap", 0)}


def test_what_many_episodes_do_is_no_fault():
    """A gripper that rests for as long as it likes is not frozen."""
    episodes = [episode(x, f"e{i}") for i, x in enumerate(logs())]
    rng = np.random.default_rng(0)
    for one in episodes:
        rest = int(rng.integers(5, 60))
        one.observations[20 : 20 + rest, 2] = one.observations[20, 2]
    scan = scan_episodes(episodes, sensors=SENSORS, detector="range")
    assert not any(one.faults for one in scan.episodes)


def test_a_dead_sensor_and_one_that_is_constant():
    episodes = [episode(x, f"e{i}") for i, x in enumerate(logs())]
    for i, one in enumerate(episodes):
        one.observations[:, 2] = i  # a payload
    episodes[4].observations[:, 1] = np.nan
    scan = scan_episodes(episodes, sensors=SENSORS, detector="mahalanobis")
    assert [(one.episode.name, [str(f) for f in one.faults]) for one in scan.episodes
            if one.faults] == [("e4", ["torque missing at row 0"])]  # fmt: skip


# A watchdog


@pytest.fixture(scope="module")
def watchdog():
    return Watchdog.fit("mewma", logs(1, n=20), logs(2, n=40), alpha=0.1, sensors=SENSORS, rate=10)


def test_a_watchdog_judges_by_its_calibration(watchdog):
    episodes = logs(3, n=3)
    episodes[1][70:, 2] += 15
    scan = scan_episodes(episodes, sensors=SENSORS, watchdog=watchdog)
    (odd,) = scan.odd
    assert (odd.episode.name, odd.suspects[0]) == ("episode 1", "current")
    assert abs(odd.first - 70) <= 3
    largest = np.array(watchdog.calibration.largest)
    for one in scan.episodes:
        assert one.rank_p == rank_p(one.largest, largest)
    assert watchdog.promise in scan.notes[0]


def test_p_values_are_ranks_where_calibration_episodes_are_enough(watchdog):
    """41 places for a rate of 0.1: four episodes may be judged by rank, five need the tail."""
    n, largest = len(watchdog.calibration.largest), np.array(watchdog.calibration.largest)
    most = int(0.1 * (n + 1))
    episodes = logs(3, n=most + 1)
    episodes[1][70:, 2] += 15
    few, many = (
        scan_episodes(episodes[:m], sensors=SENSORS, watchdog=watchdog) for m in (most, most + 1)
    )
    assert [one.p for one in few.episodes] == [rank_p(one.largest, largest) for one in few.episodes]
    assert few.odd[0].p == 1 / (n + 1) > many.odd[0].p
    assert few.odd[0].threshold == pytest.approx(largest.max())
    assert abs(few.odd[0].first - 70) <= 3
    assert (len(few.notes), len(many.notes)) == (2, 1)


def test_a_watchdog_finds_columns_by_name_and_sees_faults_of_a_single_episode(watchdog):
    episodes = [x[:, [2, 0, 1, 0]] for x in logs(3, n=2)]
    episodes[0][70:, 0] += 15
    names = ["current", "speed", "torque", "spare"]
    (odd,) = scan_episodes(episodes, sensors=names, watchdog=watchdog).odd
    assert odd.suspects[0] == "current"
    with pytest.raises(UsageError, match="torque"):
        scan_episodes(episodes, sensors=["current", "speed", "torq", "spare"], watchdog=watchdog)
    (one,) = logs(3, n=1)
    assert not scan_episodes([one], sensors=SENSORS, watchdog=watchdog).odd
    one[50:60, 0] = np.nan
    (odd,) = scan_episodes([one], sensors=SENSORS, watchdog=watchdog).odd
    assert [(f.what, f.fault) for f in odd.faults] == [("speed", "missing")]


def test_a_recorded_score_is_no_sensor_of_a_scan_and_judges_none():
    episodes = logs()
    alone = scan_episodes(episodes, sensors=SENSORS, detector="mahalanobis")
    jumps = np.random.default_rng(1).normal(size=(150, 1)) * 100
    scored = [np.hstack([x, jumps * (i == 3)]) for i, x in enumerate(episodes)]
    columns = [Quantity(name, "1") for name in SENSORS] + [Quantity("mse", "1", "score")]
    beside = scan_episodes(scored, sensors=columns, detector="mahalanobis")
    assert beside.sensors == alone.sensors == SENSORS
    assert [x.episode.name for x in beside.ranked] == [x.episode.name for x in alone.ranked]
    for one, other in zip(beside.episodes, alone.episodes, strict=True):
        assert one.scores == pytest.approx(other.scores, nan_ok=True)
        assert one.p == pytest.approx(other.p)
    with pytest.raises(UsageError, match=r"column:mse is a column .* `oodd-eval calibrate`"):
        scan_episodes(scored, sensors=columns, detector="column:mse")


def test_a_watchdog_of_a_column_judges_the_episodes_of_a_scan_by_it():
    rng = np.random.default_rng(2)
    episodes = [np.hstack([x, rng.gamma(2, size=(150, 1))]) for x in logs(n=60)]
    columns = [*SENSORS, "mse"]
    watchdog = Watchdog.fit("column:mse", episodes[:5], episodes[5:45], 0.05, sensors=columns)
    judged = [x.copy() for x in episodes[45:55]]
    judged[4][90:, 3] += 30.0
    quantities = [Quantity(name, "1") for name in SENSORS] + [Quantity("mse", "1", "score")]
    first = scan_episodes(judged, sensors=quantities, watchdog=watchdog).ranked[0]
    assert (first.episode.name, first.row, first.faults) == ("episode 4", 90, ())
