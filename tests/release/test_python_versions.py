"""What needs no PyBullet installs and runs under newer Pythons, with the same results.

Under the newest other Python of this machine; with ``--long`` under all of them, every extra in an
environment of its own. The table of docs/how-to/install.md says what is expected.
"""

import email
import itertools
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from helpers_wheel import PIP, ROOT
from packaging.requirements import Requirement

pytestmark = pytest.mark.packaging

NEWER = ("3.14", "3.13", "3.12")
SIZES = "--train 4 --calibration 4 --test 1 --cap 60 --seed-base 41"
RECORD = f"oodd_eval data build tiny --strength gain=0.2 {SIZES} --jobs 1 -q --env"


def interpreter(version):
    """Return a Python of this machine that has a version and starts, or None."""
    versions = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    for path in (shutil.which(f"python{version}"), *versions.glob(f"{version}*/bin/python")):
        if path and not subprocess.run([path, "--version"], capture_output=True).returncode:  # noqa: PLW1510
            return path
    return None


NEWEST = next(filter(interpreter, NEWER), None)


# The table


def table():
    """Return the versions of the table's columns, and its cells by extra; "" is no extra."""
    lines = re.findall(r"^\| .*\|$", (ROOT / "docs/how-to/install.md").read_text(), re.MULTILINE)
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    (begin,) = (i for i, row in enumerate(rows) if row[0] == "extra")
    names = [row[0].strip("`") for row in rows[begin + 1 :]]
    cells = {"" if n == "none" else n: row[2:] for n, row in zip(names, rows[begin + 1 :])}  # noqa: B905
    return [cell.removeprefix("Python ") for cell in rows[begin][2:]], cells


VERSIONS, TABLE = table()


@pytest.fixture(scope="module")
def metadata(wheel):
    """Metadata of the built wheel: pip reads them, not pyproject.toml."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith(".dist-info/METADATA"))
        return email.message_from_bytes(archive.read(name))


def required(metadata, extra, version):
    """Return the names of what pip installs with an extra under a Python."""
    requirements = map(Requirement, metadata.get_all("Requires-Dist"))
    here = {"extra": extra, "python_version": version, "python_full_version": f"{version}.0"}
    return {r.name for r in requirements if r.marker is None or r.marker.evaluate(here)}


def test_the_table_has_every_extra_and_every_version_of_the_package(metadata):
    assert set(TABLE) == {"", *metadata.get_all("Provides-Extra")}
    classifiers = " ".join(metadata.get_all("Classifier"))
    assert re.findall(r"Python :: (3\.\d+)", classifiers) == VERSIONS
    assert metadata["Requires-Python"] == f">={VERSIONS[0]}"


def test_the_table_says_where_pybullet_is_compiled_and_where_it_is_left_out(metadata):
    for extra, cells in TABLE.items():
        for version, cell in zip(VERSIONS, cells, strict=True):
            names = required(metadata, extra, version)
            expected = "yes"
            if version != "3.11" and "pybullet" in names:
                expected = "compiles"
            elif missing := required(metadata, extra, "3.11") - names:
                assert missing == {"pybullet", "pybullet-envs-gymnasium"}
                expected = "no robots"
            assert cell == expected, (extra, version)


# Installed


def environment(python, directory, what, options=("-c", ROOT / "constraints.txt")):
    """Return the Python of a new environment with what pip installs of wheels, and its errors."""
    subprocess.run([python, "-m", "venv", "--without-pip", directory], check=True)
    inside = directory / "bin" / "python"
    install = [*PIP, "--python", inside, "install", "--only-binary", ":all:", *options, what]
    done = subprocess.run(install, capture_output=True, text=True, check=False)
    return inside, done.stderr if done.returncode else ""


def execute(python, directory, arguments, code=0, warnings="error"):
    """Run `python -m` in a directory without a path to this checkout; return what it prints."""
    done = subprocess.run(
        [python, "-W", warnings, "-m", *arguments.split()],
        cwd=directory, capture_output=True, text=True, check=False,
        env={"PATH": "/usr/bin:/bin", "HOME": str(directory)},
    )  # fmt: skip
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr


def records(directory):
    lines = (directory / "records.jsonl").read_text().splitlines()
    rows = [json.loads(line) for line in lines]
    return {(r["detector"], r["anomaly"]): (r["status"], r["metrics"]) for r in rows}


def same_results(newer, here):
    """Compare two results directories; return how many cells they have."""
    results = records(newer)
    assert {status for status, _ in results.values()} == {"ok"}
    for cell, (_, metrics) in records(here).items():
        for metric, entry in metrics.items():
            expected = entry["value"] if entry["value"] is None else pytest.approx(entry["value"])
            assert results[cell][1][metric]["value"] == expected, (cell, metric)
    return len(results)


def digests(split):
    entries = json.loads((split / "manifest.json").read_text())["environments"]
    return {
        (name, part): group["sha256"]
        for name, entry in entries.items()
        for part, group in entry["groups"].items()
    }


@pytest.fixture(scope="module")
def newer(wheel, tmp_path_factory):
    """The newest other Python, in an environment with what records without PyBullet."""
    if NEWEST is None:
        pytest.skip("no newer Python on this machine")
    directory = tmp_path_factory.mktemp("newer") / "venv"
    python, errors = environment(interpreter(NEWEST), directory, f"{wheel}[gym,worlds]")
    if errors:
        pytest.skip(f"its libraries cannot be installed: {errors[-200:]}")
    return python


def test_a_newer_python_gives_the_same_results(newer, tmp_path):
    run = "oodd_eval run --detector clock,comb,persistence,range,mewma-a --env cartpole --output"
    for python, output in ((newer, "newer"), (sys.executable, "here")):
        execute(python, tmp_path, f"{run} {output}")
    assert same_results(tmp_path / "newer", tmp_path / "here") == 5 * 8


def test_a_newer_python_records_the_same_split(newer, tmp_path):
    build = f"{RECORD} cartpole,lunarlander,arm,tank"
    run = "oodd_eval run --detector oracle,range --env tank --jobs 1"
    for python, name in ((newer, "newer"), (sys.executable, "here")):
        execute(python, tmp_path, f"{build} --output split-{name}")
        execute(python, tmp_path, f"{run} --split split-{name} --output {name}")
    assert digests(tmp_path / "split-newer") == digests(tmp_path / "split-here")
    assert same_results(tmp_path / "newer", tmp_path / "here") == 2


def test_a_newer_python_says_why_it_records_no_robot(newer, tmp_path):
    output = execute(newer, tmp_path, f"{RECORD} hopper --output robot", code=4)
    assert "PyBullet has no wheel for Python 3.1" in output
    assert "use Python 3.11" in output


# Every extra

RUN = "oodd_eval run --env cartpole --anomaly iid,gravity --limit 5 --output results --detector"

IMPORTS = """
import importlib, sys
from importlib.metadata import packages_distributions
for module, names in packages_distributions().items():
    if {*sys.argv[1:]} & {*names} and not module.startswith("_"):
        importlib.import_module(module)
"""
"""A module that imports what some distributions have brought."""

USES = {
    "": [f"{RUN} mewma,persistence"],
    "reference": [f"{RUN} rf,pe"],
    "pyod": [f"{RUN} pyod:ECOD,sklearn:IsolationForest"],
    "river": [f"{RUN} river:HalfSpaceTrees"],
    "gym": [f"{RECORD} cartpole,lunarlander"],
    "bullet": [f"{RECORD} hopper"],
    "sim": [f"{RECORD} acrobot,lunarlander"],
    "worlds": [f"{RECORD} arm,drone,tank"],
    "train": ["oodd_eval policies train cartpole --steps 1500 --output policy"],
    "check": ["oodd_eval check persistence"],
    "all": [f"{RUN} rf,pyod:ECOD", f"{RECORD} lunarlander,drone", "oodd_eval check mewma"],
}
"""Commands that show an extra at work; of the others, what they install is imported."""


def pytest_generate_tests(metafunc):
    """All extras on all Pythons take half an hour: only with --long."""
    if "extra" in metafunc.fixturenames:
        cases = itertools.product(VERSIONS, TABLE) if metafunc.config.getoption("--long") else ()
        metafunc.parametrize(("version", "extra"), list(cases))


@pytest.fixture
def scratch(tmp_path):
    """A directory that goes with the test: an environment has up to a gigabyte."""
    yield tmp_path
    shutil.rmtree(tmp_path)


def test_every_extra_works_as_the_table_says(version, extra, metadata, wheel, scratch):
    base = interpreter(version)
    if base is None:
        pytest.skip(f"no Python {version} on this machine")
    if TABLE[extra][VERSIONS.index(version)] == "compiles":
        _, errors = environment(base, scratch / "venv", "pybullet", options=())
        assert "No matching distribution found for pybullet" in errors
        return
    python, errors = environment(base, scratch / "venv", f"{wheel}[{extra}]" if extra else wheel)
    assert not errors
    (scratch / "imports.py").write_text(IMPORTS)
    brought = required(metadata, extra, version) - required(metadata, "", version)
    uses = USES.get(extra, [f"imports {' '.join(brought)}"])
    for arguments in uses:
        execute(python, scratch, arguments, warnings="default")  # of libraries, there are some
