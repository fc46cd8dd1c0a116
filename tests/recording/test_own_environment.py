"""Environments and anomalies of plug-ins are recorded, evaluated and listed as the benchmark's."""

import functools

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="needs the extra gym")
from helpers_own import BASIN, CISTERN, forget_own
from helpers_plugins import install
from oodd_recording.registered import code_digest

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
def cistern(monkeypatch, tmp_path, forgotten):
    install(monkeypatch, tmp_path / "plugin", "cistern", CISTERN, header="")
    return tmp_path


@pytest.fixture
def basin(monkeypatch, tmp_path, forgotten):
    install(monkeypatch, tmp_path / "plugin", "basin", BASIN, header="")
    monkeypatch.setenv("OODD_EVAL_DATA", str(tmp_path / "splits"))
    return tmp_path


def build(name, *options):
    return main(["data", "build", name, *SIZES, "--jobs", "1", *options])


def test_a_split_of_ones_own_is_recorded_and_evaluated(basin, capsys):
    strengths = ["--strength", "seep=0.5", "--strength", "iid=0.3", "--strength", "friction=0.4"]
    assert build("mine", "--env", "basin", *strengths) == 0
    split = load_split("mine")
    data = split.environment("basin")
    assert data.anomalies == ("iid", "friction", "seep")
    assert split.groups == {"iid": "sensor", "friction": "dynamics", "seep": "dynamics"}
    assert [len(part) for part in (data.train, data.calibration, data.twins)] == [6, 6, 3]
    for kind in data.anomalies:
        part = data.anomalous(kind)
        for i, (x, twin) in enumerate(zip(part, data.twins, strict=True)):
            effect = part.effects[i]
            same = x.observations[:effect].tobytes() == twin.observations[:effect].tobytes()
            assert same, kind
            assert (x.observations[effect] != twin.observations[effect]).any()
        assert part.parameters[0]["strength"] == {"seep": 0.5, "iid": 0.3, "friction": 0.4}[kind]
    run = ["run", "--detector", "persistence", "--env", "basin", "--split", "mine"]
    assert main([*run, "--output", str(basin / "results")]) == 0
    assert "basin" in capsys.readouterr().out


def test_several_strengths_are_conditions_and_the_number_of_workers_changes_no_byte(basin):
    assert build("one", "--env", "valve", "--strength", "seep=0.1,2") == 0
    split = load_split("one")
    assert split.anomalies == ("seep", "seep@0.1", "seep@2")
    assert split.environment("valve").discrete
    again = ["--jobs", "2", "--output", str(basin / "again")]
    assert build("one", "--env", "valve", "--strength", "seep=0.1,2", *again) == 0
    assert load_split(basin / "again").digest == split.digest
    weak, strong = (split.environment("valve").anomalous(c) for c in split.conditions("valve"))
    twins = split.environment("valve").twins

    def distance(part):
        rows = zip(part, twins, strict=True)
        return np.mean([np.abs(x.observations - twin.observations).mean() for x, twin in rows])

    assert 0 < distance(weak) < distance(strong)


def test_every_strength_has_a_number_in_split_and_records_and_a_column(basin, capsys):
    assert build("one", "--env", "basin", "--strength", "seep=0.1,0.5,2,3") == 0
    split, numbers = load_split("one"), (0.1, 0.5, 2, 3)
    assert split.strengths("basin") == {Condition("seep", f"{n:g}"): n for n in numbers}
    assert main(["data", "info", "one"]) == 0
    assert "strengths of seep (share of the flow): 0.1, 0.5, 2, 3" in capsys.readouterr().out
    out = str(basin / "results")
    assert (
        main(["run", "--detector", "mewma", "--split", "one", "--env", "all", "--output", out]) == 0
    )
    capsys.readouterr()
    assert main(["show", out, "--split", "one", "--wide"]) == 0
    text = capsys.readouterr().out
    columns = text.partition("Matched AUC (%) by strength")[2].splitlines()[1]
    assert columns.split() == ["detector", "0.1", "0.5", "2", "3"]
    assert [r.magnitude for r in ResultsDirectory(basin / "results").records()] == [*numbers]


def test_ones_own_anomaly_is_recorded_in_an_environment_of_the_benchmark(basin, monkeypatch):
    code = BASIN.replace("simulator.env.outflow = 0.2 * (1 + strength)",
                        "simulator.scale('gravity', 1 + strength)")  # fmt: skip
    install(monkeypatch, basin / "other", "basin", code, header="")
    sizes = ["--train", "1", "--calibration", "1", "--test", "1", "--seed-base", "77"]
    assert main(["data", "build", "poles", *sizes, "--cap", "80", "--env", "cartpole",
                 "--strength", "seep=1", "--jobs", "1"]) == 0  # fmt: skip
    split = load_split("poles")
    assert split.groups == {"seep": "dynamics"}
    assert split.manifest["environments"]["cartpole"]["own"]["anomalies"] == {"seep": "dynamics"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--env", "basin"], "no strengths of anomalies are given for 'basin'"),
        (["--env", "basin", "--strength", "seep=9"], "the strength of seep is 9, expected 0 to 3"),
        (["--env", "basin", "--strength", "gravity=1"], "unknown anomaly that basin can have"),
        (["--env", "basin", "--strength", "sepe=1"], "did you mean 'seep'"),
        (["--env", "bsain", "--strength", "seep=1"], "did you mean 'basin'"),
        (["--env", "basin", "--strength", "seep=much"], "expected ANOMALY=NUMBER"),
    ],
)
def test_what_cannot_be_recorded_is_said(basin, capsys, options, message):
    assert build("mine", *options) == 4
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"basin", Basin', '"hopper", Basin', "'hopper' cannot be the name of a custom"),
        ('"basin", Basin', '"basin", lambda: Basin()', "at the top level of a module"),
        ('"seep", "dynamics"', '"iid", "dynamics"', "'iid' cannot be the name of a custom"),
        ("return [AnomalySpec(", "return (AnomalySpec(", "expected a list of oodd_eval.Anomaly"),
        ('EnvironmentSpec("valve"', 'EnvironmentSpec("seep"', "'seep' is offered twice"),
        ("Box(-1.0, 1.0, (1,))", "Box(-np.inf, 2.0, (1,))", "a Box of shape (1,) with finite ends"),
    ],
)
def test_a_wrong_spec_makes_its_plugin_broken(basin, monkeypatch, capsys, old, new, message):
    code = BASIN.replace(old, new)
    code = code.replace("seep)]", "seep),)") if "(AnomalySpec" in new else code
    install(monkeypatch, basin / "other", "basin", code, header="")
    assert build("mine", "--env", "basin", "--strength", "seep=1") == 4
    assert message in capsys.readouterr().err


def test_arguments_of_a_partial_are_part_of_what_acts(forgotten):
    import gymnasium

    digests = set()
    for name in ("CartPole-v1", "Acrobot-v1"):
        make = functools.partial(gymnasium.make, name)
        registry.register([registry.EnvironmentSpec("one", make, "policy.npz", (), (), 99)])
        digests.add(code_digest("one", []))
    assert len(digests) == 2


def checked(name, capsys, *options):
    code = main(["check", name, *options])
    return code, " ".join(capsys.readouterr().out.split())


def test_they_are_listed_described_and_pass_their_checks(basin, capsys):
    for arguments in (["list", "envs"], ["list", "anomalies"], ["info", "basin"], ["info", "seep"]):
        assert main(arguments) == 0
    told = capsys.readouterr().out
    for text in ("plug-in 'basin' of oodd-basin", "water leaves faster", "upper (m)", "0 to 3"):
        assert text in told
    assert main(["policies", "evaluate", "basin", "--episodes", "2"]) == 0
    assert "basin: return -" in capsys.readouterr().out
    for name in ("basin", "valve"):
        assert checked(name, capsys)[0] == 0
    code, told = checked("seep", capsys)
    assert (code, "6 passed" in told) == (0, True)
    assert checked("seep", capsys, "--env", "valve", "-k", "onset or draws")[0] == 0
    assert checked("seep", capsys, "-k", "nothing")[0] == 5
    assert main(["check", "basin/bason"]) == 4
    assert "'basin/bason': did you mean 'basin/basin'?" in capsys.readouterr().err


def test_what_grows_ends_and_rests_passes_its_checks(cistern, capsys):
    assert checked("cistern", capsys)[0] == 0
    for name, last in (("clog", "share"), ("surge", "end"), ("offset", "end")):
        code, told = checked(name, capsys)
        assert (code, "7 passed" in told, f" {last} " in told) == (0, True, True), told
    assert checked("offset-intermittent", capsys, "-k", "end or sensors")[0] == 0


NOISE = "0.01 * self.np_random.normal(size=2)"
OFFSET = "return SensorFault(np.array([0]), lambda x, _: x + strength)"
CORRUPTING = """fault = Fault({{}})
    fault.observe = lambda row, _: row + np.float32({})
    return fault
"""


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("basin", NOISE, "0.01 * np.random.default_rng().normal(size=2)",
         "FAILED seed two episodes of seed 960000000 differ"),
        ("basin", "self.np_random.uniform(0.8, 1.2, 2)", "np.ones(2)",
         "FAILED seed different seeds give the same episode"),
        ("basin", "False, False, {}", "self.level[0] > 1.6, False, {}", "FAILED columns 0 of 8"),
        ("basin", "return lambda row: [np.clip(2.0 - row[1], -1, 1)]",
         "t = iter(range(10**9))\n    return lambda row: [next(t) % 2 - 0.5]",
         "FAILED policy the policy gives another action"),
        ("basin", 'Quantity(n, u) for n, u in (("upper", "m"),', "Quantity(n, u) for n, u in (",
         "FAILED columns environment 'basin' has observations"),
        ("seep", "0.2 * (1 + strength)", "0.2 * (1.5 + strength)",
         "FAILED zero-strength with seed 960000000 it differs from its twin"),
        ("seep", "0.2 * (1 + strength)", "0.2", "FAILED onset at the largest strength 8 of 8"),
        ("seep", "return Seep({})", "return Seep({'strong': strength > 1})",
         "FAILED draws with seed 960000000 it draws {'strong': False} or {'strong': True}"),
        ("seep", "0.2 * (1 + strength)", "0.2 * (1 + strength * (3 - strength))",
         "FAILED strength the mean distance from the twins is"),
        ("seep", "return Seep({})", "raise ValueError('no')",
         "FAILED zero-strength it raised ValueError: no"),
        ("cistern", "        self.sum = 0.0", "        self.sum = getattr(self, 'sum', 0.0)",
         "FAILED policy the policy gives another action for row 0 of seed 960000000 after reset()"),
        ("cistern", "max(0.0, 1.0 - abs", "(1.0 - 9 * abs",
         "FAILED rewards rewards of seed 960000000 are -"),
        ("cistern", "max(3.0 + 4.0 * error + self.sum, 0.0), 8.0)", "5.0 + 99 * error, 99.0)",
         "FAILED policy the policy commands ["),
        ("surge", "1.0 - abs(self.level - self.goal)", "1.0 + self.inflow",
         "FAILED rewards rewards of seed 960000000 are 1 to 1.4"),
        ("surge", "simulator.env.inflow = 0.0", "pass",
         "FAILED end with seed 960000000 it differs from its twin though it ended"),
        ("clog", "self.share * strength", "strength",
         "FAILED share with seed 960000000 it differs from its twin while its share is 0"),
        ("offset", "np.array([0])", "np.array([2])",
         "FAILED onset offset corrupts goal (reference) in cistern, expected sensors"),
        ("offset", OFFSET, CORRUPTING.format("[0, 0, strength]"),
         "FAILED sensors with seed 960000000 it corrupts 'goal' (reference)"),
        ("offset", OFFSET, CORRUPTING.format("[0, strength, 0]"),
         "FAILED sensors with seed 960000000 it corrupts 'flow', number 1"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_an_environment_or_an_anomaly_is_found(
    tmp_path, forgotten, monkeypatch, capsys, name, old, new, message
):
    plugin, code = ("basin", BASIN) if name in {"basin", "seep"} else ("cistern", CISTERN)
    assert old in code
    code = code.replace(old, new)
    if old.startswith("self.np_random.uniform"):
        code = code.replace(NOISE, "0.01")
    install(monkeypatch, tmp_path / "plugin", plugin, code, header="")
    code, told = checked(name, capsys)
    assert (code, message in told) == (1, True), told
