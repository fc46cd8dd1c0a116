"""A plan: the units of a run (one fit each) and their cells (one anomaly each). Data only."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from oodd_eval.data.facts import ANOMALIES, PROTOCOL
from oodd_eval.names import Predicate
from oodd_eval.results.identity import Cell, Setting
from oodd_eval.results.record import Record


@dataclass(frozen=True, slots=True)
class Unit:
    """One fit: setting x seed x environment, and the anomalies that it scores.

    `parameters` are all that the factory gets, sorted by name; `shown` are those that are part of
    the result, which the device is not. `plugin` is empty for a factory of this process, which has
    no `source` (the digest of a plug-in's code) and no keys of stored scores and fits.
    """

    environment: str
    setting: Setting
    seed: int
    anomalies: tuple[str, ...]
    parameters: Mapping[str, Any]
    shown: Mapping[str, Any]
    plugin: str
    distribution: str
    version: str
    source: str = ""
    inputs: str = ""
    alarm: Literal["cusum", "score"] = "cusum"
    deterministic: bool = False
    scores_key: str = ""
    fit_key: str = ""

    @property
    def local(self) -> bool:
        """True if the detector is no plug-in's and runs in this process."""
        return not self.plugin


@dataclass(frozen=True, slots=True)
class Plan:
    """All units of a run, in the order in which they are begun and recorded.

    Of each part the first `limit` trajectories are used; None means all.
    """

    split: str
    split_digest: str
    units: tuple[Unit, ...]
    limit: int | None = None

    @property
    def cells(self) -> list[Cell]:
        """All cells, in order."""
        return [self.cell(unit, anomaly) for unit in self.units for anomaly in unit.anomalies]

    def cell(self, unit: Unit, anomaly: str) -> Cell:
        """Return one cell of a unit."""
        return Cell(self.split, unit.environment, anomaly, unit.setting, unit.seed)

    def matching(self, wanted: Predicate) -> "Plan":
        """Return the plan with those cells only whose text passes, without empty units."""
        units = (
            replace(u, anomalies=tuple(a for a in u.anomalies if wanted(str(self.cell(u, a)))))
            for u in self.units
        )
        return replace(self, units=tuple(u for u in units if u.anomalies))

    def blank(self, unit: Unit, anomaly: str, **outcome: Any) -> Record:
        """Return the record of a cell with its identity filled in, and no metrics."""
        return Record(
            detector=unit.setting.detector, horizon=unit.setting.horizon, seed=unit.seed,
            detector_version=unit.version, plugin=f"{unit.distribution}:{unit.plugin}",
            plugin_source=unit.source, parameters=dict(unit.shown),
            overrides=unit.setting.overrides, inputs=unit.inputs, alarm=unit.alarm,
            deterministic=unit.deterministic, environment=unit.environment, anomaly=anomaly,
            group=ANOMALIES[anomaly].group,
            split=self.split, split_digest=self.split_digest, limit=self.limit,
            scores=unit.scores_key, protocol=PROTOCOL, **outcome,
        )  # fmt: skip
