"""Verdicts: the interval against the region, in worlds where the truth of every claim is known."""

import itertools
import json
import math
import re
import zlib
from importlib import resources

import pytest
from helpers_records import make_record
from oodd_paper.claims import CLAIMS, RETURN, Claim, Region, claims_table, judge, rulings, summary
from oodd_paper.estimates import Estimate, Estimator, Side, lost_return
from oodd_paper.experiments import EXPERIMENTS, read_tables, settings_of
from oodd_paper.inputs import KINDS

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, TABLE1
from oodd_eval.errors import ResultsError

ABOUT_DETECTORS = [c for c in CLAIMS if c.metric != RETURN and not c.settled]
SETTLED = [c for c in CLAIMS if c.settled]
OF_RETURNS = [c for c in CLAIMS if c.metric == RETURN]
BY_ID = {c.id: c for c in CLAIMS}

ABOVE = Region(above=0.0, negligible=0.005)
BETWEEN = Region(-0.02, 0.02)
BELOW = Region(below=0.01)
SLIGHT = Region(above=0.0, below=0.05, negligible=0.005)


def interval(low, high):
    return Estimate((low + high) / 2, low, high, environments=7, expected=7)


@pytest.mark.parametrize(
    ("rule", "low", "high", "verdict"),
    [
        (ABOVE, 0.01, 0.05, "confirmed"),
        (ABOVE, -0.05, -0.01, "refuted"),
        (ABOVE, -0.01, 0.05, "undecided"),
        (ABOVE, 0.0, 0.0, "negligible"),  # the same scores
        (ABOVE, -0.004, 0.004, "negligible"),  # too little to matter
        (ABOVE, -0.0042, 0.0018, "negligible"),  # not refuted, though most of it is below 0
        (ABOVE, 0.0005, 0.0049, "negligible"),  # certainly above 0, and too little to matter
        (ABOVE, -0.0049, -0.001, "negligible"),  # certainly below 0, and too little to matter
        (ABOVE, -0.004, 0.005, "undecided"),  # up to the bound, which is not inside
        (ABOVE, -0.005, 0.004, "undecided"),
        (ABOVE, 0.001, 0.006, "confirmed"),
        (ABOVE, -0.006, -0.001, "refuted"),
        (SLIGHT, 0.001, 0.049, "confirmed"),
        (SLIGHT, 0.001, 0.004, "negligible"),
        (SLIGHT, 0.05, 0.09, "refuted"),  # a difference, and no slight one
        (SLIGHT, 0.04, 0.06, "undecided"),
        (SLIGHT, -0.02, -0.01, "refuted"),
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
    assert rule.verdict(interval(low, high)) == verdict


@pytest.mark.parametrize("half", [0.005, 0.5, 0.02])
def test_negligible_is_the_same_for_a_claim_and_its_opposite(half):
    ends = [k * half / 2 for k in range(-4, 5)]
    for low, high in itertools.combinations(ends, 2):
        one = Region(above=0.0, negligible=half).verdict(interval(low, high))
        other = Region(above=0.0, negligible=half).verdict(interval(-high, -low))
        opposite = {"confirmed": "refuted", "refuted": "confirmed"}
        assert (one == "negligible") == (max(-low, high) < half)
        if low != 0 != high:
            assert other == opposite.get(one, one)


def test_without_a_number_nothing_is_decided():
    assert ABOVE.verdict(Estimate(expected=7)) == "not run"
    assert ABOVE.verdict(Estimate(environments=7, expected=7)) == "undecided"
    # A region is printed in the unit of its metric.
    assert [ABOVE.describe("auc"), BETWEEN.describe("auc"), BELOW.describe("auc")] == [
        "> 0", "between -2 and 2", "< 1",
    ]  # fmt: skip
    assert BETWEEN.describe("far") == "between -0.02 and 0.02"


def records_of(world):
    """Records of every setting everywhere; `world` gives (auc, delay, far) of a cell."""
    made = []
    for setting, environment, anomaly in itertools.product(
        settings_of(EXPERIMENTS), ENVIRONMENTS, TABLE1
    ):
        auc, delay, far = world(setting, anomaly)
        values = {
            "auc": auc, "auc_matched": auc, "delay": delay, "delay_censored": delay, "far": far
        }  # fmt: skip
        made.append(
            make_record(
                setting.detector, environment, anomaly, values=values, horizon=setting.horizon,
                overrides=setting.overrides,
            )
        )  # fmt: skip
    return made


def as_claimed(setting, anomaly, sign=1.0):
    """AUCs as the paper says; with the sign turned, everything is the other way round."""
    far_horizon, group = setting.horizon > 1, ANOMALIES[anomaly].group
    order = {"riqn": 0, "riqn-ms": 1, "npn": 2, "rf": 3, "n-riqn": 4}.get(setting.detector, 5)
    gain = {"sensor": 0.1, "dynamics": 0.0}[group] - 0.02 * order
    gain -= 0.05 * (anomaly == "drift")
    if far_horizon:
        gain += {"drift": 0.04, "shutdown": -0.04}.get(anomaly, -0.01)
    parameters = setting.overrides
    gain -= {"members": 0.03, "samples": 0.0}.get(next(iter(parameters), ""), 0.0)
    gain -= 0.03 * (parameters.get("samples") == 4)
    delay = 10 + (1.5 if group == "dynamics" else 0) + order + (setting.horizon - 1)
    auc = 0.75 + gain if sign > 0 else 0.25 - gain
    return [auc, auc], [delay, delay], [0.1, 0.1]


def opposite(setting, anomaly):
    auc, delay, far = as_claimed(setting, anomaly, sign=-1.0)
    parameters, group = setting.overrides, ANOMALIES[anomaly].group
    if parameters.get("samples", 8) > 8:
        auc = [x + 0.05 for x in auc]  # more samples do help
    if setting.horizon > 1:
        auc = [x + (0.1 if anomaly != "drift" else -0.05) for x in auc]
        far = [0.01, 0.01]  # longer horizons do pay off
    delay = [40 - x - 30 * (setting.horizon > 1) for x in delay]
    return auc, delay, [x + (0.3 if group == "sensor" else 0.2) for x in far]


def noise(setting, anomaly):
    """The two trajectories disagree as widely as can be, in a way of each setting's own."""
    flip = zlib.crc32(f"{setting}{anomaly}".encode()) // 7 % 2
    return [[0.0, 1.0], [0.0, 40.0], [0.0, 0.5]] if flip else [[1.0, 0.0], [40.0, 0.0], [0.5, 0.0]]


@pytest.fixture(scope="module")
def worlds():
    return [Estimator(records) for records in (records_of(as_claimed), records_of(opposite), [])]


@pytest.mark.parametrize("claim", ABOUT_DETECTORS, ids=lambda c: c.id)
def test_a_claim_is_confirmed_where_it_is_true_and_refuted_where_its_opposite_is(claim, worlds):
    verdicts = [judge(claim, claim.metric, world).verdict for world in worlds]
    assert verdicts == ["confirmed", "refuted", "not run"]


def test_noise_decides_nothing_but_what_its_means_say():
    estimator = Estimator(records_of(noise))
    judged = {c.id: judge(c, c.metric, estimator) for c in ABOUT_DETECTORS}
    # Where both sides happen to have the same noise, it cancels, as it should.
    noisy = {i: j for i, j in judged.items() if j.estimate.low < j.estimate.high}
    assert len(noisy) > len(CLAIMS) / 2
    # Delays are 20 on average at any horizon: no longer for it, and longer than 10.
    assert {i for i, j in noisy.items() if j.verdict != "undecided"} <= {
        "delay-grows-10",
        "delay-grows-20",
        "delay-at-least-10",
    }


@pytest.mark.parametrize("world", [as_claimed, opposite])
def test_what_is_settled_says_so_in_any_world_and_is_not_counted(world):
    assert {c.id: c.settled for c in SETTLED} == {
        "riqn-above-riqn-ms-1": "by definition",
        "far-groups": "by construction",
        "far-large": "by construction",
    }
    estimator = Estimator(records_of(world))
    made = rulings(estimator, None)
    for r in made:
        assert (r.paper.verdict == r.claim.settled) == bool(r.claim.settled)
        assert not math.isnan(r.paper.estimate.value) or r.claim in OF_RETURNS
    told = summary(made)
    assert f"of {len(CLAIMS) - 3} claims " in told
    assert "3 more are settled by definition or by construction and not counted." in told
    shown = dict(zip(CLAIMS, claims_table(made).rows, strict=True))
    assert shown[SETTLED[0]][1].startswith("by definition: ")


def test_upper_ends_are_the_papers_own_numbers():
    digits = json.loads(resources.files("oodd_eval.data").joinpath("paper_tables.json").read_text())
    sizes = digits["table4_ensemble_auc"].values()
    horizons = max(abs(e["1"]["5"] - e["10"]["5"]) for e in sizes) / 100
    groups = [e["delay"] for e in digits["table5_groups_delta1"].values()]
    delays = max(abs(g["dynamics"]["avg"] - g["sensor"]["avg"]) for g in groups)
    worded = [c for c in CLAIMS if re.search("slightly|small|similar", c.text)]
    assert {c.id for c in worded} == {
        "horizon-similar-10", "horizon-similar-20", "horizon-dynamics-10", "horizon-dynamics-20",
        "delay-dynamics",
    }  # fmt: skip
    for claim in worded:
        end = delays if claim.metric == "delay" else horizons
        assert claim.region.below == pytest.approx(end)
        assert claim.region.above in (0.0, -claim.region.below)
        assert claim.source.startswith("Table")


@pytest.mark.parametrize(
    ("auc", "verdict"),
    [(0.504, "negligible"), (0.5, "negligible"), (0.49, "refuted"), (0.8, "confirmed")],
)
def test_a_claim_about_every_environment_is_as_good_as_its_worst(auc, verdict):
    records = [
        make_record("riqn", e, a, values={"auc": [auc if e == "hopper" else 0.8] * 2})
        for e in ENVIRONMENTS
        for a in TABLE1
    ]
    judged = judge(BY_ID["non-trivial"], "auc", Estimator(records))
    assert judged.verdict == judged.by_environment["hopper"] == verdict
    assert judged.estimate.value == pytest.approx(min(auc, 0.8) - 0.5)


def test_every_claim_has_its_place_and_only_settings_that_are_run():
    run = set(settings_of(EXPERIMENTS))
    assert len(CLAIMS) == 57
    assert all(c.section and c.number and c.text for c in CLAIMS)
    assert all(run.issuperset(side.settings) for c in CLAIMS for side in c.sides)


ADDED = """
[[claim]]
id = "own"
text = "NPN is better than RF on Ant, iid"
section = "nowhere"
number = "NPN minus RF"
metric = "auc"
plus = { settings = ["npn"], anomalies = "iid" }
minus = { settings = ["rf"], anomalies = ["iid"] }
above = 0.0
environments = ["ant"]
"""


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        ('text = "NPN', 'txt = "NPN', "'own'.*txt"),
        ('metric = "auc"', 'metric = "acu"', "'own'.*unknown metric 'acu'"),
        ('"iid" }', '"idd" }', "'own'.*unknown scope 'idd'"),
        ('["ant"]', '["aunt"]', "'own'.*unknown environment 'aunt'"),
        ('settings = ["rf"], ', "", "'own'.*settings"),
        ("above = 0.0", 'settled = "by decree"', "'own'.*by decree"),
        ('environments = ["ant"]\n', ADDED, "'own'.*same id"),
    ],
)
def test_a_wrong_claim_is_named_with_what_is_wrong(tmp_path, old, new, part):
    text = ADDED.replace(old, new, 1) if new != ADDED else 2 * ADDED
    (tmp_path / "claims.toml").write_text(text)
    with pytest.raises(ResultsError, match=f"(?s)claims.toml.*{part}"):
        read_tables(tmp_path / "claims.toml", "claim", Claim.of)


def test_claims_wait_for_all_environments():
    claim = BY_ID["non-trivial"]
    records = [make_record("riqn", "ant", a, values={"auc": [0.8, 0.8]}) for a in TABLE1]
    assert judge(claim, "auc", Estimator(records)).verdict == "undecided"
    # Its number is the least clear of those that were run.
    records += [make_record("riqn", "acrobot", a, values={"auc": [0.9, 0.9]}) for a in TABLE1]
    for given in (records, records[::-1]):
        judged = judge(claim, "auc", Estimator(given))
        assert (judged.verdict, judged.estimate.value) == ("undecided", pytest.approx(0.3))
    claim = BY_ID["riqn-ms-above-npn-1"]
    records = [
        make_record(d, e, a, values={"auc": [auc, auc]})
        for d, auc in (("riqn-ms", 0.9), ("npn", 0.6))
        for e in list(ENVIRONMENTS)[:3]
        for a in TABLE1
    ]
    judged = judge(claim, "auc", Estimator(records))
    assert (judged.verdict, judged.estimate.value) == ("undecided", pytest.approx(0.3))
    [ruling] = [r for r in rulings(Estimator(records), None) if r.claim is claim]
    assert "(3 of 7 environments)" in claims_table([ruling]).rows[0][1]


def test_a_failed_cell_decides_nothing_and_is_named():
    claim = BY_ID["riqn-ms-above-npn-1"]
    records = [
        make_record(d, e, a, status="timeout" if (d, e) == ("npn", "ant") else "ok")
        for d in ("riqn-ms", "npn") for e in ENVIRONMENTS for a in TABLE1
    ]  # fmt: skip
    [ruling] = [r for r in rulings(Estimator(records), None) if r.claim is claim]
    assert ruling.paper.verdict not in ("confirmed", "refuted")
    assert "timeout" in claims_table([ruling]).rows[0]


def returns_of(sensor, dynamics):
    """Returns of 100 and 200, of which so many shares are left in each group of anomalies."""
    share = {"nominal": 1.0} | {
        a.id: sensor if a.group == "sensor" else dynamics for a in map(ANOMALIES.get, TABLE1)
    }
    return {e: {k: [100 * s, 200 * s] for k, s in share.items()} for e in ENVIRONMENTS}


@pytest.mark.parametrize(
    ("sensor", "dynamics", "verdicts"),
    [
        (0.9, 0.7, ("confirmed", "confirmed")),
        (0.3, 0.1, ("refuted", "confirmed")),
        (1.1, 1.2, ("refuted", "refuted")),
    ],
)
def test_loss_of_return_is_paired_and_a_share_of_the_nominal(sensor, dynamics, verdicts):
    made = {r.claim: r.paper for r in rulings(Estimator([]), returns_of(sensor, dynamics))}
    assert tuple(made[c].verdict for c in OF_RETURNS) == verdicts
    lost = (1 - (sensor + dynamics) / 2, sensor - dynamics)
    for claim, expected in zip(OF_RETURNS, lost, strict=True):
        # Proportional in every trajectory: resampling cannot change it.
        e = made[claim].estimate
        assert (e.value, e.low, e.high) == pytest.approx((expected,) * 3)
    slight = judge(BY_ID["returns-fall"], "return", Estimator([]), returns_of(0.99, 0.99))
    assert slight.verdict == "negligible"


def test_negative_returns_lose_when_they_fall():
    found = {"acrobot": {k: [-80.0] * 2 if k == "nominal" else [-100.0] * 2
                         for k in KINDS}}  # fmt: skip
    estimate = lost_return(found, [Side.of(1.0, "dynamics")], ["acrobot"])
    assert estimate.value == pytest.approx(0.25)
