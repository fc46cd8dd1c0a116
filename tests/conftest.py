"""Fixtures that more than one test module uses."""

import contextlib
import gc
import os
import signal
import sys
import warnings
from pathlib import Path

import pytest

# Two workers on two cores: numerical libraries get one thread each.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# The import mode of this suite leaves the tests' directory off the path.
sys.path.insert(0, str(Path(__file__).parent))

from helpers_split import make_split

# Until the tests are collected, nothing is garbage. `pytest_collection_finish` ends this.
gc.disable()

# Begun in the background of a shell, a process ignores interrupts, and so would those it starts:
# the tests of interrupted commands would wait in vain. So it is with hang-ups under nohup.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)

# Box2D's extension module warns while it is set up and crashes when a warning is an error there.
with warnings.catch_warnings(), contextlib.suppress(ImportError):
    warnings.simplefilter("ignore")
    import Box2D  # noqa: F401


def pytest_addoption(parser):
    """Add the option that turns seconds of random attacks into hours."""
    parser.addoption("--long", action="store_true", help="random attacks: many thousands of them")


LONGEST = (
    ("test_docs", "test_walk", "test_packaging", "test_python_versions", "test_examples",
     "test_site_browser"),
    ("test_committed_board", "test_docs_commands"),
)  # fmt: skip
"""Modules that take longest, as two processes share them out to begin with."""


@pytest.hookimpl(trylast=True)  # when the tests of other marks are out
def pytest_collection_modifyitems(items):
    """Let every process begin with long tests, so that those left at the end are short.

    pytest-xdist gives each process a stretch of the tests. A process that has finished its own
    takes over the last ones of another process.
    """
    place = {name: i for i, names in enumerate(LONGEST) for name in names}
    heads = [[] for _ in LONGEST]
    rest = []
    for item in items:
        i = place.get(item.path.stem)
        (rest if i is None else heads[i]).append(item)
    for i, names in enumerate(LONGEST):
        heads[i].sort(key=lambda item, names=names: names.index(item.path.stem))
    found, total = [], len(items)
    for i, head in enumerate(heads):
        # As pytest-xdist shares them out.
        size = (total - len(found)) // (len(heads) - i) - len(head)
        found += head + rest[: max(0, size)]
        del rest[: max(0, size)]
    items[:] = found + rest


def pytest_collection_finish():
    """Spare the garbage collector what stays until the end: all modules, and thousands of tests."""
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session")
def tiny_split(tmp_path_factory):
    """Directory of a synthetic split with two environments; tests must not write to it."""
    return make_split(tmp_path_factory.mktemp("splits") / "tiny")


@pytest.fixture(scope="session")
def wheel(tmp_path_factory):
    """The wheel of this checkout."""
    from helpers_wheel import build_wheel

    return build_wheel(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="session")
def submissions(tmp_path_factory):
    """Valid entries of the leaderboard with their results and split; see `Submissions`."""
    from helpers_submission import make_submissions

    return make_submissions(tmp_path_factory.mktemp("submissions"))
