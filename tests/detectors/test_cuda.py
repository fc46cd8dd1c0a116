"""Detectors on a CUDA device: they run only where torch finds one."""

import dataclasses

import numpy as np
import pytest

from oodd_eval import evaluate, load_split
from oodd_eval.plugins.discovery import discover
from oodd_eval.plugins.state import pack

torch = pytest.importorskip("torch")

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no CUDA device")

NETWORKS = ("riqn", "riqn-ms", "n-riqn", "npn", "pe", "pe-a")

FEW = {"members": 2, "updates": 60}


@pytest.fixture(scope="module")
def hopper():
    return load_split("mini").environment("hopper")


def unfitted(name, device, horizon=1):
    factory = discover().offer(name).spec.factory
    return factory(seed=0, horizon=horizon, device=device, **FEW)


def visible(name, trajectories):
    actions = discover().offer(name).spec.inputs == "observations+actions"
    return [x if actions else x.without_actions() for x in trajectories]


@pytest.mark.parametrize("name", NETWORKS)
def test_a_fit_made_on_the_device_scores_alike_there_streamed_and_on_the_processor(name, hopper):
    detector = unfitted(name, "cuda")
    detector.fit(visible(name, hopper.train[:8]))
    processor = unfitted(name, "cpu")
    processor.restore(pack(detector.state()).state())
    for episode in visible(name, hopper.twins[:3]):
        score = detector.score(episode)
        np.testing.assert_allclose(processor.score(episode), score, rtol=5e-3, atol=5e-3)
    detector.reset()
    actions = [None, *episode.actions]
    rows = zip(episode.observations, actions, strict=True)
    streamed = [detector.update(row, action) for row, action in rows]
    np.testing.assert_allclose(streamed, score, rtol=5e-3, atol=5e-3)


@pytest.mark.parametrize("name", ["riqn", "pe-a"])
def test_a_run_on_the_device_has_the_metrics_of_one_on_the_processor(name):
    chosen = {"environments": "acrobot", "anomalies": "iid,gravity"}
    means = {
        device: evaluate(name, parameters=FEW | {"updates": 300, "device": device}, **chosen).mean()
        for device in ("cpu", "cuda")
    }
    assert means["cuda"] == pytest.approx(means["cpu"], abs=0.05)


def test_the_device_is_no_part_of_the_result():
    fields = {}
    for device in ("cpu", "cuda"):
        parameters = FEW | {"device": device}
        (record,) = evaluate("riqn", environments="acrobot", anomalies="iid", parameters=parameters)
        fields[device] = dataclasses.replace(record).parameters
        assert record.provenance["device"].startswith(device)
    assert fields["cpu"] == fields["cuda"]
