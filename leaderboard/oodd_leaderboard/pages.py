"""The files of the leaderboard, rendered from records: a page of Markdown, tables, the site."""

import contextlib
import re
import tomllib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from oodd_eval.data.facts import SPLITS, WORLDS
from oodd_eval.data.files import PACKED, compress, decompress, write_bytes, write_text
from oodd_eval.data.split import published_digests
from oodd_eval.errors import ResultsError
from oodd_eval.metrics.catalogue import UNDEFINED, metric_info
from oodd_eval.prose import Section, Table
from oodd_eval.results import tables
from oodd_eval.results.board import Board
from oodd_eval.results.record import Record
from oodd_eval.results.render.text import escape, markdown_body, markdown_table
from oodd_eval.results.report import findings_of
from oodd_leaderboard import site
from oodd_leaderboard.board_csv import cells_csv, standings_csv
from oodd_leaderboard.entry import Entry
from oodd_leaderboard.published import (
    ORIGINS,
    PUBLISHED,
    board_table,
    difference_text,
    published_bytes,
)
from oodd_leaderboard.reported import (
    REPORTED,
    SUITES,
    TABLES,
    LeaderboardSection,
    SuiteSection,
    by_detector,
    day_of,
    entries_of,
    read_reported,
    sections,
    suite_sections,
)
from oodd_leaderboard.season_files import SEASON
from oodd_leaderboard.seasons import SeasonBoard, read_season_board, read_seasons, under_way
from oodd_leaderboard.standings import OrderedBoard

PAGE: Final = "README.md"
SITE: Final = "site"
CELLS: Final = f"{SITE}/cells.csv.gz"
PARTS: Final = f"{SITE}/{site.PARTS}/"
STALE: Final = "no part of the leaderboard any more"

TEXTS: Final = tomllib.loads(Path(__file__).with_name("page.toml").read_text(encoding="utf-8"))


@dataclass(frozen=True, slots=True)
class Leaderboard:
    """What a leaderboard's directory holds: seasons, reported rows, further test suites."""

    seasons: Sequence[SeasonBoard] = ()
    reported: Sequence[LeaderboardSection] = ()
    suites: Sequence[SuiteSection] = ()
    entries: Sequence[Entry] = ()
    under_way: Sequence[str] = ()
    alone: bool = False  # a season's directory has no published file

    @property
    def boards(self) -> list[SeasonBoard | LeaderboardSection]:
        """All boards in the order of the page."""
        return [*self.seasons, *self.reported]


def read_leaderboard(directory: Path) -> Leaderboard:
    """Read a leaderboard's directory, or that of a single season.

    `ResultsError`: a season is incomplete, or something cannot be read.
    """
    if (directory / SEASON).is_file():
        return Leaderboard([read_season_board(directory)], alone=True)
    entries = entries_of(directory)
    reported = sections(read_reported(directory), by_detector(entries))
    suites, unfinished = suite_sections(directory), under_way(directory)
    return Leaderboard(read_seasons(directory), reported, suites, entries, unfinished)


def build(
    leaderboard: Leaderboard,
    output: Path,
    *,
    at: Path | None = None,
    on_part: Callable[[str], object] = str,
) -> list[str]:
    """Write page, tables, site and the published file, the same for the same records.

    Returns their names, the page first. Links are those of files `at` a place, by default there. A
    compressed file with the same content stays as it is, whatever has compressed it. `on_part` is
    called with the name of each part before it is made.
    """
    on_part("page and tables")
    files = documents(leaderboard, site.project(at or output))
    files[CELLS] = cells(leaderboard)
    on_part("site")
    boards = leaderboard.reported, leaderboard.suites, leaderboard.seasons
    parts = site.files(*boards, links=site.links(at or output))
    files |= {f"{SITE}/{name}": content for name, content in parts.items()}
    for name, content in files.items():
        if isinstance(content, str):
            write_text(output / name, content)
        elif not _has_content(output / name, content):
            write_bytes(output / name, content)
    for old in set((output / PARTS).glob("*.js")) - {output / name for name in files}:
        old.unlink()
    return list(files)


def documents(leaderboard: Leaderboard, project: str = "../") -> dict[str, str | bytes]:
    """Return what is committed beside the records by name: page, tables, the published file."""
    files: dict[str, str | bytes] = {PAGE: page(leaderboard, project)}
    for section in leaderboard.boards:
        files[_csv(section)] = standings_csv(section.ranks)
    if not leaderboard.alone:
        boards = leaderboard.reported, leaderboard.seasons
        files[PUBLISHED] = published_bytes(*boards, leaderboard.entries)
    return files


def _csv(section: SeasonBoard | LeaderboardSection) -> str:
    return f"{TABLES}/{section.name}.csv"


def cells(leaderboard: Leaderboard) -> bytes:
    """Return all cells of boards, and then of suites, as one table (compressed CSV)."""
    lines: list[tuple[dict[str, str], Record]] = []
    for section in leaderboard.boards:
        for row in section.ranks.standings:
            about = _about(section.name, variant=row.variant, trivial=row.trivial)
            lines += [(about, r) for r in row.records]
    for suite in leaderboard.suites:
        for r in suite.board.records:
            trivial = suite.board.is_trivial(r.setting)
            lines.append((_about(suite.name, variant=False, trivial=trivial), r))
    return compress(cells_csv(lines).encode())


def _about(board: str, **flags: bool) -> dict[str, str]:
    """Return the columns that stand before a cell's own in the table of all cells."""
    return {"board": board} | {name: str(flag).lower() for name, flag in flags.items()}


def differences(fresh: Path, existing: Path) -> list[str]:
    """Return a line for every file of `existing` that a fresh build changes, adds or drops.

    The site is no part of this: it is built where it is shown, and not committed.
    """
    new, old = _files(fresh), _files(existing)
    changed = {n for n in new & old if _content(fresh / n) != _content(existing / n)}
    parts = ((new - old, "missing"), (old - new, STALE), (changed, "differs"))
    return sorted(f"{name}: {difference}" for names, difference in parts for name in names)


def stale(output: Path, written: Collection[str]) -> list[str]:
    """Return the tables below a directory that are not among those written."""
    return sorted(name for name in _files(output) - set(written) if name.startswith(TABLES))


def _files(output: Path) -> set[str]:
    """Return the names of the committed files that builds write, and of none beside them."""
    paths = [output / PAGE, output / PUBLISHED, *(output / TABLES).glob("*.csv")]
    return {path.relative_to(output).as_posix() for path in paths if path.is_file()}


def _content(path: Path) -> bytes:
    """Return what a file says: other versions compress the same content differently."""
    content = path.read_bytes()
    return decompress(content) if path.suffix in PACKED else content


def _has_content(path: Path, compressed: bytes) -> bool:
    """Tell whether a file is there and says this; one that is too large to be unpacked does not."""
    with contextlib.suppress(OSError, ResultsError):
        return path.read_bytes() == compressed or _content(path) == decompress(compressed)
    return False


def page(leaderboard: Leaderboard, project: str = "../") -> str:
    """Return the whole page: seasons first, then reported rows and further suites.

    `project` is what addresses of documents begin with; without it they are no links.
    """
    parts = [TEXTS["introduction"].format(site=f"{SITE}/{site.PAGE}")]
    if not leaderboard.seasons:
        parts.append(TEXTS["no-season"])
    parts += [f"{escape(sentence)}\n" for sentence in leaderboard.under_way]
    parts += map(_season, leaderboard.seasons)
    if leaderboard.reported:
        parts.append(TEXTS["reported"].format(sentence=REPORTED))
    parts += map(_reported, leaderboard.reported)
    parts += map(_suite, leaderboard.suites)
    text = "\n".join([*parts, TEXTS["taking-part"]])
    link = rf"[\1]({project}\2)" if project else r"\1"
    return re.sub(r"\[(docs/[^]]*)\]\(\.\./(docs/[^)]*)\)", link, text)


def _season(board: SeasonBoard) -> str:
    season, ranks = board.season, board.ranks
    title = ", ".join(filter(None, [board.title, season.date])) + ": no board" * season.trial
    definition = season.split.definition
    facts = TEXTS["season"].format(
        bits=season.bits,
        split=season.split.name,
        digest=season.split.digest,
        protocol=season.protocol,
        version=season.oodd_eval,
        seeds=", ".join(map(str, season.seeds)),
        cap=definition["episode_cap"],
        worlds=", in worlds their own length" * bool(set(WORLDS) & {*season.environments}),
        table=_csv(board),
        **{name: definition[name] for name in ("train", "calibration", "test")},
    )
    facts = "\n".join(filter(None, [board.notice, facts.rstrip()]))
    return _board(title, facts, ranks, season.entries, [TEXTS["legend"]], board.drawn())


def _reported(section: LeaderboardSection) -> str:
    board = section.ranks.board
    limited = f", first {board.limit} trajectories of each part" if board.limit is not None else ""
    title = f"Reported on {board.split}, protocol {board.protocol}{limited}"
    size = TEXTS["table"].format(
        digest=escape(board.digest), date=section.date or UNDEFINED, table=_csv(section)
    )
    legend = [] if board.paired else [TEXTS["unpaired-legend"]]
    facts = f"{about_split(board)}\n\n{size}"
    return _board(title, facts, section.ranks, section.entries, legend)


def _board(
    title: str,
    facts: str,
    ranks: OrderedBoard,
    entries: Mapping[str, Entry],
    legend: Sequence[str],
    *further: Table,
) -> str:
    """Return a board's part of the page: its rows, whose they are, failures, notes."""
    front = board_table(ranks)
    counted = tables.findings(ranks.board)  # a place in the table says the same
    body = Section(
        title,
        findings=[sentence for sentence in findings_of(ranks.board) if sentence not in counted],
        tables=[*filter(None, (tables.failures(ranks.board), *further, _authors(ranks, entries)))],
        notes=[*unranked(ranks), *tables.notes(ranks.board)],
    )
    parts = [
        f"## {escape(title)}\n",
        f"{facts}\n",
        *(f"**{escape(sentence)}**\n" for sentence in first_rows(ranks)),
        *([markdown_table(front, best_cells(front, ranks))] if front else []),
        *legend,
        markdown_body(body),
    ]
    return "\n".join(parts)


def unranked(ranks: OrderedBoard) -> list[str]:
    """Return why rows of a board have no rank; nothing where none has."""
    rows = [row for row in ranks.standings if row.state and ranks.first]
    return [f"Not ranked: {row.entry} ({row.state})." for row in rows]


def first_rows(ranks: OrderedBoard) -> list[str]:
    """Return which row is first, and whether it is told from the second; nothing without ranks."""
    places = [row for row in ranks.standings if row.rank]
    if not places:
        return []
    best, *rest = places
    board = ranks.board
    cells = board.environments, board.anomalies
    mean = board.mean(best.entry, *cells, board.ranking, intervals=True)
    by = f" by {best.authors}" * bool(best.authors) + f" ({best.year})" * bool(best.year)
    noun, figure = metric_info(board.ranking).noun, tables.show_value(mean, board.ranking)
    text = f"Best: {best.entry}{by}, {noun} {figure}."
    if not rest:
        return [f"{text} There is no second ranked row."]
    test = ranks.first[rest[0].entry]
    verdict = "told" if test.told_apart else "not told"
    text += f" It is {verdict} from the second, {rest[0].entry}: the difference is "
    lines = [f"{text}{difference_text(test)}."]
    if (band := sum(row.band for row in places)) > 2:
        lines.append(f"The first band has {band} rows: none of them is told from the first.")
    return lines


LOWER: Final = ("missed", "false episodes")
"""Front columns in which less is better."""


def best_cells(front: Table, ranks: OrderedBoard) -> set[tuple[int, int]]:
    """Return row and column of the best figures of ranked rows, of which trivial ones have none."""
    ranked = [i for i, row in enumerate(ranks.standings) if row.rank and not row.trivial]
    best: set[tuple[int, int]] = set()
    for j, title in list(enumerate(front.header))[front.labels :]:
        printed = {i: re.search(r"-?\d+\.\d+", front.rows[i][j]) for i in ranked}
        figures = {i: float(match[0]) for i, match in printed.items() if match}
        if figures:
            first = (min if title in LOWER else max)(figures.values())
            best |= {(i, j) for i, figure in figures.items() if figure == first}
    return best


def _authors(ranks: OrderedBoard, entries: Mapping[str, Entry]) -> Table:
    """Return whose the rows are, what they learn from, and what their seeds gave."""
    info = metric_info(ranks.board.ranking)
    lines = []
    for row in ranks.standings:
        ends = dict.fromkeys(map(info.text, (row.seed_low, row.seed_high)))
        url = entries[row.entry.detector].url if row.entry.detector in entries else ""
        paper = " ".join(filter(None, [row.paper, url]))
        whose = [ORIGINS[row.origin], row.authors, paper, str(row.year or "")]
        inputs = row.inputs.replace("observations+actions", "+actions")
        versions = ", ".join(dict.fromkeys(r.detector_version for r in row.records))
        run = [versions, day_of(row.records), str(row.seeds)]
        lines.append([str(row.entry), *whose, inputs, *run, " to ".join(ends)])
    header = ["row", "whose", "authors", "paper", "year", "inputs"]
    header += ["version", "run on", "seeds", "mean of a seed"]
    return Table("Whose the rows are", header, lines, labels=8)


def _suite(section: SuiteSection) -> str:
    """Return what rows find on a further test suite, with a link to all tables."""
    address = f"{SUITES}/{section.name}/{PAGE}"
    several = len({row.horizon for row in section.board.entries}) > 1
    kind = "graded" if section.graded else "horizons" if several else "nominal"
    texts = TEXTS["suites"][kind if section.board.paired else "logs"]
    board = section.board
    title = f"## {texts['title']}: split {escape(board.split)}, protocol {board.protocol}\n"
    text = texts["text"].format(split=escape(board.split), place=address)
    return "\n".join([title, text, *map(markdown_table, section.tables[:1])])


def about_split(board: Board) -> str:
    """Return which tier a board is of and what its split holds, as Markdown.

    A split is a published one by its digest, not by its name.
    """
    name = board.split
    if name not in SPLITS or published_digests().get(name) != board.digest:
        return str(TEXTS["unpublished"].format(name=escape(name)))
    split, tiers = SPLITS[name], TEXTS["tiers"]
    tier = tiers.get(name, tiers["further"])
    cap = split.episode_cap
    episodes = "whole episodes" if cap is None else f"episodes of at most {cap} steps"
    return str(TEXTS["published"].format(**asdict(split), **tier, episodes=episodes))
