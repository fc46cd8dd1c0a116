"""Boards of seasons: read, refused where rows are incomplete, and ordered."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from oodd_eval.data.facts import ENVIRONMENTS, WORLDS
from oodd_eval.errors import ResultsError
from oodd_leaderboard.season_files import SEASON, Season, read_season
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
    ranks = ordered(records, season.entries, expected=season.expected)
    return SeasonBoard(season, ranks, lacking(season))


def lacking(season: Season) -> list[str]:
    """Return what a trial lacks of a season; nothing for a season."""
    if not season.trial:
        return []
    absent = [e for e in (*ENVIRONMENTS, *WORLDS) if e not in season.environments]
    return [f"environments {', '.join(absent)}"] if absent else ["the sizes of a season"]


def read_seasons(leaderboard: Path) -> list[SeasonBoard]:
    """Read the seasons of a leaderboard's directory, the newest first."""
    paths = [path.parent for path in (leaderboard / SEASONS).glob(f"*/{SEASON}")]
    seasons = map(read_season_board, sorted(paths))
    return sorted(seasons, key=lambda board: board.season.date, reverse=True)
