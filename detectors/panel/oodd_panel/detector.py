"""Fit and score of the panel.

A linear forecast, which learns the episode where episodes differ, gives errors; members that see
different things judge errors and readings; their surprises, calibrated on nominal rows that they
were not fitted on, make one statistic. Where there is data enough a probabilistic ensemble judges
beside them; where sensors are noisy, charts of a forecast that knows the constants of an episode.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from oodd_common.charts import Floats, limited, product
from oodd_common.windows import LongFitDetector
from oodd_pe import make_pe

from oodd_eval import Explanation, Trajectory
from oodd_eval.data.baseline import Baseline, Shift
from oodd_eval.errors import TrajectoryError
from oodd_eval.plugins.forecasting import CONSTANT, FeatureScale
from oodd_eval.plugins.state import Arrays, State, take
from oodd_panel import PanelParameters
from oodd_panel.constants import (
    LAGS,
    MOVED,
    SIGNED,
    SQUARED,
    ConstantsForecast,
    EpisodeCharts,
    LargestChart,
    chosen_rank,
    share_of_noise,
)
from oodd_panel.forecast import (
    ORDER,
    ROWS,
    EpisodeLearner,
    LinearForecast,
    StandardEpisode,
    chosen_ridge,
    regressors,
)
from oodd_panel.members import MEMBERS, Features, Latest, PanelMember, Pattern, window_of
from oodd_panel.surprise import SurpriseScale

FOLDS: Final = 5
"""Parts of the nominal rows, each judged by what was learnt from the others."""
LIMIT: Final = 30.0
"""Limit of a standardized reading."""
DIMENSIONS: Final = 64
"""Sensors beyond which forecasts are of so many principal components."""
LEARNT: Final = 60
"""Rows from which an episode's coefficients are learnt, where fewer are declared nominal."""
VARYING: Final = 10
"""Least episodes from which is learnt how episodes differ."""
WIDEST: Final = 150
"""Most regressors with coefficients of each episode: their covariance takes the square of it."""
GAIN: Final = 0.5
"""Most that learning may leave of the variance between episodes' mean errors, to be of use."""
SAMPLE: Final = 10_000
"""Most rows from which a member learns."""
ENSEMBLE: Final = "ensemble."
"""Prefix of the ensemble's part of a state."""
ENSEMBLE_EPISODES: Final = 20
"""Least episodes from which the ensemble is fitted: it judges by what an episode may show."""
ENSEMBLE_ROWS: Final = 2500
"""Least transitions from which it is fitted."""
ENSEMBLE_ERROR: Final = 0.3
"""Largest mean scale of the linear errors, in training standard deviations, with which it is.

More is noise of sensors, or causes that no sensor shows: logs of machines have .4 to .6, simulators
up to .22, and networks then forecast no better.
"""
CHARTS: Final = "charts"
"""Name of the voice that looks for changes of an episode's constants."""
NETWORKS: Final = "ensemble"
"""Name of the ensemble's voice."""
CHARTED_EPISODES: Final = 30
"""Least episodes from which it is fitted: it judges by its largest value in each.

Of 20 episodes of 150 rows one that was left out had four times the largest statistic of the rest.
"""
CHARTED_ROWS: Final = 2500
"""Least transitions from which it is fitted."""
NOISY: Final = 0.2
"""Least share of sensors whose errors are noise, for charts: a linear forecast says all there is.

Worlds have .27 to .67, simulators without noise 0, and there networks forecast better.
"""
REFERENCE: Final = 4.6
"""Surprise that a row must exceed to count as anomalous in the estimate of the onset: 1 in 100."""


class PanelDetector(LongFitDetector):
    r"""Surprises of calibrated members that see different things, as one statistic.

    .. math:: e_t = \frac{o_t - B^\top x_t}{\rho}, \quad
              d^k_t = \lVert (f^k_t - c_k) M_k \rVert, \quad
              s_t = -\log \hat p\bigg( \sqrt{\tfrac{1}{K} \sum_k \log^2 \hat p_k(d^k_t)} \bigg)

    where :math:`x_t` holds the latest observations up to :math:`o_{t-h}` (and actions, if asked
    for), B a ridge regression, whose coefficients are learnt anew from the first rows of an episode
    where episodes differ, and :math:`f^k` what member k looks at: the latest rows, sums of errors,
    their energy. :math:`\hat p` is the share of nominal rows with as large a distance. Higher
    means more anomalous: a score s says that a share of about exp(-s) of nominal rows are as odd.
    Scores are undefined (NaN) for t < h.

    All features are means and sums of finite memory: the statistic comes down when a fault ends.
    Members forget in 25 rows, the charts of `oodd_panel.constants` in 100.

    Parameters
    ----------
    name, seed, horizon
        See `WindowDetector`. The seed is that of the ensemble; nothing else is random. The
        regression is fitted to the horizon directly, without feeding forecasts back.
    parameters
        See `oodd_panel.PanelParameters`.
    actions
        Whether the forecast uses the commanded actions ``a_{t-h}, a_{t-h-1}, ...`` too.
    baseline
        Number of rows at the start of every episode that are nominal. Mean and spread of each
        sensor over them are brought to training's; their scores are 0.

    Notes
    -----
    Five folds of episodes, or of rows where there are fewer episodes, take turns: each is judged by
    forecast and members that were fitted on the others, and its distances calibrate the surprises.

    Fisher ("Statistical methods for research workers", 1932) adds logarithms of p-values; of their
    squares one that is certain outweighs four that are not. The sources of the members stand in
    `oodd_panel.members`.
    """

    kind: ClassVar[str] = "panel/2"

    def __init__(
        self,
        name: str,
        parameters: PanelParameters,
        *,
        seed: int,
        horizon: int,
        actions: bool,
        baseline: int = 0,
    ) -> None:
        self.baseline = baseline
        super().__init__(name, seed=seed, horizon=horizon, window=LAGS, actions=actions)
        self.parameters = parameters
        self.members_: list[PanelMember] = [member() for member in MEMBERS]
        self.tails_ = [SurpriseScale() for _ in MEMBERS]
        self.tail_ = SurpriseScale()
        self.charts_: tuple[ConstantsForecast, LargestChart] | None = None
        self.ensemble_: Any = None
        self.ensemble_tail_ = SurpriseScale()

    def score(self, trajectory: Trajectory) -> Floats:
        """Return one score per observation, NaN for t < horizon."""
        judged = self._judged(trajectory)
        return self._scored(judged, self._others(trajectory, judged), len(trajectory))

    def surprises(self, trajectory: Trajectory) -> Floats:
        """Return the surprise of each of `voices` at each row, (T + 1, K), NaN for t < horizon.

        In natural logarithms: 4.6 is one nominal row in a hundred.
        """
        judged = self._judged(trajectory)
        every = np.full((len(trajectory), len(self.voices)), np.nan)
        if judged is not None:
            others = [v[:, None] for v in self._others(trajectory, judged).values()]
            every[self.horizon :] = np.concatenate([self._surprises(judged), *others], axis=1)
        return every

    @property
    def voices(self) -> tuple[str, ...]:
        """Names of the members, and of the charts and the ensemble where there are such."""
        names = [member.name for member in self.members_]
        if self.charts_ is not None:
            names.append(CHARTS)
        if self.ensemble_ is not None:
            names.append(NETWORKS)
        return tuple(names)

    def explain(self, trajectory: Trajectory) -> Explanation:
        """Return the sensors that the most surprised voice points at, and since when.

        A sensor's share is its part of the square of that member's distance, or what the ensemble
        explains. The onset is where a CUSUM of the scores last left zero (Page 1954).
        """
        judged = self._judged(trajectory)
        rows, sensors = trajectory.observations.shape
        shares, onsets = np.full((rows, sensors), np.nan), np.full(rows, -1)
        if judged is not None:
            h = self.horizon
            others = self._others(trajectory, judged)
            scores = self._scored(judged, others, rows)[h:]
            surprises = self._surprises(judged)
            shares[h:] = self._shares(judged, surprises)
            loudest = self._total(surprises)
            for voice, said in others.items():
                speaks = said > loudest
                loudest = np.maximum(loudest, said)
                if voice == CHARTS and self.charts_ is not None:
                    forecast, largest = self.charts_
                    charts = self._charted(trajectory, forecast)
                    by_voice = largest.shares(charts, sensors)
                else:
                    by_voice = self.ensemble_.explain(self._visible(trajectory)).shares[h:]
                shares[h:][speaks] = by_voice[speaks]
            onset = _Onset(self.horizon)
            onsets[self.horizon :] = [onset(score) for score in scores.tolist()]
        return Explanation(shares, onsets)

    def reset(self) -> None:
        """Begin a new live episode."""
        super().reset()
        self._first: list[tuple[NDArray[np.float32], NDArray[np.float32] | None]] = []
        self._shift: Shift | None = None
        self._latest: Latest | None = None
        self._learner: EpisodeLearner | None = None
        self._onset = _Onset(self.horizon)
        self._charting: EpisodeCharts | None = None
        self._last: tuple[Features, Floats, str, int, Floats] | None = None
        self._action: NDArray[np.float32] | None = None
        if getattr(self, "ensemble_", None) is not None:
            self.ensemble_.reset()

    def update(
        self, observation: NDArray[np.float32], action: NDArray[np.float32] | None = None
    ) -> float:
        """Return the score of the next observation of a live episode, NaN for t < horizon."""
        if not self.baseline or self._shift is not None:
            self._action = action
            return super().update(observation, action)
        row = self._scale().checked(observation)
        t = len(self._first)
        self._first.append((row, action))
        if t + 1 == self.baseline:
            rows = np.stack([first for first, _ in self._first])
            self._shift = self.baseline_.shift(rows)
            for first, command in self._first:
                self._action = command
                super().update(first, command)
            self._onset = _Onset(self.horizon, t + 1)
        return float("nan") if t < self.horizon else 0.0

    def explain_last(self) -> tuple[Floats, int]:
        """Return the row of `explain` for the latest `update`: shares (sensors,), and the onset."""
        if self._last is None:
            return np.full(len(self._scale().mean), np.nan), -1
        features, surprises, voice, onset, charts = self._last
        if voice == NETWORKS:
            return self.ensemble_.explain_last()[0], onset
        if voice == CHARTS and self.charts_ is not None:
            return self.charts_[1].shares(charts, len(self._scale().mean))[0], onset
        return self._shares(features, surprises)[0], onset

    # From rows to features.

    def _standard(self, rows: NDArray[np.float32], shift: Shift | None) -> Floats:
        shifted = rows if shift is None else shift(rows)
        scale = self.observation_scale_
        return limited((shifted - scale.mean) / scale.std, LIMIT)

    def _row(self, observation: NDArray[np.float32]) -> NDArray[Any]:
        row = self._scale().checked(observation)
        if self.ensemble_ is not None:
            shifted = row if self._shift is None else self._shift(row)
            self._by_ensemble = self.ensemble_.update(shifted, self._action)
        standard: NDArray[Any] = self._standard(row[None], self._shift)[0]
        return standard

    def _command(self, action: NDArray[np.float32] | None) -> Any:
        scale = self.action_scale_
        standard: NDArray[Any] = (super()._command(action) - scale.mean) / scale.std
        return standard

    def _levels(self, rows: Floats) -> Floats:
        """Return principal components of standardized rows, or the rows where they are few."""
        return product(rows, self.basis_, ROWS) if self.basis_.size else rows

    def _shift_of(self, x: Trajectory) -> Shift | None:
        return self.baseline_.shift(x.observations[: self.baseline]) if self.baseline else None

    def _of_rows(self, rows: Floats, x: Trajectory) -> StandardEpisode:
        actions = np.empty((x.transitions, 0))
        if self.actions:
            actions = (x.actions - self.action_scale_.mean) / self.action_scale_.std
        return StandardEpisode(self._levels(rows), actions)

    def _judged(self, x: Trajectory) -> Features | None:
        """Return what members see of a trajectory; None where it has no row to judge."""
        self._must_fit(x)
        if x.transitions < self.horizon or len(x) < self.baseline:
            return None
        rows = self._standard(x.observations, self._shift_of(x))
        return self._steps(rows, self._of_rows(rows, x), self.forecast_)

    def _steps(self, rows: Floats, episode: StandardEpisode, forecast: LinearForecast) -> Features:
        """Return the features of the rows h, ..., T of an episode."""
        h = self.horizon
        learner = EpisodeLearner(forecast, max(LEARNT, self.baseline))
        levels = episode.rows[h:]
        errors = learner(regressors(episode, h), levels)
        return Latest(levels.shape[1], window_of(rows.shape[1]))(rows[h:], levels, errors)

    def _judge(self, window: NDArray[Any], now: NDArray[Any], t: int) -> float:
        level = self._levels(now[None])
        if self._latest is None or self._learner is None:
            self._latest = Latest(level.shape[1], window_of(len(now)))
            self._learner = EpisodeLearner(self.forecast_, max(LEARNT, self.baseline))
        x = self._regressors(window[:ORDER])
        errors = self._learner(x[None], level)
        features = self._latest(now[None], level, errors)
        surprises = self._surprises(features)
        total, charts = self._total(surprises), np.empty((1, 0))
        others: dict[str, Floats] = {}
        if self.charts_ is not None:
            forecast, largest = self.charts_
            if self._charting is None:
                self._charting = self._new_charts(forecast)
            charts = self._charting(self._regressors(window)[None], level)
            others[CHARTS] = largest(charts) if t >= self._heard else np.zeros(1)
        if self.ensemble_ is not None:
            others[NETWORKS] = self.ensemble_tail_(np.array([self._by_ensemble]))
        voice, loudest = "", total
        for name, said in others.items():
            if said[0] > loudest[0]:
                voice, loudest = name, said
        score = float(_joined(total, others)[0])
        self._last = features, surprises, voice, self._onset(score), charts
        return score

    def _regressors(self, window: NDArray[Any]) -> NDArray[Any]:
        """Return what forecasts use of a live window of standardized rows, newest first."""
        parts = [self._levels(window).ravel()]
        if self.actions:
            commands = list(self._commands)[self.lag - 1 :][: len(window)]
            known = np.zeros((len(window), len(self.action_scale_.mean)))
            if commands:
                known[: len(commands)] = commands
            parts.append(known.ravel())
        return np.concatenate([*parts, np.ones(1)])

    # The charts of an episode's constants.

    @property
    def _heard(self) -> int:
        """First row whose charts count: those before it lack some of the rows that they use."""
        return self.horizon + LAGS

    def _new_charts(self, forecast: ConstantsForecast) -> EpisodeCharts:
        return EpisodeCharts(forecast, max(LEARNT, self.baseline))

    def _charts_of(self, episode: StandardEpisode, forecast: ConstantsForecast) -> Floats:
        """Return the charts of the rows h, ..., T of an episode."""
        h = self.horizon
        return self._new_charts(forecast)(regressors(episode, h, LAGS), episode.rows[h:])

    def _charted(self, x: Trajectory, forecast: ConstantsForecast) -> Floats:
        rows = self._standard(x.observations, self._shift_of(x))
        return self._charts_of(self._of_rows(rows, x), forecast)

    # From features to the statistic.

    def _surprises(self, features: Features) -> Floats:
        """Return the members' surprises, (N, K)."""
        parts = zip(self.members_, self.tails_, strict=True)
        return np.stack([tail(m.lengths(m.features(features))) for m, tail in parts], axis=1)

    def _total(self, surprises: Floats) -> Floats:
        return self.tail_(_combined(surprises))

    def _visible(self, x: Trajectory) -> Trajectory:
        """Return a trajectory at training's level."""
        shift = self._shift_of(x)
        return x if shift is None else Trajectory(shift(x.observations), x.actions)

    def _others(self, x: Trajectory, judged: Features | None) -> dict[str, Floats]:
        """Return what voices beside the members say of the rows that are judged, each (N,)."""
        others: dict[str, Floats] = {}
        if judged is None:
            return others
        if self.charts_ is not None:
            forecast, largest = self.charts_
            said = largest(self._charted(x, forecast))
            said[:LAGS] = 0.0
            others[CHARTS] = said
        if self.ensemble_ is not None:
            scores = self.ensemble_.score(self._visible(x))[self.horizon :]
            others[NETWORKS] = self.ensemble_tail_(scores)
        return others

    def _scored(self, judged: Features | None, others: dict[str, Floats], rows: int) -> Floats:
        scores = np.full(rows, np.nan)
        scores[self.horizon :] = 0.0
        if judged is not None:
            total = self._total(self._surprises(judged))
            scores[self.horizon :] = _joined(total, others)
            scores[self.horizon : self.baseline] = 0.0
        return scores

    def _shares(self, features: Features, surprises: Floats) -> Floats:
        """Return the sensors' shares in the distance of the most surprised member, (N, S)."""
        sensors = len(self._scale().mean)
        speaking = surprises.argmax(axis=1)
        if self.basis_.size:
            speaking[:] = MEMBERS.index(Pattern)  # it alone looks at single sensors
        shares = np.empty((len(surprises), sensors))
        for k, member in enumerate(self.members_):
            rows = speaking == k
            if not rows.any():
                continue
            seen = member.features(features)[rows]
            parts = np.maximum(member.differences(seen)[1], 0.0)
            by_sensor = parts.reshape(len(parts), -1, sensors).sum(axis=1)
            total = by_sensor.sum(axis=1, keepdims=True)
            even = np.full_like(by_sensor, 1 / sensors)
            shares[rows] = np.where(total > 0, by_sensor / np.where(total > 0, total, 1.0), even)
        return shares

    # Fit.

    def _learn(self, nominal: Sequence[Trajectory]) -> FeatureScale:
        least = max(self.horizon, self.baseline) + 1
        usable = [x for x in nominal if x.transitions >= least]
        widths = {self._widths(x) for x in nominal}
        if not usable or len(widths) != 1:
            raise TrajectoryError(
                f"detector {self.name!r} cannot be fitted on {len(nominal)} trajectories, of "
                f"which {len(usable)} have at least {least} transitions, of (sensors, action "
                f"columns) {sorted(widths)}: expected at least one that long, all of the same shape"
            )
        if self.baseline:
            self.baseline_ = Baseline.fit(usable, self.baseline)
        scale = self.observation_scale_ = FeatureScale.fit(usable)
        if self.actions:
            commands = np.concatenate([x.actions for x in usable]).astype(np.float64)
            spread = commands.std(axis=0)
            spread = np.where(spread < CONSTANT, 1.0, spread)
            self.action_scale_ = FeatureScale(commands.mean(axis=0), spread)
        rows = [self._standard(x.observations, self._shift_of(x)) for x in usable]
        self.basis_ = _basis(rows) if len(scale.mean) > DIMENSIONS else np.empty((0, 0))
        episodes = [self._of_rows(r, x) for r, x in zip(rows, usable, strict=True)]
        self._dimensions = episodes[0].rows.shape[1]

        folds = _folds(list(zip(rows, episodes, strict=True)), self.horizon)
        plain = [[episode for _, episode in fold] for fold in folds]
        ridge = chosen_ridge(plain, self.horizon)
        varies = self._varies(plain, ridge)
        lengths: list[list[Floats]] = [[] for _ in MEMBERS]
        for i, fold in enumerate(folds):
            others = [x for j, other in enumerate(folds) if j != i for x in other] or fold
            forecast, members = self._fitted(others, ridge, varies=varies)
            for fold_rows, episode in fold:
                features = self._steps(fold_rows, episode, forecast)
                for k, member in enumerate(members):
                    lengths[k].append(member.lengths(member.features(features)))
        pooled = [np.concatenate(parts) for parts in lengths]
        for tail, values in zip(self.tails_, pooled, strict=True):
            tail.fit(values)
        # A tenth of few rows, which resemble one another, say little about a tail.
        common = float(np.exp(np.mean([np.log(tail.relative()) for tail in self.tails_])))
        for tail in self.tails_:
            tail.draw(common)
        surprises = [tail(v) for tail, v in zip(self.tails_, pooled, strict=True)]
        self.tail_.fit(_combined(np.stack(surprises, axis=1)))
        self.forecast_, self.members_ = self._fitted(
            list(zip(rows, episodes, strict=True)), ridge, varies=varies
        )
        total = self.tail_(_combined(np.stack(surprises, axis=1)))
        self.charts_ = self._fitted_charts(episodes, total, varies=varies)
        self.ensemble_ = None
        if self._wants_ensemble(usable):
            visible = [self._visible(x) for x in usable]
            self.ensemble_ = self._new_ensemble().fit(visible, self.progress)
            self.ensemble_tail_.fit(self.ensemble_.nominal_statistics_)
        return scale

    def _wants_ensemble(self, usable: Sequence[Trajectory]) -> bool:
        if self.parameters.forecast != "auto":
            return self.parameters.forecast == "ensemble"
        return (
            len(usable) >= ENSEMBLE_EPISODES
            and sum(x.transitions for x in usable) >= ENSEMBLE_ROWS
            and usable[0].observation_dim <= DIMENSIONS
            and not (self.charts_ and len(self.charts_[0].matrices))
            and float(self.forecast_.scale.mean()) <= ENSEMBLE_ERROR
        )

    def _fitted_charts(
        self, episodes: Sequence[StandardEpisode], total: Floats, *, varies: bool
    ) -> tuple[ConstantsForecast, LargestChart] | None:
        """Return the charts of an episode's constants, where there are episodes enough and noise.

        From the members' statistic of the folds' rows, fold by fold.
        """
        h, learnt = self.horizon, max(LEARNT, self.baseline)
        long = [x for x in episodes if len(x.rows) > h + LAGS]
        if (
            len(long) < CHARTED_EPISODES
            or sum(len(x.rows) - h for x in long) < CHARTED_ROWS
            or self.basis_.size
        ):
            return None
        rank = chosen_rank(long, h, learnt) if varies else 0
        charts: list[Floats] = []
        largest: list[float] = []
        begin = 0
        for i in range(FOLDS):
            # Of the same folds as the members' statistic, which lies fold by fold.
            others = [
                x for j, x in enumerate(episodes) if j % FOLDS != i and len(x.rows) > h + LAGS
            ]
            forecast = ConstantsForecast.fit(others, h, rank)
            for episode in episodes[i::FOLDS]:
                rows = max(len(episode.rows) - h, 0)
                if rows > LAGS:
                    charts.append(self._charts_of(episode, forecast)[LAGS:])
                    largest.append(float(total[begin : begin + rows].max()))
                begin += rows
        if share_of_noise(charts, self._dimensions) < NOISY:
            return None
        return ConstantsForecast.fit(long, h, rank), LargestChart.fit(charts, np.array(largest))

    def _new_ensemble(self) -> Any:
        try:
            return make_pe("pe-a" if self.actions else "pe", seed=self.seed, horizon=self.horizon)
        except ImportError as error:
            raise TrajectoryError(
                f"detector {self.name!r} fits an ensemble of networks on so many rows, which needs "
                f"{error.name}: install oodd-eval[reference], or set forecast=linear"
            ) from error

    def _fitted(
        self, episodes: Sequence[tuple[Floats, StandardEpisode]], ridge: float, *, varies: bool
    ) -> tuple[LinearForecast, list[PanelMember]]:
        forecast = LinearForecast.fit(
            [episode for _, episode in episodes], self.horizon, ridge, varies=varies
        )
        total = sum(len(rows) for rows, _ in episodes)
        step = -(-total // SAMPLE)
        parts = [self._steps(*x, forecast) for x in episodes]
        members: list[PanelMember] = []
        for kind in MEMBERS:
            member = kind()
            seen = np.concatenate([member.features(f)[::step] for f in parts])
            member.fit(seen)
            members.append(member)
        return forecast, members

    def _varies(self, folds: Sequence[Sequence[StandardEpisode]], ridge: float) -> bool:
        """Tell whether learning an episode's coefficients brings its later errors together."""
        episodes = [x for fold in folds for x in fold]
        learnt = max(LEARNT, self.baseline)
        long = [x for x in episodes if len(x.rows) >= 2 * learnt + self.horizon]
        width = ORDER * (self._dimensions + episodes[0].actions.shape[1]) + 1
        if len(long) < VARYING or len(long) < len(episodes) / 2 or width > WIDEST:
            return False
        left = []
        for varies in (False, True):
            means = []
            for part in (0, 1):
                forecast = LinearForecast.fit(
                    long[1 - part :: 2], self.horizon, ridge, varies=varies
                )
                for x in long[part::2]:
                    errors = EpisodeLearner(forecast, learnt)(
                        regressors(x, self.horizon), x.rows[self.horizon :]
                    )
                    means.append(np.clip(errors[learnt:], -LIMIT, LIMIT).mean(axis=0))
            left.append(float(np.var(means, axis=0).mean()))
        return left[1] <= GAIN * left[0]

    # State.

    def state(self) -> dict[str, Any]:
        """Return the fit as arrays, with the parameters that it goes with; the ensemble's, too."""
        state = super().state()
        if self.ensemble_ is not None:
            state |= {ENSEMBLE + name: value for name, value in self.ensemble_.state().items()}
        return state

    def restore(self, state: State) -> None:
        """Take over a fit that `state` returned.

        Raises `FittedStateError` when it is damaged, or of a detector with other parameters.
        """
        ensemble, rest = _part(state, ENSEMBLE), _without(state, ENSEMBLE)
        fitted = self._new_ensemble() if ensemble else None
        if fitted is not None:
            fitted.restore(ensemble)
        self.ensemble_ = None
        super().restore(rest)
        self.ensemble_ = fitted

    def _fitted_with(self) -> dict[str, Any]:
        return {"actions": self.actions, "horizon": self.horizon, "baseline": self.baseline}

    def _arrays(self) -> Arrays:
        arrays: dict[str, NDArray[Any]] = {
            "coefficients": self.forecast_.coefficients,
            "error_scale": self.forecast_.scale,
            "prior": self.forecast_.prior,
            "basis": self.basis_,
        }
        if self.actions:
            arrays["action_scale"] = np.stack([self.action_scale_.mean, self.action_scale_.std])
        if self.baseline:
            arrays["baseline"] = np.stack([self.baseline_.mean, self.baseline_.std])
        for part in [*zip(self.members_, self.tails_, strict=True)]:
            for holder in part:
                arrays |= {f"{part[0].name}.{n}": a for n, a in holder.arrays().items()}
        arrays |= {f"total.{n}": a for n, a in self.tail_.arrays().items()}
        if self.charts_ is not None:
            for part_of_charts in self.charts_:
                arrays |= {f"charts.{n}": a for n, a in part_of_charts._asdict().items()}
        if self.ensemble_ is not None:
            arrays |= {f"ensemble_tail.{n}": a for n, a in self.ensemble_tail_.arrays().items()}
        return arrays

    def _restore(self, arrays: Arrays, sensors: int) -> None:
        self.observation_scale_ = FeatureScale.of(arrays)
        used = 0
        if self.actions:
            self.action_scale_ = FeatureScale.of(arrays, "action_scale")
            used = len(self.action_scale_.mean)
        if self.baseline:
            mean, std = take(arrays, "baseline", (2, sensors))
            self.baseline_ = Baseline(self.baseline, mean, std)
        self.basis_ = take(arrays, "basis", (None, None))
        d = self._dimensions = self.basis_.shape[1] or sensors
        width = ORDER * (d + used) + 1
        self.forecast_ = LinearForecast(
            take(arrays, "coefficients", (width, d)),
            take(arrays, "error_scale", (d,), "+"),
            take(arrays, "prior", (None, None)),
        )
        self.members_ = [member() for member in MEMBERS]
        for member, tail in zip(self.members_, self.tails_, strict=True):
            for holder in (member, tail):
                holder.restore(_part(arrays, member.name + "."))
        self.tail_.restore(_part(arrays, "total."))
        self.charts_ = None
        if of_charts := _part(arrays, "charts."):
            self.charts_ = _restored_charts(of_charts, d, used)
        if of_ensemble := _part(arrays, "ensemble_tail."):
            self.ensemble_tail_.restore(of_ensemble)


def _restored_charts(
    arrays: Arrays, sensors: int, actions: int
) -> tuple[ConstantsForecast, LargestChart]:
    """Return the charts that a state holds."""
    matrices = take(arrays, "matrices", (None, 2 * (sensors + actions) + 1, sensors))
    columns = (len(SIGNED) + len(SQUARED)) * sensors + (len(MOVED) if len(matrices) else 0)
    forecast = ConstantsForecast(
        take(arrays, "coefficients", (LAGS * (sensors + actions) + 1, sensors)),
        matrices,
        take(arrays, "error_scale", (sensors,), "+"),
    )
    largest = LargestChart(
        take(arrays, "mean", (columns,)),
        take(arrays, "spread", (columns,), "+"),
        take(arrays, "scale", (2,)),
    )
    return forecast, largest


def _part(state: State, prefix: str) -> dict[str, Any]:
    """Return what a prefix marks in a state, without it."""
    return {n.removeprefix(prefix): a for n, a in state.items() if n.startswith(prefix)}


def _without(state: State, prefix: str) -> dict[str, Any]:
    return {n: a for n, a in state.items() if not n.startswith(prefix)}


def _combined(surprises: Floats) -> Floats:
    """Return root mean squares over members, (N, K) to (N,): one that is certain outweighs four."""
    combined: Floats = np.sqrt((surprises * surprises).mean(axis=1))
    return combined


def _joined(total: Floats, others: dict[str, Floats]) -> Floats:
    """Return the score from the members' surprises, (N,), and those of the voices beside them.

    The ensemble's stands in place of a smaller one of the members; the charts' square is added to
    that of the larger, as squares of members are, so that a small one hardly moves the score.
    """
    joined = np.maximum(total, others[NETWORKS]) if NETWORKS in others else total
    return np.hypot(joined, others[CHARTS]) if CHARTS in others else joined


class _Onset:
    """The row with which an anomaly would have begun: where a CUSUM of scores last left zero."""

    def __init__(self, first: int, nominal: int = 0) -> None:
        self._sum, self._now, self._onset, self._nominal = 0.0, first, first, nominal

    def __call__(self, score: float) -> int:
        """Return the onset as seen at the next row."""
        if self._sum <= 0:
            self._onset = self._now
        self._sum = max(0.0, self._sum + score - REFERENCE)
        self._now += 1
        return self._onset


def _basis(rows: Sequence[Floats]) -> Floats:
    """Return the leading principal components of standardized rows, (S, DIMENSIONS)."""
    gram: Floats = np.sum([r.T @ r for r in rows], axis=0)
    return np.ascontiguousarray(np.linalg.eigh(gram)[1][:, ::-1][:, :DIMENSIONS])


def _folds(
    episodes: Sequence[tuple[Floats, StandardEpisode]], horizon: int
) -> list[list[tuple[Floats, StandardEpisode]]]:
    """Return up to `FOLDS` folds: of episodes, or of stretches of rows where these are few."""
    if len(episodes) >= FOLDS:
        return [list(episodes[i::FOLDS]) for i in range(FOLDS)]
    folds: list[list[tuple[Floats, StandardEpisode]]] = [[] for _ in range(FOLDS)]
    for rows, episode in episodes:
        edges = np.linspace(0, len(rows), FOLDS + 1).astype(int)
        for fold, start, stop in zip(folds, edges[:-1], edges[1:], strict=True):
            if stop - start > horizon + 1:
                part = StandardEpisode(episode.rows[start:stop], episode.actions[start : stop - 1])
                fold.append((rows[start:stop], part))
    return [fold for fold in folds if fold] or [list(episodes)]
