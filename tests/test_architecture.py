"""The house: who imports what, how large a module may be, one public class a name."""

import ast
import functools
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CORE = sorted((ROOT / "oodd_eval").rglob("*.py"))
OTHERS = sorted([*(ROOT / "detectors").glob("*/*/*.py"), *(ROOT / "training").glob("*/*.py")])

NEVER = {"pickle", "dill", "cloudpickle", "joblib", "shelve", "marshal"}
HEAVY = {"torch", "sklearn", "scipy", "pandas"}
SIMULATORS = {"gymnasium", "pybullet", "pybullet_envs_gymnasium", "Box2D"}


@functools.cache
def tree(path):
    return ast.parse(path.read_text())


def imported(path):
    """Top-level names that a module imports anywhere in it."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module.split(".")[0]


def wrong(paths, allowed):
    """Modules that do what they may not, with it."""
    found = {str(path.relative_to(ROOT)): sorted(allowed(path)) for path in paths}
    return {path: names for path, names in found.items() if names}


def test_the_core_imports_no_heavy_library_and_no_detector():
    own = {path.parent.name for path in OTHERS} - {"oodd_training"}
    assert len(own) > 5

    def forbidden(path):
        simulators = set() if "simulate" in path.parts else SIMULATORS
        if path == ROOT / "oodd_eval" / "live" / "wrappers.py":
            simulators = SIMULATORS - {"gymnasium"}
        return {*imported(path)} & (HEAVY | own | simulators)

    assert not wrong(CORE, forbidden)


def test_nothing_unpickles():
    def unsafe(path):
        source = path.read_text()
        flags = {f for f in ("allow_pickle=True", "weights_only=False") if f in source}
        return flags | ({*imported(path)} & NEVER)

    assert not wrong([*CORE, *OTHERS], unsafe)


def test_modules_are_few_and_short():
    lines = {path: len(path.read_text().splitlines()) for path in (*CORE, *OTHERS)}
    assert not {str(path): n for path, n in lines.items() if n > 400}
    assert len(CORE) <= 150
    assert sum(lines[path] for path in CORE) <= 27_050
    root = ROOT / "oodd_eval"
    assert len([path for path in CORE if path.parent == root]) <= 9
    assert len([place for place in root.iterdir() if (place / "__init__.py").exists()]) <= 9


def test_no_two_public_classes_have_one_name():
    names = Counter(
        node.name
        for path in (*CORE, *OTHERS)
        for node in tree(path).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert not {name: n for name, n in names.items() if n > 1}


@pytest.mark.parametrize(
    ("arguments", "heavy"),
    [
        (["--help"], {"numpy", "h5py", "rich", "pydantic", "pluggy"}),
        (["list", "detectors"], {"numpy", "h5py", "rich", "pydantic", *HEAVY, *SIMULATORS}),
        (["list", "metrics"], {"h5py", "rich", "pydantic", *HEAVY, *SIMULATORS}),
    ],
)
def test_quick_commands_import_nothing_heavy(arguments, heavy):
    code = (
        "import sys\n"
        "from oodd_eval.cli.main import main\n"
        f"assert main({arguments!r}) == 0\n"
        f"found = sorted({heavy!r} & set(sys.modules))\n"
        "sys.exit(f'imported {found}' if found else 0)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout
