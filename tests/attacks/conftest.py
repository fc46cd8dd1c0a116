"""How many attacks there are, by family, and how many of them broke something.

``pytest -m attacks`` runs them all; with ``--long``, random ones for hours instead of seconds.
"""

from collections import Counter

import pytest
from helpers_fuzz import fuzz

PLACE = "tests/attacks/"


def pytest_collection_modifyitems(items):
    """Mark every test of this directory; the default selection leaves them out."""
    for item in items:
        if PLACE in item.nodeid:
            item.add_marker(pytest.mark.attacks)


@pytest.fixture
def fuzzed(request):
    """Run a function on examples of a strategy: a few, or thousands with --long."""
    long = request.config.getoption("--long")
    return lambda strategy, tried: fuzz(strategy, tried, long=long)


def pytest_terminal_summary(terminalreporter):
    """Print the count: a case is one test of this directory, its family is its module."""
    held, broke = Counter(), Counter()
    for outcome, count in (("passed", held), ("failed", broke), ("error", broke)):
        for report in terminalreporter.stats.get(outcome, ()):
            path, _, _ = report.nodeid.partition("::")
            if PLACE in path:
                count[path.rpartition("/test_")[2].removesuffix(".py")] += 1
    if held or broke:
        terminalreporter.section("attacks")
    for family in sorted(held | broke):
        tried = held[family] + broke[family]
        terminalreporter.line(f"{family:12} {tried:4} cases, {broke[family]} broke something")
    if held or broke:
        tried = held.total() + broke.total()
        terminalreporter.line(f"{'all':12} {tried:4} cases, {broke.total()} broke something")
