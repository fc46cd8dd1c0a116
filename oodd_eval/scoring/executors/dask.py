"""Units on an existing Dask cluster.

The cluster's workers need this package, the same plug-ins and a copy of the split; detectors run
there in processes of their own with the same limits as here. Scores come back over the network and
are kept on this side, so that resuming works as ever. When a worker is lost, Dask gives its units
to another one.

Orders and outcomes are plain dictionaries, so that a worker with another version of this package
can still say so. Everything that must be the same on both sides (plug-in, its code, the data) is
named in the order by digest and compared before any work.
"""

import contextlib
import json
import threading
import warnings
from dataclasses import asdict
from functools import lru_cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any, Final
from uuid import uuid4

from pydantic import TypeAdapter

from oodd_eval._version import __version__
from oodd_eval.data.parts import EnvironmentData
from oodd_eval.data.split import Split, load_split
from oodd_eval.errors import (
    ExecutorError,
    MissingExtraError,
    OoddError,
    PluginError,
    SplitError,
    UsageError,
)
from oodd_eval.plugins.contract import Progress, ignore_progress
from oodd_eval.plugins.discovery import Plugins, offer_of
from oodd_eval.plugins.isolation.child import Launcher, Limits, Stop
from oodd_eval.results.directory import ResultsDirectory, ScoreFile
from oodd_eval.scoring.executors import Executor, RunSettings
from oodd_eval.scoring.plan import Plan, Unit, source_digest
from oodd_eval.scoring.unit import Scored, UnitJob

try:
    import distributed
    from distributed.scheduler import KilledWorker
except ImportError as error:
    raise MissingExtraError(
        f"--executor dask://... needs Dask ({error}): install it with pip install 'oodd-eval[dask]'"
    ) from error

CONNECT_SECONDS: Final = 10.0
WORKERLESS_SECONDS: Final = 60.0  # for which units wait while there is no worker
# What comes back of a unit's score file.
_FILE: Final = ("parts", "cost", "explained", "voices", "namings")

Message = dict[str, Any]


class DaskExecutor(Executor):
    """Sends units to the workers of a cluster."""

    def __init__(
        self, address: str, settings: RunSettings, split: Split, results: ResultsDirectory | None
    ) -> None:
        super().__init__(settings, results, threading.Event())
        self.keeps_fits = False
        self._address, self._split = address, split
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
        self.jobs = settings.jobs or sum(self._client.nthreads().values())
        if not self.jobs:
            self._client.close()
            raise ExecutorError(
                f"the Dask scheduler at {address} has no workers: start some with `dask worker "
                f"{address}`"
            )

    def __call__(self, job: UnitJob, progress: Progress = ignore_progress) -> Scored:
        """Score a unit on the cluster; `progress` is called in a thread of the client's."""
        if not self._settings.fresh and (kept := job.kept(self._results)):
            return kept
        future: Any = None
        topic = f"oodd-{uuid4().hex}"  # of messages on how far the fit is
        try:
            order = order_of(job, self._split, self._settings.limits) | {"topic": topic}
            self._client.subscribe_topic(topic, lambda event: progress(event[1]))
            future = self._client.submit(on_worker, order, pure=False)
            self._running.add(future)
            if self._stopping.is_set():
                future.cancel()
            outcome = self._awaited(future)
        except ExecutorError:
            raise
        except KilledWorker as error:
            return Scored("error", f"the cluster lost every worker that ran it: {error}")
        except Exception as error:
            if self._stopping.is_set():
                return Scored("error", "interrupted")
            unit_label = f"{job.unit.setting.label(job.unit.seed)} on {job.unit.environment}"
            raise ExecutorError(
                f"{unit_label} could not be run on the cluster at {self._address} "
                f"({type(error).__name__}: {error}); its workers need oodd-eval and the same "
                "plug-ins as this side"
            ) from error
        finally:
            self._running.discard(future)
        if "refused" in outcome:
            raise ExecutorError(f"Dask worker {outcome['worker']}: {outcome['refused']}")
        file = ScoreFile(**{name: outcome[name] for name in _FILE})
        return Scored(outcome["status"], outcome["reason"], file, outcome["log"])

    def _awaited(self, future: Any) -> Message:
        """Return what comes back; `ExecutorError` when the cluster has had no worker for long."""
        lonely = 0
        while True:
            try:
                outcome: Message = future.result(timeout=WORKERLESS_SECONDS / 4)
            except (TimeoutError, distributed.TimeoutError):
                lonely = 0 if self._client.nthreads() else lonely + 1
                if lonely > 4:
                    raise ExecutorError(
                        f"the Dask scheduler at {self._address} has lost all its workers: start "
                        f"some with `dask worker {self._address}` and run again"
                    ) from None
            else:
                return outcome

    def stop(self) -> None:
        """Tell the workers that nobody waits any more."""
        super().stop()
        for future in list(self._running):
            with contextlib.suppress(Exception):
                future.cancel()

    def close(self) -> None:
        """Leave the cluster as it is."""
        self._client.close()


def order_of(job: UnitJob, split: Split, limits: Limits) -> Message:
    """Describe a unit for a worker elsewhere."""
    return {
        "version": __version__,
        "split": {"path": str(split.path.absolute()), "name": str(split.manifest["name"])},
        "plan": {
            "split": job.plan.split,
            "split_digest": job.plan.split_digest,
            "groups": dict(job.plan.groups),
            "limit": job.plan.limit,
        },
        "unit": asdict(job.unit),
        "streamed": job.streamed,
        "launcher": job.launcher and dict(job.launcher.elsewhere),
        "limits": asdict(limits),
    }


def on_worker(order: Message) -> Message:
    """Run an order inside a Dask worker; the outcome tells which."""
    worker = distributed.get_worker()
    key = worker.get_current_task()

    def withdrawn() -> bool:
        """Tell whether nobody waits for the result: the client cancelled it, or is no more."""
        task = worker.state.tasks.get(key)
        return task is None or task.state == "cancelled"

    progress = partial(worker.log_event, order["topic"])
    return {**run_order(order, withdrawn, progress), "worker": worker.address}


def run_order(order: Message, stop: Stop, progress: Progress = ignore_progress) -> Message:
    """Run an order on this machine, in a worker process of its own."""
    try:
        return _scored(order, stop, progress)
    except OoddError as error:
        return {"refused": str(error)}


def _scored(order: Message, stop: Stop, progress: Progress) -> Message:
    if order["version"] != __version__:
        raise ExecutorError(
            f"it has oodd-eval {__version__}, expected {order['version']} as on this side: "
            "install the same version there"
        )
    # Read also from JSON, which turns tuples into lists.
    unit = TypeAdapter(Unit).validate_python(order["unit"])
    plan = Plan(units=(unit,), **order["plan"])
    limits, launcher = Limits(**order["limits"]), None
    try:
        if order["launcher"]:
            text = json.dumps(order["launcher"], sort_keys=True)
            launcher, plugins = _launcher(text, limits.memory)
            offer = plugins.offer(unit.setting.detector)
        else:
            offer = offer_of(unit.plugin, unit.setting.detector)
    except (PluginError, UsageError) as error:
        raise ExecutorError(f"on the other side, {error}") from None
    digests = {"version": offer.version, "source": source_digest(offer.module, offer.packages)}
    for name, here in digests.items():
        if here != getattr(unit, name):
            raise ExecutorError(
                f"plug-in {unit.plugin!r} has the {name} {here!r} there, expected "
                f"{getattr(unit, name)!r} as on this side: install the same code there"
            )
    data = _environment(
        order["split"]["path"], order["split"]["name"], plan.split_digest, unit.environment
    )
    job = UnitJob(plan, unit, data, offer, order["streamed"], launcher)
    scored = job(limits, stop, None, fresh=True, progress=progress)
    outcome = {"status": scored.status, "reason": scored.reason, "log": scored.log}
    return {**outcome, **{name: getattr(scored.file, name) for name in _FILE}}


@lru_cache(maxsize=16)
def _launcher(text: str, memory: int | None) -> tuple[Launcher, Plugins]:
    """Make a launcher of what `Launcher.elsewhere` tells of it; units share it."""
    arguments = json.loads(text)
    module, _, maker = arguments.pop("maker").partition(":")
    launcher, plugins = getattr(import_module(module), maker)(**arguments, memory=memory)
    return launcher, plugins


@lru_cache(maxsize=16)
def _environment(path: str, name: str, digest: str, environment: str) -> EnvironmentData:
    """Open one environment of the split with a digest; it stays open for the units to come."""
    looked = []
    for location in (Path(path), name):
        try:
            split = load_split(location)
        except OoddError as error:
            looked.append(str(error))
            continue
        if split.digest == digest:
            return split.environment(environment)
        looked.append(f"{split.path} has the digest {split.digest[:12]}")
    raise SplitError(
        f"split {name!r} with the digest {digest[:12]} is not there ({'; '.join(looked)}): copy it "
        f"to the same path, or install it there with `oodd-eval data fetch`"
    )
