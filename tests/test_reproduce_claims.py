"""Verdicts: the interval against the region, in worlds where the truth of every claim is known."""

import itertools
import math
import zlib

import pytest
from helpers_records import make_record

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS
from oodd_eval.paper import returns, verdicts
from oodd_eval.paper.claims import Rule, judge
from oodd_eval.paper.evidence import Estimate, Evidence
from oodd_eval.paper.experiments import EXPERIMENTS, setups_of
from oodd_eval.paper.paper_claims import CLAIMS, RETURNS

ABOVE = Rule(low=0.0, small=0.005)
BETWEEN = Rule(-0.02, 0.02)
BELOW = Rule(high=0.01)


def interval(low, high):
    return Estimate((low + high) / 2, low, high, environments=7, expected=7)


@pytest.mark.parametrize(
    ("rule", "low", "high", "verdict"),
    [
        (ABOVE, 0.01, 0.05, "confirmed"),
        (ABOVE, -0.05, -0.01, "refuted"),
        (ABOVE, -0.01, 0.05, "undecided"),
        (ABOVE, 0.0, 0.0, "refuted"),  # the same scores
        (ABOVE, -0.004, 0.004, "refuted"),  # too little to matter
        (ABOVE, -0.004, 0.006, "undecided"),
        (ABOVE, 0.001, 0.004, "confirmed"),  # little, and certain
        (BETWEEN, -0.01, 0.019, "confirmed"),
        (BETWEEN, 0.02, 0.05, "refuted"),
        (BETWEEN, -0.09, -0.03, "refuted"),
        (BETWEEN, 0.01, 0.03, "undecided"),
        (BELOW, -0.5, 0.009, "confirmed"),
        (BELOW, 0.011, 0.5, "refuted"),
        (BELOW, 0.0, 0.02, "undecided"),
    ],
)
def test_verdict_is_where_the_interval_lies(rule, low, high, verdict):
    assert rule(interval(low, high)) == verdict


def test_without_a_number_nothing_is_decided():
    assert ABOVE(Estimate(expected=7)) == "not run"
    assert ABOVE(Estimate(environments=7, expected=7)) == "undecided"


def test_a_region_is_printed_in_the_unit_of_its_metric():
    assert ABOVE.describe("auc") == "> 0"
    assert BETWEEN.describe("auc") == "between -2 and 2"
    assert BETWEEN.describe("far") == "between -0.02 and 0.02"
    assert BELOW.describe("auc") == "< 1"


def records_of(world):
    """Records of every setup everywhere; `world` gives (auc, delay, far) of a cell."""
    made = []
    for setup, environment, anomaly in itertools.product(
        setups_of(EXPERIMENTS), ENVIRONMENTS, ANOMALIES
    ):
        auc, delay, far = world(setup, anomaly)
        values = {
            "auc": auc, "auc_matched": auc, "delay": delay, "delay_censored": delay, "far": far
        }  # fmt: skip
        made.append(
            make_record(
                setup.detector, environment, anomaly, values=values, horizon=setup.horizon,
                overrides=dict(setup.parameters),
            )
        )  # fmt: skip
    return made


def as_claimed(setup, anomaly, sign=1.0):
    """AUCs as the paper says; with the sign turned, everything is the other way round."""
    far_horizon, group = setup.horizon > 1, ANOMALIES[anomaly].group
    order = {"riqn": 0, "riqn-ms": 1, "npn": 2, "rf": 3, "n-riqn": 4}.get(setup.detector, 5)
    gain = {"sensor": 0.1, "dynamics": 0.0}[group] - 0.02 * order
    gain -= 0.05 * (anomaly == "drift")
    if far_horizon:
        gain += {"drift": 0.04, "shutdown": -0.04}.get(anomaly, -0.01)
    parameters = dict(setup.parameters)
    gain -= {"members": 0.03, "samples": 0.0}.get(next(iter(parameters), ""), 0.0)
    gain -= 0.03 * (parameters.get("samples") == 4)
    delay = 10 + (2 if group == "dynamics" else 0) + order + (setup.horizon - 1)
    auc = 0.75 + gain if sign > 0 else 0.25 - gain
    return [auc, auc], [delay, delay], [0.1, 0.1]


def opposite(setup, anomaly):
    auc, delay, far = as_claimed(setup, anomaly, sign=-1.0)
    parameters, group = dict(setup.parameters), ANOMALIES[anomaly].group
    if parameters.get("samples", 8) > 8:
        auc = [x + 0.05 for x in auc]  # more samples do help
    if setup.horizon > 1:
        auc = [x + (0.1 if anomaly != "drift" else -0.05) for x in auc]
        far = [0.01, 0.01]  # longer horizons do pay off
    delay = [40 - x - 30 * (setup.horizon > 1) for x in delay]
    return auc, delay, [x + (0.3 if group == "sensor" else 0.2) for x in far]


def noise(setup, anomaly):
    """The two trajectories disagree as widely as can be, in a way of each setup's own."""
    flip = zlib.crc32(f"{setup}{anomaly}".encode()) // 7 % 2
    return [[0.0, 1.0], [0.0, 40.0], [0.0, 0.5]] if flip else [[1.0, 0.0], [40.0, 0.0], [0.5, 0.0]]


OF_RETURNS = [claim for claim, _ in RETURNS]
FALL, DYNAMICS = OF_RETURNS


@pytest.fixture(scope="module")
def claimed():
    return Evidence(records_of(as_claimed))


@pytest.fixture(scope="module")
def denied():
    return Evidence(records_of(opposite))


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda c: c.id)
def test_a_claim_is_confirmed_where_it_is_true(claim, claimed):
    assert judge(claim, claim.metric, claimed).verdict == "confirmed"


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda c: c.id)
def test_a_claim_is_refuted_where_the_opposite_is_true(claim, denied):
    assert judge(claim, claim.metric, denied).verdict == "refuted"


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda c: c.id)
def test_a_claim_is_not_run_without_records(claim):
    judged = judge(claim, claim.metric, Evidence([]))
    assert judged.verdict == "not run"
    assert math.isnan(judged.estimate.value)


def test_noise_decides_nothing_but_that_delays_did_not_grow():
    evidence = Evidence(records_of(noise))
    judged = {c.id: judge(c, c.metric, evidence) for c in CLAIMS}
    # Where both sides happen to have the same noise, it cancels, as it should.
    noisy = {i: j for i, j in judged.items() if j.estimate.low < j.estimate.high}
    assert len(noisy) > len(CLAIMS) / 2
    # Delays are 20 on average at any horizon: no longer for it, and longer than 10.
    assert {i for i, j in noisy.items() if j.verdict != "undecided"} <= {
        "delay-grows-10",
        "delay-grows-20",
        "delay-at-least-10",
    }


def test_ids_of_claims_are_distinct_and_every_claim_has_its_place():
    ids = [c.id for c in (*CLAIMS, *OF_RETURNS)]
    assert len(set(ids)) == len(ids)
    assert all(c.place and c.number and c.text for c in (*CLAIMS, *OF_RETURNS))


def test_setups_of_claims_are_run():
    run = set(setups_of(EXPERIMENTS))
    assert all(setup in run for claim in CLAIMS for setup in claim.setups)


def test_difference_has_the_value_worked_by_hand():
    # Two trajectories, RIQN .9 and .7 everywhere, NPN .6 and .6: the difference is .3 and .1.
    records = [
        make_record(detector, environment, anomaly, values={"auc": auc})
        for detector, auc in (("riqn-ms", [0.9, 0.7]), ("npn", [0.6, 0.6]))
        for environment in ENVIRONMENTS
        for anomaly in ANOMALIES
    ]
    claim = next(c for c in CLAIMS if c.id == "riqn-ms-above-npn-1")
    judged = judge(claim, "auc", Evidence(records))
    assert judged.estimate.value == pytest.approx(0.2)
    assert 0.1 < judged.estimate.low < 0.2 < judged.estimate.high < 0.3
    assert judged.verdict == "confirmed"


def test_one_environment_refutes_a_claim_about_every_one():
    claim = next(c for c in CLAIMS if c.id == "non-trivial")
    records = [
        make_record("riqn", e, a, values={"auc": [0.4 if e == "hopper" else 0.8] * 2})
        for e in ENVIRONMENTS
        for a in ANOMALIES
    ]
    judged = judge(claim, "auc", Evidence(records))
    assert judged.verdict == "refuted"
    assert judged.estimate.value == pytest.approx(-0.1)
    assert dict(judged.by_environment)["hopper"] == "refuted"
    assert list(dict(judged.by_environment).values()).count("confirmed") == 6


def test_a_claim_about_every_environment_waits_for_all_of_them():
    claim = next(c for c in CLAIMS if c.id == "non-trivial")
    records = [make_record("riqn", "ant", a, values={"auc": [0.8, 0.8]}) for a in ANOMALIES]
    assert judge(claim, "auc", Evidence(records)).verdict == "undecided"


def test_a_claim_about_a_mean_waits_for_all_environments():
    claim = next(c for c in CLAIMS if c.id == "riqn-ms-above-npn-1")
    records = [
        make_record(d, e, a, values={"auc": [auc, auc]})
        for d, auc in (("riqn-ms", 0.9), ("npn", 0.6))
        for e in list(ENVIRONMENTS)[:3]
        for a in ANOMALIES
    ]
    judged = judge(claim, "auc", Evidence(records))
    assert (judged.verdict, judged.estimate.value) == ("undecided", pytest.approx(0.3))
    [ruling] = [r for r in verdicts.rulings(Evidence(records), None) if r.claim is claim]
    assert "(3 of 7 environments)" in verdicts.table([ruling]).rows[0][1]


def test_a_failed_cell_decides_nothing_and_is_named():
    claim = next(c for c in CLAIMS if c.id == "riqn-ms-above-npn-1")
    records = [
        make_record(d, e, a, status="timeout" if (d, e) == ("npn", "ant") else "ok")
        for d in ("riqn-ms", "npn") for e in ENVIRONMENTS for a in ANOMALIES
    ]  # fmt: skip
    [ruling] = [r for r in verdicts.rulings(Evidence(records), None) if r.claim is claim]
    assert ruling.own.verdict not in ("confirmed", "refuted")
    assert "timeout" in verdicts.table([ruling]).rows[0]


def test_loss_of_return_is_paired_and_a_share_of_the_nominal():
    # Nominal 100 and 200; sensor anomalies cost 10 % of it, dynamics anomalies 30 %.
    share = {"nominal": 1.0} | {
        a.id: 0.9 if a.group == "sensor" else 0.7 for a in ANOMALIES.values()
    }
    found = {e: {k: [100 * s, 200 * s] for k, s in share.items()} for e in ENVIRONMENTS}
    made = {r.claim: r.own for r in verdicts.rulings(Evidence([]), found) if r.claim in OF_RETURNS}
    # Proportional in every trajectory: resampling cannot change it.
    for claim in OF_RETURNS:
        e = made[claim].estimate
        assert (e.value, e.low, e.high) == pytest.approx((0.2, 0.2, 0.2))
        assert made[claim].verdict == "confirmed"


def test_returns_that_collapse_or_rise_refute_the_claims_about_them():
    def verdicts_of(sensor, dynamics):
        share = {"nominal": 1.0} | {
            a.id: sensor if a.group == "sensor" else dynamics for a in ANOMALIES.values()
        }
        found = {e: {k: [100 * s, 200 * s] for k, s in share.items()} for e in ENVIRONMENTS}
        made = {r.claim: r.own.verdict for r in verdicts.rulings(Evidence([]), found)}
        return made[FALL], made[DYNAMICS]

    assert verdicts_of(0.3, 0.1) == ("refuted", "confirmed")
    assert verdicts_of(1.1, 1.2) == ("refuted", "refuted")


def test_negative_returns_lose_when_they_fall():
    found = {"acrobot": {k: [-80.0] * 2 if k == "nominal" else [-100.0] * 2
                         for k in returns.KINDS}}  # fmt: skip
    estimate = returns.loss(found, ["acrobot"], {"dynamics": 1.0})
    assert estimate.value == pytest.approx(0.25)


def test_table_of_claims_has_a_row_per_claim_and_counts_verdicts(claimed):
    made = verdicts.rulings(claimed, None)
    assert len(verdicts.table(made).rows) == len(CLAIMS) + 2
    own = f"of {len(CLAIMS) + 2} claims {len(CLAIMS)} confirmed, 2 not run"
    assert own in verdicts.summary(made)
    assert all(r.fair is None for r in made if r.claim.metric in ("far", "return"))
