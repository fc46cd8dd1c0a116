"""pytest plug-in: a detector's regression check among the tests of its own repository.

::

    pytest --oodd-detector mine --oodd-reference reference.jsonl

adds one test per cell; ``--pyargs oodd_checks.conformance`` in place of a reference runs the
conformance checks of the detector. Without ``--oodd-detector`` nothing happens: pytest loads this
module in every environment in which oodd-eval is installed, so the harness is imported only when
asked for.
"""

from typing import Final

import pytest

_OTHERS: Final = ("reference", "env", "fail", "two_sided", "output")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options."""
    # fmt: off
    add = parser.getgroup("oodd-eval", "regression check of detectors (oodd-eval)").addoption
    add("--oodd-detector", metavar="NAMES",
        help="add a test per cell of these installed detectors: comma lists or globs")
    add("--oodd-reference", metavar="FILE",
        help="what the figures must come up to, written by oodd-eval compare --write-reference; "
             "without it a test passes when its cell does not fail")
    add("--oodd-split", default="mini", metavar="NAME", help="split (default: mini)")
    add("--oodd-env", metavar="NAMES",
        help="environments (default: those of the reference, or all)")
    add("--oodd-fail", action="append", default=[], metavar="METRIC:[+-]NUMBER[%]",
        help="fail when the metric changed by more in the direction of the sign, such as "
             "auc:-0.01 (default: when any metric is worse at all)")
    add("--oodd-two-sided", action="store_true",
        help="fail for improvements beyond the tolerance, too")
    add("--oodd-output", metavar="DIR", help="results directory to keep and to resume from")
    # fmt: on


def pytest_configure(config: pytest.Config) -> None:
    """Register the check if a detector is named."""
    if config.getoption("oodd_detector"):
        from oodd_checks.pytest_cells import Cells, Conformance  # noqa: PLC0415  see above

        conformance = any("oodd_checks.conformance" in name for name in config.args)
        config.pluginmanager.register(Conformance(config) if conformance else Cells(config))
        return
    for name in _OTHERS:
        if config.getoption(f"oodd_{name}"):
            option = f"--oodd-{name.replace('_', '-')}"
            raise pytest.UsageError(f"{option} needs --oodd-detector, the name of a detector")
