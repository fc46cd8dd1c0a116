"""The hooks a plug-in may implement. All are optional; none may change a result.

A plug-in is an importable module (or object) registered under the entry-point group ``oodd_eval``
that marks functions of these names with `hookimpl`. Arguments a hook does not need may be left out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import pluggy

if TYPE_CHECKING:
    from oodd_eval.plugins.contract import DetectorSpec
    from oodd_eval.results.record import Record
    from oodd_eval.scoring.plan import Plan

PROJECT: Final = "oodd_eval"
"""Name of the pluggy project and of the entry-point group."""

hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec
def oodd_detectors() -> list[DetectorSpec] | None:
    """Offer detectors.

    Called once per plug-in at discovery, for every command that names detectors, so it has to be
    quick: import heavy libraries inside the factories. Return the specs; None means none.
    """


@hookspec(firstresult=True)
def oodd_detector_from_spec(spec: str) -> DetectorSpec | None:
    """Make a detector from a name with a colon, such as ``pyod:IForest``.

    Called when a user names such a detector, and again in the worker that runs it, until a plug-in
    answers; those of oodd-eval itself are asked first. Return None for a name of another's making.
    For a name of your own that leads nowhere, raise `oodd_eval.errors.UsageError` or
    `UnknownNameError`. The name of the spec has a colon too, may be tidier than `spec`, and makes
    the same detector. The first line of the implementation's docstring says which names it knows:
    ``oodd-eval list detectors`` prints it. Names in results are never resolved.
    """


@hookspec
def oodd_run_started(plan: Plan) -> None:
    """Observe that a run is about to start.

    Called once, before any detector is fitted, with everything the run is going to do.
    """


@hookspec
def oodd_cell_finished(record: Record, resumed: bool) -> None:
    """Observe a finished cell, whatever its status.

    Called in the harness's process, in the order in which cells finish. `resumed` tells that the
    scores are of an earlier run with the same key; nothing was fitted.
    """


@hookspec
def oodd_run_finished(plan: Plan, records: list[Record], interrupted: bool) -> None:
    """Observe the end of a run.

    Called once, after the records are written, with the records in the order of the plan; when the
    run was interrupted, with those that were finished.
    """
