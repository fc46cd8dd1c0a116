"""The leaderboard: entries sorted into boards, and all files that are rendered from them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from oodd_eval.errors import ResultsError
from oodd_eval.leaderboard.entry import TRUST, SubmittedEntry
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record
from oodd_eval.results.tables.board import boards
from oodd_eval.results.tables.standings import RankedBoard, ranked

_SPLITS_FIRST: Final = ("standard", "paper", "reduced", "mini")
"""Order of the boards: the leaderboard's own split, then from the most data to the least."""


@dataclass(frozen=True, slots=True)
class LeaderboardSection:
    """One board of the leaderboard.

    Attributes
    ----------
    ranks
        The board with its ranking.
    entries
        The entries that have records on it, by id.
    sources
        By row: the entries that its records are from.
    """

    ranks: RankedBoard
    entries: list[SubmittedEntry]
    sources: dict[Setting, list[SubmittedEntry]]

    @property
    def trust(self) -> dict[Setting, str]:
        """Trust level by row: the lowest of its entries."""
        return {
            row: min((e.meta.trust for e in entries), key=TRUST.index)
            for row, entries in self.sources.items()
        }

    @property
    def name(self) -> str:
        """Name in file names, such as ``mini-8fb95f205861-protocol1``."""
        board = self.ranks.board
        split = re.sub(r"[^A-Za-z0-9-]+", "-", board.split.partition("@")[0])
        limit = f"-limit{board.limit}" if board.limit is not None else ""
        return f"{split}-{board.digest[:12]}-protocol{board.protocol}{limit}"


def sections(entries: Sequence[SubmittedEntry]) -> list[LeaderboardSection]:
    """Sort entries into boards of one split digest, protocol and limit each.

    Several entries may have records in one row (further seeds or environments of a detector) as
    long as they are results of the same thing: the same plug-in, version, source and parameters.

    Parameters
    ----------
    entries
        In any order; the result is the same.

    Raises
    ------
    ResultsError
        When two entries hold the same cell, or one row is of different plug-ins, versions or
        parameters. Nothing is chosen silently: which one counts is for people to decide.
    """
    by_id = sorted(entries, key=lambda entry: entry.meta.id)
    owner: dict[int, SubmittedEntry] = {}
    cells: dict[tuple[object, ...], SubmittedEntry] = {}
    records: list[Record] = []
    for entry in by_id:
        for record in entry.records:
            _refuse_twice(record, entry, cells)
            owner[id(record)] = entry
            records.append(record)
    found = []
    for board in boards(records):
        _refuse_mixtures(board.records, owner)
        own = {owner[id(r)].meta.id: owner[id(r)] for r in board.records}
        rows: dict[Setting, dict[str, SubmittedEntry]] = {}
        for record in board.records:
            source = owner[id(record)]
            rows.setdefault(record.setting, {})[source.meta.id] = source
        sources = {row: [of[i] for i in sorted(of)] for row, of in rows.items()}
        found.append(
            LeaderboardSection(ranked(board.records), [own[i] for i in sorted(own)], sources)
        )
    return sorted(found, key=_place)


def _place(section: LeaderboardSection) -> tuple[int, str, int, int, str]:
    board = section.ranks.board
    name = board.split.partition("@")[0]
    known = _SPLITS_FIRST.index(name) if name in _SPLITS_FIRST else len(_SPLITS_FIRST)
    # Whole splits before limited ones, the newest protocol first.
    limit = -1 if board.limit is None else int(board.limit)
    return known, name, limit, -board.protocol, board.digest


def _refuse_twice(
    record: Record, entry: SubmittedEntry, cells: dict[tuple[object, ...], SubmittedEntry]
) -> None:
    conditions = record.split_digest, record.protocol, record.limit
    place = record.environment, record.anomaly, record.seed
    key = (record.setting, *place, *conditions)
    if (other := cells.get(key)) is not None:
        raise ResultsError(
            f"entries {other.meta.id!r} and {entry.meta.id!r} both hold {record.cell} of split "
            f"digest {record.split_digest[:12]}, expected one: remove the entry that is replaced, "
            "or give the detector another name"
        )
    cells[key] = entry


def _source(record: Record) -> str:
    return record.plugin_source[:12]


def _refuse_mixtures(records: Sequence[Record], owner: Mapping[int, SubmittedEntry]) -> None:
    """Refuse rows whose records are not of one plug-in, version, source and parameters."""
    first: dict[Setting, Record] = {}
    for record in records:
        row = record.setting
        one = first.setdefault(row, record)
        for what, its, other in (
            ("plug-in", one.plugin, record.plugin),
            ("version", one.detector_version, record.detector_version),
            ("source digest", _source(one), _source(record)),
            ("parameters", one.parameters, record.parameters),
        ):
            if its != other:
                raise ResultsError(
                    f"row {row.label!r} of split digest {record.split_digest[:12]} has {what} "
                    f"{its!r} in entry {owner[id(one)].meta.id!r} and {other!r} in entry "
                    f"{owner[id(record)].meta.id!r}, expected one thing per row: remove the entry "
                    "that is replaced, or give the detector another name"
                )
