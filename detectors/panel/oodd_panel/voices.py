"""Voices of the panel beside its members: statistics of rows with a scale of their own.

A voice is a small detector. What it says is brought to units of its own largest value in a nominal
episode, since alarms are about episodes: one whose tail is heavy sets no threshold for the others.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Final, Self

import numpy as np
from numpy.typing import NDArray
from oodd_common.charts import Floats
from oodd_pe import make_pe

from oodd_eval import Trajectory
from oodd_eval.errors import MissingExtraError
from oodd_eval.plugins.state import Arrays, State, take

if TYPE_CHECKING:
    from oodd_panel.detector import PanelDetector

MEMBERS_VOICE: Final = "members"
"""Name of the voice of the linear members, to whose scale the others are brought."""
TAIL: Final = 0.05
"""Share of the largest nominal values, in which their tail is fitted."""
KNOTS: Final = np.linspace(0.0, 1.0 - TAIL, 191)
"""Shares of nominal values between which values are interpolated."""
SHAPES: Final = np.linspace(0.0, 1.0, 11)
"""Shapes of a tail that are tried."""
SCALES: Final = np.geomspace(0.1, 2.0, 40)
"""Scales of a tail that are tried, relative to the mean excess."""
LEAST_SCALE: Final = 0.02
"""Least scale of a tail, relative to where it begins."""
UNLIMITED: Final = 1e300
"""Limit of surprises that have none."""
SMALLEST: Final = 1e-9
"""Statistics below this are none."""
MEMBERS_WEIGHT: Final = 0.45
"""Weight of the members beside other voices.

They add little where these have something to say, and an episode in which they are loud costs all.
"""
FEWEST: Final = 5
"""Episodes below which stretches of rows stand for them."""
CHARTS: Final = "charts"
"""Name of the voice that looks for changes of an episode's constants."""
ENSEMBLE_EPISODES: Final = 20
"""Least episodes from which the ensemble is fitted: it judges by what an episode may show."""
ENSEMBLE_ROWS: Final = 2500
"""Least transitions from which it is fitted."""
ENSEMBLE_ERROR: Final = 0.3
"""Largest geometric mean of the linear errors, in training standard deviations, with which it is.

More is noise of sensors, or causes that no sensor shows: most logs of machines have .5 to .9,
simulators up to .18, and networks then forecast no better. CartPole without its commands has .03:
speeds are not forecast, and places are from them.
"""


ENSEMBLE_GAIN: Final = 0.25
"""Least gain in the log density of held-out readings over normal errors of the linear forecast.

Simulators gain 1.4 to 4 nats, Hopper with 1 % of noise .5, the temperature of a machine .06.
"""


class VoiceScale:
    """Surprise of a statistic, in units of its usual largest value in a nominal episode.

    Surprise is minus the logarithm of the share of nominal rows with as large a statistic, which
    beyond the upper twentieth has a generalized Pareto tail (Pickands 1975). Few episodes with far
    larger values make the tail heavy, so that these values are then no great surprise. `unit_` is
    the mean of the largest surprises of episodes, plus their standard deviation.
    """

    def fit(self, episodes: Sequence[Floats]) -> Self:
        """Learn from rows of nominal episodes, (N,) each, that the statistic was not fitted on."""
        values = np.concatenate(episodes)
        self.knots_ = np.quantile(values, KNOTS)
        start = float(self.knots_[-1])
        excess = values[values > start] - start
        least = max(LEAST_SCALE * abs(start), SMALLEST)
        shape, scale = _pareto(excess) if len(excess) else (0.0, least)
        self.tail_ = np.array([shape, max(scale, least)])
        if len(episodes) < FEWEST:
            episodes = np.array_split(values, min(FEWEST, len(values)))
        largest = [float(self.surprise(rows).max()) for rows in episodes]
        self.unit_ = np.array(max(np.mean(largest) + np.std(largest), SMALLEST))
        self.factor_, self.limit_ = np.ones(()), np.array(UNLIMITED)
        return self

    def surprise(self, values: Floats) -> Floats:
        """Return surprises, at least 0: (N,) to (N,)."""
        shares = np.interp(values, self.knots_, KNOTS)
        shape, scale = self.tail_.tolist()
        beyond = np.maximum(values - self.knots_[-1], 0.0) / scale
        tail = np.log1p(shape * beyond) / shape if shape else beyond
        surprises: Floats = tail - np.log1p(-shares)
        return surprises

    def __call__(self, values: Floats) -> Floats:
        """Return surprises on the panel's scale: (N,) to (N,)."""
        limit, surprises = float(self.limit_), self.factor_ * self.surprise(values)
        return np.minimum(surprises, limit + limit * np.log(np.maximum(surprises, limit) / limit))

    def brought_to(self, other: VoiceScale, weight: float) -> Self:
        """Take the unit of another scale: both exceed it in equally few episodes at weight 1."""
        self.factor_ = np.asarray(weight * other.unit_ / self.unit_)
        return self

    def limit(self) -> None:
        """Let surprises beyond the unit grow by their logarithm alone."""
        self.limit_ = self.unit_

    def arrays(self) -> Arrays:
        """Return what `restore` takes."""
        names = ("knots", "tail", "factor", "limit")
        return {name: getattr(self, f"{name}_") for name in names}

    def restore(self, arrays: Arrays) -> Self:
        """Take over a fit."""
        self.knots_ = take(arrays, "knots", KNOTS.shape)
        self.tail_ = take(arrays, "tail", (2,))
        self.factor_, self.limit_ = (take(arrays, name, (), "+") for name in ("factor", "limit"))
        return self


def _pareto(excess: Floats) -> tuple[float, float]:
    """Return the likeliest shape and scale of a generalized Pareto tail."""
    best = (-np.inf, 0.0, 1.0)
    for shape in SHAPES.tolist():
        scales = SCALES * excess.mean()
        ratios = excess / scales[:, None]
        lengths = np.log1p(shape * ratios).sum(axis=1) / shape if shape else ratios.sum(axis=1)
        likelihoods = -len(excess) * np.log(scales) - (1.0 + shape) * lengths
        k = int(likelihoods.argmax())
        best = max(best, (float(likelihoods[k]), shape, float(scales[k])))
    return best[1:]


class Voice(ABC):
    """A statistic of rows, higher where they are odd, of episodes at training's level.

    ``N = T + 1 - h`` rows of an episode are judged, all but the first h, the horizon.
    """

    name: ClassVar[str]
    weight: ClassVar[float] = 1.0 / MEMBERS_WEIGHT
    """Weight of its surprises, where the members' have 1."""

    @abstractmethod
    def fit(self, episodes: Sequence[Trajectory]) -> list[Floats]:
        """Learn; return the statistic of each nominal episode, (N,), out of fold.

        None of them where the voice has nothing to say of such episodes.
        """

    @abstractmethod
    def rows(self, episode: Trajectory) -> Floats:
        """Return the statistic of an episode, (N,)."""

    @abstractmethod
    def shares(self, episode: Trajectory) -> Floats:
        """Return each sensor's share in it, (N, S)."""

    @abstractmethod
    def reset(self) -> None:
        """Begin a new live episode."""

    @abstractmethod
    def update(self, observation: NDArray[np.float32], action: NDArray[np.float32] | None) -> float:
        """Return the statistic of the next observation of a live episode, NaN for the first h."""

    @abstractmethod
    def shares_last(self) -> Floats:
        """Return the sensors' shares, (S,), in the statistic of the latest `update`."""

    @abstractmethod
    def state(self) -> State:
        """Return what `restore` takes."""

    @abstractmethod
    def restore(self, state: State) -> None:
        """Take over a fit."""


class EnsembleVoice(Voice):
    """The probabilistic ensemble, where there are episodes enough and sensors are exact."""

    name = "ensemble"

    def __init__(self, panel: PanelDetector) -> None:
        self._panel = panel
        self.detector_: Any = None

    def _is_of_use(self, episodes: Sequence[Trajectory]) -> bool:
        panel = self._panel
        if panel.parameters.forecast != "auto":
            return panel.parameters.forecast == "ensemble"
        charts: Any = panel.voices_.get(CHARTS)
        return (
            len(episodes) >= ENSEMBLE_EPISODES
            and sum(x.transitions for x in episodes) >= ENSEMBLE_ROWS
            and not panel.basis_.size
            and not (charts and charts.rank)
            and float(np.log(panel.forecast_.scale).mean()) <= np.log(ENSEMBLE_ERROR)
        )

    def _unfitted(self) -> Any:
        panel = self._panel
        name = "pe-a" if panel.actions else "pe"
        try:
            return make_pe(name, seed=panel.seed, horizon=panel.horizon)
        except ImportError as error:
            raise MissingExtraError(
                f"detector {panel.name!r} fits an ensemble of networks on so many rows, which "
                f"needs {error.name}: install oodd-eval[reference], or set forecast=linear"
            ) from error

    def fit(self, episodes: Sequence[Trajectory]) -> list[Floats]:
        """See `Voice`."""
        if not self._is_of_use(episodes):
            return []
        self.detector_ = self._unfitted().fit(episodes, self._panel.progress)
        if self._panel.parameters.forecast == "auto":
            forecaster, scale = self.detector_.forecaster, self._panel.forecast_.scale
            linear = -0.5 * np.log(2.0 * np.pi * np.e) - np.log(scale).mean()
            if not forecaster.log_densities_[forecaster.name_] - linear >= ENSEMBLE_GAIN:
                return []
        return list(self.detector_.nominal_statistics_)

    def rows(self, episode: Trajectory) -> Floats:
        """See `Voice`."""
        scores: Floats = self.detector_.score(episode)[self._panel.horizon :]
        return scores

    def shares(self, episode: Trajectory) -> Floats:
        """See `Voice`."""
        shares: Floats = self.detector_.explain(episode).shares[self._panel.horizon :]
        return shares

    def reset(self) -> None:
        """See `Voice`."""
        self.detector_.reset()

    def update(self, observation: NDArray[np.float32], action: NDArray[np.float32] | None) -> float:
        """See `Voice`."""
        score: float = self.detector_.update(observation, action)
        return score

    def shares_last(self) -> Floats:
        """See `Voice`."""
        shares: Floats = self.detector_.explain_last()[0]
        return shares

    def state(self) -> State:
        """See `Voice`."""
        state: State = self.detector_.state()
        return state

    def restore(self, state: State) -> None:
        """See `Voice`."""
        self.detector_ = self._unfitted()
        self.detector_.restore(state)
