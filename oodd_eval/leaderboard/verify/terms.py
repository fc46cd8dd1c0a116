"""Rules that the terms of a record's metrics obey, whatever the scores: no scores break them."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.metrics import catalogue
from oodd_eval.metrics.auc import Contribution
from oodd_eval.metrics.catalogue import FOUND_WITHIN, GUARANTEED, LEVELS, METRICS

Sums = Mapping[str, Contribution]  # numerators and denominators of a record by metric

Mask = NDArray[np.bool_]  # trajectories in which something is wrong

Wrong = Iterator[tuple[str, Mask, str]]
"""Metrics, the trajectories in which they are wrong, and what is expected instead."""

_RATES: Final = {"far", "far_twin"}
_MEANS: Final = {*METRICS, *GUARANTEED, *catalogue.ATTRIBUTION} - _RATES
_AUCS: Final = {name for name in METRICS if name.startswith("auc")}
_SHARES: Final = {
    name
    for name in _MEANS
    if name.startswith(("missed", "early", "found", "false_episodes", "sensor_named"))
}
_STEPS: Final = _MEANS - _AUCS - _SHARES

_TERMS: Final[tuple[tuple[set[str], Callable[[Any, Any], Mask], str], ...]] = (
    (_RATES, lambda _, n: (n < 0) | (n % 1 != 0), "a whole number of steps as denominator"),
    (_RATES, lambda k, n: (k < 0) | (k > n) | (k % 1 != 0), "a whole number of alarms in them"),
    (_MEANS, lambda _, n: (n != 0) & (n != 1), "the denominator 0 or 1"),
    (_MEANS, lambda k, n: (n == 0) & (k != 0), "the numerator 0 where the denominator is 0"),
    (_AUCS, lambda k, _: (k < 0) | (k > 1), "an AUC within [0, 1]"),
    (_SHARES, lambda k, _: (k != 0) & (k != 1), "the numerator 0 or 1"),
    (_STEPS, lambda k, _: (k < 0) | (k % 1 != 0), "a whole number of steps"),
)
"""Metrics, their impossible numerators and denominators, and what is expected instead."""


def delays_of(own: Sums) -> list[tuple[str, str, str]]:
    """Return where delays count from, and the names of ``missed`` and ``delay_censored``."""
    found = [("onset", "missed", "delay_censored")]
    for suffix in _levels(own):
        found.append(("effect", f"missed_{suffix}", f"delay_censored_{suffix}"))
        twin = f"missed_null_{suffix}", f"delay_censored_null_{suffix}"
        found.append(("effect on the twin", *twin))
    return found


def wrong_terms(own: Sums) -> Wrong:
    """Yield every rule for single trajectories that the terms of a record break or keep."""
    explained = [name for name in catalogue.ATTRIBUTION if name in own]
    plain = (*METRICS, *explained)
    for suffix, names in (("", plain), *((f"_{level}", GUARANTEED) for level in _levels(own))):
        for kind in names:
            terms = own[kind + suffix]
            for kinds, mask, expected in _TERMS:
                if kind in kinds:
                    yield kind + suffix, mask(terms.numerator, terms.denominator), expected
    yield from _plain(own)
    for start, missed, censored in delays_of(own):
        delay = censored.replace("_censored", "")
        yield from _delays(own, missed, delay, censored)
        if start != "onset":
            yield from _first_alarms(own, missed, delay)
    for suffix in _levels(own):
        yield from _twins(own, suffix)
    for name in explained:
        wrong = own[name].denominator > own[f"delay_{catalogue.HEADLINE}"].denominator
        yield name, wrong, f"undefined where delay_{catalogue.HEADLINE} is"
    for larger, smaller in zip(_levels(own), _levels(own)[1:], strict=False):
        for kind in ("false_episodes", "early"):
            name = f"{kind}_{smaller}"
            wrong = own[name].numerator > own[f"{kind}_{larger}"].numerator
            yield name, wrong, "no alarm in an episode in which a larger level has none"


def _levels(own: Sums) -> list[str]:
    return [suffix for suffix in LEVELS if f"false_episodes_{suffix}" in own]


def _plain(own: Sums) -> Wrong:
    """Metrics without a level; ``missed`` and ``delay_censored`` are always defined."""
    for name in ("missed", "delay_censored"):
        yield name, own[name].denominator == 0, "the denominator 1: it is always defined"
    # Scores are defined from some step on, the same for a trajectory and its twin up to the onset.
    for name in ("auc", "auc_null"):
        wrong = (own["far"].denominator > 0) & (own[name].denominator == 0)
        yield name, wrong, "a defined one where far counts steps before the onset"
    matched = own["auc_matched"].denominator
    yield "auc_smoothed", own["auc_smoothed"].denominator != matched, "defined as auc_matched is"
    wrong = (own["auc_unpaired"].denominator == 1) & (matched == 0)
    yield "auc_unpaired", wrong, "undefined where auc_matched is"


def _delays(own: Sums, missed: str, delay: str, censored: str) -> Wrong:
    """Relations of misses and delays, each an alarm's or the lack of one."""
    defined, found = own[missed].denominator == 1, own[delay].denominator == 1
    miss, steps = own[missed].numerator == 1, own[censored].numerator
    yield missed, defined & (miss == found), "a trajectory either missed or with a delay"
    yield delay, found & ~defined, "no delay where missed is undefined"
    yield censored, (own[censored].denominator == 1) != defined, f"defined as {missed} is"
    yield censored, found & (steps != own[delay].numerator), "its delay"
    expected = "at least 1: a miss counts the remainder of the episode"
    yield censored, defined & ~found & (steps < 1), expected


def _first_alarms(own: Sums, missed: str, delay: str) -> Wrong:
    """Relations of guaranteed alarms, of which only an episode's first counts."""
    early, defined = missed.replace("missed", "early"), own[missed].denominator == 1
    yield early, own[early].denominator == 0, "the denominator 1: it is always defined"
    wrong = (own[early].numerator == 1) & defined
    yield missed, wrong, "undefined where the first alarm is early"
    # Alarms count in rows that both episodes have, of which the twin's terms know.
    shared = defined & (own["auc_matched"].denominator == 1)
    for k in FOUND_WITHIN:
        name = missed.replace("missed", f"found_within_{k}")
        counted, found = own[name].denominator == 1, own[name].numerator == 1
        yield name, counted & ~defined, f"undefined where {missed} is"
        yield name, shared & ~counted, f"defined where {missed} and auc_matched are"
        within = (own[delay].denominator == 1) & (own[delay].numerator < k)
        yield name, found & ~within, f"1 only for a delay below {k}"
        if k != FOUND_WITHIN[0]:
            least = own[missed.replace("missed", f"found_within_{FOUND_WITHIN[0]}")]
            yield name, (least.numerator == 1) & ~found, "1 where a shorter span has 1"
            yield name, (least.denominator == 1) != counted, "defined as a shorter span is"


def _twins(own: Sums, suffix: str) -> Wrong:
    """Relations of the twins' alarms: anywhere, and before or from their partners' effects."""
    name, missed = f"false_episodes_{suffix}", own[f"missed_null_{suffix}"]
    alarm = own[name].numerator == 1
    yield name, own[name].denominator == 0, "the denominator 1: it is always defined"
    early = own[f"early_null_{suffix}"].numerator == 1
    yield name, early & ~alarm, "an alarm where early_null has one"
    wrong = (missed.denominator == 1) & ((missed.numerator == 1) == alarm)
    yield name, wrong, "an alarm where missed_null is 0, and none where it is 1"
