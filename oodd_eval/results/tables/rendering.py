"""Boards as Markdown, for people, and as CSV, for spreadsheets and scripts."""

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence

from tabulate import tabulate

from oodd_eval.data.facts import GROUPS
from oodd_eval.metrics.catalogue import NAMES, RANKING
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Metric, Record
from oodd_eval.results.tables import ladder, layout
from oodd_eval.results.tables.board import Board, RankedBoard, Value, boards, cost_of
from oodd_eval.results.tables.layout import Table


def report(records: Sequence[Record], *, intervals: bool = False) -> str:
    """Return a report on records as Markdown: a section for each board among them."""
    sections = [_section(board, intervals=intervals) for board in boards(records)]
    return "\n".join(["# Results", "", *sections]) if sections else "# Results\n\nNo records.\n"


def _section(board: Board, *, intervals: bool) -> str:
    ok = sum(r.ok for r in board.records)
    found = [
        layout.separability(board, intervals=intervals),
        layout.guaranteed(board, intervals=intervals),
        layout.attribution(board, intervals=intervals),
        *ladder.tables(board, intervals=intervals, places=True),
        *(layout.anomaly_groups(board, h, intervals=intervals) for h in board.horizons),
        layout.all_metrics(board, intervals=intervals),
        *layout.all_alarms(board, intervals=intervals),
        *(layout.by_anomaly(board, e, intervals=intervals) for e in board.entries),
        layout.failures(board),
    ]
    cells = f"Cells: {len(board.records)}, of which {ok} ok and {len(board.records) - ok} failed."
    parts = [
        f"## Split {escape(board.split)}\n\n{cells}\n",
        *(f"**{escape(sentence)}**\n" for sentence in layout.findings(board)),
        *(markdown(table) for table in found if table),
        *(f"- {escape(line)}" for line in layout.notes(board)),
    ]
    return "\n".join(parts) + "\n"


def markdown(table: Table) -> str:
    """Return a table as Markdown under its title, its note below it."""
    rows = [[escape(cell) for cell in row] for row in table.rows]
    sides = table.alignment if rows else None
    header = [escape(h) for h in table.header]
    text = tabulate(rows, header, "pipe", colalign=sides, disable_numparse=True)
    note = f"\n{escape(table.note)}\n" if table.note else ""
    return f"### {table.title}\n\n{text}\n{note}"


def escape(text: str) -> str:
    """Keep text from being read as table or HTML: names and reasons are other people's."""
    flat = " ".join(text.split())
    for character in "\\|<>*_`[":
        flat = flat.replace(character, f"\\{character}")
    return flat


def ranking_csv(ranks: RankedBoard, trust: Mapping[Setting, str]) -> str:
    """Return one line per row: place, cost, and every metric over all cells with its interval."""
    board = ranks.board
    wanted = {name: (name, board.anomalies) for name in _metrics(ranks)}
    wanted |= {f"{RANKING}_{g}": (RANKING, board.in_group(g)) for g in GROUPS if board.in_group(g)}
    lines = []
    for one in ranks.standings:
        means = {
            column: board.mean(one.entry, board.environments, anomalies, metric, intervals=True)
            for column, (metric, anomalies) in wanted.items()
        }
        lines.append(
            {
                "rank": one.rank,
                "ties": one.ties,
                "alarm_rank": one.alarm_rank,
                "state": one.state,
                **_setting(one.entry),
                "trivial": str(one.trivial).lower(),
                "primary": str(one.primary).lower(),
                "seeds": one.seeds,
                "inputs": one.inputs,
                "trust": trust.get(one.entry, ""),
                "win_rate": number(one.wins),
                "seconds_fit": number(one.cost.fit),
                "microseconds_per_step": number(one.cost.step),
                "peak_rss_mb": number(one.cost.peak),
                **dict(zip(_columns(means), _texts(means.values()), strict=True)),
            }
        )
    return csv_rows(lines)


def cells_csv(lines: Sequence[tuple[Mapping[str, str], Record]], *, header: bool = True) -> str:
    """Return one line per cell with its stored metrics and their intervals.

    Every cell has a mapping with columns that stand before its own, the same ones for all. Every
    metric that a record can have has a column.
    """
    known: list[dict[str, object]] = [
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
            "status": r.status,
            "brief": str(r.brief).lower(),
            "seconds_fit": number(r.seconds_fit),
            "microseconds_per_step": number(cost_of([r]).step),
            "peak_rss_mb": number(r.peak_rss_mb),
        }
        for about, r in lines
    ]
    first = [[*known[0], *_columns(NAMES)]] if header else []
    metrics = (_texts(map(r.metrics.get, NAMES)) for _, r in lines)
    rows = ([*own.values(), *texts] for own, texts in zip(known, metrics, strict=True))
    return csv_text([*first, *rows])


def comparisons_csv(ranks: RankedBoard) -> str:
    """Return one line per ordered pair of ranked rows: difference, p-values, win rate."""
    header = [
        "first",
        "second",
        "difference",
        "difference_low",
        "difference_high",
        "p",
        "p_holm",
        "better",
        "win_rate",
    ]
    place = {label: i for i, label in enumerate(ranks.ranking.ranks)}
    lines = [
        [
            c.first,
            c.second,
            *map(number, (c.difference, c.low, c.high, c.p, c.p_holm)),
            str(c.better).lower(),
            number(ranks.rates[c.first, c.second]),
        ]
        for c in sorted(ranks.ranking.comparisons, key=lambda c: (place[c.first], place[c.second]))
    ]
    return csv_text([header, *lines])


def number(value: float) -> str:
    """Return a number with six significant digits for CSV; empty where undefined.

    Numbers that are rounding alone become zero: their digits may differ between machines.
    """
    if math.isnan(value):
        return ""
    return f"{value if abs(value) > 1e-12 else 0.0:.6g}"


def _metrics(ranks: RankedBoard) -> list[str]:
    """Return the names of all metrics that occur, in the order of the records."""
    return list(dict.fromkeys(name for r in ranks.board.records for name in r.metrics))


def _setting(setting: Setting) -> dict[str, object]:
    return {
        "detector": setting.detector,
        "horizon": setting.horizon,
        "overrides": setting.overrides_json,
    }


def _columns(names: Iterable[str]) -> list[str]:
    """Return the columns of values and of the ends of their intervals."""
    return [name + end for name in names for end in ("", "_low", "_high")]


def _texts(values: Iterable[Value | Metric | None]) -> list[str]:
    """Return the texts of values and of the ends of their intervals, empty for None."""
    found: list[str] = []
    for v in values:
        found += [number(v.value), number(v.low), number(v.high)] if v else ["", "", ""]
    return found


def csv_rows(rows: Sequence[Mapping[str, object]]) -> str:
    """Return rows with the same columns as CSV, their names first."""
    return csv_text([list(rows[0]), *(list(row.values()) for row in rows)])


def csv_text(lines: Iterable[Sequence[object]]) -> str:
    """Return lines of fields as CSV."""
    text = io.StringIO()
    # The same bytes on every system.
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue()
