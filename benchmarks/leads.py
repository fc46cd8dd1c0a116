"""By how much one row leads every other, environment by environment, with paired intervals.

``python benchmarks/leads.py ROW RESULTS [RESULTS ...]``, seconds. RESULTS are results directories
or entries of the leaderboard, of one split; rows are taken at Δ = 1 with default parameters. For
each environment the nearest row is printed, that whose paired 95 % interval of the lead in matched
AUC begins lowest, and every row whose interval does not begin above 0. Test seeds are drawn.
"""

import argparse

from tabulate import tabulate

from oodd_eval.results.board import grouped
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.standings import compare_rows


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("row")
    parser.add_argument("results", nargs="+")
    options = parser.parse_args()
    every = [r for place in options.results for r in ResultsDirectory(place).records()]
    plain = [r for r in every if r.ok and r.horizon == 1 and not r.overrides]
    table = []
    for environment, own in grouped(plain, lambda r: r.environment).items():
        others = {r.detector for r in own} - {options.row}
        leads = [compare_rows(own, options.row, other) for other in others]
        leads.sort(key=lambda t: t.low)
        unsure = ", ".join(t.second for t in leads if t.low <= 0) or "none"
        low = leads[0]
        table.append([environment, low.second, 100 * low.difference, 100 * low.low, unsure])
    heads = ["", "nearest row", "lead", "interval begins at", "not above 0"]
    print(tabulate(table, heads, floatfmt=".2f", tablefmt="github"))


if __name__ == "__main__":
    main()
