"""The files of the leaderboard, rendered from its entries: a page of Markdown, tables, the site."""

import contextlib
import re
import tomllib
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

from oodd_eval._version import repository
from oodd_eval.data.facts import SPLITS
from oodd_eval.data.files import PACKED, compress, decompress, write_bytes, write_text
from oodd_eval.data.split import published_digests
from oodd_eval.errors import ResultsError
from oodd_eval.names import counted
from oodd_eval.prose import Section, Table
from oodd_eval.results import tables
from oodd_eval.results.board import Board
from oodd_eval.results.record import Record
from oodd_eval.results.render.tabular import cells_csv, comparisons_csv, ranking_csv
from oodd_eval.results.render.text import escape, markdown_body, markdown_list, markdown_table
from oodd_eval.results.report import findings_of
from oodd_eval.results.standings import RankedBoard, primary_settings, verdict_of
from oodd_eval.results.tables import Tables
from oodd_leaderboard import site
from oodd_leaderboard.published import PUBLISHED, published_bytes
from oodd_leaderboard.reported import (
    REPORTED,
    SUITES,
    TABLES,
    LeaderboardSection,
    SubmittedEntry,
    SuiteSection,
    sections,
)

PAGE: Final = "README.md"
SITE: Final = "site"
CELLS: Final = f"{SITE}/cells.csv.gz"
STALE: Final = "no part of the leaderboard any more"

TEXTS: Final = tomllib.loads(Path(__file__).with_name("page.toml").read_text(encoding="utf-8"))

WIDEST: Final = 12  # rows beyond which the matrix of win rates is left to ``comparisons.csv``


def _origin(board: str, entry: str, *, primary: bool, trivial: bool) -> dict[str, str]:
    """Return the columns that stand before a cell's own in the table of all cells."""
    flags = {"primary": primary, "trivial": trivial}
    texts = {name: str(flag).lower() for name, flag in flags.items()}
    return {"board": board, "entry": entry, **texts}


def build(
    entries: Sequence[SubmittedEntry],
    output: Path,
    suites: Sequence[SuiteSection] = (),
    *,
    on_part: Callable[[str], object] = str,
) -> list[str]:
    """Write page, tables, site and the published file, the same for the same entries.

    Returns their names, the page first. A compressed file with the same content stays as it is,
    whatever has compressed it. `on_part` is called with the name of each part before it is made.
    ResultsError: the entries contradict one another.
    """
    on_part("ranking")
    by_board = sections(entries)
    on_part("page and tables")
    files = documents(by_board, suites)
    files[CELLS] = cells(by_board, suites)
    on_part("site")
    parts = site.files(by_board, suites, project=repository())
    files |= {f"{SITE}/{name}": content for name, content in parts.items()}
    for name, content in files.items():
        if isinstance(content, str):
            write_text(output / name, content)
        elif not _has_content(output / name, content):
            write_bytes(output / name, content)
    for old in set((output / SITE / site.PARTS).glob("*.js")) - {output / name for name in files}:
        old.unlink()
    return list(files)


def documents(
    by_board: Sequence[LeaderboardSection], suites: Sequence[SuiteSection] = ()
) -> dict[str, str | bytes]:
    """Return what is committed beside the entries by name: page, tables and the published file."""
    files: dict[str, str | bytes] = {PAGE: page(by_board, suites, site=f"{SITE}/{site.PAGE}")}
    for section in by_board:
        files[section.file("ranking")] = ranking_csv(section.ranks)
        files[section.file("comparisons")] = comparisons_csv(section.ranks)
    files[PUBLISHED] = published_bytes(by_board, suites)
    return files


def cells(sections: Sequence[LeaderboardSection], suites: Sequence[SuiteSection] = ()) -> bytes:
    """Return all cells of boards, and then of suites, as one table (compressed CSV)."""
    lines: list[tuple[dict[str, str], Record]] = []
    for section in sections:
        for row in section.ranks.standings:
            entry = section.sources[row.entry]
            flags = {"primary": row.primary, "trivial": row.trivial}
            about = _origin("leaderboard", entry.meta.id, **flags)
            lines += [(about, r) for r in row.records]
    for suite in suites:
        first = primary_settings(suite.board.records)
        for r in suite.board.records:
            flags = {"primary": r.setting in first, "trivial": suite.board.is_trivial(r.setting)}
            lines.append((_origin(suite.name, "", **flags), r))
    return compress(cells_csv(lines).encode())


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


def page(
    sections: Sequence[LeaderboardSection], suites: Sequence[SuiteSection] = (), *, site: str = ""
) -> str:
    """Return the whole page with the sections of suites; it names the `site` if there is one."""
    entries = {e.meta.id: e for section in sections for e in section.entries}
    parts = [TEXTS["introduction"], *([TEXTS["site"].format(site=site)] if site else [])]
    parts += [_contents(sections)] if len(sections) > 1 else []
    parts += [_section(section) for section in sections]
    parts += [_suite(suite) for suite in suites]
    parts += ["## Entries\n", *(_entry(entries[i]) for i in sorted(entries))]
    return "\n".join(parts)


def _contents(sections: Sequence[LeaderboardSection]) -> str:
    """Return links to the boards; no two of them are to be compared."""
    seen: Counter[str] = Counter()
    lines = ["Boards, which are not to be compared with one another:", ""]
    for section in sections:
        title = _title(section.ranks.board)
        # As GitHub makes addresses of headings, equal ones numbered.
        slug = re.sub(r"[^a-z0-9 _-]", "", title.lower()).replace(" ", "-")
        address = f"{slug}-{seen[slug]}" if seen[slug] else slug
        seen[slug] += 1
        rows = counted(len(section.ranks.standings), "row(s)")
        digest = section.ranks.board.digest[:12]
        lines.append(f"- [{escape(title)}](#{address}), digest {digest}: {rows}")
    return "\n".join([*lines, ""])


def _title(board: Board) -> str:
    limited = f", first {board.limit} trajectories of each part" if board.limit is not None else ""
    return f"Split {board.split}, protocol {board.protocol}{limited}"


def _section(section: LeaderboardSection) -> str:
    ranks, board = section.ranks, section.ranks.board
    about = [entry.meta for entry in section.entries]
    ok = sum(r.ok for r in board.records)
    kinds = ("ranking", "comparisons")
    files = ", ".join(f"[{kind}]({section.file(kind)})" for kind in kinds)
    cells = f"{len(board.records)}, of which {ok} ok and {len(board.records) - ok} failed"
    size = f"Digest {escape(board.digest)}. Rows: {len(ranks.standings)}. Cells: {cells}."
    plain, placed = Tables(board), Tables(board, intervals=True, standings=ranks.standings)
    body_tables = [
        *(() if board.paired else placed.of_logs(whole=True)),
        *((plain.separability(), placed.guaranteed()) if board.paired else ()),
        placed.attribution(),
        tables.cost(ranks),
        plain.all_metrics(),
        *plain.all_alarms(),
        *(_of_paper(ranks) if board.paired else ()),
        tables.wins(ranks) if len(ranks.ranking.ranks) <= WIDEST else None,
        tables.failures(board),
    ]
    body = Section(
        _title(board),
        verdict=_verdict(ranks),
        findings=findings_of(board),
        tables=[table for table in body_tables if table],
        notes=tables.notes(board),
    )
    parts = [
        f"## {escape(body.title)}\n",
        f"{about_split(board)}\n",
        f"{size} As CSV: {files}.\n",
        f"{_who_ran(section.entries)}\n",
        *(f"> {escape(e.id)}: {escape(e.caption)}\n" for e in about if e.caption),
        f"**{escape(body.verdict)}**\n",
        markdown_table(tables.ranking(ranks)),
        TEXTS["legend" if board.paired else "unpaired-legend"],
        *markdown_list(tables.ranking_notes(ranks)),
        "",
        markdown_body(body),
    ]
    return "\n".join(parts)


def _verdict(ranks: RankedBoard) -> str:
    """Return the sentence that comes first, and before it which rows share the first rank."""
    # A single comparison of two rows is not corrected for all pairs of the board, as ranks are.
    first = [str(s.entry) for s in ranks.standings if s.rank == 1 and s.primary]
    if len(first) < 2:
        return verdict_of(ranks.board)
    return (
        f"{', '.join(first)} share the first rank: over all pairs of rows (Holm) no difference is "
        f"shown. As a single comparison: {verdict_of(ranks.board)}"
    )


def _who_ran(entries: Sequence[SubmittedEntry]) -> str:
    """Return that rows are reported, and by whom."""
    ran: dict[str, set[str]] = {}
    for entry in entries:
        ran.setdefault(entry.meta.submitter or "nobody named", set()).update(entry.meta.detectors)
    rows = [f"{who} ({counted(len(names), 'detector(s)')})" for who, names in sorted(ran.items())]
    return escape(f"{REPORTED} Run by {', '.join(rows)}.")


def _suite(section: SuiteSection) -> str:
    """Return what rows find on a further test suite, with a link to all tables."""
    address = f"{SUITES}/{section.name}/{PAGE}"
    several = len({row.horizon for row in section.board.entries}) > 1
    kind = "graded" if section.graded else "horizons" if several else "nominal"
    texts = TEXTS["suites"][kind if section.board.paired else "logs"]
    title = f"## {texts['title']}: {escape(_title(section.board))}\n"
    text = texts["text"].format(split=escape(section.board.split), place=address)
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


def _of_paper(ranks: RankedBoard) -> list[Table]:
    """Return what the paper's alarm does: means, and the layout of the paper's Table 5."""
    # That has a column per row of the board, so that it is kept to rows with default parameters.
    records = [r for r in ranks.board.records if not r.overrides]
    as_in_the_paper = Tables(Board(records)).anomaly_groups() if records else []
    return [Tables(ranks.board, standings=ranks.standings).papers(), *as_in_the_paper]


def _entry(entry: SubmittedEntry) -> str:
    """Return who submitted an entry, and all that is known of how it was made."""
    meta = entry.meta
    text = "{distribution} {version} (plug-in {plugin}, source {source_digest:.12})"
    plugins = [text.format(**plugin) for plugin in meta.plugins]
    packages = sorted(meta.environment.get("packages", {}).items())
    python = f"Python {meta.environment.get('python', '')}"
    lines = [
        ("Detectors", ", ".join(sorted(meta.detectors))),
        ("Split", f"{meta.split}, digest {meta.split_digest[:12]}, protocol {meta.protocol}"),
        ("Submitted by", f"{meta.submitter or 'nobody named'}, {meta.created}"),
        ("Citation", meta.citation),
        ("Plug-ins", "; ".join(plugins)),
        ("Platform", f"{python}, {meta.environment.get('platform', '')}"),
        ("Packages", ", ".join(f"{name} {version}" for name, version in packages)),
        ("Note", meta.caption),
    ]
    listed = [f"- {name}: {escape(text)}" for name, text in lines if text]
    if meta.url:
        plain = re.fullmatch(r"https?://[^\s<>|\\`]+", meta.url)
        listed.append(f"- Page: <{meta.url}>" if plain else f"- Page: {escape(meta.url)}")
    listed += ["", "To run it again:", "", *(f"    {command}" for command in entry.commands)]
    return "\n".join([f"### {escape(meta.id)}: {escape(meta.title)}", "", *listed, ""])
