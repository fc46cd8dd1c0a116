"""Hours that a season takes, from the seconds of a trial season.

``python benchmarks/bench_season.py TRIAL [--entries DIR] [--fits RESULTS] [--cores 2]`` reads the
records of a trial season, which may be of few rows, one environment and few episodes, and prints
for each row the seconds of a fit, the microseconds that its detector takes for a row of an episode,
and the hours of a core for a season of ten environments. Fits whose updates a trial has cut short
are taken from other results of the same detectors (``--fits``, a directory of results directories).
Rows of `--entries` that were not measured count as the mean of the others. What a process in
a sandbox takes to start, with the imports of the detector, and a row to be sent, is measured here.
"""

import argparse
import subprocess
import sys
import time
from pathlib import Path
from statistics import fmean

HERE = str(Path(__file__).parent)
sys.path[:] = [path for path in sys.path if path != HERE]  # it has libraries' names

from oodd_leaderboard.entry import read_entries  # noqa: E402
from oodd_leaderboard.sandbox.launcher import make_sandbox  # noqa: E402
from oodd_leaderboard.season import SEEDS  # noqa: E402
from oodd_leaderboard.season_files import SPLIT, read_season  # noqa: E402
from oodd_recording.season import KINDS, SEASON_ENVIRONMENTS, SeasonSizes  # noqa: E402

from oodd_eval import load_split  # noqa: E402
from oodd_eval.data.files import find_file  # noqa: E402
from oodd_eval.plugins.discovery import discover  # noqa: E402
from oodd_eval.results.directory import RECORDS, read_records  # noqa: E402
from oodd_eval.scoring.executors import RunSettings  # noqa: E402
from oodd_eval.scoring.plan import make_plan  # noqa: E402
from oodd_eval.scoring.runner import run  # noqa: E402

GROUPS = 2 * KINDS + 2  # of a unit: the test parts, the twins, and the fit
TRIES = 3


def rows_of_unit(directory, sizes):
    """Return the rows of episodes that a unit of a season scores, by the lengths of the trial's."""
    split, rows = load_split(directory / SPLIT), []
    for environment in split.environments:
        groups = split.manifest["environments"][environment]["groups"]
        lengths = {
            name: 1 + group["transitions"] / group["trajectories"] for name, group in groups.items()
        }
        tests = [length for name, length in lengths.items() if name.startswith("test/")]
        rows.append(sizes.calibration * lengths["calibration"] + sizes.test * sum(tests))
    return fmean(rows)


def seconds_of_start(modules):
    """Return the seconds of a process in a sandbox that imports what a worker does, the least."""
    sandbox, taken = make_sandbox(), []
    code = "".join(f"import {name}\n" for name in ("oodd_eval.plugins.isolation.worker", *modules))
    for _ in range(TRIES):
        start = time.perf_counter()
        command, descriptors = sandbox.wrap([sys.executable, "-I", "-c", code])
        subprocess.run(command, pass_fds=descriptors, env=sandbox.environment(), check=True)
        taken.append(time.perf_counter() - start)
    return min(taken)


def seconds_of_message(directory, start):
    """Return the seconds of a row that is sent to a sandbox and whose score comes back."""
    split, plugins = load_split(directory / SPLIT), discover()
    environments = split.environments[:1]
    plan = make_plan(plugins, split=split, detectors=["clock"], environments=environments)
    settings = RunSettings(jobs=1, streamed=True, launcher=make_sandbox())
    begun = time.perf_counter()
    (record, *more) = run(plan, split, plugins, settings).records
    groups = len(more) + 3  # the test parts, the twins, and the fit
    return max(time.perf_counter() - begun - groups * start, 0.0) / record.steps_scored


def fits_of(results):
    """Return the mean seconds of a fit by detector in a directory of results directories."""
    seconds = {}
    for directory in sorted(results.glob("*/")):
        file = find_file(directory / RECORDS)
        for record in read_records(file) if file else ():
            if record.ok and not record.overrides and record.split == "mini":
                seconds.setdefault(record.detector, []).append(record.seconds_fit)
    return {name: fmean(values) for name, values in seconds.items()}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("trial", type=Path)
    parser.add_argument("--entries", type=Path, default=Path("leaderboard/entries"))
    parser.add_argument("--fits", type=Path)
    parser.add_argument("--cores", type=int, default=2)
    options = parser.parse_args()
    season, plugins, sizes = read_season(options.trial), discover(), SeasonSizes()
    records = [r for r in season.records(options.trial) if r.ok]
    long_fits = fits_of(options.fits) if options.fits else {}
    rows, starts, hours = rows_of_unit(options.trial, sizes), {}, {}
    starts[()] = seconds_of_start(())
    message = seconds_of_message(options.trial, starts[()])
    print(f"a row sent and scored in nothing: {1e6 * message:.0f} us")
    print(f"{'row':14} {'s a fit':>8} {'us a row':>9} {'s a start':>9} {'fits':>5} {'hours':>6}")
    for name, entry in season.entries.items():
        mine = [r for r in records if r.detector == name]
        if not (entry.shipped and mine):
            continue
        requires = plugins.offer(entry.detector).spec.requires
        if requires not in starts:
            starts[requires] = seconds_of_start(requires)
        trained = sizes.train / season.split.definition["train"]
        fit = max(fmean(r.seconds_fit for r in mine) * trained, long_fits.get(entry.detector, 0))
        row = sum(r.seconds_score for r in mine) / sum(r.steps_scored for r in mine)
        seeds = 1 if mine[0].deterministic else len(SEEDS)
        units = seeds * len(SEASON_ENVIRONMENTS)
        hours[name] = units * (fit + rows * (row + message) + GROUPS * starts[requires]) / 3600
        cells = f"{fit:8.1f} {1e6 * row:9.0f} {starts[requires]:9.2f} {units:5d}"
        print(f"{name:14} {cells} {hours[name]:6.2f}")
    offers = {e.name: plugins.offer(e.detector).spec for e in read_entries(options.entries)}
    units = sum((1 if s.deterministic else len(SEEDS)) for s in offers.values())
    units *= len(SEASON_ENVIRONMENTS)
    whole = sum(hours.values()) + fmean(hours.values()) * len({*offers} - {*hours})
    print(
        f"{len(offers)} rows, {units} fits, {units * rows / 1e6:.0f} million streamed rows: about "
        f"{whole:.1f} hours of a core, {whole / options.cores:.1f} on {options.cores}"
    )


if __name__ == "__main__":
    main()
