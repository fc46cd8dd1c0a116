"""Frozen policies: forward passes against second formulas, files and what damage says."""

import json

import numpy as np
import pytest

pytest.importorskip("gymnasium")
from oodd_recording.policies import load_policy, policy_digest
from oodd_recording.train.freeze import freeze_policy

from oodd_eval.errors import PolicyError


def td3(observation_dim=15, action_dim=3, scale=1.0):
    rng = np.random.default_rng(3)
    sizes = [observation_dim, 7, 5, action_dim]
    arrays = {}
    for i in (1, 2, 3):
        arrays[f"W{i}"] = (scale * rng.normal(size=(sizes[i - 1], sizes[i]))).astype("f4")
        arrays[f"b{i}"] = rng.normal(size=sizes[i]).astype("f4")
    return arrays


def iqn():
    rng = np.random.default_rng(4)
    shapes = {"W1": (4, 6), "b1": (6,), "W2": (6, 5), "b2": (5,), "C": (8, 5), "c": (5,),
              "W3": (5, 9), "b3": (9,), "W4": (9, 2), "b4": (2,)}  # fmt: skip
    arrays = {name: rng.normal(size=shape).astype("f4") for name, shape in shapes.items()}
    return arrays | {"quantiles": np.array(3)}


@pytest.fixture
def hopper(tmp_path):
    freeze_policy("hopper", td3(), {"algorithm": "TD3", "seed": 5}, tmp_path)
    return tmp_path / "hopper.npz"


def test_td3_equals_the_layers_written_out_unit_by_unit(hopper, tmp_path):
    p, row = td3(), np.linspace(-1, 1, 15, dtype="f4")
    signal = [float(v) for v in row]
    for layer in (1, 2, 3):
        w, b = p[f"W{layer}"].astype(float), p[f"b{layer}"].astype(float)
        signal = [sum(s * w[i, j] for i, s in enumerate(signal)) + b[j] for j in range(len(b))]
        signal = np.tanh(signal) if layer == 3 else [max(s, 0.0) for s in signal]
    found = load_policy("hopper", hopper).act(row)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, signal, rtol=0, atol=2.0**-17 + 1e-9)
    # Actions lie on the grid, within their bounds.
    freeze_policy("hopper", td3(scale=30.0), {}, tmp_path / "large")
    policy = load_policy("hopper", tmp_path / "large" / "hopper.npz")
    rows = np.random.default_rng(0).normal(size=(200, 15)).astype("f4")
    actions = np.array([policy.act(r) for r in rows], dtype=np.float64)
    assert np.abs(actions).max() == 1
    assert (actions * 2**16 == np.round(actions * 2**16)).all()


def test_iqn_equals_the_mean_over_quantile_midpoints_one_by_one(tmp_path):
    p = iqn()
    freeze_policy("cartpole", p, {}, tmp_path)
    policy = load_policy("cartpole", tmp_path / "cartpole.npz")
    for row in np.random.default_rng(1).normal(size=(20, 4)).astype("f4"):
        psi = np.maximum(p["W1"].T.astype(float) @ row + p["b1"], 0)
        psi = np.maximum(p["W2"].T.astype(float) @ psi + p["b2"], 0)
        q = np.zeros(2)
        for tau in (1 / 6, 3 / 6, 5 / 6):
            cosines = [np.cos(np.pi * i * tau) for i in range(8)]
            phi = np.maximum(p["C"].T.astype(float) @ cosines + p["c"], 0)
            hidden = np.maximum(p["W3"].T.astype(float) @ (psi * phi) + p["b3"], 0)
            q += (p["W4"].T.astype(float) @ hidden + p["b4"]) / 3
        np.testing.assert_allclose(policy.values(row), q, rtol=1e-9, atol=1e-9)
        assert policy.act(row) == int(np.argmax(q))
    # Equal values go to the first action.
    equal = p | {"W4": np.zeros((9, 2), "f4"), "b4": np.array([1.0, 1.0 + 1e-7], "f4")}
    freeze_policy("cartpole", equal, {}, tmp_path / "equal")
    assert load_policy("cartpole", tmp_path / "equal" / "cartpole.npz").act(np.ones(4, "f4")) == 0


def test_freezing_writes_arrays_and_provenance_with_the_digest(hopper):
    stored = json.loads(hopper.with_suffix(".json").read_text())
    assert stored == {
        "environment": "hopper", "algorithm": "TD3", "seed": 5, "digest": policy_digest(td3()),
    }  # fmt: skip
    assert load_policy("hopper", hopper).digest == stored["digest"]
    assert sorted(f.name for f in hopper.parent.iterdir()) == ["hopper.json", "hopper.npz"]


def test_digest_covers_every_weight_and_ignores_order_and_byte_order():
    p = td3()
    digest = policy_digest(p)
    assert policy_digest(dict(reversed(p.items()))) == digest
    assert policy_digest({k: v.astype(">f4") for k, v in p.items()}) == digest
    for name in p:
        changed = p[name].copy()
        changed.view("u4").flat[-1] ^= 1
        assert policy_digest(p | {name: changed}) != digest, name


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (td3() | {"W2": np.zeros((8, 5), "f4")}, "do not fit"),
        (td3() | {"b1": np.array(["1"] * 7)}, "expected numbers"),
        ({"W1": np.array([{}], dtype=object)}, "expected numbers"),
        (np.zeros(3), r"hopper\.npz cannot be read"),
    ],
    ids=["layers", "text", "objects", "single array"],
)
def test_arrays_that_make_no_policy_are_refused(tmp_path, arrays, message, hopper):
    with pytest.raises(PolicyError, match=r"15 sensors to 3 actions, expected 22 and 6"):
        load_policy("walker2d", hopper)
    with pytest.raises(PolicyError, match=r"lacks the arrays C, c, W4, b4, quantiles"):
        load_policy("cartpole", hopper)
    with hopper.open("wb") as out:
        if isinstance(arrays, dict):
            np.savez(out, **arrays)
        else:
            np.save(out, arrays)
    with pytest.raises(PolicyError, match=message):
        load_policy("hopper", hopper)
    with pytest.raises(PolicyError, match="not finite in b2"):
        freeze_policy("hopper", td3() | {"b2": np.full(5, np.nan)}, {}, tmp_path / "new")
    assert not (tmp_path / "new").exists()
