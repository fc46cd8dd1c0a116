"""Whether intervals and verdicts of differences ever disagree: ``python benchmarks/verdicts.py``.

Over all committed rows, of the leaderboard's results and of its suites: the two questions that a
board asks of its rows, and each row against all others, in both metrics that rank. A verdict is the
corrected p-value's, at most 0.05; an interval's is that it leaves out 0. Exit code 1 if any two
differ.
"""

import sys
from pathlib import Path

from oodd_leaderboard.standings import ordered

from oodd_eval.metrics.ranking import ALPHA, differences
from oodd_eval.results.board import boards, cells_with, expected_cells
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.standings import terms_of

ROOT = Path(__file__).parents[1] / "leaderboard"


def verdicts(board):
    """Return the tests of a board: of its two questions, and of each row against all others."""
    made = ordered(board.records)
    tests = [*made.above.values(), *made.first.values()]
    for metric in (board.ranking, board.alarm_ranking):
        cells = cells_with(metric, board.records) & expected_cells(board.records)
        rows = {
            str(row.entry): terms_of((r for r in row.records if r.position in cells), metric)
            for row in made.standings
        }
        whole = {
            name: row
            for name, row in rows.items()
            if row and all(of_seed.keys() == cells for of_seed in row.values())
        }
        for name in whole:
            tests += differences(whole, [(name, other) for other in whole if other != name])
    return tests


def main():
    wrong = 0
    results = [
        r for p in sorted((ROOT / "results").iterdir()) for r in ResultsDirectory(p).records()
    ]
    sources = {"results": results}
    for path in sorted(p for p in (ROOT / "suites").iterdir() if p.is_dir()):
        sources[path.name] = ResultsDirectory(path).records()
    for name, records in sources.items():
        for board in boards(records):
            tests = verdicts(board)
            told = sum(test.told_apart for test in tests)
            disagree = [test for test in tests if test.told_apart != (test.p <= ALPHA)]
            wrong += len(disagree)
            print(f"{name}, {board.conditions}: {len(tests)} tests, {told} told, "
                  f"{len(disagree)} disagree", *disagree, sep="\n", flush=True)  # fmt: skip
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
