"""Ask git what a pull request changes: which entries, and which other files."""

import os
import subprocess
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from oodd_eval.errors import UsageError


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
    place = results if results.is_dir() else Path()
    top = Path(_git(place, "rev-parse", "--show-toplevel").rstrip("\n"))
    commit = _git(top, "rev-parse", "--verify", "--end-of-options", f"{base}^{{commit}}").strip()
    fork = _git(top, "merge-base", commit, "HEAD").strip()
    changed = _git(top, "diff", "--name-only", "--no-renames", "--no-ext-diff", "-z", fork)
    root = PurePosixPath(Path(os.path.relpath(results.resolve(), top.resolve())).as_posix())
    added = _git(top, "ls-files", "--others", "--exclude-standard", "-z", "--", str(root))
    entries, others = set[str](), set[str]()
    for text in filter(None, f"{changed}{added}".split("\0")):
        path = PurePosixPath(text)
        below = path.relative_to(root).parts if path.is_relative_to(root) else ()
        if len(below) > 1:
            entries.add(below[0])
        else:
            others.add(text)  # a file beside the entries is none of them
    return Changes(sorted(entries), sorted(others))


def _git(directory: Path, *arguments: str) -> str:
    """Return what git prints; its message is the error's."""
    try:
        done = subprocess.run(  # noqa: S603
            ["git", "-C", str(directory), *arguments],  # noqa: S607
            capture_output=True,
            check=False,
            text=True,
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
