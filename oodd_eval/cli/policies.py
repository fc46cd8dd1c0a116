"""``oodd-eval policies``: train and evaluate nominal policies."""

from __future__ import annotations

import argparse
from pathlib import Path

from oodd_eval.cli.terminal import make_console
from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.errors import UnknownNameError, UsageError


def train(options: argparse.Namespace) -> int:
    """Carry out ``policies train``, going on from a checkpoint if there is one."""
    _check(options.environment)
    console = make_console()

    def progress(line: str) -> None:
        if options.verbosity >= 0:
            console.print(line)

    from oodd_eval.data.simulate.train import train_policy  # noqa: PLC0415  an extra

    best = train_policy(
        options.environment,
        out=Path(options.output),
        steps=options.steps,
        seed=options.seed,
        progress=progress,
    )
    console.print(f"best policy in {best}")
    return 0


def evaluate(options: argparse.Namespace) -> int:
    """Carry out ``policies evaluate``: mean return over fresh nominal episodes."""
    _check(options.environment)
    if options.episodes < 1:
        raise UsageError(f"--episodes is {options.episodes}, expected at least 1")
    from oodd_eval.data.simulate.policies import load_policy  # noqa: PLC0415  an extra
    from oodd_eval.data.simulate.train import evaluate_policy  # noqa: PLC0415  an extra

    policy = load_policy(options.environment, options.policy)
    found = evaluate_policy(options.environment, policy, episodes=options.episodes)
    paper = ENVIRONMENTS[options.environment].paper_return
    make_console().print(
        f"{options.environment}: return {found.mean:.1f} ± {found.std:.1f} over "
        f"{options.episodes} episodes (paper: {paper})"
    )
    return 0


def _check(environment: str) -> None:
    if environment not in ENVIRONMENTS:
        raise UnknownNameError("environment", environment, ENVIRONMENTS)
