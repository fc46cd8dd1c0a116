"""The units of a reproduction: their order, how many of them remain, and how long they take.

``costs.json`` has processor seconds by environment and setting: of a fit, which does not grow with
the split (the number of updates is fixed), and of scoring 1000 observations.
"""

import json
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

from oodd_eval.data.parts import TWINS
from oodd_eval.data.split import Split
from oodd_eval.names import counted
from oodd_eval.plugins import hookimpl
from oodd_eval.plugins.discovery import Plugins
from oodd_eval.plugins.parameters import parameters_of
from oodd_eval.prose import Table
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record
from oodd_eval.scoring.plan import Unit, make_unit
from oodd_paper.experiments import CONTROLS, PAPER, Experiment, Tier, of_paper, settings_of

# Units run stage after stage, and within a stage environment by environment.
STAGES: Final = (
    "controls",
    "models, Δ = 1",
    "variants of RIQN, Δ = 1",
    "Δ = 10",
    "Δ = 20",
    "more seeds of RIQN, Δ = 1",
    "more seeds of others, Δ = 1",
    "more seeds, Δ > 1",
)

COSTS: Final[Mapping[str, Mapping[str, tuple[float, float]]]] = json.loads(
    Path(__file__).with_name("costs.json").read_text(encoding="utf-8")
)

# Seconds assumed for a fit and for 1000 observations where nothing was measured.
UNKNOWN: Final = (30.0, 1.0)
WORKER_START: Final = 3.0


def lay_out(
    experiments: Sequence[Experiment],
    tier: Tier,
    split: Split,
    plugins: Plugins,
    device: str | None = None,
) -> list[Unit]:
    """Return every unit that some experiments need, cheap and informative ones first."""
    units, names = [], list(split.environments)
    for setting in settings_of(experiments):
        offer = plugins.offer(setting.detector)
        parameters = {**PAPER.get(setting.detector, {}), **setting.overrides}
        if device is not None and "device" in parameters_of(offer.spec.parameters):
            parameters["device"] = device
        units += [
            make_unit(
                offer, parameters, split, name, split.conditions(name), setting.horizon, seed, None
            )
            for name in names
            for seed in tier.seeds(setting)
        ]
    return sorted(units, key=lambda unit: (stage_of(unit), names.index(unit.environment)))


def stage_of(unit: Unit) -> int:
    """Return the index into `STAGES`."""
    if unit.setting.detector in CONTROLS:
        return 0
    variant = bool(of_paper(unit.setting).parameters)
    if unit.setting.horizon > 1:
        return 7 if unit.seed else 3 if unit.setting.horizon == 10 else 4
    if unit.seed:
        return 5 if unit.setting.detector in ("riqn", "riqn-ms") and not variant else 6
    return 2 if variant or unit.setting.detector == "n-riqn" else 1


def unfinished(units: Iterable[Unit], records: Iterable[Record]) -> list[Unit]:
    """Return the units of which not all cells have been scored without failure."""
    finished = {(record.scores, record.condition) for record in records if record.ok}
    return [u for u in units if any((u.scores_key, c) not in finished for c in u.conditions)]


def scored_rows(split: Split) -> dict[str, int]:
    """Return by environment how many observations a unit scores, from the manifest alone."""
    rows = dict.fromkeys(split.environments, 0)
    for environment in rows:
        for name, group in split.manifest["environments"][environment]["groups"].items():
            if name in {"calibration", TWINS} or name.startswith("test/"):
                rows[environment] += int(group["trajectories"]) + int(group["transitions"])
    return rows


def estimated_cost(setting: Setting, environment: str, rows: int) -> tuple[float, float]:
    """Return seconds on one core: of the fit, which units may share, and of everything else."""
    name = str(of_paper(setting))
    fit, per_thousand = COSTS.get(environment, {}).get(name, UNKNOWN)
    return fit, WORKER_START + per_thousand * rows / 1000


def remaining_seconds(
    units: Iterable[Unit], rows: Mapping[str, int], fitted: Collection[str]
) -> float:
    """Return seconds on one core for these units, a fit counted once, and not if in `fitted`.

    `rows` has the observations that a unit scores, by environment.
    """
    seen, total = set(fitted), 0.0
    for unit in units:
        fit, rest = estimated_cost(unit.setting, unit.environment, rows.get(unit.environment, 0))
        total += rest + (0.0 if unit.fit_key in seen else fit)
        seen.add(unit.fit_key)
    return total


def stages(
    planned: Sequence[Unit],
    left: Sequence[Unit],
    rows: Mapping[str, int],
    fitted: Collection[str],
    jobs: int,
) -> Table:
    """Return what remains of the planned units, stage by stage, and how long it takes."""
    lines, seen = [], set(fitted)
    for stage, title in [*enumerate(STAGES), (None, "all")]:
        units = [u for u in planned if stage in (None, stage_of(u))]
        to_do = [u for u in left if stage in (None, stage_of(u))]
        seconds = remaining_seconds(to_do, rows, fitted if stage is None else seen) / jobs
        seen |= {u.fit_key for u in to_do}
        if units or stage is None:
            counts = map(str, (len(units), len(units) - len(to_do), len(to_do)))
            lines.append([title, *counts, duration(seconds) if to_do else ""])
    on = f"time on {counted(jobs, 'core(s)')}"
    return Table("What remains", ["", "units", "done", "to do", on], lines)


def duration(seconds: float) -> str:
    """Return a duration as printed, such as ``"40 s"``, ``"12 min"`` or ``"3 h 20 min"``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"


class Progress:
    """An observer that tells of each finished unit, with the time that the others will take."""

    def __init__(
        self,
        units: Sequence[Unit],
        rows: Mapping[str, int],
        jobs: int,
        tell: Callable[[str], None] | None = None,
        fitted: Collection[str] = (),
    ) -> None:
        self._open = {(u.environment, u.setting.label(u.seed)): u for u in units}
        self._total, self._rows, self._jobs = len(units), rows, jobs
        self._tell, self._fitted = tell, set(fitted)
        self._cells: Counter[tuple[str, str]] = Counter()
        self._measured = self._expected = 0.0

    @hookimpl
    def oodd_cell_finished(self, record: Record, resumed: bool) -> None:
        """Tell of a unit when its last cell is there."""
        key = record.environment, record.cell.label
        self._cells[key] += 1
        if key not in self._open or self._cells[key] < len(self._open[key].conditions):
            return
        self._fitted.add(self._open.pop(key).fit_key)
        took = record.seconds_fit + record.seconds_score
        came_of = "kept" if resumed else "ok" if math.isnan(took) else duration(took)
        if not record.ok:
            came_of = f"{record.status}: {record.reason}"
        elif not resumed and not math.isnan(took):
            rows = self._rows.get(record.environment, 0)
            self._measured += took + WORKER_START
            self._expected += sum(estimated_cost(record.setting, record.environment, rows))
        if self._tell:
            done = f"[{self._total - len(self._open)}/{self._total}]"
            self._tell(f"{done} {'/'.join(key)}  {came_of}  ({duration(self.remaining())} left)")

    def factor(self) -> float:
        """Return by what factor finished units cost more than was estimated; 1 while unknown."""
        # A few quick units say nothing about long ones.
        return self._measured / self._expected if self._expected > 60 else 1.0

    def remaining(self) -> float:
        """Return the wall-clock seconds that the open units are expected to take."""
        seconds = remaining_seconds(self._open.values(), self._rows, self._fitted)
        return self.factor() * seconds / self._jobs
