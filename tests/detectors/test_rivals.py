"""The rivals, by hand and against slow, obvious forms of them."""

import numpy as np
import pytest
import torch
from helpers_state import assert_zero_scales_are_refused
from oodd_rivals import oodd_detectors, parameters
from oodd_rivals.deedee import AGES, RunningMean, ages, similarities
from oodd_rivals.pca import Components
from oodd_rivals.recent import evenly, folds_of
from oodd_rivals.rnd import forward, random_layers

from oodd_eval import Trajectory
from oodd_eval.errors import FittedStateError

pytest.importorskip("sklearn")
from oodd_rivals.paano import representatives
from oodd_rivals.patches import Heads, Patches, embedded, losses, normalized, train

SMALL = {
    "rnd": {"updates": 30, "width": 16, "outputs": 8},
    "paano": {"updates": 3, "width": 8, "batch": 16, "window": 8},
}
SPECS = {spec.name: spec for spec in oodd_detectors()}
NAMES = ["pca", "knn", "deedee", "rnd", "paano"]


def episode(seed, n=60, sensors=3):
    """A slow random walk that is pulled back, with a sensor that is 7 throughout."""
    rng = np.random.default_rng(seed)
    o = np.zeros((n, sensors))
    for t in range(1, n):
        o[t] = 0.9 * o[t - 1] + rng.normal(size=sensors)
    return bare(np.c_[o, np.full(n, 7.0)])


def bare(rows):
    rows = np.asarray(rows, np.float32)
    return Trajectory(rows, np.zeros((len(rows) - 1, 0), np.float32))


NOMINAL = [episode(seed) for seed in range(8)]
ODD = bare(episode(99).observations + np.float32(6) * (np.arange(60) >= 30)[:, None])


def unfitted(name, seed=0, **values):
    return SPECS[name].factory(seed=seed, horizon=1, **{**SMALL.get(name, {}), **values})


@pytest.fixture(scope="module")
def fitted():
    return {name: unfitted(name).fit(NOMINAL) for name in NAMES}


# All of them


@pytest.mark.parametrize("name", ["rnd", "paano"])
def test_the_seed_decides_what_is_learnt(name, fitted):
    other = unfitted(name, seed=1).fit(NOMINAL)
    assert (other.score(ODD) != fitted[name].score(ODD)).any()


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("pca", {"rows": "averaged"}), ("knn", {"window": 2}), ("deedee", {"weight": 0.5}),
        ("rnd", {"limit": 3.0}), ("paano", {"normalize": "patch"}),
    ],
)  # fmt: skip
def test_a_state_of_other_parameters_is_refused(name, change, fitted):
    with pytest.raises(FittedStateError, match="expected"):
        unfitted(name, **change).restore(fitted[name].state())


def test_states_whose_scales_are_zero_are_refused(fitted):
    for name, scales in {
        "pca": ["variances", "limits", "std"], "deedee": ["bandwidth", "spread", "unit"],
    }.items():  # fmt: skip
        assert_zero_scales_are_refused(fitted[name], unfitted(name), scales)


def test_rows_at_equal_distances_and_folds_of_one_episode():
    rows = np.arange(10.0)[:, None]
    assert evenly(rows, 4).ravel().tolist() == [0, 3, 6, 9]
    assert evenly(rows, 10).tolist() == rows.tolist()
    assert [fold.ravel().tolist() for fold in folds_of([rows])] == [
        [0, 1], [2, 3], [4, 5], [6, 7], [8, 9]
    ]  # fmt: skip
    assert [len(fold) for fold in folds_of([rows] * 7)] == [20, 20, 10, 10, 10]


# pca


def test_t_squared_and_q_by_hand():
    # Centred the row is (4, 2): 4 / 2 deviations along the component, and 2 off it.
    c = Components(np.array([1.0, 1.0]), np.array([[1.0], [0.0]]), np.array([4.0]))
    np.testing.assert_allclose(c.t_squared_and_q(np.array([[5.0, 3.0]])), [[4.0], [4.0]])


def test_with_all_components_t_squared_is_the_mahalanobis_distance():
    x = np.random.default_rng(0).normal(size=(200, 3)) @ np.array([[2, 1, 0], [0, 1, 0], [0, 1, 3]])
    t, q = Components.of(x, 1.0).t_squared_and_q(x)
    centred = x - x.mean(axis=0)
    inverse = np.linalg.inv(np.cov(x.T, bias=True))
    np.testing.assert_allclose(t, np.einsum("ni,ij,nj->n", centred, inverse, centred))
    np.testing.assert_allclose(q, 0, atol=1e-12)


@pytest.mark.parametrize("shape", [(40, 6), (6, 40)])
def test_components_are_the_singular_vectors_whichever_side_is_smaller(shape):
    x = np.random.default_rng(1).normal(size=shape) * np.linspace(1, 3, shape[1])
    _, s, vt = np.linalg.svd(x - x.mean(axis=0), full_matrices=False)
    explained = np.cumsum(s**2) / (s**2).sum()
    for share in (0.3, 0.8, 0.99):
        c = Components.of(x, share)
        k = 1 + int((explained < share).sum())
        assert c.loadings.shape == (shape[1], k)
        np.testing.assert_allclose(c.variances, s[:k] ** 2 / len(x))
        np.testing.assert_allclose(abs((c.loadings * vt[:k].T).sum(axis=0)), 1)


def test_directions_without_variance_are_left_to_q():
    x = np.c_[np.arange(10.0), 2 * np.arange(10.0)]
    c = Components.of(x, 1.0)
    assert len(c.variances) == 1
    t, q = c.t_squared_and_q(np.array([[4.5 + 2, 9 - 1.0]]))  # across the line
    np.testing.assert_allclose([t[0], q[0]], [0, 5], atol=1e-12)
    assert Components.of(np.ones((4, 2)), 0.9).variances.shape == (0,)


@pytest.mark.parametrize("rows", ["stacked", "averaged"])
def test_pca_adds_both_statistics_in_units_of_their_limits(rows):
    detector = unfitted("pca", window=3, rows=rows, share=0.9).fit(NOMINAL)
    z = (ODD.observations - detector.scale_.mean) / detector.scale_.std
    c, limits = detector.components_, detector.limits_.ravel()
    for t in (0, 1, 40):
        latest = [z[max(t - i, 0)] for i in range(3)]
        x = np.concatenate(latest) if rows == "stacked" else np.mean(latest, axis=0)
        p = c.loadings.T @ (x - c.mean)
        left = x - c.mean - c.loadings @ p
        expected = np.sqrt((p**2 / c.variances).sum() / limits[0] + left @ left / limits[1])
        assert detector.score(ODD)[t] == pytest.approx(expected, rel=1e-5)


def test_limits_are_quantiles_of_episodes_that_the_components_have_not_seen():
    """Of rows of 30 independent sensors in two short episodes, seen ones have far smaller T2."""
    rng = np.random.default_rng(0)
    episodes = [bare(rng.normal(size=(40, 30))) for _ in range(2)]
    detector = unfitted("pca", window=1, share=1.0, quantile=0.5).fit(episodes)
    rows = np.concatenate([detector.scale_(x).astype(float) for x in episodes])
    seen = np.median(Components.of(rows, 1.0).t_squared_and_q(rows)[0])
    assert detector.limits_[0, 0] > 3 * seen


def test_wide_windows_are_learnt_from_a_thousand_of_them():
    rng = np.random.default_rng(0)
    detector = unfitted("pca", window=10).fit([bare(rng.normal(size=(700, 110))) for _ in range(2)])
    assert detector.components_.loadings.shape[1] < 700
    assert np.isfinite(detector.limits_).all()


# knn


def test_distances_to_the_nearest_by_hand():
    # Mean 0 and deviation 1, so that standardized rows are the rows.
    nominal = [bare([[-1.0], [1.0]])]
    query = bare([[1.0], [3.0]])
    assert unfitted("knn", window=1, neighbours=2).fit(nominal).score(query).tolist() == [1.0, 3.0]
    # Windows of training are (-1, -1) and (1, -1), the newest first; of the query (1, 1), (3, 1).
    scores = unfitted("knn", window=2, neighbours=1).fit(nominal).score(query)
    np.testing.assert_allclose(scores, [np.sqrt((0 + 4) / 2), np.sqrt((4 + 4) / 2)])


def test_knn_is_brute_force_over_the_kept_windows():
    detector = unfitted("knn", window=2, neighbours=3, most=50).fit(NOMINAL)
    z = [(x.observations - detector.scale_.mean) / detector.scale_.std for x in (*NOMINAL, ODD)]
    *bank, rows = (np.hstack([x, x[np.maximum(np.arange(len(x)) - 1, 0)]]) for x in z)
    bank = np.concatenate(bank)
    kept = bank[np.linspace(0, len(bank) - 1, 50).round().astype(int)]
    expected = [np.sort(np.linalg.norm(kept - x, axis=1))[:3].mean() / np.sqrt(2) for x in rows]
    np.testing.assert_allclose(detector.score(ODD), expected, rtol=1e-5)


# deedee


def test_running_means_by_hand():
    rows = np.array([[1.0], [3.0], [8.0], [0.0]])
    assert RunningMean(0.0)(rows).ravel().tolist() == [1, 2, 4, 3]
    # A half counts more than a third from the third row on.
    assert RunningMean(0.5)(rows).ravel().tolist() == [1, 2, 5, 2.5]
    parts = RunningMean(0.5)
    assert [parts(rows[i : i + 1])[0, 0] for i in range(4)] == [1, 2, 5, 2.5]


def test_similarity_to_a_summary_by_hand():
    rows, summary = np.array([[0.0, 0.0], [3.0, 4.0]]), np.array([[0.0, 0.0], [0.0, 2.0]])
    # Squared distances 0 and 4; 25 and 13.
    expected = [(1 + np.exp(-2 / 3)) / 2, (np.exp(-25 / 6) + np.exp(-13 / 6)) / 2]
    np.testing.assert_allclose(similarities(rows, summary, 3.0), expected)


def test_groups_of_ages_double():
    assert ages(16).tolist() == [0, 1, 1, 2, 2, 2, 2, *[3] * 8, 4]
    assert ages(1, 2**AGES).tolist() == [AGES - 1]
    assert [ages(1, t)[0] for t in range(16)] == ages(16).tolist()


def test_deedee_adds_both_statistics_in_units_of_their_age():
    detector = unfitted("deedee", weight=0.2, summary=40).fit(NOMINAL)
    z = (ODD.observations - detector.scale_.mean) / detector.scale_.std
    mean, similarity = np.zeros(4), 0.0
    for t, row in enumerate(z):
        gain = max(0.2, 1 / (t + 1))
        mean += gain * (row - mean)
        k = [np.exp(-((row - c) ** 2).sum() / (2 * detector.bandwidth_)) for c in detector.summary_]
        similarity += gain * (np.mean(k) - similarity)
        a = np.sqrt(np.mean((mean / detector.spread_) ** 2))
        group = min(int(np.log2(t + 1)), AGES - 1)
        both = (np.array([a, -np.log(similarity)]) - detector.centre_[group]) / detector.unit_[
            group
        ]
        assert detector.score(ODD)[t] == pytest.approx(both.sum(), rel=1e-4, abs=1e-4)


def test_nominal_statistics_are_centred_at_every_age():
    """Of fresh nominal episodes the mean score is about 0 at the start as well as later."""
    detector = unfitted("deedee").fit([episode(seed, n=200) for seed in range(40)])
    scores = np.array([detector.score(episode(seed, n=200)) for seed in range(100, 140)])
    assert abs(scores[:, :4].mean()) < 0.5
    assert abs(scores[:, 100:].mean()) < 0.5


# rnd


def test_a_forward_pass_by_hand():
    layers = [
        (np.array([[1.0, -1.0]]), np.array([0.0, 1.0])),
        (np.array([[2.0], [3.0]]), np.array([-1.0])),
    ]
    # relu(2, -1) = (2, 0); relu(-2, 3) = (0, 3).
    assert forward(np.array([[2.0], [-2.0]]), layers).tolist() == [[3.0], [8.0]]


def test_layers_have_their_widths_and_variances():
    (w, b), (w2, _) = random_layers([200, 300, 5], np.random.default_rng(0))
    assert (w.shape, b.shape, w2.shape) == ((200, 300), (300,), (300, 5))
    assert w.std() == pytest.approx(np.sqrt(2 / 200), rel=0.01)


def test_distillation_learns_nominal_rows_and_not_others():
    untrained = unfitted("rnd", updates=1, rate=1e-9).fit(NOMINAL)
    trained = unfitted("rnd", updates=400).fit(NOMINAL)
    fresh = episode(50)
    assert trained.score(fresh).mean() < 0.4 * untrained.score(fresh).mean()
    assert trained.score(ODD)[35:50].mean() > 3 * trained.score(fresh).mean()


def test_rnd_is_the_root_mean_square_of_the_difference_of_its_networks():
    detector = unfitted("rnd", window=1).fit(NOMINAL)
    x = np.clip((ODD.observations - detector.scale_.mean) / detector.scale_.std, -10, 10)

    def out(layers):
        y = x
        for w, b in layers[:-1]:
            y = np.maximum(y @ w + b, 0)
        return y @ layers[-1][0] + layers[-1][1]

    expected = np.sqrt(((out(detector.target_) - out(detector.predictor_)) ** 2).mean(axis=1))
    np.testing.assert_allclose(detector.score(ODD), expected, rtol=1e-5)


def test_beyond_the_limit_sensors_are_clipped(fitted):
    far = bare([[1e3, 0, 0, 7], [1e6, 0, 0, 7]])
    first, second = fitted["rnd"].score(far)
    assert first == second


# paano


def test_patches_are_normalized_by_hand():
    patch = np.array([[[1.0, 5.0], [3.0, 5.0]]], np.float32)
    np.testing.assert_allclose(normalized(patch), [[[-1, 0], [1, 0]]], atol=1e-4)


def test_embeddings_are_the_encoders_of_training():
    heads = Heads(4, 8, np.random.default_rng(0))
    with torch.no_grad():
        for bias in heads.biases:
            bias.fill_(0.1)
    x = np.random.default_rng(1).normal(size=(5, 9, 4)).astype(np.float32)
    expected = heads.encode(torch.from_numpy(x)).detach().numpy()
    layers = heads.convolutions()
    np.testing.assert_allclose(embedded(x.astype(float), layers), expected, atol=1e-6)


def test_patches_stay_within_their_episodes():
    patches = Patches.of(
        [np.arange(3.0, dtype=np.float32)[:, None], np.full((2, 1), 9, np.float32)]
    )
    at = np.array([0, 2, 3, 4])
    assert patches.shifted(at, np.array([-1, 1, -1, -1])).tolist() == [0, 2, 3, 3]
    assert patches.ending(at, 2)[..., 0].tolist() == [[0, 0], [2, 1], [9, 9], [9, 9]]


def test_representatives_are_rows_of_each_cluster():
    rng = np.random.default_rng(0)
    # Of different lengths: the nearest to a centre is not the one with the largest product.
    vectors = np.repeat(np.diag([1.0, 5.0, 25.0]), 20, axis=0) + 0.01 * rng.normal(size=(60, 3))
    chosen = representatives(vectors, 3, seed=0)
    assert sorted(chosen.argmax(axis=1)) == [0, 1, 2]
    assert all((row == vectors).all(axis=1).any() for row in chosen)
    many = rng.normal(size=(300, 4)) * rng.exponential(size=(300, 1))
    assert len(representatives(many, 100, seed=0)) == 100
    assert representatives(np.ones((5, 2)), 3, seed=0).tolist() == [[1, 1]]


@pytest.mark.parametrize("lengths", ["kept", "one"])
def test_paano_is_the_mean_distance_to_the_nearest(lengths):
    detector = unfitted("paano", neighbours=3, lengths=lengths).fit(NOMINAL)
    z = (ODD.observations - detector.scale_.mean) / detector.scale_.std
    patch = np.stack([z[40 - i] for i in range(8)])[None].astype(np.float32)
    vector = embedded(patch.astype(float), detector.layers_)[0]
    if lengths == "one":
        vector = vector / np.linalg.norm(vector)
        np.testing.assert_allclose(np.linalg.norm(detector.bank_, axis=1), 1)
    expected = np.sort(np.linalg.norm(detector.bank_ - vector, axis=1))[:3].mean()
    assert detector.score(ODD)[40] == pytest.approx(expected, rel=1e-4)


def test_a_patch_that_is_normalized_itself_hides_its_level():
    shifted = bare(ODD.observations + np.float32(3))
    for normalize, same in (("patch", True), ("training", False)):
        detector = unfitted("paano", normalize=normalize).fit(NOMINAL)
        close = np.allclose(detector.score(shifted), detector.score(ODD), atol=1e-3)
        assert close == same


def test_training_lowers_the_loss_of_triplets():
    patches = Patches.of([x.observations for x in NOMINAL])
    settings = parameters.PaanoParameters(updates=60, width=16, batch=64, window=8)

    heads = Heads(4, 16, np.random.default_rng(0))
    before = float(losses(heads, patches, settings, np.random.default_rng(1))[0].detach())
    train(heads, patches, settings, np.random.default_rng(0))
    after = float(losses(heads, patches, settings, np.random.default_rng(1))[0].detach())
    assert after < 0.7 * before
