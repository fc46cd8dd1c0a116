"""What is said of a threshold: for a terminal, and as JSON."""

import math
from collections.abc import Iterator
from typing import Any, Final

from oodd_eval.metrics.alarms import least_episodes
from oodd_eval.metrics.binomial import clopper_pearson
from oodd_eval.metrics.catalogue import LEVELS
from oodd_eval.metrics.cusum import DRIFT, UNIT
from oodd_eval.names import counted
from oodd_monitors.calibrating import Detections, ScoreCalibration

_DIGITS: Final = 6  # of a threshold to copy


def condition(calibration: ScoreCalibration, name: str, unit: str = "") -> str:
    """Return the alarm as a line to copy.

    Parameters
    ----------
    calibration
        The threshold.
    name
        Of the score.
    unit
        Of the score.

    Returns
    -------
    str
        The threshold is rounded up, which breaks no promise.

    Examples
    --------
    >>> from oodd_monitors.calibrating import calibrate
    >>> condition(calibrate([[0.0, i / 3] for i in range(1, 20)]), "residual", "m")
    'residual > 6.33334 m'
    """
    name = {"cusum": f"cusum({name})", "ewma": f"ewma({name})"}.get(calibration.alarm, name)
    rows = f" in {calibration.hold} rows with a score in a row" if calibration.hold > 1 else ""
    shown_unit = f" {unit}" if unit not in {"", "1"} and calibration.alarm != "cusum" else ""
    return f"{name} > {_rounded_up(calibration.threshold)}{shown_unit}{rows}"


def _rounded_up(value: float) -> str:
    """Return a number with six digits that is not below it."""
    text = f"{value:.{_DIGITS}g}"
    if float(text) < value:
        unit = 10.0 ** (math.floor(math.log10(abs(value))) + 1 - _DIGITS)
        text = f"{float(text) + unit:.{_DIGITS}g}"
    return text


def sentences(calibration: ScoreCalibration, name: str) -> Iterator[str]:
    """Yield what the threshold is worth.

    Parameters
    ----------
    calibration
        The threshold.
    name
        Of the score.

    Yields
    ------
    str
        Sentences, in the order in which they are read.
    """
    yield from _formula(calibration, name)
    whole = "" if calibration.whole else " Logs that no window cuts would promise it of whole logs."
    yield f"{_upper(calibration.promise)}.{whole}"
    n, kind = calibration.units, calibration.calibration.kind
    if interval := calibration.share_interval:
        low, high = (100 * share for share in interval)
        used = f"{n} healthy logs" if kind != "cusum" else f"{n} healthy logs, the others scale it"
        yield (
            f"The true share at this threshold is {low:.2g} to {high:.2g} % (95 % interval, from "
            f"{used})."
        )
    yield from _levels(calibration)
    largest, share = calibration.sweep
    text = (
        f"A hand sweep until none of these {counted(n, 'log(s)')} trips stops at "
        f"{_rounded_up(largest)}, and lets {100 * share:.3g} % (1/{n + 1}) of further healthy logs "
        "trip on average."
    )
    if largest > 0:
        text += " A margin on top lets fewer trip: how many fewer, healthy logs do not tell."
    yield text
    test = calibration.drift
    figures = f"rank correlation {test.statistic:.2f}, p = {test.p:.2g}"
    if not calibration.notes:
        yield f"No drift seen over the logs ({figures})."
    yield from calibration.notes
    if calibration.healthy:
        alarms, n = calibration.false_alarms, calibration.healthy
        low, high = (100 * share for share in clopper_pearson(alarms, n))
        yield (
            f"Of {counted(n, 'further healthy log(s)')} {alarms} alarm "
            f"({100 * alarms / n:.3g} %, 95 % interval {low:.2g} to {high:.3g})."
        )
    yield from map(_detected, calibration.detections)


def _upper(text: str) -> str:
    return text[:1].upper() + text[1:]


def _formula(calibration: ScoreCalibration, name: str) -> Iterator[str]:
    """Yield how the statistic is computed, where it is not the score."""
    scale = calibration.rule.standardization
    if scale is not None:
        factor = UNIT / scale.std if scale.std else math.inf
        yield (
            f"cusum: S = max(0, S + {factor:.6g} * ({name} - {scale.mean:.6g}) - {DRIFT:g}), from "
            "S = 0 at the start of each log."
        )
    if calibration.smoothing:
        yield f"ewma: m = m + {calibration.smoothing:g} * ({name} - m), from the first score on."


def _levels(calibration: ScoreCalibration) -> Iterator[str]:
    """Yield how many more logs the next levels take."""
    recordings, kind = calibration.calibration.recording_count, calibration.calibration.kind
    if calibration.needed:
        yield f"{counted(calibration.needed, 'more healthy log(s)')} would keep it."
    for level in LEVELS.values():
        least = least_episodes(level, kind)
        if level < calibration.level and least > recordings:
            more = least - recordings
            yield f"{100 * level:g} % takes {least} healthy logs, {more} more."
            return


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
        low, high = (100 * share for share in clopper_pearson(row.above, row.episodes))
        yield (
            f"{group}: {line} (pooled, {row.above} of its {row.episodes} healthy logs alarm: "
            f"{low:.2g} to {high:.3g} %)"
        )


def as_json(calibration: ScoreCalibration, name: str, unit: str) -> dict[str, Any]:
    """Return all that is known of a threshold as values for JSON.

    Parameters
    ----------
    calibration
        The threshold.
    name, unit
        Of the score.

    Returns
    -------
    dict
        Without numbers that are not finite.
    """
    largest, share = calibration.sweep
    scale = calibration.rule.standardization
    return {
        "score": name,
        "unit": unit,
        "threshold": calibration.threshold,
        "alarm": calibration.alarm,
        "hold": calibration.hold,
        "smoothing": calibration.smoothing,
        "standardization": scale.numbers if scale else None,
        "level": calibration.level,
        "promise": calibration.promise,
        "share_interval": calibration.share_interval,
        "logs": calibration.calibration.episodes,
        "recordings": calibration.calibration.recording_count,
        "threshold_from": calibration.units,
        "needed": calibration.needed,
        "longest_gap": calibration.longest_gap,
        "sweep": {"threshold": largest, "share": share},
        "drift": {"correlation": calibration.drift.statistic, "p": calibration.drift.p},
        "notes": calibration.notes,
        "healthy": {"logs": calibration.healthy, "alarms": calibration.false_alarms},
        "detections": [
            row._asdict() | {"delay": None if math.isnan(row.delay) else row.delay}
            for row in calibration.detections
        ],
        "groups": {
            group: {
                "logs": row.episodes,
                "above_pooled": row.above,
                "problem": row.problem,
                "calibration": as_json(row.calibration, name, unit) if row.calibration else None,
            }
            for group, row in calibration.groups.items()
        },
    }
