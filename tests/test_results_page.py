"""Numbers of the page on what was found are those of what is committed under leaderboard/."""

import importlib.util
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from oodd_eval.cli.main import main
from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.results.identity import Setting

ROOT = Path(__file__).parents[1]
SPEC = importlib.util.spec_from_file_location("tables", ROOT / "docs" / "figures" / "tables.py")
tables = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(tables)
claims, lines, mean = tables.claims, tables.lines, tables.mean

BOARD = ROOT / "leaderboard"
PAGE, README = ((ROOT / name).read_text() for name in ("docs/results.md", "README.md"))
TEXT = " ".join(PAGE.split())
ROBOTS = [name for name, info in ENVIRONMENTS.items() if not info.discrete]
CLASSIC = [name for name in ENVIRONMENTS if name not in ROBOTS]


def test_tables_are_those_of_what_is_committed():
    """README and the page of results; `tables.py` without ``--check`` writes them."""
    assert all(f"<!-- table: {name} -->\n|" in PAGE + README for name in tables.TABLES)
    assert tables.main(["--check"]) == 0


def test_a_wrong_number_in_a_table_is_put_right():
    row = re.search(r"(?m)^\| `pe-step-a` \|.*$", PAGE)[0]
    assert tables.filled(PAGE.replace(row, row.replace(".", ".9"))) == PAGE


@pytest.mark.parametrize("suite", ["ladder", "noisy-1", "noisy-5", "horizons", "worlds", "logs"])
def test_the_page_of_a_suite_is_printed_from_its_records(suite, capsys):
    directory = BOARD / "suites" / suite
    assert main(["show", str(directory), "--stored", "--markdown"]) == 0
    advice = f"run `oodd-eval show leaderboard/suites/{suite} --stored --markdown`"
    assert capsys.readouterr().out == (directory / "README.md").read_text(encoding="utf-8"), advice


# Claims of the paper


def counted(split):
    """The verdicts by the paper's measures that data decide, by claim."""
    settled = {"by definition", "by construction"}
    rows = {c: r["verdict"] for (c, kind), r in claims(split).items() if kind == "paper"}
    return {claim: verdict for claim, verdict in rows.items() if verdict not in settled}


def test_verdicts_are_counted():
    counts = Counter(r["verdict"] for (_, kind), r in claims("mini").items() if kind == "paper")
    assert f"Of {sum(counts.values())} claims" in TEXT
    for verdict, many in counts.items():
        assert re.search(rf"\b{many}( are)? {verdict}", TEXT), verdict


def test_claims_that_were_run_on_other_splits_are_counted_rightly():
    for split in ("standard", "reduced-paper"):
        verdicts = counted(split)
        run = [claim for claim, verdict in verdicts.items() if verdict != "not run"]
        assert f"{len(run)} of {len(verdicts)}" in TEXT
        assert f"reproduction/{split}/README.md" in PAGE
    mini = counted("mini")
    differ = [c for c, v in counted("standard").items() if v not in ("not run", mini[c])]
    assert sorted(differ) == ["delay-riqn-npn", "delay-riqn-rf", "memory-1-7"]


# Sentences: a phrase of the page with the numbers that it has to have


def points(claim, kind="paper", factor=100, split="reduced-paper", ends=("value",)):
    return [f"{factor * float(claims(split)[claim, kind][end]):.1f}" for end in ends]


def gains(horizon, environments, names, sign=1):
    auc = "auc_matched"
    for name in names:
        one, other = (mean("horizons", Setting(name, h), auc, environments=environments or ())
                      for h in (1, horizon))  # fmt: skip
        yield f"{sign * (other - one):.1f}"


def hidden(*names):
    """Cells at +1 and +5 % loss, all cells, and in how many of the former each row finds half."""
    cells = {name: {} for name in names}
    for r in tables.board("worlds").records:
        if (name := str(r.setting)) in cells:
            shares = cells[name].setdefault((r.environment, r.anomaly, r.strength), [])
            shares.append(r.value("found_within_100_at_5pct"))
    weak = {n: [np.mean(x) for c, x in by.items() if c[2] in ("loss1", "loss5")]
            for n, by in cells.items()}  # fmt: skip
    (first, *_) = names
    return [len(weak[first]), len(cells[first]), *(sum(x >= 0.5 for x in weak[n]) for n in names)]


STEPS = ("pe-step", "rf", "riqn-ms", "npn")
ENDS = ("value", "low", "high")
EASIER = "sensor-above-dynamics-models"


SENTENCES = [
    ("gains {} points of matched AUC there, `rf` {}, `riqn-ms` {} and `npn` {}.",
     lambda: gains(10, ROBOTS, STEPS)),
    ("they lose {}, {}, {} and {}.",
     lambda: gains(10, CLASSIC, STEPS, -1)),
    ("falls by {} points from Δ = 1 to 20, `riqn` by {} and `riqn-ms` by {}.",
     lambda: gains(20, None, ("n-riqn", "riqn", "riqn-ms"), -1)),
    ("by {} [{}, {}] points, and by {} [{}, {}] of matched AUC",
     lambda: [*points(EASIER, ends=ENDS), *points(EASIER, "fair", ends=ENDS)]),
    ("sensor anomalies were easier by {} points", lambda: points(EASIER, split="mini-paper")),
    ("by {} points of AUC and {} of matched AUC",
     lambda: [*points("riqn-above-npn-1", "paper", -100),
              *points("riqn-above-npn-1", "fair", -100)]),
    ("longer than NPN's by {} steps, as on", lambda: points("delay-riqn-npn", factor=-1)),
    ("RIQN by {} points", lambda: points("riqn-above-riqn-ms-10", factor=-100)),
    ("N-RIQN by {} points; at Δ = 1", lambda: points("memory-10-7")),
    ("one by {} points at Δ = 1", lambda: points("ensemble-1")),
    ("{} of {} cells are `loss1` and `loss5`.", lambda: hidden("oracle")[:2]),
    ("episodes are found by `oracle` in {} of them, by `mewma-a` in {} and by `pe-a` in {}.",
     lambda: hidden("oracle", "mewma-a", "pe-a")[2:]),
]  # fmt: skip
"""Phrases of the page with the numbers that they have to have."""


@pytest.mark.parametrize(("phrase", "numbers"), SENTENCES)
def test_sentences_have_the_numbers_of_what_is_committed(phrase, numbers):
    assert phrase.format(*numbers()) in TEXT


NUMBER = re.compile(
    r"(?<![\w.,/-])[-\N{MINUS SIGN}+~]?(?:\d+(?:\.\d+)?|\.\d+)(?![\w]|[.,/-]\d|-[a-z])"
)
SETTINGS = (
    r"Δ = \d+(?:(?:,| and| or) \d+)*",
    r"\d+(?: and \d+)? (?:training|calibration|test|cells|kinds|networks|pairs)\b",
    r"(?:[Aa]t|of|to|than|most) (?:10|5|1|0\.5) %",  # levels of guaranteed alarms
    r"within (?:20|100) (?:control )?(?:steps|rows)|most 300 (?:steps|transitions)",
    r"(?:[Pp]rotocol|Tables?|Fern) \d+(?: to \d+)?|Python 3\.11",
    r"50 % is chance|longer after 150 steps",
    r"600 times cheaper",  # says another paper
)
"""What the reader is told of the settings and by others, which no result decides."""

PENDING = (
    "What the true equations reach", "Worlds with nominal variation", "With noise in every sensor",
    "Weaker anomalies: the ladder", "On longer episodes", "At longer horizons",
    "What held of the paper", "How the records were made",
)  # fmt: skip
"""Sections that are written anew with the results of protocol 3."""

FILLED = re.compile(r"<!-- table: [a-z0-9 -]+ -->\n((?:\|[^\n]*\n)+)")


def prose(section):
    """The text of a section without code, comments, addresses, and tables that are filled."""
    text = re.sub(r"(?ms)^```.*?^```", "", FILLED.sub("", section))
    for pattern, instead in (("<!--.*?-->", ""), (r"\]\([^)]*\)", "]"), ("`[^`]*`", "`x`")):
        text = re.sub(pattern, instead, text)
    return " ".join(text.split())


def unsourced(section):
    """Numbers of a section that are in none of its filled tables, with the words around them."""
    rows = [line for table in FILLED.findall(section) for line in table.splitlines()[2:]]
    cells = [float(n) for line in rows for n in NUMBER.findall(line[1:].partition("|")[2])]
    text = prose(section)
    for phrase, numbers in SENTENCES:
        text = text.replace(prose(phrase.format(*numbers())), "")
    text = re.sub("|".join(SETTINGS), " ", text)
    for match in NUMBER.finditer(text):
        number = match[0].lstrip("~+").replace("\N{MINUS SIGN}", "-")
        half = 0.5 * 10.0 ** -len(number.partition(".")[2]) + 1e-9
        if not any(abs(float(number) - cell) <= half for cell in cells):
            yield text[max(0, match.start() - 40) : match.end() + 30]


@pytest.mark.parametrize("page", [README, PAGE], ids=["README", "results"])
def test_every_number_of_the_text_is_in_a_table_that_is_filled_or_in_a_checked_sentence(page):
    """A difference or a count is one of `SENTENCES`; what no result decides, one of `SETTINGS`."""
    found = {}
    for section in re.split(r"(?m)^(?=## )", page):
        title = section.splitlines()[0].strip("# ")
        if title not in PENDING and (numbers := [*unsourced(section)]):
            found[title] = numbers
    assert not found


def test_a_number_without_a_source_is_seen():
    table = "<!-- table: board mini -->\n| row | AUC |\n|---|---|\n| `pe` | 96.3 |\n\n"
    section = f"## Of rows\n\n{table}"
    assert [*unsourced(section + "It has 96.3 %, about 96.\n")] == []
    assert [*unsourced(section + "It has 96.4 %.\n")] == ["## Of rows It has 96.4 %."]


def test_losses_on_whole_episodes_are_those_of_table_2():
    kept = {"value": {}, "paper": {}}
    for r in lines("reproduction/reduced-paper/tables/table-2.csv"):
        for column, by_environment in kept.items():
            if r["environment"] in ENVIRONMENTS:
                by_environment.setdefault(r["environment"], {})[r["kind"]] = float(r[column])

    def lost(column, environment):
        of = dict(kept[column][environment])
        nominal = of.pop("nominal")
        return round(100 * (1 - np.mean([*of.values()]) / nominal) * np.sign(nominal))

    for environment in ROBOTS:
        title = ENVIRONMENTS[environment].title
        assert re.search(rf"\b{lost('value', environment)} %? ?\({title}\)", TEXT), title
    for column, names in (("paper", ROBOTS), ("value", CLASSIC), ("paper", CLASSIC)):
        losses = [lost(column, name) for name in names]
        assert f"{min(losses)} to {max(losses)} %" in TEXT
