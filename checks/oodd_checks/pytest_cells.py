"""The tests that the pytest plug-in adds: one per cell, which share one run of the harness.

`Conformance` tells the conformance checks, whose tests are collected as any others, the detector.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from oodd_checks.conformance.trial import Trial
from oodd_eval.data.facts import PROTOCOL
from oodd_eval.data.files import refuse_inputs
from oodd_eval.data.split import Split, load_split
from oodd_eval.errors import OoddError, UnknownNameError, UsageError
from oodd_eval.metrics.catalogue import NAMES
from oodd_eval.names import counted, select
from oodd_eval.plugins.discovery import ACTIONS, Plugins, discover
from oodd_eval.results.board import Conditions
from oodd_eval.results.comparison import (
    Difference,
    RecordSet,
    compare,
    parse_tolerances,
    read_record_set,
)
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.record import Record
from oodd_eval.results.report import message
from oodd_eval.scoring.executors import RunSettings
from oodd_eval.scoring.plan import Plan, make_plan
from oodd_eval.scoring.runner import run


class Regression(Exception):  # noqa: N818  a finding, not an error of the program
    """A cell that does not come up to its reference."""


class Conformance:
    """The plug-in object that names the detectors of the shipped conformance tests."""

    def __init__(self, config: pytest.Config) -> None:
        plugins = discover()
        with _usage_errors():
            names = _detectors(config.getoption("oodd_detector"), plugins)
        # The episodes of checks have actions.
        offers = [plugins.taking_actions(plugins.offer(name), {}, names)[0] for name in names]
        self._trials = {offer.spec.name: Trial(offer.spec) for offer in offers}

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Give the shipped tests every detector."""
        if metafunc.module.__name__.startswith("oodd_checks.conformance."):
            trials = self._trials
            metafunc.parametrize("detector", trials.values(), ids=[*trials], scope="module")


class Cells:
    """The plug-in object: it adds the tests and holds what they share."""

    def __init__(self, config: pytest.Config) -> None:
        self._option = config.getoption
        self._records: dict[str, Record] = {}
        self._differences: dict[str, list[Difference]] = {}
        with _usage_errors():
            self._prepare(config.getoption)

    def _prepare(self, option: Callable[[str], Any]) -> None:
        self.plugins = discover()
        names = _detectors(option("oodd_detector"), self.plugins)
        self.split = load_split(option("oodd_split"))
        environments = select("environment", option("oodd_env") or "all", self.split.environments)
        if output := option("oodd_output"):
            read = [self.split.path, Path(option("oodd_reference") or self.split.path)]
            refuse_inputs(Path(output), read, "--oodd-output")
        self.reference, parameters = None, {}
        if path := option("oodd_reference"):
            specs = [self.plugins.offer(name).spec for name in names]
            names = list(dict.fromkeys(n for s in specs for n in (s.name, s.with_actions) if n))
            self.reference = _comparable(read_record_set(path), self.split, names, environments)
            # Of a detector that takes actions where there are any, it says which rows are run.
            names = [n for n in names if n in {r.detector for r in self.reference.records}]
            parameters = {
                f"{s.name}.{ACTIONS}": "no" for s in specs if s.with_actions and s.name in names
            }
            if not option("oodd_env"):
                covered = {record.environment for record in self.reference.records}
                environments = [name for name in environments if name in covered]
        metrics = self.reference.metrics() if self.reference else ()
        self.tolerances = parse_tolerances(option("oodd_fail"), [*NAMES, *metrics])
        self.plan = _plan(self.plugins, self.split, names, environments, self.reference, parameters)
        self.names = list(map(str, self.plan.cells))

    def pytest_report_header(self) -> str:
        """Return a line on what is checked, and against what."""
        reference = f"against {self.reference.where}" if self.reference else "without a reference"
        cells = counted(len(self.names), "cell(s)")
        return f"oodd-eval: {cells} in {counted(len(self.plan.units), 'fit(s)')}, {reference}"

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, session: pytest.Session, items: list[Any]) -> None:
        """Add the tests before other plug-ins select among them."""
        parent = CellCollector.from_parent(session, name="oodd-eval", nodeid="oodd-eval")
        parent.cells = self
        tests = parent.collect()
        # pytest calls these hooks for tests in files; with them, reports count these tests, too.
        for item in tests:
            session.ihook.pytest_itemcollected(item=item)
        report = pytest.CollectReport(parent.nodeid, "passed", None, [*tests])
        session.ihook.pytest_collectreport(report=report)
        items += tests

    def check(self, cell: str, session: pytest.Session) -> None:
        """Raise `Regression` when a cell fails; the first call runs all selected ones."""
        if not self._records:
            self.run({item.name for item in session.items if isinstance(item, CellItem)})
        record, differences = self._records[cell], self._differences.get(cell, [])
        if self.reference is None:
            if not record.ok:
                raise Regression(f"{record.status}: {record.reason}")
        elif any(d.verdict == "new" for d in differences):
            pytest.skip(f"not in {self.reference.where}: nothing to compare with")
        elif failures := [d for d in differences if d.fails]:
            raise Regression(_explained(record, failures, self.reference.where))

    def run(self, chosen: set[str]) -> None:
        """Run the harness for some cells and compare them with the reference."""
        results = ResultsDirectory(output) if (output := self._option("oodd_output")) else None
        plan = self.plan.matching(chosen.__contains__)
        done = run(plan, self.split, self.plugins, RunSettings(), results)
        if done.interrupted:
            raise KeyboardInterrupt
        self._records = {str(r.cell): r for r in done.records}
        if self.reference is None:
            return
        reference = self.reference.selected(chosen.__contains__)
        against = reference if reference.boards else self.reference  # else every cell is new
        now, two_sided = RecordSet.of(done.records), bool(self._option("oodd_two_sided"))
        for d in compare(now, against, self.tolerances, two_sided=two_sided).differences:
            self._differences.setdefault(str(d), []).append(d)


@contextmanager
def _usage_errors() -> Iterator[None]:
    try:
        yield
    except OoddError as error:
        raise pytest.UsageError(f"oodd-eval: {error}") from None


class CellCollector(pytest.Collector):
    """The parent of the tests, which stand in no file."""

    cells: Cells

    def collect(self) -> list[pytest.Item]:
        """Return a test per cell."""
        return [CellItem.from_parent(self, name=cell) for cell in self.cells.names]


class CellItem(pytest.Item):
    """The test of one cell."""

    parent: CellCollector

    def runtest(self) -> None:
        """Raise `Regression` when the cell does not come up to its reference."""
        self.parent.cells.check(self.name, self.session)

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        """Return the message alone: the traceback would lead through this module only."""
        if isinstance(excinfo.value, Regression | OoddError):
            return str(excinfo.value)
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, int | None, str]:
        """Return the heading of the test in the report."""
        return self.path, None, self.name


def _detectors(patterns: str, plugins: Plugins) -> list[str]:
    try:
        return select("detector", patterns, plugins.offers)
    except UnknownNameError as error:
        broken = (f"plug-in {b.plugin!r} is broken: {b.reason}" for b in plugins.broken)
        raise UsageError("; ".join([str(error), *broken])) from None


def _comparable(
    reference: RecordSet, split: Split, detectors: list[str], environments: list[str]
) -> RecordSet:
    """Return the reference cells whose split digest matches, of detectors at their defaults."""
    conditions = Conditions(split.name, split.digest, PROTOCOL, None)
    records = list(reference.boards.get(conditions, {}).values())
    selected = [r for r in records if r.detector in detectors and r.environment in environments]
    if plain := [r for r in selected if not r.overrides]:
        return RecordSet.of(plain, reference.where)
    has = "; ".join(map(str, reference.boards)) or "no cells"
    if records:
        has = f"only others, such as {(selected or records)[0].cell}"
    raise UsageError(
        f"nothing in common: {reference.where} has {has}, expected cells of {conditions}, of "
        f"{', '.join(detectors)} with default parameters in {', '.join(environments)}: name "
        "others, or write a reference with oodd-eval compare DIR --write-reference FILE"
    )


def _plan(
    plugins: Plugins,
    split: Split,
    detectors: list[str],
    environments: list[str],
    reference: RecordSet | None,
    parameters: Mapping[str, str],
) -> Plan:
    """Plan what a reference has: its horizons and seeds, at default parameters."""
    cells = [record.cell for record in reference.records] if reference else []
    plan = make_plan(
        plugins,
        split=split,
        detectors=detectors,
        environments=environments,
        horizons=sorted({cell.setting.horizon for cell in cells}) or [1],
        seeds=sorted({cell.seed for cell in cells}) or [0],
        parameters=parameters,
    )
    labels = {cell.label for cell in cells}
    selected = {str(cell) for cell in plan.cells if not reference or cell.label in labels}
    return plan.matching(selected.__contains__)


def _explained(record: Record, failures: list[Difference], reference: str) -> str:
    reason = "\n".join(map(message, failures)) if record.ok else f"{record.status}: {record.reason}"
    command = (
        f"oodd-eval run --detector {record.detector} --env {record.environment} "
        f"--anomaly {record.condition} --split {record.split} --horizon {record.horizon} "
        f"--seed {record.seed}"
    )
    return f"{reason}\nthe reference is {reference}; to run this cell alone:\n{command}"
