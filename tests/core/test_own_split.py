"""A split may hold environments and anomalies that the benchmark does not know."""

import json

import pytest
from helpers_plugins import local_spec
from helpers_split import make_group, make_split

from oodd_eval import evaluate, load_split
from oodd_eval.cli.main import main
from oodd_eval.data.condition import Condition, in_suite_order
from oodd_eval.data.description import describe
from oodd_eval.data.facts import ENVIRONMENTS, Quantity, in_order
from oodd_eval.data.fetch import fetch
from oodd_eval.data.layout import MANIFEST, own_facts, write_environment, write_manifest
from oodd_eval.errors import SplitError, UsageError
from oodd_eval.results import tables
from oodd_eval.results.board import boards
from oodd_eval.results.comparison import read_record_set, write_reference
from oodd_eval.results.tables import Tables

OWN = {"slip": "dynamics", "fog": "sensor"}
LIKE = {"slip": "gravity", "fog": "iid"}


def add_environment(directory, name, kinds, *, discrete=True):
    """Add an environment that moves like CartPole to a synthetic split."""
    manifest = json.loads((directory / MANIFEST).read_text())
    first = 9_000_000
    groups = {
        "train": make_group("cartpole", range(first, first + 6), 60),
        "calibration": make_group("cartpole", range(first + 10, first + 14), 60),
        "test/nominal": make_group("cartpole", range(first + 20, first + 23), 60),
    }
    for kind in kinds:
        own = make_group("cartpole", range(first + 20, first + 23), 60, LIKE.get(kind, kind))
        groups[f"test/{kind}"] = own
    entries = manifest["environments"]
    entries[name] = write_environment(
        directory / f"{name}.h5", groups.items(), "0" * 64,
        sensors=[Quantity(f"gauge {i}", "bar") for i in range(4)],
        actions=[Quantity("open", "1"), Quantity("close", "1")],
        custom=own_facts(name, discrete=discrete, groups=kinds),
    )  # fmt: skip
    write_manifest(directory, manifest["definition"], entries, generator=1, versions={})
    return directory


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    place = make_split(tmp_path_factory.mktemp("own") / "mine", ("cartpole",), name="mine")
    add_environment(place, "valve", {**OWN, "drift": "sensor"})
    return add_environment(place, "pump", {"slip": "dynamics"}, discrete=False)


def test_known_names_come_first_and_others_in_their_order():
    assert in_order(["zebra", "hopper", "ape", "acrobot", "zebra"], ENVIRONMENTS) == [
        "acrobot", "hopper", "zebra", "ape",
    ]  # fmt: skip
    texts = ["b@2", "drift", "iid@10", "iid@2", "iid@kept50", "b@10", "iid@kept90", "iid"]
    assert " ".join(map(str, in_suite_order(map(Condition.parse, texts)))) == (
        "iid iid@kept90 iid@kept50 iid@2 iid@10 drift b@2 b@10"
    )


def test_environments_and_anomalies_of_ones_own_stand_behind_the_benchmarks(place):
    split = load_split(place)
    assert split.environments == ("cartpole", "valve", "pump")
    assert split.environment("valve").anomalies == ("drift", "fog", "slip")
    assert split.anomalies[-2:] == ("fog", "slip")
    assert {kind: split.groups[kind] for kind in OWN} == OWN
    assert [split.environment(e).discrete for e in split.environments] == [True, True, False]
    assert all(check.ok for check in split.verify())
    # What ships says nothing of its own.
    assert own_facts("hopper", discrete=False, groups={"iid": "sensor"}) == {}
    assert own_facts("hopper", discrete=False, groups={"iid": "sensor", "fog": "sensor"}) == {
        "own": {"discrete": False, "anomalies": {"fog": "sensor"}}
    }


def test_a_run_scores_what_each_environment_has_and_tables_name_it(place):
    results = evaluate(local_spec("mahalanobis"), place, anomalies="slip,gravity,fog")
    found = [(r.environment, r.anomaly, r.group) for r in results]
    assert found == [
        ("cartpole", "gravity", "dynamics"), ("valve", "slip", "dynamics"),
        ("valve", "fog", "sensor"), ("pump", "slip", "dynamics"),
    ]  # fmt: skip
    assert results.ok
    (board,) = boards(results.records)
    assert board.environments == ["cartpole", "valve", "pump"]
    assert board.in_group("dynamics") == ["gravity", "slip"]
    table = Tables(board).by_anomaly(board.entries[0])
    assert table.header == ["Environment", "gravity", "slip", "fog"]
    assert [row[0] for row in table.rows] == ["CartPole", "valve", "pump"]
    assert not [line for line in tables.notes(board) if "without" in line]


def test_results_are_shown_described_and_kept_as_a_reference(place, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("OODD_EVAL_DATA", str(place.parent))
    output = str(tmp_path / "results")
    command = ["run", "--detector", "clock", "--env", "valve,pump", "--split", "mine"]
    assert main([*command, "--output", output]) == 0
    assert main(["show", output, "--env", "pump"]) == 0
    assert "pump" in capsys.readouterr().out
    records = read_record_set(output).records
    write_reference(reversed([*records]), tmp_path / "reference.jsonl")
    kept = read_record_set(tmp_path / "reference.jsonl").records
    assert [r.environment for r in kept] == ["pump", "valve", "valve", "valve"]
    told = describe(load_split(place))
    assert "gauge 0 [bar]" in told
    assert "test/fog" in told
    assert main(["data", "verify", "mine"]) == 0


def test_an_environment_of_another_split_is_told_with_that_split(place, capsys, monkeypatch):
    monkeypatch.setenv("OODD_EVAL_DATA", str(place.parent))
    assert main(["run", "--detector", "clock", "--env", "pump"]) == 4
    message = capsys.readouterr().err
    assert "'pump': it is in mine, pass --split mine" in message
    assert main(["run", "--detector", "clock", "--env", "worlds/tank"]) == 4
    assert "--split worlds after `oodd-eval data build worlds`" in capsys.readouterr().err
    assert main(["run", "--detector", "clock", "--env", "other/tank"]) == 4
    assert "unknown environment 'other/tank'" in capsys.readouterr().err
    assert main(["run", "--detector", "clock", "--env", "pumpp"]) == 4
    assert "unknown environment 'pumpp'" in capsys.readouterr().err
    with pytest.raises(UsageError, match=r"unknown anomaly 'gravity'.*Known: slip"):
        evaluate("clock", place, environments="pump", anomalies="gravity")


def edited(place, change):
    manifest = json.loads((place / MANIFEST).read_text())
    change(manifest["environments"])
    (place / MANIFEST).write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda e: e["valve"]["own"]["anomalies"].update(slip="sensor"), "it was edited"),
        (lambda e: e["valve"]["own"].update(discrete=False), "it was edited"),
        (lambda e: e["valve"]["own"]["anomalies"].pop("slip"), "unknown anomaly 'slip' in valve"),
        (lambda e: e["pump"].pop("own"), "unknown environment 'pump'"),
        (lambda e: e.update({"../x": e.pop("pump")}), "String should match pattern"),
        (lambda e: e["pump"]["own"]["anomalies"].update(slip="odd"), "Input should be 'sensor'"),
    ],
)
def test_what_a_manifest_says_of_ones_own_is_checked(place, tmp_path, change, message):
    copy = fetch(str(place), output=tmp_path / "copy").split.path
    edited(copy, change)
    with pytest.raises(SplitError, match=message):
        load_split(copy).environments  # noqa: B018
