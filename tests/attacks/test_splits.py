"""Splits of strangers: what is in a file is bounded, stays as it was verified, and is told.

Each attack edits a copy of a split and makes all digests fit again, as somebody would who wants to
deceive. It is held when an error of the project names what is wrong; a traceback, gigabytes or a
hang are not.
"""

import json
import os
import re
import resource
import shutil
import subprocess
import sys
import zlib
from contextlib import closing
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers_split import make_group, make_split

from oodd_eval import load_split
from oodd_eval.cli.main import main
from oodd_eval.data import layout
from oodd_eval.data.bounded import EPISODE
from oodd_eval.data.stored import StoredFile
from oodd_eval.errors import DigestError, SplitError, TrajectoryError

PART = "test/iid"


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Directory of a split with one environment; not to be written to."""
    place = tmp_path_factory.mktemp("attacked") / "tiny"
    return make_split(place, ("cartpole",), train=2, calibration=2, test=2)


@pytest.fixture
def copy(small, tmp_path):
    return shutil.copytree(small, tmp_path / "tiny")


def sign(directory, change=lambda _manifest: None, *, content=True):
    """Make the manifest fit the file, after a change of its own."""
    file = directory / "manifest.json"
    manifest = json.loads(file.read_text())
    entry = manifest["environments"]["cartpole"]
    if content:
        with h5py.File(directory / "cartpole.h5") as stored:
            for group, said in entry["groups"].items():
                part = stored[group]
                said["sha256"] = layout.content_digest(part)
                said["trajectories"] = len(part["seeds"])
                said["transitions"] = int(part["offsets"][-1])
    change(manifest)
    manifest["digest"] = layout.split_digest(manifest["environments"], manifest["definition"])
    file.write_text(json.dumps(manifest))


def opened(directory):
    """Open the split as a run does, and read every row."""
    with closing(load_split(directory).environment("cartpole")) as data:
        for part in (
            data.train,
            data.calibration,
            data.twins,
            *map(data.anomalous, data.anomalies),
        ):
            list(part)
            assert len(part.returns) == len(part)


def replaced(name, change, part=PART):
    def attack(file):
        group = file[part]
        array = change(group[name][:])
        del group[name]
        group[name] = array

    return attack


def test_the_copy_that_is_attacked_is_sound(copy):
    sign(copy)
    opened(copy)


# Labels


def all_to(name, value):
    return replaced(name, lambda a: np.full_like(a, value))


def both_to(value):
    def attack(file):
        for name in ("onsets", "effects"):
            all_to(name, value)(file)

    return attack


def fewer(file):
    """Take one anomalous episode away."""
    group = file[PART]
    for name, array in make_group("cartpole", [9_600_000], 60, "iid").items():
        del group[name]
        group[name] = array.astype("<f4") if array.dtype == np.float64 else array


def changed_at(row, name="observations", part=PART, value=1e-7):
    """Change a row of the first episode by as little as there is."""

    def attack(file):
        file[part][name][row] += np.float32(value)

    return attack


def negative_zero(file):
    """Give twin and episode zeros that are equal, but not bit for bit."""
    file["test/nominal/observations"][3, 1] = 0.0
    for test in file["test"].values():
        test["observations"][3, 1] = 0.0
    file[PART]["observations"][3, 1] = -0.0


LABELS = {
    "onsets below 0": (all_to("onsets", -1), "expected 0 <= onset <= effect"),
    "onsets past the end": (both_to(1000), "expected 0 <= onset <= effect <= 60"),
    "effects before the onsets": (all_to("effects", 1), "expected 0 <= onset <= effect"),
    "all onsets and effects 0": (both_to(0), "onset at row 0, expected 30 or a later row"),
    "onsets too early": (both_to(30), "first differs from its twin at row"),
    "onsets too late": (both_to(59), "differ from its twin's before its onset"),
    "effects too late": (all_to("effects", 60), "first differs from its twin at row"),
    "an episode without twin": (fewer, "has 1 trajectories, expected 2, one for each twin"),
    "seeds of other twins": (all_to("seeds", 7), "trajectory 0 has the seed 7, its twin"),
    "an episode unlike its twin": (changed_at(5), "observations of trajectory 0 differ from its"),
    "an action unlike the twin's": (changed_at(5, "actions"), "actions of trajectory 0 differ"),
    "a twin unlike its episodes": (changed_at(0, part="test/nominal"), "differ from its twin's"),
    "a zero of another sign": (negative_zero, "differ from its twin's before its onset"),
}  # fmt: skip


@pytest.mark.parametrize("attack", LABELS)
def test_labels_that_cannot_be_are_refused(copy, attack, capsys):
    change, message = LABELS[attack]
    with h5py.File(copy / "cartpole.h5", "r+") as file:
        change(file)
    sign(copy)
    with pytest.raises(SplitError, match=message):
        opened(copy)
    command = ["run", "--detector", "clock", "--env", "cartpole", "--anomaly", "iid"]
    assert main([*command, "--split", str(copy), "--output", str(copy / "out")]) == 4
    assert "cartpole.h5" in capsys.readouterr().err


# HDF5


def raw(dtype="<f4", shape=(1, 4), **plan):
    """Put a dataset with some creation properties in place of the observations of training."""

    def attack(file):
        del file["train/observations"]
        file["train"].create_dataset("observations", shape, dtype, **plan)

    return attack


def group_for_dataset(file):
    del file["train/offsets"]
    file["train"].create_group("offsets")


def dataset_for_group(file):
    del file["train"]
    file["train"] = np.zeros(3)


def linked(link, name="train/observations"):
    def attack(file):
        del file[name]
        file[name] = link

    return attack


def external(file):
    del file["train/rewards"]
    size = Path("/etc/passwd").stat().st_size
    file["train"].create_dataset("rewards", (1,), "<f4", external=[("/etc/passwd", 0, size)])


def offsets_of(*numbers):
    return replaced("offsets", lambda _: np.array(numbers, "<i8"), "train")


def bomb(file):
    """Let one chunk unpack to 670 megabytes, many times what it may have."""
    del file["train/observations"]
    rows = file["train"].create_dataset(
        "observations", (1000, 4), "<f4", chunks=(1000, 4), compression="gzip"
    )
    packer = zlib.compressobj(1)
    content = b"".join(packer.compress(bytes(2**24)) for _ in range(40)) + packer.flush()
    rows.id.write_direct_chunk((0, 0), content)


def pile(file):
    """Hold labels of 144 megabytes in little room."""
    del file[PART]["parameters"]
    file[PART].create_dataset(
        "parameters", data=np.zeros(2_400, "S60000"), chunks=(100,), compression=1
    )


def object_texts(file):
    del file[PART]["parameters"]
    file[PART].create_dataset("parameters", data=["{}", "{}"], dtype=h5py.string_dtype())


def loop(file):
    del file["test/gravity"]
    file["test/gravity"] = file["test"]


def committed_type(file):
    del file["train/seeds"]
    file["train/seeds"] = np.dtype("<i8")


HDF5 = {
    "a group for a dataset": (group_for_dataset, "holds 'offsets', expected an array"),
    "a dataset for a group": (dataset_for_group, "holds 'train', expected groups"),
    "a type for a dataset": (committed_type, "holds 'seeds', expected an array"),
    "a soft link": (linked(h5py.SoftLink("/train/actions")), "points elsewhere: refused"),
    "an external link": (linked(h5py.ExternalLink("/etc/passwd", "/")), "points elsewhere"),
    "external content": (external, "keeps its content in another file"),
    "a group in itself": (loop, "cannot be read|holds|lacks"),
    "a part without digest": (lambda f: f.create_group("test/none"), "holds the groups .*none"),
    "a dataset nobody knows": (lambda f: f["train"].create_dataset("x", data=[3]), "holds 'x'"),
    "no room for what it has": (raw(shape=(10**10, 4), chunks=(10**4, 4)), "made to fill"),
    "chunks of gigabytes": (raw(shape=(10**9, 4), chunks=(10**8, 4)), "has chunks of 1600000000"),
    "a string of a gigabyte": (
        lambda f: (f[PART].__delitem__("parameters"),
                   f[PART].create_dataset("parameters", (1,), "S1000000000")),
        "1000000000 bytes"),
    "a chunk that unpacks to 670 megabytes": (bomb, "unpacks to more than 16000 bytes"),
    "labels of 144 megabytes": (pile, "limit 134217728"),
    "another filter": (raw(shape=(8, 4), chunks=(8, 4), compression="lzf"), "packed by the filter"),
    "texts without bound": (object_texts, "dtype \\|O, expected \\|S"),
    "a compound": (raw([("x", "<f4")], (3, 4)), "dtype|holds|bytes"),
    "another dtype": (replaced("rewards", lambda a: a.astype("<f8"), "train"), "expected <f4"),
    "too few rows": (replaced("actions", lambda a: a[:-1], "train"), "rows, expected 121"),
    "too few names": (replaced("sensors", lambda a: a[1:], "names"), "expected 3 columns"),
    "offsets from below 0": (offsets_of(-3, 60, 121), "offsets must start at 0"),
    "offsets that overflow": (offsets_of(0, 2**62, -(2**63), -(2**62), 121), "offsets must start"),
}  # fmt: skip


def limited():
    resource.setrlimit(resource.RLIMIT_AS, (6 * 10**8, 6 * 10**8))


OPEN_ALL = """
import sys, pathlib
from oodd_eval import load_split
from oodd_eval.errors import DigestError, SplitError, TrajectoryError
for place in sorted(pathlib.Path(sys.argv[1]).iterdir()):
    try:
        load_split(place).environment("cartpole").close()
    except SplitError as error:
        print(place.name, "refused", error, sep="|")
    else:
        print(place.name, "opened", sep="|")
"""


@pytest.fixture(scope="module")
def told(small, tmp_path_factory):
    """What is said of each attacked file, by a process that may have 600 MB."""
    home = tmp_path_factory.mktemp("hdf5")
    for number, (attack, _) in enumerate(HDF5.values()):
        shutil.copytree(small, home / str(number))
        with h5py.File(home / str(number) / "cartpole.h5", "r+") as file:
            attack(file)
    done = subprocess.run(
        [sys.executable, "-c", OPEN_ALL, str(home)], capture_output=True, text=True, check=False,
        preexec_fn=limited, timeout=60, env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    said = (line.split("|", 2) for line in done.stdout.splitlines())
    return done.stderr, {number: rest for number, *rest in said}


@pytest.mark.parametrize("attack", HDF5)
def test_a_file_that_is_no_split_is_refused_in_little_memory(told, attack):
    stderr, found = told
    number, message = str([*HDF5].index(attack)), HDF5[attack][1]
    assert number in found, stderr[-1000:]
    assert found[number][0] == "refused"
    assert "cartpole.h5" in found[number][1]
    assert re.search(message, found[number][1]), found[number]


IN_LOGS = (
    "external content", "an external link", "no room for what it has", "chunks of gigabytes",
    "a chunk that unpacks to 670 megabytes", "another filter", "a group for a dataset",
)  # fmt: skip


@pytest.mark.parametrize("attack", IN_LOGS)
def test_logs_are_read_within_the_same_bounds(copy, attack):
    with h5py.File(copy / "cartpole.h5", "r+") as file:
        HDF5[attack][0](file)
    with closing(StoredFile(copy / "cartpole.h5", EPISODE)) as file, pytest.raises(TrajectoryError):
        file.part("train", ("observations", "actions", "rewards", "onset", "offsets"))


def test_a_pipe_is_no_file(copy):
    (copy / "cartpole.h5").unlink()
    os.mkfifo(copy / "cartpole.h5")
    with pytest.raises(SplitError, match="is no plain file"):
        opened(copy)


def test_a_link_to_a_file_elsewhere_is_refused(copy, tmp_path):
    (copy / "cartpole.h5").rename(tmp_path / "elsewhere.h5")
    (copy / "cartpole.h5").symlink_to(tmp_path / "elsewhere.h5")
    with pytest.raises(SplitError, match="is a link to another file"):
        opened(copy)


def test_parameters_that_are_no_json_are_told(copy):
    with h5py.File(copy / "cartpole.h5", "r+") as file:
        replaced("parameters", lambda a: np.array([b"[" * 60_000, b"1"]))(file)
    sign(copy)
    message = r"parameters of trajectory 0 are .*expected a JSON"
    with (
        closing(load_split(copy).environment("cartpole")) as data,
        pytest.raises(SplitError, match=message),
    ):
        _ = data.anomalous("iid").parameters


# Changed after it was verified


def write_over(file):
    file.write_bytes(file.read_bytes()[:-64] + bytes(64))


def write_over_in_silence(file):
    """Put the time of the last change back."""
    before = file.stat()
    write_over(file)
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))


def cut(file):
    os.truncate(file, 1000)


@pytest.fixture
def verified(copy, monkeypatch):
    """An open environment of a copy whose parts are read when asked for."""
    monkeypatch.setattr("oodd_eval.data.parts._KEPT", 0)
    monkeypatch.setenv("HDF5_USE_FILE_LOCKING", "FALSE")
    with closing(load_split(copy).environment("cartpole")) as data:
        yield data, copy / "cartpole.h5"


@pytest.mark.parametrize("change", [write_over, write_over_in_silence, cut])
@pytest.mark.parametrize("read", [
    lambda data: data.anomalous("iid")[0], lambda data: data.train.returns,
    lambda data: data.anomalous("iid").rewards(0), lambda data: data.arrays("train"),
])  # fmt: skip
def test_rows_that_were_changed_are_not_scored(verified, change, read):
    data, file = verified
    read(data)
    change(file)
    with pytest.raises(DigestError, match=r"cartpole\.h5 was changed while it was in use"):
        read(data)


@pytest.mark.parametrize("change", [write_over, cut])
def test_labels_are_those_that_were_verified(verified, change):
    data, file = verified
    names = ("onsets", "effects", "redraws", "seeds", "lengths", "terminated")
    expected = {name: getattr(data.anomalous("iid"), name).copy() for name in names}
    change(file)
    for name, values in expected.items():
        assert (getattr(data.anomalous("iid"), name) == values).all()


def test_a_file_that_is_replaced_or_removed_stays_readable(verified):
    data, file = verified
    expected = [x.observations for x in data.train]
    shutil.copy(file, file.with_name("other"))
    file.with_name("other").replace(file)
    assert all((x.observations == y).all() for x, y in zip(data.train, expected, strict=True))
    file.unlink()
    assert len(data.train.returns) == 2


# Manifests


def nested(manifest):
    for _ in range(150):
        manifest["definition"] = {"x": manifest["definition"]}


def edited(*keys, value):
    """Set a value deep in the manifest."""

    def change(manifest):
        for key in keys[:-1]:
            manifest = manifest[key]
        manifest[keys[-1]] = value

    return change


ENTRY = ("environments", "cartpole")
MANIFESTS = {
    "no twins": (lambda m: m["environments"]["cartpole"]["groups"].pop("test/nominal"),
                 "has no group 'test/nominal' of cartpole"),
    "no training": (lambda m: m["environments"]["cartpole"]["groups"].pop("train"),
                    "has no group 'train'"),
    "other sizes": (edited(*ENTRY, "groups", "train", "trajectories", value=3),
                    "train has 2 trajectories with 121 transitions, expected 3 with 121"),
    "sizes without end": (edited(*ENTRY, "groups", "train", "transitions", value=10**400), "tran"),
    "sizes below 0": (edited(*ENTRY, "groups", "train", "transitions", value=-1), "transitions"),
    "a name that steers a terminal": (edited("name", value="\x1b[2J"), "name: String should match"),
    "a sensor that steers a terminal": (edited(*ENTRY, "sensors", 0, "name", value="\x1b]0;x\x07"),
                                        "sensors.0.name: String should match"),
    "a path": (edited(*ENTRY, "file", value="/etc/passwd"), "file outside of the split"),
    "no file name": (edited(*ENTRY, "file", value=""), "outside|is missing"),
}  # fmt: skip


@pytest.mark.parametrize("attack", MANIFESTS)
def test_a_manifest_that_cannot_be_is_refused(copy, attack):
    change, message = MANIFESTS[attack]
    sign(copy, change, content=False)
    with pytest.raises(SplitError, match=message):
        opened(copy)


def defined(more):
    """Put something in front of the definition."""
    return lambda text: text.replace('"definition": {', f'"definition": {{"x": {more}, ', 1)


TEXTS = {
    "deeply nested": defined("[" * 10**5 + "]" * 10**5),
    "nested": defined("[" * 180 + "]" * 180),
    "half a character": defined('"\\ud800"'),
    "a number of many digits": defined("9" * 9000),
    "too long": lambda text: text + " " * 10**7,
    "a byte order mark": lambda text: "\ufeff" + text,
    "a zero byte": lambda text: text.replace("tiny", "ti\\u0000ny"),
}


@pytest.mark.parametrize("attack", TEXTS)
def test_a_text_that_is_no_manifest_is_refused(copy, attack, capsys):
    file = copy / "manifest.json"
    file.write_text(TEXTS[attack](file.read_text()))
    assert main(["data", "verify", str(copy)]) == 4
    said = capsys.readouterr().err
    assert "manifest.json" in said
    assert len(said) < 2000
