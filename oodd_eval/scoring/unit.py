"""Score one unit: take kept scores, or fit and score in a worker, and check all that comes back."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import islice
from typing import Final

import numpy as np

from oodd_eval.data.parts import EnvironmentData, TrajectorySet, lengths_of, limited, parts_of
from oodd_eval.errors import ContractError
from oodd_eval.plugins.contract import (
    Scores,
    check_prefix,
    check_scores,
    make_detector,
    probes,
    score_chunk,
)
from oodd_eval.plugins.discovery import Offer, printable
from oodd_eval.plugins.isolation.supervisor import Limits, Outcome, Request, Stop, run_isolated
from oodd_eval.results.directory import ResultsDirectory, ScoreFile
from oodd_eval.results.fits import FitStore
from oodd_eval.results.record import Status
from oodd_eval.scoring.plan import Plan, Unit

COSTS: Final = ("seconds_fit", "seconds_score", "peak_rss_mb")


@dataclass(slots=True)
class Scored:
    """Checked scores of one unit by part, or the way in which it failed.

    Status and reason are as in a record. `log` is the end of the output of a failing detector;
    `resumed` tells scores of an earlier run.
    """

    status: Status = "ok"
    reason: str = ""
    file: ScoreFile = field(default_factory=lambda: ScoreFile({}, {}))
    log: str = ""
    resumed: bool = False

    def __post_init__(self) -> None:
        # It may have come from the detector.
        self.reason = printable(self.reason)


@dataclass(frozen=True, slots=True)
class UnitJob:
    """The work of one unit, to be called in a thread of its own."""

    plan: Plan
    unit: Unit
    data: EnvironmentData
    offer: Offer

    def __call__(
        self, limits: Limits, stop: Stop, results: ResultsDirectory | None, *, fresh: bool
    ) -> Scored:
        """Return the unit's scores, or how its detector failed."""
        work = _Work(self, parts_of(self.data, self.unit.anomalies))
        if self.unit.local:
            return work.in_process()
        if reason := self.offer.unavailable():
            return Scored("unavailable", reason)
        if not fresh and (kept := self.kept(results)):
            return kept

        def isolated(*, load: str = "", save: str = "") -> Outcome:
            return work.isolated(limits, stop, load=load, save=save)

        if results is None:
            return work.checked(isolated())
        fits = results.fits
        return work.checked(_with_kept_fit(isolated, fits, self.unit.fit_key, stop, fresh=fresh))

    def kept(self, results: ResultsDirectory | None) -> Scored | None:
        """Return the scores that an earlier run has kept, if they are there and fit."""
        if results is None:
            return None
        lengths = lengths_of(parts_of(self.data, self.unit.anomalies), self.plan.limit)
        kept = results.scores(self.unit.scores_key, lengths)
        return Scored(file=kept, resumed=True) if kept else None


class _Work:
    """The trajectories of one unit, the order in which they are scored, and the checks of scores.

    Scoring is in an order that tells nothing of parts. A worker knows its seed, but not the
    split's digest: it cannot draw the same order.
    """

    def __init__(self, job: UnitJob, sets: Mapping[str, TrajectorySet]) -> None:
        self._job, self._sets = job, sets
        self._lengths = lengths_of(sets, job.plan.limit)
        key = f"{job.plan.split_digest}|{job.unit.environment}|{job.unit.seed}"
        counts = {part: len(lengths) for part, lengths in self._lengths.items()}
        self._order, self._probes = shuffled(counts, key), probes(self._lengths, key)

    def isolated(self, limits: Limits, stop: Stop, *, load: str, save: str) -> Outcome:
        """Fit (or load a fit) and score in a worker process."""
        unit, data = self._job.unit, self._job.data
        train = 0 if load else limited(len(data.train), self._job.plan.limit)
        request = Request(
            unit.plugin, unit.detector, dict(unit.parameters), unit.seed, unit.horizon, train,
            load, save,
        )  # fmt: skip
        whole = (self._sets[part][i] for part, i in self._order)
        cut = (self._sets[p.part][p.index][: p.rows] for p in self._probes)
        return run_isolated(
            request, islice(data.train, train), whole, cut, limits=limits, stop=stop
        )

    def checked(self, outcome: Outcome) -> Scored:
        """Check every score sequence of a worker and put them back in order."""
        if outcome.status != "ok":
            return Scored(outcome.status, outcome.reason, log=outcome.log)  # type: ignore[arg-type]
        parts: dict[str, list[Scores]] = {
            p: [np.empty(0)] * len(n) for p, n in self._lengths.items()
        }
        returned, warm_up = outcome.scores, outcome.warm_up
        whole, prefixes = returned[: len(self._order)], returned[len(self._order) :]
        try:
            for (part, i), scores in zip(self._order, whole, strict=True):
                parts[part][i] = self._check(scores, warm_up, part, i)
            self._check_prefixes(prefixes, warm_up, parts)
        except ContractError as error:
            return Scored("invalid", str(error), log=outcome.log)
        steps = sum(map(sum, self._lengths.values())) + sum(p.rows for p in self._probes)
        cost = {name: getattr(outcome, name) for name in COSTS}
        known = {name: value for name, value in cost.items() if value is not None}
        return Scored(file=ScoreFile(parts, {**known, "steps_scored": steps}))

    def in_process(self) -> Scored:
        """Fit and score in this process; errors of the detector pass through."""
        unit, limit = self._job.unit, self._job.plan.limit
        detector = make_detector(
            self._job.offer.spec.factory,
            seed=unit.seed,
            horizon=unit.horizon,
            parameters=unit.parameters,
        )
        detector.fit(list(islice(self._job.data.train, limit)))
        warm_up = getattr(detector, "warm_up", 0)
        parts = {
            part: [
                self._check(scores, warm_up, part, i)
                for i, scores in enumerate(score_chunk(detector, trajectories[:limit]))
            ]
            for part, trajectories in self._sets.items()
        }
        cut = [self._sets[p.part][p.index][: p.rows] for p in self._probes]
        self._check_prefixes(score_chunk(detector, cut) if cut else [], warm_up, parts)
        return Scored(file=ScoreFile(parts, {}))

    def _check(
        self, scores: object, warm_up: object, part: str, i: int, rows: int | None = None
    ) -> Scores:
        return check_scores(
            scores,
            self._lengths[part][i] if rows is None else rows,
            horizon=self._job.unit.horizon,
            warm_up=warm_up,
            detector=self._job.unit.detector,
            where=self._place(part, i),
        )

    def _check_prefixes(
        self, returned: list[object], warm_up: object, parts: Mapping[str, list[Scores]]
    ) -> None:
        for probe, scores in zip(self._probes, returned, strict=True):
            part, i = probe.part, probe.index
            found = self._check(scores, warm_up, part, i, probe.rows)
            check_prefix(
                found, parts[part][i], detector=self._job.unit.detector, where=self._place(part, i)
            )

    def _place(self, part: str, i: int) -> str:
        return f"{self._job.unit.environment}/{part}[{i}]"


def _with_kept_fit(
    isolated: Callable[..., Outcome], fits: FitStore, key: str, stop: Stop, *, fresh: bool
) -> Outcome:
    """Score with the fit that is kept under a key, or fit, score and keep the fit."""
    fit = fits.find(key, fresh=fresh)
    if fit is None:
        with fits.filling() as directory:
            outcome = isolated(save=str(directory.absolute()))
            if outcome.status == "ok" and outcome.seconds_fit is not None:
                fits.keep(key, directory, outcome.seconds_fit)
        return outcome
    outcome = isolated(load=str(fit.path.absolute()))
    if outcome.seconds_fit is not None:
        outcome.seconds_fit = fit.seconds_fit
    elif outcome.status != "ok" and not stop.is_set():
        # It ended before it was loaded; whatever the reason, a fit of its own is what counts.
        fits.distrust(key)
        return _with_kept_fit(isolated, fits, key, stop, fresh=True)
    return outcome


def shuffled(counts: Mapping[str, int], key: str) -> list[tuple[str, int]]:
    """Return all trajectories to score, as part and number, in an order that a key decides.

    Position tells nothing of the part, and the same key gives the same order anywhere.
    """
    ordered = [(part, i) for part, n in counts.items() for i in range(n)]
    seed = int.from_bytes(hashlib.sha256(key.encode()).digest())
    return [ordered[i] for i in np.random.default_rng(seed).permutation(len(ordered))]
