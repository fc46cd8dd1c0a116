"""Fit and score of the probabilistic ensemble.

A linear forecast is the base; an ensemble of networks forecasts the distribution of its errors; the
residuals, each on the scale that was forecast for it, enter charts of several memories.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from oodd_common.charts import Floats
from oodd_common.windows import StorableWindowDetector, windows
from oodd_torch.device import resolved_device

from oodd_eval import Explanation, Trajectory
from oodd_eval.errors import TrajectoryError
from oodd_eval.plugins.forecasting import CONSTANT, FeatureScale
from oodd_eval.plugins.state import Arrays, take
from oodd_pe import PeParameters
from oodd_pe.network import DensityNetworks, deviance, train
from oodd_pe.statistic import Attribution, Charts, Evidence, Running

HELD_OUT: Final = 0.15
"""Share of the nominal trajectories from which the charts are learnt; at least one."""

RIDGE: Final = 1e-6
"""Penalty of the linear forecast, relative to the mean squared change of standardized sensors."""

LIMIT: Final = 10.0
"""Largest size of an input, in standard deviations: beyond it a network has seen nothing."""


class _Known(NamedTuple):
    """What N forecasts start from."""

    window: NDArray[np.float32]  # (N, W, D), newest first
    actions: Floats | None  # (N, W, A), NaN before the beginning
    steps: NDArray[np.int64]  # (N,), times of the newest observations


class ProbabilisticEnsemble(StorableWindowDetector):
    r"""Residuals of forecast distributions, accumulated with several memories.

    .. math:: e_t = \frac{1}{M} \sum_m s_m(x_t) \, (I + U_m(x_t)) \, (y_t - \mu_m(x_t)), \quad
              r_t = \operatorname{sign}(e_t) \sqrt{(\nu + 1) \log(1 + e_t^2 / \nu(x_t))}, \quad
              z^\lambda_t = (1 - \lambda) z^\lambda_{t-1} + \lambda g_t u_t, \quad
              s_t = \max_\lambda \frac{d^\lambda_t - m_\lambda}{q_\lambda}

    where :math:`x_t` holds the latest observations up to :math:`o_{t-h}` (and actions, if asked
    for), :math:`y_t` the change since then that a ridge regression does not explain, m counts the
    members, u is r with its nominal scale removed, g less than one only while the sensors stand
    still, and d the Mahalanobis length of z. Higher means more anomalous. Scores are undefined
    (NaN) for t < h.

    Parameters
    ----------
    name, seed, horizon
        See `WindowDetector`. The seed decides held-out episodes, networks and batches. The forecast
        is fitted to the horizon directly, without feeding forecasts back.
    parameters
        See `oodd_pe.PeParameters`.
    actions
        Whether the forecast uses the commanded actions ``a_{t-h}, a_{t-h-1}, ...`` too.
    accumulate
        Whether there are charts with memory besides the one that judges a step by itself.

    Notes
    -----
    Sources: Chua, Calandra, McAllister & Levine, "Deep reinforcement learning in a handful of
    trials using probabilistic dynamics models" (2018), for the ensemble; Lowry, Woodall, Champ &
    Rigdon, "A multivariate exponentially weighted moving average control chart" (1992).
    """

    kind: ClassVar[str] = "pe/1"

    def __init__(
        self,
        name: str,
        parameters: PeParameters,
        *,
        seed: int,
        horizon: int,
        actions: bool,
        accumulate: bool,
    ) -> None:
        super().__init__(
            name, seed=seed, horizon=horizon, window=parameters.window, actions=actions
        )
        self.parameters, self.accumulate = parameters, accumulate
        self.device = resolved_device(name, parameters.device)
        self.charts_ = Charts(parameters.memories)
        self.network_: DensityNetworks

    def score(self, trajectory: Trajectory) -> Floats:
        """Return one score per observation, NaN for t < horizon."""
        self._must_fit(trajectory)
        scores = np.full(len(trajectory), np.nan)
        if trajectory.transitions >= self.horizon:
            running = Running(self.charts_, accumulate=self.accumulate)
            smoothed = running(self._evidence(trajectory))
            scores[self.horizon :] = self.charts_.statistic(smoothed).max(axis=0)
        return scores

    def explain(self, trajectory: Trajectory) -> Explanation:
        """Return which sensors the evidence of each row points at, and since when.

        See `oodd_pe.statistic.Attribution`.
        """
        self._must_fit(trajectory)
        shares = np.full(trajectory.observations.shape, np.nan)
        onsets = np.full(len(trajectory), -1)
        if trajectory.transitions >= self.horizon:
            found = Attribution(self.charts_, self.horizon)(
                self._evidence(trajectory, explain=True)
            )
            shares[self.horizon :], onsets[self.horizon :] = found
        return Explanation(shares, onsets)

    def reset(self) -> None:
        """Begin a new live episode."""
        super().reset()
        self._running: Running | None = None

    def _row(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        return self._scale().checked(observation)

    def _judge(self, window: NDArray[np.float32], now: NDArray[np.float32], t: int) -> float:
        self._running = self._running or Running(self.charts_, accumulate=self.accumulate)
        actions = None
        if self.actions:
            commands = list(self._commands)[self.lag - 1 :]
            actions = np.full((1, self.window, len(self.action_scale_.mean)), np.nan)
            actions[0, : len(commands)] = commands
        known = _Known(window[None], actions, np.array([t - self.lag]))
        evidence = self._judged(known, now[None], self._rows[1][None])
        return float(self.charts_.statistic(self._running(evidence)).max())

    def _learn(self, nominal: Sequence[Trajectory]) -> FeatureScale:
        usable = [x for x in nominal if x.transitions >= self.horizon]
        shapes = {self._widths(x) for x in nominal}
        if not usable or len(shapes) != 1:
            raise TrajectoryError(
                f"detector {self.name!r} cannot be fitted on {len(nominal)} trajectories, of "
                f"which {len(usable)} have at least {self.horizon} transitions, of (sensors, "
                f"action columns) {sorted(shapes)}: expected at least one that long, all of the "
                "same shape"
            )
        scale = FeatureScale.fit(usable)
        rows = np.concatenate([x.observations for x in usable]).astype(np.float64)
        self.varying_ = np.flatnonzero(rows.std(axis=0) >= CONSTANT)
        self.observation_scale_ = scale
        if self.actions:
            commands = np.concatenate([x.actions for x in usable]).astype(np.float64)
            spread = commands.std(axis=0)
            self.action_scale_ = FeatureScale(
                commands.mean(axis=0), np.where(spread < CONSTANT, 1.0, spread)
            )
        order = np.random.default_rng([self.seed, 0]).permutation(len(usable))
        held = max(1, round(HELD_OUT * len(usable)))
        held_out = [usable[i] for i in order[:held]]
        # A single episode has no others, and judges itself.
        training = [usable[i] for i in order[held:]] or held_out

        x = np.concatenate([self._inputs(self._known(t)) for t in training])
        y = np.concatenate([self._changes(*self._seen(t)) for t in training])
        ones = np.concatenate([x, np.ones((len(x), 1))], axis=1)
        gram = ones.T @ ones + RIDGE * len(ones) * np.eye(ones.shape[1])
        self.ridge_ = np.linalg.solve(gram, ones.T @ y)
        self.error_scale_ = np.maximum(
            np.sqrt(((y - ones @ self.ridge_) ** 2).mean(axis=0)), CONSTANT
        )
        self.input_scale_ = np.maximum(x.std(axis=0), CONSTANT)
        p = self.parameters
        self.network_ = DensityNetworks(p.members, x.shape[1], y.shape[1], p.width, self.seed)
        if y.shape[1]:
            train(
                self.network_,
                self._scaled(x),
                self._errors(x, y),
                updates=p.updates,
                batch=p.batch,
                seed=self.seed,
                device=self.device,
            )
        self.network_.frozen()
        self.charts_.fit([self._evidence(t) for t in held_out])
        return scale

    def _known(self, x: Trajectory) -> _Known:
        steps = np.arange(len(x) - self.horizon)
        actions = None
        if self.actions:
            index = steps[:, None] - np.arange(self.window)
            actions = np.where(index[..., None] >= 0, x.actions[np.maximum(index, 0)], np.nan)
        return _Known(windows(x.observations, steps, self.window), actions, steps)

    def _seen(self, x: Trajectory) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the observations that are judged and those that forecasts start from."""
        return x.observations[self.horizon :], x.observations[: len(x) - self.horizon]

    def _inputs(self, known: _Known) -> Floats:
        """Return what forecasts use: newest observation, differences, actions, and the start."""
        window, actions, steps = known
        scale, n = self.observation_scale_, len(window)
        z = np.clip((window - scale.mean) / scale.std, -LIMIT, LIMIT)[:, :, self.varying_]
        parts = [z[:, 0], (z[:, :-1] - z[:, 1:]).reshape(n, -1)]
        if actions is not None:
            a = (actions - self.action_scale_.mean) / self.action_scale_.std
            parts.append(np.where(np.isnan(a), 0.0, a).reshape(n, -1))
        # Whether the window reaches beyond the beginning.
        parts.append((steps[:, None] < self.window - 1).astype(np.float64))
        return np.concatenate(parts, axis=1)

    def _changes(self, now: NDArray[np.float32], before: NDArray[np.float32]) -> Floats:
        """Return changes of varying sensors, in standard deviations: (N, D)."""
        change = (now.astype(np.float64) - before) / self.observation_scale_.std
        varying: Floats = change[:, self.varying_]
        return varying

    def _scaled(self, x: Floats) -> Floats:
        scaled: Floats = np.clip(x / self.input_scale_, -LIMIT, LIMIT)
        return scaled

    def _errors(self, x: Floats, y: Floats) -> Floats:
        """Return what the linear forecast leaves, in units of its training error."""
        left: Floats = (y - x @ self.ridge_[:-1] - self.ridge_[-1]) / self.error_scale_
        return left

    def _evidence(self, x: Trajectory, *, explain: bool = False) -> Evidence:
        now, before = x.observations[self.horizon :], x.observations[self.horizon - 1 : -1]
        return self._judged(self._known(x), now, before, explain=explain)

    @torch.inference_mode()
    def _judged(
        self,
        known: _Known,
        now: NDArray[np.float32],
        before: NDArray[np.float32],
        *,
        explain: bool = False,
    ) -> Evidence:
        """Judge observations ``now`` (N, D); ``before`` are those of the step before."""
        x = self._inputs(known)
        y = self._errors(x, self._changes(now, known.window[:, 0]))
        given, outcome = (
            torch.from_numpy(v).expand(self.parameters.members, -1, -1)
            for v in (self._scaled(x), y)
        )
        network, scale = self.network_, self.observation_scale_
        forecast = network(given, outcome)
        constant = np.ones(len(scale.mean), dtype=bool)
        constant[self.varying_] = False
        moved = (now - scale.mean)[:, constant] / CONSTANT
        changed = np.sign(moved) * np.sqrt(2.0 * np.log1p(moved**2))
        movement = self._changes(now, before)
        of_sensors = np.zeros((len(now), len(scale.mean) if explain else 0))
        if explain:
            alone = forecast.of_sensors(network.row, network.column).square().mean(0)
            of_sensors[:, self.varying_] = alone.numpy()
            of_sensors[:, constant] = moved**2
        residual, log_tail = forecast.residual.mean(0).numpy(), forecast.log_tail.mean(0).numpy()
        return Evidence(
            np.concatenate([deviance(residual, log_tail), changed], axis=1),
            log_tail,
            np.sqrt((movement**2).sum(axis=1) / max(1, movement.shape[1])),
            of_sensors,
        )

    def _saved_with(self) -> dict[str, Any]:
        p = self.parameters
        return {
            "actions": self.actions,
            "horizon": self.horizon,
            "members": p.members,
            "width": p.width,
            "window": p.window,
            "memories": p.memories,
        }

    def _arrays(self) -> Arrays:
        scale = self.action_scale_ if self.actions else FeatureScale(np.zeros(0), np.ones(0))
        return {
            "action_scale": np.stack([scale.mean, scale.std]),
            "varying": self.varying_,
            "ridge": self.ridge_,
            "error_scale": self.error_scale_,
            "input_scale": self.input_scale_,
            **self.network_.arrays(),
            **self.charts_.arrays(),
        }

    def _restore(self, arrays: Arrays, sensors: int, directory: Path) -> None:  # noqa: ARG002
        self.observation_scale_ = FeatureScale.of(arrays)
        self.action_scale_ = FeatureScale(*take(arrays, "action_scale", (2, None)))
        self.varying_ = take(arrays, "varying", (None,), "i")
        d = len(self.varying_)
        commands = len(self.action_scale_.mean)
        inputs = self.window * (d + commands) + 1
        self.ridge_ = take(arrays, "ridge", (inputs + 1, d))
        self.error_scale_ = take(arrays, "error_scale", (d,))
        self.input_scale_ = take(arrays, "input_scale", (inputs,))
        p = self.parameters
        self.network_ = DensityNetworks(p.members, inputs, d, p.width)
        self.network_.restore(arrays)
        self.charts_.restore(arrays, d, sensors - d)
