"""Plug-ins: the hooks that a plug-in implements. All are optional; none may change a result.

A plug-in is an importable module (or object) that an entry point of the group ``oodd_eval`` names
and that marks functions of these names with `hookimpl`. Arguments that a hook does not need may be
left out. Plug-ins may also observe runs: those hooks are in `oodd_eval.scoring.observers`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import pluggy

if TYPE_CHECKING:
    from oodd_eval.data.registry import AnomalySpec, EnvironmentSpec
    from oodd_eval.plugins.contract import DetectorSpec

PROJECT: Final = "oodd_eval"
"""Name of the pluggy project and of the entry-point group."""

OFFER_HOOKS: Final = (
    "oodd_detectors",
    "oodd_environments",
    "oodd_anomalies",
    "oodd_acts",
    "oodd_kinds",
    "oodd_readers",
    "oodd_detector_from_spec",
)
"""Hooks of this module."""

OBSERVER_HOOKS: Final = (
    "oodd_run_started",
    "oodd_unit_started",
    "oodd_fit_progressed",
    "oodd_cell_finished",
    "oodd_run_finished",
)
"""Hooks that `oodd_eval.scoring.observers` specifies and calls."""

hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec
def oodd_detectors() -> list[DetectorSpec] | None:
    """Offer detectors.

    Called once, when the plug-in is loaded: when one of its detectors may have been named, or all
    detectors are listed. It has to be quick: import heavy libraries inside the factories.

    Returns
    -------
    list of DetectorSpec
        None stands for an empty list.
    """


@hookspec
def oodd_environments() -> list[EnvironmentSpec] | None:
    """Offer environments with their policies, which ``oodd-eval data build`` records.

    Called once, when environments or anomalies are listed, or one that the benchmark lacks is
    named. It has to be quick: import simulators inside the functions that specs name.

    Returns
    -------
    list of EnvironmentSpec
        None stands for an empty list.
    """


@hookspec
def oodd_anomalies() -> list[AnomalySpec] | None:
    """Offer kinds of anomalies, for environments of the benchmark or of one's own.

    Called as `oodd_environments` is.

    Returns
    -------
    list of AnomalySpec
        None stands for an empty list.
    """


@hookspec
def oodd_readers() -> list[Any] | None:
    """Offer formats of logs, which recipes name and ``oodd-eval data inspect`` recognises.

    Called once, when logs are inspected or imported. It has to be quick: import the library of a
    format inside the function that opens its files.

    Returns
    -------
    list of oodd_logs.Reader
        None stands for an empty list.
    """


@hookspec
def oodd_acts() -> list[Any] | None:
    """Offer acts, which ``oodd-eval intervene`` lets an alarm bring about.

    Called once, when interventions are studied. It has to be quick, as `oodd_environments` is.

    Returns
    -------
    list of oodd_interventions.ActSpec
        None stands for an empty list.
    """


@hookspec
def oodd_kinds() -> list[Any] | None:
    """Offer kinds of columns of logs: how they are recognised, named in recipes and converted.

    Called as `oodd_readers` is, and has to be as quick.

    Returns
    -------
    list of oodd_logs.Kind
        None stands for an empty list.
    """


@hookspec(firstresult=True)
def oodd_detector_from_spec(spec: str) -> DetectorSpec | None:
    """Make a detector from a name with a colon, such as ``pyod:IForest``.

    Called when a user names such a detector, and again in the worker that runs it, until a plug-in
    answers; those of oodd-eval itself are asked first. The first line of the implementation's
    docstring says which names it knows: ``oodd-eval list detectors`` prints it. Names in results
    are never resolved.

    Parameters
    ----------
    spec
        The name that the user gave.

    Returns
    -------
    DetectorSpec
        Its name has a colon, too, and makes the same detector; it may be a simpler spelling of
        `spec`. None for names that this plug-in does not handle.

    Raises
    ------
    UsageError, UnknownNameError
        When this plug-in handles such names, but can make no detector of this one.
    """
