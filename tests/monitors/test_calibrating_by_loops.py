"""All that `calibrate` says, computed once more by loops on random problems."""

import math
from fractions import Fraction

import numpy as np
import pytest
from oodd_monitors import LabelledScores, calibrate

from oodd_eval.errors import UsageError

ALARMS = ("threshold", "cusum", "ewma")


def problem(seed):
    """Logs with gaps, ties, windows, groups, labels, a level, a statistic and rows to hold."""
    rng = np.random.default_rng([seed, 69])
    n, steps = int(rng.integers(12, 90)), rng.choice([0, 1, 8])

    def scores(shift=0.0):
        values = rng.standard_t(3, size=int(rng.integers(6, 25))) + shift * rng.random()
        values = np.round(steps * values) / steps if steps else values
        values[rng.random(len(values)) < 0.15] = np.nan
        return np.concatenate([values, rng.integers(-1, 2, size=4) + (0.0 if steps else 1e-3)])

    logs = [scores() + 0.03 * i * (seed % 5 == 0) for i in range(n)]
    windows = None
    if seed % 3 == 1:
        windows = np.sort(rng.integers(0, max(1, n // int(rng.integers(1, 9))), size=n)).tolist()
        windows = [f"r{number}" for number in rng.permutation(windows)]
    labelled = []
    for _ in range(int(rng.integers(0, 12))):
        start = int(rng.integers(-1, 6))
        intervals = [(start, 8), (9, 10)] if rng.random() < 0.7 else []
        labelled.append(LabelledScores(scores(6.0), intervals, str(rng.choice(["slip", "jam"]))))
    return logs, {
        "level": float(rng.choice([0.02, 0.05, 0.1, 0.13, 0.25])),
        "alarm": ALARMS[seed % 3 if seed % 2 else int(rng.integers(3))],
        "hold": int(rng.integers(1, 4)),
        "recordings": windows,
        "labelled": labelled,
        "healthy": [scores() for _ in range(int(rng.integers(0, 6)))],
        "groups": [str(rng.choice(["a", "b", "c"], p=[0.6, 0.3, 0.1])) for _ in range(n)],
    }


class Loops:
    """The same by definitions."""

    def __init__(self, logs, level, alarm, hold, recordings):
        self.level, self.alarm, self.hold = level, alarm, hold
        labels = list(range(len(logs))) if recordings is None else recordings
        order = list(dict.fromkeys(labels))
        self.numbers = [order.index(label) for label in labels]
        self.recordings = len(order)
        standardizing, self.used = [], list(range(len(logs)))
        if alarm == "cusum":
            parity = self.numbers if len(order) > 1 else self.used
            odd = [i for i in self.used if parity[i] % 2]
            even = [i for i in self.used if not parity[i] % 2]
            standardizing, self.used = (even, odd) if len(odd) >= len(logs) // 2 else (odd, even)
        pooled = [s for i in standardizing for s in logs[i].tolist() if not math.isnan(s)]
        if pooled:
            self.mean = math.fsum(pooled) / len(pooled)
            unit = 2.0 ** (math.frexp(max(abs(s - self.mean) for s in pooled))[1] - 1)
            squares = math.fsum(((s - self.mean) / unit) ** 2 for s in pooled)
            self.std = unit * math.sqrt(squares / len(pooled))
        self.every = [max(self.statistic(s)) for s in logs]
        self.largest = [self.every[i] for i in self.used]
        unit = {i: self.numbers[i] for i in self.used}
        # A CUSUM takes twice as many, and windows count where recordings are too few.
        least = math.ceil(1 / Fraction(str(level))) - 1
        self.least = 2 * least if alarm == "cusum" else least
        self.promised = self.recordings >= self.least
        if not self.promised:
            unit = {i: i for i in self.used}
        sizes = {u: list(unit.values()).count(u) for u in unit.values()}
        needed, self.threshold = (1 - level) * (len(sizes) + 1), math.inf
        # Windows are refused where as many logs would be.
        for top in sorted(set(self.largest)) if len(logs) >= self.least else ():
            weight = sum(1 / sizes[unit[i]] for i in self.used if self.every[i] <= top)
            if weight >= needed - 1e-9:
                self.threshold = top
                break

    def own(self, scores):
        """The statistic of rows with a score, without rows to hold."""
        if self.alarm == "cusum":
            total = 0.0
            for s in scores:
                total = max(0.0, total + (0.01 * ((s - self.mean) / self.std) - 0.0018))
                yield total
        elif self.alarm == "ewma":
            mean = scores[0]
            for s in scores:
                mean = mean + 0.2 * (s - mean)
                yield mean
        else:
            yield from scores

    def statistic(self, scores):
        scores = [float(s) for s in scores]
        rows = [t for t, s in enumerate(scores) if not math.isnan(s)]
        result, values = [-math.inf] * len(scores), list(self.own([scores[t] for t in rows]))
        for k in range(self.hold - 1, len(rows)):
            result[rows[k]] = min(values[k - self.hold + 1 : k + 1])
        return result

    def first(self, scores):
        return next((t for t, s in enumerate(self.statistic(scores)) if s > self.threshold), None)

    def drift(self):
        """Rank correlation of recordings' largest statistics with their order, and its p-value."""
        tops = [-math.inf] * self.recordings
        for number, top in zip(self.numbers, self.every, strict=True):
            tops[number] = max(tops[number], top)
        n = len(tops)
        ranks = np.array([(sum(a < b for a in tops) + sum(a <= b for a in tops) - 1) / 2
                          for b in tops]) - (n - 1) / 2  # fmt: skip
        places = np.arange(n) - (n - 1) / 2
        norm = math.sqrt((ranks @ ranks) * (places @ places))
        correlation = abs(ranks @ places) / norm if norm else 0.0
        if correlation <= 1e-12 or n < 6:
            return correlation, 1.0
        drawn = np.random.default_rng([n, 999]).permuted(np.tile(places, (999, 1)), axis=1)
        larger = np.count_nonzero(np.abs(drawn @ ranks) / norm >= correlation - 1e-12)
        return correlation, (1 + larger) / 1000


def share_above(n, rank):
    """95 % interval of a share with the distribution Beta(n + 1 - rank, rank)."""

    def below(x):  # of n uniform numbers at least n + 1 - rank are below x
        return sum(math.comb(n, i) * x**i * (1 - x) ** (n - i) for i in range(n + 1 - rank, n + 1))

    ends = []
    for chance in (0.025, 0.975):
        low, high = 0.0, 1.0
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if below(middle) < chance else (low, middle)
        ends.append(low)
    return tuple(ends)


def gap(scores):
    longest = run = 0
    for s in scores:
        run = run + 1 if math.isnan(s) else 0
        longest = max(longest, run)
    return longest


def detections(loops, labelled, shortest):
    for kind in dict.fromkeys(episode.kind for episode in labelled):
        counts, delays = {"early": 0, "detected": 0, "missed": 0, "in_time": 0}, []
        for scores, intervals, _ in (e for e in labelled if e.kind == kind):
            first, start = loops.first(scores), intervals[0][0] if intervals else -1
            if first is None:
                counts["missed"] += 1
            elif first < start:
                counts["early"] += 1
            else:
                counts["detected"] += 1
                counts["in_time"] += first < shortest
                delays += [first - start] if start >= 0 else []
        yield kind, counts, float(np.median(delays)) if delays else None


@pytest.mark.parametrize("seed", range(200))
def test_random_problems_have_the_same_answers_by_loops(seed):
    logs, arguments = problem(seed)
    settings = [arguments[name] for name in ("level", "alarm", "hold", "recordings")]
    loops = Loops(logs, *settings)
    if math.isinf(loops.threshold):
        with pytest.raises(UsageError, match="too few"):
            calibrate(logs, **arguments)
        return
    result = calibrate(logs, **arguments)
    assert result.threshold == loops.threshold
    assert result.calibration.largest == tuple(loops.largest)
    for scores in [*logs[:5], *arguments["healthy"]]:
        assert result.statistic(scores).tolist() == loops.statistic(scores)
        assert result.first(scores) == loops.first(scores)
    assert result.needed == max(0, loops.least - loops.recordings)
    assert (result.promise[:7] == "at most") == loops.promised
    assert result.longest_gap == max(map(gap, logs))
    statistic, p = loops.drift()
    assert result.drift.statistic == pytest.approx(statistic, abs=1e-12)
    assert result.drift.p == p
    units = len({loops.numbers[i] for i in loops.used})
    assert result.sweep == (max(loops.largest), 1 / (units + 1))
    if len(set(loops.numbers)) == len(logs):
        n = len(loops.largest)
        low, high = share_above(n, sorted(loops.largest).index(loops.threshold) + 1)
        if loops.largest.count(loops.threshold) > 1:
            rank = n + 1 - math.floor(Fraction(str(loops.level)) * (n + 1))
            low, high = 0.0, share_above(n, rank)[1]
        assert result.share_interval == pytest.approx((low, high), abs=1e-12)
    else:
        assert result.share_interval is None
    assert result.false_alarms == sum(loops.first(s) is not None for s in arguments["healthy"])
    assert result.healthy == len(arguments["healthy"])
    rows = list(detections(loops, arguments["labelled"], min(map(len, logs))))
    for found, (kind, counts, delay) in zip(result.detections, rows, strict=True):
        assert (found.kind, found.episodes) == (
            kind,
            sum(counts[name] for name in ("early", "detected", "missed")),
        )
        assert {name: getattr(found, name) for name in counts} == counts
        assert math.isnan(found.delay) if delay is None else found.delay == delay
    assert list(result.groups) == list(dict.fromkeys(arguments["groups"]))
    for name, group in result.groups.items():
        members = [i for i, g in enumerate(arguments["groups"]) if g == name]
        scores, windows = [logs[i] for i in members], [loops.numbers[i] for i in members]
        alone = Loops(scores, *settings[:3], windows)
        assert group.episodes == len(members)
        assert group.above == sum(loops.first(s) is not None for s in scores)
        if math.isinf(alone.threshold):
            assert group.calibration is None
            assert "too few" in group.problem
        else:
            assert group.calibration.threshold == alone.threshold
            assert group.problem == ""


def test_random_problems_are_of_all_kinds():
    counts = dict.fromkeys((*ALARMS, "refused", "windows", "few", "tied", "drift", "groups"), 0)
    for seed in range(200):
        logs, arguments = problem(seed)
        try:
            result = calibrate(logs, **arguments)
        except UsageError:
            counts["refused"] += 1
            continue
        counts[result.alarm] += 1
        counts["windows"] += not result.whole
        counts["few"] += result.needed > 0
        counts["tied"] += result.calibration.largest.count(result.threshold) > 1
        counts["drift"] += result.drift.significant
        counts["groups"] += any(g.calibration for g in result.groups.values())
    assert min(counts.values()) >= 10, counts
