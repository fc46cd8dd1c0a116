"""The content of the site as plain data: an index of boards and rows, and parts loaded on demand.

The index has what the first view of every table shows, in whole numbers of the last printed
digit. A part is a row with all its cells and curves, or one metric of all cells of a board.
Everything that is not simple arithmetic is computed here; the page filters, averages over cells,
sorts and draws.
"""

import hashlib
import json
import math
import re
import shlex
import statistics
from calendar import month_name
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from itertools import product
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import ANOMALIES, GROUPS, Quantity, paper_tables, title_of
from oodd_eval.data.parts import EnvironmentData
from oodd_eval.data.split import SHIPPED, Split, published_digests
from oodd_eval.metrics.bootstrap import nan_mean
from oodd_eval.metrics.catalogue import HEADLINE, METRICS, NAMES, RANKING, metric_info
from oodd_eval.metrics.cusum import DRIFT, THRESHOLD
from oodd_eval.metrics.ranking import PairedDifference
from oodd_eval.metrics.unpaired import OUTCOME_UP_TO
from oodd_eval.results.board import Board, grouped
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import NAN, Record
from oodd_eval.results.report import findings_of
from oodd_eval.results.strengths import COSTS, DETECTION, Strengths, curve
from oodd_eval.results.tables import ALARMS_OF_OUTCOMES, PAPERS, POOLED, missing_level
from oodd_leaderboard.curve_file import read_curves
from oodd_leaderboard.entry import Entry
from oodd_leaderboard.reported import REPORTED, LeaderboardSection, Reported, SuiteSection, day_of
from oodd_leaderboard.season_files import SPLIT
from oodd_leaderboard.seasons import SeasonBoard
from oodd_leaderboard.standings import OrderedBoard, Standing

_COMPARED: Final = (
    *("false_episodes", "early", "delay", "delay_censored", "missed"),
    *("found_within_20", "found_within_100"),
)
WITH_INTERVALS: Final = (
    *("auc_matched", "auc_smoothed", "auc_unpaired", "auc", *PAPERS),
    *(f"{name}_{HEADLINE}" for name in _COMPARED),
)
"""Metrics that have intervals on the site."""

ALL: Final = "*"  # all environments or anomalies; a group of anomalies is `*sensor`

SUMMARIES: Final = tuple(f"{ALL}|{ALL}{group}" for group in ("", *GROUPS))
"""Selections of cells whose means stand in the index; other means are made from a part."""

REBUILT: Final = "rebuilt"  # where the commands of the site record a season's split again

ENTRY_FIELDS: Final = ("authors", "paper", "year", "url", "licence", "sha256")
"""Fields of an entry that the site shows."""

_OF_LOGS: Final = (*POOLED, *OUTCOME_UP_TO)
_ALARMS_OF_LOGS: Final = (
    *(*_COMPARED, "events_found", "false_alarms_per_hour", *ALARMS_OF_OUTCOMES),
)
"""Metrics with intervals where episodes have no twins; those of alarms at the board's level."""

MOST_SENSORS: Final = 3  # sensors of an episode: those that leave their twin's course most
STEPS: Final = 250  # steps between the least and the largest value: one a pixel
LEVELS: Final = 250  # least steps from zero to the largest value of a drawing: one a pixel
HEAVY: Final = 30  # A largest value this many times the typical one asks for a logarithmic scale

Json = dict[str, Any]
Units = Mapping[str, list[Json]]  # curves of single cells by the name of what is reported

SelectedCell = tuple[str, str]  # environment and anomaly


@dataclass(frozen=True, slots=True)
class _SiteBoard:
    """A season's board or a table of reported rows: what stands at its head, and its rows."""

    id: str
    name: str
    title: str
    date: str
    notice: str
    season: Json | None
    ranks: OrderedBoard
    entries: Mapping[str, Entry]
    sources: Mapping[Setting, Reported]


def season_line(seasons: Sequence[SeasonBoard]) -> str:
    """Return the sentence at the head of every page: the newest season, or that there is none."""
    boards = [s.season for s in seasons if not s.season.trial]
    if boards:
        return f"Season {boards[0].name}, {_day(boards[0].date)}."
    if seasons:
        return "A trial season: no board."
    return "No season has ended yet: there is no board, and all rows are reported."


def site_data(
    sections: Sequence[LeaderboardSection],
    suites: Sequence[SuiteSection] = (),
    seasons: Sequence[SeasonBoard] = (),
) -> tuple[Json, dict[str, Json]]:
    """Return the index, and the parts by name.

    A row of the index names its part. A board names those of its metrics.
    """
    sources = {source.name: source for section in sections for source in section.sources.values()}
    units = {name: read_curves(s.curves)["units"] for name, s in sources.items() if s.curves}
    parts: dict[str, Json] = {}
    tables = [*map(_of_season, seasons), *_of_reported(sections)]
    boards = [_board(table, units, parts) for table in tables]
    names = dict.fromkeys(name for b in boards for name in (*b["metrics"], b["ranking"]))
    data = {
        "threshold": THRESHOLD,
        "drift": DRIFT,
        "metrics": {name: _metric(name) for name in names},
        "paper": paper_tables()["table5_groups_delta1"],
        "boards": boards,
        "suites": [_suite(s) for s in sorted(suites, key=lambda suite: not suite.graded)],
    }
    return data, parts


def _day(iso: str) -> str:
    """Return a day in words; empty as it is."""
    if not iso:
        return ""
    day = date.fromisoformat(iso)
    return f"{day.day} {month_name[day.month]} {day.year}"


def _of_season(board: SeasonBoard) -> _SiteBoard:
    season = board.season
    about = _fields(season, "bits", "seeds", "oodd_eval") | {
        "drawn": _fields(board.drawn(), "title", "header", "rows", "note"),
        "command": f"oodd-eval leaderboard season --bits {season.bits} --output {REBUILT}",
        "installed": {
            entry: [_fields(wheel, "distribution", "version", "sha256") for wheel in wheels]
            for entry, wheels in season.installed.items()
        },
    }
    title = board.title + ": no board" * season.trial
    texts = (board.name, board.title, title, _day(season.date), board.notice)
    return _SiteBoard(*texts, about, board.ranks, season.entries, {})


def _of_reported(sections: Sequence[LeaderboardSection]) -> list[_SiteBoard]:
    splits = Counter(section.ranks.board.split for section in sections)
    tables = []
    for section in sections:
        board = section.ranks.board
        apart = f" ({board.digest[:8]})" if splits[board.split] > 1 else ""
        name = f"Reported: {board.split}{apart}"
        texts = (section.name, name, name, _day(section.date), REPORTED)
        tables.append(_SiteBoard(*texts, None, section.ranks, section.entries, section.sources))
    return tables


def part_name(text: str) -> str:
    """Return a safe file name for anything: what can be read of it, and the start of a digest."""
    slug = re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:40]
    return f"{slug}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def _suite(section: SuiteSection) -> Json:
    """Return tables of a further test suite, and of graded strengths each row's means by rung."""
    # Points are (strength, share of the return lost, value), the weakest strength first.
    board, tables = section.board, section.tables[:2]
    rows = {str(row): row for row in board.entries}
    records = grouped(board.records, lambda r: str(r.setting)) if section.graded else {}
    metrics = DETECTION, RANKING
    return {
        "name": section.name,
        **_fields(board, "split", "digest"),
        "unit": COSTS.get(Strengths.of(board.records).base, "") if section.graded else "",
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
            for label, *_ in (tables[0].rows if section.graded and tables else ())
        ],
    }


def _fields(thing: object, *names: str) -> Json:
    return {name: getattr(thing, name) for name in names}


def _metric(name: str) -> Json:
    info = metric_info(name)
    title = info.title[0].upper() + info.title[1:]
    return {"title": title, "meaning": info.summary, "kind": info.unit, "better": info.better}


def _board(table: _SiteBoard, units: Units, parts: dict[str, Json]) -> Json:
    board = table.ranks.board
    present = {name for r in board.records for name in r.metrics}
    # Where every cell has failed, the page still shows the metrics without a level.
    usual = [name for name, info in METRICS.items() if info.cells != "unpaired"]
    names = [name for name in NAMES if name in present] or (usual if board.paired else [])
    have = {(r.environment, r.anomaly) for r in board.records}
    cells = [c for c in product(board.environments, board.anomalies) if c in have]
    filtered = selections(cells, {a: g for g, kinds in board.groups.items() for a in kinds})
    rows: list[Json] = []
    for standing in table.ranks.standings:
        row, part = _row(table, standing, len(rows), names, filtered, units)
        rows.append(row)
        parts[row["part"]] = part
    with_ends = _with_intervals(names, board)
    metric_parts = {name: part_name(f"{table.id}/{name}") for name in names}
    of_rows = {row["part"]: parts[row["part"]] for row in rows}
    for i, (metric, name) in enumerate(metric_parts.items()):
        number = with_ends.index(metric) if metric in with_ends else None
        parts[name] = {
            "values": {part: content["values"][i] for part, content in of_rows.items()},
            "intervals": {
                part: {key: ends[number] for key, ends in content["intervals"].items()}
                for part, content in of_rows.items()
                if number is not None
            },
        }
    strengths: dict[str, set[str]] = {}
    for r in board.records:
        strengths.setdefault(f"{r.environment}|{r.anomaly}", set()).add(r.strength)
    return {
        **_fields(table, "id", "name", "title", "date", "notice", "season"),
        "ranked": table.season is not None,
        "episodes": _episodes(table.id, board, parts, rows),
        "cells": cells,
        "strengths": {cell: "".join(s) for cell, s in strengths.items() if len(s) == 1},
        "parts": metric_parts,
        **_fields(board, "split", "digest", "protocol", "limit", "paired", "ranking", "level"),
        "tests": board.test_seeds(),
        "environments": {e: title_of(e) if board.paired else e for e in board.environments},
        "anomalies": {a: _anomaly(board, a) for a in board.anomalies},
        "about": [] if board.paired else [*findings_of(board), *missing_level(board, HEADLINE)],
        "metrics": names,
        "intervals": with_ends,
        "rows": rows,
    }


def _anomaly(board: Board, name: str) -> Json:
    """Return an anomaly's title, group and summary; logs may use a benchmark's name for another."""
    group = next((group for group, kinds in board.groups.items() if name in kinds), "")
    if board.paired and name in ANOMALIES:
        return _fields(ANOMALIES[name], "title", "summary") | {"group": group}
    return {"title": name, "summary": "", "group": group}


def _episodes(
    identity: str, board: Board, parts: dict[str, Json], rows: Sequence[Json]
) -> dict[str, str]:
    """Add a part for each environment with the sensors of the episodes that rows show."""
    if not (split := shipped_split(board.digest)):
        return {}
    episodes: dict[str, list[tuple[str, int]]] = {}
    for curves in (parts[row["part"]]["curves"] for row in rows):
        for cell, drawn in curves.items():
            environment, anomaly = cell.split("/")
            episodes.setdefault(environment, []).append((anomaly, drawn["example"]["index"]))
    names = {environment: part_name(f"{identity}/{environment}") for environment in episodes}
    for environment, name in names.items():
        parts[name] = shown_episodes(split, environment, episodes[environment])
    return names


def _row(
    table: _SiteBoard,
    standing: Standing,
    position: int,
    names: Sequence[str],
    filtered: Mapping[str, Sequence[SelectedCell]],
    units: Units,
) -> tuple[Json, Json]:
    """Return a row's line of the index, and its part."""
    row, records, board = standing.entry, standing.records, table.ranks.board
    source = table.sources.get(row)
    entry = table.entries.get(row.detector) or Entry(row.detector)
    cells = filtered[f"{ALL}|{ALL}"]
    intervals = _intervals(board, standing, names, filtered)
    identity = f"{table.id}/{row}"
    by_cell = _by_cell(standing, cells)
    line = {
        "id": identity,
        "part": part_name(identity),
        "label": str(row),
        "detector": row.detector,
        "plugin": records[0].plugin,
        "horizon": row.horizon,
        "overrides": row.overrides,
        "seeds": sorted({r.seed for r in records}),
        "place": position,
        **_fields(standing, "rank", "equal", "band", "state", "variant", "trivial", "inputs"),
        **_fields(standing, "training", "origin", "authors", "paper", "year"),
        "url": entry.url,
        "above": _difference(table.ranks.above.get(row)),
        "first": _difference(table.ranks.first.get(row)),
        "worst": _worst(board, row),
        "seed_means": [_short(standing.seed_low), _short(standing.seed_high)],
        "cost": {n: _short(v) for n, v in standing.cost._asdict().items()},
        "missing": [i for i, of_cell in enumerate(by_cell) if not of_cell],
        "failed": [
            [i, r.status, r.reason] for i, cell in enumerate(by_cell) for r in cell if not r.ok
        ],
        "means": _summaries(board, standing, names, filtered, intervals),
    }
    complete_cells = [of_cell if all(r.ok for r in of_cell) else [] for of_cell in by_cell]
    part = {
        "version": records[0].detector_version,
        "parameters": records[0].parameters,
        "day": _day(day_of(records)),
        "command": _command(table, row, line["seeds"]),
        "entry": _fields(entry, *ENTRY_FIELDS)
        | {"requirement": entry.wheel or entry.requirement, "reported": source and source.name},
        "values": [[_mean(of_cell, name) for of_cell in complete_cells] for name in names],
        "intervals": intervals,
        "curves": _curves(units.get(source.name, []) if source else [], records),
    }
    return line, part


def _command(table: _SiteBoard, row: Setting, seeds: Sequence[int]) -> str:
    """Return the command that makes a row's records; nothing where others have not the split.

    A season's split is recorded again by the season's command, and a row has its entry's name.
    """
    board, detector, split = table.ranks.board, row.detector, table.ranks.board.split
    if table.season:
        detector, split = table.entries[detector].detector or detector, f"{REBUILT}/{SPLIT}"
    elif published_digests().get(split) != board.digest:
        return ""
    words = ["--detector", detector, "--env", ",".join(board.environments)]
    words += ["--split", split, "--seed", ",".join(map(str, seeds))]
    words += ["--horizon", str(row.horizon)] * (row.horizon != 1)
    words += ["--limit", str(board.limit)] * (board.limit is not None)
    for name, value in row.overrides.items():
        words += ["--param", f"{name}={value if isinstance(value, str) else json.dumps(value)}"]
    return shlex.join(["oodd-eval", "run", *words])


def _difference(test: PairedDifference | None) -> Json | None:
    """Return how far a row is below another one, with its interval and verdict."""
    if test is None:
        return None
    numbers = {name: _short(getattr(test, name)) for name in ("difference", "low", "high", "p")}
    return {"row": test.first, "told": test.told_apart, **numbers}


def _worst(board: Board, row: Setting) -> Json | None:
    """Return the environment with the least mean of the metric that ranks, and that mean."""
    if not (worst := board.worst(row)):
        return None
    return {"value": _short(worst[1].value), "environment": worst[0]}


def _summaries(
    board: Board,
    standing: Standing,
    names: Sequence[str],
    filtered: Mapping[str, Sequence[SelectedCell]],
    intervals: Json,
) -> dict[str, list[list[int | None]]]:
    """Return means over the selections of the index: values, then low and high ends."""
    # They are whole numbers of the last digit that is printed, None where there is none.
    summaries = {}
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
        summaries[key] = [values, *ends]
    return summaries


def _by_cell(standing: Standing, cells: Sequence[SelectedCell]) -> list[list[Record]]:
    """Return a row's records of every cell."""
    by_cell = grouped(standing.records, lambda r: (r.environment, r.anomaly))
    return [by_cell.get(cell, []) for cell in cells]


def _mean(records: Sequence[Record], metric: str) -> float | None:
    """Return the mean over detector seeds; None where there is none."""
    return _short(nan_mean(r.metrics[metric].value for r in records if metric in r.metrics))


def _intervals(
    board: Board,
    standing: Standing,
    names: Sequence[str],
    filtered: Mapping[str, Sequence[SelectedCell]],
) -> Json:
    """Intervals of means by key of the selection, in the order of the board's ``intervals``."""
    # A single record has its own. The metric that ranks and false episodes have all of them.
    metrics = _with_intervals(names, board)
    always = (board.ranking, f"false_episodes_{board.level}")
    once = grouped(standing.records, lambda r: (r.environment, r.anomaly))
    intervals: dict[str, list[list[float | None] | None]] = {}
    for (i, metric), (key, cells) in product(enumerate(metrics), filtered.items()):
        held = once.get(cells[0], []) if len(cells) == 1 else []
        if len(held) == 1:
            interval = held[0].metrics.get(metric)
            low, high = (interval.low, interval.high) if interval else (NAN, NAN)
        elif metric in always or key in SUMMARIES:
            mean = board.mean(standing.entry, *_sides(cells), metric, intervals=True)
            low, high = mean.low, mean.high
        else:
            continue
        if not math.isnan(low):
            bounds = [_printed(v, metric_info(metric).unit) for v in (low, high)]
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
    cells: Sequence[SelectedCell], groups: Mapping[str, str]
) -> dict[str, list[SelectedCell]]:
    """Return the selections of cells that filters can make, by key.

    A key is ``environment|anomaly``, each of which may be all of them, ``*``; a group of anomalies
    is ``*group``. `groups` has those of anomalies.
    """
    selected: dict[str, list[SelectedCell]] = {}
    for environment, anomaly in cells:
        group = groups.get(anomaly, "")
        kinds = (ALL, *([ALL + group] if group else []), anomaly)
        for key in product((ALL, environment), kinds):
            selected.setdefault("|".join(key), []).append((environment, anomaly))
    return selected


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
