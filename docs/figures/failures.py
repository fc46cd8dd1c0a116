r"""Write what docs/failures.md is made from: records of rows on rollouts of a learned policy.

``python docs/figures/failures.py --root DIR --results DIR [--detector mewma]``: the root is the
folder of the recipe `pi0-failures`. Rows are run within tasks, as the recipe has them, and on each
task in turn that training has not seen: there all episodes of the other tasks are for training and
calibration.
A second call goes on where the first was interrupted.
"""

import argparse
import dataclasses
import json
import lzma
from pathlib import Path

from oodd_logs.episodes import read_episodes
from oodd_logs.importing import import_recipe
from oodd_logs.recipe import Recipe
from oodd_logs.shipped_recipes import shipped_recipes

from oodd_eval import evaluate
from oodd_eval.data.split import load_split

HERE = Path(__file__).parent
RECIPE = "pi0-failures"
ROWS = (
    "column:chunk_mse", "mean:chunk_mse", "clock", "panel", "deedee", "mewma", "mahalanobis", "knn",
    "pca", "logpzo", "rnd", "logistic", "logistic-time", "tdqc",
)  # fmt: skip
SEEDS = (0, 1, 2)
SHARES = (0.6, 0.4)
"""Shares of training and calibration among the successes of tasks that training has seen."""


def tasks_of(recipe: Recipe, root: Path) -> list[str]:
    """Return the tasks of the episodes that a recipe reads."""
    with read_episodes(recipe, root) as source:
        return sorted({facts.episode.task for part in source.parts.values() for facts in part})


def splits_of(root: Path, directory: Path) -> dict[str, Path]:
    """Import the episodes within tasks, and once for each task that training has not seen."""
    recipe = Recipe.load(shipped_recipes()[RECIPE])
    recipes = {"within": dataclasses.replace(recipe, environment="within-tasks")}
    nominal = dataclasses.replace(recipe.nominal, parts=SHARES)
    for task in tasks_of(recipe, root):
        keys = {"environment": f"task-{task}", "unseen": (task,), "failures": 1.0}
        recipes[task] = dataclasses.replace(recipe, nominal=nominal, split="pi0-unseen", **keys)
    for name, of_split in recipes.items():
        output = directory / ("within" if name == "within" else "unseen")
        import_recipe(of_split, root, output, replace=True)
    return {name: directory / name for name in ("within", "unseen")}


def main() -> None:
    """Run all rows and write their records."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--detector", default=",".join(ROWS))
    options = parser.parse_args()
    for name, path in splits_of(options.root, options.results / "splits").items():
        for detector in options.detector.split(","):
            evaluate(detector, load_split(path), seed=SEEDS, output=options.results / name)
    files = [options.results / name / "records.jsonl" for name in ("within", "unseen")]
    records = [json.loads(line) for file in files for line in file.read_text("utf-8").splitlines()]
    lines = sorted(json.dumps(record, sort_keys=True) + "\n" for record in records)
    packed = lzma.compress("".join(lines).encode(), preset=9)
    (HERE / "failures.jsonl.xz").write_bytes(packed)
    print(f"{len(lines)} records, {len(packed)} bytes")


if __name__ == "__main__":
    main()
