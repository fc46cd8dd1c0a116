"""Records of one reproduction from several places, such as the entries of the leaderboard."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from oodd_eval.data import files as stored_files
from oodd_eval.errors import ResultsError
from oodd_eval.paper.experiments import EXPERIMENTS, row_of, setups_of
from oodd_eval.paper.header import Header
from oodd_eval.paper.schedule import own_records
from oodd_eval.results.directory import RECORDS, ResultsDirectory
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record


def gather(header: Header, places: Iterable[Path]) -> list[Record]:
    """Read the records that belong to a reproduction; others are left out.

    Parameters
    ----------
    header
        Which data, setups and seeds belong to it.
    places
        Directories with ``records.jsonl``, or with such directories anywhere below them.

    Raises
    ------
    ResultsError
        When there are no records, one cannot be read, or two directories have the same cell.
    """
    origin: dict[tuple[Setting, str, str, int], Path] = {}
    found = []
    for directory in sorted({d for place in places for d in _directories(place)}):
        records = ResultsDirectory(directory).records()
        for r in own_records(records, header.split_digest, header.tier, setups_of(EXPERIMENTS)):
            cell = row_of(r), r.environment, r.anomaly, r.seed
            first = origin.setdefault(cell, directory)
            if first != directory:
                raise ResultsError(
                    f"{r.cell} is in {str(first)!r} and in {str(directory)!r}: name those that "
                    "belong to the reproduction with --records"
                )
            found.append(r)
    return found


def _directories(place: Path) -> list[Path]:
    if stored_files.find_file(place / RECORDS):
        return [place]
    # Large entries of the leaderboard keep their records packed.
    names = RECORDS, RECORDS + stored_files.GZIP
    below = [file.parent for name in names for file in place.rglob(name)]
    if not below:
        raise ResultsError(f"no results in {str(place)!r}: expected {RECORDS} in it or below it")
    return below
