"""The leaderboard as one page of Markdown."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from typing import Final

from oodd_eval.data.facts import GROUPS
from oodd_eval.leaderboard.entry import SubmittedEntry
from oodd_eval.leaderboard.sections import LeaderboardSection
from oodd_eval.results.tables import ranking_tables, tables, tiers
from oodd_eval.results.tables.board import Board
from oodd_eval.results.tables.markdown import escape, table
from oodd_eval.results.tables.tables import Table

_INTRODUCTION = """# Leaderboard

Detectors of out-of-distribution dynamics on frozen splits, ranked by matched AUC. This page is
written by `oodd-eval leaderboard build` from the entries under [results](results); edit those, not
this. How to read it: [docs/leaderboard.md](../docs/leaderboard.md). How to take part:
[docs/submitting.md](../docs/submitting.md).
"""

_LEGEND = """Rank is 1 + the number of rows that are significantly better (paired bootstrap over
test seeds, Holm's correction over all pairs of the table). Rows that share a letter under *ties*
cannot be told apart. Trivial rows know nothing of the dynamics: what does not beat them has found
nothing. AUC is the paper's, for which the trivial row *clock* has 100 by construction. Brackets
hold 95 % intervals.
"""

_TABLES = ("ranking", "cells", "comparisons")
"""Kinds of CSV files of a section."""

MANY: Final = 6
"""Findings beyond which they are folded away."""

WIDEST: Final = 12
"""Rows beyond which the matrix of win rates is left to ``comparisons.csv``."""


def table_file(section: LeaderboardSection, kind: str) -> str:
    """Return the relative name of a section's CSV file of a kind."""
    return f"tables/{section.name}-{kind}.csv"


def page(sections: Sequence[LeaderboardSection], *, site: str = "") -> str:
    """Return the whole page.

    Parameters
    ----------
    sections
        All boards, in their order.
    site
        Relative address of the site, if there is one.
    """
    entries = {e.meta.id: e for section in sections for e in section.entries}
    parts = [_INTRODUCTION]
    if site:
        parts.append(f"To sort, filter and see single trajectories: open [{site}]({site}).\n")
    parts += [_contents(sections)] if len(sections) > 1 else []
    parts += [_section(section) for section in sections]
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
        rows = len(section.ranks.standings)
        digest = section.ranks.board.digest[:12]
        lines.append(f"- [{escape(title)}](#{address}), digest {digest}: {rows} rows")
    return "\n".join([*lines, ""])


def _title(board: Board) -> str:
    limited = f", first {board.limit} trajectories of each part" if board.limit is not None else ""
    return f"Split {board.split}, protocol {board.protocol}{limited}"


def _section(section: LeaderboardSection) -> str:
    ranks = section.ranks
    board = ranks.board
    ok = sum(r.ok for r in board.records)
    files = ", ".join(f"[{kind}]({table_file(section, kind)})" for kind in _TABLES)
    size = (
        f"Digest {escape(board.digest)}. Rows: {len(ranks.standings)}. Cells: "
        f"{len(board.records)}, of which {ok} ok and {len(board.records) - ok} failed."
    )
    rendered = [
        ranking_tables.alarms(ranks),
        ranking_tables.cost(ranks),
        *_as_in_the_paper(board),
        tables.ranking(board),
        tables.all_metrics(board),
        tables.calibrated(board),
        ranking_tables.pooled(ranks),
        ranking_tables.wins(ranks) if len(ranks.ranking.ranks) <= WIDEST else None,
        _failures(section),
    ]
    parts = [
        f"## {escape(_title(board))}\n",
        f"{tiers.about(board)}\n",
        f"{size} As CSV: {files}.\n",
        *(
            f"> {escape(e.meta.id)}: {escape(e.meta.caption)}\n"
            for e in section.entries
            if e.meta.caption
        ),
        table(ranking_tables.ranking(ranks, section.trust)),
        _LEGEND,
        *(f"- {escape(line)}" for line in ranking_tables.notes(ranks)),
        "",
        *_findings(board),
        *(table(one) for one in rendered if one),
        *(f"- {escape(line)}" for line in tables.notes(board)),
    ]
    return "\n".join(parts) + "\n"


def _findings(board: Board) -> list[str]:
    """Return what simple rows beat, in bold; folded away where it is much."""
    found = [escape(sentence) for sentence in tables.findings(board)]
    if len(found) <= MANY:
        return [f"**{sentence}**\n" for sentence in found]
    summary = f"{len(found)} times a simple row has a higher mean than a learned one"
    listed = [f"- {sentence}" for sentence in found]
    return [f"<details><summary><b>{summary}</b></summary>\n", *listed, "\n</details>\n"]


def _as_in_the_paper(board: Board) -> list[Table]:
    """Return the layout of the paper's Table 5 for each horizon and group of anomalies.

    It has a column per row of the board, so that it is kept to rows with default parameters.
    """
    plain = [entry for entry in board.entries if not entry.overrides]
    records = [r for r in board.records if r.setting in plain]
    if not records:
        return []
    own = Board(records)
    groups = [group for group in GROUPS if own.in_group(group)]
    return [tables.anomaly_groups(own, h, [group]) for h in own.horizons for group in groups]


def _failures(section: LeaderboardSection) -> Table | None:
    failed = section.ranks.board.failures()
    rows = [[r.environment, r.label, r.status, r.reason] for r in failed]
    header = ["environment", "detector", "state", "reason"]
    return Table("Failures", header, rows, labels=4) if rows else None


def _entry(entry: SubmittedEntry) -> str:
    """Return who submitted an entry, and all that is known of how it was made."""
    meta = entry.meta
    rerun = f", by {meta.rerun.get('by', '')}: {meta.rerun.get('how', '')}" if meta.rerun else ""
    plugins = [
        f"{p.get('distribution', '')} {p.get('version', '')} (plug-in {p.get('plugin', '')}, "
        f"source {p.get('source_digest', '')[:12]})"
        for p in meta.plugins
    ]
    packages = meta.environment.get("packages", {})
    versions = [f"{name} {packages[name]}" for name in sorted(packages)]
    python = f"Python {meta.environment.get('python', '')}"
    lines = [
        ("Detectors", ", ".join(sorted(meta.detectors))),
        ("Split", f"{meta.split}, digest {meta.split_digest[:12]}, protocol {meta.protocol}"),
        ("Submitted by", f"{meta.submitter or 'nobody named'}, {meta.created}"),
        ("Trust level", f"{meta.trust}{rerun}"),
        ("Citation", meta.citation),
        ("Plug-ins", "; ".join(plugins)),
        ("Platform", f"{python}, {meta.environment.get('platform', '')}"),
        ("Packages", ", ".join(versions)),
        ("Note", meta.caption),
    ]
    listed = [f"- {name}: {escape(text)}" for name, text in lines if text]
    if meta.url:
        listed.append(f"- Page: {_link(meta.url)}")
    command = " ".join(meta.command.split())
    # An indented block ends nowhere but at its line's end, whatever the command holds.
    made = ["", "Made with:", "", f"    {command}"] if command else []
    return "\n".join([f"### {escape(meta.id)}: {escape(meta.title)}", "", *listed, *made, ""])


def _link(url: str) -> str:
    """Return a link to a plain web address, and anything else as text."""
    return f"<{url}>" if re.fullmatch(r"https?://[^\s<>|\\`]+", url) else escape(url)
