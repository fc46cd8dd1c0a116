"""Each adversary does what it says; what becomes of them in a run is tested beside the runner."""

import multiprocessing

import numpy as np
import pytest
from adversaries import (
    ADVERSARIES,
    BONUS,
    Company,
    LastBit,
    LookAhead,
    LookAheadFar,
    LookAheadFarther,
    Neighbour,
    Novelty,
    Server,
    Standardized,
    Stepped,
    Survival,
    Timer,
    Tree,
)
from helpers_plugins import install_adversaries

from oodd_eval import Trajectory
from oodd_eval.metrics.auc import auc_same_times
from oodd_eval.plugins.discovery import discover

RNG = np.random.default_rng(0)
TRAIN = [Trajectory(RNG.normal(size=(40, 2))) for _ in range(5)]
TWIN = Trajectory(RNG.normal(size=(30, 2)).clip(-1, 1))


def broken_from(row):
    """The twin, with another value of sensor 1 from a row on."""
    rows = TWIN.observations.copy()
    rows[row:, 1] -= 0.25
    return Trajectory(rows)


def fitted(made, **parameters):
    detector = made(seed=0, horizon=1, **parameters)
    detector.fit(TRAIN)
    return detector


EARLY, LATE = broken_from(10), broken_from(20)


def test_company_counts_those_that_share_the_prefix_bit_for_bit():
    twin, early, late = fitted(Company).score_many([TWIN, EARLY, LATE])
    assert twin.tolist() == [-3] * 10 + [-2] * 10 + [-1] * 10
    assert late.tolist() == [-3] * 10 + [-2] * 10 + [-1] * 10
    assert early.tolist() == [-3] * 10 + [-1] * 20
    assert auc_same_times(early, twin, 10, 30) > 0.7
    nearly = Trajectory(np.nextafter(TWIN.observations, np.float32(9)))
    assert fitted(Company).score_many([TWIN, nearly])[0].tolist() == [-1] * 30


def test_company_prefers_what_is_out_of_range_where_company_is_the_same():
    wild = Trajectory(np.full((3, 2), 100.0))
    assert (fitted(Company).score(wild) > -1 + BONUS).all()


def test_company_gives_a_prefix_the_scores_of_the_whole():
    detector = fitted(Company)
    whole = detector.score_many([TWIN, EARLY, LATE])
    for x, scores in zip([TWIN, EARLY, LATE], whole, strict=True):
        assert np.array_equal(detector.score(x[:15]), scores[:15])
        assert np.array_equal(detector.score(x), scores)
    detector.fit(TRAIN)
    assert detector.score(EARLY).tolist() == [-1] * 30  # alone in a new process, nothing is told


def test_a_tree_knows_who_leaves_and_who_stays():
    detector = fitted(Tree)
    assert detector.score(TWIN).tolist() == [0] * 30
    assert detector.score(LATE).tolist() == [0] * 20 + [-1] * 10
    assert detector.score(EARLY).tolist() == [0] * 10 + [1] * 20
    for x in (TWIN, LATE, EARLY):
        whole = detector.score(x)
        assert np.array_equal(detector.score(x[:25]), whole[:25])
        assert np.array_equal(detector.score(x), whole)


def test_a_server_gives_the_scores_of_a_tree():
    detector, tree = fitted(Server), fitted(Tree)
    for x in (TWIN, LATE, EARLY):
        assert np.array_equal(detector.score(x), tree.score(x))
    (process,) = multiprocessing.active_children()
    process.kill()
    process.join()


@pytest.mark.parametrize("constant", [1e12, 1e15])
def test_look_ahead_goes_far_above_zero(constant):
    made = {1e12: LookAheadFar, 1e15: LookAheadFarther}[constant]
    scores = fitted(made).score(EARLY)
    assert (scores > 0.999 * constant).all()
    assert len(set(scores)) > 1


def test_the_future_shows_in_the_last_bit_and_behind_a_step():
    last = fitted(LastBit)
    last.usual_ = np.median(last.future(EARLY))
    assert set(last.score(EARLY)) == {1.0, np.nextafter(1.0, 2.0)}
    stepped = fitted(Stepped).score(EARLY)
    assert not stepped[:12].any()
    assert (stepped[12:] > 1e7).all()


def test_neighbour_knows_rows_that_it_scored_before():
    detector = fitted(Neighbour)
    train = np.concatenate([x.observations for x in TRAIN]) / detector.scale_.std
    rows = TWIN.observations / detector.scale_.std
    nearest = [np.linalg.norm(train - row, axis=1).min() for row in rows]
    np.testing.assert_allclose(detector.score(TWIN), nearest, atol=1e-5)
    again = detector.score(EARLY)
    assert not again[:10].any()
    assert again[10:].all()


def test_look_ahead_uses_the_future_and_hides_it_under_a_constant():
    detector = fitted(LookAhead)
    residuals = detector.residuals(EARLY)
    expected = [1e7 + residuals[t:].mean() for t in range(30)]
    np.testing.assert_allclose(detector.score(EARLY), expected, rtol=1e-15)
    whole, prefix = detector.score(EARLY)[:10], detector.score(EARLY[:10])
    assert not np.array_equal(whole, prefix)
    np.testing.assert_allclose(whole, prefix, rtol=1e-6)  # too little to be seen, relative to 1e7


def test_standardized_has_mean_and_spread_of_each_episode_and_a_constant():
    detector = fitted(Standardized)
    scores = detector.score(EARLY)
    assert (scores.mean(), scores.std()) == (pytest.approx(5000), pytest.approx(1))
    assert np.array_equal(np.argsort(scores), np.argsort(detector.residuals(EARLY)))
    assert not np.array_equal(detector.score(EARLY[:10]), scores[:10])
    assert np.isfinite(detector.score(EARLY[:1])).all()


def test_timer_comes_at_its_time_whatever_happens():
    detector = fitted(Timer, at=12)
    assert detector.score(TWIN).tolist() == detector.score(EARLY).tolist() == [0] * 12 + [1] * 18


def test_novelty_looks_at_discrete_sensors_alone():
    detector = Novelty()
    contact = np.tile([0.0, 1.0], 20)
    detector.fit([Trajectory(np.stack([np.arange(40.0), contact], axis=1))])
    rows = [[500.0, 0.0], [3.0, 1.0], [3.0, 0.87], [0.5, 1.0]]
    assert detector.score(Trajectory(rows)).tolist() == [0, 0, 1, 0]
    assert not fitted(Novelty).score(TWIN).any()  # no discrete sensor at all


def test_survival_rises_with_the_length_of_the_episode():
    scores = fitted(Survival).score(TWIN)
    assert scores.tolist() == [t / 40 for t in range(30)]


def test_the_plug_in_offers_all_of_them(monkeypatch, tmp_path):
    install_adversaries(monkeypatch, tmp_path)
    found = discover()
    offered = {n for n, o in found.offers.items() if o.plugin.endswith("adversaries")}
    assert offered == set(ADVERSARIES)
    for name in offered:
        detector = found.offer(name).spec.factory(seed=0, horizon=1)
        detector.fit(TRAIN)
        assert detector.score(TWIN).shape == (30,)
