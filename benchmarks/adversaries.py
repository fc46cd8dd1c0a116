"""Gains of cheats: each adversary of the tests in a plain run, and in a re-run.

``python benchmarks/adversaries.py [--env cartpole,acrobot,hopper] [--anomaly iid,drift,gravity]
[--test 20] [--cap 200] [NAME ...]``
builds two small splits: one whose seeds and twins are known, as a published split's are, and one of
seeds drawn now. It runs the honest detector and each adversary on the first as a plain run does,
which trusts them, and on the second as a re-run does: in sandboxes, row by row. Exit code 1 when
one gains in the re-run: its matched AUC or its share found within 20 rows lies above the honest
detector's interval, and the honest one's below its own, over all or in an environment; or when the
one with a table of the first split's twins would be granted.

``--honest`` runs shipped detectors on split mini, and again on three splits of drawn seeds. Exit
code 1 when one is not granted three times.
"""

import argparse
import multiprocessing
import secrets
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest

TESTS = Path(__file__).parents[1] / "tests"
HERE = str(Path(__file__).parent)
sys.path[:] = [str(TESTS), *(path for path in sys.path if path != HERE)]  # it has libraries' names

import adversaries  # noqa: E402
from helpers_plugins import install_adversaries  # noqa: E402
from oodd_leaderboard.sandbox.launcher import Sandbox  # noqa: E402
from oodd_leaderboard.verify.rerun import differences  # noqa: E402
from oodd_recording.build import build_split, digest_of_bits  # noqa: E402

from oodd_eval.data.facts import CUSTOM_SEED_BASES, SPLITS, SplitDefinition  # noqa: E402
from oodd_eval.data.split import load_split, split_places  # noqa: E402
from oodd_eval.plugins.discovery import discover  # noqa: E402
from oodd_eval.plugins.isolation.child import Limits  # noqa: E402
from oodd_eval.results.board import Board, grouped  # noqa: E402
from oodd_eval.results.directory import ResultsDirectory  # noqa: E402
from oodd_eval.scoring.executors import RunSettings  # noqa: E402
from oodd_eval.scoring.plan import make_plan  # noqa: E402
from oodd_eval.scoring.runner import run  # noqa: E402

METRICS = ("auc_matched", "found_within_20_at_5pct")
SECONDS, MEMORY = 120.0, 4 * 10**9
HONEST_SECONDS = 3600.0


HONEST = {
    "mewma": {},
    "rf": {},
    "pyod:IForest": {},
    "pe-a": {"members": 1, "updates": 300},
    "pe": {"members": 1, "updates": 300},
    "riqn": {"members": 1, "updates": 250},
}
"""Shipped detectors and their parameters here: networks are trained for a short time."""

RERUNS = 3


def build(home, name, environments, *, train=12, test, cap, drawn):
    """Build a small split of a seed base, as a published one, or of drawn bits, as in a re-run."""
    taken = {definition.seed_base for definition in SPLITS.values()}
    base = 0 if drawn else secrets.choice([n for n in CUSTOM_SEED_BASES if n not in taken])
    bits = secrets.randbits(128) if drawn else None
    definition = SplitDefinition(
        name, train, 40, test, cap, base, drawn=digest_of_bits(bits) if drawn else ""
    )
    return build_split(definition, home / name, bits=bits, environments=environments)


def table_of(split):
    """Return the module in which an adversary keeps a split's twins."""
    cells = bytearray(adversaries.CELLS)
    for environment in split.environments:
        for twin in split.environment(environment).twins:
            rows = twin.observations
            adversaries.remember(rows, np.array([0, len(rows) - 1]), cells)
    known = np.flatnonzero(np.frombuffer(cells, np.uint8)).astype("<u4")
    return f"CELLS = {known.tobytes().hex()!r}\n"


def play(
    names, anomalies, directory, output, *, rerun, environments=None, parameters=None,
    seconds=SECONDS,
):  # fmt: skip
    """Run detectors on a split, in a process of its own: one of them patches its process."""
    split = load_split(directory)
    plan = make_plan(
        discover(), split=split, detectors=names, anomalies=anomalies, parameters=parameters,
        environments=environments or [*split.environments],
    )  # fmt: skip
    launcher = Sandbox((*split_places(split), str(output))) if rerun else None
    settings = RunSettings(limits=Limits(seconds, MEMORY), launcher=launcher, streamed=rerun)
    run(plan, split, discover(), settings, ResultsDirectory(output))


def isolated(*arguments, **more):
    """Call `play` in a fresh process."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        pool.submit(play, *arguments, **more).result()


def verdict(ours, theirs):
    """Return whether a row would be granted by its re-run, and its most standard errors better."""
    both = [grouped(side, lambda r: r.environment) for side in (ours, theirs)]
    sides = {name: (both[0][name], both[1][name]) for name in both[1]}
    if failed := next((r for r in (*ours, *theirs) if not r.ok), None):
        return False, f"{failed.status}: {failed.reason}"
    compared = differences(sides)
    most = max(compared, key=lambda d: d.z)
    granted = not any(d.refused for d in compared)
    where = f"{most.metric} {most.environment or 'mean'}"
    return granted, f"{'granted' if granted else 'refused'}, {most.z:.1f} {where}"


def honest(environments):
    """Run shipped detectors on mini, and again on drawn splits; return how many are refused."""
    refused = 0
    with tempfile.TemporaryDirectory() as directory:
        home, sizes = Path(directory), {"train": 40, "test": 10, "cap": 300}
        drawn = [build(home, f"drawn{k}", environments, **sizes, drawn=True) for k in range(RERUNS)]
        for name, parameters in HONEST.items():
            more = {"environments": environments, "parameters": parameters}
            more["seconds"] = HONEST_SECONDS
            isolated([name], None, "mini", home / "entry", rerun=False, **more)
            for k, split in enumerate(drawn):
                output = home / f"again{k}"
                isolated([name], None, split, output, rerun=True, **more)
                sides = [records_of(path, name) for path in (home / "entry", output)]
                granted, words = verdict(*sides)
                refused += not granted
                print(f"{name:14} re-run {k + 1}: {words}", flush=True)
    return refused


def records_of(output, name):
    return [r for r in ResultsDirectory(output).records() if r.detector == name]


def values(board, name, metric, environment=None):
    """Return an adversary's mean with its interval, or the state of the first failed cell."""
    setting = next(s for s in board.entries if s.detector == name)
    environments = [environment] if environment else board.environments
    return board.mean(setting, environments, board.anomalies, metric, intervals=True)


def gains(board, name):
    """Return where an adversary and the honest detector are outside each other's intervals."""
    places = []
    for metric in METRICS:
        for environment in (None, *board.environments):
            mine = values(board, name, metric, environment)
            base = values(board, adversaries.BASE, metric, environment)
            if not mine.state and mine.value > base.high and mine.low > base.value:
                where = environment or "all"
                places.append(f"{metric} {where}: {mine.value:.3f}, honest {base.value:.3f}")
    return places


def text(board, name):
    """Return both metrics of a row in percent, or its state."""
    means = [values(board, name, metric) for metric in METRICS]
    percent = " ".join(f"{100 * mean.value:5.1f}" for mean in means)
    return next((mean.state for mean in means if mean.state), percent)


def reasons(board, name):
    """Return why cells of an adversary failed, and how long they took."""
    records = [r for r in board.records if r.detector == name] if board else []
    failed = {f"{r.environment}: {r.status}: {r.reason}" for r in records if not r.ok}
    seconds = {(r.environment, r.seconds_fit, r.seconds_score) for r in records}
    return [*sorted(failed), *map(str, sorted(seconds, key=str))]


def board_of(output):
    return Board(ResultsDirectory(output).records())


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="adversaries; default all")
    parser.add_argument("--env", default="cartpole,acrobot,hopper")
    parser.add_argument("--anomaly", default="iid,drift,gravity")
    parser.add_argument("--test", type=int, default=20, help="more make fewer groups")
    parser.add_argument("--cap", type=int, default=200)
    parser.add_argument("--honest", action="store_true", help="shipped detectors instead")
    parser.add_argument("--verbose", action="store_true", help="say why cells failed")
    parser.add_argument("--rerun-only", action="store_true", help="leave out the plain runs")
    options = parser.parse_args()
    environments, anomalies = options.env.split(","), options.anomaly.split(",")
    start = time.monotonic()
    if options.honest:
        return int(honest(environments) > 0)
    with tempfile.TemporaryDirectory() as directory, pytest.MonkeyPatch.context() as patch:
        home = Path(directory)
        sizes = {"test": options.test, "cap": options.cap}
        published = build(home, "published", environments, **sizes, drawn=False)
        drawn = build(home, "drawn", environments, **sizes, drawn=True)
        install_adversaries(patch, home / "plugin")
        (home / "plugin" / "oodd_adversaries_table.py").write_text(table_of(load_split(published)))
        plain, again, gained = home / "plain", home / "again", 0
        print(
            f"{'adversary':26} {'plain':>13} {'re-run':>13}  (matched AUC, found within 20, in %)"
        )
        try:
            for batch in batches(options.names):
                if not options.rerun_only:
                    isolated(batch, anomalies, published, plain, rerun=False)
                isolated(batch, anomalies, drawn, again, rerun=True)
                boards = [None if options.rerun_only else board_of(plain), board_of(again)]
                gained += sum(told(*boards, name, options.verbose) for name in batch)
        finally:
            adversaries.sweep()
        names = {name for batch in batches(options.names) for name in batch} - {adversaries.BASE}
    print(f"{len(names)} adversaries in {time.monotonic() - start:.0f} s: {gained} gains")
    return int(gained > 0)


def batches(names):
    """Return the honest detectors, and then those named, or all by kind."""
    kinds = [[f"sly-{name}" for name in kind] for kind in adversaries.KINDS.values()]
    return [[adversaries.BASE], *([names] if names else kinds)]


def told(plain, again, name, verbose):
    """Print the row of one adversary; return the number of its gains."""
    cells = [text(plain, name) if plain else "", text(again, name)]
    granted, words = False, ""
    if plain:
        granted, words = verdict(
            *([r for r in b.records if r.detector == name] for b in (plain, again))
        )
    print(f"{name:26} {cells[0]:>13} {cells[1]:>13}  {words}")
    for reason in reasons(plain, name) + reasons(again, name) if verbose else ():
        print(f"  {reason}")
    gained = gains(again, name)
    if name == "sly-memorised" and granted:
        gained.append("a grant for a memorised board")
    for place in gained:
        print(f"  gains {place}")
    sys.stdout.flush()
    return len(gained)


if __name__ == "__main__":
    sys.exit(main())
