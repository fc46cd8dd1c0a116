"""The examples in docstrings are what they say."""

import doctest
import importlib
import pkgutil

import oodd_eval

OPTIONAL = {"oodd_eval.scoring.executors.dask", "oodd_eval.__main__"}
"""Modules that need an extra, or that run the program."""


def test_examples_give_what_they_print():
    names = {m.name for m in pkgutil.walk_packages(oodd_eval.__path__, "oodd_eval.")} - OPTIONAL
    found = {name: doctest.testmod(importlib.import_module(name)) for name in sorted(names)}
    assert not [name for name, result in found.items() if result.failed]
    assert sum(result.attempted for result in found.values()) > 30
