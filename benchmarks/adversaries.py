"""Gains of cheats: each adversary of the tests in a plain run, and in a sandboxed one.

``python benchmarks/adversaries.py [--env cartpole,acrobot,hopper] [--anomaly iid,drift,gravity]
[--test 20] [--cap 200] [NAME ...]``
builds two small splits: one whose seeds and twins are known, as a published split's are, and one of
seeds drawn now. It runs the honest detector and each adversary on the first as a plain run does,
which trusts them, and on the second in sandboxes, row by row, as packages of a stranger. Exit code
1 when one gains there: its matched AUC or its share found within 20 rows lies above the honest
detector's interval, and the honest one's below its own, over all or in an environment.
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
from helpers_plugins import install_adversaries, write_adversaries  # noqa: E402
from oodd_leaderboard.sandbox.describe import discover_entry  # noqa: E402
from oodd_leaderboard.sandbox.launcher import make_sandbox  # noqa: E402
from oodd_recording.build import build_split, digest_of_bits  # noqa: E402

from oodd_eval.data.facts import CUSTOM_SEED_BASES, SPLITS, SplitDefinition  # noqa: E402
from oodd_eval.data.split import load_split, split_places  # noqa: E402
from oodd_eval.plugins.discovery import discover  # noqa: E402
from oodd_eval.plugins.isolation.child import Limits  # noqa: E402
from oodd_eval.results.board import Board  # noqa: E402
from oodd_eval.results.directory import ResultsDirectory  # noqa: E402
from oodd_eval.scoring.executors import RunSettings  # noqa: E402
from oodd_eval.scoring.plan import make_plan  # noqa: E402
from oodd_eval.scoring.runner import run  # noqa: E402

METRICS = ("auc_matched", "found_within_20_at_5pct")
SECONDS, MEMORY = 120.0, 4 * 10**9


def build(home, name, environments, *, test, cap, drawn):
    """Build a small split of a seed base, as a published one, or of bits drawn now."""
    taken = {definition.seed_base for definition in SPLITS.values()}
    base = 0 if drawn else secrets.choice([n for n in CUSTOM_SEED_BASES if n not in taken])
    bits = secrets.randbits(128) if drawn else None
    definition = SplitDefinition(
        name, 12, 40, test, cap, base, drawn=digest_of_bits(bits) if drawn else ""
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


def play(names, anomalies, directory, output, *, packages=None):
    """Run detectors on a split, in a process of its own: one of them patches its process."""
    split, launcher, plugins = load_split(directory), None, discover()
    if packages:
        launcher = make_sandbox((*split_places(split), str(output)), [packages])
        plugins = discover_entry(packages, launcher, MEMORY)
    plan = make_plan(
        plugins, split=split, detectors=names, anomalies=anomalies,
        environments=[*split.environments],
    )  # fmt: skip
    settings = RunSettings(
        limits=Limits(SECONDS, MEMORY), launcher=launcher, streamed=launcher is not None
    )
    run(plan, split, plugins, settings, ResultsDirectory(output))


def isolated(*arguments, **more):
    """Call `play` in a fresh process."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        pool.submit(play, *arguments, **more).result()


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
    parser.add_argument("--verbose", action="store_true", help="say why cells failed")
    parser.add_argument("--sandboxed-only", action="store_true", help="leave out the plain runs")
    options = parser.parse_args()
    environments, anomalies = options.env.split(","), options.anomaly.split(",")
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as directory:
        home = Path(directory)
        sizes = {"test": options.test, "cap": options.cap}
        published = build(home, "published", environments, **sizes, drawn=False)
        drawn = build(home, "drawn", environments, **sizes, drawn=True)
        write_adversaries(home / "plugin", table_of(load_split(published)))
        plain, again, gained = home / "plain", home / "again", 0
        title = f"{'adversary':26} {'plain':>13} {'sandboxed':>13}"
        print(f"{title}  (matched AUC, found within 20, in %)")
        try:
            for batch in batches(options.names):
                if not options.sandboxed_only:
                    with pytest.MonkeyPatch.context() as patch:
                        install_adversaries(patch, home / "plugin")
                        isolated(batch, anomalies, published, plain)
                isolated(batch, anomalies, drawn, again, packages=home / "plugin")
                boards = [None if options.sandboxed_only else board_of(plain), board_of(again)]
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
    print(f"{name:26} {cells[0]:>13} {cells[1]:>13}")
    for reason in reasons(plain, name) + reasons(again, name) if verbose else ():
        print(f"  {reason}")
    gained = gains(again, name)
    for place in gained:
        print(f"  gains {place}")
    sys.stdout.flush()
    return len(gained)


if __name__ == "__main__":
    sys.exit(main())
