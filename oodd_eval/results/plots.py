"""Figures of results for notebooks; they need matplotlib."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from oodd_eval.errors import MissingExtraError, ResultsError
from oodd_eval.metrics.catalogue import MetricInfo
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
    """Draw sensors over the statistic of the alarm, the nominal twin dashed."""
    figure, (upper, lower) = _subplots(2, 4.4)
    rows, twin = episode.trajectory.observations, episode.twin.observations
    common = min(len(rows), len(twin))
    spread = np.maximum(twin.std(axis=0), 1e-6)
    apart = np.abs(rows[:common] - twin[:common]).mean(axis=0) / spread
    for colour, d in zip(COLOURS, np.argsort(-apart, kind="stable")[:SENSORS], strict=False):
        nominal, anomalous = ((part[:, d] - twin[:, d].mean()) / spread[d] for part in (twin, rows))
        upper.plot(nominal, "--", color=colour, linewidth=0.8, alpha=0.5)
        upper.plot(anomalous, color=colour, linewidth=0.8, label=episode.sensors[d])
    upper.set_ylabel("sensor (std. of twin)")
    upper.axvline(episode.onset, color="0.5", linewidth=1)
    _beside(upper)
    upper.set_title(str(episode.cell), fontsize="medium")
    rule = episode.rule
    for scores, style in ((episode.twin_scores, "--"), (episode.scores, "-")):
        statistic = scores if rule is None else rule.statistic(scores)
        name = "nominal twin" if style == "--" else "anomalous"
        finite = np.where(np.isfinite(statistic), statistic, np.nan)
        lower.plot(finite, style, color=COLOURS[0], alpha=0.5 if style == "--" else 1, label=name)
    lower.set_ylabel("score" if rule is None else "statistic")
    lower.set_xlabel("row")
    lower.axvline(episode.onset, color="0.5", linewidth=1, label="onset")
    if rule is not None and np.isfinite(rule.threshold):
        lower.axhline(rule.threshold, color=COLOURS[1], linewidth=1, label="threshold at 5 %")
        # The first rows beyond the threshold matter, not how far it goes.
        lower.set_yscale("symlog", linthresh=abs(rule.threshold) or 1.0)
        if (alarm := episode.alarm) is not None:
            height = rule.statistic(episode.scores)[alarm]
            lower.plot(alarm, height, "v", color=COLOURS[1], label=f"alarm at row {alarm}")
    _beside(lower)
    return figure


def _beside(axis: Any) -> None:
    """Put the legend where it hides nothing."""
    axis.legend(loc="center left", bbox_to_anchor=(1, 0.5), fontsize="small", frameon=False)


def power(curves: Mapping[str, Sequence[ScoredEpisode]]) -> Figure:
    """Draw shares of episodes with an alarm by rows since the effect; dotted, of the twins.

    Episodes with an alarm before the effect, or without a row after it, are left out.
    """
    if not any(e.rule for episodes in curves.values() for e in episodes):
        raise ResultsError("no row has an alarm at 5 %: more calibration episodes are needed")
    figure, axis = _subplots(1, 3.6)
    rows = np.arange(LONGEST + 1)
    for (name, episodes), colour in zip(curves.items(), COLOURS * 9, strict=False):
        for twins, style in ((False, "-"), (True, ":")):
            delays = np.array([e.delay(of_twin=twins) for e in episodes])
            share = (delays[~np.isnan(delays), None] <= rows).mean(axis=0)
            label = None if twins else name
            axis.step(rows + 1, 100 * share, style, where="post", color=colour, label=label)
    axis.set_xscale("log")
    axis.set_xlabel("rows from the effect on (dotted: alarms of the nominal twins)")
    axis.set_ylabel("episodes with an alarm (%)")
    axis.set_ylim(0, 100)
    _beside(axis)
    return figure


def ladder(
    curves: Mapping[str, Sequence[Point]], nulls: Mapping[str, Sequence[Point]], metric: MetricInfo
) -> Figure:
    """Draw a metric against the strength and against the return that it costs, one line a detector.

    What chance or false alarms alone give is dotted.
    """
    costs = any(not np.isnan(p.lost) for points in curves.values() for p in points)
    figure, grid = _subplots(1, 3.6, columns=1 + costs)
    axes = np.atleast_1d(grid)
    left = axes[0]
    percent = 100 if metric.unit == "percent" else 1
    for (name, points), colour in zip(curves.items(), COLOURS * 9, strict=False):
        for label, drawn, style in ((name, points, "o-"), (None, nulls.get(name, ()), ":")):
            strength, lost, value = np.array(drawn).reshape(-1, 3).T * ([1], [100], [percent])
            look = {"color": colour, "markersize": 3, "linewidth": 1.2 if label else 0.8}
            for axis, x in zip(axes, (strength, lost), strict=False):
                known = ~np.isnan(x)
                axis.plot(x[known], value[known], style, label=label, **look)
    left.set_xscale("log")
    left.set_xlabel("strength (1: costs 1 % of the return)" if costs else "strength")
    axes[-1].set_xlabel("return lost (%)" if costs else "strength")
    left.set_ylabel(metric.title + (" (%)" if metric.unit == "percent" else ""))
    if metric.unit == "percent":
        left.set_ylim(0, 102)
    _beside(axes[-1])
    return figure
