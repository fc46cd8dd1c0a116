"""Numbers of a reproduction: means, seeds, what is missing, the paper's digits, tables and CSV."""

import dataclasses
import json
import math
import re

import numpy as np
import pytest
from helpers_records import make_record
from oodd_paper.claims import changed, rulings
from oodd_paper.dot_plots import pictures_of
from oodd_paper.estimates import Estimate, Estimator, Side, compute
from oodd_paper.experiments import (
    EXPERIMENTS,
    FILE,
    TIERS,
    Experiment,
    paper_number,
    read_tables,
    scope,
)
from oodd_paper.inputs import (
    HEADER,
    KINDS,
    RETURNS,
    Other,
    Reproduction,
    dump_returns,
    load_returns,
)
from oodd_paper.reproduction_page import (
    caption,
    layout,
    numbers_csv,
    publish,
    returns_caption,
    returns_tables,
    show,
)
from oodd_paper.run import COSTS

from oodd_eval.data.facts import ENVIRONMENTS, TABLE1
from oodd_eval.errors import ResultsError
from oodd_eval.metrics.bootstrap import bootstrap_weights
from oodd_eval.metrics.catalogue import UNDEFINED
from oodd_eval.results.identity import Setting

ALL, SENSOR, DYNAMICS = map(scope, ("all", "sensor", "dynamics"))
BY_ID = {e.id: e for e in EXPERIMENTS}
RIQN, RF = Setting("riqn"), Setting("rf")


def everywhere(detector, auc, *, environments=("ant", "hopper"), **settings):
    return [
        make_record(detector, e, a, values={"auc": auc}, **settings)
        for e in environments
        for a in TABLE1
    ]


def side(setting, weight=1.0, anomalies=TABLE1):
    return Side(weight, (setting,), anomalies)


def combine(records, sides, environments, *others):
    return Estimator(records).combine(sides, "auc", environments, *others)


def header(**changes):
    given = {
        "tier": TIERS["mini"], "split": "mini", "split_digest": "ab" * 32, "protocol": 1,
        "train": 40, "calibration": 20, "test": 2, "units": 252,
    }  # fmt: skip
    return Reproduction(**given | changes)


def test_mean_over_anomalies_and_environments_is_worked_by_hand():
    records = everywhere("riqn", [0.8, 0.6]) + everywhere("rf", [0.5, 0.5])
    estimate = combine(records, [side(RIQN)], ["ant", "hopper"])
    assert estimate.value == pytest.approx(0.7)
    assert (estimate.environments, estimate.expected, estimate.seeds) == (2, 2, 1)


def test_interval_is_the_bootstrap_written_out():
    # One environment: anomalies share their weights, so the mean is w . (.8, .6) / 2.
    weights = bootstrap_weights(2, key="ant")
    expected = np.percentile(weights @ np.array([0.8, 0.6]) / 2, [2.5, 97.5])
    estimate = combine(everywhere("riqn", [0.8, 0.6]), [side(RIQN)], ["ant"])
    assert (estimate.low, estimate.high) == pytest.approx(tuple(expected))


def test_an_interval_is_as_wide_as_the_trajectories_that_count_make_it():
    four = everywhere("riqn", [0.1, 0.2, 0.3, 0.4], environments=["ant"])
    with_undefined = everywhere("riqn", [0.1, 0.2, 0.3, 0.4, *[None] * 16], environments=["ant"])
    few, many = (combine(r, [side(RIQN)], ["ant"]) for r in (four, with_undefined))
    assert many.high - many.low > 0.9 * (few.high - few.low)


def test_difference_is_paired_and_uses_the_detector_seeds_that_both_sides_have():
    records = everywhere("riqn", [0.9, 0.3]) + everywhere("rf", [0.8, 0.2])
    estimate = combine(records, [side(RIQN), side(RF, -1.0)], ["ant", "hopper"])
    assert (estimate.value, estimate.low, estimate.high) == pytest.approx((0.1, 0.1, 0.1))
    records = everywhere("riqn", [0.9, 0.9]) + everywhere("riqn", [0.1, 0.1], seed=1)
    records += everywhere("rf", [0.5, 0.5])
    assert combine(records, [side(RIQN), side(RF, -1.0)], ["ant"]).value == pytest.approx(0.4)
    alone = combine(records, [side(RIQN)], ["ant"])
    assert (alone.value, alone.seeds) == (pytest.approx(0.5), 2)
    assert combine(records, [side(RIQN)], ["ant"], [RF]).value == pytest.approx(0.9)


def test_seeds_are_fixed():
    environments = tuple(ENVIRONMENTS)
    records = everywhere("riqn", [0.4, 0.4], environments=environments)
    records += everywhere("riqn", [0.6, 0.6], environments=environments, seed=1)
    estimate = combine(records, [side(RIQN)], environments)
    assert (estimate.low, estimate.high) == pytest.approx((0.5, 0.5))


def test_an_undefined_environment_is_left_out_of_the_mean():
    records = everywhere("riqn", [None, None], environments=["ant"])
    records += everywhere("riqn", [0.6, 0.6], environments=["hopper"])
    assert combine(records, [side(RIQN)], ["ant", "hopper"]).value == 0.6


def test_the_mean_over_models_needs_all_of_them():
    both = (side(RIQN, 0.5), side(RF, 0.5))
    records = everywhere("riqn", [0.8, 0.8]) + everywhere("rf", [0.6, 0.6], environments=["ant"])
    estimate = combine(records, both, ["ant", "hopper"])
    assert estimate.value == pytest.approx(0.7)
    assert (estimate.environments, estimate.expected) == (1, 2)


def test_a_missing_cell_is_no_number_and_a_failed_one_its_state():
    records = [r for r in everywhere("riqn", [0.8, 0.8]) if r.anomaly != "drift"]
    estimate = combine(records, [side(RIQN)], ["ant"])
    assert show(estimate, "auc") == "not run"
    kept = combine(records, [side(RIQN, anomalies=("iid",))], ["ant"])
    assert show(kept, "auc") == "80.0 [80.0, 80.0]"
    records = everywhere("riqn", [0.8, 0.8])
    records[3] = make_record("riqn", "ant", records[3].anomaly, status="oom", reason="too large")
    assert show(combine(records, [side(RIQN)], ["ant", "hopper"]), "auc") == "oom"


def test_what_is_printed():
    assert show(Estimate(0.7, 0.65, 0.75, 7, 7), "auc") == "70.0 [65.0, 75.0]"
    assert show(Estimate(4.25, math.nan, math.nan, 7, 7), "delay") == "4.2"
    assert show(Estimate(0.1, 0.05, 0.2, 3, 7), "far") == "0.100 [0.050, 0.200] (3 of 7)"
    assert show(Estimate(environments=1, expected=1), "delay") == UNDEFINED


def test_digits_of_the_paper_stand_where_they_belong():
    def digit(experiment, label, environment, anomalies, metric="auc"):
        (series,) = [s for s in BY_ID[experiment].series if s.label == label]
        return paper_number(BY_ID[experiment], series, environment, anomalies, metric)

    assert digit("table-5", "NPN", "walker2d", SENSOR) == 1.0
    assert digit("table-5", "RIQN", "hopper", DYNAMICS, "delay") == 5.24
    assert digit("table-5", "AVG", "acrobot", SENSOR) == pytest.approx(0.9479)
    assert math.isnan(digit("table-5", "RIQN", "hopper", SENSOR, "auc_matched"))
    assert digit("table-4", "Δ = 10: e = 1", "hopper", ALL) == pytest.approx(0.776)
    assert digit("table-3", "Δ = 10: N-RIQN", "ant", ALL) == pytest.approx(0.747)
    assert math.isnan(digit("table-3", "Δ = 10: N-RIQN", "hopper", ALL))
    assert math.isnan(digit("table-3", "Δ = 20: RIQN", "ant", ALL))
    sweep = BY_ID["figure-samples"]
    found = [paper_number(sweep, s, "ant", ALL, "auc") for s in sweep.series]
    assert [math.isnan(x) for x in found] == [True, False, True, True]
    # The paper's mean stands only where it has every environment.
    numbers = compute(BY_ID["table-3"], Estimator([]))
    assert math.isnan(numbers["mean", "Δ = 1: RIQN", "all", "auc"].paper)
    mean = compute(BY_ID["table-4"], Estimator([]))["mean", "Δ = 1: e = 5", "all", "auc"].paper
    seven = [89.01, 86.7, 86.0, 86.5, 87.0, 86.7, 85.1]
    assert 100 * mean == pytest.approx(sum(seven) / 7)


@pytest.mark.parametrize(("label", "mean"), [("RIQN", 89.4), ("RIQN+MS", 89.8), ("NPN", 87.6),
                                              ("RF", 80.9)])  # fmt: skip
def test_the_papers_means_over_table_5(label, mean):
    figure = BY_ID["figure-models"]
    series = {s.label: s for s in figure.series}[f"Δ = 1: {label}"]
    found = [paper_number(figure, series, e, ALL, "auc") for e in ENVIRONMENTS]
    assert 100 * np.mean(found) == pytest.approx(mean, abs=0.06)


def test_table_has_ours_and_the_papers_below():
    records = everywhere("riqn", [0.8, 0.6])
    table = BY_ID["table-4"]
    numbers = compute(table, Estimator(records))
    [shown] = layout(table, numbers, table.metrics)
    ant = next(row for row in shown.rows if row[0] == "Ant")
    below = shown.rows[shown.rows.index(ant) + 1]
    assert ant[:5] == ["Ant", "AUC (%)", "ours", "not run", "70.0 [60.0, 80.0]"]
    assert below == ["", "", "paper", "83.1", "86.5", "79.6", "84.7"]
    mean = next(row for row in shown.rows if row[0] == "Mean")
    assert mean[4].endswith("(2 of 7)")


def test_a_mean_without_all_environments_is_in_the_table_and_not_in_the_figure():
    table = BY_ID["table-4"]
    numbers = compute(table, Estimator(everywhere("riqn", [0.8, 0.6])))
    [figure] = pictures_of(table, numbers).values()
    panel = figure.panels[0]
    [drawn] = [dots for dots in panel.series if dots.label == "e = 5"]
    shown = dict(zip(panel.categories, drawn.values, strict=True))
    assert shown["Ant"] == pytest.approx(70.0)
    assert math.isnan(shown["CartPole"])
    assert math.isnan(shown["Mean"])


def test_every_experiment_lays_out_every_number():
    for experiment in EXPERIMENTS:
        numbers = compute(experiment, Estimator([]))
        metrics = (*experiment.metrics, *experiment.beyond)
        tables = layout(experiment, numbers, metrics)
        ours = [row for t in tables for row in t.rows if row[2] == "ours"]
        assert sum(len(row) - 3 for row in ours) == len(numbers)
        assert {cell for row in ours for cell in row[3:]} == {"not run"}


def test_csv_reads_back_to_the_same_numbers():
    table = BY_ID["table-5"]
    numbers = compute(table, Estimator(everywhere("riqn", [0.81, 0.6])))
    rows = numbers_csv(numbers)
    for row, number in zip(rows, numbers.values(), strict=True):
        value = number.estimate.value
        read = float(row["value"] or "nan")
        assert read == pytest.approx(value, rel=1e-5, nan_ok=True)
        assert row["state"] == ("" if number.estimate.environments else "not run")
    assert sum(bool(row["value"]) for row in rows) > 10


def test_another_reproduction_stands_beside_in_tables_and_claims(tmp_path):
    there, here = tmp_path / "there", tmp_path / "here"
    first = everywhere("riqn", [0.8, 0.6]), {"acrobot": {k: [-80.0, -90.0] for k in KINDS}}
    publish(there, header(split="mild"), *first, figures=False)
    (there / HEADER).write_text(
        json.dumps({"schema": 1, **dataclasses.asdict(header(split="mild"))})
    )
    (there / RETURNS).write_text(dump_returns(first[1], "ab" * 32))
    other = Other.load(there)
    found = {"acrobot": {k: [-70.0, -70.0] for k in KINDS}}
    records = [*everywhere("riqn", [0.4, 0.4]), *everywhere("rf", [0.9, 0.9])]
    publish(here, header(), records, found, figures=False, other=other)
    page = (here / "README.md").read_text()
    lines = [[c.strip() for c in line.split("|")[1:-1]] for line in page.splitlines()]
    below = next(i for i, c in enumerate(lines) if c[:3] == ["Acrobot", "IQN", "ours"])
    assert lines[below][3].startswith("-70.0")
    assert lines[below + 2][2:4] == ["mild", "-85.0 \\[-90.0, -80.0]"]
    ours = next(i for i, c in enumerate(lines) if c[:3] == ["Ant", "AUC (%)", "ours"])
    assert lines[ours + 2][2] == "mild"
    place = next(i for i, cell in enumerate(lines[ours]) if cell.startswith("40.0"))
    assert lines[ours + 2][place].startswith("70.0 \\[60.0, 80.0]")
    (titles,) = [c for c in lines if c and c[0] == "Claim"]
    column = titles.index("On mild")
    (claim,) = [c for c in lines if c and c[0] == "RIQN has a higher AUC than RF, Δ = 1"]
    assert "Verdicts that differ: " in page
    assert claim[column] == "not run; not run"
    assert claim[column - 2].startswith("undecided")  # two environments of seven


def test_verdicts_that_differ_are_counted():
    made = rulings(Estimator(everywhere("riqn", [0.8, 0.6], environments=ENVIRONMENTS)), None)
    claims = {
        (r.claim.id, kind): {"verdict": judged.verdict}
        for r in made for kind, judged in (("paper", r.paper), ("fair", r.fair)) if judged
    }  # fmt: skip
    other = Other("mild", {}, claims, None)
    counts = re.match(r"0 of (\d+) by the paper's measures, 0 of (\d+) ", changed(made, other))
    open_ = [r for r in made if not r.claim.settled and r.paper.verdict != "not run"]
    assert len(open_) == int(counts[1]) > 1
    for r, verdict in zip(open_[:2], ("turned", "not run"), strict=True):
        claims[r.claim.id, "paper"] = {"verdict": verdict}
    assert changed(made, other).startswith(f"1 of {len(open_) - 1} by the paper's measures, 0 of")


def test_records_of_other_data_setups_or_seeds_are_left_out(tmp_path):
    own = everywhere("riqn", [0.8, 0.6])
    publish(tmp_path / "a", header(), own, None, figures=False)
    others = [
        *everywhere("riqn", [0.1, 0.1], digest="cd" * 32),
        *everywhere("riqn", [0.1, 0.1], limit=5),
        *everywhere("riqn", [0.1, 0.1], seed=7),
        *everywhere("riqn", [0.1, 0.1], overrides={"samples": 5}),
        *everywhere("someone-elses", [0.1, 0.1]),
    ]
    publish(tmp_path / "b", header(), [*others, *own], None, figures=False)
    for path in (p for p in (tmp_path / "a").rglob("*") if p.is_file()):
        assert (tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes() == path.read_bytes()


def test_caption_names_data_seeds_and_a_reduced_tier(tmp_path):
    table = BY_ID["table-3"]
    records = everywhere("riqn", [0.8, 0.6]) + everywhere("riqn", [0.8, 0.6], seed=1)
    numbers = compute(table, Estimator([*records, *everywhere("riqn", [0.8, 0.6], horizon=10)]))
    whole = header(tier=TIERS["full"], split="standard", train=500, calibration=200, test=50)
    text = caption(whole, table, numbers)
    assert "Detector seeds: 2 for Δ = 1; 1 for Δ = 10." in text
    assert "reduced" not in text
    less = dataclasses.replace(whole, tier=TIERS["reduced"], split="reduced", test=20)
    for part in (caption(less, table, numbers), returns_caption(less)):
        assert "20 of 50 test seeds of split standard" in part
    found = {"acrobot": {k: [-80.0, -90.0] for k in KINDS}}
    (tmp_path / RETURNS).write_text(dump_returns(found, "ab" * 32))
    assert load_returns(tmp_path, "ab" * 32) == found
    assert load_returns(tmp_path, "cd" * 32) is None
    table, _ = returns_tables(found)
    assert table.rows[0][:4] == ["Acrobot", "IQN", "ours", "-85.0 [-90.0, -80.0]"]
    assert table.rows[1][:4] == ["", "", "paper", "-78.7"]


def test_measured_costs_cover_every_setting_in_every_environment():
    settings = {str(s) for e in EXPERIMENTS for s in e.settings}
    assert list(COSTS) == list(ENVIRONMENTS)
    assert all(costs.keys() == settings for costs in COSTS.values())


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        ("title =", "titel =", "'table-3'.*titel"),
        ('scopes = ["all"]', 'scopes = ["al"]', "'table-3'.*unknown scope 'al'"),
        ('["riqn"]', '["riqn[h"]', r"'table-3'.*riqn\[h"),
        ('across = "scopes"', 'across = "scoops"', "'figure-horizon'.*scoops"),
        ("columns = 3", "column = 3", "'table-3'.*column"),
        ("[[experiment]]", "[[experiment]", "cannot be read"),
        ('"table-4"', '"table-3"', "'table-3'.*same id"),
    ],
)
def test_a_wrong_experiment_is_named_with_what_is_wrong(tmp_path, old, new, part):
    path = tmp_path / "experiments.toml"
    path.write_text(FILE.read_text().replace(old, new, 1))
    with pytest.raises(ResultsError, match=f"(?s)experiments.toml.*{part}"):
        read_tables(path, "experiment", Experiment.of)
