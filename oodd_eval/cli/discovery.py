"""Plug-ins as the options ``-p`` ask for them, and what to say about broken ones."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from oodd_eval.errors import UsageError
from oodd_eval.plugins.discovery import Plugins, discover


def discovered(options: Sequence[str]) -> Plugins:
    """Discover plug-ins without those that ``-p no:NAME`` names.

    Raises
    ------
    UsageError
        When an option has another form, or names no plug-in.
    """
    for option in options:
        if not option.startswith("no:"):
            raise UsageError(f"-p {option}: expected -p no:NAME, which leaves a plug-in out")
    return discover([option.removeprefix("no:") for option in options])


def report_broken(plugins: Plugins) -> None:
    """Name broken plug-ins, with reasons, on standard error."""
    for broken in plugins.broken:
        print(  # noqa: T201  the program's voice
            f"oodd-eval: plug-in {broken.plugin!r} of {broken.distribution} is broken: "
            f"{broken.reason}",
            file=sys.stderr,
        )
