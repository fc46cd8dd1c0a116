"""The frozen policies beside the nominal returns of the paper's Table 2."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.results.tables.tables import Table


def policy_table(facts: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return one row per policy: return, the paper's return, its share of that, and a flag.

    Parameters
    ----------
    facts
        Provenance by environment, as `oodd_eval.data.simulate.policies.provenance` returns it for a
        policy that `oodd_eval.data.simulate.train.freeze_trained` wrote.

    Returns
    -------
    A table whose last column is empty from 95 % of the paper's return on, ``below target`` under
    95 % and ``below 80 %`` under 80 %. The share is that of
    `oodd_eval.data.simulate.train.share_of_paper`; the return is mean ± standard deviation.
    """
    header = ["Environment", "algorithm", "steps", "return", "episodes", "paper", "share", "flag"]
    rows = []
    for environment, found in facts.items():
        flag = "" if found["finished"] else "below 80 %" if found["flagged"] else "below target"
        rows.append([
            ENVIRONMENTS[environment].title,
            str(found["algorithm"]),
            str(found["steps"]),
            f"{found['mean_return']:.1f} ± {found['std_return']:.1f}",
            str(found["episodes"]),
            f"{found['paper_return']:.1f}",
            f"{100 * found['share_of_paper']:.1f} %",
            flag,
        ])  # fmt: skip
    return Table("Nominal return of the frozen policies (paper: Table 2)", header, rows)
