"""``oodd-eval leaderboard``: the published board, and its making from entries that are verified."""

import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Final, NamedTuple

import click
from rich.console import Console

from oodd_eval.cli import (
    DIRECTORY,
    NAMES,
    OUTPUT_DIRECTORY,
    Name,
    Names,
    Options,
    command,
    expression_option,
    say,
)
from oodd_eval.cli.console import make_console
from oodd_eval.data.files import only_writer, temporary_directory
from oodd_eval.errors import UsageError
from oodd_eval.names import counted
from oodd_leaderboard import hub
from oodd_leaderboard import submit as submission
from oodd_leaderboard.pages import STALE, differences, stale
from oodd_leaderboard.pages import build as build_board
from oodd_leaderboard.reported import read_entries, read_entry, suite_sections
from oodd_leaderboard.verify import EntryVerdict
from oodd_leaderboard.verify import verify as check
from oodd_leaderboard.verify import verify_changed as check_changed

RESULTS: Final = "leaderboard/results"  # directory of the entries, from the root of a checkout

MOST_SHOWN: Final = 30  # problems of an entry that are printed without -v


_split_option: Final = click.option(
    "--split", type=Name("splits"), help="where the split is, if not at its usual place"
)


@command("leaderboard build --check")
@click.argument("results", default=RESULTS, type=DIRECTORY, help="directory of the entries")
@click.option("--output", default="leaderboard", type=OUTPUT_DIRECTORY, help="where to write")
@click.option(
    "--check", is_flag=True, help="write nothing, exit 1 where a file beside the site would change"
)
def build(options: Options) -> int:
    """Render tables and site from the entries.

    The exit code is 1 when --check finds a difference, and 5 when there are no entries.
    """
    output = options.output
    with part_shown(quiet=options.verbosity < 0) as show, temporary_directory() as fresh:
        show("entries")
        entries = read_entries(options.results)
        if not entries:
            return say(f"no entries in {options.results}", 5)
        target = fresh if options.check else output
        with only_writer(target):
            written = build_board(entries, target, suite_sections(output), on_part=show)
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
    console = make_console(quiet=quiet, stderr=True)
    if quiet or not console.is_terminal:
        yield str
        return
    with console.status("leaderboard") as status:
        yield lambda part: status.update(f"leaderboard: {part}")


@command("leaderboard submit oodd-results --id mine --title 'My detector'", repeated=["--primary"])
@click.argument("directory", type=DIRECTORY, help="results of oodd-eval run or reproduce")
@click.option("--results", default=RESULTS, type=OUTPUT_DIRECTORY, help="directory of the entries")
@click.option("--detector", "detectors", default="all", type=Names("detectors"), help=NAMES)
@expression_option
@click.option("--complete", is_flag=True, help="leave out seeds of a row that lack cells")
@click.option("--id", help="name of the entry's directory (default: detectors and split)")
@click.option("--title", help="one line, shown on the board")
@click.option("--submitter", help="who stands behind the results")
@click.option("--citation", help="how to cite the method")
@click.option("--url", help="page of the method or its code")
@click.option(
    "--primary",
    multiple=True,
    metavar="ROW...",
    help="ranked rows, such as 'riqn[updates=9000]' (default: default parameters, least horizon)",
)
@click.option("--caption", help="a note above the tables, such as a reduced setting")
@_split_option
@click.option(
    "--curves",
    default="rows",
    type=click.Choice(["rows", "detectors", "none"]),
    help="curves of every row, of each detector's plainest row, or none",
)
@click.option(
    "--hub",
    metavar="OWNER/NAME",
    help="also write results for a hub of models, on which the split has this id, into ./hub-ID",
)
def submit(options: Options) -> int:
    """Write an entry from a results directory.

    Nothing is written, and the exit code is 1, when the entry would not be valid.
    """
    dataset = hub.check_dataset(options.hub) if options.hub else ""
    names = ("id", "title", "submitter", "citation", "url", "caption")
    texts = {name: getattr(options, name) or "" for name in names}
    texts["citation"] = " ".join(texts["citation"].split())
    statement = submission.Statement(**texts, primary=options.primary)
    option_names = ("detectors", "complete", "curves", "split")
    how = {name: getattr(options, name) for name in option_names} | {"cells": options.expression}
    submitted = submission.submit(options.directory, options.results, statement, **how)
    console, path = make_console(), submitted.path
    for line in submitted.left_out if options.verbosity >= 0 else ():
        console.print(f"left out: {line}")
    report(console, submitted.verdict, options.verbosity)
    if not submitted.verdict.ok:
        console.print(f"nothing was written to {path}")
        return 1
    if options.verbosity >= 0:
        size = sum(p.stat().st_size for p in path.rglob("*") if p.is_file())
        if size > submission.LARGE:
            advice = "leave some curves out (--curves), or submit fewer rows"
            console.print(f"  note: so large an entry is a burden to the repository: {advice}")
        console.print(
            f"\nwritten to {path}, {size / 1e6:.2g} MB; next:\n"
            f"  oodd-eval leaderboard place {path}\n"
            f"  git add {path}\n"
            "commit it alone, and open a pull request (docs/submitting.md)"
        )
    if dataset:
        files = hub.write(read_entry(path), Path(f"hub-{path.name}"), dataset)
        listed = "\n".join(f"  {file}" for file in files) or "  none: each row lacks cells"
        console.print(f"for the repository of each detector on the hub:\n{listed}")
    return 0


@command("leaderboard verify leaderboard/results/paper-mini")
@click.argument(
    "paths", nargs=-1, type=DIRECTORY, help=f"entries, or directories of them (default: {RESULTS})"
)
@click.option(
    "--changed-against",
    metavar="BRANCH",
    help="check a pull request: entries changed since the branch, nothing else, and the board",
)
@_split_option
def verify(options: Options) -> int:
    """Check entries as data, running none of their code.

    The exit code is 1 when an entry is refused, and 5 when there is none.
    """
    console = make_console()
    paths = options.paths or (Path(RESULTS),)
    if options.changed_against:
        if options.split or len(paths) > 1:
            raise UsageError("--changed-against is for one directory of entries, without --split")
        return verify_pull_request(console, paths[0], options)
    verdicts = []
    for path in paths:
        for verdict in check(path, split=options.split):
            verdicts.append(verdict)
            report(console, verdict, options.verbosity)
    if not verdicts:
        return say(f"no entries in {', '.join(map(str, paths))}", 5)
    refused = sum(not verdict.ok for verdict in verdicts)
    if len(verdicts) > 1:
        console.print(f"{len(verdicts) - refused} valid, {refused} refused")
    return int(refused > 0)


def verify_pull_request(console: Console, results: Path, options: Options) -> int:
    """Check what a branch changes; 1 when it may not be merged as the pull request of an entry."""
    entries, other_files = changes_against(options.changed_against, results)
    if not entries:
        console.print(f"no entry differs from {options.changed_against}: nothing to verify")
        return 0
    refused = 0
    for verdict in check_changed(results, entries):
        report(console, verdict, options.verbosity)
        refused += not verdict.ok
    for path in other_files[:MOST_SHOWN]:
        console.print(f"{path}: is changed together with an entry")
    if other_files:
        if len(other_files) > MOST_SHOWN:
            console.print(f"and {len(other_files) - MOST_SHOWN} more files")
        return say(
            f"a pull request of an entry changes {results}/NAME/ and nothing else: take the files "
            "above out of it",
            1,
        )
    if refused:
        return say(f"refused: {refused} of {counted(len(entries), 'entr(y/ies)')}", 1)
    with temporary_directory() as fresh:
        build_board(read_entries(results), fresh, suite_sections(results.parent))
    console.print(f"{', '.join(entries)}: may be merged, the board builds with it")
    return 0


def report(console: Console, verdict: EntryVerdict, verbosity: int) -> None:
    """Print what was found for one entry, every problem with its entry, position and field."""
    findings, entry = verdict.findings, verdict.entry
    if verdict.ok and entry is not None:
        cells = f"{counted(len(verdict.records), 'cell(s)')} of {', '.join(entry.detectors)}"
        console.print(f"{verdict.name}: valid, {cells} on {entry.split}")
    else:
        console.print(f"{verdict.name}: refused, {counted(findings.count, 'problem(s)')}")
    alike: dict[object, list[str]] = {}  # one line of those that many records have
    for i, problem in enumerate(findings.problems):
        key = i if verbosity > 0 else (problem.field, problem.message)
        alike.setdefault(key, []).append(problem.text)
    groups = list(alike.values()) if verbosity > 0 else list(alike.values())[:MOST_SHOWN]
    lines = [
        f"{verdict.name}: {text}" + (f" (and {len(more)} more like this)" if more else "")
        for text, *more in groups
    ]
    if (left := findings.count - sum(map(len, groups))) > 0:
        lines.append(f"and {left} more")
    lines += [f"note: {note}" for note in (findings.notes if verbosity >= 0 else ())]
    for line in lines:
        console.print(f"  {line}")


class Changes(NamedTuple):
    """Names of the entries that were added, changed or removed, and the paths of other files."""

    entries: list[str]
    others: list[str]


def changes_against(base: str, results: Path) -> Changes:
    """Return what differs from the commit where the current branch left a base, by name.

    The base is a branch, tag or commit. `results` is the directory of the entries, in a checkout,
    where files that git does not know yet count, too. `UsageError`: this is no checkout, or `base`
    is no commit of it that the branch comes from.
    """
    inside = results if results.is_dir() else Path()
    top = Path(_git(inside, "rev-parse", "--show-toplevel").rstrip("\n"))
    commit = _git(top, "rev-parse", "--verify", "--end-of-options", f"{base}^{{commit}}").strip()
    fork = _git(top, "merge-base", commit, "HEAD").strip()
    changed = _git(top, "diff", "--name-only", "--no-renames", "--no-ext-diff", "-z", fork)
    root = PurePosixPath(Path(os.path.relpath(results.resolve(), top.resolve())).as_posix())
    added = _git(top, "ls-files", "--others", "--exclude-standard", "-z", "--", str(root))
    entries, other_files = set[str](), set[str]()
    for text in filter(None, f"{changed}{added}".split("\0")):
        path = PurePosixPath(text)
        below = path.relative_to(root).parts if path.is_relative_to(root) else ()
        if len(below) > 1:
            entries.add(below[0])
        else:
            other_files.add(text)  # a file beside the entries is none of them
    return Changes(sorted(entries), sorted(other_files))


def _git(directory: Path, *arguments: str) -> str:
    """Return what git prints; its message is the error's."""
    try:
        done = subprocess.run(  # noqa: S603
            ["git", "-C", str(directory), *arguments],  # noqa: S607
            capture_output=True,
            check=False,
            encoding="utf-8",
            errors="surrogateescape",
        )
    except OSError as error:
        raise UsageError(f"--changed-against needs git: {error.strerror}") from None
    if done.returncode:
        said = " ".join(done.stderr.split()) or f"exit code {done.returncode}"
        raise UsageError(
            f"--changed-against: git {arguments[0]} says {said!r}; expected a checkout and a "
            "commit that it has (in CI, fetch the whole history)"
        )
    return done.stdout
