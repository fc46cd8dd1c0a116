"""The paper's digits beside ours, as fractions and steps; NaN where it prints none."""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from oodd_eval.data.facts import GROUPS
from oodd_eval.paper.experiments import MODELS, Experiment, Scope, Series
from oodd_eval.results.record import NAN

FILE: Final = Path(__file__).parents[1] / "data" / "paper_tables.json"

PERCENT: Final = 100.0
"""The paper prints AUCs in percent; here they are fractions."""


@functools.cache
def tables() -> Mapping[str, Any]:
    """Return the paper's tables as they are in the file."""
    read: Mapping[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))
    return read


def digit(
    experiment: Experiment, series: Series, environment: str, scope: Scope, metric: str
) -> float:
    """Return what the paper prints for one of our numbers.

    RIQN's mean over all anomalies at Δ = 1 and 10, which its figures show, is in its Table 4; the
    models' means over environments follow from its Table 5.
    """
    if experiment.id == "table-5":
        return _of_table_5(series, environment, scope.id, metric)
    if metric != "auc":
        return NAN
    if experiment.id == "figure-models":
        by_group = [scope.id] if scope.id in GROUPS else list(GROUPS)
        found = [_of_table_5(series, e, g, metric) for e in experiment.environments
                 for g in by_group]  # fmt: skip
        return float(np.mean(found)) if series.setups[0].horizon == 1 else NAN
    if scope.id != "all" or len(series.setups) != 1:
        return NAN
    setup = series.setups[0]
    parameters, horizon = dict(setup.parameters), str(setup.horizon)
    found_in: Mapping[str, Any]
    if experiment.id == "table-3":
        found_in, key = tables()["table3_memory_auc"], setup.detector
    elif setup.detector == "riqn" and "samples" not in parameters:
        found_in, key = tables()["table4_ensemble_auc"], str(parameters.get("members", 5))
    else:
        return NAN
    value = found_in.get(environment, {}).get(horizon, {}).get(key)
    return NAN if value is None else float(value) / PERCENT


def mean_digit(experiment: Experiment, series: Series, scope: Scope, metric: str) -> float:
    """Return the mean of the paper's digits; NaN unless it prints one for every environment."""
    found = [digit(experiment, series, e, scope, metric) for e in experiment.environments]
    return float(np.mean(found))


def returns(environment: str) -> Mapping[str, Any]:
    """Return a row of Table 2 by kind, ``nominal`` and the anomalies."""
    row: Mapping[str, Any] = tables()["table2_policy_return"][environment]
    return row


def _of_table_5(series: Series, environment: str, group: str, metric: str) -> float:
    """Return a number of Table 5: a model's, or the mean over models."""
    by_metric = tables()["table5_groups_delta1"].get(environment, {})
    if metric not in by_metric or group not in by_metric[metric]:
        return NAN
    detectors = [setup.detector for setup in series.setups]
    row = by_metric[metric][group]
    if detectors == list(MODELS):
        value = float(row["avg"])
    elif len(detectors) == 1 and detectors[0] in row:
        value = float(row[detectors[0]])
    else:
        return NAN
    return value / PERCENT if metric == "auc" else value
