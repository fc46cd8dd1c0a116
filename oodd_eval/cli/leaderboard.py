"""``oodd-eval leaderboard``: the published board, and its making from entries that are verified."""

import argparse
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from rich.console import Console

from oodd_eval.cli import EXPRESSION, NAMES, Parser, board, rerun, say
from oodd_eval.cli.terminal import make_console
from oodd_eval.errors import UsageError
from oodd_eval.leaderboard import submit as submission
from oodd_eval.leaderboard.build import STALE, differences, stale, suite_parts
from oodd_eval.leaderboard.build import build as build_board
from oodd_eval.leaderboard.entry import GRANTS, read_entries
from oodd_eval.leaderboard.verify import EntryVerdict, changes_against, grant
from oodd_eval.leaderboard.verify import verify as check
from oodd_eval.leaderboard.verify import verify_changed as check_changed
from oodd_eval.leaderboard.verify.rerun import read_order
from oodd_eval.results.directory import ResultsDirectory

RESULTS: Final = "leaderboard/results"  # directory of the entries, from the root of a checkout

SPLIT: Final = "where the split is, if not at its usual place"

MOST_SHOWN: Final = 30  # problems of an entry that are printed without -v


def define(parser: Parser) -> None:
    """Add the command, its actions and their options."""
    # fmt: off
    action = parser.nested("action")
    add = action("build", "render tables and site from the entries").options(
        build, "leaderboard build --check"
    )
    add("results", nargs="?", default=RESULTS, metavar="RESULTS_DIR",
        help=f"directory of the entries (default: {RESULTS})")
    add("--output", default="leaderboard", metavar="DIR",
        help="where to write (default: leaderboard)")
    add("--check", action="store_true",
        help="write nothing, exit 1 where a file beside the site would change")
    add = action("verify", "check entries as data, running none of their code").options(
        verify, "leaderboard verify leaderboard/results/paper-mini"
    )
    add("paths", nargs="*", metavar="PATH",
        help=f"an entry, or a directory of entries (default: {RESULTS})")
    add("--changed-against", default="", metavar="BRANCH",
        help="check a pull request: the entries that were changed since the branch was left, that "
             "nothing else was changed with them, and that the board builds")
    add("--split", metavar="PATH", help=SPLIT)
    add("--rerun", metavar="DIR",
        help="results of leaderboard rerun, or of a run of your own, to compare one entry with")
    add("--grant", default="", metavar="NAME",
        help=f"write the trust level that was reached into {GRANTS}, in this name")
    rerun.define(action("rerun", "run an entry's detectors again on seeds drawn now"))
    board.define(action)
    add = action("submit", "write an entry from a results directory").options(
        submit, "leaderboard submit oodd-results --id mine --title 'My detector'"
    )
    add("directory", metavar="DIR", help="results directory, written by oodd-eval run or reproduce")
    add("--results", default=RESULTS, metavar="RESULTS_DIR",
        help=f"directory of the entries (default: {RESULTS})")
    add("--detector", dest="detectors", default="all", metavar="NAMES",
        help=f"{NAMES} (default: all)")
    add("-k", dest="cells", default="", metavar="EXPR", help=EXPRESSION)
    add("--complete", action="store_true",
        help="leave out those seeds of a row that lack cells which others have")
    add("--id", default="", metavar="ID",
        help="name of the entry's directory (default: detectors and split)")
    add("--title", default="", metavar="TEXT", help="one line, shown on the board")
    add("--submitter", default="", metavar="TEXT", help="who stands behind the results")
    add("--citation", default="", metavar="TEXT", help="how to cite the method")
    add("--url", default="", metavar="URL", help="page of the method or its code")
    add("--primary", nargs="+", default=(), metavar="ROW",
        help="rows that are ranked for their detectors, such as 'riqn[updates=9000]' (default: of "
             "each detector the one with default parameters and the shortest horizon)")
    add("--caption", default="", metavar="TEXT",
        help="a note above the tables, such as a reduced setting")
    add("--scores", action="store_true",
        help="include every score, so that others can recompute the metrics")
    add("--split", metavar="PATH", help=SPLIT)
    add("--curves", default="rows", choices=("rows", "detectors", "none"),
        help="curves for the site: of every row, of each detector's plainest row, or none "
             "(default: rows)")
    # fmt: on


def build(options: argparse.Namespace) -> int:
    """Carry out ``leaderboard build``; 1 when ``--check`` finds a difference, 5 without entries."""
    output = Path(options.output)
    with part_shown(quiet=options.verbosity < 0) as show, tempfile.TemporaryDirectory() as fresh:
        show("entries")
        entries = read_entries(options.results)
        if not entries:
            return say(f"no entries in {options.results}", 5)
        target = Path(fresh) if options.check else output
        written = build_board(entries, target, lambda: suite_parts(output), on_part=show)
        lines = differences(target, output) if options.check else []
    if not options.check:
        if options.verbosity >= 0:
            print("\n".join(str(output / name) for name in written))
        for name in stale(output, written):
            say(f"{output / name} is {STALE}: delete it", 0)
        return 0
    print("\n".join(lines) if lines else f"{output} is up to date")
    if not lines:
        return 0
    advice = "run leaderboard build, delete what is no part of it, and commit"
    return say(f"{output} is not what its entries say: {advice}", 1)


@contextmanager
def part_shown(*, quiet: bool) -> Iterator[Callable[[str], object]]:
    """Show the part of a build that is being made; nothing where standard error is no terminal."""
    console = Console(stderr=True, quiet=quiet)
    if quiet or not console.is_terminal:
        yield str
        return
    with console.status("leaderboard") as status:
        yield lambda part: status.update(f"leaderboard: {part}")


def submit(options: argparse.Namespace) -> int:
    """Carry out ``leaderboard submit``; 1 when what was written did not pass."""
    options.citation = " ".join(options.citation.split())
    texts = ("id", "title", "submitter", "citation", "url", "caption", "primary")
    statement = submission.Statement(**{name: getattr(options, name) for name in texts})
    chosen = ("detectors", "cells", "complete", "scores", "curves", "split")
    how = {name: getattr(options, name) for name in chosen}
    made = submission.submit(options.directory, options.results, statement, **how)
    console, place = make_console(), made.path
    for line in made.left_out if options.verbosity >= 0 else ():
        console.print(f"left out: {line}")
    report(console, made.verdict, options.verbosity)
    if not made.verdict.ok:
        console.print(f"nothing was written to {place}")
        return 1
    if options.verbosity >= 0:
        size = sum(p.stat().st_size for p in place.rglob("*") if p.is_file())
        if size > submission.LARGE:
            advice = "leave the scores or some curves out (--curves), or submit fewer rows"
            console.print(f"  note: so large an entry is a burden to the repository: {advice}")
        console.print(
            f"\nwritten to {place}, {size / 1e6:.2g} MB; next:\n"
            f"  oodd-eval leaderboard place {place}\n"
            f"  git add {place}\n"
            "commit it alone, and open a pull request (docs/submitting.md)"
        )
    return 0


def verify(options: argparse.Namespace) -> int:
    """Carry out ``leaderboard verify``; 1 when an entry is refused, 5 when there is none."""
    console = make_console()
    options.paths = options.paths or [RESULTS]
    if options.changed_against:
        if options.rerun or options.grant or options.split or len(options.paths) > 1:
            options_named = "--split, --rerun or --grant"
            raise UsageError(
                f"--changed-against is for one directory of entries, without {options_named}"
            )
        return verify_pull_request(console, Path(options.paths[0]), options)
    fresh = ResultsDirectory(options.rerun).records() if options.rerun else []
    if options.rerun and not fresh:
        raise UsageError(f"--rerun: {options.rerun!r} has no records")
    if (options.rerun or options.grant) and len(options.paths) > 1:
        raise UsageError("--rerun and --grant are for one entry: name a single PATH")
    drawn = read_order(Path(options.rerun)) if options.rerun else None
    verdicts = []
    for path in options.paths:
        for verdict in check(path, split=options.split, rerun=fresh, order=drawn):
            verdicts.append(verdict)
            report(console, verdict, options.verbosity)
    if not verdicts:
        return say(f"no entries in {', '.join(options.paths)}", 5)
    if options.grant:
        if len(verdicts) > 1:
            raise UsageError("--grant is for one entry: name it, not the directory of entries")
        granted = grant(Path(options.paths[0]), verdicts[0], options.grant)
        place = Path(options.paths[0]).absolute().parents[1] / GRANTS
        console.print(f"{verdicts[0].name}: trust {granted.trust} is written to {place}")
        return 0
    refused = sum(not verdict.ok for verdict in verdicts)
    if len(verdicts) > 1:
        console.print(f"{len(verdicts) - refused} valid, {refused} refused")
    return int(refused > 0)


def verify_pull_request(console: Console, results: Path, options: argparse.Namespace) -> int:
    """Check what a branch changes; 1 when it may not be merged as the pull request of an entry."""
    entries, others = changes_against(options.changed_against, results)
    if not entries:
        console.print(f"no entry differs from {options.changed_against}: nothing to verify")
        return 0
    refused = 0
    for verdict in check_changed(results, entries):
        report(console, verdict, options.verbosity)
        refused += not verdict.ok
    for path in others[:MOST_SHOWN]:
        console.print(f"{path}: is changed together with an entry")
    if others:
        if len(others) > MOST_SHOWN:
            console.print(f"and {len(others) - MOST_SHOWN} more files")
        return say(
            f"a pull request of an entry changes {results}/NAME/ and nothing else: take the files "
            "above out of it",
            1,
        )
    if refused:
        return say(f"{refused} of {len(entries)} entries are refused", 1)
    with tempfile.TemporaryDirectory() as fresh:
        build_board(read_entries(results), Path(fresh), lambda: suite_parts(results.parent))
    console.print(f"{', '.join(entries)}: may be merged, the board builds with it")
    return 0


def report(console: Console, verdict: EntryVerdict, verbosity: int) -> None:
    """Print what was found for one entry, every problem with its entry, place and field."""
    findings, entry = verdict.findings, verdict.entry
    if verdict.ok and entry is not None:
        cells = f"{len(verdict.records)} cells of {', '.join(entry.detectors)}"
        console.print(f"{verdict.name}: valid, {cells} on {entry.split}, trust {verdict.trust}")
        if verdict.rerun is not None or verdict.rescored:
            console.print(f"  trust level established here: {verdict.reached}")
    else:
        console.print(f"{verdict.name}: refused, {findings.count} problems")
    shown = findings.problems if verbosity > 0 else findings.problems[:MOST_SHOWN]
    lines = [f"{verdict.name}: {problem.text}" for problem in shown]
    if findings.count > len(shown):
        lines.append(f"and {findings.count - len(shown)} more")
    lines += [f"re-run: {line}" for line in (verdict.rerun.lines if verdict.rerun else ())]
    lines += [f"note: {note}" for note in (findings.notes if verbosity >= 0 else ())]
    for line in lines:
        console.print(f"  {line}")
