"""A detector with its alarm beside a running robot: one call for each observation."""

import itertools
import math
import warnings
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oodd_eval.arrays import as_numbers
from oodd_eval.data.parts import EnvironmentData
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import (
    FittedStateError,
    OoddError,
    PromiseWarning,
    TrajectoryError,
    UsageError,
)
from oodd_eval.metrics.alarms import (
    RECORDED,
    AlarmKind,
    Calibration,
    GuaranteedAlarm,
    joined,
    least_episodes,
    too_few,
)
from oodd_eval.metrics.cusum import Standardization
from oodd_eval.metrics.faults import KINDS, ParetoTail, StreamScale, readings
from oodd_eval.names import check_known, counted
from oodd_eval.plugins.contract import AnyDetector, StorableDetector, copied
from oodd_eval.plugins.explanations import Explanation, checked_naming, naming_of
from oodd_eval.plugins.state import pack, read_state, take, write_state
from oodd_eval.plugins.voices import VoiceCosts, costs_of_voices
from oodd_live.handle import DetectorHandle, columns_of, has_actions, streaming
from oodd_live.nominal import Episode, Nominal, NominalData
from oodd_live.reading import EpisodeAlarm, Reading, RunLength
from oodd_live.scores import ScoreMonitor, ScoreStream, longest_gap
from oodd_live.stream import OBSERVATION, Stream

KIND: Final = "watchdog/4"

CALIBRATED: Final = ("episodes", "rolling", "recordings", "recording_count")
"""Facts of a calibration that a file has as they are."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Settings:
    """The arguments of `Watchdog.fit` that operation and promise need, or facts of a score.

    Of a score's statistic these are `smoothing` and `hold`, see `ScoreMonitor`, and the longest gap
    between scores in healthy episodes; None for a detector's.
    """

    alpha: float
    confidence: float | None
    rate: float | None
    latch: bool
    hold_off: int
    smoothing: float | None = None
    hold: int = 1
    longest_gap: int | None = None


class Watchdog:
    """A fitted detector with a threshold, fed one observation at a time.

    It is made by `fit`, by `of_scores` for the scores of a monitor, or by `load`.

    An alarm is raised when the statistic exceeds the threshold: that of the scores, or the one that
    is as rare as the faults of the sensors. Nothing that a sensor sends is an exception.

    Attributes
    ----------
    promise
        How rare false alarms are, in words.
    notes
        What was found out about the promise, in sentences: drift, whether calibration is like what
        is judged, a voice of the detector that costs the alarm more than a little.
    run_length
        The promised mean time between false alarms with its interval; None with an ``alpha``.
    voices
        What the detector's voices find alone and together, on faults injected into calibration
        episodes (`oodd_eval.plugins.voices.VoiceCosts`); None where it has none, without an
        ``alpha``, and of a loaded watchdog, whose notes are kept.
    calibration
        What the threshold is from, with the episodes that joined it; None without an ``alpha``.
    raised
        The reading that raised the present alarm; None without one.
    """

    def __init__(
        self,
        handle: DetectorHandle,
        calibration: Calibration | None,
        rule: GuaranteedAlarm,
        tail: ParetoTail,
        stream: StreamScale | None,
        rest: Floats,
        nominal: Nominal,
        settings: Settings,
        run_length: RunLength | None,
        notes: Sequence[str] = (),
    ) -> None:
        self._handle, self.calibration, self.rule = handle, calibration, rule
        self._tail, self._scale, self._rest = tail, stream, rest
        self._nominal, self.sensors = nominal, list(nominal.sensors)
        self.settings, self.run_length, self.notes = settings, run_length, list(notes)
        self.voices: VoiceCosts | None = None
        self._live = streaming(handle.detector)
        self._explain_last = getattr(self._live, "explain_last", None)
        # Actuators that the detector sees: by number without names, or with those of sensors.
        names = enumerate(nominal.actions or [""] * len(rest))
        actuators = [n if n not in {"", *self.sensors} else f"actuator {j}" for j, n in names]
        self._parts = [*self.sensors, *actuators] if handle.actions else self.sensors
        commands = rest if handle.actions else ()
        self._stream: Any = ScoreStream(settings.longest_gap or 0)
        if stream is not None:
            self._stream = Stream(stream, commands, settings.rate, nominal.baseline)
        # Rows at the start that are not judged, and rows that the detector is not shown.
        self._rows = nominal.baseline.rows if nominal.baseline else 0
        self._hidden = 0 if handle.adapts else self._rows
        self.reset()

    @classmethod
    def fit(
        cls,
        detector: AnyDetector,
        train: EnvironmentData | Sequence[Episode],
        calibration: Sequence[Episode] | None = None,
        alpha: float = 0.05,
        *,
        confidence: float | None = None,
        hours: float | None = None,
        rate: float | None = None,
        sensors: Sequence[Any] | None = None,
        baseline: int | None = None,
        offsets: Sequence[float] | None = None,
        recordings: Sequence[Hashable] | None = None,
        failures: Sequence[Episode] | None = None,
        latch: bool = True,
        hold_off: int = 0,
        statistic: str | None = None,
        seed: int = 0,
        horizon: int = 1,
        parameters: Mapping[str, Any] | None = None,
    ) -> Self:
        """Fit a detector on nominal episodes and find its threshold on others.

        What puts the promise in doubt is also raised as a `PromiseWarning`.

        Parameters
        ----------
        detector
            Name of an installed detector, a class or function that makes one, or an unfitted one.
            ``"panel"`` is `panel-a` where training episodes have actions, which `update` is then
            handed, too; ``parameters={"actions": "no"}`` leaves them out. Without ``update`` a
            detector scores the whole episode so far at every row, which a warning says.
            ``"column:NAME"`` and others that name columns are handed these alone, which are the
            watchdog's `sensors` then; of what happens to a recorded number only gaps are faults.
        train, calibration
            Nominal episodes to fit on, and others for the threshold, both in the order in which
            they were recorded: `Trajectory` objects, observations of shape (T + 1, D), or tuples of
            observations and actions (T, A). Or an environment of a split alone, which knows its
            episodes, sensors, offsets, baseline rows and rate.
        alpha
            Largest share of nominal episodes with an alarm.
        confidence
            Chance that this calibration keeps the promise, such as 0.9. By default it is kept on
            average over calibrations: in half of them somewhat more episodes alarm.
        hours
            For operation without end, in place of alpha: mean time between false alarms.
        rate
            Observations in a second; needed for `hours`, and for time stamps in `update`.
        sensors
            Names, or quantities with names and roles as those of a split; default "sensor 0" and so
            on.
        baseline
            Number of rows at the start of every episode that are nominal. They are not judged, and
            each sensor's mean and spread over them are brought to training's.
        offsets
            Subtracted from the sensors in float64, which a `Trajectory` has behind it already. By
            default what arrays of float64 need, so that float32 can tell their spread.
        recordings
            For each calibration episode the recording that it is a window of, such as its file; an
            environment of a split knows them. Windows of one recording count once, and too few
            recordings promise nothing.
        failures
            Failed episodes, for a detector that learns from them; an environment of a split may
            have some.
        latch
            Whether an alarm stays until `acknowledge`, and not only as long as its cause.
        hold_off
            Rows after the end of an alarm in which no new one is raised.
        statistic
            ``"cusum"`` or ``"score"``: see `GuaranteedAlarm`. Default what a named detector
            declares, else the CUSUM.
        seed, horizon, parameters
            For the factory of a named detector, or for the class or function.

        Returns
        -------
        Watchdog

        Raises
        ------
        UsageError
            When the calibration episodes are too few for the promise, or an argument is wrong.
        """
        if rate is not None and not rate > 0:
            raise UsageError(f"rate={rate!r}, expected observations in a second, above 0")
        data = NominalData.of(
            train,
            calibration,
            sensors=sensors,
            offsets=offsets,
            baseline=baseline,
            rate=rate,
            recordings=recordings,
            failures=failures,
            columns=columns_of(detector),
        )
        nominal = data.nominal
        rows = nominal.baseline.rows if nominal.baseline else 0
        how = statistic, seed, horizon, parameters or {}, rows, nominal.roles
        handle = DetectorHandle.make(detector, *how, actions=has_actions(data.train))
        settings = Settings(alpha, confidence, data.rate, latch, hold_off)
        if hours is not None:
            _check_hours(hours, settings, handle.alarm)
        training, calibrating = data.train, data.calibration
        _check_promise(len(calibrating), settings, handle.alarm, hours)
        supervised = failures or handle.supervised
        handle.fit(training, nominal.baseline, data.failures if supervised else ())
        stream = StreamScale.of_episodes(training, calibrating, nominal.baseline)
        if handle.alarm in RECORDED:
            # A monitor's number may stand still or go far: that is what it says.
            others, tails = np.array(KINDS) != "missing", stream.tails
            tails = tails._replace(start=np.where(others, math.inf, tails.start))
            per_unit = np.where(others[:-1, None], 0.0, stream.per_unit)
            stream = replace(stream, per_unit=per_unit, tails=tails)
        rest = np.concatenate([x.actions for x in training]).mean(axis=0, dtype=np.float64)
        faults = [
            stream.without(i).surprise(*readings(x, nominal.baseline))
            for i, x in enumerate(calibrating)
        ]
        scores = [handle.scores(x, nominal.baseline) for x in calibrating]
        findings = data.findings()
        notes = [finding.text for finding in findings]
        for finding in findings:
            if finding.doubt:
                warnings.warn(finding.text, PromiseWarning, stacklevel=2)
        if hours is None:
            largest = [float(surprise.max()) for surprise in faults]
            fitted = Calibration.fit(scores, handle.alarm, data.recordings, largest)
            if text := fitted.no_promise(alpha, confidence):
                warnings.warn(text, PromiseWarning, stacklevel=2)
                notes.insert(0, text)
            rule = fitted.rule(alpha, confidence)
            tail = fitted.tail or ParetoTail.fit(fitted.largest)
            if handle.alarm == "flag":  # so that one that is missing alarms where none was up
                tail = ParetoTail.fit(fitted.largest, 1.0)
            watchdog = cls(handle, fitted, rule, tail, stream, rest, nominal, settings, None, notes)
            visible = (handle.visible(x, nominal.baseline) for x in calibrating)
            start = rows if handle.adapts else 0
            watchdog.voices = costs_of_voices(handle.detector, visible, alpha, handle.alarm, start)
            watchdog.notes += filter(None, [str(watchdog.voices or "")])
            return watchdog
        rate = settings.rate or 0.0
        rule, tail, length = _with_run_length(scores, faults, handle.alarm, hours, rate)
        return cls(handle, None, rule, tail, stream, rest, nominal, settings, length, notes)

    @classmethod
    def of_scores(
        cls,
        calibration: Any,
        alpha: float | None = None,
        *,
        confidence: float | None = None,
        latch: bool = True,
        hold_off: int = 0,
    ) -> Self:
        """Watch the scores that a monitor computes: no detector is needed.

        `update` takes one number a row, NaN or None where there is none. A gap that is longer than
        any in the calibration is a fault that alarms, too.

        Parameters
        ----------
        calibration : ScoreCalibration, or sequence of arrays of shape (T + 1,)
            Of `oodd_eval.calibrate`, whose statistic, smoothing and hold apply; or the scores of
            healthy episodes in recorded order, NaN where there is none.
        alpha
            Largest share of nominal episodes whose scores raise an alarm; default the level of the
            calibration, 0.05 for arrays.
        confidence, latch, hold_off
            As for `fit`.

        Returns
        -------
        Watchdog

        Raises
        ------
        UsageError
            When the episodes are too few for the promise, or an argument is wrong.

        Examples
        --------
        >>> healthy = [[0.1, peak, 0.2] for peak in range(1, 20)]
        >>> watchdog = Watchdog.of_scores(healthy)
        >>> watchdog.promise
        'at most 5 % of nominal episodes raise an alarm by their scores, and at most 1 of 20 by a \
gap of more than 0 rows without one'
        >>> print(watchdog.update(19.0), watchdog.update(19.5), sep="; ")
        row 0: nominal; row 1: alarm
        """
        if hasattr(calibration, "longest_gap"):
            fitted, level = calibration.calibration, calibration.level
            facts = calibration.smoothing, calibration.hold, calibration.longest_gap
        else:
            scores = [as_numbers(x, f"episode {i}: ") for i, x in enumerate(calibration)]
            for i, x in enumerate(scores):
                if x.ndim != 1 or np.isnan(x).all():
                    expected = "expected a number a row, one at least"
                    raise UsageError(f"episode {i} has scores of shape {x.shape}, {expected}")
            fitted, level = Calibration.fit(scores, "column"), 0.05
            facts = None, 1, max(map(longest_gap, scores), default=0)
        alpha = level if alpha is None else alpha
        settings = Settings(alpha, confidence, None, latch, hold_off, *facts)
        _check_promise(fitted.episodes, settings, fitted.kind)
        statistic = "cusum" if fitted.kind == "cusum" else None
        handle = DetectorHandle.make("column:score", statistic, 0, 1, {})
        if problem := fitted.no_promise(alpha, confidence):
            warnings.warn(problem, PromiseWarning, stacklevel=2)
        notes = [*filter(None, [problem]), *getattr(calibration, "notes", ())]
        tail, nominal = ParetoTail.fit(fitted.largest), Nominal(["score"], np.zeros(1), None)
        parts = tail, None, np.zeros(0), nominal, settings, None, notes
        return cls(handle, fitted, fitted.rule(alpha, confidence), *parts)

    @property
    def promise(self) -> str:
        """The promise on false alarms as a sentence."""
        if (r := self.run_length) is None:
            alpha, confidence = self.settings.alpha, self.settings.confidence
            if self.calibration and (text := self.calibration.no_promise(alpha, confidence)):
                return text
            sure = f", with {100 * confidence:.3g} % confidence" if confidence else ""
            text = f"at most {100 * alpha:.3g} % of nominal episodes raise an alarm{sure}"
            if self.calibration and (gap := self.settings.longest_gap) is not None:
                text += f" by their scores, and at most 1 of {self.calibration.recording_count + 1}"
                text += f" by a gap of more than {gap} rows without one"
            return text
        interval = f"95 % interval {r.low:.3g} to {r.high:.3g} h"
        beyond = "" if r.hours <= r.observed else ", by the shape of the tail"
        return (
            f"a false alarm every {r.hours:g} h on average ({interval}, from {r.observed:.3g} h of "
            f"nominal operation{beyond})"
        )

    def __repr__(self) -> str:
        """Return the detector, the sensors and the promise in a line."""
        detector = self._handle.state["name"] or type(self._handle.detector).__name__
        sensors = counted(len(self.sensors), "sensor(s)")
        return f"Watchdog({detector}, {sensors}: {self.promise})"

    def reset(self) -> None:
        """Begin a new episode, without an alarm."""
        self._live.reset()
        how = self.settings.smoothing, self.settings.hold
        self._monitor, self._whole = (ScoreMonitor(self.rule, *how) for _ in range(2))
        self._stream.reset()
        self._t = -1
        self._largest = -math.inf
        self._causes: frozenset[str] = frozenset()
        self._faults: dict[int | str, str] = {}
        self._known = self._causes
        self._held = 0
        self.raised: Reading | None = None

    def confirm(self) -> None:
        """Let the episode that has just ended join the calibration, since it was nominal.

        The threshold is then that of a rolling calibration, in which an episode counts .95 to the
        power of its age, and a new episode begins, as by `reset`. For machines that drift slowly.

        Raises
        ------
        UsageError
            Where no statistic could exceed the new threshold, for operation without end or with a
            confidence, or before the first row; then nothing changes.
        """
        if self.calibration is None or self.settings.confidence is not None:
            raise UsageError(
                f"a rolling calibration keeps alpha on average, but this watchdog promises "
                f"{self.promise}: fit it with alpha alone"
            )
        if self._t < self._rows:
            raise UsageError(
                f"there were {self._t + 1} rows since the last reset, expected more than "
                f"{self._rows}: confirm an episode at its end, before reset"
            )
        joined = self.calibration.joined(self._largest)
        self.rule, self.calibration = joined.rule(self.settings.alpha), joined
        if self._scale is None:
            self._stream.most = max(self._stream.most, self._stream.longest)
            self.settings = replace(self.settings, longest_gap=self._stream.most)
        self.reset()

    def acknowledge(self) -> None:
        """Take note of the alarm: it ends, and what caused it raises no other until it was gone.

        A sum of scores starts again.
        """
        self.raised = None
        self._known, self._held = self._causes, self.settings.hold_off
        if self.rule.standardization is not None:
            self._monitor.reset()

    def update(
        self,
        observation: ArrayLike | Mapping[str, float] | None,
        action: ArrayLike | None = None,
        time: float | None = None,
        acted: float | None = None,
    ) -> Reading:
        """Judge the next row.

        Parameters
        ----------
        observation : array of shape (D,), mapping, number or None
            The newest readings as the sensors send them, or readings by sensor. Offsets of the
            split are subtracted; `replay` takes its episodes, of which they are already. NaN,
            infinite, masked or absent: no reading came from that sensor in time; None: from none.
            The score, of a watchdog of scores.
        action : array of shape (A,), optional
            Commanded since the row before; None at the first row.
        time, acted
            Time stamps of the two, in seconds of one clock; they need a `rate`. Observations that
            do not come one interval after the other are a fault, and so are older actions.

        Returns
        -------
        Reading

        Raises
        ------
        TrajectoryError
            For an array of another length, or without numbers: a mistake of the caller, no fault.
        UsageError
            For a time stamp without a rate, or one of an action alone, and for a reading of a
            sensor that is none of `sensors`.
        """
        rate = self.settings.rate
        if (time is not None and not rate) or (acted is not None and time is None):
            raise UsageError(
                f"time={time!r}, acted={acted!r}, rate={rate!r}: time stamps need a watchdog "
                "fitted with rate=, observations in a second, and acted needs time"
            )
        if isinstance(observation, Mapping):
            check_known("sensor", self.sensors, *observation)
            observation = [observation.get(name, math.nan) for name in self.sensors]
        return self._judged(self._measured(observation), action, time, acted)

    def replay(self, episode: Trajectory) -> list[Reading]:
        """Judge a recorded episode of a split from its first row on.

        Parameters
        ----------
        episode
            Observations of shape (T + 1, D) as a split has them: its offsets are subtracted.

        Returns
        -------
        list of Reading
            One for each observation. The watchdog is at the end of the episode then.

        Raises
        ------
        TrajectoryError
            For what is no `Trajectory`.
        """
        if not isinstance(episode, Trajectory):
            raise TrajectoryError(
                f"the episode is a {type(episode).__name__}, expected a Trajectory, such as "
                "Trajectory(observations - offsets, actions)"
            )
        self.reset()
        rows = zip(episode.observations, [None, *episode.actions], strict=True)
        return [self._judged(row, action, None, None) for row, action in rows]

    def explain(self, episode: Trajectory) -> list[EpisodeAlarm]:
        """Return where a recorded episode alarms, which sensors are at fault, and since when.

        An alarm lasts as long as its cause here, whatever `latch` says. A copy of the watchdog
        judges, so that this one stays in the episode that it is in.

        Parameters
        ----------
        episode
            As for `replay`.

        Returns
        -------
        list of EpisodeAlarm
            In the order of their rows; empty where nothing alarms.

        Raises
        ------
        TrajectoryError
            For what is no `Trajectory`.
        UsageError
            When the detector has what cannot be copied.
        """
        twin = self.copy()
        twin.settings = replace(self.settings, latch=False)
        alarms = []
        for alarmed, group in itertools.groupby(
            twin.replay(episode), lambda reading: reading.alarm
        ):
            if alarmed:
                first, *rest = group
                last = rest[-1].t if rest else first.t
                blame = first.onset, first.sensors, first.faults, first.parts, first.kind
                alarms.append(EpisodeAlarm(first.t, last, *blame))
        return alarms

    def _judged(
        self,
        observation: ArrayLike | None,
        action: ArrayLike | None,
        time: float | None,
        acted: float | None,
    ) -> Reading:
        """Judge the next row, from which offsets are subtracted."""
        self._t += 1
        row, command = self._stream.take(observation, action, time, acted)
        score = math.nan
        if self._t >= self._hidden:
            shift = None if self._handle.adapts else self._stream.shift
            visible = row if shift is None else shift(row)
            first = self._t == self._hidden
            command = None if first or not self._handle.actions else command
            # Scores need no detector.
            score = float(self._live.update(visible, command) if self._scale else row[0])
        if self._t < self._rows:
            score = math.nan
        above = self._monitor.update(score)
        self._whole.update(score)
        value = -math.inf
        if self._stream.surprise:
            value = float(self._tail.value(self._stream.surprise))
        if math.isfinite(self._stream.surprise):
            self._largest = max(self._largest, self._whole.statistic, value)
        self._faults = {}
        if value > self.rule.threshold:
            self._faults = self._stream.faults(self._tail, self.rule.threshold)
        self._causes = frozenset(map(str, self._faults)) | ({"statistic"} if above else set())
        self._known &= self._causes
        new = bool(self._causes - self._known) and not self._held
        self._held = max(0, self._held - 1)
        if self.raised and not self.settings.latch and not new:
            self.raised, self._held = None, self.settings.hold_off
        alarm = bool(new or self.raised)
        # It takes as long as a score.
        sensors, onset, parts, kind = self._blamed() if alarm else ({}, None, {}, "")
        score = math.nan if math.isnan(score) else score
        statistic = max(self._monitor.statistic, value)
        faults = {self._name(d): fault for d, fault in self._faults.items()}
        judged = self._t, score, statistic, self.rule.threshold, alarm
        reading = Reading(*judged, sensors, onset, faults, parts, kind)
        if new and not self.raised:
            self.raised = reading
        return reading

    def _measured(self, observation: ArrayLike | None) -> ArrayLike | None:
        """Return readings without offsets, in float64; of another length as they are."""
        if observation is None or not self._nominal.offsets.any():
            return observation
        row = as_numbers(observation)
        return row - self._nominal.offsets if row.shape == self._nominal.offsets.shape else row

    def _blamed(self) -> tuple[dict[str, float], int | None, dict[str, float], str]:
        """Return shares, onset, parts and kind: from faults where there are any."""
        # Those that raise an alarm before those that are only odd.
        faulty = [d for d in self._faults if isinstance(d, int)] or self._stream.suspects
        if faulty:
            onset = int(self._stream.since[faulty].min())
            names = [self._name(d) for d in faulty]
            parts = dict.fromkeys(names, 1.0)
            return dict.fromkeys(names, 1 / len(faulty)), onset, parts, "sensor"
        if OBSERVATION in self._faults or self._explain_last is None:
            return {}, None, {}, ""
        shares, onset, *naming = self._explain_last()
        if onset < 0:
            return {}, None, {}, ""
        widths = len(self.sensors), len(self._parts) - len(self.sensors)
        checked = [checked_naming(n, *widths) for n in naming if n is not None]
        named = naming_of(Explanation(shares[None], np.array([onset]), *checked), widths[1])
        order = np.argsort(-shares, kind="stable").tolist()
        sensors = {self.sensors[d]: float(shares[d]) for d in order}
        values = np.concatenate([named.sensors, named.actuators]).tolist()
        probabilities = sensors | dict(zip(self._parts, values, strict=True))
        likely = sorted(probabilities.items(), key=lambda part: -part[1])
        parts = {name: p for name, p in likely if p > 0}
        return sensors, int(onset) + self._hidden, parts, named.kind

    def _name(self, number: int | str) -> str:
        return number if isinstance(number, str) else self.sensors[number]

    def copy(self) -> Self:
        """Return a watchdog with the same fit, for another robot.

        Returns
        -------
        Watchdog
            At the beginning of an episode.

        Raises
        ------
        UsageError
            When the detector has what cannot be copied, such as a lock.
        """
        twin = copied(self, self._handle.detector)
        twin.reset()
        return twin

    def save(self, path: str | Path) -> None:
        """Write everything into one file, which is whole or absent.

        Parameters
        ----------
        path : str or Path
            Such as ``arm.npz``; a file of that name is replaced.

        Raises
        ------
        UsageError
            When the detector cannot hand over its fit.
        OutputError
            When the file cannot be written.
        """
        detector = self._handle.detector
        if not isinstance(detector, StorableDetector):
            problem = f"{type(detector).__name__} has no state and restore"
            raise UsageError(f"{problem}: fit the watchdog anew where it is needed")
        scale, calibration = self.rule.standardization, self.calibration
        values = {
            "made": self._handle.state,
            "sensors": self.sensors,
            "actions": self._nominal.actions,
            "threshold": self.rule.threshold,
            "standardization": scale and scale.numbers,
            "calibration": calibration
            and {
                **{name: getattr(calibration, name) for name in CALIBRATED},
                # JSON has no infinities, of which there are two: as texts.
                "largest": [x if math.isfinite(x) else str(x) for x in calibration.largest],
            },
            "tail": list(self._tail),
            "run_length": self.run_length and list(astuple(self.run_length)),
            "settings": asdict(self.settings),
            "notes": self.notes,
        }
        state = {
            "kind": KIND,
            "watchdog": values,
            **(self._scale.arrays() if self._scale else {}),
            "rest": self._rest,
            **self._nominal.arrays(),
            **self._handle.fitted(),
        }
        write_state(Path(path), pack(state, "the watchdog"))

    @classmethod
    def load(cls, path: str | Path, detector: AnyDetector | None = None) -> Self:
        """Return the watchdog that `save` wrote.

        Parameters
        ----------
        path : str or Path
            The file that `save` was called with.
        detector : Detector, class or function, optional
            An instance with the parameters of the saved one, or what makes it, where that had no
            name.

        Returns
        -------
        Watchdog

        Raises
        ------
        FittedStateError
            When the file is missing, damaged, or of an earlier version.
        """
        message = f"{str(path)!r} cannot be read as a saved watchdog"
        state = read_state(Path(path)).state()
        if (kind := str(state.get("kind"))) != KIND:
            raise FittedStateError(f"{message}: it is {kind:.40}, expected {KIND}: fit it anew")
        try:
            return cls._of(state, detector)
        except OoddError:
            raise
        except Exception as error:  # the file may hold anything where values are expected
            problem = f"{type(error).__name__}: {error}"
            raise FittedStateError(f"{message}: {problem:.500}; fit it anew") from error

    @classmethod
    def _of(cls, state: Mapping[str, Any], detector: AnyDetector | None) -> Self:
        """Return the watchdog that all this was written of."""
        values = state["watchdog"]
        settings = Settings(**_numbers(values["settings"]))
        stream = StreamScale.of(state) if settings.longest_gap is None else None
        tail = ParetoTail(*map(_finite, values["tail"]))
        rest = take(state, "rest", (None,))
        handle = DetectorHandle.from_state(values["made"], detector)
        names = [str(name) for name in values["sensors"]]
        width = len(stream.limits.mean) if stream else 1
        if not isinstance(handle.detector, StorableDetector) or len(names) != width:
            raise FittedStateError(f"it does not fit {type(handle.detector).__name__}")
        nominal = Nominal.of(state, names, int(values["made"]["baseline"]))
        nominal = replace(nominal, actions=tuple(map(str, values.get("actions", ()))))
        scale, facts, length = (values[n] for n in ("standardization", "calibration", "run_length"))
        standardization = scale and Standardization(*map(_finite, scale))
        calibration = facts and Calibration(
            handle.alarm,
            standardization,
            largest=tuple(map(float, facts.pop("largest"))),
            recordings=tuple(map(int, facts.pop("recordings"))),
            tail=tail,
            **_numbers(facts),
        )
        rule = GuaranteedAlarm(standardization, _finite(values["threshold"]))
        length = length and RunLength(*map(_finite, length))
        handle.restore(state)
        notes = [str(note) for note in values["notes"]]
        return cls(handle, calibration, rule, tail, stream, rest, nominal, settings, length, notes)


def _finite(value: float) -> float:
    """Return a finite number as one; `ValueError` for another, which no threshold can be."""
    if not math.isfinite(value):
        raise ValueError(f"{value} among what has to be finite")
    return float(value)


def _numbers(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values of a file by name: each None, or a finite number of its type."""
    return {n: v if v is None else type(v)(_finite(v)) for n, v in values.items()}


def _check_hours(hours: float, settings: Settings, kind: AlarmKind) -> None:
    """Raise `UsageError` unless a mean time between false alarms can be promised."""
    if kind == "flag":
        raise UsageError(f"hours={hours!r}: a flag is an alarm already, expected none")
    if not (hours > 0 and settings.rate):
        raise UsageError(
            f"hours={hours!r} and rate={settings.rate!r}: a mean time between false alarms needs "
            "both, in hours and in observations per second, above 0"
        )
    if settings.confidence is not None:
        raise UsageError(
            f"hours={hours!r} and confidence={settings.confidence!r}: a confidence is of a share "
            "of episodes, alpha; a mean time between false alarms has its interval, `run_length`"
        )


def _check_promise(
    episodes: int, settings: Settings, kind: AlarmKind, hours: float | None = None
) -> None:
    """Raise `UsageError` unless alpha and confidence are shares that there are episodes for."""
    alpha, confidence = settings.alpha, settings.confidence
    if not (0 < alpha < 1 and (confidence is None or 0 < confidence < 1)):
        expected = "shares between 0 and 1"
        raise UsageError(f"alpha={alpha!r}, confidence={confidence!r}: expected {expected}")
    least = 1 if hours is not None or kind == "flag" else least_episodes(alpha, kind, confidence)
    if episodes < least:
        raise UsageError(too_few(f"alpha={alpha!r}", episodes, alpha, kind, confidence))


def _with_run_length(
    scores: Sequence[Floats], faults: Sequence[Floats], kind: AlarmKind, hours: float, rate: float
) -> tuple[GuaranteedAlarm, ParetoTail, RunLength]:
    """Return the alarm that is false once in so many hours on average, and its run length."""
    standardization = Standardization.fit(scores) if kind == "cusum" else None
    unbounded = GuaranteedAlarm(standardization, math.inf)
    ends = np.cumsum([len(s) for s in scores])

    def largest(rows: Floats) -> Floats:
        return np.array([part.max() for part in np.split(rows, ends[:-1])])

    # One after the other: what a sum has reached at the end of one goes on in the next.
    statistic = unbounded.statistic(np.concatenate(scores))
    tail = ParetoTail.fit(largest(statistic))
    joint = joined(statistic, tail.value(np.concatenate(faults)))
    threshold, run_length = RunLength.fit(largest(joint), int(ends[-1]), hours, rate)
    return replace(unbounded, threshold=threshold), tail, run_length
