"""Fit and score of the panel.

A linear forecast, which learns the episode where episodes differ, gives errors; members that see
different things judge errors and readings; their surprises, calibrated on nominal rows that they
were not fitted on, make one statistic. Where there is data enough a probabilistic ensemble judges
beside them; where sensors are noisy, charts of a forecast that knows the constants of an episode.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from oodd_common.charts import Floats, Onset, limited, product, shares_of
from oodd_common.latest_rows import LatestRowsNamer
from oodd_common.windows import LongFitDetector, StandardEpisode, regressors

from oodd_eval import Explanation, Naming, Trajectory
from oodd_eval.data.baseline import Baseline, Shift
from oodd_eval.errors import TrajectoryError
from oodd_eval.plugins.forecasting import CONSTANT, FeatureScale
from oodd_eval.plugins.state import Arrays, State, take
from oodd_panel import PanelParameters, learning
from oodd_panel.constants import FOLDS, LAGS, ConstantsVoice
from oodd_panel.forecast import ORDER, ROWS, EpisodeLearner, LinearForecast, chosen_ridge
from oodd_panel.frame import FrameVoice
from oodd_panel.members import MEMBERS, Features, Latest, PanelMember, Pattern, window_of
from oodd_panel.voices import MEMBERS_VOICE, EnsembleVoice, Voice, VoiceScale

LIMIT: Final = 30.0
"""Limit of a standardized reading."""
DIMENSIONS: Final = 64
"""Sensors beyond which forecasts are of so many principal components."""
LEARNT: Final = 60
"""Rows from which an episode's coefficients are learnt, where none are declared nominal."""
VARYING: Final = 10
"""Least episodes from which is learnt how episodes differ."""
WIDEST: Final = 150
"""Most regressors with coefficients of each episode: their covariance takes the square of it."""
SAMPLE: Final = 10_000
"""Most rows from which a member learns."""
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
    roles
        Of the sensors, see `oodd_eval.Quantity`; empty where they are not known.

    Notes
    -----
    Five folds of episodes, or of rows where there are fewer episodes, take turns: each is judged by
    forecast and members that were fitted on the others, and its distances calibrate the surprises.

    Fisher ("Statistical methods for research workers", 1932) adds logarithms of p-values; of their
    squares one that is certain outweighs four that are not. The sources of the members stand in
    `oodd_panel.members`.
    """

    kind: ClassVar[str] = "panel/4"

    def __init__(
        self,
        name: str,
        parameters: PanelParameters,
        *,
        seed: int,
        horizon: int,
        actions: bool,
        baseline: int = 0,
        roles: Sequence[str] = (),
    ) -> None:
        self.baseline, self.roles = baseline, tuple(roles)
        self._namer = LatestRowsNamer(None)
        super().__init__(name, seed=seed, horizon=horizon, window=LAGS, actions=actions)
        self.parameters = parameters
        self.members_: list[PanelMember] = [member() for member in MEMBERS]
        self.tails_ = [VoiceScale() for _ in MEMBERS]
        self.voices_: dict[str, Voice] = {}
        self.scales_: dict[str, VoiceScale] = {}

    def score(self, trajectory: Trajectory) -> Floats:
        """Return one score per observation, NaN for t < horizon."""
        scores: Floats = np.max([*self.voices(trajectory).values()], axis=0)
        return scores

    def voices(self, trajectory: Trajectory) -> dict[str, Floats]:
        """Return what each voice says of each row, (T + 1,) each, NaN for t < horizon.

        The largest of them is the score. In natural logarithms: where the members alone speak, 4.6
        is one nominal row in a hundred.
        """
        self._must_fit(trajectory)
        visible = self._visible(trajectory)
        return self._said(visible, self._judged(visible))

    def explain(self, trajectory: Trajectory) -> Explanation:
        """Return the sensors that the most surprised voice points at, and since when.

        A sensor's share is its part of the square of that member's distance, or what the ensemble
        explains. The onset is where a CUSUM of the scores last left zero (Page 1954). Parts at
        fault are named of at most 64 sensors, see `oodd_common.naming`.
        """
        self._must_fit(trajectory)
        visible = self._visible(trajectory)
        judged, h = self._judged(visible), self.horizon
        shares, onsets = (
            np.full(trajectory.observations.shape, np.nan),
            np.full(len(trajectory), -1),
        )
        if judged is not None:
            said = np.stack([values[h:] for values in self._said(visible, judged).values()])
            loudest = said.argmax(axis=0)
            shares[h:] = self._shares(judged, self._surprises(judged))
            for k, voice in enumerate(self.voices_.values(), 1):
                if (speaks := loudest == k).any():
                    shares[h:][speaks] = voice.shares(visible)[speaks]
            onset = Onset(REFERENCE, h)
            onsets[h:] = [onset(score) for score in said.max(axis=0).tolist()]
        naming = None if judged is None else self._namer(visible, self.baseline)
        return Explanation(shares, onsets, _in_units(naming, self._shift_of(trajectory)))

    def reset(self) -> None:
        """Begin a new live episode."""
        super().reset()
        self._first: list[tuple[NDArray[np.float32], NDArray[np.float32] | None]] = []
        self._shift: Shift | None = None
        self._latest: Latest | None = None
        self._learner: EpisodeLearner | None = None
        self._onset = Onset(REFERENCE, self.horizon)
        self._last: tuple[Features, Floats, int, int] | None = None
        self._action: NDArray[np.float32] | None = None
        self._namer.reset()
        for voice in getattr(self, "voices_", {}).values():
            voice.reset()

    def update(
        self, observation: NDArray[np.float32], action: NDArray[np.float32] | None = None
    ) -> float:
        """Return the score of the next observation of a live episode, NaN for t < horizon."""
        command = None
        if self.actions and action is not None:  # a copy: loops may write the next one into theirs
            command = np.array(action, dtype=np.float32)
        if not self.baseline or self._shift is not None:
            return self._next(observation, command)
        row = self._scale().checked(observation)
        t = len(self._first)
        self._first.append((row, command))
        if t + 1 == self.baseline:
            rows = np.stack([first for first, _ in self._first])
            self._shift = self.baseline_.shift(rows)
            for pair in self._first:
                self._next(*pair)
            self._onset = Onset(REFERENCE, t + 1)
        return float("nan") if t < self.horizon else 0.0

    def _next(self, observation: NDArray[np.float32], action: NDArray[np.float32] | None) -> float:
        """Return the score of a row, of which the shift of its episode is known."""
        self._action = action
        score = super().update(observation, action)
        self._namer.update(self._shifted, self._action)
        return score

    def explain_last(self) -> tuple[Floats, int, Naming | None]:
        """Return what `explain` says of the latest `update`: shares (sensors,), onset, naming."""
        if self._last is None:
            return np.full(len(self._scale().mean), np.nan), -1, None
        features, surprises, loudest, onset = self._last
        if loudest:
            shares = [*self.voices_.values()][loudest - 1].shares_last()
        else:
            shares = self._shares(features, surprises)[0]
        return shares, onset, _in_units(self._namer.last(self.baseline), self._shift)

    # From rows to features.

    @property
    def learnt(self) -> int:
        """Number of errors from which an episode is learnt; later ones are only judged."""
        learn = self.parameters.learn
        if learn == "auto":
            learn = self.baseline or LEARNT
        rows = learn if isinstance(learn, int) else self.baseline * (learn == "baseline")
        return max(rows - self.horizon, 0)

    def _standard(self, rows: NDArray[np.float32]) -> Floats:
        scale = self.observation_scale_
        return limited((rows - scale.mean) / scale.std, LIMIT)

    def _row(self, observation: NDArray[np.float32]) -> NDArray[Any]:
        row = self._scale().checked(observation)
        self._shifted = row if self._shift is None else self._shift(row)
        if self._now < self.lag:
            for voice in self.voices_.values():
                voice.update(self._shifted, self._action)
        standard: NDArray[Any] = self._standard(self._shifted[None])[0]
        return standard

    def _command(self, action: NDArray[np.float32] | None) -> Any:
        scale = self.action_scale_
        standard: NDArray[Any] = (super()._command(action) - scale.mean) / scale.std
        return standard

    def _levels(self, rows: Floats) -> Floats:
        """Return principal components of standardized rows, or the rows where they are few."""
        return product(rows, self.basis_, ROWS) if self.basis_.size else rows

    def _visible(self, x: Trajectory) -> Trajectory:
        """Return a trajectory at training's level, as far as its first rows say where it is."""
        shift = self._shift_of(x)
        return x if shift is None else Trajectory(shift(x.observations), x.actions)

    def _shift_of(self, x: Trajectory) -> Shift | None:
        """Return what brings a trajectory to training's level, where its first rows tell it."""
        if not self.baseline or len(x) < self.baseline:
            return None
        return self.baseline_.shift(x.observations[: self.baseline])

    def standardized(self, x: Trajectory) -> StandardEpisode:
        """Return the rows that forecasts are of, of a trajectory at training's level."""
        return self._of_rows(self._standard(x.observations), x)

    def _of_rows(self, rows: Floats, x: Trajectory) -> StandardEpisode:
        actions = np.empty((x.transitions, 0))
        if self.actions:
            actions = (x.actions - self.action_scale_.mean) / self.action_scale_.std
        return StandardEpisode(self._levels(rows), actions)

    def _judged(self, x: Trajectory) -> Features | None:
        """Return what members see of a trajectory; None where it has no row to judge."""
        if x.transitions < self.horizon or len(x) < self.baseline:
            return None
        rows = self._standard(x.observations)
        return self._steps(rows, self._of_rows(rows, x), self.forecast_)

    def _steps(self, rows: Floats, episode: StandardEpisode, forecast: LinearForecast) -> Features:
        """Return the features of the rows h, ..., T of an episode."""
        h = self.horizon
        learner = EpisodeLearner(forecast, self.learnt)
        levels = episode.rows[h:]
        errors = learner(regressors(episode, h, ORDER), levels)
        return Latest(levels.shape[1], window_of(rows.shape[1]), rows[0])(rows[h:], errors)

    def _judge(self, window: NDArray[Any], now: NDArray[Any], _t: int) -> float:
        level = self._levels(now[None])
        if self._latest is None or self._learner is None:
            self._latest = Latest(level.shape[1], window_of(len(now)), window[-1])
            self._learner = EpisodeLearner(self.forecast_, self.learnt)
        self._live = window, level
        errors = self._learner(self._regressors(ORDER), level)
        features = self._latest(now[None], errors)
        surprises = self._surprises(features)
        said = [float(self.scales_[MEMBERS_VOICE](_combined(surprises))[0])]
        for name, voice in self.voices_.items():
            statistic = np.array([voice.update(self._shifted, self._action)])
            said.append(float(self.scales_[name](statistic)[0]))
        score = max(said)
        self._last = features, surprises, said.index(score), self._onset(score)
        return score

    def live(self, rows: int) -> tuple[Floats, Floats]:
        """Return regressors, (1, K), and what they are to forecast, (1, D), of the latest row."""
        return self._regressors(rows), self._live[1]

    def _regressors(self, rows: int) -> Floats:
        """Return what a forecast uses of so many of the latest standardized rows, (1, K)."""
        window = self._live[0][:rows]
        parts = [self._levels(window).ravel()]
        if self.actions:
            commands = list(self._commands)[self.lag - 1 :][: len(window)]
            known = np.zeros((len(window), len(self.action_scale_.mean)))
            if commands:
                known[: len(commands)] = commands
            parts.append(known.ravel())
        return np.concatenate([*parts, np.ones(1)])[None]

    # From features to the statistic.

    def _surprises(self, features: Features) -> Floats:
        """Return the members' surprises, (N, K)."""
        lengths = [m.lengths(m.features(features)) for m in self.members_]
        return self._surprised(np.stack(lengths, axis=1))

    def _surprised(self, lengths: Floats) -> Floats:
        """Return the surprises of the members' lengths, (N, K)."""
        return np.stack([tail(x) for tail, x in zip(self.tails_, lengths.T, strict=True)], axis=1)

    def _said(self, visible: Trajectory, judged: Features | None) -> dict[str, Floats]:
        """Return what the voices say of the rows of a trajectory at training's level."""
        h, every = self.horizon, {}
        for name, scale in self.scales_.items():
            said = every[name] = np.full(len(visible), np.nan)
            said[h:] = 0.0
            if judged is not None:
                members = name == MEMBERS_VOICE
                rows = (
                    _combined(self._surprises(judged))
                    if members
                    else self.voices_[name].rows(visible)
                )
                said[h:] = scale(rows)
                said[h : self.baseline] = 0.0
        return every

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
            shares[rows] = shares_of(parts.reshape(len(parts), -1, sensors).sum(axis=1))
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
        visible = [self._visible(x) for x in usable]
        self._namer = LatestRowsNamer.fit(
            visible if self.actions else [x.without_actions() for x in visible]
        )
        rows = [self._standard(x.observations) for x in visible]
        self.basis_ = _basis(rows) if len(scale.mean) > DIMENSIONS else np.empty((0, 0))
        episodes = [self._of_rows(r, x) for r, x in zip(rows, visible, strict=True)]
        self._dimensions = episodes[0].rows.shape[1]

        folds = _folds(list(zip(rows, episodes, strict=True)), self.horizon)
        plain = [[episode for _, episode in fold] for fold in folds]
        ridge = chosen_ridge(plain, self.horizon)
        varies = self.varies_ = self._varies(list(zip(rows, episodes, strict=True)), ridge)
        lengths: list[Floats] = []
        for i, fold in enumerate(folds):
            others = [x for j, other in enumerate(folds) if j != i for x in other] or fold
            forecast, members = self._fitted(others, ridge, varies=varies)
            for fold_rows, episode in fold:
                lengths.append(self._lengths(forecast, members, fold_rows, episode))
        self.tails_ = _tails(lengths)
        statistics = [_combined(self._surprised(x)) for x in lengths]
        self.forecast_, self.members_ = self._fitted(
            list(zip(rows, episodes, strict=True)), ridge, varies=varies
        )
        scale_of_members = VoiceScale().fit(statistics)
        self.voices_, self.scales_ = {}, {MEMBERS_VOICE: scale_of_members}
        for voice in self._new_voices():
            if of_voice := voice.fit(visible):
                self.voices_[voice.name] = voice
                of_episodes = VoiceScale().fit(of_voice)
                self.scales_[voice.name] = of_episodes.brought_to(scale_of_members, voice.weight)
        if EnsembleVoice.name in self.voices_:
            # An episode that is new to a linear forecast need not be new to networks.
            scale_of_members.limit()
        return scale

    def _new_voices(self) -> list[Voice]:
        """Return unfitted voices, each of which may ask for what those before it are."""
        return [ConstantsVoice(self), EnsembleVoice(self), FrameVoice(self)]

    def _fitted(
        self, episodes: Sequence[tuple[Floats, StandardEpisode]], ridge: float, *, varies: bool
    ) -> tuple[LinearForecast, list[PanelMember]]:
        forecast = LinearForecast.fit(
            [episode for _, episode in episodes], self.horizon, ridge, varies=varies
        )
        total = sum(len(rows) for rows, _ in episodes)
        step = -(-total // SAMPLE)
        members: list[PanelMember] = [kind() for kind in MEMBERS]
        seen: list[list[Floats]] = [[] for _ in MEMBERS]
        for x in episodes:
            features = self._steps(*x, forecast)
            for parts, member in zip(seen, members, strict=True):
                # A copy of some rows: the others need not stay in memory.
                parts.append(member.features(features)[::step].copy())
        for parts, member in zip(seen, members, strict=True):
            member.fit(np.concatenate(parts))
        return forecast, members

    def _varies(self, episodes: Sequence[tuple[Floats, StandardEpisode]], ridge: float) -> bool:
        """Tell whether the coefficients of an episode are learnt from its first rows."""
        width = ORDER * (self._dimensions + episodes[0][1].actions.shape[1]) + 1
        if not self.learnt or len(episodes) < VARYING or width > WIDEST:
            return False
        if self.parameters.learn != "auto":
            return True
        long = [x for x in episodes if len(x[0]) >= 2 * self.learnt + self.horizon]
        if len(long) < VARYING or len(long) < len(episodes) / 2:
            return False
        plain = [episode for _, episode in long]
        if learning.gain(plain, self.horizon, ridge, self.learnt) < learning.LEAST_GAIN:
            return False
        if self.baseline:
            return True
        shares = [self._early_faults_found(long, ridge, varies=varies) for varies in (True, False)]
        return learning.shows_no_loss(*shares)

    def _early_faults_found(
        self, episodes: Sequence[tuple[Floats, StandardEpisode]], ridge: float, *, varies: bool
    ) -> Floats:
        """Return how well faults in the rows that would be learnt from are found, by episode."""
        parts = []
        for part in (0, 1):
            forecast, members = self._fitted(episodes[1 - part :: 2], ridge, varies=varies)
            left = episodes[part::2][: learning.EPISODES // 2]
            left = [(rows[: 2 * self.learnt], episode) for rows, episode in left]
            judged = partial(self._lengths, forecast, members)
            tails = _tails([judged(*x) for x in left])
            scale = forecast.scale
            if self.basis_.size:
                scale = np.full(left[0][0].shape[1], float(scale.mean()))
            parts.append((left, partial(_statistic, judged, tails), scale))
        return learning.separation(parts, self.horizon)

    def _lengths(
        self,
        forecast: LinearForecast,
        members: Sequence[PanelMember],
        rows: Floats,
        episode: StandardEpisode,
    ) -> Floats:
        """Return the members' lengths, (N, K), of the first rows of an episode."""
        first = StandardEpisode(self._levels(rows), episode.actions[: len(rows) - 1])
        features = self._steps(rows, first, forecast)
        return np.stack([member.lengths(member.features(features)) for member in members], axis=1)

    # State.

    def state(self) -> dict[str, Any]:
        """Return the fit as arrays, with the parameters that it goes with; the voices', too."""
        state = super().state()
        for name, voice in self.voices_.items():
            state |= {f"{name}:{key}": value for key, value in voice.state().items()}
        return state

    def restore(self, state: State) -> None:
        """Take over a fit that `state` returned.

        Raises `FittedStateError` when it is damaged, or of a detector with other parameters.
        """
        self._of_voices = {v.name: (v, _part(state, v.name + ":")) for v in self._new_voices()}
        super().restore({name: value for name, value in state.items() if ":" not in name})

    def _fitted_with(self) -> dict[str, Any]:
        return {
            "actions": self.actions,
            "horizon": self.horizon,
            "baseline": self.baseline,
            "roles": [*self.roles],
            "learn": self.parameters.learn,
        }

    def _arrays(self) -> Arrays:
        arrays: dict[str, NDArray[Any]] = {
            "coefficients": self.forecast_.coefficients,
            "error_scale": self.forecast_.scale,
            "prior": self.forecast_.prior,
            "basis": self.basis_,
            **self._namer.arrays(),
        }
        if self.actions:
            arrays["action_scale"] = np.stack([self.action_scale_.mean, self.action_scale_.std])
        if self.baseline:
            arrays["baseline"] = np.stack([self.baseline_.mean, self.baseline_.std])
        for part in [*zip(self.members_, self.tails_, strict=True)]:
            for holder in part:
                arrays |= {f"{part[0].name}.{n}": a for n, a in holder.arrays().items()}
        for name, scale in self.scales_.items():
            arrays |= {f"{name}.{n}": a for n, a in scale.arrays().items()}
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
        self._namer = LatestRowsNamer.of(arrays)
        self.members_ = [member() for member in MEMBERS]
        for member, tail in zip(self.members_, self.tails_, strict=True):
            for holder in (member, tail):
                holder.restore(_part(arrays, member.name + "."))
        self.widths_ = d, used
        names = [MEMBERS_VOICE, *(name for name, (_, part) in self._of_voices.items() if part)]
        self.scales_ = {name: VoiceScale().restore(_part(arrays, name + ".")) for name in names}
        self.voices_ = {}
        for name in names[1:]:
            self.voices_[name], part = self._of_voices[name]
            self.voices_[name].restore(part)


def _part(state: State, prefix: str) -> dict[str, Any]:
    """Return what a prefix marks in a state, without it."""
    return {n.removeprefix(prefix): a for n, a in state.items() if n.startswith(prefix)}


def _tails(lengths: Sequence[Floats]) -> list[VoiceScale]:
    """Return each member's scale, from the members' lengths in nominal episodes, (N, K) each."""
    by_member = zip(*(x.T for x in lengths), strict=True)
    return [VoiceScale().fit(of_member) for of_member in by_member]


def _statistic(
    judged: Callable[[Floats, StandardEpisode], Floats],
    tails: Sequence[VoiceScale],
    rows: Floats,
    episode: StandardEpisode,
) -> Floats:
    """Return the members' joint surprise of rows, (N,)."""
    lengths = judged(rows, episode)
    surprises = [tail(x) for tail, x in zip(tails, lengths.T, strict=True)]
    return _combined(np.stack(surprises, axis=1))


def _combined(surprises: Floats) -> Floats:
    """Return root mean squares over members, (N, K) to (N,): one that is certain outweighs four."""
    combined: Floats = np.sqrt((surprises * surprises).mean(axis=1))
    return combined


def _in_units(naming: Naming | None, shift: Shift | None) -> Naming | None:
    """Return a naming of an episode at training's level with sizes in the sensors' own units."""
    if naming is None or shift is None:
        return naming
    return naming._replace(sizes=naming.sizes / shift.factor)


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
