"""Whether scores depend on the future: some episodes are scored a second time, cut short.

The scores of a prefix have to be the prefix of the scores. A detector that smooths, centres or
scales over a whole episode, that uses its length, or that keeps something of one episode for the
next gives others. The conformance check ``prefix`` asks this of made-up episodes; here it is asked
of the data that is scored, in every run.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.errors import ContractError
from oodd_eval.plugins.contract import Scores

PROBES: Final = 4
"""Prefixes scored per unit: a few percent of its cost, and one alone would do."""

MIN_ROWS: Final = 8
"""Observations of the shortest episode that is cut."""

TOLERANCE: Final = 1e-5
"""Relative difference that stands for the same score where computations differ in shape.

The summation order of a product of matrices depends on their shapes, and so, in single precision,
do the last digits. Where the same computation is done twice, scores have to be equal bit for bit.
"""

PROBE_TOLERANCE: Final = 1e-3
"""The same for episodes of a run, whatever the horizon.

A forecast that is fed its own output twenty times over multiplies what single precision leaves; a
detector that looks ahead differs by far more.
"""


@dataclass(frozen=True, slots=True)
class Probe:
    """The first `rows` observations of trajectory `index` of a part."""

    part: str
    index: int
    rows: int


def probes(lengths: Mapping[str, Sequence[int]], key: str) -> list[Probe]:
    """Draw prefixes of different episodes, between a quarter and three quarters of each.

    Parameters
    ----------
    lengths
        Observations of each trajectory, by part; what has fewer than `MIN_ROWS` is left out.
    key
        The same key gives the same probes anywhere.
    """
    every = ((part, i, n) for part, counts in lengths.items() for i, n in enumerate(counts))
    long = [(part, i, n) for part, i, n in every if n >= MIN_ROWS]
    seed = int.from_bytes(hashlib.sha256(f"probes|{key}".encode()).digest())
    rng = np.random.default_rng(seed)
    chosen = rng.permutation(len(long))[:PROBES]
    return [
        Probe(part, i, int(rng.integers(n // 4, 3 * n // 4, endpoint=True)))
        for part, i, n in (long[c] for c in chosen)
    ]


def check_prefix(found: Scores, whole: Scores, *, detector: str, where: str) -> None:
    """Check the scores of a prefix against those of the whole episode.

    Raises
    ------
    ContractError
        Naming the detector, the episode, the first score that differs and both its values.
    """
    if wrong := difference(found, whole[: len(found)], PROBE_TOLERANCE):
        raise ContractError(
            f"detector {detector!r} gives the first {len(found)} of {len(whole)} observations of "
            f"{where} other scores when they are all it gets: {wrong}; expected the same, as a "
            f"score may use nothing after its time and nothing of other episodes (`oodd-eval check "
            f"{detector} -k prefix`)"
        )


def difference(
    found: NDArray[np.float64], expected: NDArray[np.float64], tolerance: float = 0.0
) -> str:
    """Say where two score sequences of one length differ first; empty when they do not.

    Parameters
    ----------
    found, expected : float64 arrays of shape (n,)
    tolerance
        Allowed difference, relative to the larger of the score itself and the mean magnitude of
        all expected scores: a score that passes through zero has no relative precision.
    """
    usual = np.abs(expected[np.isfinite(expected)])
    # Scores near the largest float overflow here; that they are too large is found elsewhere.
    with np.errstate(invalid="ignore", over="ignore"):
        scale = np.maximum(np.abs(expected), usual.mean() if usual.size else 0.0)
        same = (found == expected) | (np.isnan(found) & np.isnan(expected))
        if tolerance:
            same |= np.abs(found - expected) <= tolerance * scale
    if same.all():
        return ""
    t = int(np.flatnonzero(~same)[0])
    return f"at t = {t} it is {found[t]:.10g} instead of {expected[t]:.10g}"
