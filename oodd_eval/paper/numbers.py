"""The numbers of an experiment, computed once, and laid out as tables and as lines of CSV."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.paper import paper
from oodd_eval.paper.evidence import Estimate, Evidence, Term
from oodd_eval.paper.experiments import Experiment, Scope, Series
from oodd_eval.results.record import NAN
from oodd_eval.results.tables.csv_tables import number as digits
from oodd_eval.results.tables.tables import PERCENT, TITLES, Table
from oodd_eval.results.tables.tables import number as plain

MEAN: Final = "mean"
"""Name of the row of means over environments."""

NOT_RUN: Final = "not run"


@dataclass(frozen=True, slots=True)
class Number:
    """One number of an experiment: ours with its interval, and the paper's or NaN."""

    environment: str
    series: Series
    scope: Scope
    metric: str
    estimate: Estimate
    paper: float = NAN


Numbers = dict[tuple[str, str, str, str], Number]
"""By environment (or `MEAN`), label of the series, id of the scope, and metric."""


def compute(experiment: Experiment, evidence: Evidence) -> Numbers:
    """Return every number of an experiment; what was not run is there, without a value."""
    found: Numbers = {}
    same = experiment.setups if experiment.same_seeds else []
    for row in _rows(experiment):
        environments = experiment.environments if row == MEAN else (row,)
        for series in experiment.series:
            for scope in experiment.scopes:
                for metric in (*experiment.metrics, *experiment.beyond):
                    weight = 1 / len(series.setups)
                    terms = [Term(weight, s, scope.anomalies, metric) for s in series.setups]
                    estimate = evidence.combine(terms, environments, same)
                    theirs = (
                        paper.mean_digit(experiment, series, scope, metric)
                        if row == MEAN
                        else paper.digit(experiment, series, row, scope, metric)
                    )
                    key = row, series.label, scope.id, metric
                    found[key] = Number(row, series, scope, metric, estimate, theirs)
    return found


def layout(experiment: Experiment, numbers: Numbers, metrics: Sequence[str]) -> list[Table]:
    """Set numbers out as the paper does, its digits below ours.

    Series side by side: a table per scope, rows by environment and metric. Scopes side by side: a
    table per metric, rows by environment and series.
    """
    if experiment.across == "series":
        return [_by_series(experiment, numbers, scope, metrics) for scope in experiment.scopes]
    return [_by_scope(experiment, numbers, metric) for metric in metrics]


def _by_series(
    experiment: Experiment, numbers: Numbers, scope: Scope, metrics: Sequence[str]
) -> Table:
    rows: list[list[str]] = []
    for row in _rows(experiment):
        for i, metric in enumerate(metrics):
            line = [numbers[row, s.label, scope.id, metric] for s in experiment.series]
            first = [_row_title(row) if i == 0 else "", title_of(metric)]
            rows += _ours_and_theirs(first, line)
    header = ["Environment", "Result", "", *(s.label for s in experiment.series)]
    return Table(scope.title, header, rows, labels=3)


def _by_scope(experiment: Experiment, numbers: Numbers, metric: str) -> Table:
    rows: list[list[str]] = []
    for row in _rows(experiment):
        for i, series in enumerate(experiment.series):
            line = [numbers[row, series.label, s.id, metric] for s in experiment.scopes]
            rows += _ours_and_theirs([_row_title(row) if i == 0 else "", series.label], line)
    header = ["Environment", "Setting", "", *(s.title for s in experiment.scopes)]
    return Table(title_of(metric), header, rows, labels=3)


def _ours_and_theirs(labels: list[str], line: Sequence[Number]) -> Iterator[list[str]]:
    yield [*labels, "ours", *(show(n.estimate, n.metric) for n in line)]
    if not all(math.isnan(n.paper) for n in line):
        theirs = ["" if math.isnan(n.paper) else plain(n.paper, n.metric) for n in line]
        yield ["", "", "paper", *theirs]


def show(estimate: Estimate, metric: str) -> str:
    """Return an estimate as printed: what failed or was not run says so and is never a number."""
    if estimate.state:
        return estimate.state
    if not estimate.environments:
        return NOT_RUN
    text = plain(estimate.value, metric)
    if not math.isnan(estimate.low):
        text += f" [{plain(estimate.low, metric)}, {plain(estimate.high, metric)}]"
    if estimate.partial:
        text += f" ({estimate.environments} of {estimate.expected})"
    return text


def title_of(metric: str) -> str:
    """Return a metric's name as printed, with its unit where it is percent."""
    base, _, suffix = metric.partition("_at_")
    at = {"": "", "1pct": " at 1 % FAR", "01pct": " at 0.1 % FAR"}[suffix]
    return TITLES[base] + at + (" (%)" if base in PERCENT else "")


def csv_lines(numbers: Numbers) -> list[list[str]]:
    """Return the numbers as lines of a CSV file, the header first; what was not run is empty."""
    header = ["environment", "series", "detectors", "horizon", "parameters", "anomalies", "metric",
              "value", "low", "high", "environments", "seeds", "state", "paper"]  # fmt: skip
    lines = [header]
    for n in numbers.values():
        first, e = n.series.setups[0], n.estimate
        detectors = "+".join(setup.detector for setup in n.series.setups)
        parameters = json.dumps(dict(first.parameters)) if first.parameters else ""
        lines.append([
            n.environment, n.series.label, detectors, str(first.horizon), parameters, n.scope.id,
            n.metric, *(digits(x) for x in (e.value, e.low, e.high)), str(e.environments),
            str(e.seeds), e.state or ("" if e.environments else NOT_RUN), digits(n.paper),
        ])  # fmt: skip
    return lines


def seeds_used(numbers: Numbers) -> dict[str, list[int]]:
    """Return by series the numbers of detector seeds that its numbers rest on, ascending."""
    used: dict[str, set[int]] = {}
    for n in numbers.values():
        if n.estimate.seeds:
            used.setdefault(n.series.label, set()).add(n.estimate.seeds)
    return {label: sorted(seeds) for label, seeds in used.items()}


def without_intervals(numbers: Numbers) -> Numbers:
    """Return the numbers without their intervals, for a narrow table."""
    return {
        key: replace(n, estimate=replace(n.estimate, low=NAN, high=NAN))
        for key, n in numbers.items()
    }


def _rows(experiment: Experiment) -> list[str]:
    own = [] if experiment.rows == "mean" else list(experiment.environments)
    return own if experiment.rows == "environments" else [*own, MEAN]


def _row_title(row: str) -> str:
    return "Mean" if row == MEAN else ENVIRONMENTS[row].title
