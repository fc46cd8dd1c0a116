"""Checks that cost nothing: before an anomaly shows, nothing tells an episode from its twin.

Both are equal, bit for bit, up to the effect, the first row that differs. Whoever scores their rows
before it differently has seen what comes after, or remembers what else was scored.
"""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from oodd_eval.data.parts import TWINS
from oodd_eval.errors import ContractError
from oodd_eval.metrics.catalogue import LEVELS
from oodd_eval.plugins.contract import ROLLOUT_TOLERANCE, TOLERANCE, Scores, difference
from oodd_eval.results.record import Record

_MEANING: Final = "it uses what comes later, or what it keeps of other episodes"


def check_before_effect(
    parts: Mapping[str, Sequence[Scores]],
    effects: Mapping[str, Sequence[int]],
    *,
    environment: str,
    detector: str,
    horizon: int = 1,
    streamed: bool = False,
) -> None:
    """Raise `ContractError` when scores before the effect are not those of the twin.

    Parameters
    ----------
    parts
        Scores of a unit whose episodes have twins, by part.
    effects
        The first row of each episode that differs from its twin's, by anomalous part.
    environment, detector
        Names for the message.
    horizon
        Prediction horizon: forecasts that feed on themselves multiply what rounding leaves.
    streamed
        True where rows were scored one by one. Then scores agree bit for bit, else up to the
        tolerance of batches, see `oodd_eval.plugins.contract.difference`.
    """
    tolerance = 0.0 if streamed else TOLERANCE if horizon == 1 else ROLLOUT_TOLERANCE
    for part, rows in effects.items():
        pairs = zip(parts[part], parts[TWINS], rows, strict=True)
        for i, (scores, twin, effect) in enumerate(pairs):
            if problem := difference(scores[:effect], twin, tolerance):
                raise ContractError(
                    f"detector {detector!r} is not causal: scores of {environment}/{part}[{i}] are "
                    f"not those of its twin before t = {effect}, where they begin to differ: "
                    f"{problem}; {_MEANING} (`oodd-eval check {detector} -k prefix`)"
                )


def early_difference(record: Record) -> str:
    """Return which episode of a cell has an alarm before the effect, and its twin none; or neither.

    Parameters
    ----------
    record
        Of a cell with twins.

    Returns
    -------
    str
        One sentence about the first such episode, or a twin with the alarm; empty if none.
    """
    for level in LEVELS:
        names = f"early_{level}", f"early_null_{level}"
        if not all(name in record.per_trajectory for name in names):
            continue
        early, null = (record.per_trajectory[name] for name in names)
        differs = np.flatnonzero((early != null).any(axis=0))
        if len(differs):
            i = int(differs[0])
            return (
                f"detector {record.detector!r} is not causal: {names[0]} of {record.environment}/"
                f"{record.condition.part}[{i}] is {early[0, i]:g}, and {names[1]}, of its twin in "
                f"the same rows, {null[0, i]:g}: {_MEANING}"
            )
    return ""
