"""A detector beside a running controller: one score per observation, an alarm as it happens.

``python examples/live_alarm.py --detector riqn --plot alarm.png`` (extras reference, sim, plots).

A trained policy balances Gymnasium's CartPole. At an onset the dynamics change: the pole gets
heavier and longer. The detector is fitted on nominal trajectories of the mini split, and the
threshold of the CUSUM is chosen on calibration trajectories so that at most one nominal episode in
ten raises an alarm. With ``--fit DIR`` the fit is kept, and the next start takes no training.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field
from pathlib import Path

import gymnasium
import numpy as np

from oodd_eval import load_split
from oodd_eval.data.simulate.policies import load_policy
from oodd_eval.metrics.alarms import GuaranteedAlarm, Monitor
from oodd_eval.plugins.discovery import discover

HEAVIER = {"masspole": 0.4, "length": 1.0}
"""Values after the onset; nominally 0.1 kg and 0.5 m (half of the pole)."""


@dataclass
class Episode:
    """Results of one episode: a value per observation, times of alarms, seconds per score."""

    scores: list[float] = field(default_factory=list)
    statistic: list[float] = field(default_factory=list)
    alarms: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)


def prepare(name, level, place):
    """Return a fitted detector and the rule that alarms in at most this share of episodes."""
    data = load_split("mini").environment("cartpole")
    detector = discover().offer(name).spec.factory(seed=0, horizon=1)
    if place and place.exists():
        detector.load(place)
    else:
        detector.fit(list(data.train))
        if place:
            place.mkdir(parents=True)
            detector.save(place)
    calibration = [detector.score(trajectory) for trajectory in data.calibration]
    return detector, GuaranteedAlarm.fit(calibration, level)


def run(detector, rule, policy, *, seed, steps, onset=None, tell=print):
    """Control one episode with a monitor beside it; from the onset on the pole is heavier."""
    env = gymnasium.make("CartPole-v1")
    monitor, seen, action = Monitor(rule), Episode(), None
    detector.reset()
    observation, _ = env.reset(seed=seed)
    for t in range(steps + 1):
        commanded = None if action is None else np.eye(2, dtype=np.float32)[action]
        start = time.perf_counter()
        score = detector.update(observation, commanded)
        alarm = monitor.update(score)
        seen.seconds.append(time.perf_counter() - start)
        seen.scores.append(score)
        seen.statistic.append(monitor.statistic)
        if alarm and not seen.alarms:
            seen.alarms.append(t)
            when = "" if onset is None or t < onset else f", {t - onset} steps after the onset"
            tell(f"step {t}: alarm{when}")
        if onset is not None and t + 1 == onset:
            change(env.unwrapped)
        action = policy.act(observation)
        observation, _, over, _, _ = env.step(action)
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


def draw(path, name, rule, onset, anomalous, nominal):
    """Plot scores and CUSUM statistic of both episodes, the onset, the threshold and the alarms."""
    from matplotlib.figure import Figure  # noqa: PLC0415  only needed here, and slow to import

    figure = Figure(figsize=(9, 5), layout="constrained")
    above, below = figure.subplots(2, sharex=True)
    for seen, colour, label in ((nominal, "0.6", "nominal"), (anomalous, "C0", "heavier pole")):
        above.plot(seen.scores, color=colour, label=label)
        below.plot(seen.statistic, color=colour)
        below.plot(seen.alarms, [seen.statistic[t] for t in seen.alarms], "v", color=colour)
    for axes in (above, below):
        axes.axvline(onset, color="C3", linestyle="--", label="onset")
        axes.spines[["top", "right"]].set_visible(False)
    below.axhline(rule.threshold, color="0.3", linestyle=":", label="threshold")
    below.set(xlabel="step", ylabel="CUSUM statistic")
    above.set(ylabel="score", title=f"{name} beside a controller: CartPole, alarms at ▾")
    handles = {label: line for axes in (above, below)
               for line, label in zip(*axes.get_legend_handles_labels(), strict=True)}  # fmt: skip
    figure.legend(handles.values(), handles, loc="outside lower center", ncols=4, frameon=False)
    figure.savefig(path, dpi=120)


def main(arguments=None):
    """Prepare, run a nominal and a changed episode, and say what was noticed when."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--detector", default="riqn", help="one that streams (default: riqn)")
    parser.add_argument("--level", type=float, default=0.1, help="share of nominal episodes")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--onset", type=int, default=150)
    parser.add_argument("--fit", type=Path, metavar="DIR", help="keep the fit here")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="write a figure")
    options = parser.parse_args(arguments)
    detector, rule = prepare(options.detector, options.level, options.fit)
    policy = load_policy("cartpole")
    episode = {"seed": options.seed, "steps": options.steps}
    print("nominal episode")
    nominal = run(detector, rule, policy, **episode)
    print(f"the pole gets heavier and longer at step {options.onset}")
    anomalous = run(detector, rule, policy, **episode, onset=options.onset)
    micros = 1e6 * np.median(anomalous.seconds)
    print(f"{len(anomalous.scores)} observations, {micros:.0f} µs from observation to decision")
    if options.plot:
        draw(options.plot, options.detector, rule, options.onset, anomalous, nominal)
        print(f"figure in {options.plot}")
    return nominal, anomalous


if __name__ == "__main__":
    main()
