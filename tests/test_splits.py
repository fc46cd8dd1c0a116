"""Opening a split: what is read back, what is verified, and what each kind of damage says."""

import hashlib
import json
import shutil
import tracemalloc

import h5py
import numpy as np
import pytest
from helpers_split import make_group, make_split
from hypothesis import given
from hypothesis import strategies as st

from oodd_eval.cli.main import main
from oodd_eval.data import layout as splits_format
from oodd_eval.data import parts
from oodd_eval.data import split as splits
from oodd_eval.data.facts import ENVIRONMENTS, TABLE1
from oodd_eval.data.layout import check_layout, content_digest, write_environment
from oodd_eval.data.parts import TWINS, TrajectorySet
from oodd_eval.data.split import load_split
from oodd_eval.errors import DigestError, SplitError, SplitNotFoundError, UnknownNameError


@pytest.fixture
def copy(tiny_split, tmp_path):
    """A copy that may be damaged."""
    return shutil.copytree(tiny_split, tmp_path / "tiny")


@pytest.fixture
def data_home(tmp_path, monkeypatch):
    monkeypatch.setenv("OODD_EVAL_DATA", str(tmp_path / "home"))
    return tmp_path / "home"


def edit_manifest(directory, change):
    file = directory / "manifest.json"
    manifest = json.loads(file.read_text())
    change(manifest)
    file.write_text(json.dumps(manifest))


def test_what_was_written_is_read_back(tiny_split):
    data = load_split(tiny_split).environment("hopper")
    seeds = range(9_600_000, 9_600_003)
    for anomaly in TABLE1:
        found, wrote = data.anomalous(anomaly), make_group("hopper", seeds, 60, anomaly)
        assert found.seeds.tolist() == list(seeds)
        assert found.onsets.tolist() == wrote["onsets"].tolist()
        assert found.effects.tolist() == wrote["effects"].tolist()
        assert found.parameters[1] == {"anomaly": anomaly, "unit": "µ", "seed": 9_600_001}
        rows = np.concatenate([x.observations for x in found])
        np.testing.assert_array_equal(rows, wrote["observations"].astype("f4"))
        actions = np.concatenate([x.actions for x in found])
        np.testing.assert_array_equal(actions, wrote["actions"].astype("f4"))


def test_lengths_returns_and_sizes_of_the_parts(tiny_split):
    data = load_split(tiny_split).environment("cartpole")
    assert [len(p) for p in (data.train, data.calibration, data.twins)] == [6, 4, 3]
    assert data.twins.lengths.tolist() == [60, 61, 62]
    assert data.twins.returns.tolist() == [60.0, 61.0, 62.0]
    assert data.anomalous("iid").returns.tolist() == [30.0, 30.5, 31.0]
    assert data.twins.terminated.tolist() == [False] * 3
    assert data.anomalies == TABLE1


def test_twins_are_identical_before_the_onset_only(tiny_split):
    data = load_split(tiny_split).environment("hopper")
    drifted = data.anomalous("drift")
    for twin, x, onset in zip(data.twins, drifted, drifted.onsets, strict=True):
        np.testing.assert_array_equal(x.observations[:onset], twin.observations[:onset])
        assert (x.observations[onset] != twin.observations[onset]).any()


def brute_force_effect(x, twin):
    """The first row that both have and that differs."""
    for t in range(min(len(x), len(twin))):
        if any(a != b for a, b in zip(x.observations[t], twin.observations[t], strict=True)):
            return t
    return None


def test_the_effect_is_the_first_row_that_differs_from_the_twin(tiny_split):
    data = load_split(tiny_split).environment("cartpole")
    for anomaly in TABLE1:
        part = data.anomalous(anomaly)
        expected = [brute_force_effect(*pair) for pair in zip(part, data.twins, strict=True)]
        assert part.effects.tolist() == expected


@pytest.mark.parametrize(
    ("tails", "brief"), [((19, 19, 90), True), ((5, 20, 90), False), ((19, 20), True)]
)
def test_a_part_is_brief_when_its_median_tail_is_under_20(tmp_path, tails, brief):
    file = tmp_path / "x.h5"
    with h5py.File(file, "w") as stored:
        group = stored.create_group("test/iid")
        group["offsets"] = np.append(0, np.cumsum([30 + tail for tail in tails]))
        group["onsets"] = group["effects"] = np.full(len(tails), 30)
        group["seeds"] = group["redraws"] = np.zeros(len(tails), np.int64)
        part = parts.AnomalousSet(stored, "test/iid")
        assert part.tails.tolist() == list(tails)
        assert part.brief is brief


def test_names_and_units_are_in_file_and_manifest_alike(tiny_split):
    split = load_split(tiny_split)
    for environment in split.environments:
        data, info = split.environment(environment), ENVIRONMENTS[environment]
        assert (data.sensors, data.actions) == (info.sensors, info.actions)
        entry = split.manifest["environments"][environment]
        named = [(q["name"], q["unit"]) for q in entry["sensors"] + entry["actions"]]
        assert named == [(q.name, q.unit) for q in data.sensors + data.actions]
        with h5py.File(tiny_split / f"{environment}.h5") as stored:
            assert stored["names/sensors"].dtype.kind == "S"
            first = json.loads(stored["names/sensors"][0])
        assert first == {"name": data.sensors[0].name, "unit": data.sensors[0].unit}


def test_a_trajectory_set_is_a_sequence(tiny_split):
    train = load_split(tiny_split).environment("cartpole").train
    assert len(train[1:3]) == 2
    np.testing.assert_array_equal(train[-1].observations, train[5].observations)
    with pytest.raises(IndexError):
        train[6]


def test_iteration_holds_one_block_of_trajectories_in_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(parts, "_ROWS", 800)
    monkeypatch.setattr(parts, "_KEPT", 1000)
    groups = {"train": make_group("ant", range(60), 400)}
    info = ENVIRONMENTS["ant"]
    write_environment(tmp_path / "ant.h5", groups.items(), "",
                      sensors=info.sensors, actions=info.actions)  # fmt: skip
    whole = groups["train"]["observations"].astype("f4").nbytes
    with h5py.File(tmp_path / "ant.h5") as file:
        train = TrajectorySet(file, "train")
        tracemalloc.start()
        total = sum(len(x) for x in train)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert total == whole // (28 * 4)
    assert peak < whole / 10


# Digests


def test_group_digest_is_sha256_over_sorted_names_dtypes_shapes_and_bytes():
    group = {"b": np.array([1, 2], ">i2"), "a": np.array([[0.5]], "<f4"), "c": np.array([b"{}"])}
    by_hand = b"a|<f4|(1, 1)|\x00\x00\x00\x3f" + b"b|<i2|(2,)|\x01\x00\x02\x00" + b"c||S2|(1,)|{}"
    assert content_digest(group) == hashlib.sha256(by_hand).hexdigest()


def test_digest_ignores_chunks_compression_and_block_size(tmp_path, monkeypatch):
    array = np.arange(30_000, dtype="<f4").reshape(-1, 3)
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file.create_group("plain").create_dataset("a", data=array)
        file.create_group("packed").create_dataset(
            "a", data=array, chunks=(7, 2), compression="gzip", shuffle=True
        )
        expected = content_digest({"a": array})
        assert content_digest(file["plain"]) == expected
        monkeypatch.setattr(splits_format, "_BLOCK", 1000)
        assert content_digest(file["packed"]) == expected


@given(st.lists(st.floats(width=32, allow_nan=False), min_size=2, max_size=20), st.integers(0, 19))
def test_digest_changes_with_any_value_and_with_the_shape(values, index):
    array = np.array(values, "<f4")
    other = array.copy()
    other.view("<u4")[index % len(array)] ^= 1
    digest = content_digest({"a": array})
    assert digest != content_digest({"a": other})
    assert digest != content_digest({"a": array[:, None]})
    assert digest != content_digest({"b": array})


def test_digest_of_a_large_dataset_is_computed_in_bounded_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(splits_format, "_BLOCK", 1 << 16)
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file.create_dataset("a", data=np.zeros((1 << 20, 4), "f4"))  # 16 MiB
        tracemalloc.start()
        content_digest(file)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 1 << 20


def test_the_same_content_gives_the_same_digest(tiny_split, tmp_path):
    again = make_split(tmp_path / "again")
    assert load_split(again).digest == load_split(tiny_split).digest
    other = make_split(tmp_path / "other", seed_base=8)
    assert load_split(other).digest != load_split(tiny_split).digest


def test_verify_lists_every_group_with_what_was_expected_and_found(copy):
    with h5py.File(copy / "hopper.h5", "r+") as file:
        file[TWINS]["rewards"][0] += 1
    checks = list(load_split(copy).verify())
    assert len(checks) == 2 * (11 + 1)
    bad = [c for c in checks if not c.ok]
    assert [(c.file, c.group) for c in bad] == [("hopper.h5", TWINS)]
    assert bad[0].expected != bad[0].actual


def test_a_changed_name_is_noticed_in_file_and_manifest(copy):
    with h5py.File(copy / "hopper.h5", "r+") as file:
        names = file["names/sensors"]
        names[0] = names[0].replace(b"torso", b"other")
    with pytest.raises(DigestError, match=r"hopper\.h5, group names: .*expected \w{64}, found"):
        load_split(copy).environment("hopper")
    digest = json.loads((copy / "manifest.json").read_text())["digest"]

    def rename(manifest):
        manifest["environments"]["cartpole"]["sensors"][0]["unit"] = "km"

    edit_manifest(copy, rename)
    with pytest.raises(SplitError, match=f"names the digest {digest}, .*: it was edited"):
        _ = load_split(copy).digest


@pytest.mark.parametrize("kind", ["sensors", "actions"])
def test_a_file_without_names_or_with_too_few_is_refused(copy, kind):
    with h5py.File(copy / "hopper.h5", "r+") as file:
        names = file[f"names/{kind}"][:]
        del file[f"names/{kind}"]
    with pytest.raises(SplitError, match=rf"hopper\.h5 lacks the names of its {kind}"):
        load_split(copy).environment("hopper")
    with h5py.File(copy / "hopper.h5", "r+") as file:
        file[f"names/{kind}"] = names[1:]
    few = len(names) - 1
    with pytest.raises(SplitError, match=rf"group train: .* expected {few} columns, since names"):
        load_split(copy).environment("hopper")


def test_writing_refuses_names_that_do_not_fit_the_columns(tmp_path):
    info = ENVIRONMENTS["cartpole"]
    groups = {"train": make_group("cartpole", range(2), 60)}
    with pytest.raises(SplitError, match=r"observations have shape \(123, 4\), expected 3 columns"):
        write_environment(tmp_path / "x.h5", groups.items(), "",
                          sensors=info.sensors[1:], actions=info.actions)  # fmt: skip
    assert not list(tmp_path.iterdir())


# Names


def test_a_built_split_is_found_by_name(data_home):
    make_split(data_home / "tiny")
    assert load_split("tiny").environments == ("cartpole", "hopper")


def test_a_directory_here_is_found_by_its_bare_name(data_home, tmp_path, monkeypatch):
    make_split(tmp_path / "work" / "mine", name="mine")
    monkeypatch.chdir(tmp_path / "work")
    assert load_split("mine").digest == load_split(tmp_path / "work" / "mine").digest
    make_split(data_home / "mine", name="mine", seed_base=8)
    assert load_split("mine").path.absolute() == tmp_path / "work" / "mine"


@pytest.mark.parametrize(
    "command", ["data info", "data verify", "run --detector clock --env cartpole -k iid --split"]
)
def test_every_command_finds_a_directory_by_its_bare_name(tmp_path, monkeypatch, capsys, command):
    make_split(tmp_path / "mine", name="mine")
    monkeypatch.chdir(tmp_path)
    assert main([*command.split(), "mine"]) == 0
    assert load_split("mine").digest[:12] in capsys.readouterr().out


def test_an_unknown_split_names_its_neighbour(data_home):
    make_split(data_home / "tiny")
    with pytest.raises(UnknownNameError, match=r"unknown split 'tinny': did you mean 'tiny'\?"):
        load_split("tinny")
    with pytest.raises(UnknownNameError, match=r"did you mean 'standard'\?"):
        load_split("standart")


def test_a_published_split_that_is_not_here_names_the_command(data_home):
    with pytest.raises(SplitNotFoundError, match=r"`oodd-eval data build standard`"):
        load_split("standard")


def test_a_directory_without_manifest_is_no_split(tmp_path):
    with pytest.raises(SplitNotFoundError, match=r"is no split: it has no manifest\.json"):
        load_split(tmp_path)


def test_a_rebuilt_published_split_is_labelled_as_another(data_home, tmp_path, monkeypatch):
    rebuilt = load_split(make_split(tmp_path / "standard", name="standard"))
    assert rebuilt.name == f"standard@{rebuilt.digest[:8]}"
    monkeypatch.setattr(splits, "published_digests", lambda: {"standard": rebuilt.digest})
    assert rebuilt.name == "standard"


def test_unknown_environment_and_anomaly_are_named(tiny_split):
    split = load_split(tiny_split)
    with pytest.raises(UnknownNameError, match="did you mean 'hopper'"):
        split.environment("hoper")
    with pytest.raises(UnknownNameError, match=r"of hopper\.h5 'idd': did you mean 'iid'"):
        split.environment("hopper").anomalous("idd")


# Damage


def test_an_edited_value_names_file_group_and_both_digests(copy):
    expected = load_split(copy).manifest["environments"]["hopper"]["groups"]["test/iid"]["sha256"]
    with h5py.File(copy / "hopper.h5", "r+") as file:
        file["test/iid"]["redraws"][0] += 1
        found = content_digest(file["test/iid"])
    with pytest.raises(DigestError) as error:
        load_split(copy).environment("hopper")
    for part in ("hopper.h5", "group test/iid", f"expected {expected}", f"found {found}"):
        assert part in str(error.value)
    load_split(copy).environment("cartpole")


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_a_truncated_file_says_so(copy, share):
    file = copy / "hopper.h5"
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    with pytest.raises(SplitError, match=r"hopper\.h5.*build or fetch it again"):
        load_split(copy).environment("hopper")


def test_a_missing_file_is_named(copy):
    (copy / "hopper.h5").unlink()
    with pytest.raises(SplitNotFoundError, match=r"hopper\.h5 is missing"):
        load_split(copy).environment("hopper")


def test_a_part_that_the_manifest_does_not_name_is_refused(copy):
    """Its content has no digest to be compared with."""

    def forget(manifest):
        del manifest["environments"]["hopper"]["groups"]["test/iid"]
        digest = splits_format.split_digest(manifest["environments"], manifest["definition"])
        manifest["digest"] = digest

    edit_manifest(copy, forget)
    for read in (lambda s: s.environment("hopper"), lambda s: list(s.verify())):
        with pytest.raises(SplitError, match=r"hopper.h5 holds the groups .*test/iid.*, expected"):
            read(load_split(copy))


def test_a_missing_group_and_a_missing_dataset_are_named(copy):
    with h5py.File(copy / "hopper.h5", "r+") as file:
        del file["train"]["seeds"]
        del file["test/iid"]
    with pytest.raises(SplitError, match=r"group train lacks the dataset 'seeds'"):
        load_split(copy).environment("hopper")
    with h5py.File(copy / "hopper.h5", "r+") as file:
        del file["train"]
    with pytest.raises(SplitError, match=r"hopper\.h5 lacks the group train"):
        load_split(copy).environment("hopper")


def replaced(dataset, change):
    def in_group(group):
        array = change(group[dataset][:])
        del group[dataset]
        group[dataset] = array

    return in_group


@pytest.mark.parametrize(
    ("part", "change", "message"),
    [
        ("test/iid", replaced("parameters", lambda _: np.array(["{}"] * 2, dtype=object)),
         r"parameters has dtype \|O, expected \|S"),
        ("train", replaced("rewards", lambda a: a.astype("<f8")),
         "rewards has dtype <f8, expected <f4"),
        ("train", replaced("actions", lambda a: a[:-1]),
         "actions has 120 rows, expected 121 for 2 trajectories"),
        ("train", replaced("offsets", lambda a: a * [1, 0, 1]),
         "rise by at least 1 per trajectory"),
        ("test/iid", replaced("effects", lambda a: a - 1),
         r"trajectory 0 has its onset at row (\d+) and its effect at row \d+, expected"),
        ("test/iid", replaced("effects", lambda a: a + np.array([0, 40])),
         r"trajectory 1 has its onset .* expected 0 <= onset <= effect <= 61, the last row"),
    ],
    ids=["objects", "dtype", "rows", "offsets", "effect-before-onset", "effect-behind-the-end"],
)  # fmt: skip
def test_another_layout_is_refused(tmp_path, part, change, message):
    anomaly = part.removeprefix("test/") if part != "train" else None
    with h5py.File(tmp_path / "x.h5", "w") as file:
        group = file.create_group(part)
        for dataset, array in make_group("cartpole", [1, 2], 60, anomaly).items():
            group[dataset] = array.astype("<f4") if array.dtype == np.float64 else array
        check_layout("x.h5", part, group)
        change(group)
        with pytest.raises(SplitError, match=message):
            check_layout("x.h5", part, group)


def test_an_edited_manifest_is_noticed(copy):
    def change(manifest):
        manifest["environments"]["hopper"]["groups"]["train"]["sha256"] = "0" * 64

    edit_manifest(copy, change)
    with pytest.raises(SplitError, match=r"names the digest .* it was edited"):
        _ = load_split(copy).digest


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.update(schema="2"), "schema: .*, got '2'"),
        (lambda m: m["environments"]["hopper"].pop("sensors"), "hopper.sensors: Field required"),
        (
            lambda m: m["environments"]["hopper"]["actions"][0].update(unit=1),
            "hopper.actions.0.unit: .*, got 1",
        ),
        (lambda m: m.pop("definition"), "definition: Field required"),
        (lambda m: m["environments"]["hopper"].pop("groups"), "hopper.groups: Field required"),
        (lambda m: m.update(environments=[]), r"environments: .*, got \[\]"),
        (lambda m: m.update(definition=None), "definition: .*, got None"),
        (lambda m: m.update(name=3), "name: .*, got 3"),
        (
            lambda m: m["environments"]["hopper"]["groups"]["train"].update(transitions=10**12),
            "hopper.groups.train.transitions: .*10000000000, got 1000000000000",
        ),
    ],
)
def test_a_damaged_manifest_says_what_is_wrong(copy, change, message):
    edit_manifest(copy, change)
    with pytest.raises(SplitError, match=message):
        _ = load_split(copy).digest


def test_a_split_of_another_layout_says_what_to_do(copy):
    edit_manifest(copy, lambda m: m.update(schema=1))
    with pytest.raises(SplitError, match=r"schema 1, expected 2: .*; remove it, then build or"):
        _ = load_split(copy).digest


def test_a_manifest_that_is_no_json_is_refused(copy):
    (copy / "manifest.json").write_text("{")
    with pytest.raises(SplitError, match="is not a split's manifest"):
        _ = load_split(copy).name


def test_a_manifest_cannot_point_outside_of_its_directory(copy):
    edit_manifest(copy, lambda m: m["environments"]["hopper"].update(file="../hopper.h5"))
    with pytest.raises(SplitError, match="file outside of the split"):
        load_split(copy).environment("hopper")
