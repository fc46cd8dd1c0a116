"""What the pytest plug-in does when asked: plan, one run of the harness, a test per cell."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from oodd_eval.data.facts import PROTOCOL
from oodd_eval.data.split import Split, load_split
from oodd_eval.errors import OoddError, UnknownNameError, UsageError
from oodd_eval.names import select
from oodd_eval.plugins.discovery import Plugins, discover
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.record import Record
from oodd_eval.results.regression.differences import Difference, compare
from oodd_eval.results.regression.figures import Conditions, FigureSet, figures_of, read_figures
from oodd_eval.results.regression.junit import message
from oodd_eval.results.regression.tolerance import KNOWN, parse_tolerances
from oodd_eval.scoring.plan import Plan, make_plan
from oodd_eval.scoring.runner import Settings, run


class Regression(Exception):  # noqa: N818  a finding, not an error of the program
    """A cell that does not come up to its reference."""


class Cells:
    """The plug-in object: it adds the tests and holds what they share.

    Parameters
    ----------
    config
        With the options of `oodd_eval.pytest_plugin`.

    Raises
    ------
    pytest.UsageError
        When the request cannot be carried out.
    """

    def __init__(self, config: pytest.Config) -> None:
        try:
            self._prepare(config.getoption)
        except OoddError as error:
            raise pytest.UsageError(f"oodd-eval: {error}") from None
        self._records: dict[str, Record] = {}
        self._differences: dict[str, list[Difference]] = {}

    def _prepare(self, option: Callable[[str], Any]) -> None:
        self.plugins = discover()
        names = _detectors(option("oodd_detector"), self.plugins)
        self.split = load_split(option("oodd_split"))
        self.output: str | None = option("oodd_output")
        self.two_sided = bool(option("oodd_two_sided"))
        path = option("oodd_reference")
        reference = _of_split(read_figures(path), self.split, names) if path else None
        self.tolerances = parse_tolerances(
            option("oodd_fail"), [*KNOWN, *(reference.metrics() if reference else ())]
        )
        self.plan = _plan(self.plugins, self.split, names, option("oodd_env"), reference)
        planned = set(self.plan.cells)
        self.reference = reference.selected(planned.__contains__) if reference else None
        if reference and self.reference and not self.reference.boards:
            raise UsageError(
                f"{reference.where} has no cell of {', '.join(names)} in "
                f"{option('oodd_env') or 'these environments'}: name others with --oodd-env"
            )

    def pytest_report_header(self) -> str:
        """Say what is checked, and against what."""
        where = f"against {self.reference.where}" if self.reference else "without a reference"
        return f"oodd-eval: {len(self.plan.cells)} cells in {len(self.plan.units)} fits, {where}"

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(
        self, session: pytest.Session, items: list[pytest.Item]
    ) -> None:
        """Add the tests before others choose among them."""
        parent = CellCollector.from_parent(session, name="oodd-eval", nodeid="oodd-eval", own=self)
        found = parent.collect()
        # What pytest would say of tests in a file, so that reports count these too.
        for item in found:
            session.ihook.pytest_itemcollected(item=item)
        report = pytest.CollectReport(parent.nodeid, "passed", None, [*found])
        session.ihook.pytest_collectreport(report=report)
        items += found

    def check(self, cell: str, session: pytest.Session) -> None:
        """Check one cell; the first call runs the harness for all chosen ones.

        Raises
        ------
        Regression
            When it fails, with what there is to say.
        """
        if not self._records:
            self._run({item.name for item in session.items if isinstance(item, CellItem)})
        record = self._records[cell]
        if self.reference is None:
            if not record.ok:
                raise Regression(f"{record.status}: {record.reason}")
            return
        found = self._differences[cell]
        if any(d.verdict == "new" for d in found):
            pytest.skip(f"not in {self.reference.where}: nothing to compare with")
        if failures := [d for d in found if d.fails]:
            raise Regression("\n".join(_explained(record, failures, self.reference.where)))

    def _run(self, chosen: set[str]) -> None:
        plan = self.plan.matching(chosen.__contains__)
        results = ResultsDirectory(self.output) if self.output else None
        done = run(plan, self.split, self.plugins, Settings(), results)
        if done.interrupted:
            raise KeyboardInterrupt
        self._records = {str(r.cell): r for r in done.records}
        if self.reference is None:
            return
        reference = self.reference.selected(chosen.__contains__)
        self._differences = {cell: [] for cell in self._records}
        if not reference.boards:
            # Every chosen cell is new.
            reference = self.reference
        comparison = compare(
            figures_of(done.records), reference, self.tolerances, two_sided=self.two_sided
        )
        for d in comparison.differences:
            self._differences.setdefault(f"{d.split}/{d.place}::{d.detector}", []).append(d)


class CellCollector(pytest.Collector):
    """The parent of the tests, which stand in no file."""

    def __init__(self, *, own: Cells, **settings: Any) -> None:
        super().__init__(**settings)
        self.own = own

    def collect(self) -> list[pytest.Item]:
        """Return a test per cell."""
        return [CellItem.from_parent(self, name=cell) for cell in self.own.plan.cells]


class CellItem(pytest.Item):
    """The test of one cell."""

    parent: CellCollector

    def runtest(self) -> None:
        """Raise `Regression` when the cell does not come up to its reference."""
        self.parent.own.check(self.name, self.session)

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        """Return the message alone: the traceback would lead through this module only."""
        if isinstance(excinfo.value, Regression | OoddError):
            return str(excinfo.value)
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, int | None, str]:
        """Return how the test is headed in the report."""
        return self.path, None, self.name


def _detectors(patterns: str, plugins: Plugins) -> list[str]:
    try:
        return select("detector", patterns, plugins.offers)
    except UnknownNameError as error:
        broken = "; ".join(f"plug-in {b.plugin!r} is broken: {b.reason}" for b in plugins.broken)
        raise UsageError(f"{error}; {broken}" if broken else str(error)) from None


def _of_split(reference: FigureSet, split: Split, names: list[str]) -> FigureSet:
    """Return a reference's cells of these detectors and of this split as it is here."""
    key = split.digest, PROTOCOL, None
    boards = {c: cells for c, cells in reference.boards.items() if c.key == key}
    if not boards:
        here = Conditions(split.name, *key).text
        raise UsageError(
            f"nothing in common: {reference.where} has "
            f"{'; '.join(c.text for c in reference.boards) or 'no cells'}, expected {here}"
        )
    found = FigureSet(reference.where, boards).selected(lambda cell: _detector(cell) in names)
    if not found.boards:
        known = sorted({_detector(cell) for cells in boards.values() for cell in cells})
        raise UsageError(
            f"{reference.where} has no cell of {', '.join(names)}, only of {', '.join(known)}: "
            "write one with oodd-eval compare DIR --write-reference FILE"
        )
    return found


def _detector(cell: str) -> str:
    return cell.partition("::")[2].partition("[")[0]


def _plan(
    plugins: Plugins, split: Split, names: list[str], envs: str | None, reference: FigureSet | None
) -> Plan:
    """Plan what the reference has: its environments, horizons and seeds, at default parameters."""
    cells = [cell for board in reference.boards.values() for cell in board] if reference else []
    labels = {cell.partition("::")[2] for cell in cells}
    settings = [m for label in labels if (m := re.search(r"\[h=(\d+),seed=(\d+)\]$", label))]
    if reference and not settings:
        raise UsageError(
            f"{reference.where} has only cells with parameters of their own, such as {cells[0]}; "
            "here detectors run with their defaults"
        )
    found = {cell.rsplit("::", 1)[0].split("/")[-2] for cell in cells}
    plan = make_plan(
        plugins,
        split=split.name,
        split_digest=split.digest,
        detectors=names,
        environments=select("environment", envs, split.environments) if envs
        else [e for e in split.environments if not reference or e in found],
        horizons=sorted({int(m[1]) for m in settings}) or [1],
        seeds=sorted({int(m[2]) for m in settings}) or [0],
    )  # fmt: skip
    return plan.matching(lambda cell: not reference or cell.partition("::")[2] in labels)


def _explained(record: Record, failures: list[Difference], where: str) -> Iterator[str]:
    """Yield the lines of a failing test."""
    if record.ok:
        yield from (message(d) for d in failures)
    else:
        yield f"{record.status}: {record.reason}"
    yield f"the reference is {where}; to run this cell alone:"
    yield (
        f"oodd-eval run --detector {record.detector} --env {record.environment} "
        f"--anomaly {record.anomaly} --split {record.split} --horizon {record.horizon} "
        f"--seed {record.seed}"
    )
