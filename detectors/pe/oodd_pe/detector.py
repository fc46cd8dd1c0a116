"""Fit and score of the probabilistic ensemble.

A forecaster judges observations by the distributions that it forecast for them; its residuals enter
charts of several memories.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from oodd_common.charts import Floats, Onset
from oodd_common.windows import LongFitDetector, windows
from oodd_torch.device import resolved_device

from oodd_eval import Explanation, Trajectory
from oodd_eval.errors import TrajectoryError
from oodd_eval.plugins.forecasting import CONSTANT, FeatureScale
from oodd_eval.plugins.state import Arrays, take
from oodd_pe import PeParameters
from oodd_pe.choice import ChosenForecaster
from oodd_pe.forecaster import Assessment, Judge, Known, Transitions, Units
from oodd_pe.rare import RareEvents
from oodd_pe.statistic import Charts, Evidence, Running

CHARTED: Final = 65_536
"""Steps from which charts are learnt, but for the rest of an episode: bounds time and memory."""

TIMES: Final = 100
"""Steps from the beginning of an episode that are told apart where rare events are looked up."""

REFERENCE: Final = 2.0
"""Nominal standard deviations of the energy that a step must exceed to count as anomalous."""

FOLDS: Final = 3
"""Parts of few nominal episodes; what judges one of them has learnt from the others."""

PARTS: Final = 5
"""Parts of the episodes that charts are learnt from, each judged by charts of the others."""

MANY: Final = 30
"""Episodes from which half of them, in folds of half the size, are enough to learn charts from."""


class ProbabilisticEnsemble(LongFitDetector):
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

    kind: ClassVar[str] = "pe/4"

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
        self.forecaster = ChosenForecaster(
            parameters, seed=seed, horizon=horizon, device=resolved_device(name, parameters.device)
        )
        self.units_: Units
        self.charts_ = Charts(parameters.memories)
        self.events_ = RareEvents(parameters.memories)

    def score(self, trajectory: Trajectory) -> Floats:
        """Return one score per observation, NaN for t < horizon."""
        self._must_fit(trajectory)
        scores = np.full(len(trajectory), np.nan)
        if trajectory.transitions >= self.horizon:
            steps = self._transitions(trajectory)
            evidence = self._evidence(steps, self.forecaster.begin()(steps))
            columns = self.charts_.columns(evidence)
            scores[self.horizon :] = _Sums(self)(steps, evidence, columns)
        return scores

    def explain(self, trajectory: Trajectory) -> Explanation:
        """Return which sensors the evidence of each row points at, and since when.

        The onset is where a CUSUM of the energy last left zero (Page 1954). A sensor's share is its
        part of what errors of single sensors would explain of the step at the onset alone: later
        forecasts start from corrupted readings, and every sensor disagrees with them.
        """
        self._must_fit(trajectory)
        shares = np.full(trajectory.observations.shape, np.nan)
        onsets = np.full(len(trajectory), -1)
        if trajectory.transitions >= self.horizon:
            steps = self._transitions(trajectory)
            judged = self.forecaster.begin()(steps)
            energies = self.charts_.columns(self._evidence(steps, judged))[:, -1].tolist()
            first_rows = [*map(self._new_onset(), energies)]
            rows, of_row = np.unique(first_rows, return_inverse=True)
            shares[self.horizon :] = self._shares(steps.rows(rows), judged.rows(rows))[of_row]
            onsets[self.horizon :] = rows[of_row] + self.horizon
        return Explanation(shares, onsets)

    def _new_onset(self) -> Onset:
        return Onset(REFERENCE * float(self.charts_.spread_), 0)

    def reset(self) -> None:
        """Begin a new live episode."""
        super().reset()
        self._judging: tuple[Judge, _Sums, Onset] | None = None
        self._onset = -1
        self._suspect: tuple[Transitions, Assessment] | None = None

    def explain_last(self) -> tuple[Floats, int]:
        """Return the row of `explain` for the latest `update`: shares (sensors,), and the onset."""
        if self._suspect is None:
            return np.full(len(self._scale().mean), np.nan), -1
        return self._shares(*self._suspect)[0], self._onset

    def _row(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        return self._scale().checked(observation)

    def _judge(self, window: NDArray[np.float32], now: NDArray[np.float32], t: int) -> float:
        if self._judging is None:
            self._judging = self.forecaster.begin(), _Sums(self), self._new_onset()
        judge, sums, onset = self._judging
        actions = None
        if self.actions:
            commands = list(self._commands)[self.lag - 1 :]
            actions = np.full((1, self.window, len(self.action_scale_.mean)), np.nan, np.float32)
            actions[0, : len(commands)] = commands
        known = Known(window[None], actions, np.array([t - self.lag]))
        steps = Transitions(known, now[None], self._rows[1][None])
        judged = judge(steps)
        evidence = self._evidence(steps, judged)
        columns = self.charts_.columns(evidence)
        self._onset = onset(float(columns[0, -1])) + self.horizon
        if self._onset == t:
            self._suspect = steps, judged
        return float(sums(steps, evidence, columns)[0])

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
        commands = np.concatenate([x.actions for x in usable]) if self.actions else None
        self._take(Units.fit(scale, rows, commands, self.window))
        self.largest_change_ = float(np.sqrt(2.0 * np.log1p(len(usable))))
        pieces, folds = self.pieces(usable)
        self.chart(pieces, self.forecaster.fit(self.units_, pieces, folds, self.progress))
        return scale

    def chart(self, pieces: Sequence[Transitions], judged: Sequence[Assessment | None]) -> None:
        """Learn the charts from what the forecaster's `fit` returned for pieces.

        `nominal_statistics_` are then the statistics of each, (N,), of residuals that were made out
        of fold, by charts of the other episodes: a covariance of 20 sensors knows 20 that differ
        too well.
        """
        known = [
            (p, j, self._evidence(p, j))
            for p, j in zip(pieces, judged, strict=True)
            if j is not None
        ]
        count = min(PARTS, len(known))
        self.nominal_statistics_ = []
        for part in range(count):
            self._chart([x for n, x in enumerate(known) if n % count != part] or known)
            self.nominal_statistics_ += [
                _Sums(self)(p, e, self.charts_.columns(e)) for p, _, e in known[part::count]
            ]
        self._chart(known)

    def _chart(self, known: Sequence[tuple[Transitions, Assessment, Evidence]]) -> None:
        """Learn the charts of steps whose residuals were made out of fold."""
        self.charts_.fit([e for _, _, e in known])
        self.events_.fit(
            [self._surroundings(p) for p, _, _ in known],
            [j.residuals for _, j, _ in known],
            [self.charts_.share(e.movement) for _, _, e in known],
        )

    def pieces(self, usable: Sequence[Trajectory]) -> tuple[list[Transitions], list[int]]:
        """Return pieces of episodes in random order, and the fold of each.

        They are whole episodes where there are enough. Those beyond `CHARTED` are in no fold, -1.
        Of `MANY` there are twice as many folds as members, so that half of the episodes are judged
        and each member learns from most of them.
        """
        order = np.random.default_rng([self.seed, 0]).permutation(len(usable))
        pieces = [self._transitions(usable[i]) for i in order]
        count = FOLDS if len(pieces) < MANY else max(FOLDS, 2 * self.parameters.members)
        if len(pieces) < FOLDS:
            blocks = [np.array_split(np.arange(len(p.now)), FOLDS) for p in pieces]
            pieces = [
                p.rows(b) for p, of_piece in zip(pieces, blocks, strict=True) for b in of_piece
            ]
        before = np.cumsum([0, *(len(p.now) for p in pieces)])[:-1]
        folds = [n % count if n < count or before[n] < CHARTED else -1 for n in range(len(pieces))]
        # An episode of fewer steps than folds leaves some empty.
        filled = [(p, fold) for p, fold in zip(pieces, folds, strict=True) if len(p.now)]
        return [p for p, _ in filled], [fold for _, fold in filled]

    def _take(self, units: Units) -> None:
        self.units_ = units
        if units.commands is not None:
            self.action_scale_ = units.commands

    def _transitions(self, x: Trajectory) -> Transitions:
        steps = np.arange(len(x) - self.horizon)
        actions = None
        if self.actions:
            index = steps[:, None] - np.arange(self.window)
            actions = np.where(index[..., None] >= 0, x.actions[np.maximum(index, 0)], np.nan)
        known = Known(windows(x.observations, steps, self.window), actions, steps)
        return Transitions(
            known, x.observations[self.horizon :], x.observations[self.horizon - 1 : -1]
        )

    def _changed(self, now: NDArray[np.float32]) -> Floats:
        """Return the evidence of sensors that were constant in training, (N, constant).

        That a sensor was constant in n episodes does not make a change impossible. In the next one
        it has a chance of about 1 / (n + 1), and no deviation of a standard normal that is less
        likely is evidence of more.
        """
        constant = self.units_.constant
        moved = (now[:, constant] - self.units_.sensors.mean[constant]) / CONSTANT
        size = np.minimum(np.sqrt(2.0 * np.log1p(moved**2)), self.largest_change_)
        changed: Floats = np.sign(moved) * size
        return changed

    def counts(self, steps: Transitions, evidence: Evidence) -> Floats:
        """Return how improbable steps are, as they count: see `oodd_pe.rare.RareEvents`, (N,)."""
        residuals = evidence.residuals[:, : evidence.log_tails.shape[1]]
        share = self.charts_.share(evidence.movement)
        return self.events_.counts(self._surroundings(steps), residuals, share)

    def _surroundings(self, steps: Transitions) -> Floats:
        """Return where rare events are looked up: inputs of forecasts, and the time, (N, I + 1)."""
        time = np.minimum(steps.known.steps, TIMES)[:, None]
        return np.concatenate([self.units_.inputs(steps.known), time], axis=1)

    def _evidence(self, steps: Transitions, judged: Assessment) -> Evidence:
        movement, residuals = self.units_.changes(steps.now, steps.before), judged.residuals
        if len(self.units_.constant):
            residuals = np.concatenate([residuals, self._changed(steps.now)], axis=1)
        return Evidence(
            residuals,
            judged.log_tails,
            np.sqrt((movement**2).sum(axis=1) / max(1, movement.shape[1])),
        )

    def _shares(self, steps: Transitions, judged: Assessment) -> Floats:
        """Return each sensor's share in the evidence of single steps, (N, sensors)."""
        explained = np.empty(steps.now.shape)
        explained[:, self.units_.varying] = self.forecaster.explained(steps, judged)
        explained[:, self.units_.constant] = self._changed(steps.now) ** 2
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
        return {
            "largest_change": np.array(self.largest_change_),
            **self.units_.arrays(),
            **self.forecaster.arrays(),
            **self.charts_.arrays(),
            **self.events_.arrays(),
        }

    def _restore(self, arrays: Arrays, sensors: int) -> None:
        self._take(Units.restored(arrays, actions=self.actions, window=self.window))
        self.largest_change_ = float(take(arrays, "largest_change", (), "+"))
        self.forecaster.restore(self.units_, arrays)
        d = len(self.units_.varying)
        self.charts_.restore(arrays, d, sensors - d)
        self.events_.restore(arrays, self.units_.width + 1, d)


class _Sums:
    """The sums of an episode so far: each call continues where the last one ended."""

    def __init__(self, detector: ProbabilisticEnsemble) -> None:
        self._detector, self._charts = detector, detector.charts_
        self._running = Running(self._charts, accumulate=detector.accumulate)
        self._events = detector.events_.running() if detector.accumulate else None

    def __call__(self, steps: Transitions, evidence: Evidence, columns: Floats) -> Floats:
        """Return the statistic of the next N steps, (N,): the largest of all charts."""
        lengths = self._running(columns, evidence.movement)
        statistics = self._charts.statistic(lengths)
        if self._events is not None:
            counts = self._detector.counts(steps, evidence)
            statistics = np.concatenate([statistics, self._events(counts)])
        largest: Floats = statistics.max(axis=0)
        return largest
