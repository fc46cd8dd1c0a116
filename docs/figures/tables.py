"""Fill the tables of README.md and docs/results.md from what is committed under leaderboard/.

A table below a comment such as ``<!-- table: board mini -->`` has rows whose first cell the author
writes; this program writes the other cells. Run ``python docs/figures/tables.py`` after a change of
committed results, or of the rows; with ``--check`` it writes nothing and fails where a page would
change.
"""

import csv
import functools
import json
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

from oodd_leaderboard.entry import read_entries

from oodd_eval.metrics.catalogue import metric_info
from oodd_eval.results.board import Board, boards
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.identity import Setting
from oodd_eval.results.strengths import DETECTION, Strengths

ROOT = Path(__file__).parents[2]
BOARD = ROOT / "leaderboard"
PAGES = (ROOT / "README.md", ROOT / "docs" / "results.md")
LOGS = ("skab", "alfa", "rosa", "tep", "nab", "uci", "ur3", "pi0-libero")
"""Sets of public logs that have anomalous episodes, in the order of columns."""

HEADLINE = ("auc_matched", "found_within_20_at_5pct", "missed_at_5pct")

Row = Callable[[str], str]
"""Return the cells of a row behind its first one, separated by bars, from what the first names."""


def lines(path: str) -> list[dict[str, str]]:
    """Return the rows of a committed CSV file."""
    with (BOARD / path).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


@functools.cache
def ranking(split: str) -> dict[str, dict[str, str]]:
    """Return the primary rows of a board by detector."""
    (file,) = (BOARD / "tables").glob(f"{split}-*-ranking.csv")
    rows = lines(str(file.relative_to(BOARD)))
    return {row["detector"]: row for row in rows if row["primary"] == "true"}


@functools.cache
def board(name: str) -> Board:
    """Return a suite's board, or that of the entries on mini."""
    if name == "mini":
        records = [r for e in read_entries(BOARD / "results") for r in e.records]
        records = [r for r in records if r.split == "mini"]
    else:
        records = ResultsDirectory(BOARD / "suites" / name).records()
    (of_split,) = boards(records)
    return of_split


def mean(
    name: str,
    row: str | Setting,
    metric: str,
    *,
    environments: Iterable[str] = (),
    anomalies: Iterable[str] = (),
) -> float:
    """Return a row's mean of a metric in per cent, by default over all cells."""
    records = board(name)
    setting = row if isinstance(row, Setting) else Setting(row)
    over = [*environments] or records.environments, [*anomalies] or records.anomalies
    return 100 * records.mean(setting, *over, metric).value


def cells(values: Iterable[float]) -> str:
    """Return numbers with one decimal as cells."""
    return " | ".join(f"{value:.1f}" for value in values)


def of_board(split: str, *metrics: str) -> Row:
    """Return the row of a detector on a board."""
    units = {m: 1 if metric_info(m).unit == "steps" else 100 for m in metrics}
    return lambda name: cells(units[m] * float(ranking(split)[name][m]) for m in metrics)


def by_environment(name: str) -> str:
    """Return matched AUC by group, and dynamics anomalies that are missed, of an environment."""
    sensor, dynamics = board("mini").in_group("sensor"), board("mini").in_group("dynamics")

    def value(row: str, metric: str, group: Iterable[str]) -> float:
        return mean("mini", row, metric, environments=[name], anomalies=group)

    pairs = [
        ", ".join(f"{value(row, 'auc_matched', group):.1f}" for row in ("panel", "pe-a"))
        for group in (sensor, dynamics)
    ]
    missed = (value(row, "missed_at_5pct", dynamics) for row in ("mewma-a", "panel", "pe-a"))
    return " | ".join([*pairs, *(f"{share:.0f}" for share in missed)])


def by_group(name: str) -> str:
    """Return matched AUC over all cells and by group, and two shares of alarms, on mini."""
    groups = (board("mini").in_group(group) for group in ("sensor", "dynamics"))
    aucs = [mean("mini", name, "auc_matched", anomalies=group) for group in groups]
    overall, *alarms = (mean("mini", name, metric) for metric in HEADLINE)
    return cells([overall, *aucs, *alarms])


def at_horizons(name: str) -> str:
    """Return three metrics of a detector, each at three horizons."""
    return cells(mean("horizons", Setting(name, h), m) for m in HEADLINE for h in (1, 10, 20))


NOISE = ("mini", "noisy-1", "noisy-5")
"""The suites without noise, and with 1 and 5 % of it."""


def under_noise(name: str) -> str:
    """Return three metrics of a detector, each by the amount of noise."""
    metrics = ("auc_matched", "found_within_20_at_5pct", "false_episodes_at_5pct")
    return cells(mean(suite, name, metric) for metric in metrics for suite in NOISE)


def of_kind_under_noise(kind: str) -> str:
    """Return what two detectors find of a kind of anomalies, each by the amount of noise."""
    found = "found_within_20_at_5pct"
    rows = ("pe-a", "mewma-a")
    return cells(mean(suite, row, found, anomalies=[kind]) for row in rows for suite in NOISE)


def beside_oracle(cells_of: str) -> str:
    """Return matched AUC and what is found of the oracle and of `pe-a`, by the amount of noise.

    The cells are named as ``cartpole, gravity`` or ``cartpole, all kinds``.
    """
    environment, kind = cells_of.split(", ")
    kinds = [] if kind == "all kinds" else [kind]
    return cells(
        mean(suite, row, metric, environments=[environment], anomalies=kinds)
        for row in ("oracle-gym", "pe-a")
        for metric in HEADLINE[:2]
        for suite in NOISE
    )


@functools.cache
def archived(split: str) -> dict[str, dict[str, str]]:
    """Return the cells of a board of protocol 2 by detector, at Δ = 1, and column."""
    archive = (ROOT / "docs" / "archive" / "protocol-2.md").read_text(encoding="utf-8")
    section = archive.split(f"## Board of {split}:")[1].split("\n## ")[0]
    rows = [[c.strip() for c in x.split("|")[1:-1]] for x in section.splitlines() if x[:1] == "|"]
    head, _, *rows = rows
    named = (dict(zip(head, row, strict=True)) for row in rows)
    return {r["detector"]: r for r in named if r["settings"].removesuffix(", 3 seeds") == "Δ=1"}


def of_protocols(name: str) -> str:
    """Return two metrics on two splits, each under protocol 2, from the archive, and today."""
    metrics = {"matched AUC": "auc_matched", "found within 20": "found_within_20_at_5pct"}
    return " | ".join(
        f"{archived(split)[name][column].split()[0]} → {of_board(split, metric)(name)}"
        for column, metric in metrics.items()
        for split in ("mini", "standard")
    )


@functools.cache
def run_again() -> dict[str, dict[str, list[float]]]:
    """Return means of an entry on `standard` and of its re-run by row and metric."""
    grants = json.loads((BOARD / "trust.json").read_text(encoding="utf-8"))["grants"]
    means = [grant["means"] for entry, grant in grants.items() if entry.endswith("-standard")]
    return dict(row for of_entry in means for row in of_entry.items())


def of_rerun(name: str) -> str:
    """Return three metrics of a row, each on the board and on fresh seeds."""
    metrics = ("auc_matched", "found_within_20_at_5pct", "false_episodes_at_5pct")
    return cells(100 * value for metric in metrics for value in run_again()[name][metric])


def of_reproductions(table1: str, losses: str) -> Row:
    """Return AUC by group of a model: of the paper, at Table 1's strengths, at equal losses."""

    def means(split: str) -> dict[tuple[str, str], dict[str, str]]:
        rows = lines(f"reproduction/{split}/tables/table-5.csv")
        rows = [r for r in rows if (r["environment"], r["metric"]) == ("mean", "auc")]
        return {(r["series"], r["anomalies"]): r for r in rows}

    def row(name: str) -> str:
        ours, same = means(table1), means(losses)
        keys = [(name, group) for group in ("sensor", "dynamics")]
        texts = (t for k in keys for t in (same[k]["paper"], ours[k]["value"], same[k]["value"]))
        return cells(100 * float(text) for text in texts)

    return row


def overview(suite: str, name: str) -> list[str]:
    """Return the cells of a row of detection thresholds on a suite's page."""
    page = (BOARD / "suites" / suite / "README.md").read_text(encoding="utf-8")
    table = page.partition("\n### Detection thresholds, lower is better")[2].split("\n\n")[1]
    rows = [[cell.strip().replace("\\", "") for cell in line.split("|")[1:-1]]
            for line in table.splitlines()]  # fmt: skip
    (row,) = (row for row in rows if row[0] == name)
    return row


def thresholds(suite: str, name: str) -> list[str]:
    """Return the threshold of a row on a suite's page, and the shares that it finds by rung."""
    row = overview(suite, name)
    return [row[1], *row[5:]]


LADDER = "ladder-noisy-1"


def of_ladder(name: str) -> str:
    """Return a row of the overview on the ladder's page: threshold, and shares by rung."""
    return " | ".join(thresholds(LADDER, name))


def by_rung(place: str) -> str:
    """Return what a row finds of an environment's ladder by rung, named as ``acrobot, pe-a``."""
    environment, name = place.split(", ")
    own = [r for r in board(LADDER).records
           if (r.environment, r.setting) == (environment, Setting(name))]  # fmt: skip
    strengths = Strengths.of(own)
    rungs = (Board(strengths.at(own, rung)) for rung in strengths.names)
    return cells(
        100 * rung.mean(Setting(name), rung.environments, rung.anomalies, DETECTION).value
        for rung in rungs
    )


def in_worlds(name: str) -> str:
    """Return matched AUC, all and by world, shares found by the loss's growth, false episodes."""
    environments = board("worlds").environments
    means = [mean("worlds", name, "auc_matched", environments=[e]) for e in environments]
    aucs = cells([mean("worlds", name, "auc_matched"), *means])
    false = cells([mean("worlds", name, "false_episodes_at_5pct")])
    return " | ".join([aucs, *thresholds("worlds", name)[1:], false])


@functools.cache
def logs() -> dict[str, Board]:
    """Return the boards of public logs by environment."""
    of_splits = boards(ResultsDirectory(BOARD / "suites" / "logs").records())
    return {board.environments[0]: board for board in of_splits}


def on_logs(metric: str = "") -> Row:
    """Return a detector's means over sets of logs of a metric, by default that by which they rank.

    A dash stands where the detector was not run.
    """

    def value(board: Board, name: str) -> str:
        if Setting(name) not in board.entries:
            return "–"  # noqa: RUF001  an en dash
        over = board.environments, board.anomalies
        return f"{100 * board.mean(Setting(name), *over, metric or board.ranking).value:.1f}"

    return lambda name: " | ".join(value(logs()[environment], name) for environment in LOGS)


@functools.cache
def claims(split: str) -> dict[tuple[str, str], dict[str, str]]:
    """Return the judgements of a reproduction by claim and measure."""
    return {(r["claim"], r["kind"]): r for r in lines(f"reproduction/{split}/claims.csv")}


def verdicts(text: str) -> str:
    """Return the verdicts on a claim, by the paper's measure and by the fair one."""
    by_text = {(r["text"], kind): r["verdict"] for (_, kind), r in claims("mini").items()}
    return f"{by_text[text, 'paper']} | {by_text.get((text, 'fair'), '–')}"  # noqa: RUF001  an en dash


WHOLE = ("auc_matched", "auc_unpaired", "auc_smoothed", *HEADLINE[1:], "false_episodes_at_5pct")

TABLES: dict[str, Row] = {
    "headline": of_board("mini", *HEADLINE, "delay_censored_at_5pct"),
    "board mini": of_board("mini", *WHOLE),
    "board standard": of_board("standard", *WHOLE),
    "environments": by_environment,
    "papers": by_group,
    "horizons": at_horizons,
    "noise": under_noise,
    "noise kinds": of_kind_under_noise,
    "oracles": beside_oracle,
    "protocols": of_protocols,
    "run again": of_rerun,
    "losses mini-paper": of_reproductions("mini", "mini-paper"),
    "losses reduced-paper": of_reproductions("standard", "reduced-paper"),
    "ladder": of_ladder,
    "ladder oracles": by_rung,
    "worlds": in_worlds,
    "claims": verdicts,
    "logs": on_logs(),
    "logs false": on_logs("false_episodes_at_10pct"),
}


def filled(page: str) -> str:
    """Return a page with the numbers of its tables; an unknown table or row raises `KeyError`."""

    def table(match: re.Match[str]) -> str:
        row = TABLES[match["name"]]
        texts = []
        for line in match["rows"].splitlines():
            label = line.split("|")[1].strip()
            # Behind the name may stand a description.
            named = re.match(r"`([A-Za-z0-9:._-]+)`", label)
            texts.append(f"| {label} | {row(named[1] if named else label)} |\n")
        return match["head"] + "".join(texts)

    pattern = (
        r"(?P<head><!-- table: (?P<name>[a-z0-9 -]+) -->\n\|[^\n]*\n\|[-|]+\|\n)"
        r"(?P<rows>(?:\|[^\n]*\n)+)"
    )
    return re.sub(pattern, table, page)


def main(arguments: list[str]) -> int:
    """Fill the pages, or with ``--check`` say which would change."""
    changed = []
    for path in PAGES:
        before = path.read_text(encoding="utf-8")
        if (after := filled(before)) != before:
            changed.append(str(path.relative_to(ROOT)))
            if "--check" not in arguments:
                path.write_text(after, encoding="utf-8")
    if changed:
        print("changed:" if "--check" not in arguments else "out of date:", ", ".join(changed))
    return int(bool(changed) and "--check" in arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
