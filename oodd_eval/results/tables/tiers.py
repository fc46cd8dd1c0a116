"""What a board's split is, in the words that have to stand above its tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from oodd_eval.data.facts import SPLITS, SplitDefinition
from oodd_eval.data.split import published_digests
from oodd_eval.results.tables.board import Board
from oodd_eval.results.tables.markdown import escape

_TIERS: Final[Mapping[str, tuple[str, str]]] = {
    "standard": ("The leaderboard's own split", ""),
    "paper": ("The paper's size", ""),
    "reduced": (
        "Reduced tier",
        (
            " They are the first trajectories of the split standard, for machines on which the "
            "whole of it takes too long: intervals are wider than they would be there, fewer rows "
            "can be told apart, and the numbers are not those of standard."
        ),
    ),
    "mini": (
        "Trial tier",
        (
            " It comes with the package, for trying and for continuous integration: shorter "
            "episodes and too few test seeds to publish a method on."
        ),
    ),
}
"""Name of the tier and what else there is to say of it, by split."""


def about(board: Board) -> str:
    """Return which tier a board is of and what its split holds, as Markdown.

    A split is a published one by its digest, not by its name.
    """
    name = board.split
    if name not in SPLITS or published_digests().get(name) != board.digest:
        return (
            f"**Not a published split.** {escape(name)} was built by those who submitted these "
            "results; compare the rows with one another alone."
        )
    title, more = _TIERS.get(name, ("Published split", ""))
    return f"**{title}.** {_sizes(SPLITS[name])}.{more}"


def _sizes(split: SplitDefinition) -> str:
    cap = split.episode_cap
    episodes = "whole episodes" if cap is None else f"episodes of at most {cap} steps"
    return (
        f"Per environment {split.train} training and {split.calibration} calibration trajectories, "
        f"and {split.test} test seeds, each with its nominal twin and all anomalies; {episodes}"
    )
