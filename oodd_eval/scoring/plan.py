"""What a run is going to do: units (one fit each) and their cells (one anomaly each)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from oodd_eval.data.facts import ANOMALIES
from oodd_eval.names import Predicate
from oodd_eval.plugins.discovery import Plugins, resolve_parameters


@dataclass(frozen=True, slots=True)
class Unit:
    """One fit: detector x parameters x horizon x seed x environment, and what it is scored on.

    Attributes
    ----------
    detector, horizon, seed, environment
        Names and numbers as on the command line.
    parameters
        All parameters, defaults included, sorted by name.
    overrides
        Those parameters that are not at their default: part of the cell's id.
    anomalies
        Ids of the anomalies to score.
    """

    detector: str
    horizon: int
    seed: int
    environment: str
    parameters: Mapping[str, Any]
    overrides: Mapping[str, Any]
    anomalies: tuple[str, ...]

    @property
    def label(self) -> str:
        """Detector and settings, the right-hand part of the cell's id."""
        settings = {"h": self.horizon, "seed": self.seed, **self.overrides}
        return f"{self.detector}[{','.join(f'{k}={_plain(v)}' for k, v in settings.items())}]"


@dataclass(frozen=True, slots=True)
class Plan:
    """All units of a run, in the order of the records.

    Attributes
    ----------
    split, split_digest
        The data.
    units
        What is fitted.
    limit
        The first so many trajectories of each part are used; None means all.
    """

    split: str
    split_digest: str
    units: tuple[Unit, ...]
    limit: int | None = None

    @property
    def cells(self) -> list[str]:
        """Ids of all cells, in order."""
        return [self.cell(unit, anomaly) for unit in self.units for anomaly in unit.anomalies]

    def cell(self, unit: Unit, anomaly: str) -> str:
        """Return the id of one cell, such as ``mini/hopper/iid::riqn[h=1,seed=0]``."""
        return f"{self.split}/{unit.environment}/{anomaly}::{unit.label}"

    def matching(self, wanted: Predicate) -> Plan:
        """Return the plan with those cells only whose ids pass; units without any are left out."""
        units = (
            replace(u, anomalies=tuple(a for a in u.anomalies if wanted(self.cell(u, a))))
            for u in self.units
        )
        return replace(self, units=tuple(u for u in units if u.anomalies))


def make_plan(
    plugins: Plugins,
    *,
    split: str,
    split_digest: str,
    detectors: Sequence[str],
    environments: Sequence[str],
    anomalies: Sequence[str] = tuple(ANOMALIES),
    horizons: Sequence[int] = (1,),
    seeds: Sequence[int] = (0,),
    parameters: Mapping[str, Any] | None = None,
    limit: int | None = None,
) -> Plan:
    """Lay out every unit, environments outermost.

    Raises
    ------
    UnknownNameError
        When a detector or one of its parameters does not exist.
    """
    offers = [plugins.offer(name) for name in detectors]
    settings = [(o.spec, resolve_parameters(o.spec, parameters or {})) for o in offers]
    units = tuple(
        Unit(
            detector=spec.name,
            horizon=horizon,
            seed=seed,
            environment=environment,
            parameters=resolved,
            overrides={
                k: v
                for k, v in resolved.items()
                if k not in spec.parameters or v != spec.parameters[k]
            },
            anomalies=tuple(anomalies),
        )
        for environment in environments
        for spec, resolved in settings
        for horizon in horizons
        for seed in seeds
    )
    return Plan(split, split_digest, units, limit)


def _plain(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, default=str)
