"""Hours that a season takes on a machine as busy as the one where the reported rows were computed.

``python -P benchmarks/bench_season.py [--row 690] [--start 1.5] [--cores 2]`` counts fits and
streamed rows of a season of all committed entries in ten environments. Seconds of fits are those of
the reported records on split mini, longer by the ratio of training episodes; of detectors without
any they are the mean of the others. Microseconds of a streamed row and seconds of a fresh sandbox
are what ``bench_isolation.py --rows`` prints, by default the means of its table.
"""

import argparse
from pathlib import Path
from statistics import fmean

from oodd_leaderboard.entry import read_entries
from oodd_leaderboard.season import SEEDS
from oodd_recording.season import KINDS, SEASON_ENVIRONMENTS, SeasonSizes

from oodd_eval import load_split
from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.data.files import find_file
from oodd_eval.plugins.discovery import discover
from oodd_eval.results.directory import RECORDS, read_records

LEADERBOARD = Path(__file__).parents[1] / "leaderboard"
SANDBOXES = 2 * KINDS + 2  # of a unit: test parts, twins among them, and the fit
WORLDS_ROWS = 401.0


def rows_of_episode(environment):
    """Return the rows of a test episode, by those of mini, which has the same cap."""
    if environment not in ENVIRONMENTS:
        return WORLDS_ROWS
    groups = load_split("mini").manifest["environments"][environment]["groups"]
    tests = [group for name, group in groups.items() if name.startswith("test/")]
    return 1 + sum(g["transitions"] for g in tests) / sum(g["trajectories"] for g in tests)


def seconds_of_fits():
    """Return the mean seconds of a fit on mini by detector, with its default parameters."""
    seconds = {}
    for directory in sorted((LEADERBOARD / "results").glob("*-mini/")):
        file = find_file(directory / RECORDS)
        for record in read_records(file) if file else ():
            if record.ok and not record.overrides and record.horizon == 1:
                seconds.setdefault(record.detector, []).append(record.seconds_fit)
    return {name: fmean(values) for name, values in seconds.items()}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--row", type=float, default=690.0, help="microseconds")
    parser.add_argument("--start", type=float, default=1.5, help="seconds")
    parser.add_argument("--cores", type=int, default=2)
    options = parser.parse_args()
    sizes, plugins, fits = SeasonSizes(), discover(), seconds_of_fits()
    episodes = sizes.calibration + sizes.test * (1 + 2 * KINDS)
    rows = episodes * fmean(map(rows_of_episode, SEASON_ENVIRONMENTS))
    specs = [plugins.offer(e.detector).spec for e in read_entries(LEADERBOARD / "entries")]
    units = [(1 if s.deterministic else len(SEEDS)) * len(SEASON_ENVIRONMENTS) for s in specs]
    usual = fmean(fits.values())
    longer = sizes.train / load_split("mini").manifest["definition"]["train"]
    seconds = {
        "fits": sum(
            n * fits.get(spec.name, usual) * longer for spec, n in zip(specs, units, strict=True)
        ),
        "rows": sum(units) * rows * options.row / 1e6,
        "sandboxes": sum(units) * SANDBOXES * options.start,
    }
    total = sum(seconds.values()) / 3600
    print(f"{len(specs)} rows, {sum(units)} fits, {rows:.0f} streamed rows of each")
    print(", ".join(f"{name} {value / 3600:.1f} h" for name, value in seconds.items()))
    rate = sum(units) * rows / seconds["rows"]
    print(
        f"{rate:.0f} rows a second and core; {total:.1f} h of a core, {total / options.cores:.1f} h"
    )


if __name__ == "__main__":
    main()
