"""Splits of strangers: what is in a file is bounded, stays as it was verified, and is told.

Each attack edits a copy of a split and makes all digests fit again, as somebody would who wants to
deceive. It is held when an error of the project names what is wrong; a traceback, gigabytes or a
hang are not.
"""

import json
import shutil
from contextlib import closing

import h5py
import numpy as np
import pytest
from helpers_split import make_group, make_split

from oodd_eval import load_split
from oodd_eval.cli.main import main
from oodd_eval.data import layout
from oodd_eval.errors import SplitError

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
    "onsets at the least number": (all_to("onsets", -(2**63)), "expected 0 <= onset <= effect"),
    "onsets past the end": (both_to(1000), "expected 0 <= onset <= effect <= 60"),
    "effects past the end": (all_to("effects", 2**62), "expected 0 <= onset <= effect <= 60"),
    "effects before the onsets": (all_to("effects", 1), "expected 0 <= onset <= effect"),
    "all onsets 0": (all_to("onsets", 0), "onset at row 0, expected 30 or a later row"),
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
