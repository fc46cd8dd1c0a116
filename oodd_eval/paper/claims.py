"""The paper's claims, each as a number and a region in which it lies if the claim is true.

A verdict is a matter of the 95 % interval alone: *confirmed* where all of it lies in the region,
*refuted* where all of it lies outside (or where a claimed advantage is smaller than matters),
*undecided* otherwise. Each claim is put to the paper's own measure and, where there is one, to a
measure without its flaw: matched AUC for AUC, censored delay for delay.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

from oodd_eval.paper.evidence import Estimate, Evidence, Term
from oodd_eval.paper.experiments import Setup

Verdict = Literal["confirmed", "refuted", "undecided", "not run"]

FAIR: Final = {"auc": "auc_matched", "delay": "delay_censored"}
"""For the paper's measures, those without their flaw."""

SMALL: Final = {"auc": 0.005, "delay": 0.5, "far": 0.005, "return": 0.02}
"""A difference within this, either way, is no advantage: half a point of AUC, half a step."""


@dataclass(frozen=True, slots=True)
class Rule:
    """The open region in which the number lies if the claim is true.

    Attributes
    ----------
    low, high
        Its ends, infinite where it has none.
    small
        Half-width of what is no advantage; 0 where that does not apply.
    """

    low: float = -math.inf
    high: float = math.inf
    small: float = 0.0

    def __call__(self, estimate: Estimate) -> Verdict:
        """Return the verdict on an estimate.

        Examples
        --------
        >>> above = Rule(low=0.0, small=0.005)
        >>> above(Estimate(0.03, 0.01, 0.05, 7, 7)), above(Estimate(0.0, -0.004, 0.004, 7, 7))
        ('confirmed', 'refuted')
        """
        if math.isnan(estimate.low) or math.isnan(estimate.high):
            return "not run" if not estimate.environments else "undecided"
        if self.low < estimate.low and estimate.high < self.high:
            return "confirmed"
        outside = estimate.high <= self.low or estimate.low >= self.high
        negligible = -self.small < estimate.low and estimate.high < self.small
        return "refuted" if outside or negligible else "undecided"

    def describe(self, metric: str) -> str:
        """Return the region as printed: ``"> 0"``, ``"between -0.02 and 0.02"``."""
        unit = 100.0 if metric == "auc" else 1.0
        low, high = (f"{unit * x:g}" for x in (self.low, self.high))
        if math.isinf(self.high):
            return f"> {low}"
        return f"< {high}" if math.isinf(self.low) else f"between {low} and {high}"


@dataclass(frozen=True, slots=True)
class Part:
    """One side of a claim: a mean over setups and anomalies, with a weight.

    The weight is that of the side; it is shared among several setups.
    """

    weight: float
    setups: tuple[Setup, ...]
    anomalies: tuple[str, ...]
    metric: str = ""


@dataclass(frozen=True, slots=True)
class Claim:
    """Something the paper says.

    Attributes
    ----------
    id
        Short and stable.
    text
        The claim, in our words, with the setups it is about.
    place
        Where the paper says it.
    number
        What is estimated, in words.
    metric
        The paper's measure: ``"auc"``, ``"delay"``, ``"far"`` or ``"return"``.
    parts
        Whose weighted sum the number is.
    rule
        When it is true.
    environments
        Over which it is a mean, or in each of which it has to hold.
    everywhere
        Whether it is claimed of every environment rather than of their mean.
    offset
        Subtracted from the sum.
    """

    id: str
    text: str
    place: str
    number: str
    metric: str
    parts: tuple[Part, ...]
    rule: Rule
    environments: tuple[str, ...]
    everywhere: bool = False
    offset: float = 0.0
    note: str = ""

    @property
    def setups(self) -> list[Setup]:
        """Every setup once."""
        return list(dict.fromkeys(s for part in self.parts for s in part.setups))


@dataclass(frozen=True, slots=True)
class Judged:
    """A verdict with the number it is about; for a claim about every environment, the least clear.

    Attributes
    ----------
    metric
        Measure it was put to.
    by_environment
        Verdict in each environment, for a claim about every one of them.
    """

    metric: str
    estimate: Estimate
    verdict: Verdict
    by_environment: tuple[tuple[str, Verdict], ...] = ()


def judge(claim: Claim, metric: str, evidence: Evidence) -> Judged:
    """Put a claim to one measure."""
    terms = [
        Term(part.weight / len(part.setups), setup, part.anomalies, part.metric or metric)
        for part in claim.parts
        for setup in part.setups
    ]
    if claim.everywhere:
        found = [
            (environment, _shifted(evidence.combine(terms, [environment]), claim.offset))
            for environment in claim.environments
        ]
        return everywhere(claim, metric, found)
    return ruled(claim, metric, _shifted(evidence.combine(terms, claim.environments), claim.offset))


def ruled(claim: Claim, metric: str, estimate: Estimate) -> Judged:
    """Return the verdict on a claim about a mean; open where environments are missing from it."""
    verdict = "undecided" if estimate.partial else claim.rule(estimate)
    return Judged(metric, estimate, verdict)


def everywhere(claim: Claim, metric: str, found: Sequence[tuple[str, Estimate]]) -> Judged:
    """Return the verdict on a claim about every environment: the weakest of the environments'."""
    verdicts = tuple((environment, claim.rule(estimate)) for environment, estimate in found)
    said = [verdict for _, verdict in verdicts if verdict != "not run"]
    run = [(claim.rule(e), e) for _, e in found if e.environments]
    if not run:
        return Judged(metric, Estimate(expected=len(found)), "not run", verdicts)
    if "refuted" in said:
        verdict: Verdict = "refuted"
    elif len(said) < len(found) or "undecided" in said:
        verdict = "undecided"
    else:
        verdict = "confirmed"
    worst = min((e for v, e in run if v == verdict), key=lambda e: e.value, default=run[0][1])
    return Judged(metric, worst, verdict, verdicts)


def _shifted(estimate: Estimate, offset: float) -> Estimate:
    if not offset:
        return estimate
    return Estimate(
        estimate.value - offset, estimate.low - offset, estimate.high - offset,
        estimate.environments, estimate.expected, estimate.seeds, estimate.state,
    )  # fmt: skip
