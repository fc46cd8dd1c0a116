"""Units on an existing Dask cluster.

The cluster's workers need this package, the same plug-ins and a copy of the split; detectors run
there in processes of their own with the same limits as here. Scores come back over the network and
are kept on this side, so that resuming works as ever. When a worker is lost, Dask gives its units
to another one.
"""

from __future__ import annotations

import contextlib
import threading
import warnings
from dataclasses import dataclass
from typing import Any, Final

from oodd_eval.errors import ExecutorError, MissingExtraError
from oodd_eval.scoring.executors import Orders
from oodd_eval.scoring.executors.remote import Message, carry_out, order_of, scored_of
from oodd_eval.scoring.unit import Scored, UnitJob

try:
    import distributed
    from distributed.scheduler import KilledWorker
except ImportError as error:
    raise MissingExtraError(
        f"--executor dask://... needs Dask ({error}): install it with pip install 'oodd-eval[dask]'"
    ) from error

CONNECT_SECONDS: Final = 10.0


class DaskExecutor:
    """Sends units to the workers of a cluster.

    Parameters
    ----------
    address
        Of the scheduler, such as ``"tcp://10.0.0.1:8786"``.
    orders
        What all units have in common.
    jobs
        Units at a time; None means one per thread of the workers.

    Raises
    ------
    ExecutorError
        When nobody answers at the address, or the cluster has no workers.
    """

    def __init__(self, address: str, orders: Orders, jobs: int | None) -> None:
        self._address, self._orders = address, orders
        self._stopping = threading.Event()
        self._running: set[Any] = set()
        try:
            # Differing versions of Dask are the cluster's affair; ours are compared unit by unit.
            with warnings.catch_warnings(action="ignore"):
                client: Any = distributed.Client  # without types
                self._client = client(address, timeout=CONNECT_SECONDS)
        except (OSError, ValueError) as error:
            raise ExecutorError(
                f"no Dask scheduler answers at {address} ({error}): start one with `dask "
                "scheduler`, or correct the address in --executor"
            ) from error
        self.jobs = jobs or sum(self._client.nthreads().values())
        if not self.jobs:
            self._client.close()
            raise ExecutorError(
                f"the Dask scheduler at {address} has no workers: start some with `dask worker "
                f"{address}`"
            )

    def __call__(self, job: UnitJob) -> Scored:
        """Carry out a unit on the cluster.

        Raises
        ------
        ExecutorError
            When the worker lacks something, or the cluster is gone.
        """
        orders = self._orders
        if not orders.fresh and (kept := job.stored(orders.results)):
            return kept
        future: Any = None
        try:
            order = order_of(job, orders.split, orders.limits)
            future = self._client.submit(on_worker, order, pure=False)
            self._running.add(future)
            if self._stopping.is_set():
                future.cancel()
            outcome = future.result()
        except KilledWorker as error:
            return Scored("error", f"the cluster lost every worker that carried it out: {error}")
        except Exception as error:
            if self._stopping.is_set():
                return Scored("error", "interrupted")
            raise ExecutorError(
                f"{job.unit.label} on {job.unit.environment} could not be carried out on the "
                f"cluster at {self._address} ({type(error).__name__}: {error}); its workers need "
                "oodd-eval and the same plug-ins as this side"
            ) from error
        finally:
            self._running.discard(future)
        try:
            return scored_of(outcome)
        except ExecutorError as error:
            raise ExecutorError(f"Dask worker {outcome['worker']}: {error}") from None

    def fit_of(self, job: UnitJob) -> str:  # noqa: ARG002  as every executor's
        """Nothing: workers keep no fits, so that no unit waits for another's."""
        return ""

    def stop(self) -> None:
        """Tell the workers that nobody waits any more."""
        self._stopping.set()
        for future in list(self._running):
            with contextlib.suppress(Exception):
                future.cancel()

    def close(self) -> None:
        """Leave the cluster as it is."""
        self._client.close()


def on_worker(order: Message) -> Message:
    """Carry out an order inside a Dask worker; the outcome tells which."""
    worker = distributed.get_worker()
    outcome = carry_out(order, _Forgotten(worker, worker.get_current_task()))
    return {**outcome, "worker": worker.address}


@dataclass(frozen=True, slots=True)
class _Forgotten:
    """Set when the scheduler has withdrawn a task: its client cancelled it, or is no more."""

    worker: Any
    key: Any

    def is_set(self) -> bool:
        """Whether nobody waits for the task's result."""
        task = self.worker.state.tasks.get(self.key)
        return task is None or task.state == "cancelled"
