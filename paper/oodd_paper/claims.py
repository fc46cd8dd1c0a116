"""The paper's claims, each as a number and a region in which it lies if the claim is true.

The 95 % interval alone decides a verdict: *negligible* where all of it is closer to 0 than matters,
then *confirmed* where all of it lies in the region, *refuted* where all of it lies outside, else
*undecided*. Each is put to the paper's measure and to one without its flaw, if there is one. Claims
that are settled by definition or by construction say so instead. ``claims.toml`` has them.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, get_args

from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.metrics.catalogue import NAMES, metric_info
from oodd_eval.names import check_known
from oodd_eval.prose import Table
from oodd_eval.results.render.tabular import csv_rows
from oodd_paper.estimates import Estimate, Estimator, Side, lost_return
from oodd_paper.experiments import read_tables
from oodd_paper.inputs import Other, Returns

NOT_RUN: Final = "not run"
RETURN: Final = "return"  # the measure of claims about the policies, not about detectors

Settled = Literal["by definition", "by construction"]
Verdict = Literal["confirmed", "negligible", "refuted", "undecided", "not run", Settled]
ORDER: Final[tuple[Verdict, ...]] = get_args(Verdict)


@dataclass(frozen=True, slots=True)
class Region:
    """The open interval of a true claim; a number within `negligible` of 0 makes no difference."""

    above: float = -math.inf
    below: float = math.inf
    negligible: float = 0.0

    def verdict(self, estimate: Estimate) -> Verdict:
        """Return the verdict on an estimate."""
        if math.isnan(estimate.low) or math.isnan(estimate.high):
            return "undecided" if estimate.environments else "not run"
        if -self.negligible < estimate.low and estimate.high < self.negligible:
            return "negligible"
        if self.above < estimate.low and estimate.high < self.below:
            return "confirmed"
        outside = estimate.high <= self.above or estimate.low >= self.below
        return "refuted" if outside else "undecided"

    def describe(self, metric: str) -> str:
        """Return the region as printed: ``"> 0"``, ``"between -0.02 and 0.02"``."""
        low, high = (f"{_scale(metric) * x:g}" for x in (self.above, self.below))
        if math.isinf(self.below):
            return f"> {low}"
        return f"< {high}" if math.isinf(self.above) else f"between {low} and {high}"


@dataclass(frozen=True, slots=True)
class Claim:
    """Something the paper says; the head of ``claims.toml`` says what the fields mean."""

    id: str
    text: str
    section: str
    number: str
    metric: str
    sides: tuple[Side, ...]
    region: Region
    fair: str = ""
    environments: tuple[str, ...] = tuple(ENVIRONMENTS)
    everywhere: bool = False
    offset: float = 0.0
    settled: Settled | None = None
    source: str = ""
    note: str = ""

    @classmethod
    def of(
        cls,
        *,
        metric: str,
        plus: Mapping[str, Any],
        minus: Mapping[str, Any] | None = None,
        **others: Any,
    ) -> "Claim":
        """Make a claim from a table of ``claims.toml``."""
        ends = {k: others.pop(k) for k in ("above", "below", "negligible") if k in others}
        sides = (Side.of(1.0, **plus), *([Side.of(-1.0, **minus)] if minus else []))
        environments = tuple(others.pop("environments", ENVIRONMENTS))
        check_known("environment", ENVIRONMENTS, *environments)
        check_known("metric", (*NAMES, RETURN), *filter(None, (metric, others.get("fair"))))
        if any(bool(side.settings) == (metric == RETURN) for side in sides):
            raise ValueError("expected settings on every side, unless the metric is 'return'")
        if (settled := others.get("settled")) not in (None, *get_args(Settled)):
            raise ValueError(f"settled is {settled!r}, expected {' or '.join(get_args(Settled))}")
        return cls(
            metric=metric, sides=sides, region=Region(**ends), environments=environments, **others
        )


CLAIMS: Final = read_tables(Path(__file__).with_name("claims.toml"), "claim", Claim.of)


@dataclass(frozen=True, slots=True)
class Judgement:
    """A verdict by one measure and its number, that of the least clear environment if of each."""

    metric: str
    estimate: Estimate
    verdict: Verdict
    by_environment: Mapping[str, Verdict] = field(default_factory=dict)


_WORST_FIRST: Final[tuple[Verdict, ...]] = ("refuted", "negligible", "undecided", "not run")
"""Verdicts on one environment that decide a claim about every one."""


class Ruling(NamedTuple):
    """A claim with its judgements: by the paper's measure and by the fair one, if there is one."""

    claim: Claim
    paper: Judgement
    fair: Judgement | None = None


def rulings(estimator: Estimator, returns: Returns | None) -> list[Ruling]:
    """Judge every claim; None for returns that were not read."""
    by_paper = [judge(c, c.metric, estimator, returns) for c in CLAIMS]
    by_fair = [judge(c, c.fair, estimator) if c.fair else None for c in CLAIMS]
    return list(map(Ruling, CLAIMS, by_paper, by_fair))


def judge(
    claim: Claim, metric: str, estimator: Estimator, returns: Returns | None = None
) -> Judgement:
    """Put a claim to one measure."""

    def verdict(estimate: Estimate) -> Verdict:
        return (
            claim.settled or claim.region.verdict(estimate) if estimate.environments else "not run"
        )

    def estimated(environments: Sequence[str]) -> Estimate:
        if metric == RETURN:
            estimate = lost_return(returns or {}, claim.sides, environments)
        else:
            estimate = estimator.combine(claim.sides, metric, environments)
        value, low, high = (x - claim.offset for x in estimate.ends)
        return replace(estimate, value=value, low=low, high=high)

    if not claim.everywhere:
        mean = estimated(claim.environments)
        partial = mean.partial and not claim.settled
        return Judgement(metric, mean, "undecided" if partial else verdict(mean))
    estimates = [estimated([e]) for e in claim.environments]
    said = [verdict(e) for e in estimates]
    by_environment = dict(zip(claim.environments, said, strict=True))
    run = [(v, e) for v, e in zip(said, estimates, strict=True) if e.environments]
    if not run:
        return Judgement(metric, Estimate(expected=len(said)), "not run", by_environment)
    # As good as the worst environment; one that was not run leaves the claim undecided.
    worst: Verdict = next((v for v in _WORST_FIRST if v in said), claim.settled or "confirmed")
    worst = "undecided" if worst == "not run" else worst
    decisive = [e for v, e in run if v == worst] or [e for _, e in run]
    number = min(decisive, key=lambda e: e.value)
    return Judgement(metric, number, worst, by_environment)


def summary(claims_judged: Sequence[Ruling]) -> str:
    """Return how many claims came to which verdict by either measure; settled ones apart."""

    def counted(judged: Sequence[Judgement], claims: str) -> str:
        count = Counter(j.verdict for j in judged)
        counts = ", ".join(f"{count[v]} {v}" for v in ORDER if count[v])
        return f"of {len(judged)}{claims} {counts}"

    open_ = [r for r in claims_judged if not r.claim.settled]
    by_paper = counted([r.paper for r in open_], " claims")
    by_fair = counted([r.fair for r in open_ if r.fair], "")
    text = f"By the paper's measures, {by_paper}; by matched AUC and censored delay, {by_fair}."
    if not (settled := len(claims_judged) - len(open_)):
        return text
    are = "is" if settled == 1 else "are"
    return f"{text} {settled} more {are} settled by definition or by construction and not counted."


def changed(claims_judged: Sequence[Ruling], other: Other) -> str:
    """Return in how many claims the verdict is another one than that of another reproduction."""
    counts = []
    for kind, judged in (
        ("paper", [r.paper for r in claims_judged]),
        ("fair", [r.fair for r in claims_judged]),
    ):
        pairs = [
            (j.verdict, other.claims[r.claim.id, kind]["verdict"])
            for r, j in zip(claims_judged, judged, strict=True)
            if j and not r.claim.settled and (r.claim.id, kind) in other.claims
        ]
        both = [pair for pair in pairs if NOT_RUN not in pair]
        counts.append(f"{sum(a != b for a, b in both)} of {len(both)}")
    return f"{counts[0]} by the paper's measures, {counts[1]} by the others"


def claims_table(claims_judged: Sequence[Ruling], other: Other | None = None) -> Table:
    """Return one row per claim, with the verdicts of another reproduction if there is one."""
    rows = []
    for r in claims_judged:
        c = r.claim
        row = {
            "Claim": f"{c.text} ({c.note})" if c.note else c.text,
            "By the paper's measure": _judgement_text(r.paper),
            "By matched AUC or censored delay": _judgement_text(r.fair) if r.fair else "",
        }
        if other:
            verdicts = [other.claims.get((c.id, kind), {}) for kind in ("paper", "fair")]
            row[f"On {other.name}"] = "; ".join(line["verdict"] for line in verdicts if line)
        row |= {
            "Number": c.number,
            "True if": c.region.describe(c.metric) + (f" ({c.source})" if c.source else ""),
            "Seeds": str(r.paper.estimate.seeds or ""),
            "Place in the paper": c.section,
        }
        rows.append(row)
    header = list(rows[0]) if rows else []
    return Table("Claims", header, [[*row.values()] for row in rows], labels=len(header))


def claims_csv(claims_judged: Sequence[Ruling]) -> str:
    """Return a line per claim and measure."""
    return csv_rows(
        [
            {
                "claim": r.claim.id,
                "text": r.claim.text,
                "place": r.claim.section,
                "number": r.claim.number,
                "metric": j.metric,
                "kind": kind,
                "region": r.claim.region.describe(r.claim.metric),
                **j.estimate.columns,
                "verdict": j.verdict,
                "by_environment": " ".join(
                    f"{e}={verdict}" for e, verdict in j.by_environment.items()
                ),
            }
            for r in claims_judged
            for kind, j in (("paper", r.paper), ("fair", r.fair))
            if j
        ]
    )


def _judgement_text(judged: Judgement) -> str:
    e = judged.estimate
    if e.state or not e.environments:
        return e.state or NOT_RUN
    # One digit more than in the tables: most numbers are differences. Adding 0 turns -0.0 to 0.0.
    digits = 3 if judged.metric == "far" else 2
    scale = _scale(judged.metric)
    value, low, high = (f"{round(scale * x, digits) + 0.0:.{digits}f}" for x in e.ends)
    title = RETURN if judged.metric == RETURN else metric_info(judged.metric).in_paper
    over = f"{e.environments} of {e.expected} environments" if e.partial else ""
    over = _named(judged.by_environment) if judged.by_environment else over
    return f"{judged.verdict}: {title} {value} [{low}, {high}]" + (f" ({over})" if over else "")


def _named(by: Mapping[str, Verdict]) -> str:
    """Return how many environments came to which verdict; those of one or two by name."""
    names = {v: [ENVIRONMENTS[e].title for e in by if by[e] == v] for v in ORDER}
    if len(set(by.values())) == 1:
        return f"in all {len(by)} environments"
    brief = {v: f": {', '.join(named)}" if len(named) <= 2 else "" for v, named in names.items()}
    return "; ".join(f"{len(names[v])} {v}{brief[v]}" for v in ORDER if names[v])


def _scale(metric: str) -> float:
    """Return the factor by which numbers are printed: AUCs in percent."""
    return 100.0 if metric != RETURN and metric_info(metric).unit == "percent" else 1.0
