"""Runs of plug-ins that only sandboxes import, as a season has them.

``python tests/helpers_boxed.py PACKAGES SPLIT OUTPUT DETECTORS`` does one in a process of its own.
"""

import sys
from pathlib import Path

from oodd_leaderboard.sandbox.describe import discover_entry
from oodd_leaderboard.sandbox.launcher import Sandbox

from oodd_eval.data.split import load_split, split_places
from oodd_eval.plugins.isolation.child import Limits
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import make_plan
from oodd_eval.scoring.runner import run

MEMORY = 2 * 10**9


def boxed_plugins(packages, hidden=(), memory=MEMORY):
    """Return the plug-ins in a directory of packages, and the launcher of their workers."""
    launcher = Sandbox(hidden, [packages])
    return discover_entry(Path(packages), launcher, memory), launcher


def boxed_run(packages, split, output, detectors, *, anomalies=None, **settings):
    """Run detectors of a directory of packages in CartPole of a split; return their records."""
    split = load_split(split)
    plugins, launcher = boxed_plugins(packages, [*split_places(split), str(output)])
    plan = make_plan(
        plugins, split=split, detectors=detectors, environments=["cartpole"], anomalies=anomalies
    )  # fmt: skip
    settings = {"jobs": 1, "limits": Limits(300, MEMORY), "launcher": launcher} | settings
    return run(plan, split, plugins, RunSettings(**settings), ResultsDirectory(output)).records


if __name__ == "__main__":
    boxed_run(*sys.argv[1:4], sys.argv[4].split(","))
