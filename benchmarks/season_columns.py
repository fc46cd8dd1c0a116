"""The five columns of a season's board, computed again from its score files by the definitions.

``python benchmarks/season_columns.py SEASON [ROW ...] [--level 5]``, seconds a row. SEASON is the
directory of ``leaderboard season``, with its score files below ``work/`` and its split. Without
names all finished rows are computed. All that is computed here is written from docs/metrics.md and
docs/protocol.md alone. The package only reads what the board says, with which it is compared. Exit
code 1 where a difference exceeds 1e-9, or a column is undefined on one side alone.
"""

import argparse
import json
import lzma
import math
import sys
from pathlib import Path

import h5py
import numpy as np
from oodd_leaderboard.season_files import read_season
from tabulate import tabulate

from oodd_eval.results.board import Board

MOST = 1e-9
METRICS = ("auc_matched", "found_within_20", "missed", "false_episodes")
NAN = math.nan


def mean(values):
    """Return the mean of what is defined; NaN without any."""
    defined = [value for value in values if not math.isnan(value)]
    return math.fsum(defined) / len(defined) if defined else NAN


def auc(positives, negatives):
    """Return P(positive > negative) + P(tie) / 2 over all pairs of defined scores."""
    positives = positives[~np.isnan(positives)][:, None]
    negatives = negatives[~np.isnan(negatives)][None, :]
    pairs = positives.size * negatives.size
    wins, ties = np.sum(positives > negatives), np.sum(positives == negatives)
    return (wins + ties / 2) / pairs if pairs else NAN


class Alarm:
    """Guaranteed alarms at a level in percent (docs/metrics.md, "Guaranteed alarms")."""

    def __init__(self, calibration, kind, level):
        if kind not in ("cusum", "score"):
            raise ValueError(f"statistic {kind!r}, expected cusum or score")
        self.kind, judged = kind, calibration
        if kind == "cusum":
            # 1. Episodes 0, 2, 4, ... standardize, and the others give the threshold.
            pooled, judged = np.concatenate(calibration[::2]), calibration[1::2]
            pooled = pooled[~np.isnan(pooled)]
            equal = np.ptp(pooled) == 0
            self.mean, self.std = (pooled[0], 0.0) if equal else (pooled.mean(), pooled.std())
        # 3. The k-th smallest of the largest statistics, k = ceil((n + 1)(1 - level)), in integers.
        largest = sorted(self.statistic(scores).max() for scores in judged)
        rank = -(-(len(largest) + 1) * (100 - level) // 100)
        self.offered = rank <= len(largest)
        self.threshold = largest[rank - 1] if self.offered else math.inf

    def statistic(self, scores):
        """2. The CUSUM, which goes on after an alarm, or the score itself if it is declared."""
        if self.kind == "score":
            return np.where(np.isnan(scores), -math.inf, scores)
        if self.std > 0:
            x = 0.01 * (scores - self.mean) / self.std
        else:  # any higher score is an alarm at once
            x = np.where(scores > self.mean, math.inf, np.where(np.isnan(scores), NAN, 0.0))
        sums, total = np.zeros(len(x)), 0.0
        for t, value in enumerate(x.tolist()):
            if not math.isnan(value):
                total = sums[t] = max(0.0, total + value - 0.0018)
        return sums

    def first(self, scores):
        """Return the first row whose statistic is above the threshold; NaN without one."""
        above = np.flatnonzero(self.statistic(scores) > self.threshold)
        return float(above[0]) if above.size else NAN


def episode(scores, twin, effect, alarm):
    """Return the metrics of one anomalous episode (docs/metrics.md, both tables)."""
    common = min(len(scores), len(twin))  # rows that both episodes have
    first = alarm.first(scores)
    early = first < effect or effect >= len(scores)  # undefined
    found = float(effect <= first < min(effect + 20, common)) if effect < common else NAN
    return (
        auc(scores[effect:common], twin[effect:common]),  # at equal times, from the effect on
        NAN if early else found,
        NAN if early else float(math.isnan(first)),
        float(not math.isnan(alarm.first(twin))),  # never undefined
    )


def starts(part):
    """Return where episodes begin and end; a split counts transitions, one less than rows."""
    offsets = part["offsets"][:]
    return offsets + np.arange(len(offsets)) if "observations" in part else offsets


def by_episode(part, name):
    """Return the rows of a part by episode."""
    return np.split(part[name][:], starts(part)[1:-1])


def effects_of(split, part):
    """Return the first row of each episode that differs from its twin's (docs/metrics.md, "Words").

    An anomaly that is never felt counts from its onset on.
    """
    if split[part]["seeds"][:].tolist() != split["test/nominal"]["seeds"][:].tolist():
        raise ValueError(f"{split.filename}: {part} is not of the seeds of its twins")
    effects = []
    rows, twins = (by_episode(split[p], "observations") for p in (part, "test/nominal"))
    pairs = zip(rows, twins, split[part]["onsets"][:].tolist(), strict=True)
    for x, twin, onset in pairs:
        common = min(len(x), len(twin))
        differs = np.flatnonzero((x[:common] != twin[:common]).any(axis=1))
        effects.append(int(differs[0]) if differs.size else onset)
    if effects != split[part]["effects"][:].tolist():
        raise ValueError(f"{split.filename}: effects of {part} are other rows than its episodes'")
    return effects


def cells_of(path, split_path, kind, conditions, level):
    """Return the metrics of each cell of a score file, means over its episodes, by condition."""
    cells = {}
    with h5py.File(path) as file, h5py.File(split_path) as split:
        for part in ("calibration", "test/nominal", *(f"test/{c}" for c in conditions)):
            if starts(file[part]).tolist() != starts(split[part]).tolist():
                raise ValueError(f"{path}: {part} has other lengths than the split's")
        alarm = Alarm(by_episode(file["calibration"], "scores"), kind, level)
        twins = by_episode(file["test/nominal"], "scores")
        for condition in conditions:
            scores = by_episode(file[f"test/{condition}"], "scores")
            effects = effects_of(split, f"test/{condition}")
            pairs = zip(scores, twins, effects, strict=True)
            metrics = zip(*(episode(a, b, e, alarm) for a, b, e in pairs), strict=True)
            matched, *alarms = map(mean, metrics)
            cells[condition] = (matched, *(alarms if alarm.offered else [NAN] * len(alarms)))
    return cells


def over(cells):
    """Return the mean over seeds, of each seed's mean over its cells (docs/protocol.md, 6).

    A failed cell is a state, and a mean with one is undefined (docs/protocol.md, 6).
    """
    if any(values is None for values in cells.values()):
        return (NAN,) * len(METRICS)
    by_seed = {}
    for (seed, *_), values in cells.items():
        by_seed.setdefault(seed, []).append(values)
    means = [[mean(column) for column in zip(*rows, strict=True)] for rows in by_seed.values()]
    return tuple(mean(column) for column in zip(*means, strict=True))


def row_of(directory, name, level):
    """Return the metrics of a row, and its matched AUC by environment (docs/leaderboard.md)."""
    with lzma.open(directory / "rows" / f"{name}.jsonl.xz", "rt", encoding="utf-8") as lines:
        records = [json.loads(line) for line in lines]
    cells, files = {}, {}
    for r in records:
        condition = "@".join(filter(None, (r["anomaly"], r["strength"])))
        cells[r["seed"], r["environment"], condition] = None
        if r["status"] == "ok":
            unit = r["scores"], r["environment"], r["seed"], r["alarm"]
            files.setdefault(unit, []).append(condition)
    for (key, environment, seed, kind), conditions in files.items():
        path = directory / "work" / name / "scores" / f"{key}.h5"
        split = directory / "split" / f"{environment}.h5"
        for condition, values in cells_of(path, split, kind, conditions, level).items():
            cells[seed, environment, condition] = values
    by_environment = {
        e: over({key: values for key, values in cells.items() if key[1] == e})[0]
        for e in dict.fromkeys(environment for _, environment, _ in cells)
    }
    return over(cells), by_environment


def compared(name, computed, by_environment, board, level):
    """Return a line for each column of a row: what is computed, what the board says, how far."""
    (entry,) = (entry for entry in board.entries if entry.detector == name)
    lines = []
    for metric, value in zip(METRICS, computed, strict=True):
        column = metric if metric == METRICS[0] else f"{metric}_at_{level}pct"
        said = board.mean(entry, board.environments, board.anomalies, column)
        lines.append([name, column, value, said.value, distance(value, said.value), said.state])
    lowest = min((v for v in by_environment.values() if not math.isnan(v)), default=NAN)
    place, said = board.worst(entry) or ("", None)
    there = said.value if said else NAN
    # Of environments that are equally bad the board may name any.
    far = max(distance(value, there) for value in (lowest, by_environment.get(place, NAN)))
    lines.insert(1, [name, f"worst environment {place}", lowest, there, far, ""])
    return lines


def distance(first, second):
    """Return how far two values are apart; infinity where one of them alone is undefined."""
    undefined = math.isnan(first), math.isnan(second)
    return abs(first - second) if not any(undefined) else 0.0 if all(undefined) else math.inf


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("season", type=Path)
    parser.add_argument("rows", nargs="*", metavar="row")
    parser.add_argument("--level", type=int, default=5, help="of alarms, in percent")
    options = parser.parse_args(arguments)
    season = read_season(options.season)
    if not (records := season.records(options.season)):
        parser.error(f"{options.season} has no finished row")
    board = Board(records, season.expected)
    finished = [entry.detector for entry in board.entries]
    if missing := [name for name in options.rows if name not in finished]:
        parser.error(f"no finished row {', '.join(missing)}, expected some of {finished}")
    lines = []
    for name in options.rows or finished:
        row = row_of(options.season, name, options.level)
        lines += compared(name, *row, board, options.level)
    heads = ["row", "column", "computed", "the board's", "difference", "state"]
    print(tabulate(lines, heads, floatfmt=("", "", ".12f", ".12f", ".1e", ""), tablefmt="github"))
    differing = [line for line in lines if line[4] > MOST]
    print(f"{len(lines)} columns, {len(differing)} differ by more than {MOST:g}")
    return int(bool(differing))


if __name__ == "__main__":
    sys.exit(main())
