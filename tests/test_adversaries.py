"""Adversaries that a run lets pass do what they say; a run itself proves those that it refuses."""

import multiprocessing

import numpy as np
from adversaries import ADVERSARIES, BONUS, Company, Novelty, Server, Survival, Timer, Tree
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
