"""A watchdog beside a running controller: one reading per observation, an alarm as it happens.

``python examples/live_alarm.py --plot alarm.png --gif alarm.gif`` (extras gym and plots).

A trained policy balances Gymnasium's CartPole. At an onset the dynamics change: the pole gets
heavier and longer. The detector is fitted on nominal trajectories of the mini split, and the
threshold chosen such that at most one nominal episode in ten raises an alarm. `panel`, the
default, is fitted in a second without its networks; ``--detector pe-a`` (extra reference) takes
most of a minute and is sooner. With ``--fit FILE`` the watchdog is kept, and the next start takes
no training; ``--monitor`` shows it at work.
"""

from __future__ import annotations

import argparse
import contextlib
import time
from dataclasses import dataclass, field
from pathlib import Path

import gymnasium
import numpy as np
from oodd_live import TerminalMonitor, Watchdog, WatchdogWrapper
from oodd_recording.policies import load_policy

from oodd_eval import load_split

HEAVIER = {"masspole": 0.4, "length": 1.0}
"""Values after the onset; nominally 0.1 kg and 0.5 m (half of the pole)."""
PARAMETERS = {"panel": {"forecast": "linear"}}
"""Of the default, which would train networks for most of a minute otherwise."""


@dataclass
class Episode:
    """Results of one episode: readings, rendered frames, times of alarms, seconds per step."""

    readings: list = field(default_factory=list)
    frames: list = field(default_factory=list)
    alarms: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    @property
    def scores(self):
        """Scores, NaN where undefined."""
        return np.array([reading.score for reading in self.readings])

    @property
    def statistic(self):
        """Statistic that is compared with the threshold."""
        return np.array([reading.statistic for reading in self.readings])


def prepare(name, level, place):
    """Return a watchdog that alarms in at most this share of episodes."""
    if place and place.exists():
        return Watchdog.load(place)
    data = load_split("mini").environment("cartpole")
    watchdog = Watchdog.fit(name, data, alpha=level, parameters=PARAMETERS.get(name))
    if place:
        watchdog.save(place)
    return watchdog


def run(watchdog, policy, *, seed, steps, onset=None, render=False, show=None, tell=print):
    """Control one episode with a watchdog beside it; from the onset on the pole is heavier."""
    cart = gymnasium.make("CartPole-v1", render_mode="rgb_array" if render else None)
    env, seen = WatchdogWrapper(cart, watchdog), Episode()
    observation, info = env.reset(seed=seed)
    for t in range(steps + 1):
        reading = info["oodd"]
        seen.readings.append(reading)
        if render:
            seen.frames.append(env.render())
        if show:
            show(reading)
        if reading.alarm and not seen.alarms:
            seen.alarms.append(t)
            when = "" if onset is None or t < onset else f", {t - onset} steps after the onset"
            tell(f"step {t}: alarm{when}; {reading.sensor or 'no sensor'} named first")
        if onset is not None and t + 1 == onset:
            change(env.unwrapped)
        action = policy.act(observation)
        start = time.perf_counter()
        observation, _, over, _, info = env.step(action)
        seen.seconds.append(time.perf_counter() - start)
        if over:
            break
    env.close()
    return seen


def change(cart):
    """Change the dynamics of a running simulator."""
    for name, value in HEAVIER.items():
        setattr(cart, name, value)
    cart.total_mass = cart.masscart + cart.masspole
    cart.polemass_length = cart.masspole * cart.length


def draw(path, watchdog, onset, anomalous, nominal):
    """Draw the robot, scores, statistic and sensors of the changed episode beside a nominal one."""
    from matplotlib.figure import Figure  # noqa: PLC0415  only needed here, and slow to import

    figure = Figure(figsize=(9, 8), layout="constrained")
    rows = figure.subfigures(2, height_ratios=(1, 3))
    last = len(anomalous.frames) - 1
    shown = sorted({min(t, last) for t in (0, onset - 1, *anomalous.alarms[:1], last)})
    for axes, t in zip(rows[0].subplots(1, len(shown)), shown, strict=True):
        picture(axes, anomalous, t)
    above, below, sensors = rows[1].subplots(3, sharex=True)
    for seen, colour, label in ((nominal, "0.6", "nominal"), (anomalous, "C0", "heavier pole")):
        above.plot(seen.scores, color=colour, label=label)
        below.plot(seen.statistic, color=colour)
        below.plot(seen.alarms, seen.statistic[seen.alarms], "v", color=colour)
    for axes in (above, below, sensors):
        axes.axvline(onset, color="C3", linestyle="--", label="onset" if axes is above else None)
        axes.spines[["top", "right"]].set_visible(False)
    below.axhline(watchdog.rule.threshold, color="0.3", linestyle=":", label="threshold")
    shares = [[r.sensors.get(n, 0.0) for r in anomalous.readings] for n in watchdog.sensors]
    sensors.stackplot(range(last + 1), shares, labels=watchdog.sensors, alpha=0.8)
    sensors.set(xlabel="step", ylabel="share of the evidence", ylim=(0, 1))
    sensors.legend(loc="upper left", fontsize="small")
    # The pole soon falls far outside: what matters is where the threshold is passed.
    below.set(ylabel="statistic, alarm at ▾", yscale="symlog")
    above.set(ylabel="score", yscale="symlog")
    handles = {
        label: line
        for axes in (above, below)
        for line, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(path, dpi=120)


def picture(axes, seen, t):
    """Show the robot at a step, framed in red while there is an alarm."""
    alarm = seen.readings[t].alarm
    axes.imshow(seen.frames[t])
    axes.set(xticks=[], yticks=[])
    axes.set_title(f"step {t}{': alarm' if alarm else ''}", color="C3" if alarm else "black")
    axes.spines[:].set(color="C3" if alarm else "0.8", linewidth=3 if alarm else 1)


def animate(path, watchdog, onset, seen, every=5):
    """Write a GIF of the robot with the statistic and the sensors beside it."""
    from matplotlib.animation import FuncAnimation, PillowWriter  # noqa: PLC0415  as above
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(8, 3.6))
    grid = {"left": 0.02, "right": 0.98, "width_ratios": (1, 0.5, 0.7), "hspace": 0.5}
    shown = figure.subplot_mosaic(
        [["robot", ".", "trace"], ["robot", ".", "bars"]], gridspec_kw=grid
    )
    robot, trace, bars = shown.values()
    threshold, last = (
        watchdog.rule.threshold,
        min(len(seen.readings), (seen.alarms or [onset])[0] + 60),
    )
    heights = np.clip(seen.statistic, -threshold, 3 * threshold)
    (line,) = trace.plot([])
    trace.axhline(threshold, color="0.3", linestyle=":")
    trace.axvline(onset, color="C3", linestyle="--")
    trace.set(xlim=(0, last), ylim=(-1.05 * threshold, 3.15 * threshold), title="statistic")
    lengths = bars.barh(watchdog.sensors, np.zeros(len(watchdog.sensors)))
    bars.set(xlim=(0, 1), title="share of the evidence")

    def one(t):
        robot.clear()
        picture(robot, seen, t)
        line.set_data(np.arange(t + 1), heights[: t + 1])
        reading = seen.readings[t]
        for name, bar in zip(watchdog.sensors, lengths, strict=True):
            bar.set(width=reading.sensors.get(name, 0.0), color="C3" if reading.alarm else "0.7")

    movie = FuncAnimation(figure, one, frames=range(0, last, every))
    movie.save(path, PillowWriter(fps=50 // every), dpi=80)


def main(arguments=None):
    """Prepare, run a nominal and a changed episode, and say what was noticed when."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--detector", default="panel", help="any detector (default: panel)")
    parser.add_argument("--level", type=float, default=0.1, help="share of nominal episodes")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--onset", type=int, default=150)
    parser.add_argument("--fit", type=Path, metavar="FILE", help="keep the watchdog here")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="write a figure")
    parser.add_argument("--gif", type=Path, metavar="FILE", help="write a film")
    parser.add_argument("--monitor", action="store_true", help="show the readings as they come")
    options = parser.parse_args(arguments)
    watchdog = prepare(options.detector, options.level, options.fit)
    print(watchdog.promise)
    policy = load_policy("cartpole")
    episode = {"seed": options.seed, "steps": options.steps}
    print("nominal episode")
    nominal = run(watchdog, policy, **episode)
    print(f"the pole gets heavier and longer at step {options.onset}")
    monitor = TerminalMonitor(options.detector) if options.monitor else contextlib.nullcontext()
    with monitor as shown:
        anomalous = run(
            watchdog,
            policy,
            **episode,
            onset=options.onset,
            render=bool(options.plot or options.gif),
            show=shown and shown.update,
        )
    micros = 1e6 * np.median(anomalous.seconds)
    print(f"{len(anomalous.readings)} observations, {micros:.0f} µs for a step and its reading")
    if options.plot:
        draw(options.plot, watchdog, options.onset, anomalous, nominal)
        print(f"figure in {options.plot}")
    if options.gif:
        animate(options.gif, watchdog, options.onset, anomalous)
        print(f"film in {options.gif}")
    return nominal, anomalous


if __name__ == "__main__":
    main()
