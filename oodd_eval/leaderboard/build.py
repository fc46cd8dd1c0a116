"""``oodd-eval leaderboard build``: tables and site from the entries."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from oodd_eval.errors import OutputError
from oodd_eval.leaderboard import site
from oodd_eval.leaderboard.entry import SubmittedEntry, read_entries
from oodd_eval.leaderboard.page import page, table_file
from oodd_eval.leaderboard.sections import sections
from oodd_eval.results.tables import csv_tables

PAGE: Final = "README.md"
TABLES: Final = "tables"
SITE: Final = "site"

_STALE: Final = "no part of the leaderboard any more"


def run(options: argparse.Namespace) -> int:
    """Carry out ``leaderboard build``; 1 when ``--check`` finds a difference, 5 without entries."""
    entries = read_entries(options.results)
    if not entries:
        print(f"oodd-eval: no entries in {options.results}", file=sys.stderr)  # noqa: T201
        return 5
    output = Path(options.output)
    if options.check:
        with tempfile.TemporaryDirectory() as fresh:
            build(entries, Path(fresh))
            return _report(differences(Path(fresh), output), output)
    written = build(entries, output)
    if options.verbosity >= 0:
        print("\n".join(str(output / name) for name in written))  # noqa: T201
    for name in sorted(_tables(output) - set(written)):
        print(  # noqa: T201
            f"oodd-eval: {output / name} is {_STALE}: delete it", file=sys.stderr
        )
    return 0


def build(entries: Sequence[SubmittedEntry], output: Path) -> list[str]:
    """Write page, tables and site: the same bytes for the same entries.

    Returns
    -------
    The page, the tables and the site, relative to `output`.

    Raises
    ------
    OutputError
        When a file cannot be written.
    ResultsError
        When the entries contradict one another.
    """
    found = sections(entries)
    address = _build_site(entries, output)
    files = {PAGE: page(found, site=address)}
    for section in found:
        files[table_file(section, "ranking")] = csv_tables.ranking(section.ranks, section.trust)
        files[table_file(section, "cells")] = csv_tables.cells(section.ranks)
        files[table_file(section, "comparisons")] = csv_tables.comparisons(section.ranks)
    try:
        for name, text in files.items():
            path = output / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8", newline="\n")
    except OSError as error:
        raise OutputError(f"cannot write the leaderboard into {str(output)!r}: {error}") from None
    return [*files, address]


def _build_site(entries: Sequence[SubmittedEntry], output: Path) -> str:
    """Render the site and return the address of its page, relative to `output`."""
    return site.render(entries, output / SITE).relative_to(output).as_posix()


def differences(fresh: Path, existing: Path) -> list[str]:
    """Return a line for every file that a build would change, add or no longer write.

    Parameters
    ----------
    fresh, existing
        Directories of a new build and of what is there.
    """
    new, old = _files(fresh), _files(existing)
    lines = [f"{name}: missing" for name in new - old]
    lines += [f"{name}: {_STALE}" for name in old - new]
    lines += [
        f"{name}: differs"
        for name in new & old
        if (fresh / name).read_bytes() != (existing / name).read_bytes()
    ]
    return sorted(lines)


def _files(output: Path) -> set[str]:
    """Return the names of the files that builds write, and of none beside them."""
    paths = (path for path in (output / SITE).rglob("*") if path.is_file())
    names = {path.relative_to(output).as_posix() for path in paths} | _tables(output)
    return names | ({PAGE} if (output / PAGE).is_file() else set())


def _tables(output: Path) -> set[str]:
    return {f"{TABLES}/{path.name}" for path in (output / TABLES).glob("*.csv")}


def _report(lines: list[str], output: Path) -> int:
    if not lines:
        print(f"{output} is up to date")  # noqa: T201
        return 0
    print("\n".join(lines))  # noqa: T201
    print(  # noqa: T201
        f"oodd-eval: {output} is not what its entries say: run leaderboard build, delete what is "
        "no part of it, and commit",
        file=sys.stderr,
    )
    return 1
