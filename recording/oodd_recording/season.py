"""The split of a season: sizes and environments are fixed, kinds, strengths and seeds are drawn."""

import hashlib
from collections.abc import Sequence
from typing import Final, NamedTuple

from oodd_eval.data.condition import Condition, Rung, ladder_of, rungs_of
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, GROUPS, WORLDS, SplitDefinition, in_order
from oodd_eval.data.registry import anomaly_spec
from oodd_recording.build import digest_of_bits

SEASON_ENVIRONMENTS: Final = (*ENVIRONMENTS, *WORLDS)
SEASON_RUNGS: Final = ("kept95", "kept90", "kept75", "loss5", "loss10", "loss25")
"""Rungs that strengths are drawn from: of the policy's return, or of the growth of the loss."""

KINDS: Final = 4  # of each group in an environment, or as many as it has
NOISE: Final = 0.01
"""Of the benchmark's sensors, which are exact without; the worlds' have their own."""


class SeasonSizes(NamedTuple):
    """Numbers of episodes of a season in each environment, and their longest length.

    `cap` is that of the benchmark's environments; None stands for it, and for the worlds' own.
    """

    train: int = 60
    calibration: int = 80
    test: int = 12
    cap: int | None = None


CAP: Final = 300


def season_definition(
    bits: int,
    environments: Sequence[str] = SEASON_ENVIRONMENTS,
    sizes: SeasonSizes = SeasonSizes(),  # noqa: B008  a constant
) -> SplitDefinition:
    """Return the definition of the split that 128 random bits give.

    Those of an environment depend on its name and the bits alone. The specs of `environments` have
    to be registered.
    """
    by_environment: dict[str, dict[str, object]] = {}
    for environment in in_order(environments, SEASON_ENVIRONMENTS):
        by_environment[environment] = {"strengths": _strengths(bits, environment)}
        if environment not in ENVIRONMENTS:
            by_environment[environment] |= {"episode_cap": sizes.cap, "noise": 0.0}
    digest = digest_of_bits(bits)
    return SplitDefinition(
        name=f"season-{digest[:8]}",
        train=sizes.train,
        calibration=sizes.calibration,
        test=sizes.test,
        episode_cap=sizes.cap or CAP,
        seed_base=0,
        noise=NOISE,
        drawn=digest,
        environments=tuple(by_environment),
        by_environment=by_environment,
    )


def _strengths(bits: int, environment: str) -> dict[str, float]:
    """Draw kinds of each group, and a rung of each that its policy, or task, reaches."""
    strengths: dict[str, float] = {}
    ladder = {kind: _reached(environment, kind) for kind in ladder_of(environment)}
    kinds = [kind for kind, rungs in ladder.items() if rungs]
    drawn: list[str] = []
    for group in GROUPS:
        of_group = (kind for kind in kinds if anomaly_spec(kind).group == group)
        drawn += sorted(of_group, key=lambda kind: _number(bits, environment, kind))[:KINDS]
    for kind in in_order(drawn, ANOMALIES):
        rungs = ladder[kind]
        name = [*rungs][_number(bits, environment, kind, "strength") % len(rungs)]
        strengths[str(Condition(kind, name))] = rungs[name].strength
    return strengths


def _reached(environment: str, kind: str) -> dict[str, Rung]:
    rungs = rungs_of(environment, kind)
    return {name: rungs[name] for name in SEASON_RUNGS if name in rungs and rungs[name].reached}


def _number(bits: int, *words: str) -> int:
    """Return a number that nobody knows without the bits; no library's generator makes it."""
    text = "/".join((f"{bits:032x}", "season", *words))
    return int.from_bytes(hashlib.sha256(text.encode()).digest(), "big")
