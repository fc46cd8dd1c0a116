"""The script that leaves variation and noise of the worlds out: what is left, and what stays."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="needs the extra worlds")
from helpers_own import forget_own
from oodd_recording.build import build_split
from oodd_recording.closed_loop import Setup, record_anomalous
from oodd_recording.environments import make
from oodd_recording.policies import load_policy
from oodd_worlds import oodd_anomalies, oodd_environments
from oodd_worlds.facts import read_world

from oodd_eval import evaluate
from oodd_eval.data.condition import conditions_of
from oodd_eval.data.facts import SplitDefinition
from oodd_eval.data.registry import register

WORLDS = ("arm", "drone", "tank")
KINDS = {"arm": "motor-loss", "drone": "rotor-loss", "tank": "leak"}
MEASURED = {"arm": 12, "drone": 12, "tank": 4}
SEED = 984_000_000


@pytest.fixture(autouse=True)
def script(monkeypatch):
    """The script, imported as processes that record import it; afterwards worlds are as before."""
    register([*oodd_environments(), *oodd_anomalies()])
    for name in WORLDS:
        monkeypatch.setattr(f"oodd_worlds.{name}.WORLD", read_world(name))
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    yield importlib.import_module("worlds_variation")
    del sys.modules["worlds_variation"]
    forget_own()


@pytest.mark.parametrize("world", WORLDS)
def test_a_world_as_it_is_has_the_bits_of_the_world(script, world):
    assert script.changed(read_world(world), variation=True, noise=True) == read_world(world)

    def recorded():
        setup = Setup(world, load_policy(world))
        twin = setup.record(SEED)
        episode = record_anomalous(setup, KINDS[world], 0.1, twin)
        trajectories = twin.trajectory, episode.trajectory
        return [x.tobytes() for t in trajectories for x in (t.observations, t.actions)]

    expected = recorded()
    register([script.spec_of(world, True, True)])
    assert recorded() == expected
    register([script.spec_of(world, False, True)])
    assert recorded() != expected


@pytest.mark.parametrize("world", WORLDS)
def test_without_noise_rows_are_the_simulators_and_nothing_is_drawn_within_an_episode(
    script, world
):
    def stepped(generator):
        simulator = make(world)
        simulator.reset(SEED)
        if generator is not None:
            simulator.env.np_random = generator
        return np.array([simulator.step(a)[0] for a in episode.trajectory.actions[:20]])

    for noise in (True, False):
        register([script.spec_of(world, True, noise)])
        episode = Setup(world, load_policy(world)).record(SEED)
        rows = stepped(None)
        assert np.array_equal(rows, episode.trajectory.observations[1:21]) != noise
        measured = [x[:, : MEASURED[world]] for x in (rows, stepped(np.random.default_rng(1)))]
        assert np.array_equal(*measured) != (noise and world != "tank")


@pytest.mark.slow
def test_the_table_has_the_numbers_of_a_run(script, tmp_path, capsys):
    sizes = ["--train", "3", "--calibration", "38", "--test", "2", "--rung", "loss100"]
    script.main(["--env", "tank", "--detector", "mewma", *sizes])
    (line,) = (x for x in capsys.readouterr().out.splitlines() if x.startswith("| mewma"))
    cells = [cell.split("/") for cell in line.split("|")[2:-1]]
    numbers = np.array(cells, float)
    register(oodd_environments())
    ladder = {str(c): x for c, x in conditions_of("ladder", "tank").items()}
    strengths = {c: x for c, x in ladder.items() if c.endswith("@loss100")}
    assert len(strengths) == 6
    definition = SplitDefinition(
        "tank-itself", 3, 38, 2, None, 9, strengths=strengths, environments=("tank",)
    )
    records = evaluate("mewma", build_split(definition, tmp_path, environments=["tank"], jobs=1))
    for i, metric in enumerate(script.METRICS):
        assert numbers[0, i] == pytest.approx(100 * records.mean(metric), abs=0.051)
    assert len({*map(tuple, numbers.tolist())}) > 1
    with pytest.raises(SystemExit):
        script.main(["--calibration", "37"])
