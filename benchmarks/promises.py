"""Share of nominal test episodes with an alarm beside the promise, on splits that were imported.

``python benchmarks/promises.py SPLIT [...] [--detector NAMES] [--level 0.1] [--baseline B]
[--shuffles 20]`` takes every environment of the splits that was imported from logs. Its nominal
episodes, training, calibration and test as they follow one another, are judged in recorded order:
as they are, with baseline rows (the split's, or B), with a rolling calibration, and with both.
Then they are shuffled, split into parts of the same sizes and judged anew, which keeps the promise:
printed is the mean share and how many standard errors it is above the level; ``--shuffles 0``
leaves that out. Exit code 1 where that is more than 3. A detector that adapts learns from the
baseline rows by itself; from the others they are taken off.

Those figures are of scores alone. Behind them stand, without ``--baseline``, the nominal test
episodes with an alarm of a run and of a watchdog's replay, in which faults of the stream join. Both
are as many, or the exit code is 1. ``--write FILE`` writes all figures as CSV, see `COLUMNS`.
"""

import argparse
import csv
import sys
import warnings
from pathlib import Path

import numpy as np
from oodd_live import Watchdog

from oodd_eval import __version__, evaluate, load_split
from oodd_eval.data.baseline import Baseline
from oodd_eval.errors import OoddError, PromiseWarning
from oodd_eval.metrics.alarms import Calibration, rolling_rules
from oodd_eval.metrics.promise import drift_test
from oodd_eval.plugins.contract import make_detector, score_chunk
from oodd_eval.plugins.discovery import discover

ROWS = "clock,comb,random,persistence,range,mahalanobis,mewma,mewma-a"
SETTINGS = {"as it is": (False, False), "baseline": (True, False), "rolling": (False, True),
            "both": (True, True)}  # fmt: skip
COLUMNS = ("set", "row", *SETTINGS, "shuffled", "errors", "run", "episodes", "release")
"""Shares in per cent; `errors` are standard errors above the level, `run` counts `episodes`."""


def scored(spec, parts, *, rows=0, seed=0):
    """Return scores of calibration and test episodes; parts are training, calibration and test."""
    adapts = spec.adapts == "baseline"
    if rows and not adapts:
        base = Baseline.fit(parts[0], rows)
        parts = [[base.judged(x) for x in part] for part in parts]
    if spec.inputs == "observations":
        parts = [[x.without_actions() for x in part] for part in parts]
    learnt = rows if adapts else 0
    detector = make_detector(spec.factory, seed=seed, horizon=1, parameters={}, baseline=learnt)
    detector.fit(parts[0])
    return [[scores[learnt:] for scores in score_chunk(detector, part)] for part in parts[1:]]


def alarmed(spec, scores, level, *, rolling=False):
    """Return whether each test episode alarms, by the scores of calibration and test."""
    calibration, test = scores
    known = Calibration.fit(calibration, spec.alarm)
    rules = rolling_rules(known, test, level) if rolling else [known.rule(level)] * len(test)
    return [rule.first(one) is not None for rule, one in zip(rules, test, strict=False)]


def recorded_shares(spec, parts, level, rows):
    """Return the share of test episodes with an alarm by setting; "-" where none is promised."""
    shares = {}
    for baseline in (False, True) if rows else (False,):
        scores = scored(spec, parts, rows=rows if baseline else 0)
        for rolling in (False, True):
            name = next(name for name, on in SETTINGS.items() if on == (baseline, rolling))
            try:
                found = alarmed(spec, scores, level, rolling=rolling)
                shares[name] = f"{100 * np.mean(found):.0f}"
            except OoddError:
                shares[name] = "-"
    return {name: shares[name] for name in SETTINGS if name in shares}


def shuffled_share(spec, parts, level, rows, shuffles):
    """Return the mean share over random orders, and its standard errors above the level.

    The orders are drawn independently from the same episodes, so that their spread is what it is.
    """
    pool, ends = [x for part in parts for x in part], np.cumsum([len(part) for part in parts])[:-1]
    shares = []
    for draw in range(shuffles):
        order = np.random.default_rng(draw).permutation(len(pool))
        drawn = [[pool[k] for k in part] for part in np.split(order, ends)]
        scores = scored(spec, drawn, rows=rows, seed=draw)
        shares.append(np.mean(alarmed(spec, scores, level)))
    spread = np.std(shares, ddof=1) / np.sqrt(shuffles)
    # Equal shares tell nothing of their spread; a promise that is kept has at least the binomial's.
    error = max(spread, np.sqrt(level * (1 - level) / (shuffles * len(parts[2]))))
    return np.mean(shares), (np.mean(shares) - level) / error


def alarms(spec, split, data, level):
    """Return how many nominal test episodes alarm in a run, and by a watchdog's replay."""
    parameters = {"actions": "no"} if spec.with_actions else {}  # the row of this name
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PromiseWarning)
        record = evaluate(
            spec.name, split, environments=data.id, parameters={spec.name: parameters}
        )[0]
        watchdog = Watchdog.fit(spec.name, data, alpha=level, parameters=parameters)
    share = record.metrics[f"false_episodes_at_{100 * level:g}pct"].value
    live = sum(any(reading.alarm for reading in watchdog.replay(x)) for x in data.twins)
    return round(share * len(data.twins)), live


def report(name, parts, rows, specs, level, shuffles):
    """Print one environment, and yield a detector's figures after the other."""
    means = np.stack([x.observations.mean(axis=0) for part in parts for x in part])
    drift = drift_test(means.astype(np.float64))
    sizes = ", ".join(str(len(part)) for part in parts)
    print(f"\n{name}: {sizes} episodes; drift {drift.statistic:.2f}, p = {drift.p:.3f}; B = {rows}")
    for spec in specs:
        figures = recorded_shares(spec, parts, level, rows)
        line = ", ".join(f"{setting} {share}" for setting, share in figures.items())
        if shuffles:
            try:
                share, errors = shuffled_share(spec, parts, level, rows, shuffles)
                figures |= {"shuffled": f"{100 * share:.1f}", "errors": f"{errors:+.1f}"}
                line += f"; shuffled {figures['shuffled']} ({figures['errors']} s.e.)"
            except OoddError as error:
                line += f"; shuffled: {error}"
        print(f"  {spec.name:12} {line}", flush=True)
        yield spec, figures


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("splits", nargs="+")
    parser.add_argument("--detector", default=ROWS)
    parser.add_argument("--level", type=float, default=0.10)
    parser.add_argument("--baseline", type=int)
    parser.add_argument("--shuffles", type=int, default=20)
    parser.add_argument("--write", type=Path, help="CSV file of all figures")
    options = parser.parse_args()
    plugins = discover()
    specs = [plugins.offer(name).spec for name in plugins.select(options.detector)]
    kept, table = True, []
    for name in options.splits:
        split = load_split(name)
        with split.opened() as opened:
            for environment in split.environments:
                data = opened(environment)
                if data.logs is None:
                    continue
                rows = data.baseline if options.baseline is None else options.baseline
                parts = [list(data.train), list(data.calibration), list(data.twins)]
                label = f"{split.name}/{environment}"
                here = [spec for spec in specs if data.actions or "actions" not in spec.inputs]
                for spec, figures in report(
                    label, parts, rows, here, options.level, options.shuffles
                ):
                    kept &= float(figures.get("errors", 0)) <= 3
                    if options.baseline is None:
                        run, live = alarms(spec, split, data, options.level)
                        print(f"{'':14} alarms of {len(data.twins)}: run {run}, live {live}")
                        kept &= run == live
                        figures |= {"run": run, "episodes": len(data.twins)}
                    table.append({"set": name, "row": spec.name, **figures, "release": __version__})
    if options.write:
        with options.write.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows(table)
    return 0 if kept else 1


if __name__ == "__main__":
    sys.exit(main())
