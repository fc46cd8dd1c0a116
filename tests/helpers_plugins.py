"""Small plug-ins, made where a test wants them: a module and the metadata pip would write."""

import sys
import textwrap
from contextlib import closing
from pathlib import Path

import adversaries
import numpy as np

from oodd_eval import load_split
from oodd_eval.plugins.discovery import discover

HEADER = """
import json, os, signal, subprocess, sys, threading, time
from pathlib import Path
import numpy as np
from oodd_eval import DetectorSpec, hookimpl
from oodd_eval.plugins.parameters import declared_by


class Good:
    def __init__(self, *, seed=0, horizon=1, **parameters):
        self.parameters = parameters
    def fit(self, nominal):
        self.fitted = len(nominal)
    def score(self, x):
        return np.abs(x.observations).sum(axis=1).astype(np.float64)


def offer(**factories):
    return [DetectorSpec(k.replace("_", "-"), v, "a test's") for k, v in factories.items()]
"""


def write_plugin(path, name, code, *, distribution=None, version="1.0", header=HEADER,
                 group="oodd_eval"):  # fmt: skip
    """Write a plug-in of one module ``oodd_<name>`` into a directory; return the module's file."""
    module = f"oodd_{name}"
    distribution = distribution or f"oodd-{name}"
    path.mkdir(parents=True, exist_ok=True)
    (path / f"{module}.py").write_text(header + textwrap.dedent(code))
    info = path / f"{distribution.replace('-', '_')}-{version}.dist-info"
    info.mkdir(exist_ok=True)
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n"
    )
    (info / "entry_points.txt").write_text(f"[{group}]\n{name} = {module}\n")
    return path / f"{module}.py"


def install(monkeypatch, path, name, code, **settings):
    """Put a plug-in, as `write_plugin` writes it, on the path, under the entry point `name`."""
    file = write_plugin(path, name, code, **settings)
    monkeypatch.delitem(sys.modules, file.stem, raising=False)
    monkeypatch.syspath_prepend(str(path))
    # Imported by the test, it must not stay for the next one.
    monkeypatch.setitem(sys.modules, file.stem, None)
    monkeypatch.delitem(sys.modules, file.stem)
    return file


def table_of(split):
    """Return the module in which an adversary keeps the twins of a split's CartPole."""
    cells = bytearray(adversaries.CELLS)
    with closing(load_split(split).environment("cartpole")) as data:
        for twin in data.twins:
            adversaries.remember(twin.observations, np.array([0, len(twin) - 1]), cells)
    known = np.flatnonzero(np.frombuffer(cells, np.uint8)).astype("<u4")
    return f"CELLS = {known.tobytes().hex()!r}\n"


def write_adversaries(path, split):
    """Write `adversaries.py` into a directory of packages, with a table of a split's twins."""
    write_plugin(
        path, "adversaries", Path(__file__).with_name("adversaries.py").read_text(), header=""
    )
    (path / "oodd_adversaries_table.py").write_text(table_of(split))


def install_adversaries(monkeypatch, path, code=""):
    """Install `adversaries.py` as a plug-in, or other code, here and in processes started here."""
    code = code or Path(__file__).with_name("adversaries.py").read_text()
    install(monkeypatch, path, "adversaries", code, header="")
    monkeypatch.setenv("PYTHONPATH", str(path))


def local_spec(name):
    """Return an installed detector that `evaluate` fits and scores in this process: quicker."""
    return discover().offer(name).spec
