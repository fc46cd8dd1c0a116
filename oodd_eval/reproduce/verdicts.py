"""The table of claims: number, interval and verdict, by the paper's measure and by a fair one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from oodd_eval.benchmark import ENVIRONMENTS
from oodd_eval.report.tables import TITLES, Table
from oodd_eval.reproduce import returns
from oodd_eval.reproduce.claims import FAIR, Claim, Judged, Verdict, judge
from oodd_eval.reproduce.evidence import Evidence
from oodd_eval.reproduce.numbers import NOT_RUN, show
from oodd_eval.reproduce.paper_claims import CLAIMS, RETURNS

RULE = (
    "**Confirmed**: the whole 95 % interval lies in the region given; **refuted**: all of it lies "
    "outside, or a claimed advantage is within half a point of AUC (half a step of delay, 0.02 of "
    "a return) of none; **undecided**: neither. A claim about every environment is as good as its "
    "worst environment, whose number is shown. Differences are paired over test seeds and over "
    "the detector seeds that both sides have; with so many claims, one in twenty intervals that "
    "should hold nothing will seem to."
)


@dataclass(frozen=True, slots=True)
class Ruling:
    """A claim with its verdicts; `fair` is None where the paper's measure is the only one."""

    claim: Claim
    own: Judged
    fair: Judged | None = None


def rulings(evidence: Evidence, found: returns.Returns | None) -> list[Ruling]:
    """Judge every claim, the one about returns first."""
    made = []
    estimate = returns.difference_of_groups(found or {}, RETURNS.environments)
    made.append(Ruling(RETURNS, Judged("return", estimate, RETURNS.rule(estimate))))
    for claim in CLAIMS:
        own = judge(claim, claim.metric, evidence)
        fair = FAIR.get(claim.metric)
        made.append(Ruling(claim, own, judge(claim, fair, evidence) if fair else None))
    return made


def summary(made: Sequence[Ruling]) -> str:
    """Return how many claims came to which verdict, under either kind of measure."""
    order: tuple[Verdict, ...] = ("confirmed", "refuted", "undecided", "not run")
    own = Counter(r.own.verdict for r in made)
    fair = Counter(r.fair.verdict for r in made if r.fair)
    return (
        f"By the paper's measures, of {len(made)} claims "
        + ", ".join(f"{own[v]} {v}" for v in order if own[v])
        + f"; by matched AUC and censored delay, of {sum(fair.values())} "
        + ", ".join(f"{fair[v]} {v}" for v in order if fair[v])
        + "."
    )


def table(made: Sequence[Ruling]) -> Table:
    """Return one row per claim."""
    header = ["Claim", "Place in the paper", "Number", "True if",
              "Paper's measure", "Verdict", "Fair measure", "Verdict"]  # fmt: skip
    rows = []
    for r in made:
        c = r.claim
        text = f"{c.text} ({c.note})" if c.note else c.text
        row = [text, c.place, c.number, c.rule.describe(c.metric), *_shown(r.own)]
        rows.append([*row, *(_shown(r.fair) if r.fair else ["", ""])])
    return Table("Claims", header, rows, labels=4)


def csv_lines(made: Sequence[Ruling]) -> list[list[str]]:
    """Return a line per claim and measure, the header first."""
    lines = [["claim", "place", "number", "metric", "kind", "region", "value", "low", "high",
              "environments", "seeds", "verdict", "by_environment"]]  # fmt: skip
    for r in made:
        for kind, judged in (("paper", r.own), ("fair", r.fair)):
            if judged is None:
                continue
            e, c = judged.estimate, r.claim
            numbers = [repr(x) if x == x else "" for x in (e.value, e.low, e.high)]  # noqa: PLR0124
            by = " ".join(f"{name}={verdict}" for name, verdict in judged.by_environment)
            what = [c.id, c.place, c.number, judged.metric, kind, c.rule.describe(c.metric)]
            lines.append([*what, *numbers, str(e.environments), str(e.seeds), judged.verdict, by])
    return lines


def _shown(judged: Judged) -> list[str]:
    if judged.metric == "return":
        e = judged.estimate
        text = f"{e.value:.2f} [{e.low:.2f}, {e.high:.2f}]" if e.environments else NOT_RUN
        return [text, judged.verdict]
    text = f"{TITLES[judged.metric]} {show(judged.estimate, judged.metric)}"
    if judged.estimate.state or not judged.estimate.environments:
        text = show(judged.estimate, judged.metric)
    if judged.by_environment and judged.verdict != "not run":
        counted = Counter(verdict for _, verdict in judged.by_environment)
        verdict = f"{judged.verdict} ({counted[judged.verdict]} of {len(judged.by_environment)}"
        where = [
            ENVIRONMENTS[e].title for e, v in judged.by_environment if v == judged.verdict
        ]  # fmt: skip
        few = f": {', '.join(where)}" if len(where) <= 2 else ""
        return [text, verdict + few + ")"]
    return [text, judged.verdict]
