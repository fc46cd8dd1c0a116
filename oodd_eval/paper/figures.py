"""Which figures there are: the numbers of an experiment, arranged as panels of dots."""

from __future__ import annotations

from collections.abc import Sequence

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS
from oodd_eval.paper.evidence import Estimate
from oodd_eval.paper.experiments import Experiment
from oodd_eval.paper.numbers import MEAN, Number, Numbers
from oodd_eval.paper.plots import Dots, Figure, Panel
from oodd_eval.paper.returns import KINDS, Returns, environments, mean_return
from oodd_eval.results.record import NAN
from oodd_eval.results.tables.tables import PERCENT, TITLES

SHORT = {"calibration": "calibr.", "components": "compon.", "shutdown": "shutd.",
         "wind-l2r": "wind →", "wind-r2l": "wind ←", "all": "mean"}  # fmt: skip
"""Labels of anomalies that fit below an axis."""

AUCS = ("auc", "auc_matched")
DRAWN = (*AUCS, "delay", "delay_censored", "far")
"""Metrics that are drawn; the others are in the tables."""


def figures(experiment: Experiment, numbers: Numbers) -> dict[str, Figure]:
    """Return an experiment's figures by file name; none where nothing of it was run."""
    if all(not n.estimate.environments for n in numbers.values()):
        return {}
    if experiment.rows == "mean":
        return {experiment.id: _means(experiment, numbers)}
    if experiment.across == "scopes":
        return {
            experiment.id + ("-matched" if metric == "auc_matched" else ""): _by_environment(
                experiment, numbers, metric
            )
            for metric in (*experiment.metrics, *experiment.beyond)
            if metric in AUCS
        }
    return {experiment.id: _by_metric(experiment, numbers)}


def _by_environment(experiment: Experiment, numbers: Numbers, metric: str) -> Figure:
    """Return a panel per environment: anomalies along the axis, a colour per setting."""
    categories = tuple(SHORT.get(s.id, s.id) for s in experiment.scopes)
    panels = []
    for row in _rows(experiment):
        series = tuple(
            _dots(s.label, [numbers[row, s.label, c.id, metric] for c in experiment.scopes])
            for s in experiment.series
        )
        last = len(categories) - 1
        panels.append(Panel(_row(row), _unit(metric), categories, series, _chance(metric), last))
    title = f"{experiment.title}: {TITLES[metric]}"
    return Figure(title, tuple(panels), columns=2, width=5.0, height=2.05)


def _by_metric(experiment: Experiment, numbers: Numbers) -> Figure:
    """Return a panel per metric and scope: environments along the axis, a colour per series.

    Labels such as ``"Δ = 1: RIQN"`` put what stands before the colon into panels of their own.
    """
    rows = _rows(experiment)
    shown = [m for m in (*experiment.metrics, *experiment.beyond) if m in DRAWN]
    series = [s for s in experiment.series if len(s.setups) == 1]
    settings = list(dict.fromkeys(s.label.rpartition(": ")[0] for s in series))
    panels = []
    for metric in shown:
        for scope in experiment.scopes:
            for setting in settings:
                dots = tuple(
                    _dots(label, [numbers[row, s.label, scope.id, metric] for row in rows])
                    for s in series
                    for before, _, label in [s.label.rpartition(": ")]
                    if before == setting
                )
                of = f", {scope.id} anomalies" if len(experiment.scopes) > 1 else ""
                at = f", {setting}" if setting else ""
                panels.append(
                    Panel(
                        TITLES[metric] + of + at, _unit(metric), tuple(map(_row, rows)), dots,
                        _chance(metric), len(rows) - 1,
                    )
                )  # fmt: skip
    columns = len(experiment.scopes) * len(settings)
    width = 9.6 / columns
    return Figure(experiment.title, tuple(panels), columns, width, height=2.3, share="row")


def _means(experiment: Experiment, numbers: Numbers) -> Figure:
    """Return a panel per metric: scopes and horizons along the axis, a colour per model."""
    horizons = list(dict.fromkeys(s.label.partition(": ")[0] for s in experiment.series))
    models = list(dict.fromkeys(s.label.partition(": ")[2] for s in experiment.series))
    panels = []
    for metric in (*experiment.metrics, *experiment.beyond):
        for scope in experiment.scopes:
            series = tuple(
                _dots(model, [numbers[MEAN, f"{h}: {model}", scope.id, metric] for h in horizons])
                for model in models
            )
            title = f"{TITLES[metric]}, {scope.title.lower()}"
            panels.append(Panel(title, _unit(metric), tuple(horizons), series, _chance(metric)))
    return Figure(
        experiment.title, tuple(panels), columns=len(experiment.scopes), width=3.3, height=2.5
    )


def returns_figure(returns: Returns, paper: Sequence[Sequence[float]]) -> Figure:
    """Return Table 2 as changes in percent of the nominal return, ours and the paper's.

    Parameters
    ----------
    returns
        Of the split.
    paper
        The paper's returns by environment of `returns` in order, and by kind.
    """
    kinds = KINDS[1:]
    categories = tuple(SHORT.get(a, a) for a in ANOMALIES)
    panels = []
    for environment, theirs in zip(environments(returns), paper, strict=True):
        nominal = mean_return(returns, environment, "nominal").value
        found = [mean_return(returns, environment, kind) for kind in kinds]
        scale = 100 / abs(nominal)
        ours = Dots(
            "ours, with intervals of the mean under the anomaly",
            tuple(scale * (e.value - nominal) for e in found),
            tuple(scale * (e.low - nominal) for e in found),
            tuple(scale * (e.high - nominal) for e in found),
            tuple(100 * (x - theirs[0]) / abs(theirs[0]) for x in theirs[1:]),
        )
        panels.append(Panel(_row(environment), "change in %", categories, (ours,), 0.0))
    title = "Change of the policies' return under each anomaly, % of the nominal return"
    return Figure(title, tuple(panels), columns=2, width=4.6, height=2.0, share="none")


def _dots(label: str, numbers: Sequence[Number]) -> Dots:
    """Return a series; a mean that lacks environments is left out, beside others it would mislead.

    Tables have it, and say so.
    """
    unit = 100.0 if numbers[0].metric in PERCENT else 1.0
    run = [Estimate() if n.estimate.partial else n.estimate for n in numbers]
    return Dots(
        label,
        tuple(unit * e.value for e in run),
        tuple(unit * e.low for e in run),
        tuple(unit * e.high for e in run),
        tuple(unit * n.paper for n in numbers),
    )


def _rows(experiment: Experiment) -> list[str]:
    return [*experiment.environments, MEAN]


def _row(row: str) -> str:
    return "Mean" if row == MEAN else ENVIRONMENTS[row].title


def _unit(metric: str) -> str:
    if metric in PERCENT:
        return f"{TITLES[metric]} (%)"
    return "steps" if metric.startswith("delay") else "rate per step"


def _chance(metric: str) -> float:
    return 50.0 if metric in PERCENT else NAN
