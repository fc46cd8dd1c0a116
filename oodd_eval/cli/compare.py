"""``oodd-eval compare``: results against a reference, and writing references."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from oodd_eval.cli.terminal import make_console
from oodd_eval.errors import OutputError, UsageError
from oodd_eval.names import expression
from oodd_eval.results.record import Record
from oodd_eval.results.regression import junit
from oodd_eval.results.regression import rendering as differences
from oodd_eval.results.regression.differences import Comparison, NothingInCommonError, compare
from oodd_eval.results.regression.figures import read_figures, read_records, write_reference
from oodd_eval.results.regression.tolerance import KNOWN, parse_tolerances


def run(options: argparse.Namespace) -> int:
    """Carry out ``oodd-eval compare``: 1 when the comparison fails, 5 when there is nothing in it.

    A reference is written last, so that a file can be compared with and then replaced.
    """
    if not options.against and not options.write_reference:
        raise UsageError("nothing to do: expected --against REFERENCE or --write-reference FILE")
    code = _compare(options) if options.against else 0
    if options.write_reference:
        records = _selected(read_records(options.results), options.expression)
        if not records:
            return _nothing(f"no record of {options.results} is selected: no reference written")
        write_reference(records, options.write_reference)
        if options.verbosity >= 0:
            make_console().print(f"{len(records)} cells written to {options.write_reference}")
    return code


def _compare(options: argparse.Namespace) -> int:
    wanted = expression(options.expression) if options.expression else None
    now = read_figures(options.results).selected(wanted)
    reference = read_figures(options.against).selected(wanted)
    known = dict.fromkeys((*KNOWN, *reference.metrics()))
    tolerances = parse_tolerances(options.fail, known)
    try:
        found = compare(
            now, reference, tolerances, by=options.by, two_sided=options.two_sided
        )  # fmt: skip
    except NothingInCommonError as error:
        return _nothing(str(error))
    _write(found, options)
    console = make_console()
    if options.verbosity < 0:
        console.print(differences.summary(found))
    else:
        differences.show(found, console, everything=options.verbosity > 0)
    return int(bool(found.failures))


def _write(comparison: Comparison, options: argparse.Namespace) -> None:
    for path, render in ((options.junit, junit.render), (options.markdown, differences.render)):
        if not path:
            continue
        try:
            Path(path).write_text(render(comparison), encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{path!r} cannot be written: {error.strerror}") from None


def _selected(records: Sequence[Record], text: str | None) -> list[Record]:
    wanted = expression(text) if text else None
    return [r for r in records if wanted is None or wanted(str(r.cell))]


def _nothing(message: str) -> int:
    print(f"oodd-eval: {message}", file=sys.stderr)  # noqa: T201  the program's voice
    return 5
