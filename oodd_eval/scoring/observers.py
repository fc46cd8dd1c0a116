"""Observers of a run: the hooks that plug-ins and the program's own reporters implement.

A plug-in is asked to observe when it has an entry point in the group ``oodd_eval.observers``, or
when it was loaded for its detectors. No observer may change a result: each gets copies.
"""

import copy
import sys
from collections.abc import Iterable
from importlib.metadata import EntryPoint
from typing import Any

import pluggy

from oodd_eval.plugins import hookspec
from oodd_eval.plugins.discovery import Plugins, register
from oodd_eval.results.record import Record
from oodd_eval.scoring.plan import Plan, Unit


@hookspec
def oodd_run_started(plan: Plan) -> None:
    """Observe that a run is about to start. Called once, before any detector is fitted.

    Parameters
    ----------
    plan
        Everything that the run is going to do.
    """


@hookspec
def oodd_unit_started(unit: Unit) -> None:
    """Observe that a unit begins. Called once for every unit, before its cells.

    Parameters
    ----------
    unit
        The detector with its setting, the environment and the anomalies.
    """


@hookspec
def oodd_fit_progressed(unit: Unit, share: float) -> None:
    """Observe how far the fit of a unit is. Called at most twice a second for each unit.

    Detectors whose `fit` has a parameter ``progress`` tell; of others only the end is known. Scores
    of an earlier run have no fit.

    Parameters
    ----------
    unit
        The unit that is being fitted.
    share
        The part of the fit that is done, from 0 to 1; 1 at its end, when scoring begins.
    """


@hookspec
def oodd_cell_finished(record: Record, resumed: bool) -> None:
    """Observe a finished cell. Called in the harness's process, once for every cell.

    Parameters
    ----------
    record
        The result, whatever its status.
    resumed
        Whether the scores are of an earlier run with the same key, so that nothing was fitted.
    """


@hookspec
def oodd_run_finished(plan: Plan, records: list[Record], interrupted: bool) -> None:
    """Observe the end of a run. Called once, after the records are written.

    Parameters
    ----------
    plan
        What the run was going to do.
    records
        Those of all finished cells, in the order of the plan.
    interrupted
        Whether the run was interrupted.
    """


class Observers:
    """All observers of one run.

    A plug-in that cannot be loaded, or that raises, is noted in ``plugins.broken`` and not called
    again: a plug-in that watches may not stop the run. The program's own observers may raise.
    """

    def __init__(self, plugins: Plugins, observers: Iterable[object] = ()) -> None:
        specification = sys.modules[__name__]
        self._plugins = plugins
        self._foreign: list[tuple[EntryPoint, pluggy.HookRelay]] = []
        observing: dict[int, EntryPoint] = {}
        for point in plugins.observing:
            with plugins.blaming(point):
                module = point.load()
                # A module that is in both groups is called once.
                if id(module) not in observing:
                    observing[id(module)] = point
                    self._foreign.append((point, register(module, specification)))
        self._observers = [register(observer, specification) for observer in observers]

    def notify(self, hook: str, **arguments: Any) -> None:
        """Call one hook of every observer."""
        for entry in list(self._foreign):
            point, hooks = entry
            failures = len(self._plugins.broken)
            with self._plugins.blaming(point, f"hook {hook} failed: "):
                call = getattr(hooks, hook)
                if call.get_hookimpls():
                    call(**copy.deepcopy(arguments))
            if len(self._plugins.broken) > failures:
                self._foreign.remove(entry)
        for hooks in self._observers:
            getattr(hooks, hook)(**arguments)
