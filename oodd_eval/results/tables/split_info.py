"""What a split holds: sizes, lengths, onsets and returns, and the paper's Table 2 beside ours."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tabulate import tabulate

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS
from oodd_eval.data.split import AnomalousSet, EnvironmentData, Split, TrajectorySet
from oodd_eval.results.tables.tables import Table

PAPER = Path(__file__).parents[2] / "data" / "paper_tables.json"
"""The numbers of Danesh & Fern (2021), with names of `oodd_eval.data.facts`."""

Returns = Mapping[str, Mapping[str, NDArray[np.float64]]]
"""Returns of every trajectory by environment and kind: ``nominal`` or an anomaly's id."""


def describe(split: Split) -> str:
    """Return all there is to know of a split as plain text; opens and verifies every file."""
    manifest = split.manifest
    definition = manifest["definition"]
    cap = definition["episode_cap"] or "the simulator's"
    recipe = (
        f"{definition['train']} training, {definition['calibration']} calibration trajectories, "
        f"{definition['test']} test seeds; episode cap {cap}; seed base {definition['seed_base']}; "
        f"generator {manifest['generator']}"
    )
    lines = [f"split {split.name}, digest {split.digest}", recipe, f"in {split.path}"]
    returns: dict[str, dict[str, NDArray[np.float64]]] = {}
    for name in split.environments:
        data = split.environment(name)
        try:
            entry = manifest["environments"][name]
            size = (split.path / entry["file"]).stat().st_size
            lines += ["", _text(group_table(data, size, str(entry["policy"])))]
            returns[name] = collect_returns(data)
        finally:
            data.close()
    return "\n".join([*lines, "", _text(return_table(returns, paper_returns()))])


def group_table(data: EnvironmentData, size: int, policy: str) -> Table:
    """Return one row per group: trajectories, their lengths, onsets, redraws and returns.

    Parameters
    ----------
    data
        One environment.
    size
        Bytes of its file.
    policy
        Digest of the policy that acted.
    """
    header = ["group", "trajectories", "transitions", "length", "onset", "redraws", "return"]
    groups: list[TrajectorySet] = [data.train, data.calibration, data.twins]
    groups += [data.anomalous(a) for a in data.anomalies]
    title = f"{ENVIRONMENTS[data.id].title}: {size / 1e6:.2f} MB, policy {policy[:12]}"
    return Table(title, header, [_row(group) for group in groups])


def _row(group: TrajectorySet) -> list[str]:
    drawn = ["", ""]
    if isinstance(group, AnomalousSet):
        drawn = [span(group.onsets), str(int(group.redraws.sum()))]
    return [
        group.group,
        str(len(group)),
        str(int(group.lengths.sum())),
        span(group.lengths),
        *drawn,
        mean_and_deviation(group.returns),
    ]


def collect_returns(data: EnvironmentData) -> dict[str, NDArray[np.float64]]:
    """Return the returns of the test part by kind: ``nominal`` and the anomalies."""
    found = {"nominal": data.twins.returns}
    return found | {a: data.anomalous(a).returns for a in data.anomalies}


def return_table(returns: Returns, paper: Mapping[str, Mapping[str, float]]) -> Table:
    """Return the paper's Table 2: mean return by environment and anomaly, ours and the paper's.

    A capped split has shorter episodes than the paper, so its returns are smaller in magnitude.
    """
    kinds = ["nominal", *ANOMALIES]
    rows = []
    for environment, found in returns.items():
        ours = [f"{found[k].mean():.1f}" if k in found else "" for k in kinds]
        theirs = [f"{paper[environment][k]:.1f}" for k in kinds]
        title = ENVIRONMENTS[environment].title
        rows += [[title, "ours", *ours], ["", "paper", *theirs]]
    title = "Table 2: mean return of the policies, nominal and under each anomaly"
    return Table(title, ["Environment", "", *kinds], rows)


def paper_returns() -> dict[str, dict[str, float]]:
    """Return the paper's Table 2: mean return by environment and kind."""
    tables: dict[str, Any] = json.loads(PAPER.read_text(encoding="utf-8"))
    return {
        environment: {kind: float(row[kind]) for kind in ("nominal", *ANOMALIES)}
        for environment, row in tables["table2_policy_return"].items()
    }


def span(values: NDArray[np.int64]) -> str:
    """Return the range of some integers, as one number when they are equal."""
    low, high = int(values.min()), int(values.max())
    return str(low) if low == high else f"{low}..{high}"


def mean_and_deviation(values: NDArray[np.float64]) -> str:
    """Return mean and standard deviation (ddof 0)."""
    return f"{values.mean():.1f} ± {values.std():.1f}"


def _text(table: Table) -> str:
    # Numbers are formatted already; tabulate would parse them and drop zeros behind the point.
    set_up = tabulate(table.rows, table.header, "simple", disable_numparse=True)
    return f"{table.title}\n\n{set_up}"
