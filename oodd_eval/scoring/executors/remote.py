"""What happens to a unit on a worker of a cluster: it is checked against what is there, then done.

Orders and outcomes are plain dictionaries, so that a worker with another version of this package
can still say so. Everything that must be the same on both sides (plug-in, its code, the data) is
named in the order by digest and compared before any work.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from oodd_eval._version import __version__
from oodd_eval.data.split import EnvironmentData, Split, load_split
from oodd_eval.errors import ExecutorError, OoddError, SplitError
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.isolation.supervisor import Limits, Stop
from oodd_eval.results.directory import ScoreFile, unit_key
from oodd_eval.scoring.plan import Plan, Unit
from oodd_eval.scoring.unit import Scored, UnitJob

Message = dict[str, Any]


def order_of(job: UnitJob, split: Split, limits: Limits) -> Message:
    """Describe a unit for a worker elsewhere."""
    return {
        "version": __version__,
        "split": {"path": str(split.path.absolute()), "name": str(split.manifest["name"])},
        "plan": {"split": job.plan.split, "split_digest": job.plan.split_digest,
                 "limit": job.plan.limit},
        "unit": asdict(job.unit),
        "plugin": job.offer.plugin,
        "key": asdict(unit_key(job.plan, job.unit, job.offer)),
        "limits": asdict(limits),
    }  # fmt: skip


def carry_out(order: Message, stop: Stop) -> Message:
    """Carry out an order on this machine, in a worker process of its own.

    Parameters
    ----------
    order
        What `order_of` made.
    stop
        When set, the work is given up.

    Returns
    -------
    What `scored_of` reads; ``{"refused": why}`` when this machine cannot give the same scores.
    """
    try:
        return _scored(order, stop)
    except OoddError as error:
        return {"refused": str(error)}


def scored_of(outcome: Message) -> Scored:
    """Read what `carry_out` returned.

    Raises
    ------
    ExecutorError
        When the worker refused.
    """
    if "refused" in outcome:
        raise ExecutorError(outcome["refused"])
    file = ScoreFile(outcome["parts"], outcome["cost"])
    return Scored(outcome["status"], outcome["reason"], file, outcome["log"])


def _scored(order: Message, stop: Stop) -> Message:
    if order["version"] != __version__:
        raise ExecutorError(
            f"it has oodd-eval {__version__}, expected {order['version']} as on this side: "
            "install the same version there"
        )
    unit = Unit(**{**order["unit"], "anomalies": tuple(order["unit"]["anomalies"])})
    plan = Plan(units=(unit,), **order["plan"])
    plugins = discover(only=[order["plugin"]])
    for broken in plugins.broken:
        raise ExecutorError(f"plug-in {broken.plugin!r} cannot be loaded there: {broken.reason}")
    offer = plugins.offer(unit.detector)
    found = asdict(unit_key(plan, unit, offer))
    for name, expected in order["key"].items():
        if found[name] != expected:
            raise ExecutorError(
                f"plug-in {order['plugin']!r} has the {name} {found[name]!r} there, expected "
                f"{expected!r} as on this side: install the same code there"
            )
    data = _environment(
        order["split"]["path"], order["split"]["name"], plan.split_digest, unit.environment
    )
    limits = Limits(**order["limits"])
    scored = UnitJob(plan, unit, data, offer)(limits, stop, None, fresh=True)
    return {
        "status": scored.status,
        "reason": scored.reason,
        "log": scored.log,
        "parts": scored.file.parts,
        "cost": scored.file.cost,
    }


@functools.lru_cache(maxsize=16)
def _environment(path: str, name: str, digest: str, environment: str) -> EnvironmentData:
    """Open one environment of the split with a digest; it stays open for the units to come."""
    places: tuple[Callable[[], Split], ...] = (
        lambda: load_split(Path(path)),
        lambda: load_split(name),
    )
    looked = []
    for place in places:
        try:
            split = place()
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
