"""Where units are carried out: in workers of this machine, or on an existing Dask cluster."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol
from urllib.parse import urlsplit

from oodd_eval.data.split import Split
from oodd_eval.errors import UsageError
from oodd_eval.plugins.isolation.supervisor import Limits
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.scoring.executors.local import LocalExecutor
from oodd_eval.scoring.unit import Scored, UnitJob

LOCAL: Final = "local"
"""The executor that is meant where none is named."""


class Executor(Protocol):
    """Carries out units; called from several threads at a time."""

    @property
    def jobs(self) -> int:
        """Units at a time."""
        ...

    def __call__(self, job: UnitJob) -> Scored:
        """Carry out a unit, or find its scores in an earlier run's results."""
        ...

    def fit_of(self, job: UnitJob) -> str:
        """Key of the fit that a unit would make, or wait for while another one makes it.

        Empty when it would do neither: the fit is kept, or shared with nobody.
        """
        ...

    def stop(self) -> None:
        """Give up what is under way: calls return soon, or raise, and no process is left."""
        ...

    def close(self) -> None:
        """Let go of whatever is held; no call is under way any more."""
        ...


@dataclass(frozen=True, slots=True)
class Orders:
    """What every unit of a run has in common: data, limits of its worker, where results are."""

    split: Split
    limits: Limits
    results: ResultsDirectory | None
    fresh: bool


def available_cores() -> int:
    """Return the number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def opener(name: str) -> Callable[[Orders, int | None], Executor]:
    """Return what makes an executor by its name: ``local`` or ``dask://HOST:PORT``.

    The maker takes the orders and the number of units at a time, None for as many as there is room
    for.

    Raises
    ------
    UsageError
        For a name that is neither.
    """
    if name == LOCAL:
        return _local
    try:
        place = urlsplit(name)
        whole = place.scheme == "dask" and place.hostname and place.port
    except ValueError:
        whole = False
    if not whole or place.path or place.query or place.fragment:
        raise UsageError(
            f"--executor {name!r}, expected 'local' or 'dask://HOST:PORT', the address of a Dask "
            "scheduler"
        )

    def dask(orders: Orders, jobs: int | None) -> Executor:
        from oodd_eval.scoring.executors.dask import DaskExecutor  # noqa: PLC0415  an extra

        return DaskExecutor(f"tcp://{place.netloc}", orders, jobs)

    return dask


def _local(orders: Orders, jobs: int | None) -> Executor:
    return LocalExecutor(
        jobs or available_cores(), orders.limits, orders.results, threading.Event(),
        fresh=orders.fresh,
    )  # fmt: skip
