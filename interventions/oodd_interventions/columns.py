"""Columns of a study: what acting at alarms saves and costs, from the returns of its arms.

A record has the fields of its cell that say what it is of, the mean return of each arm
(``returns``), and ``intervention``: value, interval and number of episodes by column. Behind those
of cells come one for each act, detector and environment, of all its kinds of anomalies, and one for
each act and detector, a mean over environments. The latter's ``behind`` is the paired difference
from the detector that saves most.

Returns count in shares of the mean return of a cell's nominal twins. Seeds are resampled, jointly
for the detectors and the kinds of an environment.
"""

import itertools
import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np

from oodd_eval.data.bounded import read_json, without_nan
from oodd_eval.data.condition import Condition, in_suite_order
from oodd_eval.data.facts import ENVIRONMENTS, in_order
from oodd_eval.data.files import write_text
from oodd_eval.errors import ResultsError
from oodd_eval.metrics.auc import Contribution, mean_of
from oodd_eval.metrics.bootstrap import drawn_cell, mean_interval, mean_over_cells, nan_mean
from oodd_eval.metrics.catalogue import ATTRIBUTION, HEADLINE, INTERVENTIONS, metric_info
from oodd_eval.metrics.ranking import PairedDifference, Position, differences
from oodd_eval.results.identity import Setting

RawCell: TypeAlias = Mapping[str, Any]
"""What a study keeps of a detector, an environment, an anomaly and an act, as JSON has it."""

InterventionRecord: TypeAlias = dict[str, Any]

CELL: Final = "oodd-eval/intervention/1"
RECORDS: Final = "records.jsonl"

ALL: Final = "all"
"""The anomaly, the group or the environment of a record that is of several."""

LEAST: Final = 0.05
"""Share of the nominal return from which on a fault costs, and acting on it saves, something."""

COLUMNS: Final = {
    **INTERVENTIONS,
    **{name.removesuffix(f"_{HEADLINE}"): metric_info(name) for name in ATTRIBUTION},
}
"""Facts about the columns by name, those of namings last."""

ARMS: Final = ("twin", "never", "watchdog", "oracle", "placebo", "false", "forced")

_LEVELS: Final = (("environment", "anomaly"), ("environment",), ())
"""Fields by which cells make records, from records of one cell to those of all environments."""

_IDENTITY: Final = (
    *("detector", "detector_version", "plugin", "parameters", "overrides", "seed"),
    *("horizon", "split", "split_digest", "act", "level", "base", "cap"),
)
_OTHER: Final = {"body", "environment"}  # kinds of faults that no naming has to tell apart
_PARTS: Final = ("sensors", "actuators")
_NAMED: Final = 0.5  # probability from which on a part is named
_MOST: Final = 2**26  # bytes of a cell


class _Part(NamedTuple):
    """A cell and the terms of its columns."""

    cell: RawCell
    terms: dict[str, Contribution]


def read_cells(directory: Path) -> list[RawCell]:
    """Return the cells of the study in a directory; `ResultsError` for a file that is none."""
    cells: list[RawCell] = []
    for path in sorted(directory.glob("cells/*/*/*.json")):
        cell = read_json(path, _MOST, ResultsError)
        if not isinstance(cell, dict) or cell.get("schema") != CELL:
            raise ResultsError(f"{str(path)!r} is no cell of a study: expected the schema {CELL!r}")
        cells.append(cell)
    return cells


def write_records(directory: Path) -> list[InterventionRecord]:
    """Compute the records of the study in a directory, write them beside its cells, return them."""
    records = records_of(read_cells(directory))
    lines = (json.dumps(record, sort_keys=True) + "\n" for record in records)
    write_text(directory / RECORDS, "".join(lines))
    return records


def row_of(cell: RawCell) -> str:
    """Return the row of a cell or a record in tables: its detector with what is no default."""
    return str(Setting.of(cell["detector"], cell["horizon"], cell["overrides"]))


def records_of(cells: Sequence[RawCell]) -> list[InterventionRecord]:
    """Return the records of cells in the order of tables, those of several behind theirs.

    Parameters
    ----------
    cells
        As `read_cells` returns them.

    Raises
    ------
    ResultsError
        When cells are of different splits, levels, caps or seeds: then no mean can be over them.
    """
    _check_alike(cells)
    names = in_order((cell["environment"] for cell in cells), ENVIRONMENTS)
    kinds = in_suite_order(_condition(cell) for cell in cells)
    ordered = sorted(
        cells,
        key=lambda c: (
            *(c["act"], row_of(c), names.index(c["environment"]), kinds.index(_condition(c))),
        ),
    )
    parts = [_Part(cell, _terms(cell)) for cell in ordered]
    behind = _behind(parts)
    records = []
    for fields in _LEVELS:
        for group in _grouped(parts, ("act", *fields)):
            record = _record(group, fields)
            if not fields and (test := behind.get((record["act"], row_of(record)))):
                figures = {"value": test.difference, "low": test.low, "high": test.high}
                record["behind"] = without_nan({"row": test.first, **figures, "p": test.p})
            records.append(record)
    return records


def _condition(cell: RawCell) -> Condition:
    return Condition.parse(cell["anomaly"])


def _check_alike(cells: Sequence[RawCell]) -> None:
    """Refuse cells that differ in what a study has in common."""
    expected: dict[str, list[Any]] = {}
    for c in cells:
        seeds = [episode["seed"] for episode in c["episodes"]]
        study = [c["split_digest"], c["level"], c["base"]]
        for scope, facts in (("", study), (c["environment"], [c["cap"], *seeds])):
            if (first := expected.setdefault(scope, facts)) != facts:
                raise ResultsError(
                    f"the cell {c['environment']}/{row_of(c)}/{c['anomaly']}--{c['act']} has "
                    f"{facts}, expected {first} as in the cells before it: cells of one study are "
                    "of one split, level, cap and the same seeds; run it with --fresh, or name "
                    "another directory with --output"
                )


def _grouped(parts: Sequence[_Part], fields: Collection[str]) -> Iterator[list[_Part]]:
    """Yield the parts of each row and combination of fields, in their order."""
    groups: dict[tuple[str, ...], list[_Part]] = {}
    for part in parts:
        key = (row_of(part.cell), *(part.cell[field] for field in fields))
        groups.setdefault(key, []).append(part)
    yield from groups.values()


def _record(parts: Sequence[_Part], fields: Collection[str]) -> InterventionRecord:
    """Return the record of some cells of a row, one for each combination of some fields."""
    cells = [part.cell for part in parts]
    groups = {cell["group"] for cell in cells}
    returns = {arm: np.mean([_mean_return(cell, arm) for cell in cells]) for arm in ARMS}
    figures = {name: _figure(parts, name) for name in COLUMNS if name in parts[0].terms}
    of = {name: cells[0][name] if name in fields else ALL for name in _LEVELS[0]}
    record = {name: cells[0][name] for name in _IDENTITY} | of
    record["group"] = groups.pop() if len(groups) == 1 else ALL
    record |= {"cells": len(cells), "seconds": math.fsum(cell["seconds"] for cell in cells)}
    if "environment" in fields:  # returns of several environments have no mean
        record["returns"] = {arm: float(mean) for arm, mean in returns.items()}
    return {**record, "intervention": figures}


def _mean_return(cell: RawCell, arm: str) -> float:
    return float(np.mean([episode["returns"][arm] for episode in cell["episodes"]]))


def _figure(parts: Sequence[_Part], name: str) -> dict[str, Any]:
    """Return a column of some cells: its value with the interval, and the number of episodes."""
    info = COLUMNS[name]
    by_environment: dict[str, list[Contribution]] = {}
    for cell, terms in parts:
        by_environment.setdefault(cell["environment"], []).append(terms[name])
    drawn = [
        drawn_cell(environment, 0, terms)
        for environment, of_cells in by_environment.items()
        # A ratio is one of sums over kinds; a median is the mean of theirs.
        for terms in (of_cells if info.median else [_sum(of_cells)])
    ]
    value = mean_over_cells((0, value) for cell in drawn for value in cell.values)
    low, high = mean_interval(drawn, kind=info.interval)
    n = sum(terms[name].n for _, terms in parts)
    return {**without_nan({"value": value, "low": low, "high": high}), "n": n}


def _sum(terms: Sequence[Contribution]) -> Contribution:
    """Return the ratio of sums over cells of the same seeds."""
    sums = (np.sum([getattr(t, end) for t in terms], 0) for end in ("numerator", "denominator"))
    return Contribution(*sums)


def _terms(cell: RawCell) -> dict[str, Contribution]:
    """Return the terms of each column by episode."""
    episodes = cell["episodes"]
    nominal = abs(_mean_return(cell, "twin")) or math.nan
    twin, never, watchdog, oracle, placebo, false, forced = (
        np.array([episode["returns"][arm] for episode in episodes]) / nominal for arm in ARMS
    )
    pays = np.mean(oracle - never) >= LEAST
    harmless = np.mean(twin - never) < LEAST
    failed = {arm: np.array([e["failed"][arm] for e in episodes], float) for arm in ARMS}
    acts = [e["acted"]["watchdog"] for e in episodes]
    delays = [
        math.nan if act is None or act < e["effect"] else float(act - e["effect"])
        for act, e in zip(acts, episodes, strict=True)
    ]
    unneeded = twin - false + harmless * (never - watchdog)
    terms = {
        "return_saved": Contribution((watchdog - never) * pays, (oracle - never) * pays),
        "placebo_saved": Contribution((placebo - never) * pays, (oracle - never) * pays),
        "safety_gain": mean_of(failed["never"] - failed["watchdog"]),
        "residual_hazard": mean_of(failed["watchdog"]),
        "availability_cost": Contribution(unneeded, np.full(len(episodes), 1.0 + harmless)),
        "harm_on_nominal": mean_of(twin - false),
        "forced_harm": mean_of(twin - forced),
        "acted": mean_of([float(act is not None) for act in acts]),
        "act_delay": mean_of(delays, median=True),
    }
    named = [_naming(episode) for episode in episodes]
    values = {name: [of_episode.get(name, math.nan) for of_episode in named] for name in COLUMNS}
    return terms | {
        name: mean_of(numbers, median=COLUMNS[name].median)
        for name, numbers in values.items()
        if name not in INTERVENTIONS
    }


def _naming(episode: Mapping[str, Any]) -> dict[str, float]:
    """Return what the naming at an alarm from the effect on is worth, by column."""
    if episode["alarm"] is None or episode["alarm"] < episode["effect"] or not episode["named"]:
        return {}
    true, named = episode["parts"], episode["named"]["0"]
    is_right = named["kind"] == true["kind"] or {named["kind"], true["kind"]} <= _OTHER
    values = {"kind_named": float(is_right), "onset_error": math.nan}
    if named["onset"] >= 0:
        values["onset_error"] = float(abs(named["onset"] - episode["effect"]))
    at_fault = {(field, i) for field in _PARTS for i in true[field]}
    if not at_fault:
        return values
    for rows, suffix in (("0", ""), ("20", "_20")):
        if rows in episode["named"]:
            parts = _named(episode["named"][rows])
            values[f"named_recall{suffix}"] = len(parts & at_fault) / len(at_fault)
            if parts:
                values[f"named_precision{suffix}"] = len(parts & at_fault) / len(parts)
    every = {(field, i) for field in _PARTS for i in range(len(named[field]))}
    values["named_chance"] = len(every & at_fault) / len(every)
    if true["sensors"]:
        largest = episode["largest"]["0"][: len(_named(named))]
        values["named_largest"] = len({*largest} & {*true["sensors"]}) / len(true["sensors"])
    return values


def _named(naming: Mapping[str, Any]) -> set[tuple[str, int]]:
    """Return the parts that a naming names."""
    return {(field, i) for field in _PARTS for i, p in enumerate(naming[field]) if p >= _NAMED}


def _behind(parts: Sequence[_Part]) -> dict[tuple[str, str], PairedDifference]:
    """Return the difference of each row from the one that saves most, by act and row.

    Rows are compared where all of an act have a value, with Holm's correction within the act.
    """
    by_act: dict[str, dict[str, dict[Position, Contribution]]] = {}
    for cell, terms in parts:
        if not math.isnan(terms["return_saved"].value):
            cells = by_act.setdefault(cell["act"], {}).setdefault(row_of(cell), {})
            cells[cell["environment"], cell["anomaly"]] = terms["return_saved"]
    behind: dict[tuple[str, str], PairedDifference] = {}
    for act, rows in by_act.items():
        common = sorted(set.intersection(*({*cells} for cells in rows.values())))
        compared = {row: {0: _by_environment(rows[row], common)} for row in rows}
        means = {
            row: nan_mean(c.value for c in cells[0].values()) for row, cells in compared.items()
        }
        best = max(means, key=lambda row: means[row])
        pairs = [(best, row) for row in rows if row != best and common]
        behind |= {(act, test.second): test for test in differences(compared, pairs)}
    return behind


def _by_environment(
    cells: Mapping[Position, Contribution], positions: Sequence[Position]
) -> dict[Position, Contribution]:
    """Return the sums of a column over the kinds of each environment."""
    return {
        (environment, ALL): _sum([cells[position] for position in of_environment])
        for environment, of_environment in itertools.groupby(positions, lambda p: p[0])
    }
