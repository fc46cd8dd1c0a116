"""What is said of a threshold: for a terminal, and as JSON."""

import math
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any, Final

from oodd_eval.metrics.alarms import least_episodes
from oodd_eval.metrics.binomial import clopper_pearson
from oodd_eval.metrics.catalogue import LEVELS
from oodd_eval.metrics.cusum import DRIFT, UNIT
from oodd_eval.names import counted
from oodd_monitors.calibrating import Detections, ScoreCalibration

_DRIFT_FROM: Final = 6
"""Logs of which an order can be rare: both orders of 5 have p = 2/120, which is above 1 %."""


def condition(calibration: ScoreCalibration, name: str, unit: str = "") -> str:
    """Return the alarm as a line to copy.

    Parameters
    ----------
    calibration
        The threshold.
    name, unit
        Of the score.

    Returns
    -------
    str
        The threshold is rounded up, which breaks no promise.

    Examples
    --------
    >>> from oodd_monitors.calibrating import calibrate
    >>> condition(calibrate([[0.0, 0.5, i / 3] for i in range(1, 20)]), "residual", "m")
    'residual > 6.33334 m'
    """
    name = name if calibration.alarm == "threshold" else f"{calibration.alarm}({name})"
    rows = f" in {calibration.hold} scores in a row" if calibration.hold > 1 else ""
    unit = "" if unit == "1" or calibration.alarm == "cusum" else unit
    return f"{name} > {_rounded_up(calibration.threshold)} {unit}".rstrip() + rows


def _rounded_up(value: float) -> str:
    """Return a number with six digits that is not below it."""
    text = f"{value:.6g}"
    if float(text) < value:
        text = f"{float(text) + 10.0 ** (math.floor(math.log10(abs(value))) - 5):.6g}"
    return text


def sentences(calibration: ScoreCalibration, name: str) -> Iterator[str]:
    """Yield what the threshold is worth, in sentences.

    Parameters
    ----------
    calibration
        The threshold.
    name
        Of the score.
    """
    if scale := calibration.rule.standardization:
        factor = UNIT / scale.std if scale.std else math.inf
        yield (
            f"cusum: S = max(0, S + {factor:.6g} * ({name} - {scale.mean:.6g}) - {DRIFT:g}), from "
            "S = 0 at the start of each log."
        )
    if calibration.smoothing:
        yield f"ewma: m = m + {calibration.smoothing:g} * ({name} - m), from the first score on."
    whole = "" if calibration.whole else " Logs that no window cuts would promise it of whole logs."
    yield f"{calibration.promise[0].upper()}{calibration.promise[1:]}.{whole}"
    n, basis, kind = calibration.units, calibration.calibration, calibration.calibration.kind
    if interval := calibration.share_interval:
        scaling = ", others scale it" if kind == "cusum" else ""
        yield (
            f"The true share at this threshold is {_percent(*interval)} (95 % interval, from "
            f"{counted(n, 'healthy log(s)')}{scaling})."
        )
    for level in (level for level in LEVELS.values() if level <= calibration.level):
        least = least_episodes(level, kind)
        if more := max(0, least - basis.recording_count):
            yield f"{100 * level:g} % takes {least} healthy logs, {more} more."
            break
    largest, share = calibration.sweep
    margin = " A margin on top lets fewer trip: how many fewer, healthy logs do not tell."
    # Where several logs have the largest value, further ones may have it, too.
    most = "at most " * (basis.largest.count(largest) > 1)
    yield (
        f"A hand sweep until none of these {counted(n, 'log(s)')} trips stops at "
        f"{_rounded_up(largest)}, and lets {most}{100 * share:.3g} % (1/{n + 1}) of further "
        f"healthy logs trip on average.{margin * (largest > 0)}"
    )
    test = calibration.drift
    steady = f"No drift seen (rank correlation {test.statistic:.2f}, p = {test.p:.2g})."
    if basis.recording_count < _DRIFT_FROM:
        steady = f"Drift shows in {_DRIFT_FROM} logs and more."
    yield from calibration.notes or [steady]
    if calibration.healthy:
        alarms, n = calibration.false_alarms, calibration.healthy
        shares = _percent(*clopper_pearson(alarms, n))
        yield f"Of {counted(n, 'further healthy log(s)')} {alarms} alarm (95 % interval {shares})."
    yield from map(_detected, calibration.detections)


def _percent(low: float, high: float) -> str:
    return f"{100 * low:.2g} to {100 * high:.2g} %"


def _detected(row: Detections) -> str:
    """Return what is detected of a kind."""
    text = f"Of {counted(row.episodes, 'log(s)')} with {row.kind}: {row.detected} alarm"
    if not math.isnan(row.delay):
        text += f" once it began, by a median delay of {row.delay:g} rows"
    elif row.detected:
        text += f", {row.in_time} of them before the shortest healthy log would end"
    early = f"; {row.early} before it began" if row.early else ""
    return f"{text}{early}; {row.missed} never."


def by_group(calibration: ScoreCalibration, name: str, unit: str) -> Iterator[str]:
    """Yield the threshold of each group, and what pooling does to it.

    Parameters
    ----------
    calibration, name, unit
        As of `condition`.
    """
    for group, row in calibration.groups.items():
        line = condition(row.calibration, name, unit) if row.calibration else row.problem
        shares = _percent(*clopper_pearson(row.above, row.episodes))
        pooled = f"pooled, {row.above} of its {row.episodes} healthy logs alarm: {shares}"
        yield f"{group or 'none'}: {line} ({pooled})"


def as_json(calibration: ScoreCalibration) -> dict[str, Any]:
    """Return all that is known of a threshold as values for JSON, NaN among them.

    Parameters
    ----------
    calibration
        The threshold.
    """
    names = ("threshold", "smoothing", "promise", "share_interval", "units", "needed", "sweep")
    properties = {name: getattr(calibration, name) for name in (*names, "notes")}
    groups = {
        name: asdict(group) | {"calibration": group.calibration and as_json(group.calibration)}
        for name, group in calibration.groups.items()
    }
    return asdict(calibration) | properties | {"groups": groups}
