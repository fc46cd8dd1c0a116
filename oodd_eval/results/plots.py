"""Figures of results for notebooks; they need matplotlib."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from oodd_eval.errors import MissingExtraError, ResultsError
from oodd_eval.metrics.catalogue import MetricInfo
from oodd_eval.metrics.unpaired import anomalous_rows
from oodd_eval.results.evaluate import ScoredEpisode
from oodd_eval.results.strengths import Point

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SENSORS: Final = 3
"""Sensors that are drawn, those that leave their twin's course most."""
LONGEST: Final = 300
"""Rows after the effect at which curves of power end."""
COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's colours, which colour-blind readers can tell apart."""


def _subplots(rows: int, height: float, columns: int = 1) -> tuple[Figure, Any]:
    try:
        from matplotlib import pyplot as plt  # noqa: PLC0415
    except ImportError:
        advice = "plots need matplotlib: pip install 'oodd-eval[plots]'"
        raise MissingExtraError(advice) from None
    figure, axes = plt.subplots(
        rows, columns, sharex="col", sharey="row", figsize=(8, height), layout="constrained"
    )
    plt.close(figure)  # A notebook shows what a cell returns, and would show it twice.
    return figure, axes


def trajectory(episode: ScoredEpisode) -> Figure:
    """Draw sensors over the statistic of the alarm, the nominal twin dashed.

    Without a twin the anomalous rows are shaded.
    """
    figure, (upper, lower) = _subplots(2, 4.4)
    _sensors(upper, episode)
    _shade(upper, episode, label=False)
    _beside(upper)
    upper.set_title(str(episode.cell), fontsize="medium")
    rule = episode.rule
    solid = "episode" if episode.twin is None else "anomalous"
    drawn = (episode.twin_scores, "--", 0.5, "nominal twin"), (episode.judged, "-", 1, solid)
    for scores, style, alpha, name in drawn:
        if scores is not None:
            statistic = scores if rule is None else rule.statistic(scores)
            finite = np.where(np.isfinite(statistic), statistic, np.nan)
            lower.plot(finite, style, color=COLOURS[0], alpha=alpha, label=name)
    lower.set_ylabel("score" if rule is None else "statistic")
    lower.set_xlabel("row")
    _shade(lower, episode, label=True)
    if rule is not None and np.isfinite(rule.threshold):
        level = f"threshold at {100 * episode.level:g} %"
        lower.axhline(rule.threshold, color=COLOURS[1], linewidth=1, label=level)
        # The first rows beyond the threshold matter, not how far it goes.
        lower.set_yscale("symlog", linthresh=abs(rule.threshold) or 1.0)
        if (alarm := episode.alarm) is not None:
            height = rule.statistic(episode.judged)[alarm]
            lower.plot(alarm, height, "v", color=COLOURS[1], label=f"alarm at row {alarm}")
    _beside(lower)
    return figure


def _sensors(axis: Any, episode: ScoredEpisode) -> None:
    """Draw the sensors that leave the course of their twin most, dashed that course."""
    # Without a twin, those that are farthest from nominal episodes in the anomalous rows.
    rows = episode.trajectory.observations.astype(np.float64)
    if episode.twin is not None:
        course = episode.twin.observations
        common, spread = min(len(rows), len(course)), np.maximum(course.std(axis=0), 1e-6)
        apart, reference = np.abs(rows[:common] - course[:common]) / spread, "twin"
        rows, course = ((part - course.mean(axis=0)) / spread for part in (rows, course))
    else:
        mean, spread = (0.0, 1.0) if episode.nominal is None else episode.nominal
        rows, reference = (rows - mean) / np.maximum(spread, 1e-6), "nominal"
        apart = np.abs(rows[anomalous_rows(episode.intervals, len(rows))])
    order = np.argsort(-apart.mean(axis=0), kind="stable")[:SENSORS]
    for colour, d in zip(COLOURS, order, strict=False):
        if episode.twin is not None:
            axis.plot(course[:, d], "--", color=colour, linewidth=0.8, alpha=0.5)
        axis.plot(rows[:, d], color=colour, linewidth=0.8, label=episode.sensors[d])
    axis.set_ylabel(f"sensor (std. of {reference})")


def _shade(axis: Any, episode: ScoredEpisode, *, label: bool) -> None:
    """Mark the onset, or without a twin the anomalous rows."""
    if episode.twin is not None:
        axis.axvline(episode.onset, color="0.5", linewidth=1, label="onset" if label else None)
        return
    names: set[str] = set()
    for start, stop in episode.intervals:
        has_start = start >= 0
        name = "anomalous rows" if has_start else "anomalous, start unknown"
        # Each name stands in the legend once.
        text = name if label and name not in names else None
        look = {"color": "0.5", "alpha": 0.2, "linewidth": 0, "hatch": None if has_start else "//"}
        axis.axvspan(max(start, 0), stop, label=text, **look)
        names.add(name)


def _beside(axis: Any) -> None:
    """Put the legend where it hides nothing."""
    axis.legend(loc="center left", bbox_to_anchor=(1, 0.5), fontsize="small", frameon=False)


def power(curves: Mapping[str, Sequence[ScoredEpisode]]) -> Figure:
    """Draw shares of episodes with an alarm by rows since the effect; dotted, of the twins.

    Episodes with an alarm before the effect, or without a row after it, are left out.
    """
    everything = [e for episodes in curves.values() for e in episodes]
    levels = sorted({100 * e.level for e in everything}) or [5.0]
    if not any(e.rule for e in everything):
        raise ResultsError(
            f"no row has an alarm at {levels[-1]:g} %: more calibration episodes are needed"
        )
    figure, axis = _subplots(1, 3.6)
    rows = np.arange(LONGEST + 1)
    for (name, episodes), colour in zip(curves.items(), COLOURS * 9, strict=False):
        for twins, style in ((False, "-"), (True, ":")):
            delays = np.array([e.delay(of_twin=twins) for e in episodes])
            if np.isnan(delays).all():
                continue
            share = (delays[~np.isnan(delays), None] <= rows).mean(axis=0)
            label = None if twins else name
            axis.step(rows + 1, 100 * share, style, where="post", color=colour, label=label)
    axis.set_xscale("log")
    paired = any(e.twin is not None for e in everything)
    dotted = " (dotted: alarms of the nominal twins)" * paired
    axis.set_xlabel(f"rows from the {'effect' if paired else 'first anomalous row'} on{dotted}")
    axis.set_ylabel("episodes with an alarm (%)")
    axis.set_ylim(0, 100)
    _beside(axis)
    return figure


def ladder(
    curves: Mapping[str, Sequence[Point]],
    nulls: Mapping[str, Sequence[Point]],
    metric: MetricInfo,
    unit: str,
) -> Figure:
    """Draw a metric against the strength and against the return that it costs, one line a detector.

    What chance or false alarms alone give is dotted. `unit` says what a strength of 1 does; it is
    empty where strengths are in the units of their kinds of anomalies.
    """
    costs = any(not np.isnan(p.lost) for points in curves.values() for p in points)
    strength_label = f"strength (1: {unit})" if unit else "strength"
    figure, grid = _subplots(1, 3.6, columns=1 + costs)
    axes = np.atleast_1d(grid)
    left = axes[0]
    percent = 100 if metric.unit == "percent" else 1
    for (name, points), colour in zip(curves.items(), COLOURS * 9, strict=False):
        for label, drawn, style in ((name, points, "o-"), (None, nulls.get(name, ()), ":")):
            strength, lost, value = np.array(drawn).reshape(-1, 3).T * ([1], [100], [percent])
            look = {"color": colour, "markersize": 3, "linewidth": 1.2 if label else 0.8}
            for axis, x in zip(axes, (strength, lost), strict=False):
                defined = ~np.isnan(x)
                axis.plot(x[defined], value[defined], style, label=label, **look)
    left.set_xscale("log")
    left.set_xlabel(strength_label)
    axes[-1].set_xlabel("return lost (%)" if costs else strength_label)
    left.set_ylabel(metric.title + (" (%)" if metric.unit == "percent" else ""))
    if metric.unit == "percent":
        left.set_ylim(0, 102)
    _beside(axes[-1])
    return figure
