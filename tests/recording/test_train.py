"""Training and evaluating policies: files, resuming, kills, provenance and the table."""

import json
import sys

import numpy as np
import oodd_recording.train
import pytest
from oodd_recording.policies import load_policy

from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.errors import MissingExtraError, PolicyError

torch = pytest.importorskip("torch")
pytest.importorskip("gymnasium")
record, freeze, iqn, td3, train = (
    pytest.importorskip(name)
    for name in (
        "oodd_recording.closed_loop",
        *(f"oodd_recording.train.{module}" for module in ("freeze", "iqn", "td3", "train")),
    )
)

QUICK = {
    "td3": {"layers": [8, 6], "batch": 4, "warm_up": 20, "evaluate_every": 40, "replay": 50,
            "refill": 50},
    "iqn": {"width": 8, "cosines": 4, "batch": 4, "quantiles_loss": 2, "quantiles_acting": 4,
            "warm_up": 20, "evaluate_every": 40, "replay": 50, "environments": 2},
}  # fmt: skip

BOTH = pytest.mark.parametrize("environment", ["cartpole", "hopper"])


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """A training of small networks that lasts moments; threads as they were."""
    for module, values in ((td3, QUICK["td3"]), (iqn, QUICK["iqn"])):
        for name, value in values.items():
            monkeypatch.setitem(module.HYPER_PARAMETERS, name, value)
    monkeypatch.setattr(train, "SELECTION_EPISODES", 2)
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def checkpoint(out, environment):
    return torch.load(out / f"{environment}.ckpt", weights_only=True)


@BOTH
def test_training_leaves_policy_provenance_curve_and_checkpoint(tmp_path, environment, capfd):
    lines = []
    best = train.train_policy(environment, out=tmp_path, steps=120, seed=3, progress=lines.append)
    load_policy(environment, best)
    facts = json.loads(best.with_suffix(".json").read_text())
    assert facts["algorithm"] == ENVIRONMENTS[environment].policy
    assert facts["seed"] == 3
    assert facts["hyper_parameters"]["batch"] == 4
    curve = json.loads((tmp_path / f"{environment}.curve.json").read_text())["curve"]
    assert [step for step, _, _ in curve] == [40, 80, 120]
    assert facts["curve"] == curve[: len(facts["curve"])]
    assert facts["curve"][-1][0] == facts["steps"]
    assert checkpoint(tmp_path, environment)["step"] == 120
    assert len(lines) == 3
    assert all(line.startswith(f"{environment}: step ") for line in lines)
    assert not list(tmp_path.rglob("*.partial"))
    assert capfd.readouterr() == ("", "")


@BOTH
def test_a_resumed_training_counts_like_one_in_one_go(tmp_path, environment):
    train.train_policy(environment, out=tmp_path / "two", steps=80)
    again = []
    train.train_policy(environment, out=tmp_path / "two", steps=160, progress=again.append)
    train.train_policy(environment, out=tmp_path / "one", steps=160)
    assert again[0] == f"{environment}: resumed at step 80"
    one, two = (checkpoint(tmp_path / d, environment) for d in ("one", "two"))
    assert one["step"] == two["step"] == 160
    assert [c[0] for c in one["curve"]] == [c[0] for c in two["curve"]] == [40, 80, 120, 160]


def test_the_best_actor_has_the_largest_worst_return(tmp_path, monkeypatch):
    returns = iter([[10.0, 10.0], [0.0, 40.0], [11.0, 11.0], [10.9, 10.9]])
    found = []

    def scripted(*_, **__):
        found.append(np.array(next(returns)))
        return found[-1]

    monkeypatch.setattr(train, "evaluate_policy", scripted)
    train.train_policy("cartpole", out=tmp_path, steps=160)
    assert json.loads((tmp_path / "cartpole.json").read_text())["steps"] == 120
    assert checkpoint(tmp_path, "cartpole")["best"] == 11.0


def test_a_kill_while_writing_leaves_the_last_checkpoint(tmp_path, monkeypatch):
    best = train.train_policy("cartpole", out=tmp_path, steps=40)
    before = (tmp_path / "cartpole.ckpt").read_bytes()

    def half(state, file):
        file.write_bytes(before[: len(before) // 2])
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(torch, "save", half)
        with pytest.raises(KeyboardInterrupt):
            train.train_policy("cartpole", out=tmp_path, steps=80)
    assert (tmp_path / "cartpole.ckpt").read_bytes() == before
    load_policy("cartpole", best)
    train.train_policy("cartpole", out=tmp_path, steps=80)
    assert [c[0] for c in checkpoint(tmp_path, "cartpole")["curve"]] == [40, 80]
    (tmp_path / "cartpole.ckpt").write_bytes(b"not a checkpoint")
    with pytest.raises(PolicyError, match=r"cartpole\.ckpt is not a checkpoint.*move it away") as e:
        train.train_policy("cartpole", out=tmp_path, steps=40)
    assert "weights_only" not in str(e.value)
    for name in ("iqn", "td3"):
        monkeypatch.delattr(oodd_recording.train, name)
        monkeypatch.delitem(sys.modules, f"oodd_recording.train.{name}")
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingExtraError, match=r"oodd-eval\[train\]"):
        train.train_policy("cartpole", out=tmp_path, steps=40)


class Leftward:
    digest = "leftward"

    def act(self, row):
        return 0


def test_each_seed_gives_one_return():
    # Pushed one way all the time, CartPole falls after 8 to 11 steps.
    found = record.evaluate_policy("cartpole", Leftward(), episodes=4, seed=7)
    later = record.evaluate_policy("cartpole", Leftward(), episodes=2, seed=9)
    assert found.shape == (4,)
    np.testing.assert_array_equal(found[2:], later)
    assert 8 <= found.mean() <= 11
