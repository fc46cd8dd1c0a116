"""How long it takes: measured costs of the reference detectors, corrected by what has finished.

``costs.json`` holds processor seconds on one core of a 2.x GHz server, on the mini split: of every
fit, and of scoring 1000 observations. Fits of networks do not grow with the split (their number of
updates is fixed); scoring is proportional to the observations.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from oodd_eval.data.layout import TWINS
from oodd_eval.data.split import Split
from oodd_eval.results.record import Record
from oodd_eval.scoring.plan import Unit

FILE: Final = Path(__file__).with_name("costs.json")

START: Final = 3.0
"""Seconds until a worker has imported what it needs."""

UNKNOWN: Final = 30.0
"""Seconds assumed for a fit that was never measured."""

USUAL_SAMPLES: Final = 8


@dataclass(frozen=True, slots=True)
class Cost:
    """Seconds on one core: of the fit, which units may share, and of everything else."""

    fit: float
    score: float


def estimate(unit: Unit, rows: int) -> Cost:
    """Return what one unit is expected to cost.

    Parameters
    ----------
    unit
        Detector, horizon, parameters and environment.
    rows
        Observations to score.
    """
    kind = _kind(unit)
    measured = _measured().get(unit.environment, {})
    fit = measured.get("fit", {}).get(kind)
    per_row = measured.get("score", {}).get(_scoring(unit, kind))
    if fit is None or per_row is None:
        return Cost(UNKNOWN if fit is None else fit, START + rows / 1000)
    return Cost(fit, START + per_row * rows / 1000)


def scored_rows(split: Split, environment: str) -> int:
    """Return how many observations a unit is scored on, from the manifest alone."""
    groups: Mapping[str, Any] = split.manifest["environments"][environment]["groups"]
    return sum(
        int(facts["trajectories"]) + int(facts["transitions"])
        for name, facts in groups.items()
        if name in {"calibration", TWINS} or name.startswith("test/")
    )


def correction(finished: Iterable[Record], rows: Mapping[str, int]) -> float:
    """Return the factor by which finished units cost more than was estimated; 1 where unknown.

    Parameters
    ----------
    finished
        One record of every finished unit.
    rows
        Observations that a unit of each environment is scored on.
    """
    measured = expected = 0.0
    for r in finished:
        if math.isnan(r.seconds_fit) or math.isnan(r.seconds_score):
            continue
        overrides = dict(r.overrides)
        unit = Unit(r.detector, r.horizon, r.seed, r.environment, r.parameters, overrides, ())
        cost = estimate(unit, rows.get(r.environment, 0))
        measured += r.seconds_fit + r.seconds_score + START
        expected += cost.fit + cost.score
    # A few quick units say nothing about long ones.
    return measured / expected if expected > 60 else 1.0


def duration(seconds: float) -> str:
    """Return a duration as printed, such as ``"40 s"``, ``"12 min"`` or ``"3 h 20 min"``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"


def _kind(unit: Unit) -> str:
    """Return whose fit it is: riqn-ms is fitted as riqn, and one network alone costs less."""
    name = "riqn" if unit.detector == "riqn-ms" else unit.detector
    return f"{name}[members=1]" if unit.overrides.get("members") == 1 else name


def _scoring(unit: Unit, kind: str) -> str:
    name = f"{unit.detector if unit.horizon > 1 else kind} h={unit.horizon}"
    if kind.endswith("]") and unit.horizon > 1:
        name = f"{kind} h={unit.horizon}"
    samples = unit.overrides.get("samples", USUAL_SAMPLES)
    return name if samples == USUAL_SAMPLES else f"{name} M={samples}"


@functools.cache
def _measured() -> dict[str, dict[str, dict[str, float]]]:
    read: dict[str, dict[str, dict[str, float]]] = json.loads(FILE.read_text(encoding="utf-8"))
    return read
