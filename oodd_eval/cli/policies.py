"""``oodd-eval policies``: train and evaluate nominal policies."""

import argparse
from pathlib import Path

from oodd_recording.policies import load_policy
from oodd_recording.record import evaluate_policy
from oodd_recording.train.train import train_policy

from oodd_eval.cli import Parser, at_least
from oodd_eval.cli.terminal import know_own, make_console
from oodd_eval.data.facts import ENVIRONMENTS


def define(parser: Parser) -> None:
    """Add the actions and their options."""
    # fmt: off
    action = parser.nested("action")
    add = action("train", "train a policy (needs the extra train)").options(
        train, "policies train hopper --steps 200000", plugins=True
    )
    add("environment", metavar="ENV")
    add("--output", default="policies", metavar="DIR", help="checkpoint and best policy")
    add("--steps", type=int, metavar="N", help="environment steps in all")
    add("--seed", type=int, default=1, metavar="N")
    add = action("evaluate", "mean return of a policy").options(
        evaluate, "policies evaluate hopper --episodes 20", plugins=True
    )
    add("environment", metavar="ENV")
    add("--policy", metavar="FILE", help="policy file (default: the frozen one)")
    add("--episodes", type=at_least(1), default=100, metavar="N",
        help="fresh episodes (default: 100)")
    add("--noise", type=float, default=0.0, metavar="SHARE",
        help="noise of all sensors, in shares of their spread (default: 0)")
    # fmt: on


def train(options: argparse.Namespace) -> int:
    """Carry out ``policies train``, going on from a checkpoint if there is one."""
    _must_know(options)
    tell = make_console(quiet=options.verbosity < 0).print
    best = train_policy(
        options.environment,
        out=Path(options.output),
        steps=options.steps,
        seed=options.seed,
        progress=tell,
    )
    make_console().print(f"best policy in {best}")
    return 0


def evaluate(options: argparse.Namespace) -> int:
    """Carry out ``policies evaluate``: mean return over fresh nominal episodes."""
    name = options.environment
    _must_know(options)
    found = evaluate_policy(
        name, load_policy(name, options.policy), episodes=options.episodes, noise=options.noise
    )
    paper = f" (paper: {ENVIRONMENTS[name].paper_return})" if name in ENVIRONMENTS else ""
    mean = f"{found.mean():.1f} ± {found.std():.1f}"
    make_console().print(f"{name}: return {mean} over {options.episodes} episodes{paper}")
    return 0


def _must_know(options: argparse.Namespace) -> None:
    """Ask plug-ins for an environment that the benchmark does not have."""
    if options.environment not in ENVIRONMENTS:
        know_own(options)
