"""Opening a split: what is read back, what is verified, and what each kind of damage says."""

import hashlib
import json
import shutil

import h5py
import numpy as np
import pytest
from helpers_split import make_group, make_split
from hypothesis import given
from hypothesis import strategies as st

from oodd_eval.data import layout as splits_format
from oodd_eval.data import parts
from oodd_eval.data import split as splits
from oodd_eval.data.facts import ENVIRONMENTS, TABLE1
from oodd_eval.data.layout import content_digest, write_environment
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
    data = load_split(tiny_split).environment("cartpole")
    assert [len(p) for p in (data.train, data.calibration, data.twins)] == [6, 4, 3]
    assert data.twins.lengths.tolist() == [60, 61, 62]
    assert data.twins.returns.tolist() == [60.0, 61.0, 62.0]
    assert data.anomalous("iid").returns.tolist() == [30.0, 30.5, 31.0]
    assert data.twins.terminated.tolist() == [False] * 3
    assert data.anomalies == TABLE1
    with pytest.raises(UnknownNameError, match="did you mean 'hopper'"):
        load_split(tiny_split).environment("hoper")
    with pytest.raises(UnknownNameError, match=r"of cartpole 'idd': did you mean 'iid'"):
        data.anomalous("idd")


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


def test_the_same_content_gives_the_same_digest(tiny_split, tmp_path):
    again = make_split(tmp_path / "again")
    assert load_split(again).digest == load_split(tiny_split).digest
    other = make_split(tmp_path / "other", seed_base=8)
    assert load_split(other).digest != load_split(tiny_split).digest


def test_an_edited_value_names_file_group_and_both_digests(copy):
    expected = load_split(copy).manifest["environments"]["hopper"]["groups"]["test/iid"]["sha256"]
    with h5py.File(copy / "hopper.h5", "r+") as file:
        file["test/iid"]["redraws"][0] += 1
        actual = content_digest(file["test/iid"])
    checks = list(load_split(copy).verify())
    assert len(checks) == 2 * (11 + 1)
    bad = [(c.file, c.group, c.expected, c.actual) for c in checks if not c.ok]
    assert bad == [("hopper.h5", "test/iid", expected, actual)]
    with pytest.raises(DigestError) as error:
        load_split(copy).environment("hopper")
    assert all(part in str(error.value) for part in bad[0])
    load_split(copy).environment("cartpole")


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


def test_writing_refuses_names_that_do_not_fit_the_columns(tmp_path):
    info = ENVIRONMENTS["cartpole"]
    groups = {"train": make_group("cartpole", range(2), 60)}
    with pytest.raises(SplitError, match=r"observations have shape \(123, 4\), expected 3 columns"):
        write_environment(tmp_path / "x.h5", groups.items(), "",
                          sensors=info.sensors[1:], actions=info.actions)  # fmt: skip
    assert not list(tmp_path.iterdir())


# Names


def test_a_directory_here_is_found_by_its_bare_name(data_home, tmp_path, monkeypatch):
    make_split(tmp_path / "work" / "mine", name="mine")
    monkeypatch.chdir(tmp_path / "work")
    assert load_split("mine").digest == load_split(tmp_path / "work" / "mine").digest
    make_split(data_home / "mine", name="mine", seed_base=8)
    assert load_split("mine").path.absolute() == tmp_path / "work" / "mine"


def test_a_name_without_a_split_says_what_to_do(data_home, tmp_path):
    make_split(data_home / "tiny")
    for name, error, message in [
        ("tinny", UnknownNameError, "did you mean 'tiny'"),
        ("standart", UnknownNameError, "did you mean 'standard'"),
        ("standard", SplitNotFoundError, "`oodd-eval data build standard`"),
        (tmp_path, SplitNotFoundError, "has no manifest"),
    ]:
        with pytest.raises(error, match=message):
            load_split(name)


def test_a_rebuilt_published_split_is_labelled_as_another(data_home, tmp_path, monkeypatch):
    rebuilt = load_split(make_split(tmp_path / "standard", name="standard"))
    assert rebuilt.name == f"standard@{rebuilt.digest[:8]}"
    monkeypatch.setattr(splits, "published_digests", lambda: {"standard": rebuilt.digest})
    assert rebuilt.name == "standard"


# Damage


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99])
def test_a_truncated_file_says_so(copy, share):
    file = copy / "hopper.h5"
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    with pytest.raises(SplitError, match=r"hopper\.h5.*build or fetch it again"):
        load_split(copy).environment("hopper")


@pytest.mark.parametrize(
    "gone", ["train", "train/seeds", "test/iid", "names/sensors", "names/actions"]
)
def test_what_a_file_lacks_is_named(copy, gone):
    with h5py.File(copy / "hopper.h5", "r+") as file:
        del file[gone]
    with pytest.raises(SplitError, match=r"hopper\.h5.* lacks "):
        load_split(copy).environment("hopper")
    (copy / "hopper.h5").unlink()
    with pytest.raises(SplitNotFoundError, match=r"hopper\.h5 is missing"):
        load_split(copy).environment("hopper")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.update(schema=1), "schema 1, expected 2"),
        (lambda m: m["environments"]["hopper"]["actions"][0].update(unit=1), "actions.0.unit"),
        (lambda m: m.update(definition=None), "definition"),
        (lambda m: m["environments"]["hopper"].update(digest="0"), "it was edited"),
    ],
)  # fmt: skip
def test_a_damaged_manifest_says_what_is_wrong(copy, change, message):
    edit_manifest(copy, change)
    if message == "it was edited":
        edit_manifest(copy, lambda m: m["definition"].update(train=7))
    with pytest.raises(SplitError, match=message):
        _ = load_split(copy).digest
