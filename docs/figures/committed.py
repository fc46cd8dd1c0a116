"""What is committed under leaderboard/, for the numbers of README.md and pages of results."""

import csv
import functools
from collections.abc import Callable, Iterable
from pathlib import Path

from oodd_leaderboard.pages import Leaderboard, read_leaderboard
from oodd_leaderboard.seasons import SeasonBoard
from oodd_leaderboard.standings import primary_settings

from oodd_eval.results.board import Board, boards
from oodd_eval.results.directory import ResultsDirectory, read_records
from oodd_eval.results.identity import Setting

ROOT = Path(__file__).parents[2]
BOARD = ROOT / "leaderboard"
README, RESULTS = ROOT / "README.md", ROOT / "docs" / "results.md"
DETAILS = sorted((ROOT / "docs" / "results").glob("*.md"))
INTERVENTIONS = ROOT / "docs" / "interventions.md"
FAILURES = ROOT / "docs" / "failures.md"

SEASON = "season"

Row = Callable[[str], str]
"""Return the cells of a row behind its first one, separated by bars, from what the first names."""


def lines(path: str) -> list[dict[str, str]]:
    """Return the rows of a committed CSV file."""
    with (BOARD / path).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


@functools.cache
def leaderboard() -> Leaderboard:
    """Return the seasons, reported rows and suites of the leaderboard."""
    return read_leaderboard(BOARD)


def newest() -> SeasonBoard:
    """Return the board of the newest season."""
    return next(board for board in leaderboard().seasons if not board.season.trial)


@functools.cache
def board(name: str) -> Board:
    """Return a suite's board, that of the rows reported on a split, or the newest season's."""
    if name == SEASON:
        return newest().ranks.board
    if (BOARD / "suites" / name).is_dir():
        (of_split,) = boards(ResultsDirectory(BOARD / "suites" / name).records())
        return of_split
    reported = (section.ranks.board for section in leaderboard().reported)
    return next(board for board in reported if board.split == name)


@functools.cache
def logs() -> dict[str, Board]:
    """Return the boards of public logs by environment."""
    of_splits = boards(ResultsDirectory(BOARD / "suites" / "logs").records())
    return {board.environments[0]: board for board in of_splits}


def primary(records: Board, name: str) -> Setting:
    """Return the row of a board that stands for a detector, or for an entry such as ``riqn-5``.

    `KeyError`: it is not on the board; `NotRunError`, where an entry has this name.
    """
    entries = {entry.name: entry for entry in leaderboard().entries}
    variant = entries[name] if name in entries and entries[name].variant else None
    setting = Setting.of(variant.detector, 1, variant.parameters) if variant else Setting(name)
    simplest = {row.detector: row for row in primary_settings(records.records)}
    if setting not in records.entries and name in simplest:
        return simplest[name]
    if setting not in records.entries:
        raise (NotRunError if name in entries else KeyError)(name)
    return setting


class NotRunError(KeyError):
    """An entry that has no row on a board, or an environment that a board does not have."""


def mean(
    name: str,
    row: str | Setting,
    metric: str,
    *,
    environments: Iterable[str] = (),
    anomalies: Iterable[str] = (),
) -> float:
    """Return a row's mean of a metric in per cent, by default over all cells."""
    records = board(name)
    setting = row if isinstance(row, Setting) else primary(records, row)
    over = [*environments] or records.environments, [*anomalies] or records.anomalies
    if absent := {*over[0]} - {*records.environments}:
        raise NotRunError(*absent)
    return 100 * records.mean(setting, *over, metric).value


def cells(values: Iterable[float]) -> str:
    """Return numbers with one decimal as cells."""
    return " | ".join(f"{value:.1f}" for value in values)


def of_reproductions(table1: str, losses: str) -> Row:
    """Return AUC by group of a model: of the paper, at Table 1's strengths, at equal losses."""

    def means(split: str) -> dict[tuple[str, str], dict[str, str]]:
        rows = lines(f"reproduction/{split}/tables/table-5.csv")
        rows = [r for r in rows if (r["environment"], r["metric"]) == ("mean", "auc")]
        return {(r["series"], r["anomalies"]): r for r in rows}

    def row(name: str) -> str:
        ours, same = means(table1), means(losses)
        keys = [(name, group) for group in ("sensor", "dynamics")]
        texts = (t for k in keys for t in (same[k]["paper"], ours[k]["value"], same[k]["value"]))
        return cells(100 * float(text) for text in texts)

    return row


def overview(suite: str, name: str) -> list[str]:
    """Return the cells of a row of detection thresholds on a suite's page."""
    page = (BOARD / "suites" / suite / "README.md").read_text(encoding="utf-8")
    table = page.partition("\n### Detection thresholds, lower is better")[2].split("\n\n")[1]
    rows = [[cell.strip().replace("\\", "") for cell in line.split("|")[1:-1]]
            for line in table.splitlines()]  # fmt: skip
    (row,) = (row for row in rows if row[0] == name)
    return row


@functools.cache
def claims(split: str) -> dict[tuple[str, str], dict[str, str]]:
    """Return the judgements of a reproduction by claim and measure."""
    return {(r["claim"], r["kind"]): r for r in lines(f"reproduction/{split}/claims.csv")}


@functools.cache
def rollouts() -> dict[str, Board]:
    """Return the boards of rows on rollouts of a learned policy, by split, see `failures.py`."""
    records = read_records(Path(__file__).with_name("failures.jsonl.xz"))
    return {board.split: board for board in boards(records)}
