"""The table of claims: number, interval and verdict, by the paper's measure and by a fair one."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.paper import returns
from oodd_eval.paper.claims import FAIR, Claim, Judged, Verdict, judge, ruled
from oodd_eval.paper.evidence import Evidence
from oodd_eval.paper.numbers import NOT_RUN
from oodd_eval.paper.paper_claims import CLAIMS, RETURNS
from oodd_eval.results.tables.csv_tables import number
from oodd_eval.results.tables.tables import TITLES, Table

ORDER: Final[tuple[Verdict, ...]] = ("confirmed", "refuted", "undecided", "not run")

RULE: Final = (
    "**Confirmed**: the whole 95 % interval lies in the region given; **refuted**: all of it lies "
    "outside, or a claimed advantage is within half a point of AUC (half a step of delay, 0.02 of "
    "a return) of none; **undecided**: neither, or environments are missing. A claim about every "
    "environment is as good as its worst environment, whose number is shown. Differences of AUC "
    "are in points. They are paired over test seeds and over the detector seeds that both sides "
    "have (*seeds*: how many; with one, the interval knows nothing of the spread between "
    "trainings). Of so many intervals, one in twenty may miss the truth by chance alone."
)


@dataclass(frozen=True, slots=True)
class Ruling:
    """A claim with its verdicts; `fair` is None where the paper's measure is the only one."""

    claim: Claim
    own: Judged
    fair: Judged | None = None


def rulings(evidence: Evidence, found: returns.Returns | None) -> list[Ruling]:
    """Judge every claim, those about returns first."""
    made = []
    for claim, weights in RETURNS:
        estimate = returns.loss(found or {}, claim.environments, weights)
        made.append(Ruling(claim, ruled(claim, claim.metric, estimate)))
    for claim in CLAIMS:
        own = judge(claim, claim.metric, evidence)
        fair = FAIR.get(claim.metric)
        made.append(Ruling(claim, own, judge(claim, fair, evidence) if fair else None))
    return made


def summary(made: Sequence[Ruling]) -> str:
    """Return how many claims came to which verdict, under either kind of measure."""
    own = Counter(r.own.verdict for r in made)
    fair = Counter(r.fair.verdict for r in made if r.fair)
    return (
        f"By the paper's measures, of {len(made)} claims "
        + ", ".join(f"{own[v]} {v}" for v in ORDER if own[v])
        + f"; by matched AUC and censored delay, of {sum(fair.values())} "
        + ", ".join(f"{fair[v]} {v}" for v in ORDER if fair[v])
        + "."
    )


def table(made: Sequence[Ruling]) -> Table:
    """Return one row per claim."""
    header = ["Claim", "By the paper's measure", "By matched AUC or censored delay", "Number",
              "True if", "Seeds", "Place in the paper"]  # fmt: skip
    rows = []
    for r in made:
        c = r.claim
        text = f"{c.text} ({c.note})" if c.note else c.text
        fair = _shown(r.fair) if r.fair else ""
        seeds = str(r.own.estimate.seeds or "")
        region = c.rule.describe(c.metric)
        rows.append([text, _shown(r.own), fair, c.number, region, seeds, c.place])
    return Table("Claims", header, rows, labels=len(header))


def csv_lines(made: Sequence[Ruling]) -> list[list[str]]:
    """Return a line per claim and measure, the header first."""
    lines = [["claim", "text", "place", "number", "metric", "kind", "region", "value", "low",
              "high", "environments", "seeds", "verdict", "by_environment"]]  # fmt: skip
    for r in made:
        for kind, judged in (("paper", r.own), ("fair", r.fair)):
            if judged is None:
                continue
            e, c = judged.estimate, r.claim
            by = " ".join(f"{name}={verdict}" for name, verdict in judged.by_environment)
            what = [c.id, c.text, c.place, c.number, judged.metric, kind, c.rule.describe(c.metric)]
            numbers = map(number, (e.value, e.low, e.high))
            lines.append([*what, *numbers, str(e.environments), str(e.seeds), judged.verdict, by])
    return lines


def _shown(judged: Judged) -> str:
    e = judged.estimate
    if e.state:
        return e.state
    if not e.environments:
        return NOT_RUN
    text = f"{judged.verdict}: {TITLES.get(judged.metric, judged.metric)} {_number(judged)}"
    if judged.by_environment:
        return f"{text} ({_by_environment(judged)})"
    return text + (f" ({e.environments} of {e.expected} environments)" if e.partial else "")


def _number(judged: Judged) -> str:
    """Return the number with one digit more than in the tables: it is a difference, mostly."""
    e = judged.estimate
    unit = 100.0 if judged.metric.startswith("auc") else 1.0
    digits = 3 if judged.metric == "far" else 2
    # Adding zero turns -0.0 into 0.0.
    value, low, high = (
        f"{round(unit * x, digits) + 0.0:.{digits}f}" for x in (e.value, e.low, e.high)
    )
    return f"{value} [{low}, {high}]"


def _by_environment(judged: Judged) -> str:
    """Return how many environments came to which verdict; those of one or two by name."""
    names: dict[Verdict, list[str]] = {}
    for environment, verdict in judged.by_environment:
        names.setdefault(verdict, []).append(ENVIRONMENTS[environment].title)
    if len(names) == 1:
        return f"in all {len(judged.by_environment)} environments"
    return "; ".join(
        f"{len(names[v])} {v}" + (f": {', '.join(names[v])}" if len(names[v]) <= 2 else "")
        for v in ORDER
        if v in names
    )
