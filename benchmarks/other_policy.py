"""Compare rows on the episodes of two policies of the same environments.

    python benchmarks/other_policy.py --first DIR ... --second DIR ...

takes results directories of `oodd-eval run`, one an environment, in the same order. Printed are
matched AUC by environment, its mean, and the mean share of episodes found within 100 rows where at
most 5 % of nominal episodes have an alarm, with the first policy → the second (%); then how much
each moves in an environment, and the rank correlation (Spearman) of the rows.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr
from tabulate import tabulate

from oodd_eval.metrics.catalogue import HEADLINE
from oodd_eval.results.board import boards
from oodd_eval.results.directory import ResultsDirectory

METRICS = {"matched AUC": "auc_matched", "found": f"found_within_100_{HEADLINE}"}


def means(directories, metric):
    """Return the environments, and a row's mean in each (%), by the row."""
    environments, by_row = [], {}
    for directory in directories:
        (board,) = boards(ResultsDirectory(directory).records())
        (environment,) = board.environments
        environments.append(environment)
        for row in board.entries:
            value = board.mean(row, [environment], board.anomalies, metric).value
            by_row.setdefault(str(row), []).append(100 * value)
    return environments, {row: np.array(x) for row, x in by_row.items()}


def compared(first, second):
    """Return the environments, and by metric and row an array (2, environments)."""
    tables = {}
    for metric in METRICS.values():
        (environments, before), (others, after) = means(first, metric), means(second, metric)
        if environments != others or before.keys() != after.keys():
            raise SystemExit(
                f"the first directories have {', '.join(environments)} and the rows "
                f"{', '.join(before)}; the second {', '.join(others)} and {', '.join(after)}: "
                "give directories of the same environments, in the same order, with the same rows"
            )
        tables[metric] = {row: np.stack([before[row], after[row]]) for row in before}
    return environments, tables


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=Path, nargs="+", required=True)
    parser.add_argument("--second", type=Path, nargs="+", required=True)
    options = parser.parse_args(arguments)
    environments, tables = compared(options.first, options.second)
    aucs, shares = tables.values()
    rows = []
    for row in sorted(aucs, key=lambda row: -aucs[row][0].mean()):
        pairs = [*aucs[row].T, aucs[row].mean(axis=1), shares[row].mean(axis=1)]
        rows.append([row, *(f"{before:.1f} → {after:.1f}" for before, after in pairs)])
    print(tabulate(rows, ["row", *environments, "mean", "found"], tablefmt="github"))
    lines = []
    for title, metric in METRICS.items():
        values = np.stack(list(tables[metric].values()))  # rows, policies, environments
        for i, environment in enumerate(environments):
            before, after = values[:, 0, i], values[:, 1, i]
            moved = np.abs(after - before)
            rank = spearmanr(before, after).statistic
            lines.append([title, environment, moved.mean(), moved.max(), f"{rank:.2f}"])
    print()
    header = ["metric", "environment", "moved, mean", "moved, most", "rank correlation"]
    print(tabulate(lines, header, floatfmt=".1f", tablefmt="github", disable_numparse=[4]))


if __name__ == "__main__":
    main()
