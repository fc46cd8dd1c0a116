"""Which parts are named: recall and precision at a detector's guaranteed alarm, and rows later.

``python benchmarks/naming.py SPLIT [--env NAMES] [--detector panel-a] [--level 0.05]
[--kept results/naming]``, a minute an environment. Fits of the detector are kept in that directory.

By environment and kind of anomaly, of the anomalous episodes with an alarm from the effect on: mean
recall and pooled precision of the faulty sensors that `PartNamer` names at that alarm, 5 and 20
rows later (at the end of shorter episodes), the median distance of its onset at the alarm from the
effect in rows, and the share whose kind of part is right at the alarm. Beside them what as many
sensors have that are drawn at random (*chance*, precision) or read farthest from their mean
(*largest*, recall), both as many as are faulty. Faulty actuators are counted like sensors. Where no
part is faulty the number of parts named stands in place of recall and precision. *Nominal* are six
rows of each twin at random.
"""

import argparse
from pathlib import Path

import numpy as np
from oodd_common.naming import PartNamer
from oodd_panel import make_panel
from tabulate import tabulate

from oodd_eval import load_split
from oodd_eval.metrics.alarms import Calibration
from oodd_eval.names import select
from oodd_eval.plugins.state import pack, read_state, write_state

LATER = (0, 5, 20)
SHOWN = 6


def detector_of(name, data, file):
    """Return a fitted panel, kept or new."""
    detector = make_panel(name, seed=0)
    if file.exists():
        detector.restore(read_state(file).state())
    else:
        see = lambda x: x if name.endswith("-a") else x.without_actions()  # noqa: E731
        detector.fit([see(x) for x in data.train])
        file.parent.mkdir(parents=True, exist_ok=True)
        write_state(file, pack(detector.state()))
    return detector


def namings(namer, x, rows):
    """Return the namings and onsets as seen at some rows of an episode."""
    live, named = namer.begin(), {}
    for t, row in enumerate(x.observations[: max(rows) + 1]):
        live.update(row, x.actions[t - 1] if t else None)
        if t in rows:
            named[t] = live.name()
    return [named[t] for t in rows]


def parts(naming):
    """Return the numbers of the parts named; actuators stand behind the sensors."""
    probability = np.concatenate([naming.sensors, naming.actuators])
    return {int(p) for p in np.flatnonzero(probability >= 0.5)}


def measured(namer, x, alarm, effect, parameters, group):
    """Return the facts of one episode with an alarm."""
    d, rows = x.observation_dim, [min(alarm + k, x.transitions) for k in LATER]
    actuator = parameters.get("actuator")
    faulty = {int(s) for s in parameters.get("sensors", ())}
    if isinstance(actuator, (int, float)):
        faulty.add(d + int(actuator))
    named = namings(namer, x, rows)
    scale = namer.model.sensors
    standard = np.abs((x.observations[alarm] - scale.mean) / scale.std)
    largest = {int(s) for s in np.argsort(-standard)[: len(faulty)]}
    right = "sensor" if group == "sensor" else "actuator" if actuator is not None else ""
    kind = named[0][0].kind
    return {
        "faulty": faulty,
        "named": [parts(naming) for naming, _ in named],
        "largest": len(largest & faulty) / len(faulty) if faulty else np.nan,
        "chance": len(faulty) / (d + x.action_dim),
        "onset": abs(named[0][1] - effect),
        "kind": kind == right if right else kind in ("body", "environment"),
    }


def columns(episodes):
    """Return the cells of a row of the table."""
    cells = []
    for k in range(len(LATER)):
        named = [e["named"][k] for e in episodes]
        hits = [len(n & e["faulty"]) for n, e in zip(named, episodes, strict=True)]
        count = sum(map(len, named))
        if not all(e["faulty"] for e in episodes):
            cells.append(f"{count / len(episodes):.1f} named")
            continue
        recall = np.mean([h / len(e["faulty"]) for h, e in zip(hits, episodes, strict=True)])
        cells.append(f"{100 * recall:.0f} / {100 * sum(hits) / max(count, 1):.0f}")
    means = [100 * np.mean([e[key] for e in episodes]) for key in ("chance", "largest", "kind")]
    chance, largest, kind = (f"{mean:.0f}" for mean in means)
    if not all(e["faulty"] for e in episodes):
        chance = largest = ""
    onset = f"{np.median([e['onset'] for e in episodes]):.0f}"
    return [len(episodes), *cells, chance, largest, onset, kind]


def table_of(environment, split, detector_name, level, kept):
    """Return the rows of the table for one environment."""
    data = split.environment(environment)
    file = kept / f"{split.name}-{split.digest[:12]}-{environment}-{detector_name}.npz"
    detector, namer = detector_of(detector_name, data, file), PartNamer.fit(list(data.train))
    rule = Calibration.fit([detector.score(x) for x in data.calibration], "score").rule(level)
    rows = []
    for condition in split.conditions(environment):
        test, episodes = data.anomalous(condition), []
        group = split.groups[condition.anomaly]
        for x, effect, parameters in zip(test, test.effects, test.parameters, strict=True):
            above = rule.statistic(detector.score(x)) > rule.threshold
            alarms = np.flatnonzero(above[effect:]) + effect
            if len(alarms):
                fact = measured(namer, x, int(alarms[0]), int(effect), parameters, group)
                episodes.append(fact)
        if episodes:
            rows.append([environment, str(condition), *columns(episodes)])
    rng, counts = np.random.default_rng(0), []
    for x in data.twins:
        at = rng.integers(2, len(x), SHOWN).tolist()
        counts += [len(parts(naming)) for naming, _ in namings(namer, x, at)]
    rows.append([environment, "nominal", len(counts), f"{np.mean(counts):.1f} named"])
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("split")
    parser.add_argument("--env", default="all")
    parser.add_argument("--detector", default="panel-a", choices=("panel", "panel-a"))
    parser.add_argument("--level", type=float, default=0.05)
    parser.add_argument("--kept", type=Path, default=Path("results/naming"))
    options = parser.parse_args()
    split = load_split(options.split)
    head = ["environment", "kind", "alarms", *(f"+{k}" for k in LATER)]
    head += ["chance", "largest", "onset", "kind right"]
    rows = []
    for environment in select("environment", options.env, split.environments):
        rows += table_of(environment, split, options.detector, options.level, options.kept)
    print(tabulate(rows, head, tablefmt="github"))


if __name__ == "__main__":
    main()
