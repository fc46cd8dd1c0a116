"""Score one unit: take kept scores, or fit and score in a worker, and check all that comes back."""

import copy
import secrets
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from itertools import islice
from typing import Final

import numpy as np

from oodd_eval.data.baseline import Baseline, check_baseline
from oodd_eval.data.parts import (
    CALIBRATION,
    TWINS,
    EnvironmentData,
    TrajectorySet,
    lengths_of,
    parts_of,
)
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import ContractError
from oodd_eval.plugins import contract, explanations
from oodd_eval.plugins.contract import Probe, Scores
from oodd_eval.plugins.discovery import Offer, printable
from oodd_eval.plugins.explanations import Named
from oodd_eval.plugins.isolation.child import Limits, Stop
from oodd_eval.plugins.isolation.supervisor import Outcome, run_isolated
from oodd_eval.results.directory import ORDER_BITS, FitStore, ResultsDirectory, ScoreFile
from oodd_eval.results.record import Status
from oodd_eval.scoring.plan import Plan, Unit

_NOMINAL: Final = (CALIBRATION, TWINS)
LEAST_GROUP: Final = 8
"""Trajectories of a group where test parts differ in size: each group takes a process."""

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
        work = GroupedScoring(self, parts_of(self.data, self.unit.conditions))
        if self.unit.local:
            return work.in_process()
        if reason := self.offer.unavailable():
            return Scored("unavailable", reason)
        if not fresh and (kept := self.kept(results)):
            return kept

        def isolated(*, load: str = "", save: str = "") -> Outcome:
            return work.isolated(limits, stop, load=load, save=save)

        if results is None:
            # It is this process that removes what was saved, however the worker ends.
            with tempfile.TemporaryDirectory(prefix="oodd-eval-") as directory:
                return work.checked(isolated(save=directory))
        fits = results.fits
        return work.checked(_with_kept_fit(isolated, fits, self.unit.fit_key, stop, fresh=fresh))

    def kept(self, results: ResultsDirectory | None) -> Scored | None:
        """Return the scores that an earlier run has kept, if they are there and fit."""
        if results is None:
            return None
        lengths = lengths_of(parts_of(self.data, self.unit.conditions), self.plan.limit)
        kept = results.scores(self.unit.scores_key, lengths)
        return Scored(file=kept, resumed=True) if kept else None


class GroupedScoring:
    """The trajectories of one unit, the groups in which they are scored, and the checks of scores.

    A group holds no two trajectories of one seed: as many calibration trajectories as there are
    test seeds, the twins, one anomaly, or prefixes of other trajectories (without twins: a part of
    any of these). It is scored apart from all others. The order of groups, and which prefixes there
    are, follow from a number drawn from the system's randomness, which is stored with the scores.
    Within a group the order is that of the split, so that scores are the same bit for bit. A
    detector that explains is asked to in the same way, when all is scored: only the anomalous
    trajectories, and prefixes of some of these.
    """

    def __init__(self, job: UnitJob, sets: Mapping[str, TrajectorySet]) -> None:
        self._job, self._sets = job, sets
        self._lengths = lengths_of(sets, job.plan.limit)
        self._adapts = bool(job.unit.adapts)
        # Rows at the start of each episode that a detector is not shown, or learns from.
        self._rows = rows = job.data.baseline
        self._baseline: Baseline | None = None
        if rows:
            for part, lengths in self._lengths.items():
                check_baseline(lengths, rows, f"{job.unit.environment}/{part}")
        if rows and not self._adapts:
            self._baseline = Baseline.fit(islice(job.data.train, job.plan.limit), rows)
            self._lengths = {p: [n - rows for n in ns] for p, ns in self._lengths.items()}
        self._order = secrets.randbits(ORDER_BITS)
        self._probes = contract.probes(self._lengths, self._order)
        self._ordered = [*groups(self._lengths), self._probes]
        self._drawn = np.random.default_rng(self._order).permutation(len(self._ordered))
        self._groups = [self._ordered[k] for k in self._drawn]
        anomalous = {p: n for p, n in self._lengths.items() if p not in _NOMINAL}
        again = [group for group in self._ordered[:-1] if group[0].part in anomalous]
        again.append(contract.probes(anomalous, self._order))
        order = np.random.default_rng([self._order, len(again)]).permutation(len(again))
        self._explained = [again[k] for k in order]

    def isolated(self, limits: Limits, stop: Stop, *, load: str, save: str) -> Outcome:
        """Fit (or load a fit) and score in worker processes."""
        unit, data = self._job.unit, self._job.data
        train = 0 if load else len(data.train.lengths[: self._job.plan.limit])
        request = {
            "plugin": unit.plugin,
            "detector": unit.setting.detector,
            "seed": unit.seed,
            "horizon": unit.setting.horizon,
            "parameters": dict(unit.parameters),
            "baseline": self._adapting,
            "train": train,
            "load": load,
            "save": save,
        }
        nominal = map(self._visible, islice(data.train, train))
        parts, again = (map(self._members, g) for g in (self._groups, self._explained))
        return run_isolated(request, nominal, parts, again, limits=limits, stop=stop)

    def checked(self, outcome: Outcome) -> Scored:
        """Check every score sequence of a worker and put them in their places."""
        if outcome.status != "ok":
            return Scored(outcome.status, outcome.reason, log=outcome.log)  # type: ignore[arg-type]
        returned, sizes = iter(outcome.scores), [*map(len, self._groups)]
        if (n := len(outcome.scores)) != sum(sizes):
            wrong = f"{n} score arrays came back, expected {sum(sizes)}"
            return Scored("invalid", wrong, log=outcome.log)
        try:
            parts = self._placed([[*islice(returned, n)] for n in sizes], outcome.warm_up)
            explained = self._explanations(outcome.explained, parts)
        except ContractError as error:
            return Scored("invalid", str(error), log=outcome.log)
        # Prefixes, a few percent more, are others in every run, and records shall be the same.
        steps = sum(map(sum, self._lengths.values()))
        cost = {name: getattr(outcome, name) for name in COSTS}
        known = {name: value for name, value in cost.items() if value is not None}
        cost = {**known, "steps_scored": steps}
        return Scored(file=self._whole(ScoreFile(parts, cost, self._order, explained)))

    def in_process(self) -> Scored:
        """Fit and score in this process, a copy each group; errors of the detector pass through."""
        unit, limit = self._job.unit, self._job.plan.limit
        detector = contract.make_detector(
            self._job.offer.spec.factory,
            seed=unit.seed,
            horizon=unit.setting.horizon,
            parameters=unit.parameters,
            baseline=self._adapting,
        )
        detector.fit([*map(self._visible, islice(self._job.data.train, limit))])
        chunks = ([*self._members(group)] for group in self._groups)
        returned = [contract.score_chunk(copy.deepcopy(detector), chunk) for chunk in chunks]
        parts = self._placed(returned, getattr(detector, "warm_up", 0))
        again = self._explained if explanations.explains(detector) else ()
        explained = [
            explanation
            for group in again
            for explanation in explanations.explain_chunk(
                copy.deepcopy(detector), [*self._members(group)]
            )
        ]
        scores = ScoreFile(parts, {}, self._order, self._explanations(explained, parts))
        return Scored(file=self._whole(scores))

    @property
    def _adapting(self) -> int:
        """The number of baseline rows for a detector that adapts to them, else 0."""
        return self._rows if self._adapts else 0

    def _whole(self, scores: ScoreFile) -> ScoreFile:
        """Return scores and explanations of whole episodes, undefined in their baseline rows."""
        rows = self._rows
        if not rows:
            return scores
        # Of a detector that adapts these rows were scored, too.
        start = rows if self._adapts else 0
        parts = {
            part: [np.concatenate([np.full(rows, np.nan), one[start:]]) for one in arrays]
            for part, arrays in scores.parts.items()
        }
        explained = {
            part: [_behind(one[:, start:], rows, rows - start) for one in arrays]
            for part, arrays in scores.explained.items()
        }
        return replace(scores, parts=parts, explained=explained)

    def _members(self, group: Sequence[Probe]) -> Iterator[Trajectory]:
        return (self._visible(self._sets[p.part][p.index])[: p.rows] for p in group)

    def _visible(self, trajectory: Trajectory) -> Trajectory:
        """Return what the detector may see: no actions, unless it declares that it uses them."""
        withheld = self._job.unit.inputs == "observations"
        judged = self._baseline.judged(trajectory) if self._baseline else trajectory
        return judged.without_actions() if withheld else judged

    def _placed(self, returned: list[list[object]], warm_up: object) -> dict[str, list[Scores]]:
        """Check the scores of all groups; raise `ContractError`, or return them by part."""
        parts: dict[str, list[Scores]]
        parts = {p: [np.empty(0)] * len(n) for p, n in self._lengths.items()}
        scores, unit = dict(zip(self._drawn, returned, strict=True)), self._job.unit
        detector, horizon = unit.setting.detector, unit.setting.horizon
        # In the order of the split: the first fault that is told is the same in every run.
        for k, group in enumerate(self._ordered):
            for (part, i, rows), array in zip(map(astuple, group), scores[k], strict=True):
                where = f"{unit.environment}/{part}[{i}]"
                checked = contract.check_scores(
                    array,
                    rows,
                    horizon=horizon,
                    warm_up=warm_up,
                    detector=detector,
                    where=where,
                    baseline=self._adapting,
                )
                if group is self._probes:
                    contract.check_prefix(
                        checked, parts[part][i], detector=detector, where=where, horizon=horizon
                    )
                else:
                    parts[part][i] = checked
        return parts

    def _explanations(
        self, returned: Sequence[object], parts: Mapping[str, Sequence[Scores]]
    ) -> dict[str, list[Named]]:
        """Check explanations, if there are any; raise `ContractError`, or return them by part."""
        probes = [probe for group in self._explained for probe in group]
        if returned and len(returned) != len(probes):
            raise ContractError(f"{len(returned)} explanations came back, expected {len(probes)}")
        explained: dict[str, list[Named]] = {}

        def key(pair: tuple[Probe, object]) -> tuple[bool, str, int]:
            probe = pair[0]  # whole ones before those that are cut
            return probe.rows < len(parts[probe.part][probe.index]), probe.part, probe.index

        for probe, array in sorted(zip(probes, returned, strict=False), key=key):
            scores, named = parts[probe.part][probe.index], explained.setdefault(probe.part, [])
            cut, where = probe.rows < len(scores), f"{probe.part}[{probe.index}]"
            checked = explanations.check_named(
                array,
                scores[: probe.rows],
                len(self._job.data.sensors),
                f"{self._job.unit.environment}/{where}",
                named[probe.index] if cut else None,
            )
            named += [] if cut else [checked]
        return explained


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
    elif outcome.status != "ok" and not stop():
        # The kept fit could not be loaded: discard it and fit again.
        fits.distrust(key)
        return _with_kept_fit(isolated, fits, key, stop, fresh=True)
    return outcome


def _behind(explained: Named, rows: int, shift: int) -> Named:
    """Return an explanation behind undefined rows; what it calls onsets are `shift` rows later."""
    onsets = np.where(explained[1] < 0, -1, explained[1] + shift)
    known = np.stack([explained[0], onsets])
    return np.concatenate([np.full((2, rows), -1), known], axis=1).astype(np.int32)


def groups(lengths: Mapping[str, Sequence[int]]) -> list[list[Probe]]:
    """Return whole trajectories in groups of one part, at most as many as there are twins.

    All have that size but the last one of calibration, where the twins do not divide it. Without
    twins test parts have sizes of their own: the smallest of these is the most, but for small ones
    `LEAST_GROUP`. So no size tells calibration from test.
    """
    sizes = {len(ns) for part, ns in lengths.items() if part.startswith("test/") and ns}
    size = min(sizes, default=1)
    if len(sizes) > 1:
        size = max(size, LEAST_GROUP)
    every = [[Probe(part, i, n) for i, n in enumerate(ns)] for part, ns in lengths.items()]
    return [part[i : i + size] for part in every for i in range(0, len(part), size)]
