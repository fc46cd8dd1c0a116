"""Write the pages "Environments and anomalies": an overview, and a page for each environment.

``python docs/figures/environments.py [DIRECTORY]`` writes them, here unless told otherwise. Numbers
are those of the facts, of the frozen policies and of ``ladder.json``; the words that only a person
can write are in ``environments.toml``. Texts need no simulation, so that a test can compare them.
"""

import argparse
import json
import tomllib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Final

from oodd_recording.benchmark import FROZEN
from oodd_recording.values import SENSOR_SHARE, VALUES, bound_of, spread_of, unit_of

from oodd_eval.data.condition import (
    FRACTIONS,
    PAPER,
    ROBOTS_CAP,
    WHOLE,
    Rung,
    all_rungs_of,
    read_ladder,
    rungs_of,
)
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, TABLE1
from oodd_eval.data.files import write_bytes, write_text

NAME: Final = "environments"
COMMAND: Final = "python docs/figures/environments.py"
OVERVIEW_RUNG: Final = "kept90"
PICTURED: Final = "kept75"
"""The rung of the plotted episodes, or the strongest where the bound costs less."""

_WORDS: Final = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
_ATTRIBUTES: Final = {
    "link_length_1": "length of the inner link",
    "link_length_2": "length of the outer link",
    "link_mass_1": "mass of the inner link",
    "link_mass_2": "mass of the outer link",
    "pole_length": "half the pole's length",
    "pole_mass": "mass of the pole",
    "main_engine_power": "power of the main engine",
    "power": "motor power",
    "side_engine_power": "power of the side engines",
}


def write_pages(
    directory: Path,
    *,
    environments: Iterable[str] = tuple(ENVIRONMENTS),
    progress: Callable[[str], None] = lambda _text: None,
) -> None:
    """Write the overview, ``environments.md``, and the pages with their pictures below it.

    The same versions write the same bytes. The overview names all environments; `progress` is
    called with the name of each when its files are written.
    """
    # Texts alone need no simulators.
    from pictures import draw_pictures  # noqa: PLC0415

    write_text(directory / f"{NAME}.md", overview())
    for environment in environments:
        write_text(directory / NAME / f"{environment}.md", environment_page(environment))
        rungs = {kind: pictured(environment, kind) for kind in calibrated(environment)}
        for name, content in draw_pictures(environment, rungs):
            write_bytes(directory / NAME / name, content)
        progress(environment)


def calibrated(environment: str) -> list[str]:
    """Return the kinds whose strengths are known in an environment."""
    return [kind for kind in ANOMALIES if kind in read_ladder().get(environment, {})]


def pictured(environment: str, kind: str) -> tuple[str, float]:
    """Return the rung, and its strength, of the episode that is plotted for a kind."""
    rungs = rungs_of(environment, kind)
    name = PICTURED if PICTURED in rungs else list(rungs)[-1]
    return name, rungs[name].strength


def overview() -> str:
    """Return the text of ``environments.md``."""
    environments = [
        (
            f"[{e}]({NAME}/{e}.md)",
            f'<img src="{NAME}/{e}.png" alt="{i.title}: a frame" width="160">',
            *_returns(e),
            i.observation_dim,
            f"{i.action_dim}{', one a step' * i.discrete}",
        )
        for e, i in ENVIRONMENTS.items()
    ]
    kinds = [(f"`{k}`", a.title, a.group, a.summary) for k, a in ANOMALIES.items()]
    strengths = [(f"`{k}`", *(_overview_strength(e, k) for e in ENVIRONMENTS)) for k in ANOMALIES]
    columns = ("environment", "", "return", "the paper's", "sensors", "actions")
    return f"""# Environments and anomalies

There are {len(ENVIRONMENTS)} environments with a trained policy each, and {len(ANOMALIES)} kinds of
anomalies. Each environment has a page: its sensors and actions, and for each kind what it does
there, its strengths, what they cost the policy, and an episode beside its twin. These pages are
written by `{COMMAND}`.

## Environments

{_table(environments, columns)}

Returns are means over 100 episodes of the frozen policy, with their standard deviation; the
paper's are those of its Table 2. Frames are half-way through an episode.

## Kinds of anomalies

The first {len(TABLE1)} are the paper's. A sensor anomaly corrupts what sensors say, and the policy
acts on it; an anomaly of the dynamics changes what happens. Both begin at an onset and last to the
end.

{_table(kinds, ("kind", "name", "group", "what it does"))}

## Strengths

The strength at which the policy keeps 90 % of its return (`{OVERVIEW_RUNG}`), linked to all that is
known of the kind there; `> 1` where the largest sensible strength, 1, costs less. Units differ
between kinds, and some between environments; they stand on the pages.

{_table(strengths, ("kind", *ENVIRONMENTS))}
"""


def environment_page(environment: str) -> str:
    """Return the text of an environment's page."""
    info = ENVIRONMENTS[environment]
    ours, papers = _returns(environment)
    spread, breakable = spread_of(environment), VALUES["sensors"][environment]
    facts = [
        ("simulator", f"`{info.simulator}`"),
        ("longest episode", f"{info.episode_cap} steps"),
        ("policy", info.policy),
        ("its mean return over 100 episodes", ours),
        ("that of the paper's policy", papers),
    ]
    sensors = [
        (i, s.name, _unit(s.unit), f"{spread[i]:.3g}", "yes" if i in breakable else "")
        for i, s in enumerate(info.sensors)
    ]
    actions = [(i, a.name, _unit(a.unit)) for i, a in enumerate(info.actions)]
    count = max(1, int(SENSOR_SHARE * info.observation_dim))
    kinds = "\n\n".join(_kind(environment, kind) for kind in ANOMALIES)
    return f"""# {info.title}

![{info.title}: a frame half-way through an episode]({environment}.png)

{_WORDS["environment"][environment]}

{_table(facts, ("", f"`{environment}`"))}

[All environments and kinds](../{NAME}.md) ·
[how strengths are found](../data.md#anomalies-of-graded-strength)

## Sensors

{_table(sensors, ("", "sensor", "unit", "spread", "may break"))}

The unit is what the number 1 means; the spread is the standard deviation in nominal operation. A
sensor anomaly corrupts {count} of those that may break, drawn for each episode.

## Actions

{_table(actions, ("", "action", "unit"))}

{_ACTIONS[info.discrete]}

## Anomalies

A rung is a strength at which the policy keeps that share of its return; `4th`, `16th` and `64th`
are these parts of the strength of `kept99`, and cost nothing yet. At `{PAPER}` the policy loses
what the paper's Table 2 says. Intervals are 95 %: of the strength at which the share is kept, and
of the share that is kept at the strength.{_whole(environment)}

A plot shows one sensor of an episode (orange) and of its nominal twin (grey) around the onset: of
the sensors that may have changed, the one that differs most. A dot marks the end of the episode.

{kinds}
"""


def _whole(environment: str) -> str:
    """Return what a page says of the length of episodes."""
    if ENVIRONMENTS[environment].discrete:
        return ""
    return (
        f"\nThese strengths were measured in episodes of at most {ROBOTS_CAP} steps, that of "
        f"`{WHOLE}` in whole episodes."
    )


_ACTIONS: Final = {
    True: "One of them is chosen in each step; in trajectories it is a one-hot row.",
    False: "All of them are commanded in each step, from -1 to 1.",
}


def _kind(environment: str, kind: str) -> str:
    """Return the section of a kind of anomaly."""
    info = ANOMALIES[kind]
    title = f"**{info.title}**, {info.group}{', of the paper' if kind in TABLE1 else ''}."
    parts = [f"### {kind}", f"{title} {_meaning(environment, kind)}"]
    if kind in TABLE1:
        parts.append(f"Table 1 of the paper: {table1_value(environment, kind)}.")
    if kind not in calibrated(environment):
        return "\n\n".join([*parts, "Not calibrated."])
    unit, bound = unit_of(environment, kind), bound_of(environment, kind)
    parts.append(f"Strength: {unit}; at most {bound:g}.")
    rows = [_rung(name, rung) for name, rung in all_rungs_of(environment, kind).items()]
    parts.append(_table(rows, ("rung", "strength", "return kept", "reached")))
    name, strength = pictured(environment, kind)
    about = f"One sensor of an episode under {kind} at {name} ({strength:g}), and of its twin"
    return "\n\n".join([*parts, f"![{about}]({environment}/{kind}.svg)"])


def _meaning(environment: str, kind: str) -> str:
    base = kind.removesuffix("-intermittent")
    known = _WORDS["kind"]["wind-l2r" if base == "wind" else base]
    family = "discrete" if ENVIRONMENTS[environment].discrete else "continuous"
    text: str = known.get(environment) or known.get(family) or known["all"]
    return text if kind == base else f"{text} On for 10 rows, off for 40, from the onset on."


def _rung(name: str, rung: Rung) -> Sequence[str]:
    if name in FRACTIONS:
        return f"`{name}`", f"{rung.strength:g}", "", ""
    kept, low, high = (f"{100 * x:.0f}" for x in (rung.kept, rung.kept_low, rung.kept_high))
    interval = f" ({rung.low:g} to {rung.high:g})" if rung.low < rung.high else ""
    reached = "yes" if rung.reached else "no: this is the largest"
    return f"`{name}`", f"{rung.strength:g}{interval}", f"{kept} % ({low} to {high})", reached


def _overview_strength(environment: str, kind: str) -> str:
    if kind not in calibrated(environment):
        return "not calibrated"
    rung = rungs_of(environment, kind).get(OVERVIEW_RUNG)
    reached = rung is not None and rung.reached
    text = f"{rung.strength:.3g}" if rung and reached else f"> {bound_of(environment, kind):g}"
    return f"[{text}]({NAME}/{environment}.md#{kind})"


def table1_value(environment: str, kind: str) -> str:
    """Return what Table 1 of the paper says of a kind, and what strengths these are."""
    value: Any = VALUES.get("wind" if kind.startswith("wind") else kind, {}).get(environment)
    spread = spread_of(environment)[VALUES["sensors"][environment]]
    strengths: Any
    nominal = _WORDS["nominal"][environment]
    if kind == "iid":
        text = "noise of mean {:g} and standard deviation {:g} in the sensor's unit".format(*value)
        strengths = value[1] / spread
    elif kind == "calibration":
        text, strengths = f"a factor of {value:g}", [value - 1]
    elif kind == "drift":
        text, strengths = f"a slope of {value:g} per step in the sensor's unit", value / spread
    elif kind == "shutdown":
        text, strengths = "the sensor reads 0", [1.0]
    elif kind == "gravity":
        text = _range("gravity", value, nominal["gravity"])
        strengths = [x / nominal["gravity"] - 1 for x in value]
    elif kind == "components":
        text = "; ".join(_range(_ATTRIBUTES[n], x, nominal[n]) for n, x in value.items())
        changes = [(n, x / nominal[n] - 1) for n, both in value.items() for x in both]
        strengths = [-change if "power" in n else change for n, change in changes]
    elif ENVIRONMENTS[environment].discrete:
        text, strengths = f"a gust in a step with probability {value:g}", [value]
    else:
        sign = "added to" if kind == "wind-l2r" else "taken from"
        text, strengths = f"{value:g} {sign} every command", [value]
    both = dict.fromkeys(f"{x:.3g}" for x in (min(strengths), max(strengths)))
    return f"{text} (strength {' to '.join(both)})"


def _range(name: str, bounds: Sequence[float], nominal: float) -> str:
    values = " to ".join(dict.fromkeys(f"{x:g}" for x in bounds))
    return f"{name} {values}, nominally {nominal:g}"


def _returns(environment: str) -> tuple[str, str]:
    """Return the returns of our policy and the paper's, as text."""
    provenance: dict[str, Any] = json.loads((FROZEN / f"{environment}.json").read_text("utf-8"))
    ours = f"{provenance['mean_return']:.1f} ± {provenance['std_return']:.1f}"
    return ours, f"{ENVIRONMENTS[environment].paper_return:.1f}"


def _unit(unit: str) -> str:
    return "" if unit == "1" else unit


def _table(rows: Iterable[Sequence[Any]], header: Sequence[str]) -> str:
    lines = (header, ["---"] * len(header), *rows)
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("directory", type=Path, nargs="?", default=Path(__file__).parents[1])
    write_pages(parser.parse_args().directory, progress=print)
