"""The oracle of Acrobot, CartPole and LunarLander, without or with noise of the sensors.

It needs no simulator: the equations are written out in `classic` and `lander`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Final, Protocol

import numpy as np
from numpy.typing import NDArray
from oodd_common.windows import StorableWindowDetector

from oodd_eval import Trajectory
from oodd_eval.errors import FittedStateError
from oodd_eval.plugins.forecasting import FeatureScale
from oodd_eval.plugins.state import Arrays, take
from oodd_worlds.classic import (
    AcrobotEquations,
    CartPoleEquations,
    Equations,
    ExtendedFilter,
    noise_of,
)
from oodd_worlds.lander import (
    CLASSES,
    PARTS,
    RELATION,
    LanderEquations,
    Ranges,
    changes,
    jitter,
    touches,
)
from oodd_worlds.oracles import WEIGHTS, WhiteCharts, judged, standards_of

Floats = NDArray[np.float64]
Row = NDArray[np.float32]

ENVIRONMENTS: Final = {(6, 3): "acrobot", (4, 2): "cartpole", (8, 4): "lunarlander"}
"""Names by the numbers of sensors and of action columns."""

EQUATIONS: Final[Mapping[str, Callable[[], Equations]]] = {
    "acrobot": AcrobotEquations,
    "cartpole": CartPoleEquations,
    "lunarlander": LanderEquations,
}

FADING: Final = 0.99
"""Share of an excess that is left after a row."""

EXACT: Final = 1e-4
"""Median change of the rate of turning of a lander without engines, in rad/s, above which its
sensors are noisy: 1e-6 by rounding, .005 with noise of 1 %."""


class JudgedEpisode(Protocol):
    """An episode that is judged row by row."""

    def update(self, row: Floats, action: Floats) -> float:
        """Return the score of a row after the action before it."""


class Judge(Protocol):
    """Noise and ranges learnt from the training part of one environment."""

    def begin(self, row: Floats) -> JudgedEpisode:
        """Return an episode after its first row."""

    def arrays(self) -> Arrays:
        """Return the fit by name."""


class FilteredEpisode:
    """Standardized charts of a filter's innovations, as those of `OracleDetector`."""

    def __init__(self, equations: Equations, noise: Floats, row: Floats) -> None:
        self._filter, self._charts = ExtendedFilter(equations, noise, row), WhiteCharts(len(row))
        self.standards: Floats | None = None

    def charts(self, row: Floats, action: Floats) -> Floats:
        """Return the charts after a row."""
        return self._charts.update(self._filter.update(row, action)[0])

    def update(self, row: Floats, action: Floats) -> float:
        """Return the largest standardized chart."""
        return float(judged(self.charts(row, action), np.asarray(self.standards)))


class FilterJudge:
    """The equations, the sensors' noise, and how large charts are in nominal episodes."""

    def __init__(self, make: Callable[[], Equations], noise: Floats, standards: Floats) -> None:
        self._make, self._noise, self._standards = make, noise, standards

    @classmethod
    def fit(cls, make: Callable[[], Equations], nominal: Sequence[Trajectory]) -> FilterJudge:
        """Take noise and standards from nominal episodes."""
        noise, charts = noise_of(make, nominal), []
        for x in nominal:
            rows = x.observations.astype(np.float64)
            episode = FilteredEpisode(make(), noise, rows[0])
            pairs = zip(rows[1:], x.actions.astype(np.float64), strict=True)
            of_rows = [episode.charts(*pair) for pair in pairs]
            charts.append(np.reshape(of_rows, (-1, 2 * len(WEIGHTS))))
        return cls(make, noise, standards_of(charts))

    def begin(self, row: Floats) -> JudgedEpisode:
        """Return an episode with a filter of its own."""
        episode = FilteredEpisode(self._make(), self._noise, row)
        episode.standards = self._standards
        return episode

    def arrays(self) -> Arrays:
        """Return noise and standards."""
        mean, spread = self._standards
        return {"noise": self._noise, "chart_mean": mean, "chart_spread": spread}

    @classmethod
    def of(cls, make: Callable[[], Equations], arrays: Arrays, sensors: int) -> FilterJudge:
        """Return the judge that `arrays` were of."""
        charts = (2 * len(WEIGHTS),)
        standards = take(arrays, "chart_mean", charts), take(arrays, "chart_spread", charts, "+")
        return cls(make, take(arrays, "noise", (sensors,), "+"), np.stack(standards))


class Flight:
    """An episode of LunarLander without noise: a filter's charts, or the ranges if these say more.

    A row that no nominal engine could have brought about is proof, which rows that one could have
    do not take back: an excess is remembered, and fades by a hundredth a row.
    """

    def __init__(self, filtered: JudgedEpisode, ranges: Ranges, row: Floats) -> None:
        self._filtered, self._ranges, self._last, self._count = filtered, ranges, row, 0
        self._touched, self._proof = False, -np.inf

    def update(self, row: Floats, action: Floats) -> float:
        """Return by how much a row has left its range most, or the largest chart."""
        pair = np.stack([self._last, row])
        of_row = changes(pair, action[None], self._count, touched=self._touched)
        self._last, self._count = row, self._count + 1
        self._touched = self._touched or bool(touches(row[None])[0])
        excess = float(self._ranges.excess(*of_row)[0])
        self._proof = max(excess, FADING * self._proof if self._proof > 0 else -np.inf)
        return max(self._proof, self._filtered.update(row, action))


class LanderJudge:
    """A filter, and the ranges of what gravity and kinematics do not tell."""

    def __init__(self, filtered: FilterJudge, ranges: Ranges) -> None:
        self._filtered, self._ranges = filtered, ranges

    def begin(self, row: Floats) -> JudgedEpisode:
        """Return an episode."""
        return Flight(self._filtered.begin(row), self._ranges, row)

    def arrays(self) -> Arrays:
        """Return both; an excess that counts for nothing has the unit 0."""
        low, high, unit, relation = self._ranges
        unit = np.where(np.isinf(unit), 0.0, unit)
        ranges = {"low": low, "high": high, "unit": unit, "relation": relation}
        return {**self._filtered.arrays(), **ranges}

    @classmethod
    def of(cls, filtered: FilterJudge, arrays: Arrays) -> LanderJudge:
        """Return the judge that `arrays` were of."""
        shape = (CLASSES, PARTS)
        low, high, unit = (take(arrays, name, shape) for name in ("low", "high", "unit"))
        unit = np.where(unit > 0, unit, np.inf)
        ranges = Ranges(low, high, unit, take(arrays, "relation", (CLASSES, RELATION)))
        return cls(filtered, ranges)


class GymOracle(StorableWindowDetector):
    """Distance of a row from what the true equations and the row's past allow.

    Acrobot and CartPole: the largest standardized chart of the innovations of an extended Kalman
    filter, whose noise is that of the sensors in training. LunarLander: the same; without noise, by
    how much the row's changes of velocity, less gravity's, leave the range that an engine's bounded
    dispersion leaves in training, or positions and angle what velocities tell, where that is more;
    it fades slowly. Higher means more anomalous; the score of the first row is NaN. Nothing is
    random.

    Parameters
    ----------
    name, seed
        See `WindowDetector`.
    horizon
        1, as equations lead from row to row.

    Raises
    ------
    NotImplementedError
        For another horizon, and by `fit` for another environment.
    """

    kind: ClassVar[str] = "oracle-gym/1"

    def __init__(self, name: str, *, seed: int, horizon: int) -> None:
        if horizon != 1:
            raise NotImplementedError(f"{name} forecasts one row, got horizon {horizon}: use 1")
        super().__init__(name, seed=seed, horizon=horizon, actions=True)

    def score(self, trajectory: Trajectory) -> Floats:
        """Return one score per observation, NaN for the first."""
        self._must_fit(trajectory)
        rows = trajectory.observations.astype(np.float64)
        episode = self._judge_.begin(rows[0])
        pairs = zip(rows[1:], trajectory.actions.astype(np.float64), strict=True)
        return np.array([np.nan, *(episode.update(*pair) for pair in pairs)])

    def reset(self) -> None:
        """Begin a new live episode."""
        super().reset()
        self._episode: JudgedEpisode | None = None

    def _row(self, observation: Row) -> Row:
        return self._scale().checked(observation)

    def _judge(self, window: Row, now: Row, t: int) -> float:
        self._episode = self._episode or self._judge_.begin(window[0].astype(np.float64))
        return self._episode.update(now.astype(np.float64), self._commands[0].astype(np.float64))

    def _learn(self, nominal: Sequence[Trajectory]) -> FeatureScale:
        scale = FeatureScale.fit(nominal)
        widths = sorted({self._widths(x) for x in nominal})
        if len(widths) != 1 or widths[0] not in ENVIRONMENTS:
            known = ", ".join(f"{name} {shape}" for shape, name in ENVIRONMENTS.items())
            raise NotImplementedError(
                f"{self.name} has the equations of {known}, and got trajectories of (sensors, "
                f"action columns) {widths}: run it with --env {','.join(ENVIRONMENTS.values())}"
            )
        self._take(widths[0])
        name = ENVIRONMENTS[widths[0]]
        self._judge_: FilterJudge | LanderJudge
        self._judge_ = filtered = FilterJudge.fit(EQUATIONS[name], nominal)
        if name == "lunarlander" and jitter(nominal) < EXACT:
            self._judge_ = LanderJudge(filtered, Ranges.fit(nominal))
        return scale

    def _take(self, widths: tuple[int, int]) -> None:
        self.action_scale_ = FeatureScale(np.zeros(widths[1]), np.ones(widths[1]))

    def _fitted_with(self) -> dict[str, Any]:
        return {}

    def _arrays(self) -> Arrays:
        return {"actions": np.array(len(self.action_scale_.mean)), **self._judge_.arrays()}

    def _restore(self, arrays: Arrays, sensors: int) -> None:
        widths = sensors, int(take(arrays, "actions", (), "i"))
        if widths not in ENVIRONMENTS:
            raise FittedStateError(
                f"a fit of {self.name} has (sensors, action columns) {widths}, expected one of "
                f"{sorted(ENVIRONMENTS)}: fit again"
            )
        name = ENVIRONMENTS[widths]
        self._judge_ = filtered = FilterJudge.of(EQUATIONS[name], arrays, sensors)
        if name == "lunarlander" and "relation" in arrays:
            self._judge_ = LanderJudge.of(filtered, arrays)
        self._take(widths)
