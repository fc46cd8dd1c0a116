"""Environments and anomalies of plug-ins are recorded, evaluated and listed as the benchmark's."""

import functools

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="needs the extra sim")
from helpers_own import TANK, forget_own
from helpers_plugins import install
from oodd_recording.info import code_digest

from oodd_eval import load_split
from oodd_eval.cli.main import main
from oodd_eval.data import registry
from oodd_eval.data.condition import Condition
from oodd_eval.results.directory import ResultsDirectory

SIZES = ["--train", "6", "--calibration", "6", "--test", "3", "--seed-base", "77"]


@pytest.fixture
def forgotten():
    """No environment of one test is known in the next."""
    yield
    forget_own()


@pytest.fixture
def tank(monkeypatch, tmp_path, forgotten):
    install(monkeypatch, tmp_path / "plugin", "tank", TANK, header="")
    monkeypatch.setenv("OODD_EVAL_DATA", str(tmp_path / "splits"))
    return tmp_path


def build(name, *options):
    return main(["data", "build", name, *SIZES, "--jobs", "1", *options])


def test_a_split_of_ones_own_is_recorded_and_evaluated(tank, capsys):
    strengths = ["--strength", "leak=0.5", "--strength", "iid=0.3", "--strength", "friction=0.4"]
    assert build("mine", "--env", "tank", *strengths) == 0
    split = load_split("mine")
    data = split.environment("tank")
    assert data.anomalies == ("iid", "friction", "leak")
    assert split.groups == {"iid": "sensor", "friction": "dynamics", "leak": "dynamics"}
    assert [len(part) for part in (data.train, data.calibration, data.twins)] == [6, 6, 3]
    for kind in data.anomalies:
        part = data.anomalous(kind)
        for i, (x, twin) in enumerate(zip(part, data.twins, strict=True)):
            effect = part.effects[i]
            same = x.observations[:effect].tobytes() == twin.observations[:effect].tobytes()
            assert same, kind
            assert (x.observations[effect] != twin.observations[effect]).any()
        assert part.parameters[0]["strength"] == {"leak": 0.5, "iid": 0.3, "friction": 0.4}[kind]
    run = ["run", "--detector", "persistence", "--env", "tank", "--split", "mine"]
    assert main([*run, "--output", str(tank / "results")]) == 0
    assert "tank" in capsys.readouterr().out


def test_several_strengths_are_conditions_and_the_number_of_workers_changes_no_byte(tank):
    assert build("one", "--env", "valve", "--strength", "leak=0.1,2") == 0
    split = load_split("one")
    assert split.anomalies == ("leak", "leak@0.1", "leak@2")
    assert split.environment("valve").discrete
    again = ["--jobs", "2", "--output", str(tank / "again")]
    assert build("one", "--env", "valve", "--strength", "leak=0.1,2", *again) == 0
    assert load_split(tank / "again").digest == split.digest
    weak, strong = (split.environment("valve").anomalous(c) for c in split.conditions("valve"))
    twins = split.environment("valve").twins

    def distance(part):
        rows = zip(part, twins, strict=True)
        return np.mean([np.abs(x.observations - twin.observations).mean() for x, twin in rows])

    assert 0 < distance(weak) < distance(strong)


def test_every_strength_has_a_number_in_split_and_records_and_a_column(tank, capsys):
    assert build("one", "--env", "tank", "--strength", "leak=0.1,0.5,2,3") == 0
    split, numbers = load_split("one"), (0.1, 0.5, 2, 3)
    assert split.strengths("tank") == {Condition("leak", f"{n:g}"): n for n in numbers}
    assert main(["data", "info", "one"]) == 0
    assert "strengths of leak (share of the flow): 0.1, 0.5, 2, 3" in capsys.readouterr().out
    out = str(tank / "results")
    assert (
        main(["run", "--detector", "mewma", "--split", "one", "--env", "all", "--output", out]) == 0
    )
    text = capsys.readouterr().out
    columns = text.partition("Matched AUC (%) by strength")[2].splitlines()[1]
    assert columns.split() == ["detector", "0.1", "0.5", "2", "3"]
    assert "Anomalies have several strengths" in text
    assert [r.magnitude for r in ResultsDirectory(tank / "results").records()] == [*numbers]


def test_ones_own_anomaly_is_recorded_in_an_environment_of_the_benchmark(tank, monkeypatch):
    code = TANK.replace("simulator.env.outflow = 0.2 * (1 + strength)",
                        "simulator.scale('gravity', 1 + strength)")  # fmt: skip
    install(monkeypatch, tank / "other", "tank", code, header="")
    sizes = ["--train", "1", "--calibration", "1", "--test", "1", "--seed-base", "77"]
    assert main(["data", "build", "poles", *sizes, "--cap", "80", "--env", "cartpole",
                 "--strength", "leak=1", "--jobs", "1"]) == 0  # fmt: skip
    split = load_split("poles")
    assert split.groups == {"leak": "dynamics"}
    assert split.manifest["environments"]["cartpole"]["own"]["anomalies"] == {"leak": "dynamics"}


def test_they_are_listed_and_described(tank, capsys):
    assert main(["list", "envs"]) == 0
    assert main(["list", "anomalies"]) == 0
    assert main(["info", "tank"]) == 0
    assert main(["info", "leak"]) == 0
    told = capsys.readouterr().out
    for text in ("plug-in 'tank' of oodd-tank", "water leaves faster", "upper (m)", "0 to 3"):
        assert text in told
    assert main(["policies", "evaluate", "tank", "--episodes", "2"]) == 0
    assert "tank: return -" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--env", "tank"], "no strengths of anomalies are given for 'tank'"),
        (["--env", "tank", "--strength", "leak=9"], "the strength of leak is 9, expected 0 to 3"),
        (["--env", "tank", "--strength", "gravity=1"], "unknown anomaly that tank can have"),
        (["--env", "tank", "--strength", "laek=1"], "did you mean 'leak'"),
        (["--env", "tnak", "--strength", "leak=1"], "did you mean 'tank'"),
        (["--env", "tank", "--strength", "leak=much"], "expected ANOMALY=NUMBER"),
    ],
)
def test_what_cannot_be_recorded_is_said(tank, capsys, options, message):
    assert build("mine", *options) == 4
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"tank", Tank', '"hopper", Tank', "'hopper' cannot be the name of a custom"),
        ('"tank", Tank', '"tank", lambda: Tank()', "at the top level of a module"),
        ('"leak", "dynamics"', '"iid", "dynamics"', "'iid' cannot be the name of a custom"),
        ("return [AnomalySpec(", "return (AnomalySpec(", "expected a list of oodd_eval.Anomaly"),
        ('EnvironmentSpec("valve"', 'EnvironmentSpec("leak"', "'leak' is offered twice"),
    ],
)
def test_a_wrong_spec_makes_its_plugin_broken(tank, monkeypatch, capsys, old, new, message):
    code = TANK.replace(old, new)
    code = code.replace("leak)]", "leak),)") if "(AnomalySpec" in new else code
    install(monkeypatch, tank / "other", "tank", code, header="")
    assert build("mine", "--env", "tank", "--strength", "leak=1") == 4
    assert message in capsys.readouterr().err


def test_arguments_of_a_partial_are_part_of_what_acts(forgotten):
    import gymnasium

    digests = set()
    for name in ("CartPole-v1", "Acrobot-v1"):
        make = functools.partial(gymnasium.make, name)
        registry.register([registry.EnvironmentSpec("one", make, "policy.npz", (), (), 99)])
        digests.add(code_digest("one", []))
    assert len(digests) == 2


def test_spaces_that_are_not_as_the_spec_says_are_refused(tank, monkeypatch, capsys):
    code = TANK.replace("Box(-1.0, 1.0, (1,))", "Box(-2.0, 2.0, (1,))")
    install(monkeypatch, tank / "other", "tank", code, header="")
    assert build("mine", "--env", "tank", "--strength", "leak=1") == 4
    assert "a Box of shape (1,) from -1 to 1" in capsys.readouterr().err


def checked(name, capsys, *options):
    code = main(["check", name, *options])
    return code, " ".join(capsys.readouterr().out.split())


def test_what_is_in_order_passes_its_checks(tank, capsys):
    for name in ("tank", "valve"):
        assert checked(name, capsys)[0] == 0
    code, told = checked("leak", capsys)
    assert (code, "4 passed" in told) == (0, True)
    assert checked("leak", capsys, "--env", "valve", "-k", "onset or draws")[0] == 0
    assert checked("leak", capsys, "-k", "nothing")[0] == 5


NOISE = "0.01 * self.np_random.normal(size=2)"


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("tank", NOISE, "0.01 * np.random.default_rng().normal(size=2)",
         "FAILED seed two episodes of seed 960000000 differ"),
        ("tank", "self.np_random.uniform(0.8, 1.2, 2)", "np.ones(2)",
         "FAILED seed different seeds give the same episode"),
        ("tank", "False, False, {}", "self.level[0] > 1.6, False, {}", "FAILED columns 0 of 8"),
        ("tank", "return lambda row: [np.clip(2.0 - row[1], -1, 1)]",
         "t = iter(range(10**9))\n    return lambda row: [next(t) % 2 - 0.5]",
         "FAILED policy the policy gives another action"),
        ("tank", 'Quantity(n, u) for n, u in (("upper", "m"),', "Quantity(n, u) for n, u in (",
         "FAILED columns environment 'tank' has observations"),
        ("leak", "0.2 * (1 + strength)", "0.2 * (1.5 + strength)",
         "FAILED zero-strength with seed 960000000 it differs from its twin"),
        ("leak", "0.2 * (1 + strength)", "0.2", "FAILED onset at the largest strength 8 of 8"),
        ("leak", "return Leak({})", "return Leak({'strong': strength > 1})",
         "FAILED draws with seed 960000000 it draws {'strong': False} or {'strong': True}"),
        ("leak", "0.2 * (1 + strength)", "0.2 * (1 + strength * (3 - strength))",
         "FAILED strength the mean distance from the twins is"),
        ("leak", "return Leak({})", "raise ValueError('no')",
         "FAILED zero-strength it raised ValueError: no"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_an_environment_or_an_anomaly_is_found(
    tank, monkeypatch, capsys, name, old, new, message
):
    noiseless = old.startswith("self.np_random.uniform")
    code = TANK.replace(old, new).replace(NOISE, "0.01") if noiseless else TANK.replace(old, new)
    assert code != TANK
    install(monkeypatch, tank / "other", "tank", code, header="")
    code, told = checked(name, capsys)
    assert code == 1
    assert message in told
