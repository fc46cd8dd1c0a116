"""How near the estimated onset is at the first guaranteed alarm: the share within some rows.

``python benchmarks/onsets.py RESULTS SPLIT [--rows 5]`` reads the scores and explanations that
``oodd-eval run`` has kept; seconds. Printed is, by detector, environment and group of anomalies,
the share of the found anomalies whose onset was estimated within so many rows of the effect, and
the share over all of them. ``onset_error_at_5pct`` in the records is the median of the same errors.
"""

import argparse
from collections import defaultdict

import numpy as np
from tabulate import tabulate

from oodd_eval import load_split
from oodd_eval.data.facts import GROUPS
from oodd_eval.metrics.catalogue import HEADLINE
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.evaluate import Rules, must_be_of, stored_scores


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("results")
    parser.add_argument("split")
    parser.add_argument("--rows", type=int, default=5)
    options = parser.parse_args()
    results, split = ResultsDirectory(options.results), load_split(options.split)
    near = defaultdict(list)
    with split.opened() as environment:
        for record in (r for r in results.records() if r.ok):
            must_be_of(split, record)
            data = environment(record.environment)
            file = stored_scores([record], results, data)
            rule = Rules.fit(file.parts["calibration"], record.alarm).guaranteed[HEADLINE]
            part = f"test/{record.anomaly}"
            effects = data.anomalous(record.anomaly).effects
            for scores, explained, effect in zip(
                file.parts[part], file.explained.get(part, ()), effects, strict=False
            ):
                first = rule.first(scores)
                if first is not None and first >= effect:
                    found = abs(int(explained[1, first]) - int(effect)) <= options.rows
                    for place in (record.environment, "all"):
                        for group in (record.group, "all"):
                            near[record.detector, place, group].append(found)
    groups = [*GROUPS, "all"]
    rows = [
        [
            detector,
            place,
            *(
                100 * np.mean(near[detector, place, g]) if near[detector, place, g] else None
                for g in groups
            ),
        ]
        for detector, place in dict.fromkeys(key[:2] for key in list(near))
    ]
    print(tabulate(rows, ["detector", "environment", *groups], floatfmt=".1f", tablefmt="github"))


if __name__ == "__main__":
    main()
