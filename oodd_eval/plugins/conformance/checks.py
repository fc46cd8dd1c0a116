"""All checks, in the order in which they are carried out."""

from __future__ import annotations

import time
import traceback
from collections.abc import Iterable, Iterator
from typing import Final

from oodd_eval.plugins.conformance import (
    checks_causality,
    checks_contract,
    checks_edges,
    checks_manners,
    checks_repeat,
    checks_saving,
    checks_scores,
)
from oodd_eval.plugins.conformance.bench import Bench, CheckFailedError, CheckSkipped
from oodd_eval.plugins.conformance.kit import Check
from oodd_eval.plugins.conformance.report import Result
from oodd_eval.plugins.isolation.processes import printable

CHECKS: Final = {
    check.name: check
    for module in (
        checks_contract,
        checks_scores,
        checks_repeat,
        checks_causality,
        checks_edges,
        checks_saving,
        checks_manners,
    )
    for check in module.CHECKS
}
"""The checks by name."""


def carry_out(bench: Bench, checks: Iterable[Check]) -> Iterator[Result]:
    """Carry out some checks on one bench, each when its result is asked for."""
    for check in checks:
        start = time.perf_counter()
        status, message, detail = "passed", "", ""
        try:
            check.carry_out(bench)
        except CheckFailedError as error:
            status, message = "failed", printable(str(error))
            if error.__cause__:
                lines = "".join(traceback.format_exception(error.__cause__)).splitlines()
                detail = "\n".join(printable(line) for line in lines)
        except CheckSkipped as skip:
            status, message = "skipped", str(skip)
        yield Result(check.name, status, message, time.perf_counter() - start, detail)
