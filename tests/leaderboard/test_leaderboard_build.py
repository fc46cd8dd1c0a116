"""The board: standings, page and tables, what is never mixed, ``leaderboard build``."""

import csv
import dataclasses
import io
import lzma
import re
from pathlib import Path

import numpy as np
import pytest
from helpers_records import PAIRED, example, make_record
from helpers_site import submitted as entry
from oodd_leaderboard import pages as leaderboard_build
from oodd_leaderboard.pages import cells, page
from oodd_leaderboard.published import PUBLISHED
from oodd_leaderboard.reported import REPORTED, read_entries, sections

from oodd_eval.cli.main import main
from oodd_eval.data.facts import ENVIRONMENTS, SPLITS, TABLE1
from oodd_eval.data.files import decompress
from oodd_eval.data.split import published_digests
from oodd_eval.errors import ResultsError
from oodd_eval.metrics import catalogue
from oodd_eval.metrics.catalogue import UNDEFINED
from oodd_eval.results import board as results_board
from oodd_eval.results import tables
from oodd_eval.results.board import Board, expected_cells
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Metric
from oodd_eval.results.render.tabular import comparisons_csv, number, ranking_csv
from oodd_eval.results.standings import cost_of, primary_settings, ranked

SEEDS = 12


def record(detector, matched, *, environment="hopper", anomaly="iid", **more):
    """A record of twelve test seeds with all metrics a board may show."""
    values = {name: [0.5] * SEEDS for name in PAIRED}
    values |= {"auc_matched": matched, "delay": [3.0] * (SEEDS - 1) + [None]}
    one = make_record(detector, environment, anomaly, values=values, **more)
    one = dataclasses.replace(one, counts={"test": SEEDS})
    if not one.ok:
        return one
    none = np.repeat([[0.0], [1.0]], SEEDS, axis=1)
    per_trajectory = one.per_trajectory | {
        "false_episodes_at_5pct": none,
        "early_at_5pct": none,
        "missed_at_5pct": one.per_trajectory["missed"],
        "delay_censored_at_5pct": np.array([[60 * (1 - (m or 0)) for m in matched], none[1]]),
    }
    metrics = one.metrics | {name: Metric(0.5) for name in per_trajectory}
    return dataclasses.replace(
        one,
        metrics=metrics,
        per_trajectory=per_trajectory,
        seconds_fit=2.0,
        seconds_score=0.5,
        peak_rss_mb=100.0,
        inputs="observations",
        steps_scored=10_000,
    )


def board():
    """Records of four detectors in two environments; rf fails in one of them."""
    rng = np.random.default_rng(0)
    records = []
    for environment in ("ant", "hopper"):
        episodes = rng.uniform(0, 0.2, size=SEEDS)
        for detector, mean in (("riqn", 0.75), ("rf", 0.6), ("persistence", 0.55), ("clock", 0.5)):
            for anomaly in ("iid", "gravity"):
                failed = (detector, environment) == ("rf", "ant")
                own = {"status": "timeout", "reason": "after 5 s | <b>"} if failed else {}
                noise = 0.02 * rng.normal(size=SEEDS)
                matched = np.full(SEEDS, 0.5) if detector == "clock" else mean + episodes + noise
                records.append(
                    record(detector, matched, environment=environment, anomaly=anomaly, **own)
                )
        # A second method that is as good as the first, at another horizon.
        records += [
            record("riqn", 0.75 + episodes + 0.02 * rng.normal(size=SEEDS),
                   environment=environment, anomaly=anomaly, horizon=10)
            for anomaly in ("iid", "gravity")
        ]  # fmt: skip
    return records


def entries():
    trivial = [r for r in board() if r.detector in ("clock", "persistence")]
    others = [r for r in board() if r.detector in ("rf", "riqn")]
    other_split = [
        record(d, [v] * SEEDS, digest="cd" * 32) for d, v in (("riqn", 0.8), ("clock", 0.5))
    ]
    return [
        entry("reference", others, caption="Reduced: one network | all sensors.",
              citation="Danesh & Fern 2021", url="https://example.org/riqn"),
        entry("trivial", trivial),
        entry("other-split", other_split),
    ]  # fmt: skip


def write(root, submitted):
    for one in submitted:
        folder = root / one.meta.id
        folder.mkdir(parents=True)
        (folder / "entry.json").write_text(one.meta.to_json())
        lines = "".join(r.to_json() + "\n" for r in one.records)
        (folder / "records.jsonl").write_text(lines)
    return root


@pytest.fixture(autouse=True)
def small_site(monkeypatch):
    """The site has tests of its own; here it is one file that names the entries."""

    def files(given, _graded, *, project):
        names = " ".join(e.meta.id for section in given for e in section.entries)
        return {leaderboard_build.site.PAGE: names}

    monkeypatch.setattr(leaderboard_build.site, "files", files)


def lines_of(text):
    return list(csv.DictReader(io.StringIO(text)))


def built(tmp_path, submitted, name="out"):
    results = write(tmp_path / f"results-{name}", submitted)
    output = tmp_path / name
    code = main(["leaderboard", "build", str(results), "--output", str(output)])
    return code, results, output


def files_below(output):
    return {
        p.relative_to(output).as_posix(): p.read_bytes() for p in output.rglob("*") if p.is_file()
    }


# Rendering


def test_an_entry_declares_the_row_that_is_ranked_for_its_detector():
    def primary(*declared):
        records = [r for r in board() if r.detector != "rf"]
        found = sections([entry("mine", records, primary=list(declared))])[0]
        standings = found.ranks.standings
        return {s.entry.horizon for s in standings if s.entry.detector == "riqn" and s.primary}

    assert primary() == primary("riqn", "clock") == {1}
    assert primary("riqn[h=10]") == {10}
    with pytest.raises(ResultsError, match="expected one row a detector"):
        primary("riqn", "riqn[h=10]")
    # It has all cells of the usual row.
    usual = [r for r in board() if r.detector != "rf"]
    lacking = [r for r in usual if r.horizon == 1 or r.environment == "ant"]
    with pytest.raises(ResultsError, match="lacks 2 cells that 'riqn' has"):
        sections([entry("mine", lacking, primary=["riqn[h=10]"])])


@pytest.mark.parametrize("whole", [False, True])
def test_a_stranger_does_not_choose_the_row_that_is_ranked(whole):
    official = [r for r in board() if r.detector != "rf"]
    row = [dataclasses.replace(r, overrides={"trees": 1}) for r in official
           if r.detector == "riqn" and r.horizon == 1]  # fmt: skip
    stranger = row if whole else row[:1]
    with pytest.raises(
        ResultsError, match=r"'stranger' declares .* 'official' has rows of it, too"
    ):
        sections(
            [entry("official", official), entry("stranger", stranger, primary=["riqn[trees=1]"])]
        )
    # Without the statement it is a variant.
    ranks = sections([entry("official", official), entry("stranger", stranger)])[0].ranks
    assert {str(s.entry): s.rank for s in ranks.standings if s.primary} == {
        "riqn": 1, "persistence": 2, "clock": 3,
    }  # fmt: skip


@pytest.mark.parametrize("lacks", ["cells", "seeds"])
def test_part_of_a_simpler_row_does_not_stand_for_a_whole_one(lacks):
    def rows(horizon, seeds, anomalies=("iid", "gravity")):
        return [record("foo", [0.7] * SEEDS, seed=s, anomaly=a, horizon=horizon,
                       deterministic=False) for s in range(seeds) for a in anomalies]  # fmt: skip

    part = rows(1, 3, ("iid",)) if lacks == "cells" else rows(1, 1)
    own = [entry("official", rows(10, 3)), entry("stranger", part)]
    ranks = sections(own)[0].ranks
    assert [(str(s.entry), s.rank) for s in ranks.standings if s.primary] == [("foo[h=10]", 1)]


def test_a_page_has_every_table_of_every_board_and_the_entries():
    text = page(sections(entries()), site="site/index.html")
    first, second = text.split("\n## Split mini")[1:]
    assert len(re.findall(r"^### (.*)$", first, re.MULTILINE)) >= 9
    assert "### Failures" not in second
    assert "(#split-mini-protocol-1), digest abababababab: 5 rows" in text
    assert "(#split-mini-protocol-1-1), digest cdcdcdcdcdcd: 2 rows" in text
    ranking = first.partition("### Ranking")[2].partition("Rank is")[0]
    (line,) = [x for x in ranking.splitlines() if re.match(r"\| 1 .* riqn +\| Δ=1 ", x)]
    terms = [r.per_trajectory["auc_matched"][0] for r in board() if r.setting == Setting("riqn")]
    assert f"| {100 * np.mean(terms):.1f} " in line
    assert all(f"### {e.meta.id}: An entry" in text for e in entries())
    assert f"\n{REPORTED} Run by Somebody (4 detectors).\n" in first
    assert f"\n{REPORTED} Run by Somebody (2 detectors).\n" in second


def test_tables_for_programs_have_the_figures_of_the_ranking():
    section = sections(entries())[0]
    lines = lines_of(ranking_csv(section.ranks))
    assert [line["detector"] for line in lines] == [
        s.entry.detector for s in section.ranks.standings
    ]
    assert [line["rank"] for line in lines] == ["1", "1", "2", "3", ""]
    first = lines[0]
    assert float(first["auc_matched_low"]) < float(first["auc_matched"])
    assert float(first["auc_matched"]) < float(first["auc_matched_high"])
    assert (first["seconds_fit"], first["microseconds_per_step"], first["peak_rss_mb"]) == (
        "2", "50", "100",
    )  # fmt: skip
    pairs = lines_of(comparisons_csv(section.ranks))
    by_pair = {(p["first"], p["second"]): p for p in pairs}
    forth, back = by_pair["riqn", "clock"], by_pair["clock", "riqn"]
    assert float(forth["difference"]) == -float(back["difference"]) > 0
    assert (forth["better"], back["better"], forth["win_rate"]) == ("true", "false", "1")


@pytest.mark.parametrize("split", ["mini", "mine"])
@pytest.mark.parametrize("extra", [{"strength": "x"}, {"anomaly": "made-up"}])
def test_one_more_record_of_a_stranger_takes_no_rank_from_anybody(monkeypatch, split, extra):
    """Expected cells are the split's, not what any row has."""
    records = [dataclasses.replace(record(d, [v] * SEEDS, environment=e, anomaly=a), split=split)
               for d, v in (("a", 0.9), ("b", 0.8), ("clock", 0.5))
               for e in ENVIRONMENTS for a in TABLE1]  # fmt: skip
    monkeypatch.setattr(results_board, "published_digests", lambda: {"mini": "ab" * 32})
    before = ranked(records)
    assert before.ranking.ranks == {"a": 1, "b": 2, "clock": 3}
    more = dataclasses.replace(records[0], **extra)
    after = ranked([*records, more])
    assert after.ranking.ranks == before.ranking.ranks
    board = Board([*records, more])
    for row in board.entries:
        value = board.mean(row, board.environments, board.anomalies, "auc_matched")
        assert not value.partial
    # Nor does it make a variant the primary row.
    variant = [dataclasses.replace(r, overrides={"x": 1}) for r in records if r.detector == "a"]
    odd = dataclasses.replace(variant[0], **extra)
    assert str(next(s for s in primary_settings([*records, *variant, odd])
                    if s.detector == "a")) == "a"  # fmt: skip


def test_cells_of_a_published_split_are_expected_though_no_row_has_them(monkeypatch):
    records = [record("a", [0.9] * SEEDS), record("clock", [0.5] * SEEDS)]
    assert set(ranked(records).ranking.ranks) == {"a", "clock"}
    monkeypatch.setattr(results_board, "published_digests", lambda: {"mini": "ab" * 32})
    ranks = ranked(records)
    assert ranks.ranking.ranks == {}
    assert [s.state for s in ranks.standings] == ["55 of 56 cells missing"] * 2
    # Means are over the columns that a table has.
    assert not ranks.board.mean(Setting("a"), ["hopper"], ["iid"], "auc_matched").partial


@pytest.mark.parametrize("name", published_digests())
def test_expected_cells_of_published_splits_are_those_of_their_definition(name):
    digest = published_digests()[name]
    cells = expected_cells([dataclasses.replace(make_record(digest=digest), split=name)])
    assert {e for e, _ in cells} == set(ENVIRONMENTS)
    suites = Path(__file__).parents[2] / "leaderboard" / "suites"
    files = suites / name, Path(__file__).parents[2] / "leaderboard" / "results" / "paper-mini"
    for directory in filter(Path.is_dir, files):
        records = ResultsDirectory(directory).records()
        if {r.split_digest for r in records} == {digest}:
            assert {r.position for r in records} == cells


def test_equals_share_a_rank_and_a_letter_and_the_better_stand_before_the_trivial():
    other = [
        dataclasses.replace(r, detector="mine", horizon=1) if r.horizon == 10 else r
        for r in board()
    ]
    table = tables.ranking(ranked(other))
    places = [(r[0], r[1], r[3]) for r in table.rows]
    assert set(places[:2]) == {("1", "a", "riqn"), ("1", "a", "mine")}
    assert places[2:] == [
        ("3", UNDEFINED, "persistence (trivial)"),
        ("4", UNDEFINED, "clock (trivial)"),
        (UNDEFINED, UNDEFINED, "rf"),
    ]


def test_a_further_row_of_a_detector_is_a_variant_that_pushes_nobody_down():
    ranks = ranked(board())
    places = [(r[0], r[3], r[4]) for r in tables.ranking(ranks).rows]
    assert set(places[:2]) == {("1", "riqn", "Δ=1"), ("1", "riqn (variant)", "Δ=10")}
    assert [place[0] for place in places[2:]] == ["2", "3", UNDEFINED]
    assert any("pushes no other row down" in line for line in tables.ranking_notes(ranks))
    # Another row may be declared primary.
    ten = {s.entry for s in ranks.standings if s.entry.horizon == 10}
    others = {s.entry for s in ranks.standings if s.entry.detector != "riqn"}
    standings = ranked(board(), ten | others).standings
    assert {s.entry.horizon: s.primary for s in standings if s.entry.detector == "riqn"} == {
        1: False, 10: True,
    }  # fmt: skip


def test_a_primary_row_with_randomness_needs_three_seeds():
    def seeds(n, **more):
        return [record("riqn", [0.7] * SEEDS, seed=s, deterministic=False, **more)
                for s in range(n)]  # fmt: skip

    clock = record("clock", [0.5] * SEEDS)
    for n in (1, 2):
        ranks = ranked([*seeds(n), clock])
        assert f"Not ranked: riqn, {n} of 3 detector seeds." in tables.ranking_notes(ranks)
        assert ranks.ranking.ranks == {"clock": 1}
    assert ranked([*seeds(3), clock]).ranking.ranks == {"riqn": 1, "clock": 2}
    # A variant is marked anyway.
    variant = seeds(1, horizon=10)
    assert ranked([*seeds(3), *variant, clock]).ranking.ranks["riqn[h=10]"] == 1


def test_the_second_ranking_is_by_guaranteed_alarms_and_lower_is_better():
    ranks = ranked(board())
    assert {s.entry.detector: s.alarm_rank for s in ranks.standings if s.primary} == {
        "riqn": 1, "persistence": 2, "clock": 3, "rf": None,
    }  # fmt: skip
    slow = [
        dataclasses.replace(r, per_trajectory=r.per_trajectory | {
            "delay_censored_at_5pct": np.repeat([[90.0], [1.0]], SEEDS, axis=1)
        }) if r.detector == "riqn" else r
        for r in board()
    ]  # fmt: skip
    by_alarms = {s.entry.detector: s.alarm_rank for s in ranked(slow).standings if s.primary}
    assert by_alarms == {"riqn": 3, "persistence": 1, "clock": 2, "rf": None}
    # A row in which it is undefined says so, and has its other rank all the same.
    undefined = [
        dataclasses.replace(r, per_trajectory=r.per_trajectory | {
            "delay_censored_at_5pct": np.zeros((2, SEEDS))
        }) if (r.setting, r.environment) == (Setting("riqn"), "ant") else r
        for r in board()
    ]  # fmt: skip
    notes = tables.ranking_notes(ranked(undefined))
    assert "Without an alarm rank: riqn, undefined in 2 of 4 cells." in notes
    assert ranked(undefined).ranking.ranks == ranks.ranking.ranks


@pytest.mark.parametrize(
    ("records", "row", "state"),
    [
        (board(), "rf", "timeout in 2 of 4 cells"),
        ([r for r in board() if (r.horizon, r.environment, r.anomaly) != (10, "ant", "iid")],
         "riqn[h=10]", "1 of 4 cells missing"),
        ([record("riqn", [None] * SEEDS), record("clock", [0.5] * SEEDS)],
         "riqn", "undefined in 1 of 1 cell"),
        ([*board(), record("riqn", [0.7] * SEEDS, environment="ant", seed=1)],
         "riqn", "3 of 8 cells missing"),
    ],
)  # fmt: skip
def test_a_row_that_is_not_whole_is_listed_with_its_state_and_no_rank(records, row, state):
    ranks = ranked(records)
    assert f"Not ranked: {row}, {state}." in tables.ranking_notes(ranks)
    standing = next(s for s in ranks.standings if str(s.entry) == row)
    assert (standing.rank, np.isnan(standing.wins)) == (None, True)
    assert ranks.ranking.ranks["clock"] >= 1


def test_boards_without_any_ranked_row_are_rendered():
    failed = [make_record(status="error", reason="no"), make_record("rf", status="oom")]
    text = page(sections([entry("all-failed", failed)]))
    assert "Not ranked: riqn, error in 1 of 1 cell." in text
    assert "Win rates" not in text


def test_rows_that_share_the_first_rank_are_named_before_a_single_comparison():
    values = np.linspace(0.7, 0.9, SEEDS)
    near = [record("riqn", values), record("rf", values[::-1])]
    text = page(sections([entry("near", near)]))
    assert "**rf, riqn share the first rank: over all pairs of rows (Holm) no difference" in text
    apart = [record("riqn", values), record("rf", values - 0.3)]
    text = page(sections([entry("apart", apart)]))
    assert "**riqn beats rf by" in text
    assert "share the first rank" not in text


def test_win_rate_is_the_mean_over_the_other_rows():
    cells = [("ant", "iid"), ("ant", "gravity"), ("hopper", "iid"), ("hopper", "gravity")]
    values = {"a": [0.9, 0.9, 0.9, 0.6], "b": [0.8, 0.8, 0.8, 0.7], "c": [0.8, 0.1, 0.1, 0.1]}
    records = [
        record(name, [value] * SEEDS, environment=e, anomaly=x)
        for name, column in values.items()
        for (e, x), value in zip(cells, column, strict=True)
    ]
    ranks = ranked(records)
    # a beats b in 3 of 4 and c in 4 of 4; b ties with c in one and beats it in three.
    assert {str(s.entry): s.wins for s in ranks.standings} == {
        "a": (3 / 4 + 1) / 2, "b": (1 / 4 + 7 / 8) / 2, "c": (0 + 1 / 8) / 2
    }  # fmt: skip
    table = tables.wins(ranks)
    assert dict(zip(table.header, table.rows[1], strict=True)) == {
        "detector": "b", "a": "25", "b": "", "c": "88"
    }  # fmt: skip


def test_cost_counts_a_fit_once_for_all_its_anomalies():
    records = [
        dataclasses.replace(
            record("rf", [0.5] * SEEDS, environment=environment, anomaly=anomaly),
            seconds_fit=fit, seconds_score=score, peak_rss_mb=peak,
        )
        for environment, fit, score, peak in (("ant", 1.0, 0.1, 50.0), ("hopper", 4.0, 0.3, 40.0))
        for anomaly in ("iid", "gravity", "drift")
    ]  # fmt: skip
    cost = cost_of(records)
    tiny = dataclasses.replace(record("clock", [0.5] * SEEDS), seconds_fit=8.4e-05)
    assert tables.cost(ranked([tiny])).rows[0][3:] == ["< 0.001", "50", "100"]
    assert tables.cost(ranked([make_record()])).rows[0][3:] == [UNDEFINED] * 3
    # 0.4 s for 20 000 steps.
    assert (cost.fit, cost.peak) == (2.5, 50.0)
    assert cost.step == pytest.approx(20.0)


# What is mixed and what never


def test_no_table_mixes_digests_protocols_or_limits():
    one = record("riqn", [0.6] * SEEDS)
    others = [
        record("riqn", [0.7] * SEEDS, digest="cd" * 32),
        dataclasses.replace(record("riqn", [0.8] * SEEDS), protocol=2),
        record("riqn", [0.9] * SEEDS, limit=12),
    ]
    submitted = [entry(f"e{i}", [r]) for i, r in enumerate([one, *others])]
    found = sections(submitted)
    assert [len(s.ranks.board.records) for s in found] == [1, 1, 1, 1]
    assert len({s.name for s in found}) == 4
    text = page(found)
    assert text.count("\n## Split") == 4
    # The newest protocol first, limited ones last.
    assert [s.entries[0].meta.id for s in found] == ["e2", "e0", "e1", "e3"]


def test_other_splits_follow_from_the_most_data_to_the_least():
    names = ("mini", "another", "reduced", "standard", "paper")
    submitted = [
        entry(name, [dataclasses.replace(record("riqn", [0.6] * SEEDS, digest=f"{i}e" * 32),
                                         split=name)])
        for i, name in enumerate(names)
    ]  # fmt: skip
    assert [s.ranks.board.split for s in sections(submitted)] == [
        "standard", "paper", "reduced", "mini", "another"
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("split", "digest", "tier"),
    [
        ("mini", "mini", "Trial tier.** Per environment 40 training and 40 calibration"),
        ("ladder", "ladder", "A further test suite.** Per environment "),
        ("standard", "mini", "Not a published split."),
        ("mini@12345678", "", "Not a published split."),
    ],
)
def test_a_page_says_which_tier_a_split_is_and_never_by_its_name_alone(
    monkeypatch, split, digest, tier
):
    digests = {name: f"{i:02d}" * 32 for i, name in enumerate(SPLITS)}
    monkeypatch.setattr(leaderboard_build, "published_digests", lambda: digests)
    one = record("riqn", [0.6] * SEEDS, digest=digests.get(digest, "12" * 32))
    assert tier in page(sections([entry("one", [dataclasses.replace(one, split=split)])]))


def test_wide_tables_hold_default_rows_and_the_rest_is_in_files():
    rows = [record("riqn", [0.7] * SEEDS)]
    rows += [record("riqn", [0.7] * SEEDS, overrides={"members": i}) for i in range(1, 13)]
    text = page(sections([entry("many", rows)]))
    (header,) = [line for line in text.splitlines() if line.startswith("| Result")]
    assert "members" not in header
    assert "Win rates" not in text
    only = page(sections([entry("one", rows[1:3])]))
    assert "| Result" not in only


def test_nothing_depends_on_the_order_of_entries_or_records():
    turned = [
        dataclasses.replace(e, records=list(reversed(e.records))) for e in reversed(entries())
    ]
    one, other = sections(entries()), sections(turned)
    assert page(one) == page(other)
    for a, b in zip(one, other, strict=True):
        assert ranking_csv(a.ranks) == ranking_csv(b.ranks)


def test_two_rows_with_the_same_name_are_refused():
    records = [record("riqn", [0.5] * SEEDS, horizon=10), record("riqn[h=10]", [0.5] * SEEDS)]
    with pytest.raises(ResultsError, match=r"both called 'riqn\[h=10\]'"):
        ranked(records)


# Text of others


def test_nothing_that_others_wrote_becomes_markup():
    evil = "<script>x</script> | `a` \n# b [c](javascript:d)"
    hostile = entry(
        "hostile", [dataclasses.replace(record("riqn", [0.5] * SEEDS), detector=evil)],
        title=evil, citation=evil, url="javascript:alert(1)", caption=evil,
        submitter=evil,
    )  # fmt: skip
    text = page(sections([hostile]))
    shown = "\n".join(line for line in text.splitlines() if not line.startswith("    "))
    assert "<script" not in shown.replace("\\<", "")
    assert "[c]" not in shown.replace("\\[", "")
    assert "\n# b" not in text
    assert "<javascript" not in text
    # A command stands in an indented block, on one line.
    assert "\n    oodd-eval run --detector '<script>x</script> | `a` # b [c](javascript:d)'" in text


# Numbers for machines


def test_csv_of_cells_has_a_line_per_cell_with_stored_metrics():
    found = sections(entries())
    lines = lines_of(decompress(cells(found)).decode())
    assert len(lines) == 22
    assert {line["board"] for line in lines} == {"leaderboard"}
    by_cell = {(r.detector, r.horizon, r.environment, r.anomaly): r for r in board()}
    for line in (line for line in lines if line["digest"] == found[0].ranks.board.digest):
        one = by_cell[line["detector"], int(line["horizon"]), line["environment"], line["anomaly"]]
        assert line["status"] == one.status
        if one.ok:
            assert float(line["auc_matched"]) == pytest.approx(one.value("auc_matched"), rel=1e-5)
        else:
            assert line["auc_matched"] == ""


def test_every_column_of_the_table_of_cells_is_described():
    page = (Path(__file__).parents[2] / "docs" / "board-data.md").read_text(encoding="utf-8")
    listed = [name for row in re.findall(r"^\| (`.*?) \|", page, re.MULTILINE)
              for name in re.findall(r"`(\w+)`", row)]  # fmt: skip
    columns = list(lines_of(decompress(cells(sections(entries()))).decode())[0])
    own = [c for c in columns if re.sub(r"_(low|high)$", "", c) not in catalogue.NAMES]
    assert sorted(own) == sorted(name for name in listed if not name.startswith("_"))
    assert len(own) < len(columns)


def test_the_pages_program_reads_the_table(tmp_path, monkeypatch, capsys):
    pytest.importorskip("pandas")
    page = (Path(__file__).parents[2] / "docs" / "board-data.md").read_text(encoding="utf-8")
    (program,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    built(tmp_path, entries(), "leaderboard")
    monkeypatch.chdir(tmp_path)
    exec(program, {})  # noqa: S102  the document's own
    assert re.search(r"^riqn +0\.\d+$", capsys.readouterr().out, re.MULTILINE)


def test_csv_numbers_have_six_digits_and_no_rounding_noise():
    assert [number(v) for v in (1 / 3, 123456.7, -1e-17, float("nan"))] == [
        "0.333333", "123457", "0", ""
    ]  # fmt: skip


# The command


def test_build_writes_page_tables_and_site(tmp_path, capsys):
    code, _, output = built(tmp_path, entries())
    assert code == 0
    written = set(files_below(output))
    assert {"README.md", "site/index.html"} < written
    assert {n for n in written if n.startswith("tables/")} == {
        f"tables/mini-{digest}-protocol1-{kind}.csv"
        for digest in ("ab" * 6, "cd" * 6)
        for kind in ("ranking", "comparisons")
    }
    assert set(capsys.readouterr().out.split()) == {str(output / name) for name in written}
    text = (output / "README.md").read_text()
    for name in (*written, "results"):
        unlinked = name in ("README.md", PUBLISHED) or name.startswith("site/")
        assert f"]({name})" in text or unlinked
    assert "open `site/index.html`" in text


def test_check_compares_what_compressed_files_say(tmp_path):
    _, results, output = built(tmp_path, entries())
    check = ["leaderboard", "build", str(results), "--output", str(output), "--check"]
    content = lzma.decompress((output / PUBLISHED).read_bytes())
    elsewhere = lzma.compress(content, preset=1)
    (output / PUBLISHED).write_bytes(elsewhere)
    assert main(check) == 0
    assert main(check[:-1]) == 0
    assert (output / PUBLISHED).read_bytes() == elsewhere
    for other in (lzma.compress(content[:-2]), elsewhere[:-9]):
        (output / PUBLISHED).write_bytes(other)
        assert main(check[:-1]) == 0
        assert lzma.decompress((output / PUBLISHED).read_bytes()) == content
    (output / PUBLISHED).write_bytes(lzma.compress(content[:-2]))
    assert main(check) == 1


def test_a_board_that_no_reader_would_unpack_is_written(tmp_path, monkeypatch):
    """A board of 300 rows has more cells than a compressed file of a stranger may hold."""

    def refused(_content):
        raise ResultsError("decompresses to more than 64000000 bytes")

    monkeypatch.setattr(leaderboard_build, "decompress", refused)
    for _ in range(2):
        leaderboard_build.build(entries(), tmp_path)
    assert (tmp_path / PUBLISHED).is_file()


def test_check_names_every_file_that_differs_and_writes_nothing(tmp_path, capsys):
    _, results, output = built(tmp_path, entries())
    check = ["leaderboard", "build", str(results), "--output", str(output), "--check"]
    before = files_below(output)
    (output / "notes.txt").write_text("mine")
    assert main(check) == 0
    assert "up to date" in capsys.readouterr().out
    assert files_below(output) == before | {"notes.txt": b"mine"}
    name = f"tables/mini-{'ab' * 6}-protocol1"
    (output / f"{name}-ranking.csv").write_text("rank\n")
    (output / f"{name}-comparisons.csv").unlink()
    (output / "tables" / "old.csv").write_text("")
    (output / "site" / "index.html").write_text("")
    assert main(check) == 1
    said = capsys.readouterr()
    assert said.out.splitlines() == [
        f"{name}-comparisons.csv: missing",
        f"{name}-ranking.csv: differs",
        "tables/old.csv: no part of the leaderboard any more",
    ]
    assert "run leaderboard build" in said.err
    assert (output / f"{name}-ranking.csv").read_text() == "rank\n"


def test_without_entries_nothing_is_written(tmp_path, capsys):
    (tmp_path / "none").mkdir()
    output = tmp_path / "out"
    assert main(["leaderboard", "build", str(tmp_path / "none"), "--output", str(output)]) == 5
    assert "no entries" in capsys.readouterr().err
    assert not output.exists()


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    results = write(tmp_path / "results", [entry("trivial", example())])
    found = read_entries(results)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "tables").write_text("")
    with pytest.raises(OSError, match="cannot be written"):
        leaderboard_build.build(found, tmp_path / "out")


def test_a_mean_is_within_its_interval_where_a_cell_is_undefined_for_one_seed():
    def one(seed, anomaly, steps):
        made = record("riqn", [0.7] * SEEDS, seed=seed, anomaly=anomaly)
        term = np.repeat([[steps or 0.0], [float(steps is not None)]], SEEDS, axis=1)
        return dataclasses.replace(made, per_trajectory=made.per_trajectory | {"delay": term})

    unlike = [one(0, "iid", None), one(0, "gravity", 5.0), one(1, "iid", 50.0),
              one(1, "gravity", 5.0)]  # fmt: skip
    other = [dataclasses.replace(r, detector="rf") for r in unlike]
    found = Board([*unlike, *other])
    first, second = found.entries
    mean = found.mean(first, found.environments, found.anomalies, "delay", intervals=True)
    # Of the means 5 and 27.5 of the two seeds.
    assert (mean.low, mean.value, mean.high) == (5.0, 16.25, 27.5)
    assert found.compare(first, second, "delay") == (16.25, 16.25, 2)


# Rows with other training data


@pytest.mark.parametrize(
    ("training", "mark"),
    [
        ("simulation", "trained on simulation"),
        ("anomalies", "trained on anomalies"),
        ("external", "trained on external"),
        ("oracle", "oracle"),
    ],
)
def test_a_row_that_knows_more_is_shown_and_not_ranked(training, mark):
    cheat = [dataclasses.replace(r, detector="wise", training=training)
             for r in board() if r.detector == "riqn" and r.horizon == 10]  # fmt: skip
    before, after = ranked(board()), ranked([*board(), *cheat])
    (row,) = (s for s in after.standings if s.training != "nominal")
    assert row.rank is row.alarm_rank is None
    assert row.state == row.alarm_state == mark
    assert row.marks == f" ({mark})"
    assert after.ranking == before.ranking
    notes = tables.ranking_notes(after)
    assert f"Not ranked: wise[h=10], {mark}." in notes
    oracles = [note for note in notes if note.startswith("An oracle")]
    assert (len(oracles), sum("Rows trained on more" in note for note in notes)) == (
        (1, 0) if training == "oracle" else (0, 1)
    )
