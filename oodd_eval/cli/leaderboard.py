"""``oodd-eval leaderboard submit`` and ``verify``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Final

from rich.console import Console

from oodd_eval.cli.terminal import make_console
from oodd_eval.errors import UsageError
from oodd_eval.leaderboard import submit as submission
from oodd_eval.leaderboard.entry import ENTRY
from oodd_eval.leaderboard.verify import verify as verification
from oodd_eval.leaderboard.verify.grant import grant
from oodd_eval.results.directory import ResultsDirectory

MOST_SHOWN: Final = 30
"""Problems of an entry that are printed without -v."""


def submit(options: argparse.Namespace) -> int:
    """Carry out ``leaderboard submit``; 1 when what was written did not pass."""
    statement = submission.Statement(
        id=options.id or "",
        title=options.title,
        submitter=options.submitter,
        citation=" ".join(options.citation.split()),
        url=options.url,
        caption=options.caption,
        trust=options.trust,
    )
    made = submission.submit(
        options.directory,
        options.results,
        statement,
        detectors=options.detector,
        cells=options.expression,
        complete=options.complete,
        scores=options.scores,
        curves=options.curves,
        split=options.split,
    )
    console, place = make_console(), made.place
    for line in made.left_out if options.verbosity >= 0 else ():
        console.print(f"left out: {line}")
    report(console, made.verdict, options.verbosity)
    if not made.verdict.ok:
        console.print(f"nothing was written to {place}")
        return 1
    if options.verbosity >= 0:
        if made.size > submission.LARGE:
            console.print(
                "  note: an entry as large as this is a burden to the repository: leave the "
                "scores or some curves out (--curves), or submit fewer rows"
            )
        console.print(
            f"\nwritten to {place}, {made.size / 1e6:.2g} MB; next:\n"
            f"  oodd-eval leaderboard build {place.parent}\n"
            f"  git add {place}\n"
            "look at the tables, commit both, and open a pull request (docs/submitting.md)"
        )
    return 0


def verify(options: argparse.Namespace) -> int:
    """Carry out ``leaderboard verify``; 1 when an entry is refused, 5 when there is none."""
    console = make_console()
    fresh = ResultsDirectory(options.rerun).records() if options.rerun else []
    if options.rerun and not fresh:
        raise UsageError(f"--rerun: {options.rerun!r} has no records")
    if (options.rerun or options.grant) and len(options.paths) > 1:
        raise UsageError("--rerun and --grant are for one entry: name a single PATH")
    verdicts = [
        verdict
        for path in options.paths
        for verdict in verification.verify(
            path,
            split=options.split,
            rerun=fresh,
            progress=lambda verdict: report(console, verdict, options.verbosity),
        )
    ]
    if not verdicts:
        print(f"oodd-eval: no entries in {', '.join(options.paths)}", file=sys.stderr)  # noqa: T201
        return 5
    if options.grant:
        if len(verdicts) > 1:
            raise UsageError("--grant is for one entry: name it, not the directory of entries")
        granted = grant(Path(options.paths[0]), verdicts[0], options.grant)
        console.print(f"{granted.id}: trust {granted.trust} is written to its {ENTRY}")
        return 0
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
        if verdict.rerun is not None or verdict.rescored:
            console.print(f"  trust level established here: {verdict.reached}")
    else:
        console.print(f"{verdict.name}: refused, {findings.count} problems")
    shown = findings.problems if verbosity > 0 else findings.problems[:MOST_SHOWN]
    for problem in shown:
        console.print(f"  {verdict.name}: {problem.text}")
    if findings.count > len(shown):
        console.print(f"  and {findings.count - len(shown)} more")
    for line in verdict.rerun.lines if verdict.rerun is not None else ():
        console.print(f"  re-run: {line}")
    if verbosity >= 0:
        for note in findings.notes:
            console.print(f"  note: {note}")
