"""What the defaults of the rows that learn from failures were chosen by: training parts alone.

``python benchmarks/outcome_choices.py --root DIR`` takes the training parts of the recipe
`pi0-failures` and prints AUC of outcomes at equal time and at half of it, weighted by failures, and
the sequential Brier score with both outcomes weighing alike: by cross-validation within tasks, four
folds drawn eight times, and on each task left out that has more than one success. Then it prints
how much of the number of the row a linear function of the features tells.
"""

import argparse
import itertools
import tempfile
from pathlib import Path

import numpy as np
from oodd_logs.importing import import_recipe
from oodd_logs.recipe import Recipe
from oodd_logs.shipped_recipes import shipped_recipes
from oodd_outcomes.detector import RunningFeatures
from tabulate import tabulate

from oodd_eval.plugins.discovery import discover

FOLDS, DRAWS = 4, 8
RIDGES = {"logistic": (1, 10, 30), "logistic-time": (30,), "tdqc": (0.3, 1, 3)}


def training_parts(root):
    """Return episodes, outcomes (1 for a failure) and tasks of the training parts."""
    recipe = Recipe.load(shipped_recipes()["pi0-failures"])
    with tempfile.TemporaryDirectory() as directory:
        data = import_recipe(recipe, root, Path(directory)).environment(recipe.environment)
        parts = data.train, data.failures
        rows = [(x, y, k) for y, part in enumerate(parts) for x, k in zip(part, part.tasks)]  # noqa: B905
        data.close()
    return rows


def folds_of(rows, seed):
    """Return a fold for each episode: those of a task with one outcome are dealt out alike."""
    rng, folds = np.random.default_rng(seed), np.zeros(len(rows), int)
    for task, outcome in itertools.product(sorted({k for *_, k in rows}), (0, 1)):
        members = [i for i, (_, y, k) in enumerate(rows) if (y, k) == (outcome, task)]
        folds[members] = rng.permutation(len(members)) % FOLDS
    return folds.tolist()


def scored(detector, ridge, rows, folds):
    """Return the scores of all episodes, each by a fit on the other folds."""
    scores = [None] * len(rows)
    for fold in {*folds}:
        rest = [row for row, f in zip(rows, folds, strict=True) if f != fold]
        fitted = detector.factory(seed=0, horizon=1, ridge=float(ridge))
        nominal, failures = ([x for x, y, _ in rest if y == outcome] for outcome in (0, 1))
        fitted.fit(nominal, failures)
        for i, f in enumerate(folds):
            if f == fold:
                scores[i] = fitted.score(rows[i][0])
    return scores


def auc(failed, nominal):
    above = np.subtract.outer(failed, nominal)
    return ((above > 0) + 0.5 * (above == 0)).mean()


def figures(scores, rows):
    """Return AUC at equal time, at half of it, and the Brier score, over tasks."""
    values, weights = [], []
    for task in dict.fromkeys(k for *_, k in rows):
        failed, nominal = (
            [s for s, (_, y, k) in zip(scores, rows, strict=True) if (y, k) == (outcome, task)]
            for outcome in (1, 0)
        )
        if len(nominal) > 1:
            n = min(map(len, failed + nominal))
            aucs = [
                auc(*([s[:m].max() for s in p] for p in (failed, nominal))) for m in (n, n // 2)
            ]
            off = (
                np.mean([(1 - s[:n]) ** 2 for s in failed]),
                np.mean([s[:n] ** 2 for s in nominal]),
            )
            values.append([*aucs, np.mean(off)])
            weights.append(len(failed))
    return np.average(values, axis=0, weights=weights)


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path, required=True)
    rows = training_parts(parser.parse_args().root)
    offers, table = discover().offers, []
    for name, ridge in ((name, ridge) for name, ridges in RIDGES.items() for ridge in ridges):
        spec = offers[name].spec
        draws = [scored(spec, ridge, rows, folds_of(rows, seed)) for seed in range(DRAWS)]
        within = np.mean([figures(scores, rows) for scores in draws], axis=0)
        unseen = figures(scored(spec, ridge, rows, [k for *_, k in rows]), rows)
        aucs = [f"{100 * a:.1f} / {100 * b:.1f}" for a, b, _ in (within, unseen)]
        table.append([name, ridge, *aucs, f"{within[2]:.3f} / {unseen[2]:.3f}"])
    recorded = figures([x.observations[:, 1] for x, *_ in rows], rows)
    table.append(
        ["column:chunk_mse", "", *[" / ".join(f"{100 * a:.1f}" for a in recorded[:2])] * 2]
    )
    header = ["row", "ridge", "within tasks", "unseen task", "Brier, within / unseen"]
    print(tabulate(table, header, "github", disable_numparse=True))
    usual = int(np.median([len(x) for x, y, _ in rows if not y]))
    for most in (usual, None):
        features = [RunningFeatures(x.observation_dim)(x.observations)[:most] for x, *_ in rows]
        every = np.concatenate(features)
        inputs, count = every[:, :-1], every[:, -1]
        inputs = np.c_[
            (inputs - inputs.mean(0)) / np.maximum(inputs.std(0), 1e-6), inputs[:, 0] ** 0
        ]
        rest = count - inputs @ np.linalg.lstsq(inputs, count, rcond=None)[0]
        print(f"rows up to {most}: {1 - rest.var() / count.var():.2f} of the variance of time")


if __name__ == "__main__":
    main()
