"""A detector with its alarm beside a running robot: one call for each observation."""

import copy
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import FittedStateError, UsageError
from oodd_eval.live.handle import DetectorHandle, streaming
from oodd_eval.live.reading import Reading, RunLength
from oodd_eval.live.stream import ACTION, OBSERVATION, Stream, StreamLimits
from oodd_eval.metrics.alarms import GuaranteedAlarm, Monitor, least_episodes
from oodd_eval.metrics.cusum import Standardization
from oodd_eval.plugins.contract import Detector, StorableDetector
from oodd_eval.plugins.state import load_state, save_state

KIND: Final = "watchdog/1"
FILE: Final = "watchdog.json"
DETECTOR: Final = "detector"

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Settings:
    """The arguments of `Watchdog.fit` that operation and promise need."""

    alpha: float
    confidence: float | None
    rate: float | None
    latch: bool
    hold_off: int


class Watchdog:
    """A fitted detector with a threshold, fed one observation at a time; made by `fit` or `load`.

    An alarm is raised when the statistic of the scores exceeds the threshold, or when readings are
    no measurements any more. Nothing that a sensor sends is an exception.

    Attributes
    ----------
    promise
        How rare false alarms are, in words.
    run_length
        The promised mean time between false alarms with its interval; None with an ``alpha``.
    raised
        The reading that raised the present alarm; None without one.
    """

    def __init__(
        self,
        handle: DetectorHandle,
        rule: GuaranteedAlarm,
        limits: StreamLimits,
        sensors: Sequence[str],
        settings: Settings,
        run_length: RunLength | None,
    ) -> None:
        self._handle, self.rule, self._limits, self.sensors = handle, rule, limits, list(sensors)
        self.settings, self.run_length = settings, run_length
        self._live = streaming(handle.detector)
        self._explain_last = getattr(self._live, "explain_last", None)
        self._monitor, self._stream = Monitor(rule), Stream(limits, settings.rate)
        self.reset()

    @classmethod
    def fit(
        cls,
        detector: str | Detector,
        train: Sequence[Trajectory],
        calibration: Sequence[Trajectory],
        alpha: float = 0.05,
        *,
        confidence: float | None = None,
        hours: float | None = None,
        rate: float | None = None,
        sensors: Sequence[Any] | None = None,
        latch: bool = True,
        hold_off: int = 0,
        statistic: str | None = None,
        seed: int = 0,
        horizon: int = 1,
        parameters: Mapping[str, Any] | None = None,
    ) -> Self:
        """Fit a detector on nominal episodes and find its threshold on others.

        Parameters
        ----------
        detector
            Name of an installed detector, or an unfitted one. Without ``update`` it scores the
            whole episode so far at every row, which a warning says.
        train, calibration
            Nominal episodes to fit on, and others, in an order that has nothing to do with what
            happened, for the threshold.
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
            Names, or quantities with names as those of a split; default "sensor 0" and so on.
        latch
            Whether an alarm stays until `acknowledge`, and not only as long as its cause.
        hold_off
            Rows after the end of an alarm in which no new one is raised.
        statistic
            ``"cusum"`` or ``"score"``: see `GuaranteedAlarm`. Default what a named detector
            declares, else the CUSUM.
        seed, horizon, parameters
            For the factory of a named detector.

        Returns
        -------
        Watchdog

        Raises
        ------
        UsageError
            When the calibration episodes are too few for the promise, or an argument is wrong.
        """
        handle = DetectorHandle.make(detector, statistic, seed, horizon, parameters or {})
        training, others = list(train), list(calibration)
        if rate is not None and not rate > 0:
            raise UsageError(f"rate={rate!r}, expected observations in a second, above 0")
        if hours is not None and not (hours > 0 and rate):
            raise UsageError(
                f"hours={hours!r} and rate={rate!r}: a mean time between false alarms needs both, "
                "in hours and in observations per second, above 0"
            )
        if hours is not None and confidence is not None:
            raise UsageError(
                f"hours={hours!r} and confidence={confidence!r}: a confidence is of a share of "
                "episodes, alpha; a mean time between false alarms has its interval, `run_length`"
            )
        if not (0 < alpha < 1 and (confidence is None or 0 < confidence < 1)):
            expected = "shares between 0 and 1"
            raise UsageError(f"alpha={alpha!r}, confidence={confidence!r}: expected {expected}")
        least = least_episodes(alpha, handle.alarm, confidence) if hours is None else 1
        if len(others) < least:
            raise UsageError(
                f"alpha={alpha!r} takes {least} calibration episodes, got {len(others)}: record "
                "more, or promise less"
            )
        names = [str(getattr(s, "name", s)) for s in sensors or ()]
        width = training[0].observation_dim if training else 0
        if sensors is not None and (len(names) != width or len({*names}) != width):
            raise UsageError(f"{len(names)} names of sensors {names}, expected {width}, all unlike")
        handle.detector.fit([handle.visible(x) for x in training])
        # Without a guarantee to keep exact, the limits may know what the threshold is from.
        limits = StreamLimits.fit(training if hours is None else training + others)
        score = handle.detector.score
        scores = [np.asarray(score(handle.visible(x)), np.float64) for x in others]
        run_length = None
        if hours is None:
            faulty = [limits.faulty(x) for x in others]
            # An episode with a fault alarms at any threshold. Those that standardize stay.
            scores = [
                np.array([np.inf]) if f and (handle.alarm == "score" or i % 2) else s
                for i, (f, s) in enumerate(zip(faulty, scores, strict=True))
            ]
            rule = GuaranteedAlarm.fit(scores, alpha, handle.alarm, confidence)
        else:
            cusum = Standardization.fit(scores) if handle.alarm == "cusum" else None
            unbounded = GuaranteedAlarm(cusum, math.inf)
            # One after the other: what a sum has reached at the end of one goes on in the next.
            joined = unbounded.statistic(np.concatenate(scores))
            ends = np.cumsum([len(s) for s in scores])
            largest = np.array([part.max() for part in np.split(joined, ends[:-1])])
            threshold, run_length = RunLength.fit(largest, int(ends[-1]), hours, float(rate or 0))
            rule = replace(unbounded, threshold=threshold)
        names = names or [f"sensor {d}" for d in range(width)]
        settings = Settings(alpha, confidence, rate, latch, hold_off)
        return cls(handle, rule, limits, names, settings, run_length)

    @property
    def promise(self) -> str:
        """The promise on false alarms as a sentence."""
        if (r := self.run_length) is None:
            alpha, confidence = self.settings.alpha, self.settings.confidence
            sure = f", with {100 * confidence:.3g} % confidence" if confidence else ""
            return f"at most {100 * alpha:.3g} % of nominal episodes raise an alarm{sure}"
        interval = f"95 % interval {r.low:.3g} to {r.high:.3g} h"
        beyond = "" if r.hours <= r.observed else ", by the shape of the tail"
        return (
            f"a false alarm every {r.hours:g} h on average ({interval}, from {r.observed:.3g} h of "
            f"nominal operation{beyond})"
        )

    def reset(self) -> None:
        """Begin a new episode, without an alarm."""
        self._live.reset()
        self._monitor.reset()
        self._stream.reset()
        self._t = -1
        self._causes: frozenset[str] = frozenset()
        self._known = self._causes
        self._held = 0
        self.raised: Reading | None = None

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
        observation : array of shape (D,), mapping or None
            The newest readings, or readings by sensor. NaN, infinite or absent: no reading came
            from that sensor in time; None: from none.
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
            For an array of another length, which is a mistake of the caller and no fault.
        UsageError
            For a time stamp without a rate, or one of an action alone.
        """
        rate = self.settings.rate
        if (time is not None and not rate) or (acted is not None and time is None):
            raise UsageError(
                f"time={time!r}, acted={acted!r}, rate={rate!r}: time stamps need a watchdog "
                "fitted with rate=, observations in a second, and acted needs time"
            )
        self._t += 1
        if isinstance(observation, Mapping):
            observation = [observation.get(name, math.nan) for name in self.sensors]
        row, command = self._stream.take(observation, action, time, acted)
        score = float(self._live.update(row, command if self._handle.actions else None))
        above = self._monitor.update(score)
        faults = {
            str(d): fault
            for d, fault in self._stream.faults.items()
            if d != ACTION or self._handle.actions
        }
        self._causes = frozenset(faults) | ({"statistic"} if above else set())
        self._known &= self._causes
        new = bool(self._causes - self._known) and not self._held
        self._held = max(0, self._held - 1)
        if self.raised and not self.settings.latch and not new:
            self.raised, self._held = None, self.settings.hold_off
        alarm = bool(new or self.raised)
        sensors, onset = self._blamed() if alarm else ({}, None)  # takes as long as a score
        reading = Reading(
            self._t,
            math.nan if math.isnan(score) else score,
            self._monitor.statistic,
            self.rule.threshold,
            alarm,
            sensors,
            onset,
            {self._name(d): fault for d, fault in self._stream.faults.items() if str(d) in faults},
        )
        if new and not self.raised:
            self.raised = reading
        return reading

    def _blamed(self) -> tuple[dict[str, float], int | None]:
        """Return shares by sensor and the onset: from faults where there are any."""
        if suspects := self._stream.suspects:
            # Those beyond their limit before those that are only odd.
            first = [d for d in suspects if d in self._stream.faults] or list(suspects)
            return {self._name(d): 1 / len(first) for d in first}, min(suspects.values())
        if OBSERVATION in self._stream.faults or self._explain_last is None:
            return {}, None
        shares, onset = self._explain_last()
        if onset < 0:
            return {}, None
        order = np.argsort(-shares, kind="stable").tolist()
        return {self.sensors[d]: float(shares[d]) for d in order}, int(onset)

    def _name(self, number: int | str) -> str:
        return number if isinstance(number, str) else self.sensors[number]

    def copy(self) -> Self:
        """Return a watchdog with the same fit, for another robot.

        Returns
        -------
        Watchdog
            At the beginning of an episode.
        """
        other = copy.deepcopy(self)
        other.reset()
        return other

    def save(self, directory: str | Path) -> None:
        """Write everything into a new or empty directory, as JSON and plain arrays.

        Parameters
        ----------
        directory : str or Path
            The detector's own files go into a directory ``detector`` in it.

        Raises
        ------
        UsageError
            When the detector cannot be saved, or the directory is not empty.
        """
        path = Path(directory)
        if not isinstance(self._handle.detector, StorableDetector):
            what = f"{type(self._handle.detector).__name__} has no save and load"
            raise UsageError(f"{what}: fit the watchdog anew where it is needed")
        if path.exists() and any(path.iterdir()):
            raise UsageError(f"{str(path)!r} is not empty: save into a new directory")
        (path / DETECTOR).mkdir(parents=True)
        self._handle.detector.save(path / DETECTOR)
        save_state(path, kind=KIND, settings={}, arrays=self._limits.arrays())
        nominal = self.rule.standardization
        state = {
            "made": self._handle.state,
            "sensors": self.sensors,
            "threshold": None if math.isinf(self.rule.threshold) else self.rule.threshold,
            "standardization": nominal and [nominal.mean, nominal.std],
            "run_length": self.run_length and list(astuple(self.run_length)),
            "settings": asdict(self.settings),
        }
        (path / FILE).write_text(json.dumps(state, indent=1), encoding="utf-8")

    @classmethod
    def load(cls, directory: str | Path, detector: Detector | None = None) -> Self:
        """Return the watchdog that `save` wrote.

        Parameters
        ----------
        directory : str or Path
            The directory that `save` was called with.
        detector : Detector, optional
            An instance with the parameters of the saved one, where that had no name.

        Returns
        -------
        Watchdog

        Raises
        ------
        FittedStateError
            When the files are missing or damaged.
        """
        path = Path(directory)
        limits = StreamLimits.of(load_state(path, kind=KIND, settings={}))
        try:
            state = json.loads((path / FILE).read_text(encoding="utf-8"))
            handle = DetectorHandle.from_state(state["made"], detector)
            nominal, threshold = state["standardization"], state["threshold"]
            rule = GuaranteedAlarm(
                None if nominal is None else Standardization(*map(float, nominal)),
                math.inf if threshold is None else float(threshold),
            )
            length = state["run_length"]
            run_length = None if length is None else RunLength(*map(float, length))
            names = [str(name) for name in state["sensors"]]
            settings = Settings(**state["settings"])
        except UsageError:
            raise
        except (OSError, ValueError, KeyError, TypeError) as error:
            what = f"{str(path / FILE)!r} cannot be read as a saved watchdog"
            raise FittedStateError(f"{what}: {type(error).__name__}: {error}") from None
        if not isinstance(handle.detector, StorableDetector) or len(names) != len(limits.mean):
            raise FittedStateError(f"{str(path)!r} does not fit {type(handle.detector).__name__}")
        handle.detector.load(path / DETECTOR)
        return cls(handle, rule, limits, names, settings, run_length)
