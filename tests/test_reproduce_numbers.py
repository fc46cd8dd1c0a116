"""Numbers of a reproduction: means, seeds, what is missing, the paper's digits, tables and CSV."""

import csv
import dataclasses
import io
import json
import math
from pathlib import Path

import numpy as np
import pytest
from helpers_records import make_record

import oodd_eval
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS
from oodd_eval.metrics.bootstrap import bootstrap_weights
from oodd_eval.paper import captions, costs, paper, returns
from oodd_eval.paper.evidence import Estimate, Evidence, Term
from oodd_eval.paper.experiments import ALL, EXPERIMENTS, GROUPED, RIQN, TIERS, Setup
from oodd_eval.paper.figures import figures
from oodd_eval.paper.header import Header
from oodd_eval.paper.numbers import compute, csv_lines, layout, show
from oodd_eval.paper.publish import publish
from oodd_eval.results.tables.tables import UNDEFINED

BY_ID = {e.id: e for e in EXPERIMENTS}
RF = Setup("rf")


def everywhere(detector, auc, *, environments=("ant", "hopper"), **settings):
    return [
        make_record(detector, e, a, values={"auc": auc}, **settings)
        for e in environments
        for a in ANOMALIES
    ]


def term(setup, weight=1.0, anomalies=tuple(ANOMALIES), metric="auc"):
    return Term(weight, setup, anomalies, metric)


def header(**changes):
    facts = {
        "tier": TIERS["mini"], "split": "mini", "split_digest": "ab" * 32, "protocol": 1,
        "train": 40, "calibration": 20, "test": 2, "units": 252,
    }  # fmt: skip
    return Header(**facts | changes)


def test_mean_over_anomalies_and_environments_is_worked_by_hand():
    records = everywhere("riqn", [0.8, 0.6]) + everywhere("rf", [0.5, 0.5])
    estimate = Evidence(records).combine([term(RIQN)], ["ant", "hopper"])
    assert estimate.value == pytest.approx(0.7)
    assert (estimate.environments, estimate.expected, estimate.seeds) == (2, 2, 1)


def test_interval_is_the_bootstrap_written_out():
    # One environment: anomalies share their weights, so the mean is w . (.8, .6) / 2.
    weights = bootstrap_weights(2, key="ant")
    expected = np.percentile(weights @ np.array([0.8, 0.6]) / 2, [2.5, 97.5])
    estimate = Evidence(everywhere("riqn", [0.8, 0.6])).combine([term(RIQN)], ["ant"])
    assert (estimate.low, estimate.high) == pytest.approx(tuple(expected))


def test_difference_is_paired_over_test_seeds():
    records = everywhere("riqn", [0.9, 0.3]) + everywhere("rf", [0.8, 0.2])
    estimate = Evidence(records).combine([term(RIQN), term(RF, -1.0)], ["ant", "hopper"])
    assert (estimate.value, estimate.low, estimate.high) == pytest.approx((0.1, 0.1, 0.1))


def test_difference_uses_the_detector_seeds_that_both_sides_have():
    records = everywhere("riqn", [0.9, 0.9]) + everywhere("riqn", [0.1, 0.1], seed=1)
    records += everywhere("rf", [0.5, 0.5])
    evidence = Evidence(records)
    assert evidence.combine([term(RIQN), term(RF, -1.0)], ["ant"]).value == pytest.approx(0.4)
    alone = evidence.combine([term(RIQN)], ["ant"])
    assert (alone.value, alone.seeds) == (pytest.approx(0.5), 2)
    assert evidence.combine([term(RIQN)], ["ant"], [RF]).value == pytest.approx(0.9)


def test_where_networks_computed_makes_no_other_row():
    records = everywhere("riqn", [0.8, 0.6], overrides={"device": "cuda"}, environments=["ant"])
    records += everywhere("riqn", [0.8, 0.6], overrides={"samples": 4}, environments=["hopper"])
    estimate = Evidence(records).combine([term(RIQN)], ["ant", "hopper"])
    assert (estimate.value, estimate.environments) == (pytest.approx(0.7), 1)


def test_detector_seeds_widen_the_interval():
    one = Evidence(everywhere("riqn", [0.5, 0.5])).combine([term(RIQN)], ["ant"])
    two = everywhere("riqn", [0.4, 0.4]) + everywhere("riqn", [0.6, 0.6], seed=1)
    wide = Evidence(two).combine([term(RIQN)], ["ant"])
    assert one.low == one.high == 0.5
    assert (wide.low, wide.high) == pytest.approx((0.4, 0.6))


def test_seeds_are_resampled_independently_by_environment():
    environments = tuple(ENVIRONMENTS)
    records = everywhere("riqn", [0.4, 0.4], environments=environments)
    records += everywhere("riqn", [0.6, 0.6], environments=environments, seed=1)
    estimate = Evidence(records).combine([term(RIQN)], environments)
    assert 0.4 < estimate.low < 0.47
    assert 0.53 < estimate.high < 0.6


def test_an_undefined_environment_is_left_out_of_the_mean():
    records = everywhere("riqn", [None, None], environments=["ant"])
    records += everywhere("riqn", [0.6, 0.6], environments=["hopper"])
    assert Evidence(records).combine([term(RIQN)], ["ant", "hopper"]).value == 0.6


def test_the_mean_over_models_needs_all_of_them():
    both = (term(RIQN, 0.5), term(RF, 0.5))
    records = everywhere("riqn", [0.8, 0.8]) + everywhere("rf", [0.6, 0.6], environments=["ant"])
    estimate = Evidence(records).combine(both, ["ant", "hopper"])
    assert estimate.value == pytest.approx(0.7)
    assert (estimate.environments, estimate.expected) == (1, 2)


def test_a_missing_cell_is_no_number():
    records = [r for r in everywhere("riqn", [0.8, 0.8]) if r.anomaly != "drift"]
    estimate = Evidence(records).combine([term(RIQN)], ["ant"])
    assert show(estimate, "auc") == "not run"
    kept = Evidence(records).combine([term(RIQN, anomalies=("iid",))], ["ant"])
    assert show(kept, "auc") == "80.0 [80.0, 80.0]"


def test_a_failed_cell_is_its_state():
    records = everywhere("riqn", [0.8, 0.8])
    records[3] = make_record("riqn", "ant", records[3].anomaly, status="oom", reason="too large")
    assert show(Evidence(records).combine([term(RIQN)], ["ant", "hopper"]), "auc") == "oom"


def test_what_is_printed():
    assert show(Estimate(0.7, 0.65, 0.75, 7, 7), "auc") == "70.0 [65.0, 75.0]"
    assert show(Estimate(4.25, math.nan, math.nan, 7, 7), "delay") == "4.2"
    assert show(Estimate(0.1, 0.05, 0.2, 3, 7), "far") == "0.100 [0.050, 0.200] (3 of 7)"
    assert show(Estimate(environments=1, expected=1), "delay") == UNDEFINED


def test_digits_of_the_paper_stand_where_they_belong():
    table_5 = BY_ID["table-5"]
    series = {s.label: s for s in table_5.series}
    sensor, dynamics = GROUPED
    assert paper.digit(table_5, series["NPN"], "walker2d", sensor, "auc") == 1.0
    assert paper.digit(table_5, series["RIQN"], "hopper", dynamics, "delay") == 5.24
    assert paper.digit(table_5, series["AVG"], "acrobot", sensor, "auc") == pytest.approx(0.9479)
    assert math.isnan(paper.digit(table_5, series["RIQN"], "hopper", sensor, "auc_matched"))
    table_4 = BY_ID["table-4"]
    alone = {s.label: s for s in table_4.series}["Δ = 10: e = 1"]
    assert paper.digit(table_4, alone, "hopper", ALL, "auc") == pytest.approx(0.776)
    table_3 = BY_ID["table-3"]
    by_label = {s.label: s for s in table_3.series}
    n_riqn, far = by_label["Δ = 10: N-RIQN"], by_label["Δ = 20: RIQN"]
    assert paper.digit(table_3, n_riqn, "ant", ALL, "auc") == pytest.approx(0.747)
    assert math.isnan(paper.digit(table_3, n_riqn, "hopper", ALL, "auc"))
    assert math.isnan(paper.digit(table_3, far, "ant", ALL, "auc"))


@pytest.mark.parametrize(("label", "mean"), [("RIQN", 89.4), ("RIQN+MS", 89.8), ("NPN", 87.6),
                                              ("RF", 80.9)])  # fmt: skip
def test_the_papers_means_over_table_5(label, mean):
    figure = BY_ID["figure-models"]
    series = {s.label: s for s in figure.series}[f"Δ = 1: {label}"]
    assert 100 * paper.mean_digit(figure, series, ALL, "auc") == pytest.approx(mean, abs=0.06)


def test_sweep_of_samples_has_the_papers_digit_at_eight_only():
    sweep = BY_ID["figure-samples"]
    found = [paper.digit(sweep, s, "ant", ALL, "auc") for s in sweep.series]
    assert [math.isnan(x) for x in found] == [True, False, True, True]


def test_table_has_ours_and_the_papers_below():
    records = everywhere("riqn", [0.8, 0.6])
    table = BY_ID["table-4"]
    numbers = compute(table, Evidence(records))
    [shown] = layout(table, numbers, table.metrics)
    ant = next(row for row in shown.rows if row[0] == "Ant")
    below = shown.rows[shown.rows.index(ant) + 1]
    assert ant[:5] == ["Ant", "AUC (%)", "ours", "not run", "70.0 [60.0, 80.0]"]
    assert below == ["", "", "paper", "83.1", "86.5", "79.6", "84.7"]
    mean = next(row for row in shown.rows if row[0] == "Mean")
    assert mean[4].endswith("(2 of 7)")


def test_a_mean_without_all_environments_is_in_the_table_and_not_in_the_figure():
    table = BY_ID["table-4"]
    numbers = compute(table, Evidence(everywhere("riqn", [0.8, 0.6])))
    [figure] = figures(table, numbers).values()
    panel = figure.panels[0]
    [drawn] = [dots for dots in panel.series if dots.label == "e = 5"]
    shown = dict(zip(panel.categories, drawn.values, strict=True))
    assert shown["Ant"] == pytest.approx(70.0)
    assert math.isnan(shown["CartPole"])
    assert math.isnan(shown["Mean"])


def test_the_papers_mean_stands_only_where_it_has_every_environment():
    numbers = compute(BY_ID["table-3"], Evidence([]))
    assert math.isnan(numbers["mean", "Δ = 1: RIQN", "all", "auc"].paper)
    numbers = compute(BY_ID["table-4"], Evidence([]))
    seven = [89.01, 86.7, 86.0, 86.5, 87.0, 86.7, 85.1]
    mean = numbers["mean", "Δ = 1: e = 5", "all", "auc"].paper
    assert 100 * mean == pytest.approx(sum(seven) / 7)


def test_every_experiment_lays_out_every_number():
    for experiment in EXPERIMENTS:
        numbers = compute(experiment, Evidence([]))
        metrics = (*experiment.metrics, *experiment.beyond)
        tables = layout(experiment, numbers, metrics)
        ours = [row for t in tables for row in t.rows if row[2] == "ours"]
        assert sum(len(row) - 3 for row in ours) == len(numbers)
        assert {cell for row in ours for cell in row[3:]} == {"not run"}


def test_csv_reads_back_to_the_same_numbers():
    table = BY_ID["table-5"]
    numbers = compute(table, Evidence(everywhere("riqn", [0.81, 0.6])))
    header, *lines = csv_lines(numbers)
    for line, number in zip(lines, numbers.values(), strict=True):
        row = dict(zip(header, line, strict=True))
        value = number.estimate.value
        read = float(row["value"] or "nan")
        assert read == pytest.approx(value, rel=1e-5, nan_ok=True)
        assert row["state"] == ("" if number.estimate.environments else "not run")
    assert sum(bool(line[header.index("value")]) for line in lines) > 10


def test_nothing_missing_is_printed_as_zero(tmp_path):
    publish(tmp_path, header(), everywhere("riqn", [0.8, 0.6]), None, pictures=False)
    for path in tmp_path.rglob("*.csv"):
        for row in csv.DictReader(io.StringIO(path.read_text())):
            if row.get("environments") == "0":
                assert row["value"] == "", path.name


def test_records_of_other_data_setups_or_seeds_are_left_out(tmp_path):
    own = everywhere("riqn", [0.8, 0.6])
    publish(tmp_path / "a", header(), own, None, pictures=False)
    others = [
        *everywhere("riqn", [0.1, 0.1], digest="cd" * 32),
        *everywhere("riqn", [0.1, 0.1], limit=5),
        *everywhere("riqn", [0.1, 0.1], seed=7),
        *everywhere("riqn", [0.1, 0.1], overrides={"samples": 5}),
        *everywhere("someone-elses", [0.1, 0.1]),
    ]
    publish(tmp_path / "b", header(), [*others, *own], None, pictures=False)
    for path in (p for p in (tmp_path / "a").rglob("*") if p.is_file()):
        assert (tmp_path / "b" / path.relative_to(tmp_path / "a")).read_bytes() == path.read_bytes()


def test_caption_names_data_seeds_and_a_reduced_tier(tmp_path):
    table = BY_ID["table-3"]
    records = everywhere("riqn", [0.8, 0.6]) + everywhere("riqn", [0.8, 0.6], seed=1)
    records += everywhere("riqn", [0.8, 0.6], horizon=10)
    numbers = compute(table, Evidence(records))
    whole = header(tier=TIERS["full"], split="standard", train=500, calibration=100, test=50)
    text = captions.caption(whole, table, numbers)
    assert "Detector seeds: 2 for Δ = 1; 1 for Δ = 10." in text
    assert "50 test seeds" in text
    assert "reduced" not in text
    reduced = dataclasses.replace(whole, tier=TIERS["reduced"], split="reduced", calibration=50,
                                  test=20)  # fmt: skip
    less = "the first 50 of 100 calibration trajectories and 20 of 50 test seeds of split standard"
    assert less in captions.caption(reduced, table, numbers)
    assert less in captions.of_returns(reduced)
    assert less in "\n".join(captions.opening(reduced, records))
    mini = captions.caption(header(), table, numbers)
    assert "(**reduced**: split standard has 500 training trajectories, 100 calibration " in mini
    assert "and 50 test seeds, and episodes end after 300 steps here)" in mini
    own = captions.caption(dataclasses.replace(whole, split="mine", test=10), table, numbers)
    assert "(**reduced**: split standard has 50 test seeds)" in own


def test_page_tells_how_long_networks_were_trained():
    records = everywhere("riqn", [0.8, 0.6])
    assert "trained for" not in "\n".join(captions.opening(header(), records))
    for number, record in enumerate(records):
        record.parameters["updates"] = 600 if number else 2400
    text = "\n".join(captions.opening(header(), records))
    assert "- Networks were trained for at most 600 or 2400 updates. " in text


def test_page_tells_of_failures_with_their_reasons(tmp_path):
    records = everywhere("riqn", [0.8, 0.6])
    records[0] = make_record("riqn", "ant", "iid", status="timeout", reason="not done after 5 s")
    publish(tmp_path, header(), records, None, pictures=False)
    page = (tmp_path / "README.md").read_text()
    assert "2 of 252 fits and scorings have been run, 1 of which failed" in page
    assert "not done after 5 s" in page


def test_returns_are_kept_and_read_back(tmp_path):
    found = {"acrobot": {k: [-80.0, -90.0] for k in returns.KINDS}}
    path = tmp_path / returns.FILE
    path.write_text(returns.dump(found, "ab" * 32))
    assert returns.load(path, "ab" * 32) == found
    assert returns.load(path, "cd" * 32) is None
    table = returns.table(found)
    assert table.rows[0][:4] == ["Acrobot", "IQN", "ours", "-85.0 [-90.0, -80.0]"]
    assert table.rows[1][:4] == ["", "", "paper", "-78.7"]


def test_measured_costs_cover_every_setup_in_every_environment():
    measured = json.loads(costs.FILE.read_text())
    assert list(measured) == list(ENVIRONMENTS)
    assert all(measured[e]["fit"].keys() == measured["ant"]["fit"].keys() for e in measured)
    assert all(measured[e]["score"].keys() == measured["ant"]["score"].keys() for e in measured)


def test_costs_and_digits_ship_with_the_package():
    root = Path(oodd_eval.__file__).parent
    assert costs.FILE.is_relative_to(root)
    assert paper.FILE.is_relative_to(root)
