"""Fixtures that more than one test module uses."""

import sys
from pathlib import Path

import pytest

# The import mode of this suite leaves the tests' directory off the path.
sys.path.insert(0, str(Path(__file__).parent))

from helpers_split import make_split


@pytest.fixture(scope="session")
def tiny_split(tmp_path_factory):
    """Directory of a synthetic split with two environments; tests must not write to it."""
    return make_split(tmp_path_factory.mktemp("splits") / "tiny")
