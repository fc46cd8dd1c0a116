"""Shared parts of the rivals with trained networks: fitting, standard units, single steps.

Networks are trained in single precision by torch. Rows are judged by NumPy in double precision:
beside a robot every row is a call of its own, and NumPy's calls take less time.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from oodd_common.charts import Floats
from oodd_common.windows import StorableWindowDetector

from oodd_eval import Trajectory
from oodd_eval.errors import TrajectoryError
from oodd_eval.plugins.forecasting import CONSTANT, FeatureScale
from oodd_eval.plugins.state import Arrays, take

Shapes = Mapping[str, tuple[int, int]]
"""Rows and columns of every weight by its name; those of a vector are (1, columns)."""

Weights = dict[str, Floats]

HELD_OUT: Final = 0.15
"""Share of the nominal trajectories that no weight is learned from; at least one.

They say when to stop, and on which scale to judge.
"""

LIMIT: Final = 10.0
"""Inputs are clipped at this many standard deviations. No network is trained on larger ones."""

POSITIVE: Final = ("unit", "calibration")
"""Names of what is divided by."""

SHRINK: Final = 0.1
"""Part of the weights of a recurrent network that a step of rate 1 takes away."""

BLOCK: Final = 8
"""Rows that are multiplied by a matrix at once where they are judged together.

A row by itself, as it comes live, costs as much as a block.
"""


class NetworkRival(StorableWindowDetector):
    """A detector of trained networks, whose weights are its state.

    Parameters
    ----------
    name, seed, horizon, window, lag, actions
        See `oodd_common.windows.WindowDetector`. The seed decides which episodes are held out, the
        initial weights and the batches.
    """

    weights_: Weights
    """Weights, and whatever else was learned, by name, in double precision."""
    loss_: float
    """Held-out loss after the training; each detector says in which unit."""
    varying_: NDArray[np.int64]
    """Columns of the sensors that vary in training, the only ones that networks see: (V,)."""
    surprise_: float
    """Term of a sensor that moves and never did in a sum of squares: 2 log(episodes + 1).

    The square of the largest normal residual to expect once in that many episodes, about. A sensor
    that was constant by chance must not outweigh all others.
    """

    def __init__(
        self,
        name: str,
        *,
        seed: int,
        horizon: int,
        actions: bool,
        window: int = 1,
        lag: int | None = None,
    ) -> None:
        super().__init__(name, seed=seed, horizon=horizon, window=window, lag=lag, actions=actions)
        self.observation_scale_: FeatureScale
        self.reach = horizon
        """Transitions that an episode must have to be learned from."""

    def score(self, trajectory: Trajectory) -> Floats:
        """Return one score per observation, NaN for t < lag."""
        self._must_fit(trajectory)
        scores = np.full(len(trajectory), np.nan)
        judged = trajectory.observations[self.lag :]
        scores[self.lag :] = self._scores(self._standard(trajectory), judged)
        return scores

    @abstractmethod
    def _scores(self, rows: Floats, observations: NDArray[np.float32]) -> Floats:
        """Return scores from row `lag` on, from `_standard` rows and these rows as they are."""

    @abstractmethod
    def _train(self, training: Sequence[Floats], held_out: Sequence[Floats]) -> None:
        """Set `weights_` and `loss_`, from `_standard` rows of episodes."""

    @abstractmethod
    def _shapes(self, sensors: int, commands: int) -> Shapes:
        """Return the shapes of everything in `weights_`, for so many varying sensors."""

    def _row(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        return self._scale().checked(observation)

    def _learn(self, nominal: Sequence[Trajectory]) -> FeatureScale:
        shapes = {self._widths(x) for x in nominal}
        usable = [x for x in nominal if x.transitions >= self.reach]
        if not usable or len(shapes) != 1:
            raise TrajectoryError(
                f"detector {self.name!r} cannot be fitted on {len(nominal)} trajectories, of "
                f"which {len(usable)} have at least {self.reach} transitions, of (sensors, "
                f"action columns) {sorted(shapes)}: expected at least one that long, all of the "
                "same shape"
            )
        self.observation_scale_ = scale = FeatureScale.fit(usable)
        rows = np.concatenate([x.observations for x in usable])
        self.varying_ = np.flatnonzero(rows.std(axis=0, dtype=np.float64) >= CONSTANT)
        self.surprise_ = 2.0 * math.log(len(usable) + 1)
        self.action_scale_ = FeatureScale(np.zeros(0), np.ones(0))
        if self.actions:
            commands = np.concatenate([x.actions for x in usable]).astype(np.float64)
            spread = commands.std(axis=0)
            self.action_scale_ = FeatureScale(
                commands.mean(axis=0), np.where(spread < CONSTANT, 1.0, spread)
            )
        order = np.random.default_rng([self.seed, 0]).permutation(len(usable))
        held = max(1, round(HELD_OUT * len(usable)))
        episodes = [self._standard(usable[i]) for i in order]
        # A single episode has no others, and is both.
        self._train(episodes[held:] or episodes, episodes[:held])
        return scale

    def _standard(self, x: Trajectory) -> Floats:
        """Return varying sensors and the action after each row, standardized: (T + 1, V + A).

        The last observation is followed by none; zeros stand there, which nothing may look at.
        """
        rows = self._standard_rows(x.observations)
        commands = np.zeros((len(rows), len(self.action_scale_.mean)))
        if self.actions:
            commands[:-1] = self._standard_action(x.actions)
        return np.concatenate([rows, commands], axis=1)

    def _standard_rows(self, observations: NDArray[np.float32]) -> Floats:
        """Return the varying sensors of rows, standardized: (N, D) to (N, V)."""
        scale = self.observation_scale_
        standard = (observations.astype(np.float64) - scale.mean) / scale.std
        varying: Floats = standard[:, self.varying_]
        return varying

    def _moved(self, observations: NDArray[np.float32]) -> Floats:
        """Return how many sensors are elsewhere than they always were in training: (N,)."""
        moved = np.abs(observations - self.observation_scale_.mean) >= CONSTANT
        moved[:, self.varying_] = False
        count: Floats = moved.sum(axis=1).astype(np.float64)
        return count

    def _standard_action(self, actions: NDArray[np.float32]) -> Floats:
        scale = self.action_scale_
        standard: Floats = (actions.astype(np.float64) - scale.mean) / scale.std
        return standard

    def _arrays(self) -> Arrays:
        scale = self.action_scale_
        return {
            "action_scale": np.stack([scale.mean, scale.std]),
            "varying": self.varying_,
            "learned": np.array([self.loss_, self.surprise_]),
            **self.weights_,
        }

    def _restore(self, arrays: Arrays, sensors: int) -> None:  # noqa: ARG002
        self.observation_scale_ = FeatureScale.of(arrays)
        self.action_scale_ = FeatureScale.of(arrays, "action_scale")
        self.varying_ = take(arrays, "varying", (None,), "i")
        self.loss_, self.surprise_ = take(arrays, "learned", (2,)).tolist()
        shapes = self._shapes(len(self.varying_), len(self.action_scale_.mean))
        self.weights_ = {
            name: take(arrays, name, shape, "+" if name in POSITIVE else "f")
            for name, shape in shapes.items()
        }


# Single steps, in NumPy


def silu(x: Floats) -> Floats:
    """Return x / (1 + exp(-x)), by a function that never overflows."""
    half: Floats = 0.5 * x
    return half + half * np.tanh(half)


def sigmoid(x: Floats) -> Floats:
    """Return 1 / (1 + exp(-x)), by a function that never overflows."""
    return 0.5 + 0.5 * np.tanh(0.5 * x)


def gru_step(weights: Weights, x: Floats, memory: Floats) -> Floats:
    """Return the memory after one input, (1, H): one step of `oodd_torch.gru`."""
    h = memory.shape[1]
    projected = x @ weights["gru_in"] + weights["gru_in_bias"]
    recurrent = memory @ weights["gru"] + weights["gru_bias"]
    gates = sigmoid(projected[:, : 2 * h] + recurrent[:, : 2 * h])
    new = np.tanh(projected[:, 2 * h :] + gates[:, :h] * recurrent[:, 2 * h :])
    after: Floats = new + gates[:, h:] * (memory - new)
    return after


def settings(parameters: Any, *names: str) -> dict[str, Any]:
    """Return some parameters by name, as JSON values."""
    return {name: getattr(parameters, name) for name in names}
