"""Fill the tables of README.md and pages of results from what is committed.

A table below a comment such as ``<!-- table: worlds -->`` has rows whose first cell the author
writes; this program writes the other cells, a line on the release of the records, and the numbers
of sentences (``sentences.py``). Run ``python docs/figures/tables.py`` after a change of committed
results, or of the rows, and read the sentences. With ``--check`` it writes nothing, and fails where
a number of a document is not that of what is committed, in the README's output, on pages of suites
and on the board, too, or where a sentence states an order that the results do not have.
"""

import csv
import functools
import io
import json
import math
import os
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import redirect_stdout, suppress
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import sentences
from committed import (
    BOARD,
    DETAILS,
    FAILURES,
    INTERVENTIONS,
    README,
    RESULTS,
    ROOT,
    SEASON,
    NotRunError,
    Row,
    board,
    cells,
    claims,
    leaderboard,
    logs,
    mean,
    newest,
    of_reproductions,
    overview,
    primary,
    rollouts,
)
from oodd_interventions.columns import ALL, COLUMNS, row_of
from oodd_interventions.page import sections
from oodd_leaderboard.pages import documents
from oodd_leaderboard.published import board_table

from oodd_eval.cli.main import main as oodd_eval
from oodd_eval.data.files import read_text
from oodd_eval.metrics.catalogue import metric_info
from oodd_eval.results.board import Board, Column
from oodd_eval.results.directory import ResultsDirectory, read_records
from oodd_eval.results.identity import Setting
from oodd_eval.results.strengths import DETECTION, Strengths
from oodd_eval.results.tables import Tables

PAGES = (README, RESULTS, *DETAILS, INTERVENTIONS, FAILURES)
FILLED_ONLY = ROOT / "docs" / "public-logs.md", ROOT / "docs" / "index.md"
"""Pages whose tables are filled, and whose other numbers are of files and of a picture."""

MAIN = Path(__file__).with_name("main.jsonl.xz")
"""Records of the README's main command: ``records.jsonl`` of its results."""
STUDY = Path(__file__).with_name("interventions.jsonl.xz")
"""Records of the study of interventions: ``records.jsonl`` of its directory."""
PROMISES = Path(__file__).with_name("promises.csv")
"""What `benchmarks/promises.py` writes."""
LOGS = ("skab", "alfa", "rosa", "tep", "nab", "uci", "ur3", "pi0-libero", "g1")
"""Sets of public logs in the order of columns; the last has nothing to find."""

HEADLINE = ("auc_matched", "found_within_20_at_5pct", "missed_at_5pct")


@functools.cache
def five_columns(name: str) -> dict[str, list[str]]:
    """Return the five columns of a board's rows as text, by row."""
    table = Tables(board(name)).headline()
    return {name: texts for name, *texts in table.rows} if table else {}


def of_board(name: str) -> Row:
    """Return the five columns of a row on a board."""
    return lambda row: " | ".join(five_columns(name)[str(primary(board(name), row))])


def by_environment(name: str) -> str:
    """Return matched AUC of three rows in an environment, each with the share that it misses."""
    metrics = ("auc_matched", "missed_at_5pct")
    pairs = [[mean(SEASON, row, metric, environments=[name]) for metric in metrics]
             for row in ("panel-a", "pe-a", "arcade-a")]  # fmt: skip
    return " | ".join(f"{auc:.1f}, {missed:.0f}" for auc, missed in pairs)


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


def on_logs(name: str) -> str:
    """Return by set of logs the metric by which rows rank, and nominal episodes with an alarm.

    A dash stands where the row was not run, or there is nothing to find.
    """

    def pair(of: Board) -> str:
        setting = Setting(name)
        if setting not in of.entries:
            return "–"  # noqa: RUF001  an en dash
        over = of.environments, of.anomalies
        metrics = of.ranking, "false_episodes_at_10pct"
        auc, false = (100 * of.mean(setting, *over, metric).value for metric in metrics)
        return f"{'–' if math.isnan(auc) else f'{auc:.1f}'}, {false:.0f}"  # noqa: RUF001

    if not any(Setting(name) in of.entries for of in logs().values()):
        primary(logs()[LOGS[0]], name)
    return " | ".join(pair(logs()[name]) for name in LOGS)


def promise(place: str) -> dict[str, str]:
    """Return a line of `PROMISES`, named as ``skab, panel``."""
    lines = csv.DictReader(PROMISES.read_text(encoding="utf-8").splitlines())
    (line,) = (line for line in lines if f"{line['set']}, {line['row']}" == place)
    return line


def promised(place: str) -> str:
    """Return the shares of a row's nominal test episodes with an alarm."""
    line = promise(place)
    shares = [line[column].replace("-", "–") or "–"  # noqa: RUF001  an en dash
              for column in ("as it is", "baseline", "rolling", "both")]  # fmt: skip
    shuffled = f"{line['shuffled']} ({line['errors']})" if line["shuffled"] else "–"  # noqa: RUF001
    return " | ".join([*shares, shuffled, f"{line['run']} of {line['episodes']}"])


@functools.cache
def study() -> list[dict]:
    """Return the records of the study of interventions."""
    return [json.loads(line) for line in read_text(STUDY).splitlines()]


@functools.cache
def of_title(title: str) -> dict[str, list[str]]:
    """Return the rows of the study's table whose title begins so, by their labels."""
    tables = (table for section in sections(study()) for table in section.tables)
    (table,) = (table for table in tables if table.title.startswith(title))
    return {", ".join(row[: table.labels]): row[table.labels :] for row in table.rows}


def of_study(title: str) -> Row:
    """Return the cells of a row of one of the study's tables."""
    return lambda labels: " | ".join(of_title(title)[labels])


def worth(place: str) -> str:
    """Return AUC over sensor faults, and what naming and masking at the alarm are worth.

    The row is named as ``hopper, panel-a``.
    """
    environment, name = place.split(", ")
    suite = "mini" if environment in board("mini").environments else "worlds"
    sensor = board(suite).in_group("sensor")
    auc = mean(suite, name, "auc_matched", environments=[environment], anomalies=sensor)
    key = (environment, ALL, name, "mask")
    (record,) = (r for r in study() if (r["environment"], r["anomaly"], row_of(r), r["act"]) == key)
    columns = ("named_precision", "named_recall", "named_recall_20", "return_saved")
    figures = ((record["intervention"][column]["value"], COLUMNS[column]) for column in columns)
    return " | ".join(
        [f"{auc:.1f}", *(info.text(math.nan if x is None else x) for x, info in figures)]
    )


OUTCOMES = ("auc_outcome", "auc_outcome_half", "auc_outcome_whole")
ALARMS = ("found_outcome", "false_episodes", "balanced_outcome", "outcome_time")


def on_rollouts(name: str, split: str, metrics: Iterable[str], environments: Iterable[str]) -> str:
    """Return metrics of a row, the first with its interval, and the first in each environment."""
    board, entry, (first, *others) = rollouts()[split], Setting(name), metrics
    whole = board.of(entry, Column(first, intervals=True))
    text = metric_info(first).text
    further = [(metric_info(metric).text, Column(metric)) for metric in others]
    further += [(text, Column(first, "", [environment])) for environment in environments]
    values = [write(board.of(entry, column).value) for write, column in further]
    return " | ".join([f"{text(whole.value)} [{text(whole.low)}, {text(whole.high)}]", *values])


def within_tasks(name: str) -> str:
    """Return what a row finds of failures of tasks that training has, see `failures.py`."""
    return on_rollouts(name, "pi0-failures", [*OUTCOMES, "brier_outcome"], [])


def alarms_within_tasks(name: str) -> str:
    """Return what the alarms of a row find there, at 10 %."""
    board, entry = rollouts()["pi0-failures"], Setting(name)
    infos = [metric_info(f"{metric}_at_10pct") for metric in ALARMS]
    return " | ".join(info.text(board.of(entry, Column(info.name)).value) for info in infos)


def unseen_tasks(name: str) -> str:
    """Return what a row finds of failures of tasks that training lacks, see `failures.py`."""
    metrics = ("auc_outcome", "auc_outcome_half", "brier_outcome")
    return on_rollouts(name, "pi0-unseen", metrics, rollouts()["pi0-unseen"].environments)


def verdicts(text: str) -> str:
    """Return the verdicts on a claim, by the paper's measure and by the fair one."""
    by_text = {(r["text"], kind): r["verdict"] for (_, kind), r in claims("mini").items()}
    return f"{by_text[text, 'paper']} | {by_text.get((text, 'fair'), '–')}"  # noqa: RUF001  an en dash


TABLES: dict[str, Row] = {
    "season": of_board(SEASON),
    "environments": by_environment,
    "horizons": at_horizons,
    "noise": under_noise,
    "noise kinds": of_kind_under_noise,
    "oracles": beside_oracle,
    "losses mini-paper": of_reproductions("mini", "mini-paper"),
    "losses reduced-paper": of_reproductions("standard", "reduced-paper"),
    "ladder": of_ladder,
    "ladder oracles": by_rung,
    "worlds": in_worlds,
    "claims": verdicts,
    "logs": on_logs,
    "promises": promised,
    "mask": of_study("Return saved by mask"),
    "mask costs": of_study("What mask prevents"),
    "stop": of_study("Return saved by stop"),
    "stop costs": of_study("What stop prevents"),
    "switch": of_study("Return saved by switch"),
    "stop harmless": of_study("Faults that stop cannot mend"),
    "namings": of_study("Parts named"),
    "outcomes within": within_tasks,
    "outcomes alarms": alarms_within_tasks,
    "outcomes unseen": unseen_tasks,
    "worth": worth,
}
BOARDS: dict[str, tuple[Iterable[str], tuple[str, ...]]] = {
    "season": ([SEASON], ()),
    "environments": ([SEASON], ("panel-a", "pe-a", "arcade-a")),
    "horizons": (["horizons"], ()),
    "noise": (NOISE, ()),
    "noise kinds": (NOISE, ("pe-a", "mewma-a")),
    "oracles": (NOISE, ("oracle-gym", "pe-a")),
    "ladder": ([LADDER], ()),
    "ladder oracles": ([LADDER], ()),
    "worlds": (["worlds"], ()),
    "logs": (LOGS, ()),
    "outcomes within": (["pi0-failures"], ()),
    "outcomes alarms": (["pi0-failures"], ()),
    "outcomes unseen": (["pi0-unseen"], ()),
    "worth": (["mini"], ()),
}
"""The boards of a table, and its rows, where its lines do not begin or end with these."""
REPRODUCED = {
    "claims": ["mini"],
    "losses mini-paper": ["mini", "mini-paper"],
    "losses reduced-paper": ["standard", "reduced-paper"],
}
"""Tables of reproductions, which begin with their release."""


def named(label: str) -> str:
    """Return the name of a line by its first cell; behind it may stand a description."""
    name = re.match(r"`([A-Za-z0-9:._-]+)`", label)
    return name[1] if name else label


def releases(table: str, label: str) -> set[str]:
    """Return the releases of the records that a line of a table is of."""
    if table == "promises":
        return {promise(label)["release"]}
    if table in REPRODUCED:
        pages = [read_text(BOARD / "reproduction" / of / "README.md") for of in REPRODUCED[table]]
        return {re.search(r"oodd-eval ([\d.]+)", page)[1] for page in pages}
    names, rows = BOARDS[table]
    found = set()
    for of in (logs().get(name) or rollouts().get(name) or board(name) for name in names):
        for row in rows or (named(label).rpartition(", ")[2],):
            with suppress(KeyError):
                setting = primary(of, row)
                row_of = replace(setting, horizon=1)
                same = (r for r in of.records if replace(r.setting, horizon=1) == row_of)
                found |= {r.provenance["oodd_eval"] for r in same}
    return found


def caption(table: str, by_line: list[set[str]]) -> tuple[str, str]:
    """Return the line below a table, of the release of its records, and the newest release.

    Lines with records of others are marked.
    """
    found = sorted({r for line in by_line for r in line}, key=lambda r: [*map(int, r.split("."))])
    text = f"Records of release {found[-1]}"
    if len(found) > 1:
        text += f"; lines marked † have some of {' and '.join(found[:-1])}"
    if SEASON in BOARDS.get(table, ((), ()))[0]:
        text += f", {newest().title.lower()}"
    return f"\n*{text}.*\n", found[-1]


def cells_of(table: str, label: str) -> str:
    """Return the cells behind the first; dashes where the line's row or environment was not run."""
    try:
        return TABLES[table](named(label))
    except NotRunError:
        return "–"  # noqa: RUF001  an en dash


SEASON_TABLE = "board season"
"""A table that is filled whole, header and rows: of the newest season so many as it has lines."""


def of_season(lines: int) -> str:
    """Return the first lines of the newest season's board, the last of a row of the paper."""
    board = newest()
    table = board_table(board.ranks)
    if table is None:
        raise ValueError(f"{board.title} has no row")
    standings = board.ranks.standings
    places = [i for i, row in enumerate(standings) if row.rank]
    first, paper = places[:lines], [i for i in places if standings[i].origin == "paper"][:1]
    if not {*paper} <= {*first}:
        first[-1:] = paper
    rows = [[rank, f"`{row}`", *others] for rank, row, *others in (table.rows[i] for i in first)]
    header = [f"rank, {board.title[0].lower()}{board.title[1:]}", *table.header[1:]]
    head = f"| {' | '.join(header)} |\n|{'---|' * len(header)}\n"
    return head + "".join(f"| {' | '.join(cells)} |\n" for cells in rows)


def filled(page: str) -> str:
    """Return a page with the numbers of its tables; an unknown table or row raises `KeyError`."""

    def table(match: re.Match[str]) -> str:
        if match["name"] == SEASON_TABLE:
            marker = match["head"].partition("\n")[0]
            return f"{marker}\n{of_season(len(match['rows'].splitlines()))}"
        name, lines = match["name"], match["rows"].splitlines()
        labels = [line.split("|")[1].strip().removesuffix(" †") for line in lines]
        by_line = (
            [releases(name, label) for label in labels]
            if name in {*BOARDS, *REPRODUCED, "promises"}
            else []
        )
        below, release = caption(name, by_line) if any(by_line) else ("", "")
        marks = [" †" if line - {release} else "" for line in by_line] or [""] * len(labels)
        width = match["head"].splitlines()[1].count("|") - 2
        texts = (cells_of(name, label) for label in labels)
        texts = [" | ".join(["–"] * width) if text == "–" else text for text in texts]  # noqa: RUF001
        rows = zip(labels, marks, texts, strict=True)
        return match["head"] + "".join(f"| {a}{b} | {c} |\n" for a, b, c in rows) + below

    return re.sub(
        r"(?P<head><!-- table: (?P<name>[a-z0-9 -]+) -->\n\|[^\n]*\n\|[-|]+\|\n)"
        r"(?P<rows>(?:\|[^\n]*\n)+)(?:\n\*Records of [^\n]*\*\n)?",
        table,
        page,
    )


def problems(pages: dict[Path, str]) -> Iterator[str]:
    """Yield a line for each number of a document that is not that of what is committed.

    Parameters
    ----------
    pages
        The Markdown of `PAGES` and of `FILLED_ONLY` by path.
    """
    for path, text in pages.items():
        if filled(text) != text:
            yield f"{path.relative_to(ROOT)}: tables are out of date, run docs/figures/tables.py"
    for name in {*TABLES} | {SEASON_TABLE}:
        if not any(f"<!-- table: {name} -->\n|" in text for text in pages.values()):
            yield f"no page has the table {name}"
    yield from sentences.problems(pages[path] for path in PAGES)
    yield from in_output(pages[README])
    yield from of_suites()
    yield from of_leaderboard()


def printed(*arguments: str) -> str:
    """Return what a command prints."""
    with redirect_stdout(io.StringIO()) as output, patch.dict(os.environ, {"COLUMNS": "100"}):
        code = oodd_eval([*arguments])
    if code:
        raise RuntimeError(f"oodd-eval {' '.join(arguments)}: exit code {code}, expected 0")
    return output.getvalue()


def in_output(readme: str) -> Iterator[str]:
    """Yield a line where the README's main command prints something else of its records."""
    command = readme.partition("<!-- command: main -->")[2]
    with TemporaryDirectory() as directory:
        ResultsDirectory(Path(directory)).merge_records(read_records(MAIN))
        text = printed("show", "--stored", directory)
    if not text.startswith(command.partition("```text\n")[2].partition("```")[0]):
        yield f"README.md: the main command prints\n{text}"


def of_suites() -> Iterator[str]:
    """Yield a line for each suite's page that its records do not give."""
    for page in sorted((BOARD / "suites").glob("*/README.md")):
        name = page.parent.relative_to(ROOT)
        if printed("show", str(page.parent), "--stored", "--markdown") != read_text(page):
            yield f"{name}: out of date, run `oodd-eval show {name} --stored --markdown`"


def of_leaderboard() -> Iterator[str]:
    """Yield a line for each line of the board's page, tables and published file that differs.

    Numbers may differ by one in their last printed digit: sums are rounded otherwise on other
    processors. ``leaderboard build --check`` compares bytes.
    """
    files = documents(leaderboard())
    tables = {path.relative_to(BOARD).as_posix() for path in (BOARD / "tables").glob("*.csv")}
    for name in sorted(tables - {*files}):
        yield f"leaderboard/{name} is of no record"
    with TemporaryDirectory() as directory:
        for name, content in files.items():
            fresh, committed = Path(directory) / Path(name).name, BOARD / name
            fresh.write_bytes(content if isinstance(content, bytes) else content.encode())
            texts = read_text(fresh), read_text(committed) if committed.exists() else ""
            yield from (f"leaderboard/{name}: {line}" for line in unlike(*texts))


NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?![\w.])")


def digit(text: str) -> float:
    """Return what one unit of a number's last printed digit is worth; 0 for whole numbers."""
    if text.lstrip("-").isdigit():
        return 0.0
    mantissa, _, exponent = text.partition("e")
    if len(exponent) > 3:
        return 0.0  # the beginning of a digest
    return 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))


def unlike(fresh: str, committed: str) -> Iterator[str]:
    """Yield a line for each line of two texts that differs by more than rounding."""
    pairs = zip_longest(fresh.splitlines(), committed.splitlines(), fillvalue="")
    for i, (new, old) in enumerate(pairs, start=1):
        if new == old:
            continue
        words = [NUMBER.sub("#", re.sub(r" +|-{3,}", " ", text)) for text in (new, old)]
        numbers = zip(NUMBER.findall(new), NUMBER.findall(old), strict=False)
        near = all(abs(float(a) - float(b)) <= 1.001 * digit(b) for a, b in numbers)
        if words[0] != words[1] or not near:
            yield f"line {i}: {old[:200]!r} is committed, the records give {new[:200]!r}"


def main(arguments: list[str]) -> int:
    """Fill the pages, or with ``--check`` print what is wrong in the documents."""
    pages = {path: path.read_text(encoding="utf-8") for path in (*PAGES, *FILLED_ONLY)}
    if arguments == ["--check"]:
        lines = [*problems(pages)]
        print("\n".join(lines) or "numbers of the documents are those of what is committed")
        return int(bool(lines))
    for path, text in pages.items():
        if (after := sentences.filled(filled(text))) != text:
            path.write_text(after, encoding="utf-8")
            print("changed:", path.relative_to(ROOT))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
