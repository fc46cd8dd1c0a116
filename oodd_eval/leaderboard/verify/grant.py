"""Write the level of trust that was established into an entry."""

from __future__ import annotations

import os
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from oodd_eval.errors import OutputError, UsageError
from oodd_eval.leaderboard.entry import ENTRY, TRUST, Entry
from oodd_eval.leaderboard.verify import rules
from oodd_eval.leaderboard.verify.verify import Verdict


def grant(directory: Path, verdict: Verdict, by: str) -> Entry:
    """Raise an entry's level of trust to the one that its verification established.

    Parameters
    ----------
    directory
        Of the entry.
    verdict
        Of its verification.
    by
        Who verified it, as one line.

    Returns
    -------
    The entry as it is now, in ``entry.json`` too.

    Raises
    ------
    UsageError
        When `by` is no name, or no higher level than the entry's own was established.
    OutputError
        When ``entry.json`` cannot be written.
    """
    if complaint := rules.text(200, least=1)(by):
        raise UsageError(f"--grant {complaint}")
    entry = verdict.entry
    if entry is None or not verdict.ok:
        raise UsageError(f"--grant: {verdict.name} is refused, so nothing is granted")
    if TRUST.index(verdict.reached) <= TRUST.index(entry.trust):
        raise UsageError(
            f"--grant: {verdict.name} has trust {entry.trust!r}, and what was established here is "
            f"{verdict.reached!r}: a higher level needs its scores (re-scored) or a run of yours, "
            "named with --rerun (re-run)"
        )
    rerun = None
    if verdict.reached == "re-run" and verdict.rerun is not None:
        today = datetime.now(UTC).date().isoformat()
        rerun = {"by": by, "how": f"{verdict.rerun.how}, {today}"}
    granted = replace(entry, trust=verdict.reached, rerun=rerun)
    path = directory / ENTRY
    temporary = path.with_name(f".{ENTRY}.{os.getpid()}")
    try:
        temporary.write_text(granted.to_json(), encoding="utf-8")
        temporary.replace(path)
    except OSError as error:
        raise OutputError(f"{str(path)!r} cannot be written: {error}") from error
    finally:
        temporary.unlink(missing_ok=True)
    return granted
