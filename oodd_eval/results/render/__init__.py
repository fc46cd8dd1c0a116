"""Formats of reports: each is a function from a report to its text.

A format is one function under `renders`, in a module of this package. All modules are imported
here, so that nothing else has to name a new one.
"""

import pkgutil
from collections.abc import Callable
from importlib import import_module
from typing import Final, NamedTuple

from oodd_eval.results.report import Report

Render = Callable[[Report], str]


class Format(NamedTuple):
    """A format: what it is, in a few words that follow "print", and its function.

    It has `tables`, or else a line for each cell with all metrics.
    """

    summary: str
    render: Render
    tables: bool


FORMATS: Final[dict[str, Format]] = {}
"""All formats by name: the option of ``oodd-eval show`` that asks for one."""


def renders(name: str, summary: str, *, tables: bool = True) -> Callable[[Render], Render]:
    """Return a decorator that makes a function known as a format."""

    def add(function: Render) -> Render:
        FORMATS[name] = Format(summary, function, tables)
        return function

    return add


for _module in pkgutil.iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")
