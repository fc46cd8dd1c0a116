"""Draw the figures of the README and home page, of docs/protocol.md and docs/results/ladder.md.

``python docs/figures/make.py [DIRECTORY]`` writes the SVG files, here unless told otherwise. The
ladder's is drawn from the committed results on the ladder, the others from Hopper in the split that
comes with the package: one episode goes through those of docs/protocol.md. They have no background,
and colours that can be read on white and on black.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from oodd_eval import load_split
from oodd_eval.data.parts import AnomalousSet, EnvironmentData
from oodd_eval.metrics.alarms import GuaranteedAlarm, offered_levels
from oodd_eval.metrics.auc import AlarmRule, auc_onset, auc_same_times, first_delay
from oodd_eval.metrics.catalogue import HEADLINE
from oodd_eval.metrics.cusum import UNIT, Standardization, cusum
from oodd_eval.plugins.contract import Detector, Scores
from oodd_eval.plugins.discovery import discover
from oodd_eval.results.directory import ResultsDirectory
from oodd_eval.results.strengths import DETECTION, curve

ENVIRONMENT = "hopper"
DYNAMICS, SENSOR = "components", "shutdown"
EPISODE = 2
"""Which test seed: one in which the anomaly is found neither at once nor with difficulty."""

GREY = "#808080"
NOMINAL, ANOMALOUS, ONSET, ALARM = GREY, "#D55E00", GREY, "#2E86C1"

LADDER = Path(__file__).parents[2] / "leaderboard" / "suites" / "ladder-noisy-1"
DRAWN = {
    "pe-a": "#D55E00",
    "panel-a": "#C9820A",
    "panel": "#B0569B",
    "mewma-a": "#2E86C1",
    "npn": "#13916B",
    "riqn": "#7A6FD0",
    "rf": "#A0703C",
    "persistence": GREY,
}
"""Rows of the ladder's figure: the best, some of the paper, and one that knows nothing."""

STYLE = {
    "svg.hashsalt": "oodd-eval",
    "svg.fonttype": "path",
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.color": GREY,
    "axes.edgecolor": GREY,
    "axes.labelcolor": GREY,
    "axes.facecolor": "none",
    "xtick.color": GREY,
    "ytick.color": GREY,
    "legend.frameon": False,
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
    "path.simplify": False,
}


@dataclass(frozen=True)
class Scored:
    """One detector's scores of an environment, and what turns them into alarms."""

    calibration: list[Scores]
    twins: list[Scores]
    anomalous: list[Scores]
    rule: AlarmRule

    def guaranteed(self) -> tuple[float, GuaranteedAlarm]:
        """Return the headline level, or the one that there are episodes for, and its alarms."""
        levels = offered_levels(len(self.calibration), "cusum")
        level = levels.get(HEADLINE, max(levels.values()))
        return level, GuaranteedAlarm.fit(self.calibration, level)


def scored(name: str, data: EnvironmentData, anomaly: str = DYNAMICS) -> Scored:
    """Fit an installed detector on the train part and score the others."""
    detector: Detector = discover().offer(name).spec.factory(seed=0, horizon=1)
    detector.fit(list(data.train))
    calibration = [detector.score(x) for x in data.calibration]
    return Scored(
        calibration,
        [detector.score(x) for x in data.twins],
        [detector.score(x) for x in data.anomalous(anomaly)],
        AlarmRule(Standardization.fit(calibration)),
    )


def mark_onset(axes: Axes, onset: int, name: str = "onset") -> None:
    """Draw the line that separates nominal from anomalous."""
    axes.axvline(onset, color=ONSET, linewidth=1, linestyle="--")
    axes.annotate(
        name,
        (onset, 1),
        xycoords=("data", "axes fraction"),
        xytext=(4, 1),
        textcoords="offset points",
        fontsize=8,
    )


def widest_gap(found: AnomalousSet, data: EnvironmentData, episode: int = EPISODE) -> int:
    """Return the (corrupted) sensor that differs most from the twin's, in standard deviations."""
    anomalous, twin = found[episode].observations, data.twins[episode].observations
    both = min(len(anomalous), len(twin))
    spread = np.maximum(twin.std(axis=0), 0.1)
    gap = np.abs(anomalous[:both] - twin[:both]).mean(axis=0) / spread
    among = found.parameters[episode].get("sensors", range(len(gap)))
    return int(max(among, key=gap.__getitem__))


def draw_twins(data: EnvironmentData) -> Figure:
    """One sensor of an anomalous trajectory and of its nominal twin, for both groups."""
    figure = Figure(figsize=(7.6, 4.6), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    titles = {
        SENSOR: "Sensor anomaly: sensor {sensor} is switched off and reads 0",
        DYNAMICS: "Dynamics anomaly: motor power {power:.2f} instead of 0.75; sensor {sensor}",
    }
    for axes, (anomaly, title) in zip(panels, titles.items(), strict=True):
        found = data.anomalous(anomaly)
        drawn = {k: v for k, v in found.parameters[EPISODE].items() if k != "sensors"}
        sensor, onset = widest_gap(found, data), int(found.onsets[EPISODE])
        for trajectory, colour, width, label in (
            (found[EPISODE], ANOMALOUS, 1.2, "anomalous trajectory"),
            (data.twins[EPISODE], NOMINAL, 1.2, "its nominal twin"),
        ):
            axes.plot(trajectory.observations[:, sensor], color=colour, lw=width, label=label)
        if (end := len(found[EPISODE])) < len(data.twins[EPISODE]):
            last = found[EPISODE].observations[-1, sensor]
            axes.annotate("episode ends", (end, last), xytext=(4, -3), textcoords="offset points")
        axes.set_title(title.format(sensor=sensor, **drawn), pad=14)
        axes.set_ylabel("observation")
        mark_onset(axes, onset)
    panels[0].legend(loc="lower right")
    panels[1].set_xlabel("time t (steps)")
    return figure


def draw_alarms(data: EnvironmentData, mewma: Scored) -> Figure:
    """From scores over the CUSUM statistic to alarms, with the paper's threshold."""
    figure = Figure(figsize=(7.6, 5.2), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    onset = int(data.anomalous(DYNAMICS).onsets[EPISODE])
    rule = mewma.rule
    shown = slice(onset - 60, onset + 60)
    times = np.arange(shown.start, shown.stop)
    for scores, colour, label in (
        (mewma.twins[EPISODE], NOMINAL, "nominal twin"),
        (mewma.anomalous[EPISODE], ANOMALOUS, "anomalous trajectory"),
    ):
        x = rule.standardization(scores)
        statistic, alarms = cusum(x, drift=rule.drift, threshold=rule.threshold)
        above.plot(times, x[shown] / UNIT, color=colour, lw=1.2, label=label)
        below.plot(times, statistic[shown] / UNIT, color=colour, lw=1.2)
        raised = times[alarms[shown]]
        if colour == ANOMALOUS:
            early, late = raised[raised < onset], raised[raised >= onset]
            for at, style, name in ((early, "none", "false alarm"), (late, ALARM, "alarm")):
                below.scatter(
                    at,
                    np.full(len(at), -0.8),
                    marker="^",
                    s=26,
                    edgecolors=ALARM,
                    facecolors=style,
                    linewidths=0.9,
                    label=name,
                )
            delay = int(first_delay(alarms, onset))
    above.axhline(rule.drift / UNIT, color=GREY, lw=0.8, ls=":")
    below.axhline(rule.threshold / UNIT, color=GREY, lw=0.8, ls=":")
    for axes, name, height in ((above, "drift", rule.drift), (below, "threshold", rule.threshold)):
        axes.annotate(
            name,
            (0, height / UNIT),
            xycoords=("axes fraction", "data"),
            fontsize=8,
            xytext=(3, 2),
            textcoords="offset points",
            color=GREY,
        )
        mark_onset(axes, onset)
    above.set_title("Standardized score of the detector mewma", pad=14)
    above.set_ylabel("standard deviations")
    above.legend(loc="upper left", bbox_to_anchor=(0, 1.02))
    below.set_title(f"CUSUM statistic: the first alarm comes {delay} steps after the onset", pad=14)
    below.set_ylabel("standard deviations")
    below.set_xlabel("time t (steps)")
    below.set_yticks([0, 1, 2])
    below.legend(loc="upper left", ncols=2)
    return figure


def draw_clock(data: EnvironmentData, mewma: Scored) -> Figure:
    """Compare what the paper's AUC and what matched AUC compare, for two detectors."""
    figure = Figure(figsize=(8.4, 5.4), layout="constrained")
    grid = figure.subplots(2, 2, sharex=True, sharey="row")
    onset = int(data.anomalous(DYNAMICS).onsets[EPISODE])
    scores = {
        "clock": tuple(
            np.arange(len(x[EPISODE]), dtype=np.float64) for x in (mewma.anomalous, mewma.twins)
        ),
        "mewma": (mewma.anomalous[EPISODE], mewma.twins[EPISODE]),
    }
    for (left, right), (name, (anomalous, twin)) in zip(grid, scores.items(), strict=True):
        stop = min(len(anomalous), len(twin))
        before, after = np.arange(onset), np.arange(onset, stop)
        own = 100 * auc_onset(anomalous, onset)
        matched = 100 * auc_same_times(anomalous, twin, onset, stop)
        left.plot(before, anomalous[:onset], color=ALARM, lw=1.6, label="before the onset")
        left.plot(after, anomalous[onset:stop], color=ANOMALOUS, lw=1.6, label="from the onset on")
        left.set_title(f"{name}: paper's AUC {own:.0f} %", pad=14)
        right.plot(
            after,
            twin[onset:stop],
            color=NOMINAL,
            lw=3.2 if name == "clock" else 1.6,
            label="nominal twin",
        )
        right.plot(after, anomalous[onset:stop], color=ANOMALOUS, lw=1.6, label="anomalous")
        right.set_title(f"{name}: matched AUC {matched:.0f} %", pad=14)
        left.set_ylabel("score")
        mark_onset(left, onset)
        mark_onset(right, onset)
    for axes in grid[0]:
        axes.legend(loc="upper left")
    for axes in grid[1]:
        axes.set_xlabel("time t (steps)")
    return figure


def draw_guaranteed(data: EnvironmentData, mewma: Scored) -> Figure:
    """Draw the threshold among the calibration episodes, and the first alarm of an episode."""
    figure = Figure(figsize=(7.6, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 2), sharey=True)
    level, rule = mewma.guaranteed()
    largest = np.sort([rule.largest(scores) for scores in mewma.calibration[1::2]])
    left.plot(np.arange(1, len(largest) + 1), largest / UNIT, "o", color=NOMINAL, ms=4)
    left.set_xlabel("calibration episodes, in order")
    left.set_ylabel("largest CUSUM (standard deviations)")
    effect = int(data.anomalous(DYNAMICS).effects[EPISODE])
    for scores, colour, label in (
        (mewma.twins[EPISODE], NOMINAL, "nominal twin"),
        (mewma.anomalous[EPISODE], ANOMALOUS, "anomalous trajectory"),
    ):
        statistic = rule.statistic(scores) / UNIT
        right.plot(statistic, color=colour, lw=1.2, label=label)
        if (first := rule.first(scores)) is not None:
            right.plot(first, statistic[first], "v", color=ALARM, ms=8, label="first alarm")
    mark_onset(right, effect, "effect")
    for axes in (left, right):
        axes.axhline(rule.threshold / UNIT, color=ALARM, lw=1, ls=":")
    right.set_ylim(0, 3 * rule.threshold / UNIT)
    right.set_xlabel("time t (steps)")
    right.set_title(
        f"threshold for at most {100 * level:g} % of nominal episodes", fontsize=9, pad=14
    )
    right.legend(loc="upper left")
    return figure


def draw_shutdown(data: EnvironmentData, mewma: Scored) -> Figure:
    """Draw a sensor that is switched off, and the alarm of the episode with the median delay."""
    anomaly = data.anomalous(SENSOR)
    level, rule = mewma.guaranteed()
    firsts = [rule.first(scores) for scores in mewma.anomalous]
    if None in firsts or any(rule.first(scores) is not None for scores in mewma.twins):
        raise ValueError("an episode has no alarm, or a twin has one: the caption would be wrong")
    delays = [int(first or 0) - int(at) for first, at in zip(firsts, anomaly.effects, strict=True)]
    episode = int(np.argsort(delays, kind="stable")[(len(delays) - 1) // 2])
    effect, sensor = int(anomaly.effects[episode]), widest_gap(anomaly, data, episode)
    figure = Figure(figsize=(5, 4.6), layout="constrained")  # read on a telephone, too
    above, below = figure.subplots(2, 1, sharex=True)
    shown = slice(effect - 60, effect + 40)
    times = np.arange(shown.start, shown.stop)
    for trajectory, scores, colour, label in (
        (data.twins[episode], mewma.twins[episode], NOMINAL, "without the fault"),
        (anomaly[episode], mewma.anomalous[episode], ANOMALOUS, "with the fault"),
    ):
        values = trajectory.observations[shown, sensor]
        above.plot(times[: len(values)], values, color=colour, lw=1.4, label=label)
        statistic = rule.statistic(scores)[shown] / UNIT
        below.plot(times[: len(statistic)], statistic, color=colour, lw=1.4)
    if (end := len(anomaly[episode])) < shown.stop:
        last = anomaly[episode].observations[-1, sensor]
        above.annotate("episode ends", (end, last), xytext=(4, -3), textcoords="offset points")
    alarm = effect + delays[episode]
    height = float(rule.statistic(mewma.anomalous[episode])[alarm]) / UNIT
    below.plot(alarm, height, "v", color=ALARM, ms=9, label="first alarm")
    below.axhline(rule.threshold / UNIT, color=ALARM, lw=1, ls=":")
    below.annotate(
        f"threshold at {100 * level:g} %",
        (0, rule.threshold / UNIT),
        xycoords=("axes fraction", "data"),
        xytext=(3, 3),
        textcoords="offset points",
        fontsize=8,
    )
    below.set_ylim(0, 3 * rule.threshold / UNIT)
    mark_onset(above, effect, "fault")
    mark_onset(below, effect, "fault")
    above.set_title(f"Hopper, {data.sensors[sensor].name}: the sensor is off", pad=14)
    above.set_ylabel("observation")
    above.legend(loc="lower left")
    below.set_title(f"The detector mewma: an alarm {delays[episode]} steps after the fault", pad=14)
    below.set_ylabel("CUSUM (standard deviations)")
    below.set_xlabel("time t (steps)")
    below.legend(loc="upper left")
    return figure


def draw_power() -> Figure:
    """Draw how many anomalies some rows find, from the weakest rung of the ladder on."""
    figure = Figure(figsize=(7.6, 3.6), layout="constrained")
    axes = figure.subplots()
    records = list(ResultsDirectory(LADDER).records())
    for name, colour in DRAWN.items():
        own = [r for r in records if str(r.setting) == name]
        points = curve(own, DETECTION)
        axes.plot(
            [p.strength for p in points],
            [100 * p.value for p in points],
            color=colour,
            lw=1.8,
            label=name,
        )
    axes.axvline(1, color=GREY, lw=1, ls="--")
    axes.annotate(
        "costs 1 % of the return",
        (1, 0.02),
        xycoords=("data", "axes fraction"),
        xytext=(4, 0),
        textcoords="offset points",
        fontsize=8,
    )
    axes.set_xscale("log")
    axes.set_ylim(0, 100)
    axes.set_xlabel("strength of the anomaly")
    axes.set_ylabel("found within 100 steps (%)")
    axes.set_title("at most 5 % of nominal episodes raise an alarm", loc="left")
    axes.legend(loc="upper left", bbox_to_anchor=(1, 1))
    return figure


def draw_all(directory: Path) -> None:
    """Write all figures; the same versions write the same bytes."""
    data = load_split("mini").environment(ENVIRONMENT)
    mewma = scored("mewma", data)
    figures: dict[str, Callable[[], Figure]] = {
        "twins": lambda: draw_twins(data),
        "alarms": lambda: draw_alarms(data, mewma),
        "clock": lambda: draw_clock(data, mewma),
        "guaranteed": lambda: draw_guaranteed(data, mewma),
        "shutdown": lambda: draw_shutdown(data, scored("mewma", data, SENSOR)),
        "power": draw_power,
    }
    with mpl.rc_context(STYLE):
        for name, draw in figures.items():
            draw().savefig(directory / f"{name}.svg", metadata={"Date": None, "Creator": None})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("directory", type=Path, nargs="?", default=Path(__file__).parent)
    draw_all(parser.parse_args().directory)
