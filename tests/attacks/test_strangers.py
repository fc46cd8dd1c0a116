"""Packages of strangers: what lies in their directory is nobody's but the sandbox's."""

import os
import shutil
import sys

import pytest
from helpers_boxed import boxed_plugins, boxed_run
from helpers_plugins import write_plugin
from oodd_leaderboard.sandbox.metadata import MOST_DISTRIBUTIONS, check_packages

from oodd_eval.errors import PluginError

pytestmark = pytest.mark.skipif(not shutil.which("bwrap"), reason="needs bubblewrap")

SHADOWS = ("secrets", "json", "numpy", "oodd_eval", "psutil", "sitecustomize", "usercustomize")
RUNS = """
import glob, json, secrets, numpy, oodd_eval, psutil
import oodd_helper
mine = [n for n, m in sys.modules.items()
        if (getattr(m, "__file__", None) or "").startswith("/packages/")]
assert sorted(mine) == ["oodd_helper", "oodd_odd"], mine
assert sys.path[-1] == "/packages/0" and "PYTHONPATH" not in os.environ and sys.flags.safe_path
assert glob.glob("/packages/*") == ["/packages/0"]

@hookimpl
def oodd_detectors(): return offer(odd=Good, rf=Good)
"""


@pytest.fixture
def packages(tmp_path):
    """A directory of packages with whatever could run by itself, or in place of others."""
    directory = tmp_path / "packages" / "odd"
    write_plugin(directory, "odd", RUNS)
    (directory / "oodd_helper.py").write_text("")
    touch = (
        f"import pathlib; pathlib.Path({str(tmp_path / 'ran')!r}).touch()\nraise SystemExit(9)\n"
    )
    for name in SHADOWS:
        (directory / f"{name}.py").write_text(touch)
    (directory / "runs.pth").write_text("import oodd_odd, secrets\n")
    return directory


def test_what_lies_there_neither_runs_nor_wins(packages, tiny_split, tmp_path, monkeypatch):
    # The command's own path counts for nothing in a worker.
    write_plugin(tmp_path / "own", "own", "")
    monkeypatch.syspath_prepend(str(tmp_path / "own"))
    path = list(sys.path)
    records = boxed_run(packages, tiny_split, tmp_path / "out", ["odd", "rf"], anomalies=["iid"])
    assert [(r.status, r.reason) for r in records] == [("ok", "")] * 2
    assert {r.plugin for r in records} == {"oodd-odd:odd"}
    assert not (tmp_path / "ran").exists()
    assert sys.path == path
    assert not {"oodd_odd", "oodd_helper", *SHADOWS[-2:]} & {*sys.modules} - {"sitecustomize"}


def test_the_packages_of_another_entry_are_not_seen(packages, tmp_path):
    other = packages.with_name("other")
    write_plugin(other, "other", f"assert not os.path.exists({str(packages)!r})\n"
                 "assert not glob.glob('/packages/1')\n", header="import glob, os\n")  # fmt: skip
    plugins, _ = boxed_plugins(other)
    assert not plugins.offers
    assert not plugins.broken
    assert plugins.names == {"other"}


def test_keys_change_with_any_file_of_the_packages(packages, tiny_split, tmp_path):
    sources = set()
    for number in range(2):
        directory = shutil.copytree(packages, tmp_path / str(number))
        (directory / "oodd_helper.py").write_text(f"x = {number}")
        (record, *_) = boxed_run(
            directory, tiny_split, tmp_path / "out", ["odd"], anomalies=["iid"]
        )
        sources.add((record.plugin_source, record.scores))
    assert len(sources) == 2
    assert len({scores for _, scores in sources}) == 2


SOUND = "Metadata-Version: 2.1\nName: oodd-odd\nVersion: 1.0\n"
FILES = {
    "no metadata": {"METADATA": None},
    "no name": {"METADATA": "Version: 1\n"},
    "steering": {"METADATA": "Name: x\x1b[2J\nVersion: 1\n"},
    "a path": {"METADATA": "Name: ../../x\nVersion: 1\n"},
    "the plug-in of another": {"METADATA": "Name: oodd:rf\nVersion: 1\n"},
    "no UTF-8": {"METADATA": b"Name: \xff\xfe\nVersion: 1\n"},
    "huge": {"METADATA": SOUND + "X: y\n" * 10**6},
    "a pipe": {"entry_points.txt": os.mkfifo},
    "a device": {"METADATA": lambda path: path.symlink_to("/dev/zero")},
    "garbled points": {"entry_points.txt": "[oodd_eval]\na = :: ) (\n"},
    "a point's long name": {"entry_points.txt": f"[oodd_eval]\n{'a' * 999} = oodd_odd\n"},
    "a point's odd name": {"entry_points.txt": "[oodd_eval]\n../../x = oodd_odd\n"},
    "no points": {"entry_points.txt": "[oodd_eval]\n"},
}
TAKEN = ("oodd-eval", "OODD_Eval", "numpy", "NumPy")


@pytest.mark.parametrize("files", FILES.values(), ids=FILES)
def test_metadata_that_pip_makes_of_no_wheel_is_refused_with_a_reason(files, packages):
    (info,) = packages.glob("*.dist-info")
    for name, content in files.items():
        (info / name).unlink()
        if callable(content):
            content(info / name)
        elif content is not None:
            (info / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(PluginError) as refused:
        boxed_plugins(packages)
    assert str(refused.value).isprintable()
    assert len(str(refused.value)) < 900


@pytest.mark.parametrize("name", TAKEN)
def test_a_distribution_with_the_name_of_an_installed_one_is_refused(name, packages):
    write_plugin(packages, "more", "", distribution=name, version="99")
    with pytest.raises(PluginError, match=r"99 has the name of [\d.]+\S*, which is installed here"):
        boxed_plugins(packages)


def test_many_distributions_are_refused(packages):
    for number in range(MOST_DISTRIBUTIONS):
        (packages / f"x{number}-1.dist-info").mkdir()
    with pytest.raises(PluginError, match="201 distributions, expected at most 200"):
        check_packages(packages)
