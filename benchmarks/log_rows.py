"""AUC of anomalous rows within files of public logs, the figure that their papers print.

    python benchmarks/log_rows.py --root DIR --half 1 --detector panel,pca,knn,mewma

``DIR/skab``, ``DIR/alfa``, ``DIR/tep``, ``DIR/uci`` and ``DIR/rosa`` hold files of the sets as they
are published; what is missing is left out. Of the faulty files in alphabetic order those with even
numbers are one half (0), on which members and settings of `panel` were looked at, and those with
odd numbers the other (1), which judges. Who is fitted on what:

- skab: the first 400 rows of each file; the others are judged (the set's own protocol).
- alfa: the flights without a failure. tep: d00, and rows 160 on of d01_te to d21_te are faulty.
- uci: half of the normal episodes of each file; rows of the faulty ones are compared with the same
  rows of the other normal ones. lp2 and lp3 are the same file.
- rosa: merged_data104, a healthy run at another speed; the first half of merged_data402 is half 0,
  the second half 1.

Printed are AUC by set and detector, their mean, the slowest fit, and, for skab, in how many cases
the statistic is below its largest nominal value within 60 rows after a fault, where the readings
themselves return: the median distance of rows 30 to 60 after it is at most twice that of nominal
rows. The first row of a file has no score and is left out. ``lstm-autoencoder`` is
`lstm_autoencoder.LstmAutoencoder`, which is no installed detector.
"""

import argparse
import csv
import sys
import time
from pathlib import Path

import numpy as np
from lstm_autoencoder import LstmAutoencoder

from oodd_eval import Trajectory
from oodd_eval.metrics.auc import auc
from oodd_eval.plugins.contract import make_detector
from oodd_eval.plugins.discovery import discover

ROWS = "panel,pca,knn,pyod:LOF,pyod:KNN,deedee,mewma,mahalanobis"
NOMINAL_ROWS = 400
RETURN = 60
ROSA = ("Actual Speed", "Shaft Control Effort", "Orient.", "AngVel", "LinAcc", "Mag", "Quat",
        "Temp", "Audio", "Strain Gage")  # fmt: skip


def table(path, delimiter=","):
    """Return the columns of a file with a header, by name; empty or textual cells are NaN."""
    with path.open(newline="") as file:
        head, *lines = csv.reader(file, delimiter=delimiter)

    def number(cell):
        try:
            return float(cell)
        except ValueError:
            return np.nan

    cells = np.array([[number(cell) for cell in line] for line in lines])
    columns = {}
    for name, values in zip(head, cells.T, strict=True):
        columns.setdefault(name.strip(), values)
    return columns


def filled(columns, names):
    """Return rows of columns with gaps held, and leading ones filled with the first value."""
    rows = np.stack([columns[name] for name in names], axis=1)
    for values in rows.T:
        known = np.flatnonzero(~np.isnan(values))
        if len(known):
            after = np.searchsorted(known, np.arange(len(values)), side="right") - 1
            values[:] = values[known[np.maximum(after, 0)]]
        else:
            values[:] = 0.0
    return rows


def skab(root, half):
    """Yield a task a file: nominal episodes, and labelled rows."""
    paths = [p for p in sorted(root.rglob("*.csv")) if "anomaly-free" not in p.name]
    for path in paths[half::2]:
        columns = table(path, ";")
        names = [n for n in columns if n not in {"datetime", "anomaly", "changepoint"}]
        rows, labels = filled(columns, names), columns["anomaly"] > 0
        yield [rows[:NOMINAL_ROWS]], [(rows[NOMINAL_ROWS:], labels[NOMINAL_ROWS:])]


def alfa(root, half):
    """Yield one task of all flights."""
    paths = sorted(root.rglob("*.csv"))
    nominal = [table(p) for p in paths if "no_failure" in p.name]
    faulty = [table(p) for p in paths if "no_failure" not in p.name][half::2]
    shared = set.intersection(*(set(c) for c in nominal + faulty)) - {"%time"}
    names = [n for n in nominal[0] if n in shared]
    tests = [(filled(c, names), np.nan_to_num(c["field.data"]) != 0) for c in faulty]
    yield [filled(c, names) for c in nominal], tests


def tep(root, half):
    """Yield one task of all faults."""
    tests = []
    for path in sorted(root.glob("d*_te.dat"))[1:][half::2]:
        rows = np.loadtxt(path)
        tests.append((rows, np.arange(len(rows)) >= 160))
    yield [np.loadtxt(root / "d00.dat").T], tests


def uci(root, half):
    """Yield a task a file, whose faults have no nominal beginning: normal and faulty episodes."""
    chosen = {0: ("lp1", "lp3", "lp5"), 1: ("lp4",)}[half]
    for path in (root / f"{name}.data" for name in chosen):
        episodes = []
        for line in path.read_text().splitlines():
            cells = line.split()
            if len(cells) == 1:
                episodes.append((cells[0] in {"normal", "ok"}, []))
            elif cells:
                episodes[-1][1].append([float(cell) for cell in cells])
        normal = [np.array(rows) for nominal, rows in episodes if nominal]
        faulty = [np.array(rows) for nominal, rows in episodes if not nominal]
        middle = len(normal) // 2
        yield normal[:middle], (normal[middle:], faulty)


def rosa(root, half):
    """Yield one task."""
    healthy, columns = (
        table(next(root.rglob(f"merged_data{number}.csv"))) for number in (104, 402)
    )
    with next(root.rglob("merged_data402.csv")).open(newline="") as file:
        labels = np.array([row["Binary Macro Health Mode"].strip() == "A"
                           for row in csv.DictReader(file, skipinitialspace=True)])  # fmt: skip
    names = [n for n in columns if n.startswith(ROSA)]
    middle = len(labels) // 2
    judged = slice(middle, None) if half else slice(middle)
    yield [filled(healthy, names)], [(filled(columns, names)[judged], labels[judged])]


# PyOD imports numba, which imports coverage: not the script of that name beside this one.
sys.path[:] = [path for path in sys.path if Path(path).resolve() != Path(__file__).parent]
OTHERS = {"lstm-autoencoder": LstmAutoencoder}
SETS = {"skab": skab, "alfa": alfa, "tep": tep, "uci": uci, "rosa": rosa}


def trajectory(rows):
    """Return rows as an episode without actions."""
    return Trajectory(rows, np.empty((len(rows) - 1, 0)))


def row_aucs(detector, tests):
    """Return AUC of each test: of rows within a file, or between episodes at the same rows."""
    if isinstance(tests, tuple):
        nominal, faulty = (
            np.stack([detector.score(trajectory(rows)) for rows in part]) for part in tests
        )
        return [np.mean([auc(faulty[:, t], nominal[:, t]) for t in range(1, nominal.shape[1])])]
    values = []
    for rows, labels in tests:
        if 0 < labels[1:].sum() < len(labels) - 1:
            scores, faulty = detector.score(trajectory(rows))[1:], labels[1:]
            values.append(auc(scores[faulty], scores[~faulty]))
    return values


def returns(detector, nominal, tests):
    """Yield whether the statistic has come down, for each fault after which the readings have."""
    mean, std = nominal[0].mean(axis=0), nominal[0].std(axis=0)

    def distances(rows):
        return np.sqrt((((rows - mean) / np.where(std < 1e-6, 1.0, std)) ** 2).mean(axis=1))

    for rows, labels in tests:
        stops = np.flatnonzero(labels[:-1] & ~labels[1:]) + 1
        for stop in stops:
            after = slice(stop + RETURN // 2, stop + RETURN)
            if len(rows) < stop + RETURN or labels[stop : stop + RETURN].any():
                continue
            if np.median(distances(rows[after])) > 2 * np.median(distances(nominal[0])):
                continue
            scores = detector.score(trajectory(rows))
            first = int(labels.argmax())
            limit = np.nanmax(np.r_[scores[:first], detector.score(trajectory(nominal[0]))])
            if np.nanmax(scores[first:stop]) > limit:
                yield bool((scores[stop : stop + RETURN] <= limit).any())


def unfitted(name, plugins):
    """Return an unfitted detector, installed or not."""
    if name in OTHERS:
        return OTHERS[name]()
    factory = plugins.offer(name).spec.factory
    return make_detector(factory, seed=0, horizon=1, parameters={})


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--half", type=int, choices=(0, 1), default=1)
    parser.add_argument("--detector", default=ROWS)
    options = parser.parse_args()
    plugins = discover()
    installed = [name for name in options.detector.split(",") if name not in OTHERS]
    names = plugins.select(",".join(installed)) if installed else []
    for name in (*names, *(name for name in options.detector.split(",") if name in OTHERS)):
        by_set, slowest, down = {}, 0.0, []
        for set_name, read in SETS.items():
            values = []
            for nominal, tests in read(options.root / set_name, options.half):
                detector = unfitted(name, plugins)
                started = time.process_time()
                detector.fit([trajectory(rows) for rows in nominal])
                slowest = max(slowest, time.process_time() - started)
                values += row_aucs(detector, tests)
                if set_name == "skab":
                    down += returns(detector, nominal, tests)
            if values:
                by_set[set_name] = np.mean(values)
        line = "  ".join(f"{key} {value:.3f}" for key, value in by_set.items())
        mean = np.mean(list(by_set.values()))
        cost = f"fit {slowest:.1f} s  down {sum(down)}/{len(down)}"
        print(f"{name:14} {line}  mean {mean:.3f}  {cost}", flush=True)


if __name__ == "__main__":
    main()
