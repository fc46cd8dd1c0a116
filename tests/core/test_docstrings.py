"""Docstrings: examples give what they print, and what docs/reference shows is documented whole."""

import ast
import doctest
import functools
import importlib
import pkgutil
import re
from pathlib import Path

import griffe
import oodd_checks
import oodd_leaderboard
import oodd_live
import oodd_logs
import oodd_monitors
import pytest
import yaml

import oodd_eval
from oodd_eval import errors

ROOT = Path(__file__).parents[2]
SEARCH = [
    ROOT,
    *(
        ROOT / name
        for name in (
            "checks",
            "interventions",
            "leaderboard",
            "live",
            "logs",
            "monitors",
            "recording",
        )
    ),
    *(ROOT / "detectors").iterdir(),
]
OPTIONAL = {"oodd_eval.scoring.executors.dask", "oodd_eval.__main__"}
"""Modules that need an extra, or that run the program."""

OPENED = {"EnvironmentData", "TrajectorySet", "AnomalousSet", "Watchdog"}
"""Classes whose objects users get from a function: they have attributes in place of parameters."""

DIRECTIVE = re.compile(r"^::: (\S+)\n((?:(?: {4}.*)?\n)*)", re.MULTILINE)


def test_examples_give_what_they_print():
    names = {
        module.name
        for top in (oodd_checks, oodd_eval, oodd_leaderboard, oodd_live, oodd_logs, oodd_monitors)
        for module in pkgutil.walk_packages(top.__path__, f"{top.__name__}.")
    } - OPTIONAL
    results = {name: doctest.testmod(importlib.import_module(name)) for name in sorted(names)}
    assert not [name for name, result in results.items() if result.failed]
    assert sum(result.attempted for result in results.values()) > 30


@functools.cache
def package(name):
    return griffe.load(name, search_paths=SEARCH, docstring_parser="numpy")


def public(item, members):
    """Yield an object of a directive and those in it that its page shows."""
    if item.is_alias:
        item = item.final_target
    if item.is_function or item.is_class:
        yield item
    if not (item.is_class or item.is_module):
        return
    for name, member in item.members.items():
        if (name in members) if members is not None else (
            not (name.startswith("_") or member.is_alias or member.is_module)
            and member.has_docstring
        ):  # fmt: skip
            yield from public(member, None)


def documented():
    """Functions and classes that docs/reference shows, by path."""
    for page in sorted((ROOT / "docs" / "reference").glob("*.md")):
        for path, block in DIRECTIVE.findall(page.read_text()):
            options = (yaml.safe_load(block) or {}).get("options", {})
            root, _, rest = path.partition(".")
            for item in public(package(root)[rest], options.get("members")):
                yield item.path, item


SHOWN = dict(documented())


def raised(function):
    """Errors of the project that a function itself raises."""
    source = "\n".join(function.lines)
    (node,) = ast.parse(
        re.sub(f"^{re.match(' *', source)[0]}", "", source, flags=re.MULTILINE)
    ).body
    todo = list(ast.iter_child_nodes(node))
    while todo:
        node = todo.pop()
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            name = getattr(node.exc.func, "id", "")
            if hasattr(errors, name):
                yield name
        if not isinstance(node, ast.FunctionDef | ast.Lambda):
            todo += ast.iter_child_nodes(node)


def omissions(item):
    """What the docstring of a function or class leaves out."""
    if not item.has_docstring:
        return ["everything"]
    sections = {section.kind.value: section.value for section in item.docstring.parse()}
    described = {
        name.strip("* ")
        for kind in ("parameters", "other parameters", "attributes")
        for entry in sections.get(kind, ())
        for name in entry.name.split(",")
    }
    names = {p.name.strip("*") for p in item.parameters if not p.name.startswith("_")}
    left_out = sorted(names - {"self", "cls"} - described)
    if item.is_class:
        return left_out if item.name not in OPENED else [] if described else ["attributes"]
    if str(item.returns) not in {"None", "NoReturn"} and not sections.keys() & {
        "returns",
        "yields",
    }:
        left_out.append("what it returns")
    kinds = [
        getattr(errors, name)
        for entry in sections.get("raises", ())
        for name in re.findall(r"\w+Error", str(entry.annotation))
        if hasattr(errors, name)
    ]
    unnamed = (n for n in raised(item) if not any(issubclass(getattr(errors, n), k) for k in kinds))
    return left_out + sorted({*unnamed})


@pytest.mark.parametrize("path", sorted(SHOWN))
def test_what_the_reference_shows_is_documented_whole(path):
    """Every parameter, what is returned, and each error of the project that is raised there."""
    assert not omissions(SHOWN[path])
