"""Names of environments and kinds of plug-ins have spaces: no clash breaks a plug-in."""

import json
from dataclasses import replace

import pytest

pytest.importorskip("gymnasium", reason="needs the extra gym")
from helpers_own import CISTERN, forget_own
from helpers_plugins import install

from oodd_eval import load_split
from oodd_eval.cli.main import main
from oodd_eval.data import registry
from oodd_eval.errors import PluginError, UnknownNameError, UsageError
from oodd_eval.plugins.discovery import discover
from oodd_eval.results.directory import ResultsDirectory

SIZES = ["--train", "6", "--calibration", "6", "--test", "3", "--seed-base", "77", "--jobs", "1"]
LATE = (
    CISTERN.replace("Cistern", "Late").replace('"cistern"', '"tank"').replace('"clog"', '"payload"')
)
"""A plug-in with an environment `tank` and a kind `payload`, as the worlds have."""

ONE = LATE.replace("ROWS = 120", "ROWS = 110")
TWO = LATE.replace('"level", "m"', '"height", "m"').replace(
    '"dynamics", "a pump wears"', '"sensor", "x"'
)


@pytest.fixture
def two(monkeypatch, tmp_path):
    """Two plug-ins beside the worlds, each with an environment `tank` and a kind `payload`."""
    monkeypatch.setenv("OODD_EVAL_DATA", str(tmp_path / "splits"))
    forget_own()
    for name, code in (("one", ONE), ("two", TWO)):
        install(monkeypatch, tmp_path / name, name, code, header="")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path / 'one'}:{tmp_path / 'two'}")
    yield tmp_path
    forget_own()


def build(name, *options):
    return main(["data", "build", name, *SIZES, *options])


def test_nobody_is_broken_and_lists_say_long_names_where_short_ones_are_shared(two, capsys):
    assert discover().broken == []
    for kind, names, alone in (
        ("envs", {"one/tank", "two/tank", "worlds/tank"}, "arm"),
        ("anomalies", {"one/payload", "two/payload", "worlds/payload"}, "leak"),
    ):
        assert main(["list", kind]) == 0
        first = {line.split()[0] for line in capsys.readouterr().out.splitlines()}
        assert names | {alone} <= first
        assert not {"tank", "payload"} & first


@pytest.mark.parametrize("name", ["tank", "payload"])
@pytest.mark.parametrize("command", [["check"], ["info"]])
def test_a_shared_short_name_is_refused_with_the_long_ones(two, capsys, command, name):
    assert main([*command, name]) == 4
    told = capsys.readouterr().err
    assert all(f"{plugin}/{name}" in told for plugin in ("one", "two", "worlds"))


@pytest.mark.parametrize(
    "arguments",
    [
        ["policies", "evaluate", "tank"],
        ["data", "page", "tank"],
        ["data", "calibrate", "--env", "tank", "--output", "x.json"],
        ["data", "build", "mine", *SIZES, "--env", "tank", "--strength", "iid=0.1"],
        ["data", "build", "mine", *SIZES, "--env", "t*", "--strength", "iid=0.1"],
    ],
)
def test_commands_that_record_refuse_a_shared_short_name(two, capsys, monkeypatch, arguments):
    monkeypatch.chdir(two)
    assert main(arguments) == 4
    assert (
        "'tank' is the short name of one/tank, two/tank and worlds/tank" in capsys.readouterr().err
    )


def test_what_was_named_is_checked_and_described(two, capsys):
    for plugin, sensor in (("one", "level (m)"), ("two", "height (m)"), ("worlds", "level 1 (cm)")):
        assert main(["info", f"{plugin}/tank"]) == 0
        assert sensor in capsys.readouterr().out
    assert main(["check", "two/tank", "-k", "columns"]) == 0
    assert capsys.readouterr().out.startswith("two/tank\n")
    assert main(["check", "one/payload", "-k", "onset"]) == 0
    assert capsys.readouterr().out.startswith("one/payload in one/tank\n")
    assert main(["check", "one/payload", "--env", "one/tank", "-k", "onset"]) == 0
    assert main(["policies", "evaluate", "two/tank", "--episodes", "1"]) == 0


def test_each_is_recorded_and_evaluated_by_short_and_long_names(two, capsys):
    """An environment's own kind is meant by its short name, in the worker processes, too."""
    digests = set()
    for plugin, sensor, group in (("one", "level", "dynamics"), ("two", "height", "sensor")):
        for i, kind in enumerate(("payload", f"{plugin}/payload")):
            name = f"of-{plugin}-{i}"
            assert build(name, "--env", f"{plugin}/tank", "--strength", f"{kind}=0.2,0.5") == 0
            split = load_split(name)
            digests.add(split.environment("tank").digest)
            assert split.environments == ("tank",)
            assert split.anomalies == ("payload", "payload@0.2", "payload@0.5")
            assert (split.columns[0], split.groups) == (sensor, {"payload": group})
            entry = split.manifest["environments"]["tank"]
            assert entry["plugins"] == {"": plugin, "payload": plugin}
        run = ["run", "--detector", "persistence", "--split", name, "-q"]
        for j, (env, anomaly) in enumerate(
            [("tank", "payload"), (f"{plugin}/tank", f"{plugin}/payload@0.5")]
        ):
            out = str(two / f"results-{plugin}-{j}")
            assert main([*run, "--env", env, "--anomaly", anomaly, "--output", out]) == 0
            records = ResultsDirectory(two / f"results-{plugin}-{j}").records()
            assert {r.environment for r in records} == {"tank"}
            assert [str(r.condition) for r in records] == (
                ["payload@0.5"] if j else ["payload@0.2", "payload@0.5"]
            )
        capsys.readouterr()
        assert main(["show", out, "--env", f"{plugin}/tank"]) == 0
        assert "persistence" in capsys.readouterr().out
        other = "two" if plugin == "one" else "one"
        assert main(["show", out, "--env", f"{other}/tank"]) == 4
        assert main([*run, "--env", f"{other}/tank", "--output", out]) == 4
        assert f"it is in of-{other}-0 and" in capsys.readouterr().err or plugin == "one"
        assert main([*run, "--env", "worlds/tank", "--output", out]) == 4
    assert len(digests) == 2  # one each, whatever its kind was called


def test_the_worlds_are_recorded_whoever_shares_their_names(two):
    """Published definitions have short names, which mean the worlds' own."""
    definition = {"train": 2, "calibration": 2, "test": 1}
    names = ["worlds/tank", "--strength", "leak=0.05"]
    sizes = [word for n, size in definition.items() for word in (f"--{n}", str(size))]
    command = ["data", "build", "small", *sizes, "--seed-base", "77", "--jobs", "1", "--env"]
    assert main([*command, *names]) == 0
    split = load_split("small")
    assert split.columns[0] == "level 1"
    assert split.environment_names == ("tank", "worlds/tank")


def test_a_split_is_of_one_plugin_and_not_replaced_by_another(two, capsys):
    options = "--strength", "iid=0.1"
    assert build("mine", "--env", "one/tank", *options) == 0
    before = load_split("mine").digest
    assert build("mine", "--env", "two/tank", *options) == 4
    assert "holds one/tank, and two/tank has the same short name" in capsys.readouterr().err
    assert build("mine", "--env", "one/tank,two/tank", *options) == 4
    assert "is the short name of one/tank and two/tank" in capsys.readouterr().err
    assert load_split("mine").digest == before


def test_kinds_for_an_environment_are_of_the_one_beside_them(two, capsys):
    """The worlds' `leak` is for their tank, and cannot be recorded in another one."""
    assert build("mine", "--env", "one/tank", "--strength", "leak=0.05") == 4
    assert "unknown anomaly that tank can have 'leak'" in capsys.readouterr().err
    assert build("mine", "--env", "cartpole", "--strength", "one/payload=0.5") == 4
    assert "unknown anomaly that cartpole can have" in capsys.readouterr().err
    assert build("mine", "--env", "cartpole", "--strength", "three/payload=0.5") == 4
    assert "unknown anomaly 'three/payload'" in capsys.readouterr().err


def test_a_kind_may_be_for_an_environment_of_another_plugin_by_its_long_name(two):
    """A short name in `environments` means the plug-in's own; a long one whoever has it."""
    offered = discover().custom_specs
    (tank,) = offered.named("two/tank", registry.EnvironmentSpec)
    (kind,) = offered.named("one/payload", registry.AnomalySpec)
    assert kind.environments == ("tank",)
    assert not offered.is_for(kind, "one", tank)
    assert offered.is_for(replace(kind, environments=("two/tank",)), "one", tank)
    assert not offered.is_for(replace(kind, environments=("worlds/tank",)), "one", tank)
    assert offered.is_for(replace(kind, environments=()), "one", tank)


def test_a_broken_plugin_hides_nothing_of_another_with_the_same_name(two):
    """Two distributions may name their plug-ins alike: what is there has its long name."""
    offered = discover().custom_specs
    beside = type(offered)(offered.specs, {"one": "'one' of elsewhere: no module"})
    assert [spec.name for spec in beside.meanings("one/tank")] == ["tank"]
    with pytest.raises(PluginError, match="elsewhere"):
        beside.meanings("one/pool")


GENERAL = """
import numpy as np
from oodd_eval import AnomalySpec, hookimpl
from oodd_recording.faults import SensorFault


def offset(strength, rng, simulator):
    return SensorFault(np.array([0]), lambda x, _: x + FACTOR * strength)


@hookimpl
def oodd_anomalies():
    return [AnomalySpec("payload", "sensor", "an offset", "1", 1.0, offset)]
"""


def test_a_kind_for_all_environments_is_named_where_two_plugins_have_it(two, monkeypatch, capsys):
    sizes = [
        "--train",
        "1",
        "--calibration",
        "1",
        "--test",
        "1",
        "--seed-base",
        "77",
        "--cap",
        "80",
    ]
    command = ["data", "build", "poles", *sizes, "--jobs", "1", "--env", "cartpole", "--strength"]
    for name, factor in (("half", "0.5"), ("whole", "1.0")):
        install(monkeypatch, two / name, name, GENERAL.replace("FACTOR", factor), header="")
    assert main([*command, "payload=0.5"]) == 4
    assert (
        "'payload' is the short name of half/payload and whole/payload" in capsys.readouterr().err
    )
    assert main([*command, "half/payload=0.5", "--strength", "whole/payload=0.5"]) == 4
    assert main([*command, "half/payload=0.5"]) == 0
    split = load_split("poles")
    assert split.anomalies == ("payload",)
    assert split.manifest["environments"]["cartpole"]["plugins"] == {"payload": "half"}
    data = split.environment("cartpole")
    part, onset = data.anomalous("payload"), data.anomalous("payload").onsets[0]
    gap = part[0].observations[onset, 0] - data.twins[0].observations[onset, 0]
    assert gap == pytest.approx(0.25)
    # Its own kind comes first in an environment, and what two others have means neither.
    specs = discover().custom_specs
    specs.register(["one/tank"])
    assert registry.anomaly_spec("payload").plugin == "one"
    specs.register(["worlds/arm"])
    assert registry.anomaly_spec("payload").plugin == "worlds"


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("import gymnasium", "import no_such_module", "no_such_module"),
        ("Integral, SENSORS", "lambda: Integral(), SENSORS", "at the top level of a module"),
    ],
)
def test_a_broken_plugin_is_not_replaced_by_another_of_the_name(
    monkeypatch, tmp_path, capsys, old, new, reason
):
    """Its environment `tank` is no other plug-in's."""
    monkeypatch.chdir(tmp_path)
    install(monkeypatch, tmp_path / "plugin", "tank", ONE.replace(old, new), header="")
    for command in (["check"], ["info"], ["policies", "evaluate"], ["data", "page"]):
        assert main([*command, "tank"]) == 4
        assert reason in capsys.readouterr().err
    assert build("mine", "--env", "tank", "--strength", "iid=0.1") == 4
    assert reason in capsys.readouterr().err
    assert main(["check", "tank/tank"]) == 4
    assert main(["list", "envs"]) == 1
    assert "[broken plug-in]" in capsys.readouterr().out
    assert main(["check", "worlds/tank", "-k", "columns"]) == 1  # what was broken may be missed
    assert main(["check", "worlds/tank", "-k", "columns", "-p", "no:tank"]) == 0
    forget_own()


def test_names_mean_the_same_in_any_order_of_plugins(two, monkeypatch):
    specs = discover().custom_specs
    turned = type(specs)(specs.specs[::-1], specs.broken)
    for offered in (specs, turned):
        for name in ("tank", "payload"):
            with pytest.raises(UsageError, match="short name"):
                offered.meanings(name)
        assert offered.register(["one/tank", "worlds/arm"], ["iid"]) == ["tank", "arm"]
        with pytest.raises(UsageError, match="one/payload and worlds/payload"):
            offered.register(["one/tank", "worlds/arm"], ["payload"])
        with pytest.raises(UsageError, match="'payload' is the short name"):
            offered.register(["one/tank", "worlds/arm"])  # their ladders may need both
        with pytest.raises(UnknownNameError):
            offered.register(["three/tank"])
    with pytest.raises(PluginError, match="broken"):
        type(specs)(specs.specs, {"three": "'three'"}).register(["three/tank"])


def test_the_manifest_of_an_older_split_says_nothing_and_short_names_select(two, capsys):
    assert build("mine", "--env", "one/tank", "--strength", "iid=0.1") == 0
    file = two / "splits" / "mine" / "manifest.json"
    manifest = json.loads(file.read_text())
    del manifest["environments"]["tank"]["plugins"]
    digest = manifest["digest"]
    file.write_text(json.dumps(manifest))
    split = load_split(two / "splits" / "mine")
    assert (split.digest, split.environment_names) == (digest, ("tank", "tank"))
    assert split.select("tank", "all") == (["tank"], ["iid"])
    with pytest.raises(UsageError):
        split.select("one/tank", "all")
    assert build("mine", "--env", "one/tank", "--strength", "iid=0.1") == 0
    assert load_split(two / "splits" / "mine").digest == digest


def test_a_published_definition_means_the_worlds_whatever_is_installed(two, monkeypatch):
    recorded = []
    record = "oodd_recording.commands.record_split"
    monkeypatch.setattr(
        record, lambda _definition, _options, names, *_, **__: recorded.append(names)
    )
    for options, names in (
        (["--env", "tank"], ["tank"]),
        (["--env", "t*"], ["tank"]),
        ([], ["arm", "drone", "tank"]),
    ):
        assert main(["data", "build", "worlds", *options]) == 0
        assert recorded.pop() == names
        assert registry.environment_spec("tank").plugin == "worlds"
        assert registry.anomaly_spec("leak").plugin == "worlds"


ACTING = """


@hookimpl
def oodd_acts():
    from oodd_interventions import ActSpec

    return [ActSpec("stop", Held, "the pump holds", ("dynamics",), ("tank",))]


class Held:
    def __init__(self, situation):
        pass

    def act(self, row):
        return np.array([4.0], np.float32)
"""


def test_what_an_alarm_saves_is_studied_in_the_environment_that_was_named(two, monkeypatch, capsys):
    """The split says whose its environment is, and acts are those for it."""
    install(monkeypatch, two / "acting", "acting", ONE + ACTING, header="")
    monkeypatch.setenv("PYTHONPATH", str(two / "acting"))
    assert build("mine", "--env", "acting/tank", "--strength", "payload=0.5") == 0
    study = ["intervene", "--detector", "persistence", "--split", "mine", "--level", "30"]
    study += ["--seeds", "1", "--jobs", "1", "--output", str(two / "study")]
    capsys.readouterr()
    assert main([*study, "--env", "tank"]) == 0
    (file,) = (two / "study" / "cells").rglob("*.json")
    assert (
        file.relative_to(two / "study" / "cells").as_posix()
        == "tank/persistence/payload--stop.json"
    )
    assert "act_source" in json.loads(file.read_text())  # no shipped act
    assert main([*study, "--env", "acting/tank", "--act", "acting/stop"]) == 0
    assert main([*study, "--env", "worlds/tank"]) == 4


def test_globs_stand_for_short_names_unless_they_have_a_slash(two, capsys):
    assert build("mine", "--env", "one/tank", "--strength", "one/payload=0.5,0.7") == 0
    split = load_split("mine")
    conditions = ["payload", "payload@0.5", "payload@0.7"]
    assert split.select("o*/t*", "one/*") == (["tank"], conditions)
    assert split.select("t*", "*") == (["tank"], conditions)
    assert split.select("all", "one/payload@0.7,payload@0.7") == (["tank"], ["payload@0.7"])
    for names in (("o*", "all"), ("all", "o*"), ("two/*", "all")):
        with pytest.raises(UsageError):
            split.select(*names)
    assert discover().custom_specs.select_environments("t*,one/*") == ["tank", "one/tank"]
