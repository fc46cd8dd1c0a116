"""What Danesh & Fern (2021) claim, with the place where they do, ready to be judged."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Final

from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.paper.claims import SMALL, Claim, Part, Rule
from oodd_eval.paper.experiments import (
    ALL,
    BY_GROUP,
    HORIZONS,
    MODELS,
    RIQN,
    Setup,
    with_members,
    with_samples,
)

EVERYWHERE: Final = tuple(ENVIRONMENTS)
TWO: Final = ("acrobot", "ant")
"""The paper's "two representative environments" of Table 3."""

SENSOR: Final = BY_GROUP["sensor"].anomalies
DYNAMICS: Final = BY_GROUP["dynamics"].anomalies
SUDDEN: Final = tuple(a for a in SENSOR if a != "drift")
MODEL_SETUPS: Final = tuple(Setup(detector) for detector in MODELS)

BETTER: Final = Rule(low=0.0, small=SMALL["auc"])
LATER: Final = Rule(low=0.0, small=SMALL["delay"])

SIMILAR: Final = 0.03
"""AUCs this close are "quite similar": in Table 4 the step from Δ = 1 to 10 costs 2.8 points."""

ENOUGH: Final = 0.01
"""A gain below one point of AUC is "no absolute benefit"."""

FAR_MARGIN: Final = 0.02
"""False-alarm rates this close are alike: in Table 5 groups differ by at most 0.04, mostly 0.01."""


def _versus(
    first: Setup, second: Setup, anomalies: tuple[str, ...] = ALL.anomalies
) -> tuple[Part, ...]:
    return Part(1.0, (first,), anomalies), Part(-1.0, (second,), anomalies)


def _groups(setups: tuple[Setup, ...], *, of: float = 1.0) -> tuple[Part, ...]:
    """Sensor minus dynamics; the reverse for ``of=-1``."""
    return Part(of, setups, SENSOR), Part(-of, setups, DYNAMICS)


def _models() -> list[Claim]:
    named = MODELS.items()
    pairs = [*itertools.pairwise(named), (("riqn", MODELS["riqn"]), ("npn", MODELS["npn"]))]
    return [
        Claim(
            f"{first}-above-{second}-{h}",
            f"{label} has a higher AUC than {other}, Δ = {h}",
            "section 4.1, Comparing Dynamics Models",
            f"{label} minus {other}",
            "auc",
            _versus(Setup(first, h), Setup(second, h)),
            BETTER,
            EVERYWHERE,
            note="the same by definition: mean sampling acts on rollouts"
            if (first, second, h) == ("riqn", "riqn-ms", 1)
            else "",
        )
        for h in HORIZONS
        for (first, label), (second, other) in pairs
    ]


def _groups_of_anomalies() -> list[Claim]:
    place = "section 4.2, Impact of High-Level Anomaly Types; Table 5"
    named = [(detector, label, (Setup(detector),)) for detector, label in MODELS.items()]
    each = [
        Claim(
            f"sensor-above-dynamics-{name}",
            f"Sensor anomalies give a higher AUC than dynamics anomalies: {label}",
            place,
            "sensor minus dynamics, Δ = 1",
            "auc",
            _groups(setups),
            BETTER,
            EVERYWHERE,
        )
        for name, label, setups in [*named, ("models", "mean over models", MODEL_SETUPS)]
    ]
    return [
        *each,
        Claim(
            "sensor-above-dynamics-everywhere",
            "The mean over models is higher for sensor than for dynamics anomalies in every "
            "environment",
            place,
            "least clear of the environments",
            "auc",
            _groups(MODEL_SETUPS),
            BETTER,
            EVERYWHERE,
            everywhere=True,
        ),
    ]


def _horizons() -> list[Claim]:
    place = "section 4.1, Impact of Horizon"
    claims = [
        Claim(
            "non-trivial",
            "RIQN's performance is non-trivial in every environment, Δ = 1",
            "section 4.1, Overall AUC",
            "RIQN minus 50, least clear of the environments",
            "auc",
            (Part(1.0, (RIQN,), ALL.anomalies),),
            Rule(low=0.0, small=SMALL["auc"]),
            EVERYWHERE,
            everywhere=True,
            offset=0.5,
            note="under the paper's AUC the phase of an episode counts, too",
        ),
        Claim(
            "drift-hardest",
            "At Δ = 1 drift has a lower AUC than the other sensor anomalies",
            place,
            "others minus drift",
            "auc",
            (Part(1.0, (RIQN,), SUDDEN), Part(-1.0, (RIQN,), ("drift",))),
            BETTER,
            EVERYWHERE,
        ),
    ]
    for h in HORIZONS[1:]:
        far = Setup("riqn", h)
        claims += [
            Claim(
                f"horizon-similar-{h}",
                f"Averaged over anomalies, Δ = {h} is similar to Δ = 1",
                "section 4.1, Overall AUC",
                f"Δ = {h} minus Δ = 1",
                "auc",
                _versus(far, RIQN),
                Rule(-SIMILAR, SIMILAR),
                EVERYWHERE,
            ),
            Claim(
                f"horizon-helps-drift-{h}",
                f"Δ = {h} improves drift",
                place,
                f"Δ = {h} minus Δ = 1, drift",
                "auc",
                _versus(far, RIQN, ("drift",)),
                BETTER,
                EVERYWHERE,
            ),
            Claim(
                f"horizon-hurts-shutdown-{h}",
                f"Δ = {h} degrades sensor shutdown",
                place,
                f"Δ = 1 minus Δ = {h}, shutdown",
                "auc",
                _versus(RIQN, far, ("shutdown",)),
                BETTER,
                EVERYWHERE,
            ),
            Claim(
                f"horizon-hurts-sudden-{h}",
                f"Δ = 1 is better than Δ = {h} for sensor anomalies other than drift",
                place,
                f"Δ = 1 minus Δ = {h}",
                "auc",
                _versus(RIQN, far, SUDDEN),
                BETTER,
                EVERYWHERE,
            ),
            Claim(
                f"horizon-dynamics-{h}",
                f"Δ = 1 has a small advantage over Δ = {h} for dynamics anomalies",
                place,
                f"Δ = 1 minus Δ = {h}",
                "auc",
                _versus(RIQN, far, DYNAMICS),
                BETTER,
                EVERYWHERE,
            ),
        ]
    return claims


def _components() -> list[Claim]:
    claims = []
    for h in HORIZONS:
        for where, environments in (("Acrobot and Ant", TWO), ("all environments", EVERYWHERE)):
            claims.append(
                Claim(
                    f"memory-{h}-{len(environments)}",
                    f"Memory helps: RIQN has a higher AUC than N-RIQN, Δ = {h}, {where}",
                    "section 4.2, Role of memory; Table 3",
                    "RIQN minus N-RIQN",
                    "auc",
                    _versus(Setup("riqn", h), Setup("n-riqn", h)),
                    BETTER,
                    environments,
                )
            )
    claims += [
        Claim(
            f"ensemble-{h}",
            f"An ensemble of five has a higher AUC than one network, Δ = {h}",
            "section 4.2, Impact of Ensemble Size; Table 4",
            "e = 5 minus e = 1",
            "auc",
            _versus(with_members(5, h), with_members(1, h)),
            BETTER,
            EVERYWHERE,
        )
        for h in (1, 10)
    ]
    claims.append(
        Claim(
            "samples-4",
            "M = 4 has a lower AUC than M = 8 in every environment",
            "appendix A",
            "M = 8 minus M = 4, least clear of the environments",
            "auc",
            _versus(RIQN, with_samples(4)),
            BETTER,
            EVERYWHERE,
            everywhere=True,
        )
    )
    claims += [
        Claim(
            f"samples-{m}",
            f"M = 8 suffices: M = {m} gains less than one point",
            "appendix A",
            f"M = {m} minus M = 8",
            "auc",
            _versus(with_samples(m), RIQN),
            Rule(high=ENOUGH),
            EVERYWHERE,
        )
        for m in (32, 128)
    ]
    return claims


def _alarms() -> list[Claim]:
    place = "section 4.3, Anomaly Detection Performance"
    claims = [
        Claim(
            "delay-dynamics",
            "Delays are slightly longer for dynamics than for sensor anomalies, mean over models",
            f"{place}; Table 5",
            "dynamics minus sensor, Δ = 1, steps",
            "delay",
            _groups(MODEL_SETUPS, of=-1.0),
            LATER,
            EVERYWHERE,
        ),
        *(
            Claim(
                f"delay-riqn-{detector}",
                f"RIQN has shorter delays than {label}, Δ = 1",
                "Table 5",
                f"{label} minus RIQN, steps",
                "delay",
                _versus(Setup(detector), RIQN),
                LATER,
                EVERYWHERE,
            )
            for detector, label in MODELS.items()
            if detector not in ("riqn", "riqn-ms")
        ),
    ]
    for h in HORIZONS[1:]:
        far = Setup("riqn", h)
        claims += [
            Claim(
                f"delay-grows-{h}",
                f"Delays at Δ = {h} are longer by about Δ",
                f"{place} (not shown)",
                f"Δ = {h} minus Δ = 1, steps",
                "delay",
                _versus(far, RIQN),
                Rule(0.5 * h, 1.5 * h),
                EVERYWHERE,
                note="about: from half of Δ to one and a half",
            ),
            Claim(
                f"delay-at-least-{h}",
                f"Mean delays at Δ = {h} are at least Δ in every environment",
                "section 3",
                f"delay at Δ = {h} minus {h}, steps, least clear of the environments",
                "delay",
                (Part(1.0, (far,), ALL.anomalies),),
                LATER,
                EVERYWHERE,
                everywhere=True,
                offset=float(h),
                note="called a lower bound of any delay; yet a score is about the observation of "
                "its own time, so that an alarm may come at once",
            ),
            Claim(
                f"far-no-gain-{h}",
                f"Δ = {h} does not pay off in a lower false-alarm rate",
                place,
                f"FAR at Δ = 1 minus FAR at Δ = {h}",
                "far",
                _versus(RIQN, far),
                Rule(high=FAR_MARGIN),
                EVERYWHERE,
            ),
        ]
    claims += [
        Claim(
            "far-groups",
            "The false-alarm rate is not particularly sensitive to the group of anomalies",
            f"{place}; Table 5",
            "sensor minus dynamics, mean over models",
            "far",
            _groups(MODEL_SETUPS),
            Rule(-FAR_MARGIN, FAR_MARGIN),
            EVERYWHERE,
            note="false alarms are counted before the onset, where nothing of an anomaly is seen: "
            "only onsets differ between anomalies",
        ),
        Claim(
            "far-large",
            "False-alarm rates are on the order of 10 %, mean over models",
            f"{place}; Table 5",
            "FAR",
            "far",
            (Part(1.0, MODEL_SETUPS, ALL.anomalies),),
            Rule(0.05, 0.2),
            EVERYWHERE,
            note="on the order: from 5 to 20 %",
        ),
    ]
    return claims


RETURNS: Final[tuple[tuple[Claim, Mapping[str, float]], ...]] = (
    (
        Claim(
            "returns-fall",
            "Anomalies lower the return of the policies, and not catastrophically",
            "section 2.2; Table 2",
            "share of the nominal return that is lost",
            "return",
            (),
            Rule(0.0, 0.5),
            EVERYWHERE,
            note="catastrophically: by more than half",
        ),
        {"sensor": 0.5, "dynamics": 0.5},
    ),
    (
        Claim(
            "returns-dynamics",
            "Dynamics anomalies cost the policies more of their return than sensor anomalies",
            "section 2.2; Table 2",
            "lost share of the nominal return, dynamics minus sensor",
            "return",
            (),
            Rule(low=0.0, small=SMALL["return"]),
            EVERYWHERE,
        ),
        {"dynamics": 1.0, "sensor": -1.0},
    ),
)
"""Claims about the split's data rather than about detectors, with the weight of either group."""

CLAIMS: Final = (
    *_models(),
    *_horizons(),
    *_components(),
    *_groups_of_anomalies(),
    *_alarms(),
)
"""All claims about detectors, in the order of the table."""
