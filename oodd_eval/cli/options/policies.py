"""Options of ``policies``."""

from __future__ import annotations

from oodd_eval.cli.options import Commands, Parser, command


def add(commands: Commands[Parser]) -> None:
    """Add ``policies`` and its actions."""
    policies = commands.add_parser("policies", help="train and evaluate nominal policies")
    actions = policies.add_subparsers(dest="action", metavar="ACTION", required=True)
    train = command(actions, "train", "policies:train", "train a policy (needs the extra train)")
    add = train.add_argument
    add("environment", metavar="ENV")
    add("--output", default="policies", metavar="DIR", help="checkpoint and best policy")
    add("--steps", type=int, metavar="N", help="environment steps in all")
    add("--seed", type=int, default=1, metavar="N")
    evaluate = command(actions, "evaluate", "policies:evaluate", "mean return of a policy")
    add = evaluate.add_argument
    add("environment", metavar="ENV")
    add("--policy", metavar="FILE", help="policy file (default: the frozen one)")
    add("--episodes", type=int, default=100, metavar="N", help="fresh episodes (default: 100)")
