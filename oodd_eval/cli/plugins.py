"""Plug-ins as commands find them: broken ones are reported on standard error."""

from collections.abc import Callable, Collection

from oodd_eval.cli import Options, say, say_notes
from oodd_eval.plugins.discovery import Plugins, discover


def discovered(options: Options, find: Callable[[Collection[str]], Plugins] = discover) -> Plugins:
    """Find plug-ins without those of ``-p``; broken ones are reported on standard error."""
    plugins = find(options.disabled)
    say_notes(plugins.notes)
    plugins.report_broken_to(
        lambda b: say(f"plug-in {b.plugin!r} of {b.distribution} is broken: {b.reason}")
    )
    return plugins
