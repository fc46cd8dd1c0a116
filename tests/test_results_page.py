"""Numbers of the page on what was found are those of what is committed under leaderboard/."""

import csv
import functools
import re
from collections import Counter
from pathlib import Path

import pytest

from oodd_eval.cli.main import main
from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.leaderboard.entry import read_entries, read_grants
from oodd_eval.results.board import boards
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.identity import Setting

BOARD = Path(__file__).parents[1] / "leaderboard"
PAGE = (BOARD.parent / "docs" / "results.md").read_text()
TEXT = " ".join(PAGE.split())
ROBOTS = [name for name, info in ENVIRONMENTS.items() if not info.discrete]


def lines(path):
    with (BOARD / path).open() as file:
        return list(csv.DictReader(file))


@functools.cache
def ranking(split):
    (file,) = (BOARD / "tables").glob(f"{split}-*-ranking.csv")
    return {r["detector"]: r for r in lines(file) if r["primary"] == "true"}


@functools.cache
def board(name, seed=None):
    """A suite's board, or that of the entries on mini."""
    if name == "mini":
        records = [r for e in read_entries(BOARD / "results") for r in e.records]
        records = [r for r in records if r.split == "mini" and seed in (None, r.seed)]
    else:
        records = ResultsDirectory(BOARD / "suites" / name).records()
    (one,) = boards(records)
    return one


def mean(name, row, metric, *, seed=None, environments=None, anomalies=None):
    one = board(name, seed)
    setting = row if isinstance(row, Setting) else Setting(row)
    environments = environments or one.environments
    return 100 * one.mean(setting, environments, anomalies or one.anomalies, metric).value


# Tables: what a row of a section's table has to hold


COLUMNS = ("auc_matched", "auc_unpaired", "auc_smoothed", "found_within_20_at_5pct",
           "missed_at_5pct", "false_episodes_at_5pct")  # fmt: skip


def of_board(split):
    return lambda name: [100 * float(ranking(split)[name][column]) for column in COLUMNS]


@functools.cache
def grants():
    return {k: v for g in read_grants(BOARD / "results").values() for k, v in g.means.items()}


def of_grants(name):
    units = {"auc_matched": 100, "false_episodes_at_5pct": 100, "delay_censored_at_5pct": 1}
    return [unit * value for m, unit in units.items() for value in grants()[name][m]]


def under_noise(name):
    metrics = ("auc_matched", "found_within_20_at_5pct", "false_episodes_at_5pct")
    splits = (("mini", 0), ("noisy-1", None), ("noisy-5", None))
    return [mean(split, name, m, seed=seed) for m in metrics for split, seed in splits]


def at_horizons(name):
    metrics = ("auc_matched", "found_within_20_at_5pct", "missed_at_5pct")
    return [mean("horizons", Setting(name, h), m) for m in metrics for h in (1, 10, 20)]


def by_environment(name):
    auc, missed = "auc_matched", "missed_at_5pct"
    groups = board("mini").in_group("sensor"), board("mini").in_group("dynamics")
    over = {"environments": [name]}
    return [
        *(mean("mini", d, auc, anomalies=g, **over) for g in groups for d in ("pe", "pe-a")),
        *(round(mean("mini", d, missed, anomalies=groups[1], **over))
          for d in ("mewma-a", "pe", "pe-a")),
    ]  # fmt: skip


def of_protocols(name):
    archive = (BOARD.parent / "docs" / "archive" / "protocol-1.md").read_text()
    mini = archive.split("## Board of mini")[1].split("## Board of reduced")[0]
    (old,) = re.findall(rf"\| {name}(?: \(trivial\))? \| Δ=1(?:, 3 seeds)? \| ([\d.]+) ", mini)
    return [float(old), 100 * float(ranking("mini")[name]["auc_matched"])]


def of_reproductions(table1, paper):
    def means(split):
        rows = lines(f"reproduction/{split}/tables/table-5.csv")
        rows = [r for r in rows if (r["environment"], r["metric"]) == ("mean", "auc")]
        return {(r["series"], r["anomalies"]): r for r in rows}

    def row(name):
        ours, same = means(table1), means(paper)
        keys = [(name, group) for group in ("sensor", "dynamics")]
        values = (v for k in keys for v in (same[k]["paper"], ours[k]["value"], same[k]["value"]))
        return [100 * float(v) for v in values]

    return row


@pytest.mark.parametrize(
    ("title", "least", "pattern", "expected"),
    [
        ("## What finds how much", 15, r"`[a-z-]+`", of_board("mini")),
        ("## What finds how much", 7, r"[a-z0-9]+", by_environment),
        ("## On longer episodes", 15, r"`[a-z-]+`", of_board("standard")),
        ("## At longer horizons", 14, r"`[a-z-]+`", at_horizons),
        ("## Run again on fresh seeds", 13, r"`[a-z-]+`", of_grants),
        ("## With noise in every sensor", 17, r"`[a-z-]+`", under_noise),
        ("## What changed", 6, r"`[a-z-]+`, protocol 1 → 2", of_protocols),
        ("### At the paper's losses\n", 5, r"[A-Z+]+", of_reproductions("mini", "mini-paper")),
        ("### At the paper's losses, on", 5, r"[A-Z+]+",
         of_reproductions("standard", "reduced-paper")),
    ],
)  # fmt: skip
def test_tables_have_the_numbers_of_what_is_committed(title, least, pattern, expected):
    section = re.split(r"\n##+ ", PAGE.split(title, 1)[1])[0]
    rows = re.findall(rf"^\| ({pattern}) \| ([-\d., |→]+) \|$", section, re.MULTILINE)
    assert len(rows) >= least
    for label, numbers in rows:
        name = re.match(r"`?([A-Za-z0-9+-]+)", label)[1]
        values = [float(n) for n in re.findall(r"-?\d+(?:\.\d+)?", numbers)]
        assert values == pytest.approx(expected(name), abs=0.051), name


def test_the_ladder_is_that_of_the_suites_page():
    page = (BOARD / "suites/ladder/README.md").read_text(encoding="utf-8").replace("\\", "")
    table = page.partition("\n### Detection thresholds, lower is better")[2].split("\n\n")[1]
    _, _, *rows = [[x.strip() for x in line.split("|")[1:-1]] for line in table.splitlines()]
    expected = [(row[0], row[1], " | ".join(row[5:])) for row in rows]
    assert expected == re.findall(
        r"^\| `([a-z-]+)` \| (\S+ \[[^]]+\]) \| (.+) \|$", PAGE, re.MULTILINE
    )


@pytest.mark.parametrize("suite", ["ladder", "noisy-1", "noisy-5", "horizons"])
def test_the_page_of_a_suite_is_printed_from_its_records(suite, capsys):
    directory = BOARD / "suites" / suite
    assert main(["show", str(directory), "--stored", "--markdown"]) == 0
    advice = f"run `oodd-eval show leaderboard/suites/{suite} --stored --markdown`"
    assert capsys.readouterr().out == (directory / "README.md").read_text(encoding="utf-8"), advice


# Claims of the paper


@functools.cache
def claims(split):
    return {(r["claim"], r["kind"]): r for r in lines(f"reproduction/{split}/claims.csv")}


def test_verdicts_are_those_of_the_reproduction():
    verdicts = {(r["text"], kind): r["verdict"] for (_, kind), r in claims("mini").items()}
    rows = re.findall(r"^\| ([^|]+) \| ([\w ]+) \| ([^|]+) \|$", PAGE, re.MULTILINE)
    rows = [row for row in rows if (row[0], "paper") in verdicts]
    assert len(rows) >= 12
    for text, paper, fair in rows:
        assert paper == verdicts[text, "paper"], text
        assert fair == verdicts.get((text, "fair"), "\N{EN DASH}"), text
    counts = Counter(v for (_, kind), v in verdicts.items() if kind == "paper")
    assert f"Of {sum(counts.values())} claims" in TEXT
    for verdict, many in counts.items():
        assert re.search(rf"\b{many}( are)? {verdict}", TEXT), verdict
