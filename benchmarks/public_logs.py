"""Import public logs by their recipes, run shipped rows on them, and fill docs/public-logs.md.

``python benchmarks/public_logs.py --root DIR [--set skab,nab] [--detector mewma,clock]`` takes the
files of set NAME from DIR/NAME. Cards are written from the comments of the recipes, tables from
what is run; sets whose folder is missing keep the table that the page has. With ``--check`` the
page is compared and not written; without ``--root`` it is the cards alone.
"""

import argparse
import re
import sys
import tempfile
import textwrap
import time
import warnings
from pathlib import Path

from oodd_eval import evaluate
from oodd_eval.data.importing import import_recipe
from oodd_eval.data.recipe import Recipe
from oodd_eval.data.shipped_recipes import shipped_recipes
from oodd_eval.errors import PromiseWarning
from oodd_eval.results.board import boards
from oodd_eval.results.render.text import markdown_table
from oodd_eval.results.unpaired import UnpairedTables
from oodd_eval.scoring.doubts import promises_of

PAGE = Path(__file__).parents[1] / "docs" / "public-logs.md"

ORDER = ("skab", "alfa", "rosa", "tep", "cwru", "nab", "ur3", "uci", "lerobot", "pi0")
"""Sets in the order of the page: labelled rows first, outcomes last."""

DETECTORS = (
    "panel", "mewma", "pca", "knn", "deedee", "mahalanobis", "range", "persistence", "rf", "pe",
    "clock",
)  # fmt: skip
"""Shipped rows; `pe` takes a minute a set, as does `panel` where its networks join."""


def card(name):
    """Return the card of a set, from the comment at the head of its recipe and its first keys."""
    path = shipped_recipes()[name]
    recipe = Recipe.load(path)
    head = re.match(r"(?:#.*\n)+", path.read_text(encoding="utf-8"))[0]
    text = re.sub(r"^# ?", "", head, flags=re.MULTILINE)
    about, hard = text.split("\nWhat is hard about it\n")
    summary, get = (" ".join(part.split()) for part in about.split("\nGet: "))
    rows = {
        "licence": recipe.licence,
        "get it": get,
        "cite": recipe.citation,
        "recipe": f"`recipes/{name}.toml`",
    }
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


def result(name, root, detectors, work):
    """Return the tables of a set, what was imported, and what was said of the promise."""
    started = time.perf_counter()
    recipe = Recipe.load(shipped_recipes()[name])
    split = import_recipe(recipe, root, work / name)
    print(f"{name}: imported in {time.perf_counter() - started:.1f} s", file=sys.stderr)
    data = split.environment(recipe.environment)
    parts = {"training": data.train, "calibration": data.calibration, "nominal test": data.twins}
    sizes = [f"{len(part)} {title}" for title, part in parts.items()]
    sizes += [f"{len(data.labelled(anomaly))} {anomaly}" for anomaly in data.anomalies]
    imported = f"Imported here, of a part of the set: {', '.join(sizes)} episodes; digest"
    paragraphs = [f"{imported} `{split.digest[:12]}`."]
    paragraphs.append("\n".join(f"- {_promise(finding)}." for finding in promises_of(data)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PromiseWarning)  # the lines above say it
        results = evaluate([*detectors], split, output=work / f"{name}-results")
    failed = [(record.detector, record.reason) for record in results if not record.ok]
    assert not failed, failed
    (board,) = boards([*results])
    seconds = {record.detector: record.seconds_fit + record.seconds_score for record in results}
    print(f"{name}: { ({d: round(s, 1) for d, s in seconds.items()}) }", file=sys.stderr)
    tables = UnpairedTables(board)
    paragraphs += [
        re.sub(r"^### (.*)", r"**\1**", markdown_table(table)).strip()
        for table in (tables.headline(), tables.outcomes(), tables.nominal())
        if table
    ]
    return "\n\n".join(paragraphs)


def filled(page, name, tables):
    """Return the page with one set's card, and its tables where it was run."""
    for kind, text in (("card", card(name)), ("table", tables.get(name))):
        if text is None:
            continue
        pattern = rf"(<!-- {kind}: {name} -->\n).*?(<!-- end -->)"
        page, count = re.subn(
            pattern, lambda m, text=text: f"{m[1]}\n{text}\n\n{m[2]}", page, flags=re.DOTALL
        )
        assert count == 1, f"{PAGE} has {count} places for the {kind} of {name}, expected 1"
    return page


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, help="folder with a folder of files for each set")
    parser.add_argument("--set", default=",".join(ORDER), help="names of recipes")
    parser.add_argument("--detector", default=",".join(DETECTORS), help="names of detectors")
    parser.add_argument("--check", action="store_true", help="write nothing; 1 where it differs")
    options = parser.parse_args(arguments)
    names = options.set.split(",")
    before = PAGE.read_text(encoding="utf-8")
    page = before
    with tempfile.TemporaryDirectory() as work:
        tables = {
            name: result(name, options.root / name, options.detector.split(","), Path(work))
            for name in names
            if options.root and (options.root / name).is_dir()
        }
    for name in names:
        page = filled(page, name, tables)
    if options.check:
        return int(page != before)
    PAGE.write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
