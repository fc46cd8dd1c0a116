"""The strengths of the suite *ladder*: numbers behind the names of its rungs."""

import functools
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from oodd_eval.names import check_known


@dataclass(frozen=True, slots=True)
class Rung:
    """One strength of an anomaly, and which share of its return the policy keeps at it.

    `low` and `high` are the ends of the strength's interval, `kept_low` and `kept_high` those of
    the share; NaN where unknown. `reached` is False where no sensible strength costs so much.
    """

    strength: float
    low: float = math.nan
    high: float = math.nan
    kept: float = math.nan
    kept_low: float = math.nan
    kept_high: float = math.nan
    reached: bool = True


@functools.cache
def rungs_of(environment: str, kind: str) -> Mapping[str, Rung]:
    """Return the rungs of an anomaly in an environment by name; none where it has no ladder."""
    file = Path(__file__).with_suffix(".json")
    table = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    rungs = table.get(environment, {}).get(kind, {}).get("rungs", {})
    return MappingProxyType({name: Rung(**row) for name, row in rungs.items()})


def strength_of(environment: str, kind: str, rung: str) -> float:
    """Return the strength of a rung; `UnknownNameError` where the ladder has no such rung."""
    rungs = rungs_of(environment, kind)
    check_known(f"rung of {environment}/{kind}", rungs, rung)
    return rungs[rung].strength
