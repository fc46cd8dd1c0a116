"""``oodd-eval leaderboard submit`` and ``verify``."""

from __future__ import annotations

import argparse
import sys
from typing import Final

from rich.console import Console

from oodd_eval.report.terminal import make_console
from oodd_eval.submission import submit as submission
from oodd_eval.submission import verify as verification

MOST_SHOWN: Final = 30
"""Problems of an entry that are printed without -v."""


def submit(options: argparse.Namespace) -> int:
    """Carry out ``leaderboard submit``; 1 when what was written did not pass."""
    rerun = {"by": options.rerun_by, "how": options.rerun_how}
    statement = submission.Statement(
        id=options.id or "",
        title=options.title,
        submitter=options.submitter,
        citation=" ".join(options.citation.split()),
        url=options.url,
        caption=options.caption,
        trust=options.trust,
        rerun=rerun if any(rerun.values()) else None,
    )
    place, verdict = submission.submit(
        options.directory,
        options.results,
        statement,
        detectors=options.detector,
        scores=options.scores,
        split=options.split,
    )
    console = make_console()
    report(console, verdict, options.verbosity)
    if not verdict.ok:
        console.print(f"nothing was written to {place}")
        return 1
    if options.verbosity >= 0:
        console.print(
            f"\nwritten to {place}; next:\n"
            f"  oodd-eval leaderboard build {place.parent}\n"
            f"  git add {place}\n"
            "look at the tables, commit both, and open a pull request (docs/submitting.md)"
        )
    return 0


def verify(options: argparse.Namespace) -> int:
    """Carry out ``leaderboard verify``; 1 when an entry is refused, 5 when there is none."""
    console = make_console()
    verdicts = [
        verdict
        for path in options.paths
        for verdict in verification.verify(
            path,
            split=options.split,
            progress=lambda verdict: report(console, verdict, options.verbosity),
        )
    ]
    if not verdicts:
        print(f"oodd-eval: no entries in {', '.join(options.paths)}", file=sys.stderr)  # noqa: T201
        return 5
    refused = sum(not verdict.ok for verdict in verdicts)
    if len(verdicts) > 1:
        console.print(f"{len(verdicts) - refused} valid, {refused} refused")
    return int(refused > 0)


def report(console: Console, verdict: verification.Verdict, verbosity: int) -> None:
    """Print what was found for one entry, every problem with its entry, place and field."""
    findings, entry = verdict.findings, verdict.entry
    if verdict.ok and entry is not None:
        cells = len(verdict.records or {})
        console.print(
            f"{verdict.name}: valid, {cells} cells of {', '.join(entry.detectors)} on "
            f"{entry.split}, trust {entry.trust}"
        )
    else:
        console.print(f"{verdict.name}: refused, {findings.count} problems")
    shown = findings.problems if verbosity > 0 else findings.problems[:MOST_SHOWN]
    for problem in shown:
        console.print(f"  {verdict.name}: {problem.text}")
    if findings.count > len(shown):
        console.print(f"  and {findings.count - len(shown)} more")
    if verbosity >= 0:
        for note in findings.notes:
            console.print(f"  note: {note}")
