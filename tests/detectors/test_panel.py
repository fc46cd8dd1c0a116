"""The panel: its forecast, members and tails by hand and by second formulas, and what it finds."""

import sys
from functools import partial

import numpy as np
import oodd_panel.voices
import pytest
from oodd_common.windows import StandardEpisode, regressors
from oodd_panel import make_panel
from oodd_panel.constants import (
    LAGS,
    MOVED,
    ConstantsForecast,
    EpisodeCharts,
    LargestChart,
    chosen_rank,
    moving_of,
    share_of_noise,
)
from oodd_panel.detector import PanelDetector
from oodd_panel.forecast import EpisodeLearner, LinearForecast, chosen_ridge
from oodd_panel.learning import FAULTS, ONSET, shows_no_loss, with_fault
from oodd_panel.members import (
    ENERGY,
    LEAST_ENERGY,
    MEMBERS,
    RECENT,
    Energy,
    Latest,
    NeighbourDistance,
    Pattern,
    RecentRows,
    Sums,
)
from oodd_panel.voices import Voice, VoiceScale
from oodd_pe import make_pe
from sklearn.decomposition import PCA
from sklearn.neighbors import NearestNeighbors

from oodd_eval import Trajectory, load_split
from oodd_eval.cli.main import main
from oodd_eval.errors import FittedStateError, MissingExtraError, TrajectoryError, UsageError
from oodd_eval.metrics.alarms import GuaranteedAlarm, guaranteed_contributions

MIXING = np.random.default_rng(7).normal(size=(3, 8)) / 2


def log_of(seed, rows=300, gain=1.0, level=0.0):
    """Eight sensors that three slow causes move, with noise; a gain and a level of the episode."""
    rng = np.random.default_rng(seed)
    causes, o = np.zeros(3), np.empty((rows, 8))
    for t in range(rows):
        causes = 0.9 * causes + rng.normal(size=3)
        o[t] = gain * causes @ MIXING + level + 0.3 * rng.normal(size=8)
    return Trajectory(o)


def driven(seed, gain, rows=200, onset=None):
    """One sensor that follows a command with the episode's gain; a lost tenth of it from onset."""
    rng = np.random.default_rng([seed, 1])
    u, o = rng.normal(size=(rows - 1, 1)), np.zeros((rows, 1))
    for t in range(1, rows):
        lost = 0.5 if onset is not None and t >= onset else 0.0
        o[t] = 0.5 * o[t - 1] + (gain - lost) * u[t - 1] + 0.05 * rng.normal()
    return Trajectory(o, u)


def with_step(x, start, stop, by, sensor=2):
    rows = x.observations.copy()
    rows[start:stop, sensor] += by
    return Trajectory(rows, x.actions)


@pytest.fixture(scope="module")
def panel():
    return make_panel().fit([log_of(seed) for seed in range(10)])


# The forecast


def test_regressors_hold_three_rows_and_three_actions_newest_first_then_one():
    rows, actions = np.array([[1.0], [2.0], [3.0], [4.0]]), np.array([[10.0], [20.0], [30.0]])
    expected = [[1, 1, 1, 10, 0, 0, 1], [2, 1, 1, 20, 10, 0, 1], [3, 2, 1, 30, 20, 10, 1]]
    assert regressors(StandardEpisode(rows, actions), 1, order=3).tolist() == expected
    assert regressors(StandardEpisode(rows, actions), 2, order=3).tolist() == expected[:2]
    assert regressors(StandardEpisode(rows[:1], actions[:0]), 1, order=3).shape == (0, 7)


def test_learnt_coefficients_are_the_posterior_mean_of_bayesian_regression():
    rng = np.random.default_rng(0)
    k, d, n = 4, 2, 30
    x, y = rng.normal(size=(n, k)), rng.normal(size=(n, d))
    root = rng.normal(size=(k, k))
    prior, mean, scale = 0.1 * root @ root.T, rng.normal(size=(k, d)), np.array([2.0, 3.0])
    learner = EpisodeLearner(LinearForecast(mean, scale, prior), 25)
    errors = learner(x, y)
    # Row 20 by normal equations, of the rows before it.
    precision = np.linalg.inv(prior)
    covariance = np.linalg.inv(precision + x[:20].T @ x[:20])
    posterior = covariance @ (precision @ mean + x[:20].T @ y[:20])
    spread = np.sqrt(1 + x[20] @ covariance @ x[20])
    assert np.abs(errors[:25]).max() < 4  # so that no error was limited
    np.testing.assert_allclose(errors[20], (y[20] - x[20] @ posterior) / scale / spread)
    # Rows beyond the first ones teach nothing.
    wild = np.r_[y[:25], y[25:28] + 50.0, y[28:]]
    after = EpisodeLearner(LinearForecast(mean, scale, prior), 25)(x, wild)
    np.testing.assert_array_equal(after[28:], errors[28:])


def plain_episodes(gains, seed=0):
    episodes = [driven(seed + i, gain) for i, gain in enumerate(gains)]
    return [
        StandardEpisode(x.observations.astype(float), x.actions.astype(float)) for x in episodes
    ]


def test_variance_of_coefficients_between_episodes_is_recovered():
    gains = 1.0 + 0.3 * np.random.default_rng(2).normal(size=60)
    forecast = LinearForecast.fit(plain_episodes(gains), 1, 1e-6, varies=True)
    assert forecast.scale[0] == pytest.approx(0.05, rel=0.05)
    # The newest action is the fourth regressor; its prior is in units of the errors' variance.
    assert np.sqrt(forecast.prior[3, 3]) * 0.05 == pytest.approx(gains.std(), rel=0.1)
    assert forecast.coefficients[3, 0] == pytest.approx(gains.mean(), abs=0.02)
    equal = make_panel("panel-a", forecast="linear").fit([driven(seed, 1.0) for seed in range(24)])
    assert equal.forecast_.prior.shape == (0, 0)


def test_the_chosen_ridge_is_small_for_an_exact_system_and_large_for_noise():
    rng = np.random.default_rng(3)
    noise = [[StandardEpisode(rng.normal(size=(30, 6)), np.empty((29, 0)))] for _ in range(5)]
    exact = [
        [StandardEpisode(np.cumprod(np.r_[1.0, np.full(29, 0.9)])[:, None] * v, np.empty((29, 0)))]
        for v in (1, 2, -1, 3, -2)
    ]
    assert chosen_ridge(noise, 1) == 1.0
    assert chosen_ridge(exact, 1) == 1e-4


# Constants of an episode


def random_charts(rank, seed=14, sensors=2, actions=1):
    """A forecast of random numbers and regressors for it."""
    rng = np.random.default_rng(seed)
    k, g = LAGS * (sensors + actions) + 1, 2 * (sensors + actions) + 1
    forecast = ConstantsForecast(
        rng.normal(size=(k, sensors)), rng.normal(size=(rank, g, sensors)), np.array([2.0, 3.0])
    )
    return forecast, rng.normal(size=(400, k))


def test_coefficients_move_of_means_over_lags_and_of_latest_values():
    rows = np.arange(1.0, 15.0).reshape(7, 2)
    regressed = regressors(StandardEpisode(rows, np.full((6, 1), 5.0)), 1, LAGS)
    assert regressed.shape == (6, LAGS * 3 + 1)
    # Before the last row, six rows with means 6 and 7, and six actions of 5.
    assert moving_of(regressed, 2)[-1].tolist() == [6.0, 7.0, 11.0, 12.0, 5.0, 5.0, 1.0]


def test_constants_have_the_spread_of_what_was_drawn():
    gains = 1.0 + 0.3 * np.random.default_rng(15).normal(size=60)
    forecast = ConstantsForecast.fit(plain_episodes(gains), 1, 1)
    assert forecast.error_scale[0] == pytest.approx(0.05, rel=0.1)
    # The latest action stands after the lags of the sensor, and of what moves in the fourth place.
    assert forecast.coefficients[LAGS, 0] == pytest.approx(gains.mean(), abs=0.05)
    assert np.abs(forecast.matrices[0, 3, 0]) == pytest.approx(gains.std(), rel=0.1)


def test_the_rank_is_that_which_forecasts_other_episodes():
    rng = np.random.default_rng(16)
    assert chosen_rank(plain_episodes(np.ones(20)), 1, 60) == 0
    levels = [
        StandardEpisode(level + 0.1 * rng.normal(size=(200, 3)), np.empty((199, 0)))
        for level in rng.normal(size=(20, 3))
    ]
    assert chosen_rank(levels, 1, 60) > 0


def test_constants_are_learnt_as_by_normal_equations():
    forecast, x = random_charts(3)
    rng = np.random.default_rng(17)
    drawn, directions = rng.normal(size=3), moving_of(x, 2)
    noise = rng.normal(size=(400, 2)) * forecast.error_scale
    effect = np.einsum("ng,rgd->nrd", directions, forecast.matrices)
    y = x @ forecast.coefficients + np.einsum("nrd,r->nd", effect, drawn) + noise
    errors = EpisodeCharts(forecast, 60).errors(x, y)
    scaled = effect / forecast.error_scale
    left = (y - x @ forecast.coefficients) / forecast.error_scale
    precision = np.eye(3) + np.einsum("nrd,nsd->rs", scaled[:60], scaled[:60])
    posterior = np.linalg.solve(precision, np.einsum("nrd,nd->r", scaled[:60], left[:60]))
    spread = np.einsum("rd,rs,sd->d", scaled[99], np.linalg.inv(precision), scaled[99])
    assert np.abs(errors[:60]).max() < 4  # so that no error was limited
    np.testing.assert_allclose(
        errors[99], (left[99] - posterior @ scaled[99]) / np.sqrt(1 + spread)
    )


def test_the_test_of_constants_is_chi_square_until_one_of_them_moves():
    forecast, x = random_charts(4)
    rng = np.random.default_rng(18)
    effect = np.einsum("ng,rgd->nrd", moving_of(x, 2), forecast.matrices)
    still, moved = [], []
    for _ in range(40):
        noise = rng.normal(size=(400, 2)) * forecast.error_scale
        constants = np.tile(rng.normal(size=4), (400, 1))
        for held, shift in ((still, 0.0), (moved, 0.5)):
            constants[200:, 1] += shift
            y = x @ forecast.coefficients + np.einsum("nrd,nr->nd", effect, constants) + noise
            held.append(EpisodeCharts(forecast, 60)(x, y)[:, -len(MOVED) :] ** 2)
    # The expectation of chi-square is its degrees of freedom.
    np.testing.assert_allclose(np.mean(still, axis=0)[150:].mean(axis=0), 4.0, rtol=0.15)
    assert (np.mean(moved, axis=0)[260] > 6.0).all()
    np.testing.assert_array_equal(moved[0][:200], still[0][:200])


@pytest.mark.parametrize("rank", [0, 3])
def test_charts_are_the_same_for_one_row_at_a_time_as_for_many(rank):
    forecast, x = random_charts(rank)
    y = np.random.default_rng(19).normal(size=(400, 2))
    charts = EpisodeCharts(forecast, 60)
    steps = [charts(x[t : t + 1], y[t : t + 1]) for t in range(100)]
    np.testing.assert_array_equal(np.concatenate(steps), EpisodeCharts(forecast, 60)(x, y)[:100])


def test_the_largest_chart_counts_in_units_of_its_largest_nominal_values():
    charts = [np.array([[1.0, 0.0], [0.0, 10.0]]), np.array([[3.0, 30.0]])]
    largest = LargestChart.fit(charts)
    # Largest values 1 and 3, 10 and 30: means 2 and 20, deviations 1 and 10.
    np.testing.assert_allclose(largest(np.array([[4.0, 0.0], [2.0, 50.0]])), [2.0, 3.0])


def test_noise_is_told_from_heavy_tails_by_its_kurtosis():
    rng = np.random.default_rng(20)
    errors = np.c_[rng.normal(size=4000), rng.standard_t(3, size=4000), np.zeros(4000)]
    assert share_of_noise([np.abs(errors)], 3) == pytest.approx(1 / 3)


# Features and members


def test_features_are_the_same_for_one_row_at_a_time_as_for_many():
    rng = np.random.default_rng(4)
    rows, errors = rng.normal(size=(40, 7)), rng.normal(size=(40, 3))
    batch, latest = Latest(3, 4, rows[0])(rows, errors), Latest(3, 4, rows[0])
    steps = [latest(rows[t : t + 1], errors[t : t + 1]) for t in range(40)]
    for whole, *parts in zip(batch, *steps, strict=True):
        np.testing.assert_array_equal(whole, np.concatenate(parts))


def test_energy_is_the_logarithm_of_the_mean_square_of_the_latest_errors():
    errors = np.arange(1.0, 13.0)[:, None]
    energy = Latest(1, 2, errors[0])(errors, errors).energy[:, 0]
    # Errors before the beginning count as 1.
    assert energy[0] == pytest.approx(np.log((1 + 9) / 10 + LEAST_ENERGY))
    assert energy[1] == pytest.approx(np.log((1 + 4 + 8) / 10 + LEAST_ENERGY))
    assert energy[11] == pytest.approx(np.log((errors[2:] ** 2).mean() + LEAST_ENERGY))
    assert len(errors[2:]) == ENERGY


@pytest.mark.parametrize(
    "member", [Sums(), Energy(), RecentRows()], ids=["sums", "energy", "recent"]
)
def test_contributions_to_a_length_add_up_to_its_square(member):
    rng = np.random.default_rng(5)
    member.fit(rng.normal(size=(200, 4)) @ rng.normal(size=(4, 4)))
    lengths, parts = member.differences(rng.normal(size=(9, 4)))
    np.testing.assert_allclose(parts.sum(axis=1), lengths**2)


@pytest.mark.parametrize("rows", [400, 6], ids=["many rows", "fewer rows than features"])
def test_a_pattern_is_what_principal_components_leave(rows):
    rng = np.random.default_rng(6)
    nominal = rng.normal(size=(rows, 3)) @ rng.normal(size=(3, 10)) + 0.01 * rng.normal(
        size=(rows, 10)
    )
    member, seen = Pattern(), rng.normal(size=(5, 10))
    member.fit(nominal)
    pca = PCA(member.components_.shape[1], svd_solver="full").fit(nominal)
    left = seen - pca.inverse_transform(pca.transform(seen))
    np.testing.assert_allclose(member.lengths(seen), np.linalg.norm(left, axis=1), rtol=1e-6)
    assert pca.explained_variance_ratio_.sum() >= 0.9
    assert pca.explained_variance_ratio_[:-1].sum() < 0.9


@pytest.mark.parametrize("rows", [400, 60], ids=["many rows", "fewer rows than features"])
def test_recent_rows_are_judged_by_t_squared_and_q_of_the_other_half(rows):
    rng = np.random.default_rng(16)
    mixing = rng.normal(size=(3, 80))
    nominal = rng.normal(size=(rows, 3)) @ mixing + 0.1 * rng.normal(size=(rows, 80))
    seen, member = 2 * rng.normal(size=(5, 80)), RecentRows()
    member.fit(nominal)

    def both(fitted, judged):
        scores = fitted.transform(judged)
        left = judged - fitted.inverse_transform(scores)
        variances = fitted.explained_variance_ * (1 - 1 / fitted.n_samples_)
        return np.stack([(scores**2 / variances).sum(axis=1), (left**2).sum(axis=1)])

    halves = np.array_split(nominal, 2)
    pcas = [PCA(RECENT, svd_solver="full").fit(half) for half in halves]
    limits = np.quantile(
        np.concatenate([both(pcas[1], halves[0]), both(pcas[0], halves[1])], axis=1), 0.99, axis=1
    )
    expected = both(PCA(RECENT, svd_solver="full").fit(nominal), seen) / limits[:, None]
    np.testing.assert_allclose(member.lengths(seen), np.sqrt(expected.sum(axis=0)), rtol=1e-6)


def test_recent_rows_of_no_variance_are_judged():
    member = RecentRows()
    member.fit(np.ones((30, 4)))
    np.testing.assert_allclose(member.lengths(np.array([[1.0, 1, 1, 1], [3, 1, 1, 1]])), [0, 2])


def test_neighbours_are_those_of_a_brute_search():
    rng = np.random.default_rng(8)
    nominal, seen = rng.normal(size=(300, 6)), rng.normal(size=(20, 6))
    member = NeighbourDistance()
    member.fit(nominal)
    search = NearestNeighbors(n_neighbors=5).fit(nominal)
    np.testing.assert_allclose(member.lengths(seen), search.kneighbors(seen)[0].mean(axis=1))
    np.testing.assert_allclose(member.lengths(seen), member.differences(seen)[0])


# Voices


class Column(Voice):
    """The size of one sensor's readings as a voice."""

    def __init__(self, column):
        self.name, self.column = f"column {column}", column

    def fit(self, episodes):
        return [self.rows(x) for x in episodes]

    def rows(self, episode):
        return np.abs(episode.observations[1:, self.column]).astype(float)

    def shares(self, episode):
        return np.tile(np.eye(episode.observation_dim)[self.column], (episode.transitions, 1))

    def reset(self):
        self.t = -1

    def update(self, observation, action):
        self.t += 1
        return np.nan if self.t == 0 else abs(float(observation[self.column]))

    def shares_last(self):
        return np.eye(2)[self.column]

    def state(self):
        return {"column": self.column}

    def restore(self, state):
        assert state["column"] == self.column


def spoilt(seed, by=0.0):
    """Two sensors, of which the second has a heavy tail in a tenth of the episodes."""
    rng = np.random.default_rng([seed, 6])
    rows = rng.normal(size=(200, 2))
    if seed % 10 == 0:
        rows[rng.integers(20, 180) :][:8, 1] *= 1e3 * np.exp(rng.normal())
    rows[120:, 0] += by
    return Trajectory(rows)


def test_a_panel_without_its_networks_is_unavailable(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    for name in [name for name in sys.modules if name.startswith("oodd_pe.")]:
        monkeypatch.delitem(sys.modules, name)
    panel = make_panel("panel", seed=0, horizon=1, forecast="ensemble")
    with pytest.raises(MissingExtraError, match=r"needs torch: install oodd-eval\[reference\]"):
        panel.fit([log_of(seed) for seed in range(20)])


def test_a_voice_with_a_heavy_tail_does_not_set_the_threshold(monkeypatch):
    columns = lambda _: [Column(0), Column(1)]  # noqa: E731  in place of a method
    monkeypatch.setattr(PanelDetector, "_new_voices", columns)
    panel = make_panel(forecast="linear").fit([spoilt(seed) for seed in range(40)])
    nominal = [panel.voices(spoilt(seed)) for seed in range(40, 80)]
    faulty = [panel.voices(spoilt(seed, by=5.0)) for seed in range(81, 90)]

    def share(of):
        largest = sorted(np.nanmax(of(said)) for said in nominal)
        return np.mean([np.nanmax(of(said)[120:140]) > largest[38] for said in faulty])

    good = share(lambda said: said["column 0"])
    assert good > 0.9
    assert share(lambda said: np.max([*said.values()], axis=0)) >= good
    assert share(lambda said: said["column 1"]) < 0.1
    test = spoilt(81, by=5.0)
    assert (panel.explain(test).shares[125:, 0] == 1).all()
    restored = make_panel(forecast="linear")
    restored.restore(panel.state())
    streamed = [restored.update(row) for row in test.observations]
    np.testing.assert_array_equal(streamed, panel.score(test))
    assert restored.explain_last()[0].tolist() == [1.0, 0.0]


def test_a_scale_tells_values_beyond_all_nominal_ones_apart():
    rng = np.random.default_rng(30)
    scale = VoiceScale().fit([rng.exponential(size=200) for _ in range(40)])
    surprises = scale(np.array([1.0, 5.0, 20.0, 40.0]))
    # Of an exponential distribution the surprise is the value; the largest of 200 is about 6.
    np.testing.assert_allclose(surprises[:2], [1.0, 5.0], rtol=0.1)
    assert (np.diff(surprises) > 1.0).all()
    assert float(scale.unit_) == pytest.approx(7.2, rel=0.1)
    heavy = VoiceScale().fit([np.exp(2 * rng.exponential(size=200)) for _ in range(40)])
    assert heavy.tail_[0] >= 0.8
    assert float(heavy.unit_) == pytest.approx(7.2, rel=0.2)
    few = VoiceScale().fit([np.arange(100.0)])
    assert np.isfinite(few(np.array([-np.inf, 0.0, 1e6]))).all()


@pytest.mark.slow
def test_no_voice_costs_three_points_of_what_the_best_voice_alone_finds(tmp_path):
    pytest.importorskip("mujoco")
    sizes = {"train": 40, "calibration": 40, "test": 10, "cap": 300, "seed-base": 744}
    options = [f"--{name}={size}" for name, size in sizes.items()]
    main(["data", "build", "voices", *options, "--output", str(tmp_path / "split")])
    split = load_split(tmp_path / "split")
    assert len(split.environments) == 7
    losses = []
    for environment in split.environments:
        data = split.environment(environment)
        panel = make_panel().fit([x.without_actions() for x in data.train])
        said = {
            part: [panel.voices(x.without_actions()) for x in rows]
            for part, rows in {
                "nominal": data.calibration,  # one kind of anomaly has the name calibration
                "twins": data.twins,
                **{name: data.anomalous(name) for name in data.anomalies},
            }.items()
        }

        def share(of, said=said, data=data):
            scores = {part: [of(x) for x in rows] for part, rows in said.items()}
            rule = GuaranteedAlarm.fit(scores["nominal"], 0.05, "score")
            cells = [
                guaranteed_contributions(
                    scores[name], scores["twins"], data.anomalous(name).effects, rule
                )["found_within_20"]
                for name in data.anomalies
            ]
            return np.nanmean([cell.value for cell in cells])

        alone = [share(lambda x, voice=voice: x[voice]) for voice in said["twins"][0]]
        joined = share(lambda x: np.max([*x.values()], axis=0))
        losses.append(max(alone) - joined)
        # CartPole misses the bound: members and charts cost the ensemble six of 80 episodes.
        bound = 0.08 if environment == "cartpole" else 0.03
        assert losses[-1] <= bound, (environment, losses)
    assert np.mean(losses) <= 0.03, losses


# The panel


def test_ten_episodes_name_the_sensor_and_the_onset(panel):
    faulty = with_step(log_of(50), 200, 300, 3.0, sensor=5)
    shares, onsets, *_ = panel.explain(faulty)
    assert np.isnan(shares[0]).all()
    assert onsets[0] == -1
    assert (shares[205:].argmax(axis=1) == 5).mean() > 0.8
    assert abs(np.median(onsets[210:]) - 200) <= 10


def test_the_statistic_comes_down_within_sixty_rows_after_a_fault(panel):
    largest = sorted(np.nanmax(panel.score(log_of(seed))) for seed in range(100, 119))
    returned = []
    for seed in range(200, 220):
        scores = panel.score(with_step(log_of(seed), 100, 180, 3.0))
        assert np.nanmax(scores[100:180]) > largest[-1]
        returned.append(np.nanmax(scores[240:]) <= largest[-1])
    assert np.mean(returned) >= 0.9


def test_members_are_surprised_by_what_they_look_at(panel):
    rows = log_of(51).observations.copy()
    rows[150:, 3] += np.where(np.arange(150) % 2, 4.0, -4.0)
    judged = panel._judged(Trajectory(rows))
    typical = np.median(panel._surprises(judged)[170:], axis=0)
    surprise = dict(zip([member.name for member in MEMBERS], typical, strict=True))
    # Errors of alternating sign cancel in sums, and not in squares.
    assert surprise["energy"] > 1.5 * surprise["sums"]


def test_a_level_of_the_day_is_taken_out_with_baseline_rows():
    nominal = [log_of(seed, level=seed % 3) for seed in range(10)]
    panel = make_panel(baseline=60).fit(nominal)
    test, moved = log_of(70), log_of(70, level=40.0)
    scores = panel.score(test)
    np.testing.assert_allclose(scores[60:], panel.score(moved)[60:], atol=1e-3)
    assert (scores[1:60] == 0).all()
    panel.reset()
    np.testing.assert_array_equal([panel.update(row) for row in test.observations], scores)
    # A live episode counts its rows from the first one, too.
    faulty = with_step(test, 120, 200, 2.0)
    panel.reset()
    for row in faulty.observations[:150]:
        panel.update(row)
    assert panel.explain_last()[1] == panel.explain(faulty).onsets[149] == pytest.approx(120, abs=5)


def test_what_differs_between_episodes_is_learnt_from_their_first_rows():
    gains = np.random.default_rng(11).uniform(0.5, 1.5, size=24)
    nominal = [driven(seed, gain) for seed, gain in enumerate(gains)]
    panel = make_panel("panel-a", forecast="linear").fit(nominal)
    assert panel.forecast_.prior.size
    calibration = [driven(100 + seed, gain) for seed, gain in enumerate(gains)]
    threshold = max(np.nanmax(panel.score(x)) for x in calibration)
    faulty = [driven(200 + seed, gain, onset=120) for seed, gain in enumerate(gains)]
    assert np.mean([np.nanmax(panel.score(x)[120:]) > threshold for x in faulty]) > 0.9


def settled(seed, by=0.0):
    """Two sensors about a level; from row 20 on one of them is off."""
    rng = np.random.default_rng([seed, 5])
    rows = rng.normal(size=(160, 2))
    rows[20:, 0] += by
    return Trajectory(rows)


def test_identical_episodes_are_not_learnt_so_an_early_fault_is_found():
    nominal = [settled(seed) for seed in range(20)]
    faulty = [settled(200 + seed, by=1.5) for seed in range(10)]
    panel, learning = (make_panel(learn=learn).fit(nominal) for learn in ("auto", 60))
    assert not panel.forecast_.prior.size
    assert learning.forecast_.prior.size
    np.testing.assert_array_equal(
        panel.score(faulty[0]), make_panel(learn="none").fit(nominal).score(faulty[0])
    )
    late = [[p.score(x)[100:].mean() for x in faulty] for p in (panel, learning)]
    assert np.mean(late[0]) > np.mean(late[1])


@pytest.mark.parametrize(
    ("learn", "baseline", "rows"),
    [("none", 0, 0), ("none", 40, 0), ("baseline", 0, 0), ("baseline", 40, 39), (25, 0, 24),
     (25, 40, 24), (0, 40, 0), ("auto", 0, 59), ("auto", 40, 39)],
)  # fmt: skip
def test_as_many_rows_of_an_episode_are_learnt_as_asked_for(learn, baseline, rows):
    gains = np.random.default_rng(11).uniform(0.5, 1.5, size=12)
    nominal = [driven(seed, gain) for seed, gain in enumerate(gains)]
    panel = make_panel("panel-a", forecast="linear", learn=learn, baseline=baseline).fit(nominal)
    assert panel.learnt == rows
    assert bool(panel.forecast_.prior.size) == bool(rows)
    x = driven(300, 0.6)
    learner = EpisodeLearner(panel.forecast_, panel.learnt)
    episode = panel.standardized(x)
    learner(regressors(episode, 1, order=3)[:rows], episode.rows[1 : 1 + rows])
    before = learner.coefficients
    learner(regressors(episode, 1, order=3)[rows:], episode.rows[1 + rows :])
    assert learner.coefficients is before
    assert np.array_equal(before, panel.forecast_.coefficients) == (rows == 0)


def test_faults_are_put_into_a_fifth_of_the_sensors_from_row_15_on():
    rows, generator = np.random.default_rng(3).normal(size=(60, 10)), np.random.default_rng(0)
    for fault in FAULTS:
        spoilt = with_fault(rows, np.ones(10), fault, generator)
        np.testing.assert_array_equal(spoilt[:ONSET], rows[:ONSET])
        changed = (spoilt[ONSET:] != rows[ONSET:]).any(axis=0).sum()
        assert changed == (10 if fault[0] == "slow" else 2)


def test_learning_must_gain_more_than_the_standard_error():
    without = np.linspace(0.5, 0.7, 16)
    assert shows_no_loss(without + 0.01, without)
    assert not shows_no_loss(without - 0.01, without)
    assert not shows_no_loss(without + np.tile([0.3, -0.29], 8), without)


def pumped(seed, gain, onset=None):
    """A level that follows a pump near a voltage of 3 with the episode's gain; a tenth is lost."""
    rng = np.random.default_rng([seed, 4])
    u, level = 3.0 + 0.3 * rng.normal(size=(199, 1)), np.empty((200, 1))
    level[0] = 2 * 3 * gain
    for t in range(1, 200):
        share = 0.9 if onset is not None and t >= onset else 1.0
        level[t] = 0.5 * level[t - 1] + share * gain * u[t - 1] + 0.1 * rng.normal()
    return Trajectory(level, u)


@pytest.fixture(scope="module")
def charting():
    gains = np.random.default_rng(21).uniform(0.9, 1.1, size=32)
    nominal = [pumped(seed, gain) for seed, gain in enumerate(gains)]
    return make_panel("panel-a", forecast="linear").fit(nominal)


def test_charts_of_constants_are_a_voice_that_streams_and_is_restored(charting):
    assert charting.voices_["charts"].rank
    faulty = pumped(301, 1.05, onset=120)
    scores, (shares, onsets, *_) = charting.score(faulty), charting.explain(faulty)
    said = charting.voices(faulty)["charts"][1:]
    assert said[150:].min() > said[:110].max()
    restored = make_panel("panel-a", forecast="linear")
    restored.restore(charting.state())
    np.testing.assert_array_equal(restored.score(faulty), scores)
    prefix = Trajectory(faulty.observations[:151], faulty.actions[:150])
    np.testing.assert_array_equal(charting.score(prefix), scores[:151])
    actions = [None, *faulty.actions]
    for t, (row, action) in enumerate(zip(faulty.observations, actions, strict=True)):
        np.testing.assert_array_equal(restored.update(row, action), scores[t])
        share, onset, *_ = restored.explain_last()
        np.testing.assert_array_equal(share, shares[t])
        assert onset == onsets[t]


def test_a_sensor_that_always_jumps_hides_no_fault_of_the_others():
    def with_set_point(seed, by=0.0):
        rng = np.random.default_rng([seed, 3])
        rows = np.c_[rng.normal(size=(200, 2)), np.repeat(rng.normal(size=10), 20)]
        rows[150:, 0] += by
        return Trajectory(rows)

    panel = make_panel(forecast="linear").fit([with_set_point(seed) for seed in range(32)])
    faulty = with_set_point(90, by=1.5)
    said = panel.voices(faulty)["charts"]
    assert said[170:].min() > said[:150][LAGS + 1 :].max()
    assert (panel.explain(faulty)[0][175:].argmax(axis=1) == 0).mean() > 0.8


def test_more_sensors_than_components_are_forecast_by_components():
    rng = np.random.default_rng(12)
    mixing = rng.normal(size=(3, 100))

    def wide(seed):
        draw = np.random.default_rng([seed, 2])
        return Trajectory(draw.normal(size=(80, 3)) @ mixing + 0.1 * draw.normal(size=(80, 100)))

    panel = make_panel().fit([wide(seed) for seed in range(6)])
    assert panel.forecast_.coefficients.shape == (3 * 64 + 1, 64)
    faulty = with_step(wide(50), 40, 80, 5.0, sensor=77)
    shares, *_ = panel.explain(faulty)
    assert (shares[45:].argmax(axis=1) == 77).mean() > 0.8


def test_the_ensemble_is_a_voice_where_it_is_asked_for(monkeypatch):
    quick = partial(make_pe, updates=60, members=1, width=16)
    monkeypatch.setattr(oodd_panel.voices, "make_pe", quick)
    nominal = [driven(seed, 1.0, rows=60) for seed in range(8)]
    panel = make_panel("panel-a", forecast="ensemble").fit(nominal)
    test = driven(90, 1.0, rows=60, onset=30)
    scores = panel.score(test)
    said = panel.voices(test)
    assert [*said] == ["members", "ensemble"]
    np.testing.assert_array_equal(np.max([*said.values()], axis=0), scores)
    restored = make_panel("panel-a", forecast="ensemble")
    restored.restore(panel.state())
    np.testing.assert_array_equal(restored.score(test), scores)
    restored.reset()
    actions = [None, *test.actions]
    streamed = [restored.update(*x) for x in zip(test.observations, actions, strict=True)]
    np.testing.assert_allclose(streamed, scores, rtol=1e-9)
    alone = make_panel("panel-a", forecast="linear").fit(nominal)
    assert [*alone.voices(test)] == ["members"]
    assert not np.array_equal(alone.score(test), scores, equal_nan=True)


def test_states_of_other_settings_and_bad_arguments_are_refused(panel):
    for other in (make_panel(baseline=5), make_panel("panel-a")):
        with pytest.raises(FittedStateError):
            other.restore(panel.state())
    with pytest.raises(UsageError, match="forecast"):
        make_panel(forecast="cubic")
    with pytest.raises(TrajectoryError, match="at least one that long"):
        make_panel().fit([Trajectory(np.zeros((1, 2)))])
