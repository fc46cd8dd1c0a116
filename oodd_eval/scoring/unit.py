"""Get the checked scores of one unit: from an earlier run, a worker, or this process."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import islice
from typing import Final

import numpy as np

from oodd_eval.data.layout import TWINS
from oodd_eval.data.split import EnvironmentData, TrajectorySet
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import ContractError
from oodd_eval.plugins.causality import Probe, check_prefix, probes
from oodd_eval.plugins.contract import Scores, check_scores
from oodd_eval.plugins.discovery import Offer
from oodd_eval.plugins.isolation.processes import printable
from oodd_eval.plugins.isolation.supervisor import Limits, Outcome, Request, Stop, run_isolated
from oodd_eval.plugins.isolation.worker import make_detector, score_chunk
from oodd_eval.results.directory import ResultsDirectory, ScoreFile, fit_key, unit_key
from oodd_eval.results.fits import FittedStore
from oodd_eval.scoring.plan import Plan, Unit

CALIBRATION: Final = "calibration"

LOCAL: Final = ""
"""Plug-in name of a detector that is no plug-in's: it runs in this process."""


@dataclass(slots=True)
class Scored:
    """Checked scores of one unit by part, or the way in which it failed.

    `log` is the end of what a failing detector printed; `resumed` tells scores of an earlier run.
    The reason may have come from the detector: it is made fit to print.
    """

    status: str = "ok"
    reason: str = ""
    file: ScoreFile = field(default_factory=lambda: ScoreFile({}, {}))
    log: str = ""
    resumed: bool = False

    def __post_init__(self) -> None:
        self.reason = printable(self.reason)


@dataclass(frozen=True, slots=True)
class UnitJob:
    """One unit's work, in a thread of its own: scores from the cache, a worker or this process."""

    plan: Plan
    unit: Unit
    data: EnvironmentData
    offer: Offer

    def __call__(
        self,
        limits: Limits,
        stop: Stop,
        results: ResultsDirectory | None,
        *,
        fresh: bool,
    ) -> Scored:
        """Return the unit's scores, or how its detector failed."""
        sets = parts_of(self.data, self.unit.anomalies)
        counts = {part: limited(len(s), self.plan.limit) for part, s in sets.items()}
        if self.offer.plugin == LOCAL:
            return self._in_process(sets, counts)
        if reason := self.offer.unavailable():
            return Scored("unavailable", reason)
        if not fresh and (kept := self.stored(results)):
            return kept
        # A worker knows its seed, but not the digest: it cannot draw the same.
        order, again = shuffled(counts, self._key), self._probes()

        def isolated(*, load: str = "", save: str = "") -> Outcome:
            train = 0 if load else limited(len(self.data.train), self.plan.limit)
            return run_isolated(
                Request(
                    plugin=self.offer.plugin,
                    detector=self.unit.detector,
                    parameters=dict(self.unit.parameters),
                    seed=self.unit.seed,
                    horizon=self.unit.horizon,
                    train=train,
                    load=load,
                    save=save,
                ),
                islice(self.data.train, train),
                (sets[part][i] for part, i in order),
                (sets[p.part][p.index][: p.rows] for p in again),
                limits=limits,
                stop=stop,
            )

        if results:
            key = fit_key(self.plan, self.unit, self.offer)
            outcome = _with_store(isolated, results.fitted, key, stop, fresh=fresh)
        else:
            outcome = isolated()
        return self._checked(outcome, order, again, sets, counts)

    def stored(self, results: ResultsDirectory | None) -> Scored | None:
        """Return the scores that an earlier run has kept, if they are there and fit."""
        if results is None:
            return None
        key = unit_key(self.plan, self.unit, self.offer).text
        kept = results.scores(key, self._lengths())
        return Scored(file=kept, resumed=True) if kept else None

    def _checked(
        self,
        outcome: Outcome,
        order: list[tuple[str, int]],
        again: list[Probe],
        sets: Mapping[str, TrajectorySet],
        counts: Mapping[str, int],
    ) -> Scored:
        """Check every score sequence and put them back in order."""
        if outcome.status != "ok":
            return Scored(outcome.status, outcome.reason, log=outcome.log)
        parts: dict[str, list[Scores]] = {p: [np.empty(0)] * n for p, n in counts.items()}
        try:
            returned, warm_up = outcome.scores, outcome.warm_up
            for (part, i), scores in zip(order, returned[: len(order)], strict=True):
                parts[part][i] = self._check(scores, warm_up, part, i, sets[part][i])
            for probe, scores in zip(again, returned[len(order) :], strict=True):
                self._check_prefix(scores, warm_up, probe, sets, parts)
        except ContractError as error:
            return Scored("invalid", str(error), log=outcome.log)
        cost = {
            "seconds_fit": outcome.seconds_fit,
            "seconds_score": outcome.seconds_score,
            "peak_rss_mb": outcome.peak_rss_mb,
            "steps_scored": sum(len(scores) for part in parts.values() for scores in part)
            + sum(probe.rows for probe in again),
        }
        known = {name: value for name, value in cost.items() if value is not None}
        return Scored(file=ScoreFile(parts, known))

    def _check(
        self, scores: object, warm_up: object, part: str, i: int, trajectory: Trajectory
    ) -> Scores:
        return check_scores(
            scores,
            trajectory,
            horizon=self.unit.horizon,
            warm_up=warm_up,  # type: ignore[arg-type]  # check_scores is what checks it
            detector=self.unit.detector,
            where=f"{self.unit.environment}/{part}[{i}]",
        )

    def _check_prefix(
        self,
        scores: object,
        warm_up: object,
        probe: Probe,
        sets: Mapping[str, TrajectorySet],
        parts: Mapping[str, list[Scores]],
    ) -> None:
        part, i = probe.part, probe.index
        found = self._check(scores, warm_up, part, i, sets[part][i][: probe.rows])
        where = f"{self.unit.environment}/{part}[{i}]"
        check_prefix(found, parts[part][i], detector=self.unit.detector, where=where)

    @property
    def _key(self) -> str:
        return f"{self.plan.split_digest}|{self.unit.environment}|{self.unit.seed}"

    def _probes(self) -> list[Probe]:
        return probes(self._lengths(), self._key)

    def _lengths(self) -> dict[str, list[int]]:
        return lengths_of(parts_of(self.data, self.unit.anomalies), self.plan.limit)

    def _in_process(self, sets: Mapping[str, TrajectorySet], counts: Mapping[str, int]) -> Scored:
        """Fit and score here: what the detector raises passes through."""
        detector = make_detector(
            self.offer.spec.factory,
            seed=self.unit.seed,
            horizon=self.unit.horizon,
            parameters=self.unit.parameters,
        )
        detector.fit(list(islice(self.data.train, self.plan.limit)))
        parts: dict[str, list[Scores]] = {}
        for part, trajectories in sets.items():
            chunk = trajectories[: counts[part]]
            parts[part] = [
                self._check(scores, getattr(detector, "warm_up", 0), part, i, chunk[i])
                for i, scores in enumerate(score_chunk(detector, chunk))
            ]
        again = self._probes()
        prefixes = [sets[p.part][p.index][: p.rows] for p in again]
        scored = score_chunk(detector, prefixes) if prefixes else []
        for probe, scores in zip(again, scored, strict=True):
            self._check_prefix(scores, getattr(detector, "warm_up", 0), probe, sets, parts)
        return Scored(file=ScoreFile(parts, {}))


def _with_store(
    isolated: Callable[..., Outcome],
    store: FittedStore,
    key: str,
    stop: Stop,
    *,
    fresh: bool,
) -> Outcome:
    """Score with the fit that is kept under a key, or fit and keep it."""
    fitted = store.find(key, fresh=fresh)
    if fitted is None:
        with store.alone(key):
            # Meanwhile another unit of the same fit may have kept it.
            fitted = store.find(key, fresh=fresh)
            if fitted is None:
                with store.room() as room:
                    outcome = isolated(save=str(room.absolute()))
                    if outcome.status == "ok" and outcome.seconds_fit is not None:
                        store.keep(key, room, outcome.seconds_fit)
                return outcome
    outcome = isolated(load=str(fitted.path.absolute()))
    if outcome.seconds_fit is not None:
        outcome.seconds_fit = fitted.seconds_fit
    elif outcome.status != "ok" and not stop.is_set():
        # It ended before it was loaded; whatever the reason, a fit of its own is what counts.
        store.distrust(key)
        return _with_store(isolated, store, key, stop, fresh=True)
    return outcome


def parts_of(data: EnvironmentData, anomalies: tuple[str, ...]) -> dict[str, TrajectorySet]:
    """Return the parts to score by name: calibration, the twins and the anomalies."""
    anomalous = {f"test/{a}": data.anomalous(a) for a in anomalies}
    return {CALIBRATION: data.calibration, TWINS: data.twins, **anomalous}


def lengths_of(sets: Mapping[str, TrajectorySet], limit: int | None) -> dict[str, list[int]]:
    """Return the number of observations of each trajectory to score, by part."""
    return {part: [int(n) + 1 for n in s.lengths[:limit]] for part, s in sets.items()}


def limited(n: int, limit: int | None) -> int:
    """Return how many of n trajectories are used."""
    return n if limit is None else min(n, limit)


def shuffled(counts: Mapping[str, int], key: str) -> list[tuple[str, int]]:
    """Return all trajectories to score, as part and number, in an order that a key decides.

    Position tells nothing of the part, and the same key gives the same order anywhere.
    """
    ordered = [(part, i) for part, n in counts.items() for i in range(n)]
    seed = int.from_bytes(hashlib.sha256(key.encode()).digest())
    return [ordered[i] for i in np.random.default_rng(seed).permutation(len(ordered))]
