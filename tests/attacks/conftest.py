"""Attacks: ``pytest -m attacks`` runs them; with ``--long``, random ones for hours, not seconds."""

import pytest
from helpers_fuzz import fuzz
from helpers_robustness import Ground


def pytest_collection_modifyitems(items):
    """Mark every test of this directory; the default selection leaves them out."""
    for item in items:
        if "tests/attacks/" in item.nodeid:
            item.add_marker(pytest.mark.attacks)


@pytest.fixture(scope="session")
def ground(tmp_path_factory):
    """Valid files of every kind, which tests copy."""
    return Ground(tmp_path_factory.mktemp("ground"))


@pytest.fixture
def fuzzed(request):
    """Run a function on examples of a strategy: a few, or thousands with --long."""
    long = request.config.getoption("--long")
    return lambda strategy, tried: fuzz(strategy, tried, long=long)
