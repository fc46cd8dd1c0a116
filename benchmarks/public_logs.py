"""Import public logs by their recipes, run shipped rows on them, and fill docs/public-logs.md.

``python benchmarks/public_logs.py --root DIR --results DIR [--set skab] [--detector mewma]`` takes
the files of set NAME from DIR/NAME, runs all rows, and says on the page what was imported. A
second call goes on where the first was interrupted. ``oodd-eval compare DIR --write-reference``
makes of the results the records that are committed in ``leaderboard/suites/logs``.

Without ``--root`` the page is filled: cards from the comments of the recipes, and which part of a
set the committed records are of, from ``sets.toml`` beside them. With ``--check`` it is compared
and not written. ``docs/figures/tables.py`` fills its tables.
"""

import argparse
import re
import sys
import textwrap
import time
import tomllib
import warnings
from pathlib import Path

from oodd_logs.importing import import_recipe
from oodd_logs.recipe import Recipe
from oodd_logs.shipped_recipes import shipped_recipes

from oodd_eval import evaluate
from oodd_eval.errors import PromiseWarning
from oodd_eval.plugins.discovery import discover
from oodd_eval.results.board import boards
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.scoring.promises import promises_of

ROOT = Path(__file__).parents[1]
PAGE, RECORDS = ROOT / "docs" / "public-logs.md", ROOT / "leaderboard" / "suites" / "logs"

SETS = tomllib.loads((RECORDS / "sets.toml").read_text(encoding="utf-8"))
"""The part of each set that the committed records are of."""

ORDER = ("skab", "alfa", "rosa", "tep", "cwru", "nab", "ur3", "uci", "lerobot", "pi0")
"""Sets in the order of the page: labelled rows first, outcomes last."""

SEEDS = (0, 1, 2)


def shipped_rows():
    """Return the names of the detectors of this package that learn from nominal logs alone.

    At one step `riqn-ms` is `riqn`.
    """
    offers = discover().offers.items()
    ours = {n: o.spec for n, o in offers if o.distribution == "oodd-eval" and n != "riqn-ms"}
    return [name for name, spec in ours.items() if spec.training == "nominal"]


def card(name):
    """Return the card of a set, from the comment at the head of its recipe and its first keys."""
    path = shipped_recipes()[name]
    recipe = Recipe.load(path)
    head = re.match(r"(?:#.*\n)+", path.read_text(encoding="utf-8"))[0]
    text = re.sub(r"^# ?", "", head, flags=re.MULTILINE)
    about, hard = text.split("\nWhat is hard about it\n")
    summary, get = (" ".join(part.split()) for part in about.split("\nGet: "))
    rows = {"licence": recipe.licence, "get it": get, "cite": recipe.citation}
    return "\n\n".join(
        [
            f"## {name}",
            textwrap.fill(summary, 110, break_long_words=False),
            "\n".join(["| | |", "|---|---|", *(f"| {k} | {v} |" for k, v in rows.items())]),
            f"What is hard about it:\n\n{hard.strip()}",
        ]
    )


def _promise(finding):
    """Return what was found out about a promise, in short where it was tested."""
    subjects = {
        "drift": "drift along the recorded order",
        "difference": "difference of calibration from the nominal test episodes",
        "length": "difference of their lengths",
    }
    if finding.subject not in subjects:
        return str(finding)
    sensor = f", most in {finding.sensor}" if finding.sensor else ""
    return f"{subjects[finding.subject]}: p = {finding.p:.2g}{sensor}"


def run(name, root, detectors, results):
    """Run rows on a set, and say what was imported and what of it puts the promise in doubt."""
    started = time.perf_counter()
    recipe = Recipe.load(shipped_recipes()[name])
    split = import_recipe(recipe, root, results / "splits" / name, replace=True)
    print(f"{name}: imported in {time.perf_counter() - started:.1f} s", file=sys.stderr)
    data = split.environment(recipe.environment)
    parts = {"training": data.train, "calibration": data.calibration, "nominal test": data.twins}
    sizes = [f"{len(part)} {title}" for title, part in parts.items()]
    sizes += [f"{len(data.labelled(anomaly))} {anomaly}" for anomaly in data.anomalies]
    imported = f"Imported here: {', '.join(sizes)} episodes; digest"
    # Windows of one length are no shorter in one part than in another.
    findings = [f for f in promises_of(data) if not (f.subject == "length" and f.p == 1)]
    doubts = "\n".join(f"- {_promise(finding)}." for finding in findings)
    plugins = discover()
    with_actions = {n for n in detectors if "actions" in plugins.offer(n).spec.inputs}
    names = [n for n in detectors if n not in with_actions or data.actions]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PromiseWarning)  # the lines above say it
        records = evaluate(names, split, seed=SEEDS, output=results)
    failed = [(record.detector, record.reason) for record in records if not record.ok]
    print(f"{name}: {len(records)} records, failed: {failed or 'none'}", file=sys.stderr)
    return f"{imported} `{split.digest[:12]}`.\n\n{doubts}"


def sources(records, page):
    """Return which part of each set the records are of, and where its table is, by its name.

    A digest that the page does not say of what was imported is of another recipe.
    """
    sets = {Recipe.load(path).environment: name for name, path in shipped_recipes().items()}
    lines = dict.fromkeys(ORDER, "No table: its files were not at hand.")
    for board in boards(records):
        name, digest = sets[board.environments[0]], board.digest[:12]
        releases = " and ".join(sorted({r.provenance["oodd_eval"] for r in board.records}))
        recipe = "" if f"episodes; digest `{digest}`" in page else " and an earlier recipe"
        table = f"../leaderboard/README.md#public-logs-split-{name}-protocol-3"
        lines[name] = (
            f"[Table of all rows]({table}), computed on {SETS[name]['part']}, by release "
            f"{releases}{recipe}; digest `{digest}`."
        )
    return lines


def filled(page, **blocks):
    """Return the page with blocks of some kinds, each given as texts by set."""
    for kind, texts in blocks.items():
        for name, text in texts.items():
            pattern = rf"(<!-- {kind}: {name} -->\n).*?(<!-- end -->)"
            page, count = re.subn(
                pattern, lambda m, text=text: f"{m[1]}\n{text}\n\n{m[2]}", page, flags=re.DOTALL
            )
            assert count == 1, f"{PAGE} has {count} places for the {kind} of {name}, expected 1"
    return page


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, help="folder with a folder of files for each set")
    parser.add_argument("--results", type=Path, help="with --root: where results are kept")
    parser.add_argument("--set", default=",".join(ORDER), help="names of recipes")
    parser.add_argument("--detector", default=",".join(shipped_rows()))
    parser.add_argument("--check", action="store_true", help="write nothing; 1 where it differs")
    options = parser.parse_args(arguments)
    if bool(options.root) != bool(options.results):
        parser.error("--root is where the files are, --results where results go: give both")
    names = options.set.split(",")
    before = PAGE.read_text(encoding="utf-8")
    if options.root:
        present = [name for name in names if (options.root / name).is_dir()]
        detectors = options.detector.split(",")
        imported = {n: run(n, options.root / n, detectors, options.results) for n in present}
        page = filled(before, imported=imported)
    else:
        of = sources(ResultsDirectory(RECORDS).records(), before) if RECORDS.is_dir() else {}
        page = filled(before, card={n: card(n) for n in names}, source=of)
    if options.check:
        return int(page != before)
    PAGE.write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
