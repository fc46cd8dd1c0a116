"""Detectors that learn from failed episodes, on processes whose probabilities are known."""

import numpy as np
import pytest
from helpers_state import assert_zero_scales_are_refused
from oodd_outcomes import oodd_detectors
from oodd_outcomes.detector import RunningFeatures
from oodd_outcomes.learning import learn, probabilities, weights_of

from oodd_eval import Trajectory
from oodd_eval.errors import FittedStateError, TrajectoryError, UsageError
from oodd_eval.metrics.auc import auc

SPECS = {spec.name: spec for spec in oodd_detectors()}
NAMES = [*SPECS]


def unfitted(name, **values):
    return SPECS[name].factory(seed=0, horizon=1, **values)


def bare(rows):
    rows = np.asarray(rows, np.float32)
    return Trajectory(rows, np.zeros((len(rows) - 1, 0), np.float32))


def fitted(name, episodes, **values):
    """Fit on pairs of rows and outcome."""
    parts = [[bare(x) for x, *_, y in episodes if y == outcome] for outcome in (0, 1)]
    return unfitted(name, **values).fit(*parts)


def walk(rng, outcome, rows=60, drift=0.2):
    """Return a walk that drifts by outcome, the probability of failure by row, and the outcome.

    It is the posterior of the outcome, both of which are equally frequent beforehand.
    """
    s = np.cumsum(rng.normal(drift * (2 * outcome - 1), 1, rows))
    return s[:, None], 1 / (1 + np.exp(-2 * drift * s)), outcome


def passage(rng, kinds=6, rows=(10, 20)):
    """Return a stage of one of six kinds and a second one that alone decides, as `walk` does."""
    kind = rng.integers(kinds)
    chance = np.linspace(0.1, 0.9, kinds)[kind]  # of the bad second stage
    bad = rng.random() < chance
    after = 0.8 if bad else 0.2
    x = 0.1 * rng.normal(size=(sum(rows), kinds + 1))
    x[: rows[0], kind] += 1
    x[rows[0] :, kinds] += 1 if bad else -1
    truth = np.repeat([0.8 * chance + 0.2 * (1 - chance), after], rows)
    return x, truth, int(rng.random() < after)


def some(rng, count, rows=60):
    return [walk(rng, i % 2, rows) for i in range(count)]


TRAINING = some(np.random.default_rng(0), 40)
FRESH = some(np.random.default_rng(1), 60)


@pytest.fixture(scope="module")
def detectors():
    return {name: fitted(name, TRAINING) for name in NAMES}


# All of them


@pytest.mark.parametrize("name", NAMES)
def test_scores_are_probabilities_of_rows_so_far(name, detectors):
    x = bare(1e4 * FRESH[0][0])  # far from training
    scores = detectors[name].score(x)
    assert scores.dtype == np.float64
    assert scores.shape == (60,)
    assert ((scores >= 0) & (scores <= 1)).all()
    near = bare(FRESH[0][0])
    whole = detectors[name].score(near)
    assert detectors[name].score(near[:23]).tolist() == whole[:23].tolist()
    detectors[name].reset()
    assert [detectors[name].update(row) for row in near.observations] == whole.tolist()


@pytest.mark.parametrize("name", NAMES)
def test_a_restored_fit_gives_the_same_bits(name, detectors):
    again = unfitted(name)
    again.restore(detectors[name].state())
    x = bare(FRESH[0][0])
    assert again.score(x).tolist() == detectors[name].score(x).tolist()
    with pytest.raises(FittedStateError, match="expected"):
        unfitted(name, ridge=2.5).restore(detectors[name].state())
    others = {"logistic": "logistic-time", "logistic-time": "tdqc", "tdqc": "logistic"}
    with pytest.raises(FittedStateError, match="expected"):
        unfitted(others[name], ridge=detectors[name].ridge).restore(detectors[name].state())
    assert_zero_scales_are_refused(detectors[name], unfitted(name), ["unit", "std"])


@pytest.mark.parametrize("name", NAMES)
def test_the_order_of_episodes_and_of_sensors_and_units_do_not_matter(name):
    rng = np.random.default_rng(3)
    episodes = [(np.c_[x, rng.normal(size=(60, 2))], y) for x, _, y in TRAINING]
    expected = fitted(name, episodes).score(bare(episodes[0][0]))
    shuffled = [episodes[i] for i in rng.permutation(len(episodes))]
    turned = [(x[:, [2, 0, 1]], y) for x, y in episodes]
    scaled = [(x * [10, 0.1, 3] + [5, -1, 0], y) for x, y in episodes]
    for others, query in ((shuffled, episodes), (turned, turned), (scaled, scaled)):
        scores = fitted(name, others).score(bare(query[0][0]))
        np.testing.assert_allclose(scores, expected, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_one_outcome_alone_is_refused_with_what_to_do(name):
    episodes = [bare(x) for x, *_ in TRAINING[:4]]
    expected = "4 nominal and 0 failed .*fit\\(nominal, failures=...\\).* failures = 0.5"
    for failures in (None, []):
        with pytest.raises(TrajectoryError, match=f"'{name}' was fitted on {expected}"):
            unfitted(name).fit(episodes, failures)
    with pytest.raises(TrajectoryError, match="0 nominal and 4 failed"):
        unfitted(name).fit([], episodes)
    with pytest.raises(TrajectoryError, match="the same number of sensors"):
        unfitted(name).fit(episodes, [bare(np.zeros((9, 2)))])
    with pytest.raises(UsageError, match=f"'ridge' of {name} is 0, expected more than 0"):
        unfitted(name, ridge=0)


@pytest.mark.parametrize("name", NAMES)
def test_what_the_rows_declare(name):
    spec = SPECS[name]
    assert (spec.training, spec.alarm, spec.deterministic) == ("failures", "score", True)
    assert not spec.requires  # numpy alone


# Features and weights


def test_features_are_of_all_rows_so_far():
    x = np.random.default_rng(0).normal(size=(30, 3))
    running = RunningFeatures(3)
    features = np.concatenate([running(x[:1]), running(x[1:12]), running(x[12:])])
    assert features.tolist() == RunningFeatures(3)(x).tolist()
    for t in (0, 1, 17, 29):
        past = x[: t + 1]
        expected = [x[t], past.mean(axis=0), past.std(axis=0), past.max(axis=0), [t + 1]]
        np.testing.assert_allclose(features[t], np.concatenate(expected), atol=1e-7)


def test_episodes_of_an_outcome_weigh_alike_and_outcomes_too():
    lengths, outcomes = np.array([5, 20, 40, 2]), np.array([0.0, 0.0, 0.0, 1.0])
    weights = np.split(weights_of(lengths, outcomes), np.cumsum(lengths)[:-1])
    np.testing.assert_allclose([w.sum() for w in weights], [2 / 3, 2 / 3, 2 / 3, 2])
    assert all(len(set(w)) == 1 for w in weights)


def test_rows_beyond_the_usual_length_of_success_teach_logistic_nothing():
    rng = np.random.default_rng(0)
    nominal = [walk(rng, 0, rows) for rows in (30, 40, 50)]
    failed = [walk(rng, 1, 200) for _ in range(3)]
    cut = [(x[:40], p, y) for x, p, y in nominal + failed]
    query = FRESH[0][0]
    for name, same in (("logistic", True), ("logistic-time", True), ("tdqc", False)):
        # Sensors have the same mean and spread, which only changes digits.
        whole, short = (fitted(name, e).score(bare(query)) for e in (nominal + failed, cut))
        assert np.allclose(whole, short, atol=1e-4) == same


# What is solved


def features_of(episodes):
    return [RunningFeatures(x.shape[1])(x)[:, :-1] for x, *_ in episodes]


def test_logistic_is_that_of_scikit_learn():
    linear_model = pytest.importorskip("sklearn.linear_model")
    episodes = [walk(np.random.default_rng(i), i % 3 == 0, 20 + i) for i in range(30)]
    features, outcomes = features_of(episodes), np.array([float(y) for *_, y in episodes])
    model = learn(features, outcomes, 3.0, temporal=False)
    lengths = np.array([len(x) for x in features])
    weights, rows = weights_of(lengths, outcomes), np.concatenate(features)
    theirs = linear_model.LogisticRegression(C=1 / 3, tol=1e-10, max_iter=10_000)
    z = (rows - model.centre) / model.unit
    theirs.fit(z, np.repeat(outcomes, lengths), sample_weight=weights)
    np.testing.assert_allclose(model(rows), theirs.predict_proba(z)[:, 1], atol=1e-4)


def test_temporal_differences_are_what_fitted_iteration_comes_to():
    """Fit to the next rows' probabilities as they were, replace these, and so on."""
    features, outcomes = features_of(TRAINING), np.array([float(y) for *_, y in TRAINING])
    model = learn(features, outcomes, 1.0, temporal=True)
    rows = np.concatenate(features)
    x = np.c_[(rows - model.centre) / model.unit, np.ones(len(rows))]
    weights = weights_of(np.full(40, 60), outcomes)
    beta, targets = np.zeros(x.shape[1]), np.full(len(rows), 0.5)
    precision = np.array([1.0] * (x.shape[1] - 1) + [0.0])
    for _ in range(3000):
        p = probabilities(x @ beta)
        curvature = (x * (weights * p * (1 - p))[:, None]).T @ x
        gradient = x.T @ (weights * (p - targets)) + precision * beta
        beta = beta - np.linalg.solve(curvature + np.diag(precision), gradient)
        values = probabilities(x @ beta).reshape(40, 60)
        targets = np.c_[values[:, 1:], outcomes].ravel()
    np.testing.assert_allclose(model(rows), probabilities(x @ beta), atol=1e-5)


# What is known beforehand


def squared_errors(detector, episodes):
    """Return the mean squared difference from the true probability, by row."""
    return np.mean([(detector.score(bare(x)) - p) ** 2 for x, p, _ in episodes], axis=0)


def test_probabilities_are_calibrated_where_they_are_known():
    rng = np.random.default_rng(5)
    training, fresh = some(rng, 400), some(rng, 400)
    detector = fitted("logistic", training, ridge=1.0)
    assert np.sqrt(squared_errors(detector, fresh).mean()) < 0.04
    scores = np.concatenate([detector.score(bare(x)) for x, *_ in fresh])
    outcomes = np.repeat([y for *_, y in fresh], 60)
    for low in np.arange(0, 1, 0.2):
        inside = (scores >= low) & (scores < low + 0.2)
        assert outcomes[inside].mean() == pytest.approx(scores[inside].mean(), abs=0.08)
    # Temporal differences are shrunk more by the same precision: outcomes enter by last rows alone.
    assert np.sqrt(squared_errors(fitted("tdqc", training), fresh).mean()) < 0.12


def test_imbalanced_outcomes_and_long_failures_do_not_bias_logistic():
    rng = np.random.default_rng(6)
    training = [walk(rng, int(i % 10 == 0), 180 if i % 10 == 0 else 60) for i in range(600)]
    detector = fitted("logistic", training, ridge=1.0)
    errors = [(detector.score(bare(x)) - p).mean() for x, p, _ in FRESH]
    assert abs(np.mean(errors)) < 0.03


def test_temporal_differences_are_better_early_where_a_later_state_decides():
    """Episodes of all kinds pass through two states: what follows these is learnt from all."""
    early = {"logistic": [], "tdqc": []}
    for seed in range(8):
        rng = np.random.default_rng(seed)
        training, fresh = ([passage(rng) for _ in range(100)] for _ in range(2))
        for name, errors in early.items():
            errors.append(squared_errors(fitted(name, training, ridge=1.0), fresh)[:10].mean())
    assert np.mean(early["tdqc"]) < 0.75 * np.mean(early["logistic"])


def test_where_the_model_is_right_outcomes_teach_more_than_next_rows():
    rng = np.random.default_rng(7)
    training, fresh = some(rng, 100), some(rng, 200)
    direct, temporal = (
        squared_errors(fitted(name, training, ridge=1.0), fresh)[:20].mean()
        for name in ("logistic", "tdqc")
    )
    assert direct < temporal


def test_the_largest_so_far_is_a_clock():
    """Sensors are noise, failures are long: whole episodes are told apart, equal rows are not."""
    rng = np.random.default_rng(8)

    def episodes(count):
        lengths = [(30 + int(rng.integers(10)), 0) for _ in range(count)] + [(100, 1)] * count
        return [(rng.normal(size=(rows, 5)), y) for rows, y in lengths]

    detector = fitted("tdqc", episodes(40))
    good, bad = (
        [detector.score(bare(x)) for x, y in episodes(60) if y == outcome] for outcome in (0, 1)
    )
    whole = auc(np.array([s.max() for s in bad]), np.array([s.max() for s in good]))
    same = auc(np.array([s[:30].max() for s in bad]), np.array([s[:30].max() for s in good]))
    assert whole > 0.8
    assert abs(same - 0.5) < 0.1
