"""The content of the site as plain data: an index of boards and rows, and parts loaded on demand.

The index has what the first view of every table shows, in whole numbers of the last printed
digit. A part is a row with all its cells and curves, or one metric of all cells of a board.
Everything that is not simple arithmetic is computed here; the page filters, averages over cells,
sorts and draws.
"""

import hashlib
import math
import re
import statistics
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, GROUPS, TABLE1, Quantity, paper_tables
from oodd_eval.data.parts import EnvironmentData
from oodd_eval.data.split import SHIPPED, Split
from oodd_eval.metrics.bootstrap import nan_mean
from oodd_eval.metrics.catalogue import HEADLINE, METRICS, NAMES, RANKING, metric_info
from oodd_eval.metrics.cusum import DRIFT, THRESHOLD
from oodd_eval.results.board import Board, grouped
from oodd_eval.results.record import NAN, Record
from oodd_eval.results.report import findings_of
from oodd_eval.results.standings import Standing
from oodd_eval.results.strengths import COSTS, DETECTION, Strengths, curve
from oodd_eval.results.tables import PAPERS, POOLED, missing_level
from oodd_leaderboard.curve_file import read_curves
from oodd_leaderboard.reported import LeaderboardSection, SubmittedEntry, SuiteSection, commands_of

_COMPARED: Final = (
    *("false_episodes", "early", "delay", "delay_censored", "missed"),
    *("found_within_20", "found_within_100"),
)
WITH_INTERVALS: Final = (
    *("auc_matched", "auc_smoothed", "auc_unpaired", "auc", *PAPERS),
    *(f"{name}_{HEADLINE}" for name in _COMPARED),
)
"""Metrics that have intervals on the site: those that comparisons are made with."""

SUMMARIES: Final = ("all|all", "all|sensor", "all|dynamics")
"""Selections of cells whose means stand in the index; other means are made from a part."""

ENTRY_FIELDS: Final = ("id", "title", "submitter", "created", "citation", "url", "caption")
"""Fields of an entry that the site shows."""

_OF_LOGS: Final = (*POOLED, "auc_outcome")
_ALARMS_OF_LOGS: Final = (
    *(*_COMPARED, "events_found", "false_alarms_per_hour", "found_outcome", "found_outcome_null"),
)
"""Metrics with intervals where episodes have no twins; those of alarms at the board's level."""

MOST_SENSORS: Final = 3  # sensors of an episode: those that leave their twin's course most
STEPS: Final = 250  # steps between the least and the largest value: one a pixel
LEVELS: Final = 250  # least steps from zero to the largest value of a drawing: one a pixel
HEAVY: Final = 30  # A largest value this many times the typical one asks for a logarithmic scale

Json = dict[str, Any]
Units = Mapping[str, list[Json]]  # curves of single cells by the id of their entry

SelectedCell = tuple[str, str]  # environment and anomaly


def site_data(
    sections: Sequence[LeaderboardSection], suites: Sequence[SuiteSection] = ()
) -> tuple[Json, dict[str, Json]]:
    """Return the index, and the parts by name.

    A row of the index names its part. A board names those of its metrics.
    """
    entries = {entry.meta.id: entry for section in sections for entry in section.entries}
    units = {i: read_curves(e.curves)["units"] for i, e in entries.items() if e.curves}
    parts: dict[str, Json] = {}
    on_site = [_board(section, units, parts) for section in sections]
    names = dict.fromkeys(
        name for board in on_site for name in (*board["metrics"], board["ranking"])
    )
    used = {*TABLE1, *(name for board in on_site for name in board["anomalies"] if board["paired"])}
    kinds = [a for a in ANOMALIES.values() if a.id in used]
    data = {
        "threshold": THRESHOLD,
        "drift": DRIFT,
        "metrics": {name: _metric(name) for name in names},
        "environments": {e.id: _fields(e, "title", "family") for e in ENVIRONMENTS.values()},
        "anomalies": {a.id: _fields(a, "title", "group", "summary") for a in kinds},
        "paper": paper_tables()["table5_groups_delta1"],
        "boards": on_site,
        "power": [_power(suite) for suite in suites if suite.graded],
    }
    return data, parts


def part_name(text: str) -> str:
    """Return a safe file name for anything: what can be read of it, and the start of a digest."""
    slug = re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:40]
    return f"{slug}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def _power(section: SuiteSection) -> Json:
    """Return tables of a board of graded strengths, and each row's means along the ladder."""
    # Points are (strength, share of the return lost, value), the weakest strength first.
    board, tables = section.board, section.tables[:2]
    rows = {str(row): row for row in board.entries}
    records = grouped(board.records, lambda r: str(r.setting))
    metrics = DETECTION, RANKING
    return {
        **_fields(board, "split", "digest"),
        "unit": COSTS.get(Strengths.of(board.records).base, ""),
        "tables": [_fields(table, "title", "header", "rows", "note") for table in tables],
        "metrics": [_metric(name) | {"chance": name == RANKING} for name in metrics],
        "rows": [
            {
                "label": label,
                "trivial": board.is_trivial(rows[label]),
                "points": [
                    [[*map(_short, point)] for point in curve(records[label], name)]
                    for name in metrics
                ],
            }
            for label, *_ in (tables[0].rows if tables else ())
        ],
    }


def _fields(thing: object, *names: str) -> Json:
    return {name: getattr(thing, name) for name in names}


def _metric(name: str) -> Json:
    info = metric_info(name)
    title = info.title[0].upper() + info.title[1:]
    return {"title": title, "meaning": info.summary, "kind": info.unit, "better": info.better}


def _board(section: LeaderboardSection, units: Units, parts: dict[str, Json]) -> Json:
    ranks, board = section.ranks, section.ranks.board
    present = {name for r in board.records for name in r.metrics}
    # Where every cell has failed, the page still shows the metrics without a level.
    usual = [name for name, info in METRICS.items() if info.cells != "unpaired"]
    names = [name for name in NAMES if name in present] or (usual if board.paired else [])
    have = {(r.environment, r.anomaly) for r in board.records}
    cells = [c for c in product(board.environments, board.anomalies) if c in have]
    names_of_logs = None if board.paired else _names_of_logs(board)
    filtered = selections(cells, names_of_logs)
    rows, ends, by_cell = [], {}, {}
    for standing in ranks.standings:
        row, part = _row(section, standing, names, filtered, units)
        rows.append(row)
        parts[row["part"]] = part
        ends[row["part"]] = _ranking_intervals(part, board, names)
        by_cell[row["part"]] = _by_cell(standing, cells)
    metric_parts = {name: part_name(f"{section.name}/{name}") for name in names}
    for metric, name in metric_parts.items():
        values = {
            part: [_mean(records, metric) for records in of_row] for part, of_row in by_cell.items()
        }
        parts[name] = {"values": values, "intervals": ends if metric == board.ranking else {}}
    return {
        "id": section.name,
        "episodes": _episodes(section, parts, rows),
        "cells": cells,
        "parts": metric_parts,
        **_fields(board, "split", "digest", "protocol", "limit"),
        "tests": board.test_seeds(),
        **_fields(board, "environments", "anomalies"),
        **_fields(board, "paired", "ranking", "level"),
        "own": names_of_logs,
        "about": [] if board.paired else [*findings_of(board), *missing_level(board, HEADLINE)],
        "metrics": names,
        "intervals": _with_intervals(names, board),
        "rows": rows,
        "resamples": ranks.ranking.resamples,
    }


def _names_of_logs(board: Board) -> Json:
    """Return environments and anomalies of logs, whose names may be the benchmark's for others."""
    groups = {kind: group for group in GROUPS for kind in board.in_group(group)}
    return {
        "environments": {e: {"title": e, "family": ""} for e in board.environments},
        "anomalies": {
            a: {"title": a, "group": groups.get(a, ""), "summary": ""} for a in board.anomalies
        },
    }


def _episodes(
    section: LeaderboardSection, parts: dict[str, Json], rows: Sequence[Json]
) -> dict[str, str]:
    """Add a part for each environment with the sensors of the episodes that rows show."""
    if not (split := shipped_split(section.ranks.board.digest)):
        return {}
    episodes: dict[str, list[tuple[str, int]]] = {}
    for curves in (parts[row["part"]]["curves"] for row in rows):
        for cell, drawn in curves.items():
            environment, anomaly = cell.split("/")
            episodes.setdefault(environment, []).append((anomaly, drawn["example"]["index"]))
    names = {environment: part_name(f"{section.name}/{environment}") for environment in episodes}
    for environment, name in names.items():
        parts[name] = shown_episodes(split, environment, episodes[environment])
    return names


def _row(
    section: LeaderboardSection,
    standing: Standing,
    names: Sequence[str],
    filtered: Mapping[str, Sequence[SelectedCell]],
    units: Units,
) -> tuple[Json, Json]:
    """Return a row's line of the index, and its part."""
    row, records = standing.entry, standing.records
    source, label, ranks = section.sources[row], str(row), section.ranks
    order = {cell: i for i, cell in enumerate(filtered["all|all"])}
    in_order = sorted(records, key=lambda r: (order[r.environment, r.anomaly], r.seed))
    intervals = _intervals(ranks.board, standing, names, filtered)
    identity = f"{section.name}/{label}"
    have = {(r.environment, r.anomaly) for r in records}
    line = {
        "id": identity,
        "part": part_name(identity),
        "label": label,
        "detector": row.detector,
        "plugin": records[0].plugin,
        "horizon": row.horizon,
        "overrides": row.overrides,
        "seeds": sorted({r.seed for r in records}),
        **_fields(standing, "trivial", "primary", "inputs", "rank", "alarm_rank", "ties", "state"),
        "training": standing.training,
        "wins": _short(standing.wins),
        "lead": standing.lead,
        "cost": {n: _short(v) for n, v in standing.cost._asdict().items()},
        **_fields(source.meta, "submitter", "caption"),
        "missing": [i for i, cell in enumerate(filtered.get("all|all", [])) if cell not in have],
        "failed": [
            [filtered["all|all"].index((r.environment, r.anomaly)), r.status, r.reason]
            for r in in_order
            if not r.ok
        ],
        "means": _summaries(section, standing, names, filtered, intervals),
    }
    compared = [c for c in ranks.ranking.comparisons if label in (c.first, c.second)]
    part = {
        "version": records[0].detector_version,
        "parameters": records[0].parameters,
        "command": " && ".join(commands_of(records)),
        "entry": _entry(source, records[0].plugin),
        "cells": [_cell(r, names, _with_intervals(names, ranks.board)) for r in in_order],
        "intervals": intervals,
        "comparisons": [
            [c.second, *map(_short, (c.difference, c.low, c.high, c.p_holm))]
            for c in compared
            if c.first == label
        ],
        "worse_than": [c.first for c in compared if c.second == label and c.better],
        "wins": {
            other: _short(rate) for (first, other), rate in ranks.rates.items() if first == label
        },
        "curves": _curves(units.get(source.meta.id, []), records),
    }
    return line, part


def _summaries(
    section: LeaderboardSection,
    standing: Standing,
    names: Sequence[str],
    filtered: Mapping[str, Sequence[SelectedCell]],
    intervals: Json,
) -> dict[str, list[list[int | None]]]:
    """Return means over the selections of the index: values, then low and high ends."""
    # They are whole numbers of the last digit that is printed, None where there is none.
    board, summaries = section.ranks.board, {}
    for key in (key for key in SUMMARIES if key in filtered):
        means = [board.mean(standing.entry, *_sides(filtered[key]), name) for name in names]
        values = [_digits(m.value, name) for m, name in zip(means, names, strict=True)]
        with_ends = _with_intervals(names, board)
        ends_of = intervals.get(key, [None] * len(with_ends))
        ends = [
            [
                _digits(NAN if pair is None or pair[i] is None else pair[i], name)
                for pair, name in zip(ends_of, with_ends, strict=True)
            ]
            for i in (0, 1)
        ]
        summaries[key.partition("|")[2]] = [values, *ends]
    return summaries


def _by_cell(standing: Standing, cells: Sequence[SelectedCell]) -> list[list[Record]]:
    """Return a row's records of every cell, none where one has failed."""
    by_cell = grouped(standing.records, lambda r: (r.environment, r.anomaly))
    cells_of = [by_cell.get(cell, []) for cell in cells]
    return [records if all(r.ok for r in records) else [] for records in cells_of]


def _mean(records: Sequence[Record], metric: str) -> float | None:
    """Return the mean over detector seeds; None where there is none."""
    return _short(nan_mean(r.metrics[metric].value for r in records if metric in r.metrics))


def _ranking_intervals(
    part: Json, board: Board, names: Sequence[str]
) -> dict[str, list[float | None]]:
    """Return a row's intervals of the metric that ranks by selection."""
    # A cell of one record has its pair.
    with_ends = _with_intervals(names, board)
    if board.ranking not in with_ends:
        return {}
    index = with_ends.index(board.ranking)
    intervals = {key: ends[index] for key, ends in part["intervals"].items()}
    once = grouped(part["cells"], lambda cell: (cell["environment"], cell["anomaly"]))
    for (environment, anomaly), cells in once.items():
        if len(cells) == 1 and "values" in cells[0]:
            pair = [cells[0][end][index] for end in ("low", "high")]
            intervals[f"{environment}|{anomaly}"] = pair
    return {key: pair for key, pair in intervals.items() if pair and None not in pair}


def _entry(entry: SubmittedEntry, plugin: str) -> Json:
    """Return who an entry is from, and the digest of the plug-in's source that it names."""
    of_entry = entry.meta.plugins[::-1]
    digests = {f"{p['distribution']}:{p['plugin']}": p["source_digest"] for p in of_entry}
    return _fields(entry.meta, *ENTRY_FIELDS) | {"source_digest": digests.get(plugin, "")}


def _cell(record: Record, names: Sequence[str], with_ends: Sequence[str]) -> Json:
    """One record: its values, and its intervals, in the orders of the board's lists of names."""
    plain = _fields(record, "environment", "anomaly", "seed")
    if not record.ok:
        return plain | _fields(record, "status", "reason")
    metrics = [record.metrics.get(name) for name in names]
    bounds = [(record.metrics.get(name), metric_info(name).unit) for name in with_ends]
    return plain | {
        "values": [m and _short(m.value) for m in metrics],
        "low": [m and _printed(m.low, kind) for m, kind in bounds],
        "high": [m and _printed(m.high, kind) for m, kind in bounds],
    }


def _intervals(
    board: Board,
    standing: Standing,
    names: Sequence[str],
    filtered: Mapping[str, Sequence[SelectedCell]],
) -> Json:
    """Intervals of means by key of the selection, in the order of the board's ``intervals``."""
    # A single record has its own.
    metrics = _with_intervals(names, board)
    intervals: dict[str, list[list[float | None] | None]] = {}
    for (i, metric), (key, cells) in product(enumerate(metrics), filtered.items()):
        selected = metric == board.ranking or key in SUMMARIES
        if not selected or len(cells) == standing.seeds == 1:
            continue
        mean = board.mean(standing.entry, *_sides(cells), metric, intervals=True)
        if not math.isnan(mean.low):
            bounds = [_printed(v, metric_info(metric).unit) for v in (mean.low, mean.high)]
            intervals.setdefault(key, [None] * len(metrics))[i] = bounds
    return intervals


def _with_intervals(names: Sequence[str], board: Board) -> list[str]:
    of_logs = (*_OF_LOGS, *(f"{name}_{board.level}" for name in _ALARMS_OF_LOGS))
    return [name for name in (WITH_INTERVALS if board.paired else of_logs) if name in names]


def _curves(units: Sequence[Json], records: Sequence[Record]) -> Json:
    """Curves of a row's cells by ``environment/anomaly``, of the first seed that has them."""
    cells = {str(r.cell) for r in records}
    curves: Json = {}
    for unit in units:
        if unit["cell"] in cells:
            parts = {name: unit[name] for name in ("seed", "roc", "delay_far")}
            parts["example"] = gridded(unit["example"])
            curves.setdefault(f"{unit['environment']}/{unit['anomaly']}", parts)
    return curves


def gridded(example: Json) -> Json:
    """Return an example whose scores and statistics are whole numbers of steps.

    A ``score_step`` or ``cusum_step`` of None says that the numbers are as they were, because a few
    are so large that they need a logarithmic scale.
    """
    steps = dict(example)
    for step_name, unit, names in (
        ("score_step", 1.0, ("scores", "twin")),
        ("cusum_step", THRESHOLD, ("cusum", "twin_cusum")),
    ):
        present = [name for name in names if name in example]
        step = _step((v for name in present for v in example[name] if v is not None), unit)
        steps[step_name] = step
        if step is not None:
            for name in present:
                steps[name] = [None if v is None else round(v / step) for v in example[name]]
    return steps


def _step(numbers: Iterable[float], unit: float) -> float | None:
    """Return a round step for numbers that are drawn together; None where they are too uneven."""
    sizes = [abs(v) for v in numbers]
    largest = max([unit, *sizes])
    typical = max(unit, statistics.median(sizes) if sizes else unit)
    if largest > HEAVY * typical:
        return None
    power = math.floor(math.log10(largest / LEVELS))
    # Not 10**-4 but the float that is printed as 0.0001.
    steps = [float(f"{digit}e{power}") for digit in (1, 2, 5)]
    return max(s for s in steps if s <= largest / LEVELS * (1 + 1e-9))


def _digits(value: float, metric: str) -> int | None:
    """Return a number as a whole number of the last digit that is printed of it."""
    near = _printed(value, (kind := metric_info(metric).unit))
    return None if near is None else round(near * (10 if kind == "steps" else 1000))


def _short(value: float) -> float | None:
    """Round to six digits, finer than anything printed; None for what is undefined."""
    if not math.isfinite(value):
        return None
    near = float(f"{value:.6g}")
    return int(near) if near.is_integer() else near


def _printed(value: float, kind: str) -> float | None:
    """Round an end of an interval to what is printed: nothing is computed from it."""
    if not math.isfinite(value):
        return None
    # A percentage is rounded as one, so that the page and other tables have the same digits.
    if kind == "percent":
        return _short(round(round(100 * value, 1) / 100, 3))
    return _short(round(value, 1 if kind == "steps" else 3))


def _sides(cells: Sequence[SelectedCell]) -> tuple[list[str], list[str]]:
    """Return the environments and anomalies of a selection."""
    environments, anomalies = zip(*cells, strict=True)
    return list(dict.fromkeys(environments)), list(dict.fromkeys(anomalies))


def selections(
    cells: Sequence[SelectedCell], logs: Json | None = None
) -> dict[str, list[SelectedCell]]:
    """Return the selections of cells that filters can make, by key.

    A key is ``environments|anomalies``: for the one ``all``, a family or an environment, for the
    other ``all``, a group or an anomaly. `logs` has what logs say of theirs; they have no families.
    """

    def family(environment: str) -> str:
        return environment if logs else ENVIRONMENTS[environment].family

    def group(anomaly: str) -> str:
        return logs["anomalies"][anomaly]["group"] or anomaly if logs else ANOMALIES[anomaly].group

    environments: dict[str, set[str]] = {}
    anomalies: dict[str, set[str]] = {}
    for environment, anomaly in cells:
        for name in ("all", family(environment), environment):
            environments.setdefault(name, set()).add(environment)
        for name in ("all", group(anomaly), anomaly):
            anomalies.setdefault(name, set()).add(anomaly)
    selected = {
        f"{some}|{label}": [(e, a) for e, a in cells if e in environments[some] and a in named]
        for some in environments
        for label, named in anomalies.items()
    }
    return {key: selection for key, selection in selected.items() if selection}


def shipped_split(digest: str) -> Split | None:
    """Return the split with a digest if it comes with the package.

    The site shows no sensors of other splits, so that its files do not depend on which splits a
    machine has; entries hold scores, not observations.
    """
    splits = (Split(path.parent) for path in SHIPPED.glob("*/manifest.json"))
    return next((split for split in splits if split.digest == digest), None)


def shown_episodes(split: Split, environment: str, episodes: Iterable[tuple[str, int]]) -> Json:
    """Return the sensors of test episodes by ``anomaly/index``.

    Each sensor has its name with unit, a step, and in whole numbers of steps what the episode and
    its nominal twin read from row 0 on.
    """
    data = split.environment(environment)
    return {f"{a}/{i}": _sensors(data, a, i) for a, i in sorted(set(episodes))}


def _sensors(data: EnvironmentData, anomaly: str, index: int) -> list[Json]:
    episode, twin = data.anomalous(anomaly)[index].observations, data.twins[index].observations
    both = min(len(episode), len(twin))
    spread = np.maximum(twin.std(axis=0), 1e-6)
    apart = np.abs(episode[:both] - twin[:both]).mean(axis=0) / spread
    return [
        _sensor(_title(data.sensors[d]), episode[:, d], twin[:, d])
        for d in np.argsort(-apart, kind="stable")[:MOST_SENSORS]
    ]


def _title(sensor: Quantity) -> str:
    return sensor.name if sensor.unit == "1" else f"{sensor.name} ({sensor.unit})"


def _sensor(name: str, episode: NDArray[Any], twin: NDArray[Any]) -> Json:
    values = np.concatenate([episode, twin]).astype(np.float64)
    step = float(f"{max(np.ptp(values) / STEPS, 1e-9):.2g}")
    steps = np.round(values / step).astype(int).tolist()
    return {"name": name, "step": step, "own": steps[: len(episode)], "twin": steps[len(episode) :]}
