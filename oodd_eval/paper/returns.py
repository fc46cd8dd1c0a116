"""Table 2 from the split's own data: returns of the policies, nominal and under each anomaly.

The returns of the test part are kept in ``returns.json`` beside the records, so that the table can
be made again without the split.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS
from oodd_eval.data.split import Split
from oodd_eval.errors import ResultsError
from oodd_eval.metrics.bootstrap import bootstrap_weights, percentiles
from oodd_eval.paper import paper
from oodd_eval.paper.evidence import Estimate
from oodd_eval.results.tables.csv_tables import number
from oodd_eval.results.tables.tables import Table

FILE: Final = "returns.json"
KINDS: Final = ("nominal", *ANOMALIES)

Returns = Mapping[str, Mapping[str, Sequence[float]]]
"""Return of every test trajectory by environment and kind, ``nominal`` or an anomaly's id."""


def collect(split: Split) -> dict[str, dict[str, list[float]]]:
    """Read the returns of the test part; verifies the data on the way."""
    found: dict[str, dict[str, list[float]]] = {}
    for name in split.environments:
        data = split.environment(name)
        try:
            sets = {"nominal": data.twins} | {a: data.anomalous(a) for a in data.anomalies}
            found[name] = {kind: s.returns.tolist() for kind, s in sets.items()}
        finally:
            data.close()
    return found


def dump(returns: Returns, digest: str) -> str:
    """Return the content of ``returns.json``."""
    whole = {"schema": 1, "split_digest": digest, "returns": returns}
    return json.dumps(whole, sort_keys=True) + "\n"


def load(path: Path, digest: str) -> Returns | None:
    """Read ``returns.json``; None where it is absent or of other data.

    Raises
    ------
    ResultsError
        When it cannot be read.
    """
    try:
        whole: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        found: Returns = whole["returns"]
        same = whole["split_digest"] == digest
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ResultsError(
            f"{str(path)!r} cannot be read: {error!r}; delete it, and it will be made again"
        ) from None
    return found if same else None


def environments(returns: Returns) -> list[str]:
    """Return the environments that there are, in the order of the tables."""
    return [e for e in ENVIRONMENTS if e in returns]


def mean_return(returns: Returns, environment: str, kind: str) -> Estimate:
    """Return a mean over test seeds with its interval; undefined where it was not recorded."""
    values = np.array(returns.get(environment, {}).get(kind, []), dtype=np.float64)
    if not values.size:
        return Estimate(expected=1)
    series = _resampled_mean(environment, values)
    return Estimate(float(values.mean()), *percentiles(series), 1, 1)


def loss(returns: Returns, over: Sequence[str], weights: Mapping[str, float]) -> Estimate:
    """Return the weighted sum, over groups of anomalies, of the share of the return that is lost.

    In each environment a group's loss is (nominal - mean over its anomalies) / |nominal|, paired
    over test seeds.
    """
    values, series = [], []
    for environment in over:
        found = {k: np.array(v, dtype=np.float64) for k, v in returns.get(environment, {}).items()}
        if any(kind not in found for kind in KINDS):
            continue
        one, many = 0.0, np.zeros(1)
        for group, weight in weights.items():
            kinds = [a.id for a in ANOMALIES.values() if a.group == group]
            anomalous = np.mean([found[kind] for kind in kinds], axis=0)
            lost, nominal = found["nominal"] - anomalous, found["nominal"]
            one += weight * lost.mean() / abs(nominal.mean())
            many = many + weight * (
                _resampled_mean(environment, lost) / abs(_resampled_mean(environment, nominal))
            )
        values.append(one)
        series.append(many)
    if not values:
        return Estimate(expected=len(over))
    mean = np.mean(series, axis=0)
    return Estimate(float(np.mean(values)), *percentiles(mean), len(values), len(over))


def table(returns: Returns) -> Table:
    """Return the paper's Table 2, ours with intervals and the paper's below it.

    The policies are of the paper's kinds; ours and the authors' are not the same networks.
    """
    rows = []
    for environment in environments(returns):
        ours = [mean_return(returns, environment, kind) for kind in KINDS]
        theirs = [f"{paper.returns(environment)[kind]:.1f}" for kind in KINDS]
        title = ENVIRONMENTS[environment].title
        policy = ENVIRONMENTS[environment].policy
        rows += [[title, policy, "ours", *map(_show, ours)], ["", "", "paper", *theirs]]
    header = ["Environment", "Policy", "", "Nominal", *(a.title for a in ANOMALIES.values())]
    return Table("Mean return", header, rows, labels=3)


def numbers(returns: Returns) -> list[list[str]]:
    """Return Table 2 as lines of a CSV file, the header first."""
    lines = [["environment", "kind", "group", "value", "low", "high", "n", "paper"]]
    groups = {"nominal": ""} | {a.id: a.group for a in ANOMALIES.values()}
    for environment in environments(returns):
        for kind in KINDS:
            e = mean_return(returns, environment, kind)
            n = len(returns[environment].get(kind, []))
            digits = map(number, (e.value, e.low, e.high))
            theirs = number(float(paper.returns(environment)[kind]))
            lines.append([environment, kind, groups[kind], *digits, str(n), theirs])
    return lines


def _resampled_mean(environment: str, values: NDArray[np.float64]) -> NDArray[np.float64]:
    weights = bootstrap_weights(len(values), key=environment)
    mean: NDArray[np.float64] = np.einsum("rn,n->r", weights, values) / len(values)
    return mean


def _show(estimate: Estimate) -> str:
    if not estimate.environments:
        return "not recorded"
    return f"{estimate.value:.1f} [{estimate.low:.1f}, {estimate.high:.1f}]"
