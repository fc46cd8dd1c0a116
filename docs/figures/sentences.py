"""Numbers in sentences of README.md and pages of results, and the results that decide them."""

import functools
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final

import numpy as np
from committed import (
    SEASON,
    board,
    claims,
    logs,
    mean,
    of_reproductions,
    overview,
    primary,
    rollouts,
)

from oodd_eval.data.facts import ENVIRONMENTS, WORLDS
from oodd_eval.results.board import Column
from oodd_eval.results.identity import Setting

ROBOTS: Final = [name for name, info in ENVIRONMENTS.items() if not info.discrete]
CLASSIC: Final = [name for name in ENVIRONMENTS if name not in ROBOTS]

# Claims of the paper


def counted(split: str) -> dict[str, str]:
    """Return the verdicts by the paper's measures that data decide, by claim."""
    settled = {"by definition", "by construction"}
    rows = {c: r["verdict"] for (c, kind), r in claims(split).items() if kind == "paper"}
    return {claim: verdict for claim, verdict in rows.items() if verdict not in settled}


def run_there(split: str) -> list[int]:
    """Return how many claims a reproduction gives verdicts on, and of how many."""
    verdicts = counted(split)
    return [sum(verdict != "not run" for verdict in verdicts.values()), len(verdicts)]


def of_claims(*verdicts: str) -> list[int]:
    """Return how many claims there are, and how many have each of these verdicts on mini."""
    counts = Counter(r["verdict"] for (_, kind), r in claims("mini").items() if kind == "paper")
    return [counts.total(), *(counts[verdict] for verdict in verdicts)]


DIFFERENT_ON_STANDARD: Final = {"delay-riqn-npn", "delay-riqn-rf", "memory-1-7"}
"""Claims that the page names, as their verdict differs on standard."""


def claims_that_differ() -> set[str]:
    """Return the claims whose verdict on standard is another than on mini."""
    mini = counted("mini")
    return {c for c, v in counted("standard").items() if v not in ("not run", mini[c])}


def reversed_at_equal_losses() -> list[str]:
    """Return claims whose verdict at equal losses is the reverse of that at Table 1's strengths."""
    mini, same = counted("mini"), counted("mini-paper")
    return [c for c in mini if {mini[c], same[c]} == {"confirmed", "refuted"}]


# Sentences: a phrase of the page with the numbers that it has to have


def points(
    claim: str,
    kind: str = "paper",
    factor: int = 100,
    split: str = "reduced-paper",
    ends: Iterable[str] = ("value",),
    digits: int = 1,
) -> list[str]:
    """Return figures of a claim, such as its value and the ends of its interval."""
    row = claims(split)[claim, kind]
    return [f"{factor * float(row[end]):.{digits}f}" for end in ends]


def of_all_models() -> tuple[list[float], list[float]]:
    """Return AUC of all models by group: the paper's, at Table 1's strengths, at equal losses."""
    cells = [float(c) for c in of_reproductions("mini", "mini-paper")("AVG").split(" | ")]
    return cells[:3], cells[3:]


def level() -> list[str]:
    """Return by how many points AUC at equal losses is above that at Table 1's strengths."""
    return [f"{group[2] - group[1]:.0f}" for group in of_all_models()]


def between_groups() -> list[str]:
    """Return by how many points the paper's AUC of sensor anomalies is the higher one."""
    sensor, dynamics = of_all_models()
    return [f"{sensor[0] - dynamics[0]:.0f}"]


def differing() -> list[int]:
    """Return how many verdicts differ at equal losses, and of how many."""
    mini, same = counted("mini"), counted("mini-paper")
    return [sum(mini[c] != same[c] for c in same), len(same)]


def gains(
    horizon: int, environments: Iterable[str], names: Iterable[str], sign: int = 1
) -> Iterator[str]:
    """Yield by how many points matched AUC grows from Δ = 1 to a horizon, row by row."""
    auc = "auc_matched"
    for name in names:
        one, other = (mean("horizons", Setting(name, h), auc, environments=environments)
                      for h in (1, horizon))  # fmt: skip
        yield f"{sign * (other - one):.1f}"


def in_worlds(
    name: str, metric: str = "found_within_100_at_5pct"
) -> dict[tuple[str, str, str], float]:
    """Return a row's metric by environment, kind and strength, mean over its seeds."""
    cells: dict[tuple[str, str, str], list[float]] = {}
    for r in board("worlds").records:
        if str(r.setting) == name:
            cells.setdefault((r.environment, r.anomaly, r.strength), []).append(r.value(metric))
    return {cell: np.mean(values) for cell, values in cells.items()}


def hidden(*names: str) -> list[int]:
    """Return how many cells are at +1 and +5 % loss, all, and in how many each row finds half."""
    cells = [in_worlds(name) for name in names]
    weak = [[x for c, x in by.items() if c[2] in ("loss1", "loss5")] for by in cells]
    return [len(weak[0]), len(cells[0]), *(sum(x >= 0.5 for x in shares) for shares in weak)]


def lost_thrust(name: str, strength: str) -> list[str]:
    """Return matched AUC of a row in the drone's lost thrust, and the share found, in per cent."""
    cell = ("drone", "rotor-loss", strength)
    return [f"{100 * in_worlds(name, m)[cell]:.0f}"
            for m in ("auc_matched", "found_within_100_at_5pct")]  # fmt: skip


def apart(split: str, one: str, other: str, environments: Iterable[str] = ()) -> str:
    """Return by how many points a row's matched AUC is above another's."""
    rows = [mean(split, row, "auc_matched", environments=environments) for row in (one, other)]
    return f"{rows[0] - rows[1]:.1f}"


def lost_to_noise(row: str, *environments: str) -> str:
    """Return by how many points 5 % of noise lowers a row's matched AUC."""
    without, noisy = (mean(suite, row, "auc_matched", environments=environments)
                      for suite in ("mini", "noisy-5"))  # fmt: skip
    return f"{without - noisy:.1f}"


def false_under_noise() -> Iterator[str]:
    """Yield false episodes with 1 and 5 % of noise in per cent, mean over rows run everywhere."""
    for suite in ("noisy-1", "noisy-5"):
        whole = board(suite)
        shares = [mean(suite, row, "false_episodes_at_5pct") for row in whole.entries
                  if {r.environment for r in whole.records if r.setting == row} == {*ENVIRONMENTS}
                  ]  # fmt: skip
        yield f"{np.mean(shares):.1f}"


def beyond_ladder(one: str, other: str) -> list[str]:
    """Return of how many pairs a row finds the weakest rung, all pairs, and both rows' misses."""
    _, _, pairs, below, above, *_ = overview("ladder-noisy-1", one)
    return [below, pairs, above, overview("ladder-noisy-1", other)[4]]


RIVALS = ("logpzo", "rpt-a", "wm-kl-a", "deedee", "paano", "knn", "pca", "rnd")
STEPS = ("rf", "riqn-r", "riqn-ms", "npn")
ENDS = ("value", "low", "high")
EASIER = "sensor-above-dynamics-models"


def false_among_successes(row: str) -> list[int]:
    """Return how many successful test rollouts a row alarms in at 10 %, and of how many."""
    board = rollouts()["pi0-failures"]
    (cell, *_) = (r for r in board.records if r.detector == row)
    count = cell.counts["nominal"]
    return [round(count * cell.value("false_episodes_at_10pct")), count]


def test_rollouts() -> list[int]:
    """Return the numbers of successful and of failed test rollouts within tasks."""
    counts = rollouts()["pi0-failures"].records[0].counts
    return [counts["nominal"], counts["test"]]


SENTENCES: list[tuple[str, Callable[[], Iterable[Any]]]] = [
    ("`rf` gains {} points of matched AUC there, `riqn-r` {}, `riqn-ms` {} and `npn` {}.",
     lambda: gains(10, ROBOTS, STEPS)),
    ("`panel-a` falls by {} points and `panel` by {}.",
     lambda: gains(20, (), ("panel-a", "panel"), -1)),
    ("they lose {}, {}, {} and {}.",
     lambda: gains(10, CLASSIC, STEPS, -1)),
    ("falls by {} points from Δ = 1 to 20, `riqn` by {} and `riqn-ms` by {}.",
     lambda: gains(20, (), ("n-riqn", "riqn", "riqn-ms"), -1)),
    ("by {} [{}, {}] points, and by {} [{}, {}] of matched AUC",
     lambda: [*points(EASIER, ends=ENDS), *points(EASIER, "fair", ends=ENDS)]),
    ("by {} points of AUC and {} of matched AUC",
     lambda: [*points("riqn-above-npn-1", "paper", -100),
              *points("riqn-above-npn-1", "fair", -100)]),
    ("longer than NPN's by {} steps, where they are shorter by {} on `mini`.",
     lambda: [*points("delay-riqn-npn", factor=-1, split="standard"),
              *points("delay-riqn-npn", factor=1, split="mini")]),
    ("longer than RF's by {} steps",
     lambda: points("delay-riqn-rf", factor=-1, split="standard")),
    ("Of {} claims, by the paper's measures, {} are confirmed, {} refuted, {} undecided",
     lambda: of_claims("confirmed", "refuted", "undecided")),
    ("{} negligible, {} by construction and {} by definition.",
     lambda: of_claims("negligible", "by construction", "by definition")[1:]),
    ("[{} of {}](../../leaderboard/reproduction/standard/README.md)",
     lambda: run_there("standard")),
    ("for {} of {} claims [on `reduced-paper`]",
     lambda: run_there("reduced-paper")),
    ("{} of {} verdicts differ", differing),
    ("AUCs are {} points higher for sensor anomalies and {} for dynamics anomalies",
     level),
    ("In the paper they are, by {} points of AUC.", between_groups),
    ("Delays grow by {} steps instead of 10.",
     lambda: points("delay-grows-10", factor=1, digits=0)),
    ("RIQN by {} points", lambda: points("riqn-above-riqn-ms-10", factor=-100)),
    ("N-RIQN by {} points; at Δ = 1", lambda: points("memory-10-7")),
    ("{} of {} cells are `loss1` and `loss5`.", lambda: hidden("oracle")[:2]),
    (("episodes are found by `oracle` in {} of them, by `arcade-a` in {}, by `panel-a` in {}, by "
      "`mewma-a` in {} and by `pe-a` in {}."),
     lambda: hidden("oracle", "arcade-a", "panel-a", "mewma-a", "pe-a")[2:]),
    ("It is {} points above `panel-a`, which fits",
     lambda: [apart("worlds", "arcade-a", "panel-a")]),
    ("Both are above all other detectors, `panel-a` by {} points.",
     lambda: [apart("worlds", "panel-a", "mewma-a")]),
    ("`panel-a` has {} points more there than `panel`, and as many in the drone.",
     lambda: [apart("worlds", "panel-a", "panel", environments=["tank"])]),
    ("without memory, is {} points below `pe-a`",
     lambda: [apart("worlds", "pe-a", "pe-step-a")]),
    ("matched AUC of {} and finds {} % of the episodes; `pe-a` has {} at `loss25` and finds {} %.",
     lambda: [*lost_thrust("mewma-a", "loss10"), *lost_thrust("pe-a", "loss25")]),
    ("`pe-a` is then {} points above `mewma-a`, after {} without noise.",
     lambda: [apart(suite, "pe-a", "mewma-a") for suite in ("noisy-5", "mini")]),
    ("falls by {} points there and by {}. On Ant it falls by {}.",
     lambda: [lost_to_noise("pe-a", where) for where in ("lunarlander", "acrobot", "ant")]),
    ("With 5 % it is {} points behind and", lambda: [apart("noisy-5", "pe-a", "panel-a")]),
    ("From no noise to 5 % it falls by {} points, `pe-a` by {}.",
     lambda: [lost_to_noise(row) for row in ("arcade-a", "pe-a")]),
    ("false episodes are {} % with 1 % of noise and {} % with 5 %.", false_under_noise),
    (("`pe-a` finds the weakest rung in {} of the {} pairs, and not the strongest in {}; `riqn` "
      "misses the strongest in {}."),
     lambda: beyond_ladder("pe-a", "riqn")),
    ("with `column:chunk_mse`, {} of the {} successful test episodes where 10 % were promised",
     lambda: false_among_successes("column:chunk_mse")),
    ("test parts of {} successful and {} failed episodes.", test_rollouts),
    ("with the true equations, is {} points above",
     lambda: [apart(SEASON, "oracle", "panel-a", environments=["arm"])]),
]  # fmt: skip
"""Phrases of the page with the numbers that they have to have."""


# Orders: a phrase of the page, and whether the results are so


def above(first: str, others: str, metric: str = "auc_matched", split: str = SEASON) -> bool:
    """Tell whether every row of some has more of a metric than every row of others."""
    ours, theirs = ([mean(split, row, metric) for row in names.split(",")]
                    for names in (first, others))  # fmt: skip
    return min(ours) > max(theirs)


def leads() -> bool:
    """Tell whether no ranked row but those of ensemble and panel is above these."""
    ours = ("panel-a", "pe-a")
    names = {row.detector for row in board(SEASON).entries} - {*ours, "oracle", "oracle-gym"}
    return all(above(",".join(ours), name) for name in names)


def by_environment(row: str) -> dict[str, float]:
    """Return a row's matched AUC by environment of the season."""
    return {e: mean(SEASON, row, "auc_matched", environments=[e])
            for e in board(SEASON).environments}  # fmt: skip


def worlds_are_hardest() -> bool:
    """Tell whether worlds are the hardest for `pe-a`, and `arcade-a` leads in each of them."""
    ours = by_environment("pe-a")
    rows = {row.detector for row in board(SEASON).entries} - {"arcade-a", "oracle", "oracle-gym"}
    best = {e: max(by_environment(row)[e] for row in rows) for e in WORLDS}
    return max(ours[e] for e in WORLDS) < min(ours[e] for e in ENVIRONMENTS) and all(
        by_environment("arcade-a")[e] > best[e] for e in WORLDS
    )


def lead_logs(*names: str) -> bool:
    """Tell whether rows have the highest means over the sets of logs with something to find."""
    means: dict[str, list[float]] = {}
    for of in logs().values():
        over = of.environments, of.anomalies, of.ranking
        for row in of.entries:
            means.setdefault(str(row), []).append(of.mean(row, *over).value)
    whole = {row: np.nanmean(v) for row, v in means.items() if len(v) == len(logs())}
    return {*sorted(whole, key=whole.__getitem__)[-len(names) :]} == {*names}


def promise_holds(split: str) -> bool:
    """Tell whether no row's false episodes are above the promised 5 % by all of its interval."""
    rows, column = board(split), Column("false_episodes_at_5pct", intervals=True)
    names = {row.detector for row in rows.entries}
    return all(rows.of(primary(rows, name), column).low <= 0.05 for name in names)


ORDERS: list[tuple[str, Callable[[], bool]]] = [
    ("asks it beside simpler members, are above all others.", leads),
    ("it is above every network of the paper.",
     lambda: above("mewma-a", "riqn-5,riqn,riqn-ms,n-riqn,npn")),
    ("the forest `rf` with one moving average, is above `rf`,", lambda: above("rf-ewma", "rf")),
    ("and finds less within 20 steps.",
     lambda: above("rf", "rf-ewma", "found_within_20_at_5pct")),
    ("So is `mewma`, without the actions, and so",
     lambda: above("mewma", "riqn-5,riqn,riqn-ms,n-riqn,npn")),
    ("No row of the paper is above `manifold`,",
     lambda: above("manifold", "riqn-5,riqn-ms-5,riqn,riqn-ms,n-riqn,npn,rf")),
    ("the best of the [rows that know no dynamics](../detectors/trivial/README.md).",
     lambda: above("manifold", "mahalanobis,range,persistence,random,clock,comb")),
    ("arm and the tank less than a point above `panel-a`.",
     lambda: all(0 < by_environment("arcade-a")[e] - by_environment("panel-a")[e] < 1
                 for e in ("arm", "tank"))),
    ("linear in polynomials, which came as a wheel and is in no package here.",
     lambda: above("edmd-a", "riqn-5,riqn,riqn-ms,n-riqn,npn")),
    ("`pe-a` is above `pe`, `panel-a` above `panel` and `mewma-a` above `mewma`.",
     lambda: all(above(f"{name}-a", name) for name in ("pe", "panel", "mewma"))),
    ("but its matched AUC is lower.",
     lambda: above("logpzo", "logpzo-a")
     and above("logpzo-a", "logpzo", "found_within_20_at_5pct")),
    ("`pe-a` loses most there,", worlds_are_hardest),
    ("and finds more within 20 steps than `riqn-5`.",
     lambda: above("range", "riqn-5", "found_within_20_at_5pct")),
    ("has a higher matched AUC than `riqn-5`.", lambda: above("knn", "riqn-5")),
    ("The arm is the hardest for `panel-a` and `pe-a`.",
     lambda: all(min(aucs, key=aucs.get) == "arm"
                 for aucs in map(by_environment, ("panel-a", "pe-a")))),
    ("(../leaderboard/README.md#reported-on-standard-protocol-3), and holds there.",
     lambda: promise_holds("standard")),
    ("they have the highest means, and [no row leads everywhere](public-logs.md)",
     lambda: lead_logs("knn", "rf-ewma", "panel")),
    ("None comes within five points of `pe-a`.",
     lambda: all(float(apart("mini", "pe-a", row)) > 5 for row in RIVALS)),
]  # fmt: skip
"""Phrases of the page on orders of rows, and whether the results are so."""


NUMBER = re.compile(
    r"(?<![\w.,/-])[-\N{MINUS SIGN}+~]?(?:\d+(?:\.\d+)?|\.\d+)(?![\w]|[.,/-]\d|-[a-z])"
)
SETTINGS = (
    r"Δ = \d+(?:(?:,| and| or) \d+)*",
    r"\d+(?: and \d+)? (?:training|calibration|test|cells|kinds|networks|pairs)\b",
    r"(?:[Aa]t|of|to|than|most) (?:10|5|1|0\.5) %",  # levels of guaranteed alarms
    r"[Ww]ith [15] % of noise|spread's 1 or 5 %|\([A-Z][a-z]+(?: et al\.)? \d{4}\)",
    r"within (?:20|100) (?:control )?(?:steps|rows)|most 300 (?:steps|transitions)",
    r"(?:[Pp]rotocol|Tables?|Fern) \d+(?: (?:to|and) \d+)?|Python 3\.11",
    r"50 % is chance|longer after 150 steps|first 60 rows|1, 5, 10, 25 and 100 %",
    r"10 test episodes each|where (?:5|10) % were promised|let the loss grow by 25 %|Alarms at 5 %",
    r"600 times cheaper",  # says another paper
    r"(?:CoRL|RSS|NeurIPS) \d{4}|arXiv \d{4}\.\d{5}|tasks: 0, 2, 5 and 8|95 % interval",
)
"""What the reader is told of the settings and by others, which no result decides."""

FILLED = re.compile(r"<!-- table: [a-z0-9 -]+ -->\n((?:\|[^\n]*\n)+)(?:\n\*Records of [^\n]*\*)?")


def prose(section: str) -> str:
    """Return text without code, comments, addresses, and tables that are filled."""
    text = re.sub(r"(?ms)^```.*?^```", "", FILLED.sub("", section))
    for pattern, instead in (("<!--.*?-->", ""), (r"\]\([^)]*\)", "]"), ("`[^`]*`", "`x`")):
        text = re.sub(pattern, instead, text)
    return " ".join(text.split())


@functools.cache
def stated() -> list[str]:
    """Return the phrases of `SENTENCES` with their numbers."""
    return [phrase.format(*numbers()) for phrase, numbers in SENTENCES]


def filled(page: str) -> str:
    """Return a page whose sentences have the numbers of committed results; words stay."""
    for phrase, numbers in SENTENCES:
        texts = [r"\s+".join(map(re.escape, part.split(" "))) for part in phrase.split("{}")]
        between = [*map(str, numbers()), ""]
        page = re.sub(
            "(" + r")-?\d[\d.]*(".join(texts) + ")",
            lambda match, between=between: "".join(
                text + number for text, number in zip(match.groups(), between, strict=True)
            ),
            page,
        )
    return page


def unsourced(section: str) -> Iterator[str]:
    """Yield numbers that are in no filled table and in no checked sentence, with words around."""
    rows = [line for table in FILLED.findall(section) for line in table.splitlines()[2:]]
    texts = " ".join(line[1:].partition("|")[2] for line in rows)
    cells = [float(number.lstrip("~")) for number in NUMBER.findall(texts)]
    text = prose(section)
    for phrase in stated():
        text = text.replace(prose(phrase), "")
    text = re.sub("|".join(SETTINGS), " ", text)
    for match in NUMBER.finditer(text):
        number = match[0].lstrip("~+").replace("\N{MINUS SIGN}", "-")
        half = 0.5 * 10.0 ** -len(number.partition(".")[2]) + 1e-9
        if not any(abs(float(number) - cell) <= half for cell in cells):
            yield text[max(0, match.start() - 40) : match.end() + 30]


def problems(texts: Iterable[str]) -> Iterator[str]:
    """Yield a line for each sentence of the pages that committed results do not give.

    Parameters
    ----------
    texts
        Markdown of the pages.
    """
    texts = [*texts]
    words = " ".join(" ".join(texts).split())
    for phrase in stated():
        if phrase not in words:
            yield f"no page has the sentence of committed results: {phrase}"
    for phrase, holds in ORDERS:
        if phrase not in words:
            yield f"no page has the phrase on an order: {phrase}"
        elif not holds():
            yield f"the results are not so: {phrase}"
    for section in (s for text in texts for s in re.split(r"(?m)^(?=## )", text)):
        for number in unsourced(section):
            title = section.splitlines()[0].strip("# ")
            yield f"{title}: a number is in no filled table and no checked sentence: {number}"
    if (named := claims_that_differ()) != DIFFERENT_ON_STANDARD:
        yield f"claims that differ on standard: the page names others than {sorted(named)}"
    if len(reverse := reversed_at_equal_losses()) != 1:
        yield f"one verdict is reversed at equal losses by the page, by the results {reverse}"
