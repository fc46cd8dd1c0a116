"""Boards as Markdown, for people, and as CSV, for spreadsheets and scripts."""

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from tabulate import tabulate

from oodd_eval.data.facts import GROUPS, SPLITS
from oodd_eval.data.split import published_digests
from oodd_eval.metrics.catalogue import RANKING
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import NAN, Metric, Record
from oodd_eval.results.tables import layout
from oodd_eval.results.tables.board import Board, RankedBoard, Value, boards
from oodd_eval.results.tables.layout import Table

_TITLES: Final = {
    "standard": "The leaderboard's own split",
    "paper": "The paper's size",
    "reduced": "Reduced tier",
    "mini": "Trial tier",
}
_REMARKS: Final = {
    "reduced": " They are the first trajectories of the split standard, for machines on which the "
    "whole of it takes too long: intervals are wider than they would be there, fewer rows can be "
    "told apart, and the numbers are not those of standard.",
    "mini": " It comes with the package, for trying and for continuous integration: shorter "
    "episodes and too few test seeds to publish a method on.",
}


def report(records: Sequence[Record], *, intervals: bool = False) -> str:
    """Return a report on records as Markdown: a section for each board among them."""
    sections = [_section(board, intervals=intervals) for board in boards(records)]
    return "\n".join(["# Results", "", *sections]) if sections else "# Results\n\nNo records.\n"


def _section(board: Board, *, intervals: bool) -> str:
    ok = sum(r.ok for r in board.records)
    found = [
        layout.separability(board, intervals=intervals),
        layout.guaranteed(board, intervals=intervals),
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


def about_split(board: Board) -> str:
    """Return which tier a board is of and what its split holds, as Markdown.

    A split is a published one by its digest, not by its name.
    """
    name = board.split
    if name not in SPLITS or published_digests().get(name) != board.digest:
        return (
            f"**Not a published split.** {escape(name)} was built by those who submitted these "
            "results; compare the rows with one another alone."
        )
    split = SPLITS[name]
    cap = split.episode_cap
    episodes = "whole episodes" if cap is None else f"episodes of at most {cap} steps"
    return (
        f"**{_TITLES[name]}.** Per environment {split.train} training and {split.calibration} "
        f"calibration trajectories, and {split.test} test seeds, each with its nominal twin and "
        f"all anomalies; {episodes}.{_REMARKS.get(name, '')}"
    )


def ranking_csv(ranks: RankedBoard, trust: Mapping[Setting, str]) -> str:
    """Return one line per row: place, cost, and every metric over all cells with its interval."""
    board = ranks.board
    wanted = [(name, name, board.anomalies) for name in _metrics(ranks)]
    wanted += [(f"{RANKING}_{g}", RANKING, board.in_group(g)) for g in GROUPS if board.in_group(g)]
    header = ["rank", "ties", "alarm_rank", "state", "detector", "horizon", "overrides",
              "trivial", "primary", "seeds", "inputs", "trust", "win_rate", "seconds_fit",
              "microseconds_per_step", "peak_rss_mb",
              *_with_ends(column for column, _, _ in wanted)]  # fmt: skip
    lines = []
    for one in ranks.standings:
        entry, cost = one.entry, one.cost
        values = [
            board.mean(entry, board.environments, anomalies, metric, intervals=True)
            for _, metric, anomalies in wanted
        ]
        lines.append([
            one.rank, one.ties, one.alarm_rank, one.state, *_setting(entry),
            str(one.trivial).lower(), str(one.primary).lower(), one.seeds, one.inputs,
            trust.get(entry, ""), *map(number, (one.wins, cost.fit, cost.step, cost.peak)),
            *_ends(values),
        ])  # fmt: skip
    return csv_text([header, *lines])


def cells_csv(ranks: RankedBoard) -> str:
    """Return one line per cell with its stored metrics and their intervals."""
    names = _metrics(ranks)
    header = ["detector", "horizon", "overrides", "seed", "environment", "group", "anomaly",
              "status", "brief", *_with_ends(names)]  # fmt: skip
    lines = [
        [*_setting(one.entry), r.seed, r.environment, r.group, r.anomaly, r.status,
         str(r.brief).lower(), *_ends(map(r.metrics.get, names))]
        for one in ranks.standings
        for r in one.records
    ]  # fmt: skip
    return csv_text([header, *lines])


def comparisons_csv(ranks: RankedBoard) -> str:
    """Return one line per ordered pair of ranked rows: difference, p-values, win rate."""
    header = ["first", "second", "difference", "difference_low", "difference_high", "p", "p_holm",
              "better", "win_rate"]  # fmt: skip
    place = {label: i for i, label in enumerate(ranks.ranking.ranks)}
    lines = [
        [c.first, c.second, *map(number, (c.difference, c.low, c.high, c.p, c.p_holm)),
         str(c.better).lower(), number(ranks.rates[c.first, c.second])]
        for c in sorted(ranks.ranking.comparisons, key=lambda c: (place[c.first], place[c.second]))
    ]  # fmt: skip
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


def _setting(setting: Setting) -> tuple[str, int, str]:
    return setting.detector, setting.horizon, setting.overrides_json


def _with_ends(names: Iterable[str]) -> list[str]:
    return [column for name in names for column in (name, f"{name}_low", f"{name}_high")]


def _ends(values: Iterable[Value | Metric | None]) -> list[str]:
    """Return the texts of values under the columns of `_with_ends`."""
    ends = ((v.value, v.low, v.high) if v else (NAN, NAN, NAN) for v in values)
    return [number(end) for three in ends for end in three]


def csv_text(lines: Iterable[Sequence[object]]) -> str:
    """Return lines of fields as CSV."""
    text = io.StringIO()
    # The same bytes on every system.
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue()
