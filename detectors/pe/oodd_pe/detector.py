"""Fit and score of the probabilistic ensemble.

A linear forecast is the base; an ensemble of networks forecasts the distribution of its errors; the
residuals, each on the scale that was forecast for it, enter charts of several memories.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from oodd_common.charts import Floats
from oodd_common.windows import StorableWindowDetector, windows
from oodd_torch.device import resolved_device

from oodd_eval import Explanation, Trajectory
from oodd_eval.errors import TrajectoryError
from oodd_eval.plugins.forecasting import CONSTANT, FeatureScale
from oodd_eval.plugins.state import Arrays, take
from oodd_pe import PeParameters
from oodd_pe.ensemble import DensityEnsemble
from oodd_pe.network import DensityNetworks, train
from oodd_pe.statistic import Charts, Evidence, Onsets, Running, deviance

HELD_OUT: Final = 0.15
"""Share of the nominal trajectories from which the charts are learnt; at least one."""

RIDGE: Final = 1e-6
"""Penalty of the linear forecast, relative to the mean squared change of standardized sensors."""

LIMIT: Final = 10.0
"""Inputs are clipped at this many standard deviations. No network is trained on larger ones."""


class _Known(NamedTuple):
    """The latest observations, actions and times from which N forecasts are made."""

    window: NDArray[np.float32]  # (N, W, D), newest first
    actions: Floats | None  # (N, W, A), NaN before the beginning
    steps: NDArray[np.int64]  # (N,), times of the newest observations

    def rows(self, index: NDArray[np.int64]) -> _Known:
        """Return what some of the forecasts start from."""
        actions = None if self.actions is None else self.actions[index]
        return _Known(self.window[index], actions, self.steps[index])


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

    kind: ClassVar[str] = "pe/2"

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
        self.ensemble_: DensityEnsemble

    def score(self, trajectory: Trajectory) -> Floats:
        """Return one score per observation, NaN for t < horizon."""
        self._must_fit(trajectory)
        scores = np.full(len(trajectory), np.nan)
        if trajectory.transitions >= self.horizon:
            running = Running(self.charts_, accumulate=self.accumulate)
            evidence = self._evidence(trajectory)
            smoothed = running(self.charts_.columns(evidence), evidence.movement)
            scores[self.horizon :] = self.charts_.statistic(smoothed).max(axis=0)
        return scores

    def explain(self, trajectory: Trajectory) -> Explanation:
        """Return which sensors the evidence of each row points at, and since when.

        See `oodd_pe.statistic.Onsets`. A sensor's share is its part of what errors of single
        sensors would explain of the step at the onset alone: later forecasts start from corrupted
        readings, and every sensor disagrees with them.
        """
        self._must_fit(trajectory)
        shares = np.full(trajectory.observations.shape, np.nan)
        onsets = np.full(len(trajectory), -1)
        if trajectory.transitions >= self.horizon:
            first_rows = Onsets(self.charts_)(self.charts_.columns(self._evidence(trajectory)))
            rows, of_row = np.unique(first_rows, return_inverse=True)
            known, now = self._known(trajectory), trajectory.observations[self.horizon :]
            shares[self.horizon :] = self._shares(known.rows(rows), now[rows])[of_row]
            onsets[self.horizon :] = first_rows + self.horizon
        return Explanation(shares, onsets)

    def reset(self) -> None:
        """Begin a new live episode."""
        super().reset()
        self._running: Running | None = None
        self._onsets: Onsets | None = None
        self._onset = -1
        self._suspect: tuple[_Known, NDArray[np.float32]] | None = None

    def explain_last(self) -> tuple[Floats, int]:
        """Return the row of `explain` for the latest `update`: shares (sensors,), and the onset."""
        if self._suspect is None:
            return np.full(len(self._scale().mean), np.nan), -1
        return self._shares(*self._suspect)[0], self._onset

    def _row(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        return self._scale().checked(observation)

    def _command(self, action: NDArray[np.float32] | None) -> NDArray[np.float32]:
        return super()._command(action).copy()

    def _judge(self, window: NDArray[np.float32], now: NDArray[np.float32], t: int) -> float:
        if self._running is None or self._onsets is None:
            self._running = Running(self.charts_, accumulate=self.accumulate)
            self._onsets = Onsets(self.charts_)
        actions = None
        if self.actions:
            commands = list(self._commands)[self.lag - 1 :]
            actions = np.full((1, self.window, len(self.action_scale_.mean)), np.nan)
            actions[0, : len(commands)] = commands
        known = _Known(window[None], actions, np.array([t - self.lag]))
        evidence = self._judged(known, now[None], self._rows[1][None])
        columns = self.charts_.columns(evidence)
        self._onset = int(self._onsets(columns)[0]) + self.horizon
        if self._onset == t:
            self._suspect = known, now[None]
        return float(self.charts_.statistic(self._running(columns, evidence.movement)).max())

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
        rows = np.concatenate([x.observations for x in usable])
        self.varying_ = np.flatnonzero(rows.std(axis=0, dtype=np.float64) >= CONSTANT)
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

        inputs, outcomes = self._examples(training)
        p, d = self.parameters, outcomes.shape[1]
        network = DensityNetworks(p.members, inputs.shape[1], d, p.width, self.seed)
        if d:
            train(
                network,
                inputs,
                outcomes,
                updates=p.updates,
                batch=p.batch,
                seed=self.seed,
                device=self.device,
            )
        self.ensemble_ = DensityEnsemble(network.arrays())
        self.charts_.fit([self._evidence(t) for t in held_out])
        return scale

    def _examples(
        self, training: Sequence[Trajectory]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Fit the linear forecast; return inputs, (N, I), and outcomes, (N, D), of networks."""
        # Twice over the episodes, since all their inputs in double precision need gigabytes.
        moments = []
        for t in training:
            ones = np.pad(self._inputs(self._known(t)), ((0, 0), (0, 1)), constant_values=1.0)
            moments.append((ones.T @ ones, ones.T @ self._changes(*self._seen(t))))
        gram, cross = (np.sum(m, axis=0) for m in zip(*moments, strict=True))
        n = int(gram[-1, -1])
        self.ridge_ = np.linalg.solve(gram + RIDGE * n * np.eye(len(gram)), cross)
        variance = np.diag(gram)[:-1] / n - (gram[-1, :-1] / n) ** 2
        self.input_scale_ = np.sqrt(np.maximum(variance, CONSTANT**2))

        inputs = np.empty((n, len(variance)), np.float32)
        errors = np.empty((n, cross.shape[1]))
        done = 0
        for t in training:
            x = self._inputs(self._known(t))
            rows = slice(done, done := done + len(x))
            inputs[rows] = self._scaled(x)
            errors[rows] = self._errors(x, self._changes(*self._seen(t)))
        self.error_scale_ = np.maximum(np.sqrt((errors**2).mean(axis=0)), CONSTANT)
        errors /= self.error_scale_
        return inputs, errors.astype(np.float32)

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
        """Return what the linear forecast leaves of changes."""
        left: Floats = y - x @ self.ridge_[:-1] - self.ridge_[-1]
        return left

    def _evidence(self, x: Trajectory) -> Evidence:
        now, before = x.observations[self.horizon :], x.observations[self.horizon - 1 : -1]
        return self._judged(self._known(x), now, before)

    def _posed(self, known: _Known, now: NDArray[np.float32]) -> tuple[Floats, Floats]:
        """Return what networks are given, (N, inputs), and what they are to forecast, (N, D)."""
        x = self._inputs(known)
        errors = self._errors(x, self._changes(now, known.window[:, 0]))
        return self._scaled(x), errors / self.error_scale_

    def _moved(self, now: NDArray[np.float32]) -> tuple[NDArray[np.bool_], Floats]:
        """Return which sensors were constant in training, and how far they are from that."""
        constant = np.ones(now.shape[1], dtype=bool)
        constant[self.varying_] = False
        moved: Floats = (now - self.observation_scale_.mean)[:, constant] / CONSTANT
        return constant, moved

    def _judged(
        self, known: _Known, now: NDArray[np.float32], before: NDArray[np.float32]
    ) -> Evidence:
        """Judge observations ``now`` (N, D); ``before`` are those of the step before."""
        residual, log_tail = self.ensemble_(*self._posed(known, now))
        moved = self._moved(now)[1]
        changed = np.sign(moved) * np.sqrt(2.0 * np.log1p(moved**2))
        movement = self._changes(now, before)
        return Evidence(
            np.concatenate([deviance(residual, log_tail), changed], axis=1),
            log_tail,
            np.sqrt((movement**2).sum(axis=1) / max(1, movement.shape[1])),
        )

    def _shares(self, known: _Known, now: NDArray[np.float32]) -> Floats:
        """Return each sensor's share in the evidence of single steps, (N, sensors)."""
        explained = np.empty(now.shape)
        explained[:, self.varying_] = self.ensemble_.of_sensors(*self._posed(known, now))
        constant, moved = self._moved(now)
        explained[:, constant] = moved**2
        explained = np.maximum(explained, CONSTANT)
        shares: Floats = explained / explained.sum(axis=1, keepdims=True)
        return shares

    def _fitted_with(self) -> dict[str, Any]:
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
            **self.ensemble_.arrays,
            **self.charts_.arrays(),
        }

    def _restore(self, arrays: Arrays, sensors: int) -> None:
        self.observation_scale_ = FeatureScale.of(arrays)
        self.action_scale_ = FeatureScale.of(arrays, "action_scale")
        self.varying_ = take(arrays, "varying", (None,), "i")
        d = len(self.varying_)
        commands = len(self.action_scale_.mean)
        inputs = self.window * (d + commands) + 1
        self.ridge_ = take(arrays, "ridge", (inputs + 1, d))
        self.error_scale_ = take(arrays, "error_scale", (d,), "+")
        self.input_scale_ = take(arrays, "input_scale", (inputs,), "+")
        p = self.parameters
        self.ensemble_ = DensityEnsemble.restored(
            arrays, DensityNetworks(p.members, inputs, d, p.width)
        )
        self.charts_.restore(arrays, d, sensors - d)
