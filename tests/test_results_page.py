"""Numbers of the page on what was found are those of the committed board and reproduction."""

import csv
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from oodd_eval.cli.main import main
from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.leaderboard.entry import read_entries, read_grants
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.identity import Setting
from oodd_eval.results.tables.board import boards

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "results.md").read_text()
COLUMNS = ("auc_matched", "auc_unpaired", "auc_smoothed", "found_within_20_at_5pct",
           "missed_at_5pct", "false_episodes_at_5pct")  # fmt: skip


@pytest.fixture(scope="module")
def entries():
    return read_entries(ROOT / "leaderboard" / "results")


def section(title):
    return PAGE.partition(f"\n## {title}\n")[2].partition("\n## ")[0]


def ranking(split="mini"):
    (file,) = (ROOT / "leaderboard" / "tables").glob(f"{split}-*-ranking.csv")
    with file.open() as lines:
        rows = [r for r in csv.DictReader(lines) if r["primary"] == "true"]
    return {r["detector"]: r for r in rows}


@pytest.mark.parametrize(
    ("split", "title"), [("mini", "What finds how much"), ("standard", "On longer episodes")]
)
def test_the_table_is_the_boards(split, title):
    number = r" \| ".join([r"([\d.]+)"] * len(COLUMNS))
    rows = re.findall(rf"^\| `([a-z-]+)` \| {number} \|$", section(title), re.MULTILINE)
    board = ranking(split)
    assert {"riqn", "npn", "rf", "mewma", "mahalanobis", "range"} <= {r[0] for r in rows}
    for name, *found in rows:
        expected = [100 * float(board[name][column]) for column in COLUMNS]
        assert [float(n) for n in found] == pytest.approx(expected, abs=0.051), name
    shown = [float(r[1]) for r in rows]
    assert shown == sorted(shown, reverse=True)


def test_the_table_of_fresh_seeds_is_that_of_the_grants():
    means = {}
    for grant in read_grants(ROOT / "leaderboard" / "results").values():
        assert grant.trust == "re-run"
        means |= grant.means
    number = r" \| ".join([r"([\d.]+)"] * 6)
    text = section("Run again on fresh seeds")
    rows = re.findall(rf"^\| `([a-z-]+)` \| {number} \|$", text, re.MULTILINE)
    assert {"pe-a", "riqn", "npn", "rf", "persistence"} <= {r[0] for r in rows}
    metrics = {"auc_matched": 100, "false_episodes_at_5pct": 100, "delay_censored_at_5pct": 1}
    for name, *found in rows:
        expected = [unit * value for m, unit in metrics.items() for value in means[name][m]]
        assert [float(n) for n in found] == pytest.approx(expected, abs=0.051), name
    changes = [abs(one - other) for one, other in (m["auc_matched"] for m in means.values())]
    assert max(changes) < 0.03
    for name in ("pe", "pe-a", "riqn", "npn"):
        assert abs(np.diff(means[name]["auc_matched"])) < 0.01
    false = {name: m["false_episodes_at_5pct"][1] for name, m in means.items()}
    assert np.mean([*false.values()]) == pytest.approx(0.03, abs=0.005)
    assert np.mean([v for n, v in false.items() if n.startswith("pe")]) == pytest.approx(
        0.05, abs=0.005
    )


def test_the_table_by_environment_is_the_boards(entries):
    records = [r for e in entries for r in e.records if r.split == "mini"]

    def mean(detector, group, metric):
        wanted = (detector, environment, group)
        own = [r for r in records if (str(r.setting), r.environment, r.group) == wanted]
        return 100 * np.mean([r.value(metric) for r in own])

    pair = r"([\d.]+), ([\d.]+)"
    rows = re.findall(
        rf"^\| (\w+) \| {pair} \| {pair} \| (\d+) \| (\d+) \| (\d+) \|$", PAGE, re.MULTILINE
    )
    assert [r[0] for r in rows] == list(ENVIRONMENTS)
    for environment, *found in rows:
        expected = [
            mean(d, g, "auc_matched") for g in ("sensor", "dynamics") for d in ("pe", "pe-a")
        ]
        assert [float(n) for n in found[:4]] == pytest.approx(expected, abs=0.051), environment
        missed = [mean(d, "dynamics", "missed_at_5pct") for d in ("mewma-a", "pe", "pe-a")]
        assert [float(n) for n in found[4:]] == pytest.approx(missed, abs=0.51), environment


def test_protocols_beside_each_other():
    archive = (ROOT / "docs" / "archive" / "protocol-1.md").read_text()
    rows = re.findall(
        r"^\| `([a-z-]+)`, protocol 1 → 2 \| ([\d.]+) → ([\d.]+) \|$", PAGE, re.MULTILINE
    )
    assert len(rows) >= 5
    mini = archive.split("## Board of mini")[1].split("## Board of reduced")[0]
    board = ranking()
    for name, before, after in rows:
        (old,) = re.findall(rf"\| {name}(?: \(trivial\))? \| Δ=1(?:, 3 seeds)? \| ([\d.]+) ", mini)
        assert (before, float(after)) == (
            old, pytest.approx(100 * float(board[name]["auc_matched"]), abs=0.051)
        ), name  # fmt: skip


def claims():
    with (ROOT / "leaderboard/reproduction/mini/claims.csv").open() as lines:
        return list(csv.DictReader(lines))


def test_verdicts_are_those_of_the_reproduction():
    verdicts = {(r["text"], r["kind"]): r["verdict"] for r in claims()}
    rows = re.findall(r"^\| ([^|]+) \| ([\w ]+) \| ([^|]+) \|$", PAGE, re.MULTILINE)
    found = [(text, paper, fair) for text, paper, fair in rows if (text, "paper") in verdicts]
    assert len(found) >= 12
    for text, paper, fair in found:
        assert (paper, fair) == (
            verdicts[text, "paper"],
            verdicts.get((text, "fair"), "\N{EN DASH}"),
        ), text


def test_verdicts_are_counted_rightly():
    counted = Counter(r["verdict"] for r in claims() if r["kind"] == "paper")
    text = " ".join(PAGE.split())
    assert f"Of {sum(counted.values())} claims" in text
    for verdict, many in counted.items():
        assert re.search(rf"\b{many}( are)? {verdict}", text), verdict


@pytest.mark.parametrize(
    ("heading", "table1", "paper"),
    [
        ("At the paper's losses", "mini", "mini-paper"),
        ("At the paper's losses, on whole episodes", "standard", "reduced-paper"),
    ],
)
def test_the_table_at_the_papers_losses_is_that_of_both_reproductions(heading, table1, paper):
    def means(split):
        file = ROOT / "leaderboard" / "reproduction" / split / "tables" / "table-5.csv"
        with file.open() as lines:
            own = [r for r in csv.DictReader(lines) if r["environment"] == "mean"]
        return {(r["series"], r["anomalies"]): r for r in own if r["metric"] == "auc"}

    ours, same = means(table1), means(paper)
    section = re.split(r"\n##+ ", PAGE.split(f"### {heading}\n")[1])[0]
    rows = re.findall(r"^\| ([A-Z+]+) \| ([\d. |]+) \|$", section, re.MULTILINE)
    assert [r[0] for r in rows] == ["RIQN", "RIQN+MS", "NPN", "RF", "AVG"]
    for name, found in rows:
        keys = [(name, group) for group in ("sensor", "dynamics")]
        expected = [v for k in keys for v in (same[k]["paper"], ours[k]["value"], same[k]["value"])]
        assert [float(n) for n in found.split(" | ")] == pytest.approx(
            [100 * float(v) for v in expected], abs=0.051
        )


def verdicts(reproduction):
    """Verdicts by the paper's measures of a committed reproduction, by claim."""
    with (ROOT / "leaderboard" / "reproduction" / reproduction / "claims.csv").open() as lines:
        return {r["claim"]: r["verdict"] for r in csv.DictReader(lines) if r["kind"] == "paper"}


def test_claims_on_standard_are_counted_rightly():
    settled = {"by definition", "by construction"}
    found = {c: v for c, v in verdicts("standard").items() if v not in settled}
    run = {claim: verdict for claim, verdict in found.items() if verdict != "not run"}
    mini = verdicts("mini")
    differ = [claim for claim, verdict in run.items() if verdict != mini[claim]]
    text = " ".join(PAGE.split())
    assert f"[{len(run)} of {len(found)}](../leaderboard/reproduction/standard/README.md)" in text
    assert sorted(differ) == ["delay-riqn-npn", "delay-riqn-rf", "memory-1-7"]
    assert "Three of them differ" in text


def test_losses_on_whole_episodes_are_those_of_table_2():
    file = ROOT / "leaderboard" / "reproduction" / "reduced-paper" / "tables" / "table-2.csv"
    kept = {"ours": {}, "paper": {}}
    with file.open() as lines:
        for r in csv.DictReader(lines):
            if r["environment"] in ENVIRONMENTS:
                for who, column in (("ours", "value"), ("paper", "paper")):
                    kept[who].setdefault(r["environment"], {})[r["kind"]] = float(r[column])
    lost = {
        who: {e: 100 * (1 - np.mean([own[k] for k in own if k != "nominal"]) / own["nominal"])
              * np.sign(own["nominal"]) for e, own in both.items()}
        for who, both in kept.items()
    }  # fmt: skip
    text = " ".join(PAGE.split())
    found = re.search(
        r"robots lose (\d+) \((\w+)\), (\d+) \((\w+)\), (\d+) \((\w+)\) and (\d+) % \((\w+)\) "
        r"of their return; the paper's lost (\d+) to (\d+) %. The classic three lose (\d+) to "
        r"(\d+) %, the paper's (\d+) to (\d+) %",
        text,
    ).groups()
    robots = {e: info.title for e, info in ENVIRONMENTS.items() if not info.discrete}
    assert dict(zip(found[1:8:2], map(int, found[:8:2]), strict=True)) == {
        title: round(lost["ours"][e]) for e, title in robots.items()
    }
    ranges = [
        sorted(round(x) for e, x in lost[who].items() if (e in robots) == of_robots)
        for who, of_robots in (("paper", True), ("ours", False), ("paper", False))
    ]
    ends = [n for own in ranges for n in (own[0], own[-1])]
    assert [int(n) for n in found[8:]] == ends
    # To within the spread of 20 test seeds robots lose what the paper's lost.
    assert max(abs(lost["ours"][e] - lost["paper"][e]) for e in robots) < 5


def test_claims_on_whole_episodes_are_told_rightly():
    place = ROOT / "leaderboard" / "reproduction"
    found = {}
    for split in ("reduced-paper", "mini-paper"):
        with (place / split / "claims.csv").open() as lines:
            for r in csv.DictReader(lines):
                found[split, r["claim"], r["kind"]] = r
    own = {key[1:]: r for key, r in found.items() if key[0] == "reduced-paper"}

    def points(claim, kind, factor=100, split="reduced-paper"):
        r = found[split, claim, kind]
        return [f"{factor * float(r[end]):.1f}" for end in ("value", "low", "high")]

    text = " ".join(PAGE.split())
    auc, matched = (points("sensor-above-dynamics-models", kind) for kind in ("paper", "fair"))
    few = points("sensor-above-dynamics-models", "paper", split="mini-paper")
    assert "by {} [{}, {}] points, and by {} [{}, {}] of matched AUC".format(*auc, *matched) in text
    assert f"sensor anomalies were easier by {few[0]} points" in text
    above = [points("riqn-above-npn-1", kind, -100)[0] for kind in ("paper", "fair")]
    assert "by {} points of AUC and {} of matched AUC".format(*above) in text
    longer = points("delay-riqn-npn", "paper", -1)[0]
    assert f"longer than NPN's by {longer} steps, as on `standard`; on" in text
    with (place / "reduced-paper" / "tables" / "table-5.csv").open() as lines:
        rows = [r for r in csv.DictReader(lines) if (r["series"], r["metric"]) == ("AVG", "auc")]
    means = {(r["environment"], r["anomalies"]): float(r["value"]) for r in rows}
    better = [e for e in ENVIRONMENTS if means[e, "dynamics"] > means[e, "sensor"]]
    assert better == ["hopper", "walker2d"]
    assert "In Hopper and Walker2D dynamics anomalies are found better" in text
    assert f"RIQN by {points('riqn-above-riqn-ms-10', 'paper', -100)[0]} points" in text
    assert f"N-RIQN by {points('memory-10-7', 'paper')[0]} points; at Δ = 1" in text
    assert f"one by {points('ensemble-1', 'paper')[0]} points at Δ = 1" in text
    assert round(float(own["delay-grows-10", "paper"]["value"])) == 3
    settled = {"by definition", "by construction"}
    counted = [r["verdict"] for (_, kind), r in own.items() if kind == "paper"]
    counted = [verdict for verdict in counted if verdict not in settled]
    missing = [c for (c, kind), r in own.items() if (r["verdict"], kind) == ("not run", "paper")]
    assert all("-20" in claim for claim in missing)
    assert f"{len(counted) - len(missing)} of {len(counted)} claims were [computed on it]" in text
    assert f"Δ = 20, which {len(missing)} claims are about" in text
    expected = {
        "memory-1-7": "negligible", "samples-4": "negligible", "ensemble-10": "negligible",
        "riqn-ms-above-npn-10": "refuted",
        "sensor-above-dynamics-everywhere": "refuted", "riqn-above-npn-1": "refuted",
        "npn-above-rf-1": "confirmed", "riqn-above-rf-1": "confirmed", "delay-riqn-npn": "refuted",
    }  # fmt: skip
    assert {c: own[c, "paper"]["verdict"] for c in expected} == expected
    assert found["mini-paper", "delay-riqn-npn", "paper"]["verdict"] == "confirmed"


SUITES = ROOT / "leaderboard" / "suites"


def test_the_ladder_is_that_of_the_suites_page():
    page = (SUITES / "ladder/README.md").read_text(encoding="utf-8").replace("\\", "")
    table = page.partition("\n### Detection thresholds, lower is better")[2].split("\n\n")[1]
    header, _, *rows = [[x.strip() for x in line.split("|")[1:-1]] for line in table.splitlines()]
    names = header[5:]
    found = re.findall(r"^\| `([a-z-]+)` \| (\S+ \[[^]]+\]) \| (.+) \|$", PAGE, re.MULTILINE)
    assert [f"`{name}`" for name in names] == re.findall(r"`\w+`", PAGE.split("| threshold |")[1])[
        : len(names)
    ]
    expected = [(row[0], row[1], " | ".join(row[5:])) for row in rows]
    assert found == expected


@pytest.mark.parametrize("suite", ["ladder", "noisy-1", "noisy-5", "horizons"])
def test_the_page_of_a_suite_is_printed_from_its_records(suite, capsys):
    own = SUITES / suite
    assert main(["show", str(own), "--stored", "--markdown"]) == 0
    told = f"run `oodd-eval show leaderboard/suites/{suite} --stored --markdown`"
    assert capsys.readouterr().out == (own / "README.md").read_text(encoding="utf-8"), told


def rows_of_nine(title):
    """Return the rows of a section's table that have a detector and nine numbers."""
    number = r" \| ".join([r"(-?[\d.]+)"] * 9)
    return re.findall(rf"^\| `([a-z-]+)` \| {number} \|$", section(title), re.MULTILINE)


UNDER_NOISE = ("auc_matched", "found_within_20_at_5pct", "false_episodes_at_5pct")


def test_the_table_under_noise_is_that_of_the_records(entries):
    """Detector seed 0 on mini and on both noisy splits, metric by metric."""
    chosen = [r for e in entries for r in e.records if r.split == "mini" and r.seed == 0]
    (mini,) = boards(chosen)
    noisy = (ResultsDirectory(SUITES / name).records() for name in ("noisy-1", "noisy-5"))
    (one,), (five,) = map(boards, noisy)

    def mean(board, row, metric):
        return 100 * board.mean(row, board.environments, board.anomalies, metric).value

    rows = rows_of_nine("With noise in every sensor")
    assert {r[0] for r in rows} == {row.detector for row in five.entries}
    for name, *found in rows:
        row = Setting(name)
        expected = [mean(board, row, m) for m in UNDER_NOISE for board in (mini, one, five)]
        assert [float(n) for n in found] == pytest.approx(expected, abs=0.051), name
    shown = [float(r[3]) for r in rows]
    assert shown == sorted(shown, reverse=True)


def test_longer_horizons_are_told_as_the_records_have_them():
    """With detector seed 0 on reduced; at one step beside what the board of standard has."""
    (board,) = boards(ResultsDirectory(SUITES / "horizons").records())
    robots = [name for name, info in ENVIRONMENTS.items() if not info.discrete]
    classic = [name for name in ENVIRONMENTS if name not in robots]

    def mean(name, horizon, metric="auc_matched", environments=board.environments):
        row = Setting(name, horizon)
        return 100 * board.mean(row, environments, board.anomalies, metric).value

    found = "found_within_20_at_5pct"
    rows = rows_of_nine("At longer horizons")
    names = {row.detector for row in board.entries}
    assert {r[0] for r in rows} == names
    for name, *numbers in rows:
        metrics = ("auc_matched", found, "missed_at_5pct")
        expected = [mean(name, h, m) for m in metrics for h in (1, 10, 20)]
        assert [float(n) for n in numbers] == pytest.approx(expected, abs=0.051), name
    shown = [float(r[1]) for r in rows]
    assert shown == sorted(shown, reverse=True)

    def gain(name, horizon, environments=board.environments):
        return mean(name, horizon, environments=environments) - mean(
            name, 1, environments=environments
        )

    text = " ".join(section("At longer horizons").split())
    assert all(mean(name, 20, found) < mean(name, 1, found) for name in names)
    better = {name for name in names if gain(name, 20) > 0}
    assert better == {"pe-step", "pe-step-a", "persistence"}
    single = ("pe-step", "rf", "riqn-ms", "npn")
    told = [f"{gain(name, 10, robots):.1f}" for name in single]
    assert (
        "gains {} points of matched AUC there, `rf` {}, `riqn-ms` {} and `npn` {}.".format(*told)
        in text
    )
    told = [f"{-gain(name, 10, classic):.1f}" for name in single]
    assert "they lose {}, {}, {} and {}.".format(*told) in text
    assert all(gain(n, 10, robots) < 0 for n in ("pe", "pe-a", "mewma", "mewma-a", "rf-ewma"))
    told = [f"{-gain(name, 20):.1f}" for name in ("n-riqn", "riqn", "riqn-ms")]
    assert (
        "falls by {} points from Δ = 1 to 20, `riqn` by {} and `riqn-ms` by {}.".format(*told)
        in text
    )
    first = ranking("standard")
    apart = {m: [100 * float(first[n][m]) - mean(n, 1, m) for n in names]
             for m in ("auc_matched", found)}  # fmt: skip
    assert round(max(map(abs, apart["auc_matched"])), 1) == 0.3
    assert round(max(apart[found])) == 6
