"""Boards of seasons: read, refused where rows are incomplete, and ordered."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from oodd_eval.data.facts import ENVIRONMENTS, WORLDS
from oodd_eval.errors import ResultsError
from oodd_eval.names import counted
from oodd_eval.prose import Table
from oodd_leaderboard.season_files import SEASON, Season, read_season, row_path
from oodd_leaderboard.standings import OrderedBoard, ordered

SEASONS: Final = "seasons"  # directory of the seasons in that of the leaderboard


@dataclass(frozen=True, slots=True)
class SeasonBoard:
    """The board of a season; `lacks` says by phrases why a trial is none."""

    season: Season
    ranks: OrderedBoard
    lacks: list[str]

    @property
    def name(self) -> str:
        """Name in file names."""
        return f"season-{self.season.name}"

    @property
    def title(self) -> str:
        """Name in headings."""
        return f"{'Trial' if self.season.trial else 'Season'} {self.season.name}"

    @property
    def notice(self) -> str:
        """What a trial lacks, as a sentence; empty for a season."""
        return f"This trial lacks {' and '.join(self.lacks)}." if self.lacks else ""

    def drawn(self) -> Table:
        """Return which anomalies, with their strengths, the bits gave each environment."""
        groups = self.ranks.board.groups
        rows = []
        for environment, conditions in self.season.conditions.items():
            kinds = {text: text.partition("@")[0] for text in conditions}
            of_groups = ([t for t in conditions if kinds[t] in groups[group]] for group in groups)
            rows.append([environment, *map(", ".join, of_groups)])
        note = (
            "kept90 is the strength at which the policy keeps 90 % of its return, loss10 that at "
            "which its task's loss grows by 10 %. Numbers stand in season.json."
        )
        header = ["environment", *groups]
        return Table("Anomalies that were drawn", header, rows, labels=len(header), note=note)


def read_season_board(directory: Path) -> SeasonBoard:
    """Read a season and order its rows.

    `ResultsError`: rows lack environments, and the message has a line for each of them.
    """
    season = read_season(directory)
    records = season.records(directory)
    if missing := season.missing(records):
        listed = "\n  ".join(missing)
        raise ResultsError(
            f"season {season.name} is no board yet, these rows are not whole:\n  {listed}\n"
            "run leaderboard season again, which goes on where it stopped"
        )
    # An oracle lacks the equations of some environments, which is no failure.
    run = [r for r in records if (r.training, r.status) != ("oracle", "incompatible")]
    ranks = ordered(run, season.entries, expected=season.expected)
    return SeasonBoard(season, ranks, lacking(season))


def lacking(season: Season) -> list[str]:
    """Return what a trial lacks of a season; nothing for a season."""
    if not season.trial:
        return []
    absent = [e for e in (*ENVIRONMENTS, *WORLDS) if e not in season.environments]
    return [f"environments {', '.join(absent)}"] if absent else ["the sizes of a season"]


def read_seasons(leaderboard: Path) -> list[SeasonBoard]:
    """Read the seasons of a leaderboard's directory that ended, in the order of `newest_first`."""
    return newest_first(
        read_season_board(path) for path, season in _seasons(leaderboard) if season.date
    )


def under_way(leaderboard: Path) -> list[str]:
    """Return a sentence for each season of a leaderboard's directory that has not ended."""
    sentences = []
    for path, season in _seasons(leaderboard):
        if not season.date:
            run = sum(row_path(path, name).is_file() for name in season.entries)
            rows = counted(len(season.entries), "row(s)")
            sentences.append(f"Season {season.name} is under way: {run} of {rows} have been run.")
    return sentences


def _seasons(leaderboard: Path) -> list[tuple[Path, Season]]:
    paths = sorted(path.parent for path in (leaderboard / SEASONS).glob(f"*/{SEASON}"))
    return [(path, read_season(path)) for path in paths]


def newest_first(seasons: Iterable[SeasonBoard]) -> list[SeasonBoard]:
    """Return seasons by date, the newest first, and behind them trials."""
    by_date = sorted(seasons, key=lambda s: (s.season.date, s.season.name), reverse=True)
    return sorted(by_date, key=lambda s: s.season.trial)
