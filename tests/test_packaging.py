"""What pip installs: the built wheel, and a detector directory lifted out of the project."""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest
from helpers_wheel import pip

pytestmark = pytest.mark.packaging

ROOT = Path(__file__).parents[1]


def test_wheel_ships_only_leaf_named_packages(wheel):
    names = {name.split("/")[0] for name in zipfile.ZipFile(wheel).namelist()}
    packages = {name for name in names if not name.endswith(".dist-info")}
    assert packages
    assert all(name.startswith("oodd_") for name in packages), packages


def test_wheel_ships_data_policies_and_types(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {
        "oodd_eval/py.typed",
        "oodd_common/py.typed",
        "oodd_riqn/py.typed",
        "oodd_recording/train/train.py",
        "oodd_eval/data/shipped/mini/manifest.json",
        "oodd_eval/plugins/template/templates/pyproject.toml.in",
        "oodd_eval/plugins/template/templates/gitignore.in",
        "oodd_eval/leaderboard/published.jsonl.gz",
        *(f"oodd_eval/data/recipes/{path.name}" for path in (ROOT / "recipes").glob("*.toml")),
    } <= names
    assert "oodd_recording/frozen/ant.npz" in names


def test_what_is_handed_out_works_in_an_environment_of_its_own(tmp_path):
    """As docs/how-to/release.md says; `build` makes the wheel of the source distribution."""

    def run(*command):
        done = subprocess.run(
            command, capture_output=True, text=True, check=False,
            env={**os.environ, "PYTHON": sys.executable},
        )  # fmt: skip
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", tmp_path, ROOT)
    source, wheel = sorted(tmp_path.iterdir(), key=lambda path: path.suffix)
    assert source.name.endswith(".tar.gz")
    assert "works in an environment of its own" in run(ROOT / ".ci" / "check-dist", wheel)


def test_wheel_is_at_most_30_megabytes(wheel):
    assert wheel.stat().st_size <= 30e6


def readme_pyproject():
    return re.search(r"```toml\n(.*?)```", (ROOT / "detectors/README.md").read_text(), re.DOTALL)[1]


LIFTED = ["rf", "riqn", "npn", "mewma", "panel", "pe", "rivals", "adapters"]


@pytest.mark.parametrize("name", LIFTED)
def test_each_detector_directory_lifts_out(name, tmp_path):
    project, target = tmp_path / "project", tmp_path / "target"
    project.mkdir()
    package = project / f"oodd_lifted_{name}"
    shutil.copytree(
        ROOT / "detectors" / name / f"oodd_{name}", package,
        ignore=shutil.ignore_patterns("__pycache__"),
    )  # fmt: skip
    for path in package.rglob("*.py"):
        source = path.read_text().replace(f"oodd_{name}", package.name)
        # The detectors get names of their own too: two plug-ins may not offer the same name.
        path.write_text(re.sub(r'(\bname=)"', r'\1"lifted-', source))
    text = readme_pyproject().replace("oodd_bounds", package.name)
    text = text.replace("oodd-bounds", f"oodd-lifted-{name}")
    text = text.replace("bounds =", f"lifted-{name} =")
    (project / "pyproject.toml").write_text(text)
    pip("install", "--no-deps", "--no-build-isolation", "--target", str(target), str(project))
    listed = subprocess.run(
        [sys.executable, "-m", "oodd_eval", "list", "detectors"],
        env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "PYTHONPATH": str(target)},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert listed.returncode == 0, listed.stdout + listed.stderr
    # A plug-in that makes detectors of names is listed in brackets; rivals have names of their own.
    first = {"rivals": "pca"}.get(name, name)
    assert re.search(rf"^\(?lifted-{first}\b", listed.stdout, re.MULTILINE), listed.stdout


def test_tutorial_detector_installs_and_runs(tmp_path):
    project, target = tmp_path / "project", tmp_path / "target"
    project.mkdir()
    code = re.search(r"```python\n(.*?)```", (ROOT / "detectors/README.md").read_text(), re.DOTALL)[
        1
    ]
    (project / "oodd_bounds.py").write_text(code)
    text = readme_pyproject() + '\n[tool.hatch.build.targets.wheel]\ninclude = ["oodd_bounds.py"]\n'
    (project / "pyproject.toml").write_text(text)
    pip("install", "--no-deps", "--no-build-isolation", "--target", str(target), str(project))
    ran = subprocess.run(
        [sys.executable, "-m", "oodd_eval", "run", "--detector", "bounds", "--env", "cartpole"],
        env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "PYTHONPATH": str(target)},
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "8 ok" in ran.stdout


def test_version_is_the_distributions():
    import oodd_eval

    assert oodd_eval.__version__ == version("oodd-eval")
