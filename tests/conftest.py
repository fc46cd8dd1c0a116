"""Fixtures that more than one test module uses."""

import contextlib
import gc
import os
import signal
import sys
import warnings
from pathlib import Path

import pytest
from hypothesis import settings

# Two workers on two cores: numerical libraries get one thread each.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# The import mode of this suite leaves the tests' directory off the path.
sys.path.insert(0, str(Path(__file__).parent))

from helpers_split import make_split

TESTS = Path(__file__).parent

# A slow machine is no error.
settings.register_profile("tests", deadline=None)
settings.load_profile("tests")

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
    """Add the option that turns seconds of random attacks into hours, and that of samples."""
    parser.addoption("--long", action="store_true", help="random attacks: many thousands of them")
    parser.addoption(
        "--tenth", action="append", default=[], metavar="FOLDER",
        help="run every tenth test of this folder, too",
    )  # fmt: skip


def pytest_configure(config):
    """Collect the folders of which a sample runs, too."""
    if sampled := config.getoption("--tenth"):
        if config.args_source is pytest.Config.ArgsSource.TESTPATHS:
            config.args = []
        config.args += {*(str(TESTS / name) for name in sampled)} - {*config.args}


def pytest_collection_modifyitems(config, items):
    """Leave out nine of ten tests of the folders that --tenth names."""
    sampled = {TESTS / name for name in config.getoption("--tenth")}
    of_samples = [item for item in items if sampled & {*item.path.parents}]
    left_out = {*of_samples} - {*of_samples[::10]}
    config.hook.pytest_deselected(items=[item for item in items if item in left_out])
    items[:] = [item for item in items if item not in left_out]


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
