"""Tables, thresholds and plots of results at several strengths, from records made by hand."""

import dataclasses
import io
import math

import pytest
from helpers_records import example, make_record
from rich.console import Console

from oodd_eval.data.condition import Rung
from oodd_eval.errors import SplitError
from oodd_eval.metrics.catalogue import UNDEFINED
from oodd_eval.prose import print_sections
from oodd_eval.results import strengths as of_records
from oodd_eval.results.board import Board
from oodd_eval.results.collection import Results
from oodd_eval.results.render import FORMATS
from oodd_eval.results.report import Report
from oodd_eval.results.strengths import DETECTION, Strengths, StrengthTables, curve, thresholds
from oodd_eval.results.tables import Tables

FIGURES = ("metrics", "per_trajectory")
NULL = "found_within_100_null_at_5pct"
UNITS = {("ant", "iid"): 2.0, ("hopper", "iid"): 10.0, ("ant", "gravity"): 1.0}
TIMES = {"4th": (1 / 4, math.nan), "kept99": (1, 0.99), "kept90": (4, 0.9), "kept50": (16, 0.5)}


@pytest.fixture(autouse=True)
def small_ladder(monkeypatch):
    """Three places; in ant no gravity costs half of the return."""

    def small(environment, kind):
        if (environment, kind) not in UNITS:
            raise SplitError(f"no strengths of {kind} are calibrated in {environment}")
        unit = UNITS[environment, kind]
        names = [n for n in TIMES if (environment, kind, n) != ("ant", "gravity", "kept50")]
        return {n: Rung(unit * TIMES[n][0], kept=TIMES[n][1]) for n in names}

    monkeypatch.setattr(of_records, "rungs_of", small)


def at(detector, place, shares, **fields):
    """Records of one detector and place; a share of 4 episodes is found at each rung."""
    return [
        make_record(
            detector, *place, strength=name,
            values={DETECTION: [float(i < 4 * share) for i in range(4)], NULL: [0.0] * 4,
                    "auc_matched": [0.5 + share / 2] * 4},
            **fields,
        ) for name, share in shares.items()
    ]  # fmt: skip


def all_of(detector, *shares, **fields):
    """Records in all three places with the same shares."""
    own = dict(zip(TIMES, shares, strict=True))
    less = {n: s for n, s in own.items() if n != "kept50"}
    shares = {place: less if place[1] == "gravity" else own for place in UNITS}
    return [r for place, given in shares.items() for r in at(detector, place, given, **fields)]


# riqn reaches one half at 4 units, rf at 8 in two places and nowhere in the third, pe below all.
RECORDS = [
    *all_of("riqn", 0, 0.25, 0.5, 1),
    *all_of("rf", 0, 0, 0.25, 0.75),
    *all_of("pe", 0.5, 0.75, 1, 1),
]


def rows_of(table):
    return {row[0]: dict(zip(table.header, row, strict=True)) for row in table.rows}


def table_of(records, start, *, intervals=False, places=False):
    made = StrengthTables(Board(records), intervals).overview(places=places)
    return next(t for t in made if t.title.startswith(start))


def test_thresholds_are_by_row_and_place_in_the_anomalys_unit():
    found = {str(s): {p: t.value for p, t in places.items()}
             for s, places in thresholds(RECORDS).items()}  # fmt: skip
    assert found["riqn"] == pytest.approx({p: 4 * u for p, u in UNITS.items()})
    iids = {p: 8 * u for p, u in UNITS.items() if p[1] == "iid"}
    assert found["rf"] == pytest.approx({**iids, ("ant", "gravity"): math.inf})
    assert found["pe"] == dict.fromkeys(UNITS, 0)


def test_the_overview_has_multiples_of_riqns_thresholds_the_lowest_first():
    rows = rows_of(table_of(RECORDS, "Detection thresholds, lower"))
    assert list(rows) == ["pe", "riqn", "rf"]
    assert rows["riqn"]["threshold"] == "1 [1, 1]"
    assert rows["pe"]["threshold"].startswith("≤0.0625 [")  # a quarter of a unit against four
    assert rows["rf"]["threshold"].startswith(">1.59 [")  # 2, 2, and 4 units against 4: 4 ** (1/3)
    assert [rows["rf"][c] for c in ("pairs", "below", "above")] == ["3", "0", "1"]
    assert [rows["pe"][c] for c in ("pairs", "below", "above")] == ["3", "3", "0"]
    # Where no gravity costs half of the return, the largest counts: 0.75, 0.75 and 0.25.
    shares = [rows["rf"][name] for name in TIMES]
    assert shares == ["0.0", "0.0", "25.0", "58.3"]


def test_rows_that_know_more_are_named_below_the_tables():
    wise = [dataclasses.replace(r, detector="wise", training="external") for r in RECORDS[:4]]
    oracle = [dataclasses.replace(r, detector="oracle", training="oracle") for r in RECORDS[:4]]
    note = "Not ranked, for what they know: wise (trained on external), oracle."
    for records, expected in ((RECORDS, False), ([*RECORDS, *wise, *oracle], True)):
        of_board = Tables(Board(records)).separability()
        shown = [table_of(records, "Detection thresholds, lower"), of_board]
        assert [note in (table.note or "") for table in shown] == [expected] * 2
        assert expected or not any("Not ranked" in (table.note or "") for table in shown)


def test_means_by_kind_say_on_which_side_censored_ones_are():
    rows = rows_of(table_of(RECORDS, "Detection thresholds by anomaly"))
    assert rows["riqn"] == {"detector": "riqn", "iid": "4", "gravity": "4"}
    assert rows["rf"] == {"detector": "rf", "iid": "8", "gravity": ">4"}
    assert rows["pe"] == {"detector": "pe", "iid": "≤0.25", "gravity": "≤0.25"}
    mixed = [*at("rf", ("ant", "iid"), dict(zip(TIMES, (1, 1, 1, 1), strict=True))),
             *at("rf", ("hopper", "iid"), dict(zip(TIMES, (0, 0, 0, 0), strict=True)))]  # fmt: skip
    assert rows_of(table_of(mixed, "Detection thresholds by anomaly"))["rf"]["iid"] == "~2"
    rows = rows_of(table_of(RECORDS, "Detection thresholds by anomaly", intervals=True))
    assert rows["riqn"]["iid"].startswith("4 [")


def test_a_place_with_a_missing_or_failed_rung_has_no_threshold():
    missing = [r for r in RECORDS if (r.detector, r.environment) != ("rf", "hopper")
               or r.strength != "kept90"]  # fmt: skip
    places = {str(s): set(own) for s, own in thresholds(missing).items()}
    assert places["rf"] == {("ant", "iid"), ("ant", "gravity")}
    assert places["riqn"] == {*UNITS}
    row = rows_of(table_of(missing, "Detection thresholds, lower"))["rf"]
    assert row["threshold"].endswith("]*")
    assert row["pairs"] == "2"
    failed = [*all_of("riqn", 0, 0, 1, 1), *all_of("rf", 0, 0, 1, 1, status="oom", reason="big")]
    row = rows_of(table_of(failed, "Detection thresholds, lower"))["rf"]
    assert (row["threshold"], row["pairs"], row["kept99"]) == (UNDEFINED, "0", "oom")


def test_a_row_without_a_record_at_a_strength_has_an_empty_field_there():
    records = [*RECORDS, *at("late", ("hopper", "iid"), {"4th": 0.5})]
    for detail in ("brief", "full"):
        assert "late" in str(Report(records, detail=detail))
    late = rows_of(table_of(records, "Matched AUC (%) by strength"))["late"]
    assert (late["4th"], late["kept50"]) == ("75.0*", "")


def test_all_detector_seeds_count():
    shares = ((0, 0, 0, 1), (0, 1, 1, 1))
    both = [r for seed, own in enumerate(shares) for r in all_of("rf", *own, seed=seed)]
    (own,) = thresholds(both).values()
    assert own["ant", "iid"].value == pytest.approx(2)  # half of all from kept99 on
    assert own["ant", "iid"].interval == (2, 2)  # seeds are fixed, and episodes agree
    del both[-1]
    assert ("ant", "gravity") not in next(iter(thresholds(both).values()))


def test_the_next_weaker_rung_stands_in_where_a_ladder_has_none(monkeypatch):
    def at(records, name):
        found = Strengths.of(records).at(records, name)
        return {(r.environment, r.anomaly): r.strength for r in found}

    ends = {("ant", "iid"): "kept50", ("hopper", "iid"): "kept50", ("ant", "gravity"): "kept90"}
    assert at(RECORDS, "kept50") == ends
    # A rung that was not run is missing.
    fewer = [r for r in RECORDS if (r.environment, r.strength) != ("hopper", "kept50")]
    assert {environment for environment, _ in at(fewer, "kept50")} == {"ant"}
    fewer = [r for r in RECORDS if r.anomaly == "gravity" and r.strength != "kept90"]
    assert not at(fewer, "kept50")
    # Strengths that no ladder has are left out.
    cells = ("drift", "kept99"), ("iid", "harsh"), ("iid", "")
    other = [make_record("rf", "ant", kind, strength=name) for kind, name in cells]
    assert Strengths.of(other).rungs == {}
    assert not StrengthTables(Board(other)).overview()
    assert Strengths.of(RECORDS + other).rungs.keys() == UNITS.keys()
    usual = of_records._calibrated

    def without(*place):
        return {n: r for n, r in usual(*place).items() if place[0] != "ant" or n != "kept90"}

    monkeypatch.setattr(of_records, "_calibrated", without)
    found = at(RECORDS, "kept90")
    assert found["ant", "iid"] == found["ant", "gravity"] == "kept99"
    assert found["hopper", "iid"] == "kept90"


def test_reports_and_the_terminal_have_the_tables_where_there_are_strengths():
    assert "strength" not in FORMATS["markdown"].render(Report(example()))
    text = FORMATS["markdown"].render(Report(RECORDS))
    shown = io.StringIO()
    print_sections(Report(RECORDS, detail="brief").sections, Console(file=shown, width=100))
    for title in ("Detection thresholds, lower is better", "Matched AUC (%) by strength",
                  "Detection thresholds by anomaly"):  # fmt: skip
        assert f"### {title}" in text
        assert title not in shown.getvalue()
    (section,) = Report(RECORDS, detail="brief").sections
    assert section.tables[0].header[:2] == ["detector", "matched AUC"]
    assert "all strengths" in section.tables[0].note
    # Where records keep the share that is found alone, thresholds are what there is.
    kept = [
        dataclasses.replace(r, **{n: {DETECTION: getattr(r, n)[DETECTION]} for n in FIGURES})
        for r in RECORDS
    ]
    (section,) = Report(kept, detail="brief").sections
    assert [t.title.partition(",")[0] for t in section.tables] == ["Detection thresholds"]
    assert "### rf: detection thresholds" in text
    bare = [make_record("rf", "ant", "iid", strength=name) for name in TIMES]
    tables = StrengthTables(Board(bare)).overview(places=True)
    assert [t.title for t in tables] == ["Matched AUC (%) by strength"]  # no alarms at 5 %


# Results


def test_thresholds_come_as_flat_rows():
    rows = Results(RECORDS).thresholds()
    assert len(rows) == 9
    row = next(r for r in rows if r["row"] == "rf" and r["anomaly"] == "gravity")
    assert row == {
        "row": "rf", "environment": "ant", "anomaly": "gravity", "threshold": math.inf,
        "low": pytest.approx(4 ** (2 / 3)), "high": math.inf, "weakest": 0.25, "strongest": 4.0,
        "kept99": 1.0,
    }  # fmt: skip


def test_a_curve_has_the_mean_over_places_at_each_rung():
    points = curve([r for r in RECORDS if r.detector == "rf"], DETECTION)
    assert [p.value for p in points] == pytest.approx([0, 0, 0.25, (0.75 + 0.75 + 0.25) / 3])
    strengths = [1 / 4, 1, 4, (16 * 16 * 4) ** (1 / 3)]
    assert [p.strength for p in points] == pytest.approx(strengths)
    assert math.isnan(points[0].lost)
    assert [p.lost for p in points[1:]] == pytest.approx([0.01, 0.1, (0.5 + 0.5 + 0.1) / 3])


def test_curves_are_drawn_against_strength_and_return_lost():
    pytest.importorskip("matplotlib")
    figure = Results(RECORDS).plot_ladder("rf", "pe", environments="hopper", anomalies="i*")
    left, right = figure.axes
    assert left.get_xscale() == "log"
    assert [line.get_label() for line in left.lines][::2] == ["rf", "pe"]
    own, null = left.lines[:2]
    assert list(own.get_xdata()) == pytest.approx([1 / 4, 1, 4, 16])
    assert list(own.get_ydata()) == pytest.approx([0, 0, 25, 75])
    assert list(null.get_ydata()) == [0, 0, 0, 0]
    # What the weakest rung costs is not known.
    assert list(right.lines[0].get_xdata()) == pytest.approx([1, 10, 50])
    by_auc = Results(RECORDS).plot_ladder(metric="auc_matched").axes[0]
    assert by_auc.get_ylabel() == "matched AUC (%)"


# Strengths of one's own


GRAVITY = {"0.1": 0.1, "0.5": 0.5, "1": 1.0, "10": 10.0}


def own(detector, shares, environment="tank", anomaly="gravity", **fields):
    """Records at four strengths that no ladder has; a share of 4 episodes is found at each."""
    return [
        make_record(
            detector, environment, anomaly, strength=name, magnitude=GRAVITY[name],
            values={DETECTION: [float(i < 4 * share) for i in range(4)], NULL: [0.0] * 4,
                    "auc_matched": [0.5 + share / 2] * 4},
            **fields,
        ) for name, share in zip(GRAVITY, shares, strict=True)
    ]  # fmt: skip


def test_strengths_of_ones_own_give_a_threshold_and_a_column_each():
    """A quarter is found at 0.1 and three at 0.5: one half lies at their geometric mean."""
    records = [*own("rf", (0.25, 0.75, 0.75, 1)), *own("pe", (0, 0, 0.5, 1))]
    values = {r["row"]: r["threshold"] for r in Results(records).thresholds()}
    assert values == {"rf": pytest.approx(math.sqrt(0.05)), "pe": pytest.approx(1)}
    table = table_of(records, "Share of episodes found")
    assert table.header == ["detector", "0.1", "0.5", "1", "10"]  # by number, not by text
    assert [rows_of(table)["pe"][name] for name in GRAVITY] == ["0.0", "0.0", "50.0", "100.0"]
    aucs = rows_of(table_of(records, "Matched AUC"))["rf"]
    assert [aucs[name] for name in GRAVITY] == ["62.5", "87.5", "87.5", "100.0"]
    by_kind = StrengthTables(Board(records), units={"gravity": "of 1 g"}).overview()[0]
    assert by_kind.header == ["detector", "gravity (of 1 g)"]
    assert [row[1] for row in by_kind.rows] == ["0.224", "1"]
    assert by_kind.title.endswith("each in its own unit")
    assert "Means" not in by_kind.note
    # Of one environment there is no more to say.
    titles = [t.title for t in StrengthTables(Board(records)).overview(places=True)]
    assert not any(title.startswith("rf: detection") for title in titles)
    pool = own("rf", (0, 0, 1, 1), environment="pool")
    table = table_of([*records, *pool], "rf: detection", places=True)
    assert rows_of(table)["tank"]["gravity"] == "0.224"


def test_thresholds_without_a_common_scale_have_no_mean_but_relative_to_a_reference():
    """Kilograms and newton metres; a rung alone, whose ladder is not known, is no scale either."""
    load, stiff = (own("rf", s, anomaly=k) for k, s in (("mass", (0, 1, 1, 1)),
                                                        ("friction", (0, 0, 1, 1))))  # fmt: skip
    units = {"mass": "kg", "friction": "N m s/rad"}
    tables = StrengthTables(Board([*load, *stiff]), units=units).overview()
    assert tables[0].header == ["detector", "mass (kg)", "friction (N m s/rad)"]
    expected = [f"{math.sqrt(a * b):.3g}" for a, b in ((0.1, 0.5), (0.5, 1))]
    assert tables[0].rows == [["rf", *expected]]
    shares = next(t for t in tables if t.title.startswith("Share"))
    columns = [f"{kind} {name}" for kind in units for name in GRAVITY]
    assert shares.header == ["detector", *columns]
    assert shares.rows[0][1:] == [*["0.0", *["100.0"] * 3], *["0.0"] * 2, *["100.0"] * 2]
    assert not any("threshold" in table.header for table in tables)
    assert curve([*load, *stiff], DETECTION) == []
    strengths = [point.strength for point in curve(load, DETECTION)]
    assert strengths == pytest.approx([*GRAVITY.values()])
    # A reference has the same units.
    riqn = [dataclasses.replace(r, detector="riqn") for r in (*load, *stiff)]
    relative = StrengthTables(Board([*load, *stiff, *riqn]), units=units).overview()[0]
    assert "as a multiple of riqn's" in relative.note
    assert {row[1] for row in relative.rows} == {"1 [1, 1]"}
    # Of the benchmark's ladder each kind has the scale, of others only where they have the rung.
    renamed = [
        [dataclasses.replace(r, strength=name) for r, name in zip(load, names, strict=True)]
        for names in (
            ("kept99", "kept90", "kept75", "kept50"),
            ("4th", "kept90", "kept75", "kept50"),
        )
    ]
    for records, scaled in zip(renamed, (True, False), strict=True):
        assert Strengths.of(records).scaled == scaled
        first = StrengthTables(Board(records), units=units).overview()[0]
        assert ("threshold" in first.header) == scaled
        assert math.isnan(Results(records).thresholds()[0]["kept99"]) == (not scaled)


def test_one_place_without_a_scale_leaves_thresholds_without_a_mean():
    """Rungs of the ladder in hopper; in the tank they have no strength that costs 1 %."""
    known = at("rf", ("hopper", "iid"), dict(zip(TIMES, (0, 0.25, 0.5, 1), strict=True)))
    assert Strengths.of(known).scaled
    names = zip(own("rf", (0, 1, 1, 1)), ("4th", "kept90", "kept75", "kept50"), strict=True)
    tank = [dataclasses.replace(r, strength=name) for r, name in names]
    both = Strengths.of([*known, *tank])
    assert both.calibrated
    assert not both.scaled
    first = StrengthTables(Board([*known, *tank])).overview()[0]
    assert first.title.endswith("each in its own unit")
    assert "threshold" not in first.header
    assert first.rows == [["rf", "40", "0.224"]]


def test_environments_without_a_common_scale_have_a_column_each():
    records = [*own("rf", (0, 1, 1, 1)), *own("rf", (0, 0, 1, 1), environment="pool")]
    table = StrengthTables(Board(records), units={"gravity": "g"}).overview()[0]
    assert table.header == ["detector", "gravity (g), tank", "gravity (g), pool"]
    assert table.rows == [["rf", "0.224", "0.707"]]
    assert "Means" not in table.note


def test_the_number_of_a_record_counts_and_not_the_ladders_of_the_same_name():
    (record,) = [
        r for r in RECORDS if r.detector == "rf" and r.position == ("hopper", "iid@kept90")
    ]
    (rung,) = Strengths.of([record]).rungs["hopper", "iid"].values()
    assert (rung.strength, rung.kept) == (40.0, 0.9)
    other = dataclasses.replace(record, magnitude=30.0)
    (rung,) = Strengths.of([other]).rungs["hopper", "iid"].values()
    assert rung.strength == 30.0
    assert math.isnan(rung.kept)
