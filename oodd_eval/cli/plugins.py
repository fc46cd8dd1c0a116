"""Plug-ins as commands find them: broken ones are reported on standard error."""

from __future__ import annotations

from typing import TYPE_CHECKING

from oodd_eval.cli import Options, say, say_notes
from oodd_eval.data.registry import Spec, register
from oodd_eval.plugins.discovery import Plugins, discover

if TYPE_CHECKING:
    from oodd_eval.plugins.isolation.child import Limits


def discovered(options: Options, limits: Limits | None = None) -> Plugins:
    """Discover plug-ins without those of ``-p``; broken ones are reported on standard error.

    With limits that hide paths, only sandboxes load plug-ins: this process imports none.
    """
    if limits is None or limits.hidden is None:
        plugins = discover(options.disabled)
    else:
        from oodd_eval.plugins.isolation.describe import discover_in_sandbox

        plugins = discover_in_sandbox(options.disabled, limits)
        if watching := ", ".join(point.name for point in plugins.observer_points):
            say(f"plug-ins that observe runs are left out of a sandboxed one: {watching}")
    say_notes(plugins.notes)
    plugins.report_broken_to(
        lambda b: say(f"plug-in {b.plugin!r} of {b.distribution} is broken: {b.reason}")
    )
    return plugins


def register_custom(options: Options) -> list[Spec]:
    """Make environments and anomalies of plug-ins known in this process; return them."""
    specs = [spec for spec, _ in discovered(options).custom_specs.values()]
    register(specs)
    return specs
