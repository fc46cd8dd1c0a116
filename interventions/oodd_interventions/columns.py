"""Columns of a study: what acting at alarms saves and costs, from the returns of its arms.

A record has the fields of its cell that say what it is of, the mean return of each arm
(``returns``), and ``intervention``: value, interval and number of episodes by column. Behind those
of cells come one for each act, detector and environment, of all its kinds of anomalies, and one for
each act and detector, a mean over environments. The latter's ``behind`` is the paired difference
from the detector that saves most.

Returns count in shares of the mean return of a cell's nominal twins. Seeds are resampled, jointly
for the detectors and the kinds of an environment.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from operator import itemgetter
from typing import Any, Final, TypeAlias

import numpy as np

from oodd_eval.data.bounded import without_nan
from oodd_eval.metrics.alarms import naming_contributions
from oodd_eval.metrics.auc import Contribution, mean_of
from oodd_eval.metrics.bootstrap import drawn_cell, mean_interval, mean_over_cells, nan_mean
from oodd_eval.metrics.catalogue import ATTRIBUTION, HEADLINE, INTERVENTIONS, metric_info
from oodd_eval.metrics.ranking import Position, differences
from oodd_eval.plugins.explanations import KINDS, NAMED
from oodd_eval.results.board import grouped
from oodd_eval.results.identity import Setting

RawCell: TypeAlias = Mapping[str, Any]
"""What a study keeps of a detector, an environment, an anomaly and an act, as JSON has it."""

InterventionRecord: TypeAlias = dict[str, Any]
_Terms: TypeAlias = dict[str, Contribution]
_Parts: TypeAlias = Sequence[tuple[RawCell, _Terms]]

ALL: Final = "all"
"""The anomaly, the group or the environment of a record that is of several."""

LEAST: Final = 0.05
"""Share of the nominal return from which on a fault costs, and acting on it saves, something."""

NAMINGS: Final = {name.removesuffix(f"_{HEADLINE}"): metric_info(name) for name in ATTRIBUTION[1:]}
"""Facts about the columns of namings: all but the sensor that is named first."""

COLUMNS: Final = {**INTERVENTIONS, **NAMINGS}
"""Facts about all columns by name."""

ARMS: Final = ("twin", "never", "watchdog", "oracle", "placebo", "false", "forced")

_RAW: Final = ("schema", "episodes", "curves", "provenance", "seconds")  # not in records
_ALIKE: Final = {"body", "environment"}  # kinds of faults that a naming need not tell apart


def row_of(cell: RawCell) -> str:
    """Return the row of a cell or a record in tables: its detector with what is no default."""
    return str(Setting.of(cell["detector"], cell["horizon"], cell["overrides"]))


def records_of(cells: Sequence[RawCell]) -> list[InterventionRecord]:
    """Return the records of cells in the order of tables, those of several behind theirs.

    Parameters
    ----------
    cells
        Of one study, so that those of an environment have the same seeds.
    """
    parts = [(cell, _terms(cell)) for cell in sorted(cells, key=_key)]
    behind = _behind(parts)

    def of(scope: int) -> list[InterventionRecord]:
        groups = grouped(parts, lambda part: _key(part[0])[:scope])
        return [_record(group, scope, behind.get(key, {})) for key, group in groups.items()]

    return [*of(4), *of(3), *of(2)]


def _key(cell: RawCell) -> tuple[str, str, str, str]:
    return cell["act"], row_of(cell), cell["environment"], cell["anomaly"]


def _record(parts: _Parts, scope: int, behind: Mapping[str, Any]) -> InterventionRecord:
    """Return the record of cells of a row that share the fields of a key up to a scope."""
    cell = parts[0][0]
    record = {name: value for name, value in cell.items() if name not in _RAW}
    if scope < 4:
        record |= dict.fromkeys(("environment", "anomaly", "group")[scope - 2 :], ALL)
    else:
        record["returns"] = {arm: float(_by_episode(cell, "returns", arm).mean()) for arm in ARMS}
    if behind:
        record["behind"] = behind
    record["intervention"] = {name: _figure(parts, name) for name in COLUMNS}
    plain: InterventionRecord = without_nan(record)
    return plain


def _figure(parts: _Parts, name: str) -> dict[str, float]:
    """Return a column of some cells: its value with the interval, and the number of episodes."""
    info, terms = COLUMNS[name], [(cell["environment"], terms[name]) for cell, terms in parts]
    pooled = terms if info.median else [*_pooled(terms).items()]
    low, high = mean_interval([drawn_cell(e, 0, c) for e, c in pooled], kind=info.interval)
    value = mean_over_cells((0, c.value) for _, c in pooled)
    return {"value": value, "low": low, "high": high, "n": sum(c.n for _, c in terms)}


def _pooled(terms: Iterable[tuple[str, Contribution]]) -> dict[str, Contribution]:
    """Return ratios of sums over the cells of each environment, which have the same seeds."""
    groups = grouped(terms, itemgetter(0)).items()
    terms_of = {e: [(c.numerator, c.denominator) for _, c in group] for e, group in groups}
    return {e: Contribution(*np.sum(of, axis=0)) for e, of in terms_of.items()}


def _by_episode(cell: RawCell, field: str, arm: str) -> Any:
    return np.array([episode[field][arm] for episode in cell["episodes"]], np.float64)


def _terms(cell: RawCell) -> _Terms:
    """Return the terms of each column by episode."""
    episodes = cell["episodes"]
    nominal = abs(_by_episode(cell, "returns", "twin").mean()) or math.nan
    twin, never, watchdog, oracle, placebo, false, forced = (
        _by_episode(cell, "returns", arm) / nominal for arm in ARMS
    )
    pays = (oracle - never).mean() >= LEAST
    harmless = (twin - never).mean() < LEAST
    fails, fails_still = (_by_episode(cell, "failed", arm) for arm in ("never", "watchdog"))
    effects = np.array([e["effect"] for e in episodes], float)
    acts = _by_episode(cell, "acted", "watchdog")  # NaN without one
    unneeded = twin - false + harmless * (never - watchdog)
    return _naming(episodes) | {
        "return_saved": Contribution(pays * (watchdog - never), pays * (oracle - never)),
        "placebo_saved": Contribution(pays * (placebo - never), pays * (oracle - never)),
        "safety_gain": mean_of(fails - fails_still),
        "residual_hazard": mean_of(fails_still),
        "availability_cost": Contribution(unneeded, np.full(len(acts), 1.0 + harmless)),
        "harm_on_nominal": mean_of(twin - false),
        "forced_harm": mean_of(twin - forced),
        "acted": mean_of(np.isfinite(acts).astype(float)),
        "act_delay": mean_of(np.where(acts >= effects, acts - effects, math.nan), median=True),
    }


def _naming(episodes: Sequence[Mapping[str, Any]]) -> _Terms:
    """Return the terms of the columns of namings, at alarms from the effect on."""
    named = [e["named"] if e["named"] and e["alarm"] >= e["effect"] else {} for e in episodes]

    def width(field: str) -> int:
        lengths = (len(naming["0"][field]) for naming in named if naming)
        return int(max([0, *lengths, *(1 + i for e in episodes for i in e["parts"][field])]))

    sensors = width("sensors")
    faulty = np.zeros((len(episodes), max(1, sensors + width("actuators"))), bool)
    namings = np.full((len(episodes), 3, 1 + faulty.shape[1]), -1, np.int8)
    kinds, errors = [], []
    for row, fault, episode, naming in zip(namings, faulty, episodes, named, strict=True):
        true, first = episode["parts"], naming.get("0")
        kind = true["kind"]
        fault[[*true["sensors"], *(sensors + i for i in true["actuators"])]] = True
        kinds.append([i for i, k in enumerate(KINDS) if k == kind or {k, kind} <= _ALIKE])
        errors.append(abs(first["onset"] - episode["effect"]) if first else math.nan)
        if first:
            for time, at in enumerate((first, naming.get("20", first))):
                parts = np.array([*at["sensors"], *at["actuators"]]) >= NAMED
                row[time, : 1 + len(parts)] = KINDS.index(at["kind"]) or -1, *parts
            largest = episode["largest"]["0"][: (row[0, 1:] > 0).sum()]
            row[2, [1 + sensor for sensor in largest]] = 1
    judged = np.array([bool(naming) for naming in named])
    terms = naming_contributions(namings, faulty, kinds, judged)
    return terms | {"onset_error": mean_of(errors, median=True)}


def _behind(parts: _Parts) -> dict[tuple[str, ...], dict[str, Any]]:
    """Return the difference of each row from the one that saves most, by act and row.

    Rows are compared where all of an act have a value, with Holm's correction within the act.
    """
    acts: dict[str, dict[str, dict[Position, Contribution]]] = {}
    for cell, terms in parts:
        act, row, environment, anomaly = _key(cell)
        if not math.isnan((saved := terms["return_saved"]).value):
            acts.setdefault(act, {}).setdefault(row, {})[environment, anomaly] = saved
    behind: dict[tuple[str, ...], dict[str, Any]] = {}
    for act, rows in acts.items():
        common = sorted(set.intersection(*map(set, rows.values())))
        pooled = {row: _pooled((p[0], of[p]) for p in common) for row, of in rows.items()}
        best = max(rows, key=lambda row: nan_mean(c.value for c in pooled[row].values()))
        compared = {row: {0: {(e, ALL): c for e, c in of.items()}} for row, of in pooled.items()}
        pairs = [(best, row) for row in rows if row != best and common]
        for test in differences(compared, pairs):
            figures = {"value": test.difference, "low": test.low, "high": test.high, "p": test.p}
            behind[act, test.second] = {"row": best, **figures}
    return behind
