"""Hours that a season takes, from what a trial of it has taken.

``python benchmarks/bench_season.py TRIAL [--jobs 2]`` reads the directory of a ``leaderboard
season`` with few environments or episodes that ran without a break, so many fits at a time. The
seconds of a fit and of its streamed rows are those of the records. What is left of the time, by the
dates of the row's files, is of its sandboxes, and of waiting on a busy machine. For a season fits
count for all environments, with seconds in proportion to training episodes. Rows count for all
episodes, as long as the trial's.
"""

import argparse
from pathlib import Path
from statistics import fmean

from oodd_leaderboard.season_files import WORK, read_season
from oodd_recording.season import KINDS, SEASON_ENVIRONMENTS, SeasonSizes
from tabulate import tabulate

from oodd_eval.results.board import grouped


def busy(directory, jobs):
    """Return the seconds that the units of a row were at work, by the times of its files."""
    begun = (directory / "splits.json").stat().st_mtime
    ends = sorted(path.stat().st_mtime for path in directory.glob("scores/*.h5"))
    # Of the units that were at work together one began whenever another one ended.
    return sum(end - begun for end in ends[-jobs:])


def units_of(records):
    """Return a record of each fit, whose cost and rows those of its other cells have, too."""
    return [cells[0] for cells in grouped(records, lambda r: (r.environment, r.seed)).values()]


def costs_of(records, directory, jobs):
    """Return the mean seconds of a fit, microseconds of a row and seconds of a sandbox."""
    units = units_of(records)
    fits, scores = sum(r.seconds_fit for r in units), sum(r.seconds_score for r in units)
    sandboxes = len(records) + 2 * len(units)  # test parts, twins among them, and the fit
    other = busy(directory, jobs) - fits - scores
    steps = sum(r.steps_scored for r in units)
    return fits / len(units), 1e6 * scores / steps, other / sandboxes


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("trial", type=Path)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    season, sizes = read_season(options.trial), SeasonSizes()
    records = grouped(season.records(options.trial), lambda r: r.detector)
    rows = {name: of_row for name, of_row in records.items() if all(r.ok for r in of_row)}
    longer = sizes.train / season.split.definition["train"]
    table, lengths = {}, []
    for name, of_row in rows.items():
        fit, row, sandbox = costs_of(of_row, options.trial / WORK / name, options.jobs)
        for r in units_of(of_row):
            tests = r.counts["test"] * (1 + len(season.conditions[r.environment]))
            lengths.append(r.steps_scored / (r.counts["calibration"] + tests))
        seeds = len({r.seed for r in of_row})
        table[name] = [seeds * len(SEASON_ENVIRONMENTS), fit * longer, row, sandbox]
    streamed = fmean(lengths) * (sizes.calibration + sizes.test * (1 + 2 * KINDS))
    for costs in table.values():
        units, fit, row, sandbox = costs
        costs.append(units * (fit + streamed * row / 1e6 + (2 * KINDS + 2) * sandbox) / 3600)
    lines = [[name, *costs] for name, costs in table.items()]
    heads = ["row", "units", "s a fit", "us a row", "s a sandbox", "hours of a core"]
    print(tabulate(lines, heads, floatfmt=".2f", tablefmt="github"))
    units, *_, hours = map(sum, zip(*table.values(), strict=True))
    print(f"{len(table)} of {len(season.entries)} rows, {units} fits")
    print(f"{units * streamed / 1e6:.1f} million streamed rows, {hours:.1f} h of a core")


if __name__ == "__main__":
    main()
