"""What pip installs: the built wheel, and a detector directory lifted out of the project."""

import email
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest
from helpers_wheel import pip
from trove_classifiers import classifiers, deprecated_classifiers

from oodd_eval._version import repository

pytestmark = pytest.mark.packaging

ROOT = Path(__file__).parents[2]


def test_wheel_ships_only_leaf_named_packages(wheel):
    names = {name.split("/")[0] for name in zipfile.ZipFile(wheel).namelist()}
    packages = {name for name in names if not name.endswith(".dist-info")}
    assert packages
    assert all(name.startswith("oodd_") for name in packages), packages


def test_wheel_ships_data_policies_and_types(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    packages = {name.split("/")[0] for name in names if name.endswith("/__init__.py")}
    assert {
        *(f"{package}/py.typed" for package in packages),
        "oodd_recording/train/train.py",
        "oodd_eval/data/shipped/mini/manifest.json",
        "oodd_checks/template/templates/pyproject.toml.in",
        "oodd_checks/template/templates/gitignore.in",
        "oodd_leaderboard/published.jsonl.xz",
        *(f"oodd_logs/recipes/{path.name}" for path in (ROOT / "recipes").glob("*.toml")),
    } <= names
    assert "oodd_recording/frozen/ant.npz" in names


def run(*command):
    done = subprocess.run(
        command, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHON": sys.executable},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def distributions(tmp_path_factory):
    """Source distribution, and the wheel that `build` makes of it."""
    directory = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", directory, ROOT)
    return sorted(directory.iterdir(), key=lambda path: path.suffix)


def test_what_is_handed_out_works_in_an_environment_of_its_own(distributions):
    """As docs/how-to/release.md says."""
    source, wheel = distributions
    assert source.name.endswith(".tar.gz")
    assert "works in an environment of its own" in run(ROOT / ".ci" / "check-dist", wheel)


def test_the_source_distribution_holds_what_the_repository_does(distributions):
    listed = ["git", "-C", ROOT, "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    tracked = {name for name in run(*listed).split("\0") if name and (ROOT / name).exists()}
    with tarfile.open(distributions[0]) as packed:
        top, *_ = {member.name.partition("/")[0] for member in packed}
        names = {member.name.removeprefix(f"{top}/") for member in packed if member.isfile()}
    assert names - {"PKG-INFO"} == tracked


def test_the_wheel_has_no_tests_and_the_licence(distributions):
    with zipfile.ZipFile(distributions[1]) as packed:
        names = packed.namelist()
        (licence,) = (name for name in names if name.endswith(".dist-info/licenses/LICENSE"))
        assert packed.read(licence) == (ROOT / "LICENSE").read_bytes()
    parts = {part for name in names for part in Path(name).parts}
    assert not parts & {"tests", "docs", "benchmarks", "__pycache__", ".work", "conftest.py"}
    # Checks of detectors are part of the product, and they alone.
    modules = {str(Path(name).parent) for name in names if Path(name).name.startswith("test_")}
    assert modules == {"oodd_checks/conformance"}


def test_metadata_say_what_the_project_says(distributions):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    with zipfile.ZipFile(distributions[1]) as packed:
        (name,) = (n for n in packed.namelist() if n.endswith(".dist-info/METADATA"))
        metadata = email.message_from_bytes(packed.read(name))
    assert metadata["License-Expression"] == project["license"]
    assert metadata["Summary"] == project["description"]
    assert metadata["Description-Content-Type"] == "text/markdown"
    assert metadata.get_payload(decode=True).decode() == (ROOT / "README.md").read_text()
    urls = dict(url.split(", ", 1) for url in metadata.get_all("Project-URL", []))
    assert urls == project.get("urls", {})
    assert all(address.startswith("https://") for address in urls.values())
    labels = metadata.get_all("Classifier")
    assert not {*labels} - classifiers
    assert {*labels}.isdisjoint(deprecated_classifiers)
    columns = re.search(
        r"\| extra \| for \| Python (.*) \|", (ROOT / "docs/how-to/install.md").read_text()
    )
    minors = [label.rpartition(" ")[2] for label in labels if ":: Python :: 3." in label]
    assert minors == columns[1].split(" | ")


def test_the_index_takes_both_distributions(distributions):
    """Their metadata are valid; of a readme in Markdown twine reads no more than the type."""
    pytest.importorskip("twine", reason="it is among the dependencies of development (extra dev)")
    said = run(sys.executable, "-m", "twine", "--no-color", "check", "--strict", *distributions)
    assert said.count("PASSED") == 2


def test_the_readme_renders_as_on_the_page_of_an_index():
    """Its tables, code and links are what they are in the repository."""
    reason = "it is among the dependencies of development (extra dev)"
    pytest.importorskip("comrak", reason=reason)  # without it the next one renders no Markdown
    markdown = pytest.importorskip("readme_renderer.markdown", reason=reason)
    readme = (ROOT / "README.md").read_text()
    page = markdown.render(readme)
    prose = re.sub(r"^```.*?^```$", "", readme, flags=re.MULTILINE | re.DOTALL)
    assert page.count("<table>") == len(re.findall(r"^\|[-|]+\|$", readme, re.MULTILINE)) > 0
    assert page.count("<pre") == readme.count("\n```") // 2 > 0
    targets = re.findall(r"\]\(([^)\s]+)\)", prose)
    assert [*re.findall(r'(?:href|src)="([^#"][^"]*)"', page)] == targets
    assert not re.search(r"<!--|&lt;!--|\|---", page)
    if repository():
        # A page of an index shows no file of the repository.
        assert not [target for target in targets if not target.startswith("https://")]


def test_wheel_is_at_most_30_megabytes(wheel):
    assert wheel.stat().st_size <= 30e6


def readme_pyproject():
    return re.search(r"```toml\n(.*?)```", (ROOT / "detectors/README.md").read_text(), re.DOTALL)[1]


LIFTED = ["rf", "riqn", "npn", "mewma", "panel", "pe", "rivals", "outcomes", "adapters"]


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
    # A plug-in that makes detectors of names is listed in brackets; some have names of their own.
    first = {"rivals": "pca", "outcomes": "logistic"}.get(name, name)
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
