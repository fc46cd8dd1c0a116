"""Score one unit: take kept scores, or fit and score in a worker, and check all that comes back."""

import inspect
import secrets
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from typing import Any, Final, NamedTuple

import numpy as np

from oodd_eval.data.baseline import Baseline, check_baseline
from oodd_eval.data.parts import CALIBRATION, EnvironmentData, TrajectorySet, lengths_of, parts_of
from oodd_eval.data.trajectory import Trajectory, TrajectorySequence
from oodd_eval.errors import ContractError, OutputError, ResultsError, SplitError, UsageError
from oodd_eval.metrics.catalogue import NAMED_AFTER
from oodd_eval.plugins import contract, explanations
from oodd_eval.plugins.contract import Progress, ignore_progress
from oodd_eval.plugins.discovery import Offer, describe, printable
from oodd_eval.plugins.isolation.child import Launcher, Limits, Stop
from oodd_eval.plugins.isolation.supervisor import Outcome, run_isolated
from oodd_eval.plugins.state import PackedState
from oodd_eval.plugins.voices import costs_of_voices, first_rows
from oodd_eval.results.directory import ResultsDirectory, ScoreFile
from oodd_eval.results.evaluate import first_alarms, with_explanations
from oodd_eval.results.record import Status
from oodd_eval.scoring.plan import Plan, Unit

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


class Member(NamedTuple):
    """A trajectory by its part, and its number there."""

    part: str
    number: int


@dataclass(frozen=True, slots=True)
class UnitJob:
    """The work of one unit, to be called in a thread of its own.

    Rows are scored one by one where `streamed`. Workers are started by the `launcher`, if any.
    """

    plan: Plan
    unit: Unit
    data: EnvironmentData
    offer: Offer
    streamed: bool = False
    launcher: Launcher | None = None

    def __call__(
        self,
        limits: Limits,
        stop: Stop,
        results: ResultsDirectory | None,
        *,
        fresh: bool,
        progress: Progress = ignore_progress,
    ) -> Scored:
        """Return the unit's scores, or how it failed: only what the user can mend is raised.

        `progress` hears which share of the fit is done, in the thread that calls.
        """
        local = self.unit.local
        try:
            if local:
                return GroupedScoring(self, progress).in_process()
            return self._isolated(limits, stop, results, progress, fresh=fresh)
        except (SplitError, OutputError, ResultsError):
            raise
        except Exception as error:
            sole = len({unit.setting.detector for unit in self.plan.units}) == 1
            if sole if local else isinstance(error, UsageError):
                raise
            # Of a worker it is a plug-in that nobody thought of.
            reason = describe(error) if local else f"oodd-eval: {describe(error)}"
            status: Status = "invalid" if local and isinstance(error, ContractError) else "error"
            return Scored(status, reason, log=traceback.format_exc())

    def _isolated(
        self,
        limits: Limits,
        stop: Stop,
        results: ResultsDirectory | None,
        progress: Progress,
        *,
        fresh: bool,
    ) -> Scored:
        if reason := self.offer.unavailable():
            return Scored("unavailable", reason)
        if not fresh and (kept := self.kept(results)):
            return kept
        work = GroupedScoring(self, progress)
        if results is None:
            return work.checked(work.isolated(limits, stop))
        fits, key = results.fits, self.unit.fit_key
        if fit := fits.find(key, fresh=fresh):
            outcome = work.isolated(limits, stop, state=fit.packed)
            if outcome.seconds_fit is not None or outcome.status == "ok" or stop():
                outcome.seconds_fit = fit.seconds_fit
                return work.checked(outcome)
            fits.distrust(key)  # It could not be restored.
        outcome = work.isolated(limits, stop, keep=True)
        if outcome.status == "ok" and outcome.state and outcome.seconds_fit is not None:
            fits.keep(key, outcome.state, outcome.seconds_fit)
        return work.checked(outcome)

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
    test seeds, the twins, or one anomaly (without twins: a part of any of these). It is scored
    apart from all others, in the order of the split, so that scores are the same bit for bit. A
    detector that explains is asked to in the same way, when all is scored: only the anomalous
    trajectories with twins, up to the first guaranteed alarm, which metrics are of, and after all
    of a group some rows longer. Where rows are streamed, groups hold all parts, see `mixed`, and
    nothing is explained.
    """

    def __init__(self, job: UnitJob, progress: Progress = ignore_progress) -> None:
        self._progress = progress
        columns = job.unit.columns
        data = job.data.of_columns(columns) if columns else job.data
        self._job, self._sets = job, parts_of(data, job.unit.conditions)
        self._lengths = lengths_of(self._sets, job.plan.limit)
        self._adapts = bool(job.unit.adapts)
        # Rows at the start of each episode that a detector is not shown, or learns from.
        self._rows = rows = job.data.baseline
        self._baseline: Baseline | None = None
        if rows:
            for part, lengths in self._lengths.items():
                check_baseline(lengths, rows, f"{job.unit.environment}/{part}")
        if rows and not self._adapts:
            self._baseline = Baseline.fit(islice(data.train, job.plan.limit), rows)
            self._lengths = {p: [n - rows for n in ns] for p, ns in self._lengths.items()}
        self._train = _Visible(data.train, job.plan.limit, self._visible)
        failed = data.failures if job.unit.training == "failures" else None
        self._failures = failed and _Visible(failed, job.plan.limit, self._visible)
        sizes = {part: len(lengths) for part, lengths in self._lengths.items()}
        self._groups = mixed(sizes) if job.streamed else groups(sizes)
        # Metrics with twins alone are of explanations, and there are no baseline rows then. The
        # parts at fault are sensors.
        self._explains = data.paired and not (rows or columns or job.streamed)
        # Of what is explained: the episode, which of the rows after its alarm, and rows until then.
        self._asked: list[tuple[Member, int, int]] = []
        # What voices are compared on, and how.
        calibration = (Member(CALIBRATION, i) for i in range(sizes[CALIBRATION]))
        self._heard = first_rows(self._members(calibration))
        self._hearing: dict[str, Any] = {"kind": job.unit.alarm, "start": self._adapting}

    def isolated(
        self, limits: Limits, stop: Stop, *, state: PackedState | None = None, keep: bool = False
    ) -> Outcome:
        """Fit (or take over the state of a fit) and score in worker processes."""
        unit = self._job.unit
        request = {
            "plugin": unit.plugin,
            "detector": unit.setting.detector,
            "seed": unit.seed,
            "horizon": unit.setting.horizon,
            "parameters": dict(unit.parameters),
            "baseline": self._adapting,
            "roles": unit.roles,
            "hearing": self._hearing,
        }
        return run_isolated(
            request,
            self._train,
            map(self._members, self._groups),
            lambda outcome: self._alarmed(outcome.scores, outcome.warm_up),
            () if self._job.streamed else self._heard,
            limits=limits,
            stop=stop,
            failures=self._failures,
            launcher=self._job.launcher,
            state=state,
            keep=keep,
            streamed=self._job.streamed,
            progress=self._progress,
        )

    def checked(self, outcome: Outcome) -> Scored:
        """Check every score sequence of a worker and put them in their places."""
        if outcome.status != "ok":
            return Scored(outcome.status, outcome.reason, log=outcome.log)  # type: ignore[arg-type]
        cost = {name: value for name in COSTS if (value := getattr(outcome, name)) is not None}
        try:
            explained = outcome.explained if outcome.explains else None
            scores = self._file(outcome.scores, explained, outcome.warm_up)
        except ContractError as error:
            return Scored("invalid", str(error), log=outcome.log)
        cost["steps_scored"] = sum(map(sum, self._lengths.values()))
        return Scored(file=replace(scores, cost=cost, voices=outcome.voices))

    def in_process(self) -> Scored:
        """Fit and score in this process, a copy each group; errors of the detector are raised.

        One that cannot be copied is fitted again for each group.
        """
        detector = self._fitted()

        def returned(
            groups: Iterable[Iterable[Trajectory]], work: Callable[..., list[object]]
        ) -> list[object]:
            chunks = map(list, groups)
            return [result for chunk in chunks for result in work(self._another(detector), chunk)]

        scores = returned(map(self._members, self._groups), contract.score_chunk)
        explained, warm_up = None, getattr(detector, "warm_up", 0)
        if explanations.explains(detector):
            explained = returned(self._alarmed(scores, warm_up), explanations.explain_chunk)
        file = self._file(scores, explained, warm_up)
        costs = costs_of_voices(self._another(detector), self._heard, **self._hearing)
        return Scored(file=replace(file, voices=costs.values() if costs else {}))

    def _fitted(self) -> contract.Detector:
        """Return a detector that was made and fitted in this process."""
        unit = self._job.unit
        detector = contract.make_detector(
            self._job.offer.spec.factory,
            seed=unit.seed,
            horizon=unit.setting.horizon,
            parameters=unit.parameters,
            baseline=self._adapting,
            roles=unit.roles,
        )
        contract.fit_detector(detector, [*self._train], self._progress, self._failures)
        self._progress(1.0)
        return detector

    def _another(self, detector: contract.Detector) -> contract.Detector:
        """Return a copy of a fitted detector, or one that is fitted like it."""
        try:
            return contract.copied(detector)
        except UsageError:
            warnings.warn(
                f"{type(detector).__name__} cannot be copied after its fit, so that it is fitted "
                "again for each group of episodes: define __getstate__ and __setstate__ to save "
                "that time",
                stacklevel=_callers_level(),
            )
            return self._fitted()

    @property
    def _adapting(self) -> int:
        """The number of baseline rows for a detector that adapts to them, else 0."""
        return self._rows if self._adapts else 0

    def _whole(self, parts: dict[str, list[contract.Scores]]) -> dict[str, list[contract.Scores]]:
        """Return scores of whole episodes, undefined in their baseline rows."""
        rows = self._rows
        if not rows:
            return parts
        # Of a detector that adapts these rows were scored, too.
        start = rows if self._adapts else 0
        return {
            part: [np.concatenate([np.full(rows, np.nan), array[start:]]) for array in arrays]
            for part, arrays in parts.items()
        }

    def _alarmed(self, scores: Sequence[object], warm_up: object) -> Iterator[Iterator[Trajectory]]:
        """Yield what is to be explained by group: episodes up to their alarm, then rows longer."""
        if not self._explains:
            return
        try:
            firsts = first_alarms(self._checked(scores, warm_up), self._job.unit.alarm)
        except (ContractError, OverflowError):
            return  # The records say so.
        self._asked = []
        for group in self._groups:
            asked = [
                (Member(part, i), later, min(first + 1 + rows, self._lengths[part][i]))
                for later, rows in enumerate(NAMED_AFTER)
                for part, i in group
                if part in firsts and (first := firsts[part][i]) is not None
            ]
            if asked:
                self._asked += asked
                yield (self._visible(self._sets[part][i])[:n] for (part, i), _, n in asked)

    def _members(self, group: Iterable[Member]) -> Iterator[Trajectory]:
        return (self._visible(self._sets[part][i]) for part, i in group)

    def _visible(self, trajectory: Trajectory) -> Trajectory:
        """Return what the detector may see: no actions, unless it declares that it uses them."""
        withheld = self._job.unit.inputs == "observations"
        judged = self._baseline.judged(trajectory) if self._baseline else trajectory
        return judged.without_actions() if withheld else judged

    def _file(
        self, scores: Sequence[object], explained: Sequence[object] | None, warm_up: object
    ) -> ScoreFile:
        """Check what came back; raise `ContractError`, or return it by part, in whole episodes."""
        parts = self._checked(scores, warm_up)
        if explained is None or not self._explains:
            return ScoreFile(self._whole(parts), {})
        asked = (
            (member, later, self._visible(self._sets[member.part][member.number])[:n], array)
            for (member, later, n), array in zip(self._asked, explained, strict=True)
        )
        return with_explanations(parts, asked, self._job.data, self._train)

    def _checked(
        self, scores: Sequence[object], warm_up: object
    ) -> dict[str, list[contract.Scores]]:
        """Return what the detector returned by part; `ContractError` for what are no scores."""
        unit = self._job.unit
        by_member = dict(zip(chain(*self._groups), scores, strict=True))
        return {
            part: [
                contract.check_scores(
                    by_member[Member(part, i)],
                    rows,
                    horizon=unit.setting.horizon,
                    warm_up=warm_up,
                    detector=unit.setting.detector,
                    where=f"{unit.environment}/{part}[{i}]",
                    baseline=self._adapting,
                )
                for i, rows in enumerate(lengths)
            ]
            for part, lengths in self._lengths.items()
        }


def _callers_level() -> int:
    """Return the `stacklevel` at which a warning names the line that has called this package."""
    frame, level = inspect.currentframe(), 0
    while frame and str(frame.f_globals.get("__name__")).startswith("oodd_eval."):
        frame, level = frame.f_back, level + 1
    return level  # this function's frame is one of them


class _Visible(TrajectorySequence):
    """The first trajectories of a set, as a detector sees them, read at every access."""

    def __init__(
        self, members: TrajectorySet, limit: int | None, view: Callable[[Trajectory], Trajectory]
    ) -> None:
        self._members, self._n, self._view = members, len(members.lengths[:limit]), view

    def __len__(self) -> int:
        return self._n

    def __iter__(self) -> Iterator[Trajectory]:
        return map(self._view, islice(self._members, self._n))

    def _one(self, i: int) -> Trajectory:
        return self._view(self._members[i])


def groups(sizes: Mapping[str, int]) -> list[list[Member]]:
    """Return the trajectories of parts, by their number, in groups of at most the twins' number.

    All have that size but the last one of calibration, where the twins do not divide it. Without
    twins test parts have sizes of their own: the smallest of these is the most, but for small ones
    `LEAST_GROUP`. So no size tells calibration from test.
    """
    tests = {n for part, n in sizes.items() if part.startswith("test/") and n}
    size = min(tests, default=1)
    if len(tests) > 1:
        size = max(size, LEAST_GROUP)
    return [
        [Member(part, i) for i in range(start, min(start + size, n))]
        for part, n in sizes.items()
        for start in range(0, n, size)
    ]


def mixed(sizes: Mapping[str, int]) -> list[list[Member]]:
    """Return the trajectories of parts, by their number, in groups that hold some of all parts.

    There are as many groups as test parts. The episodes of one test seed are in different groups,
    which are drawn at random in every run, as is the order in a group. So nothing that tells a
    group or a place in it, such as the time since the fit, says which episodes are anomalous.
    """
    random = secrets.SystemRandom()
    calibration = [Member(CALIBRATION, i) for i in range(sizes.get(CALIBRATION, 0))]
    tests = {part: n for part, n in sizes.items() if part != CALIBRATION and n}
    drawn: list[list[Member]] = [[] for _ in tests or [CALIBRATION]]
    seeds = range(max(tests.values(), default=0))
    rows = [[Member(part, i) for part, n in tests.items() if i < n] for i in seeds]
    size = len(drawn)
    rows += [calibration[i : i + size] for i in range(0, len(calibration), size)]
    for row in rows:
        for group, member in zip(random.sample(drawn, len(row)), row, strict=True):
            group.append(member)
    for group in drawn:
        random.shuffle(group)
    return [group for group in drawn if group]
