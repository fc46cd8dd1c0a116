"""The house: which packages there are, who imports what, how large a room is, names."""

import ast
import configparser
import functools
import io
import math
import re
import subprocess
import sys
import tokenize
import tomllib
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = sorted(
    path.parent
    for path in (*ROOT.glob("*/__init__.py"), *ROOT.glob("*/oodd_*/__init__.py"),
                 *ROOT.glob("detectors/*/*/__init__.py"))
    if path.parts[-3] != "examples"
)  # fmt: skip
SOURCES = {package.name: sorted(package.rglob("*.py")) for package in PACKAGES}
CORE = SOURCES["oodd_eval"]
OTHERS = [path for name in SOURCES if name != "oodd_eval" for path in SOURCES[name]]

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
    offenders = {str(path.relative_to(ROOT)): sorted(allowed(path)) for path in paths}
    return {path: names for path, names in offenders.items() if names}


def test_lists_of_packages_name_every_package():
    """Hatch, mypy, coverage and import-linter list packages: the directories decide which."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]
    linter = configparser.ConfigParser()
    linter.read(ROOT / ".importlinter")
    names = set(SOURCES)
    assert {"oodd_eval", "oodd_pe", "oodd_recording", "oodd_paper"} <= names
    wheel = project["hatch"]["build"]["targets"]["wheel"]["packages"]
    assert {ROOT / path for path in wheel} == set(PACKAGES)
    assert set(project["mypy"]["packages"]) == names
    paths = {ROOT / path for path in project["mypy"]["mypy_path"].split(":")}
    assert paths == {package.parent for package in PACKAGES} - {ROOT}
    assert set(project["coverage"]["run"]["source_pkgs"]) == names
    assert set(linter["importlinter"]["root_packages"].split()) == names


def test_the_core_imports_no_heavy_library_and_no_other_package():
    others = set(SOURCES) - {"oodd_eval"}

    def forbidden(path):
        return {*imported(path)} & (HEAVY | others | SIMULATORS)

    assert not wrong(CORE, forbidden)


def test_nothing_unpickles():
    def unsafe(path):
        source = path.read_text()
        flags = {f for f in ("allow_pickle=True", "weights_only=False") if f in source}
        return flags | ({*imported(path)} & NEVER)

    assert not wrong([*CORE, *OTHERS], unsafe)


def code_lines(formatted):
    """Lines of code in a formatted module: no blank line, comment, docstring or import counts."""
    left_out = set()
    for node in ast.walk(ast.parse(formatted)):
        docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if isinstance(node, ast.Import | ast.ImportFrom) or docstring:
            left_out.update(range(node.lineno, node.end_lineno + 1))
    layout = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
              tokenize.ENDMARKER}  # fmt: skip
    code = set()
    for token in tokenize.generate_tokens(io.StringIO(formatted).readline):
        if token.type not in layout:
            code.update(range(token.start[0], token.end[0] + 1))
    return len(code - left_out)


def room_of(path):
    """The room of a module: its package, and in the evaluator the directory below it."""
    package = next(package for package in PACKAGES if package in path.parents)
    inner = path.relative_to(package).parts
    room = f"/{inner[0]}" if package.name == "oodd_eval" and len(inner) > 1 else ""
    return package.name + room


def test_rooms_are_as_large_as_planned(tmp_path):
    """The plan stands in docs/architecture.md; a room may be a tenth above it.

    Lines are counted as the formatter lays them out without any ``fmt: skip``.
    """
    copies = {path: tmp_path / path.relative_to(ROOT) for path in [*CORE, *OTHERS]}
    for path, copy in copies.items():
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text(path.read_text().replace("# fmt: skip", ""))
    format_all = ["ruff", "format", "-q", "--config", str(ROOT / "pyproject.toml"), str(tmp_path)]
    subprocess.run([sys.executable, "-m", *format_all], check=True)
    text = (ROOT / "docs" / "architecture.md").read_text()
    section = text.partition("## Size")[2].partition("\n## ")[0]
    plan = {name: int(lines.replace(" ", "")) for name, lines in
            re.findall(r"^\| `([\w/]+?)/?` \| ([\d ]+) \|", section, re.MULTILINE)}  # fmt: skip
    size, modules = Counter(), Counter()
    for path, copy in copies.items():
        size[room_of(path)] += code_lines(copy.read_text())
        modules[room_of(path)] += 1
    for room in size:
        line = f"{room:24} {size[room]:6} code lines, {modules[room]:3} modules; plan {plan[room]}"
        print(line)  # noqa: T201  shown by -s
    assert plan.keys() == size.keys()
    assert not {room: (size[room], plan[room]) for room in size if size[room] > 1.1 * plan[room]}


def test_no_two_public_classes_have_one_name():
    names = Counter(
        node.name
        for path in (*CORE, *OTHERS)
        for node in tree(path).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert not {name: n for name, n in names.items() if n > 1}


VAGUE = {"found", "own", "place", "told", "given", "made", "shown", "wanted"}


def vague_names(path):
    """Variables, parameters, attributes, functions and classes with a name that says nothing."""
    for node in ast.walk(tree(path)):
        match node:
            case ast.Name(id=name, ctx=ast.Store()) | ast.arg(arg=name):
                pass
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                pass
            case ast.MatchAs(name=str(name)):
                pass
            case _:
                continue
        if name.lstrip("_").lower() in VAGUE:
            yield f"{path.relative_to(ROOT)}:{node.lineno}: {name}"


def test_names_say_what_they_hold():
    assert not [line for path in (*CORE, *OTHERS) for line in vague_names(path)]


def module_name(path):
    package = next(package for package in PACKAGES if package in path.parents)
    parts = path.relative_to(package.parent).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


MODULES = {module_name(path) for path in (*CORE, *OTHERS)}


def named_by_text(path):
    """Packages and modules of ours in texts of a module, which contracts of imports do not see."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value.partition(":")[0]


LAZY = {
    "oodd_eval/__init__.py": "names that stay there, of packages",
    "oodd_eval/cli/__init__.py": "what shells complete, below it",
    "oodd_eval/cli/info.py": "the description of a split, as data info prints it",
    "oodd_eval/cli/main.py": "the table of commands",
    "oodd_eval/cli/run.py": "the launcher of --sandbox, and how it finds plug-ins",
    "oodd_eval/plugins/isolation/supervisor.py": "the process that it starts",
    "oodd_eval/scoring/plan.py": "packages that digests of plug-ins pass over",
}
"""Modules that may name others by text, and why."""


def test_no_text_imports_what_the_contracts_forbid():
    paths = [path for path in CORE if str(path.relative_to(ROOT)) not in LAZY]
    known = MODULES - {"oodd_eval"}
    assert not wrong(paths, lambda path: {*named_by_text(path)} & known - {module_name(path)})


AROUND = (
    "oodd_checks",
    "oodd_interventions",
    "oodd_leaderboard",
    "oodd_live",
    "oodd_logs",
    "oodd_monitors",
)
LOADS = {
    "list detectors": ((*AROUND, "oodd_eval.results", "oodd_eval.scoring"), 1_950),
    "run --detector mewma --env hopper -q": (AROUND, 10_850),
    "data inspect logs": (("oodd_eval.results", "oodd_eval.scoring", "oodd_live"), 8_000),
    "scan logs": (("oodd_eval.results", "oodd_eval.scoring"), 13_600),
}
"""What a command may not load, and how many code lines of the project it loads at most."""


@pytest.mark.parametrize("command", LOADS)
def test_commands_load_what_they_need(command, tmp_path):
    (tmp_path / "logs").mkdir()
    for number in range(12):
        rows = "".join(f"{t},{math.sin(t + number)},{math.cos(t)}\n" for t in range(60))
        (tmp_path / "logs" / f"{number:02}.csv").write_text(f"t,speed,torque\n{rows}")
    code = (
        "import sys\n"
        "from oodd_eval.cli.main import main\n"
        f"assert main({command.split()!r}) in (0, 1)\n"
        "ours = [m for m in list(sys.modules.values()) if m.__name__.startswith('oodd_')]\n"
        "print(*['', *(f'{m.__name__}={m.__file__}' for m in ours)], sep='\\n')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    rooms = "|".join(("oodd_eval", *AROUND))  # what detectors load is theirs
    loaded = dict(re.findall(rf"^((?:{rooms})\b[\w.]*)=(.*)$", done.stdout, re.MULTILINE))
    forbidden, most = LOADS[command]
    assert not [name for name in loaded if name.startswith(forbidden)]
    lines = {name: code_lines(Path(path).read_text()) for name, path in loaded.items()}
    print(f"{command}: {len(lines)} modules, {sum(lines.values())} code lines")  # noqa: T201  by -s
    assert sum(lines.values()) <= most


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
        f"loaded = sorted({heavy!r} & set(sys.modules))\n"
        "sys.exit(f'imported {loaded}' if loaded else 0)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout
