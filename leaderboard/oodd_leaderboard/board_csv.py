"""Boards as CSV: a line a row, and a line a cell."""

from collections.abc import Iterable, Mapping, Sequence

from oodd_eval.metrics.catalogue import NAMES
from oodd_eval.results.board import Value
from oodd_eval.results.record import NAN, Metric, Record
from oodd_eval.results.render.tabular import csv_rows, csv_text, number
from oodd_leaderboard.standings import OrderedBoard, cost_of

_DIFFERENCE = ("difference", "low", "high", "p")


def standings_csv(ordered: OrderedBoard) -> str:
    """Return one line per row: place, origin, differences, cost, and every metric over all cells.

    Metrics have their intervals, and so have differences to the row above and to the first.
    """
    board = ordered.board
    metrics = dict.fromkeys(name for r in board.records for name in r.metrics)
    columns = {name: (name, board.anomalies) for name in metrics}
    columns |= {f"{board.ranking}_{g}": (board.ranking, kinds) for g, kinds in board.groups.items()}
    lines = []
    for row in ordered.standings:
        means = [
            board.mean(row.entry, board.environments, anomalies, metric, intervals=True)
            for metric, anomalies in columns.values()
        ]
        pairs = {"above": ordered.above.get(row.entry), "first": ordered.first.get(row.entry)}
        lines.append(
            {
                "rank": row.rank,
                "equal": str(row.equal).lower(),
                "band": str(row.band).lower(),
                "state": row.state,
                "detector": row.entry.detector,
                "horizon": row.entry.horizon,
                "overrides": row.entry.overrides_json,
                "origin": row.origin,
                "authors": row.authors,
                "paper": row.paper,
                "year": row.year,
                "trivial": str(row.trivial).lower(),
                "variant": str(row.variant).lower(),
                "training": row.training,
                "inputs": row.inputs,
                "seeds": row.seeds,
                "seed_low": number(row.seed_low),
                "seed_high": number(row.seed_high),
                **{
                    f"{name}_{part}": number(getattr(pair, part)) if pair else ""
                    for name, pair in pairs.items()
                    for part in _DIFFERENCE
                },
                "seconds_fit": number(row.cost.fit),
                "microseconds_per_step": number(row.cost.step),
                "peak_rss_mb": number(row.cost.peak),
                **dict(zip(_columns(columns), _texts(means), strict=True)),
            }
        )
    return csv_rows(lines)


def cells_csv(lines: Sequence[tuple[Mapping[str, str], Record]]) -> str:
    """Return one line per cell with its stored metrics and their intervals.

    Every cell has a mapping with columns that stand before its own, the same ones for all. Every
    metric that a record can have has a column.
    """
    facts: list[dict[str, object]] = [
        {
            **about,
            "split": r.split,
            "digest": r.split_digest,
            "protocol": r.protocol,
            "limit": "" if r.limit is None else r.limit,
            "detector": r.detector,
            "version": r.detector_version,
            "horizon": r.horizon,
            "overrides": r.setting.overrides_json,
            "seed": r.seed,
            "environment": r.environment,
            "group": r.group,
            "anomaly": r.anomaly,
            "strength": r.strength,
            "magnitude": "" if r.magnitude is None else number(r.magnitude),
            "paired": str(r.paired).lower(),
            "status": r.status,
            "note": r.note,
            "brief": str(r.brief).lower(),
            "seconds_fit": number(r.seconds_fit),
            "microseconds_per_step": number(cost_of([r]).step),
            "peak_rss_mb": number(r.peak_rss_mb),
        }
        for about, r in lines
    ]
    metrics = (_texts(map(r.metrics.get, NAMES)) for _, r in lines)
    rows = ([*cell.values(), *texts] for cell, texts in zip(facts, metrics, strict=True))
    return csv_text([[*facts[0], *_columns(NAMES)], *rows])


def _columns(names: Iterable[str]) -> list[str]:
    """Return the columns of values and of the ends of their intervals."""
    return [name + end for name in names for end in ("", "_low", "_high")]


def _texts(values: Iterable[Value | Metric | None]) -> list[str]:
    """Return the texts of values and of the ends of their intervals, empty for None."""
    ends = ((v.value, v.low, v.high) if v else (NAN, NAN, NAN) for v in values)
    return [number(end) for group in ends for end in group]
