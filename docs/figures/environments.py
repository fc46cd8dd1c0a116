"""Write the pages "Environments and anomalies": an overview, and a page for each environment.

``python docs/figures/environments.py [DIRECTORY]`` writes them, here unless told otherwise. A page
is what ``oodd-eval data page`` writes; those of the benchmark also say what the paper has, and what
only a person can write, from ``environments.toml``.
"""

import argparse
import json
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from oodd_recording.benchmark import FROZEN
from oodd_recording.page import INTERVALS, LEVELS, Page, table, write_page
from oodd_recording.values import VALUES, spread_of
from oodd_worlds import oodd_anomalies, oodd_environments

from oodd_eval.data.condition import PAPER, ROBOTS_CAP, RUNGS, WHOLE, ladder_of, rungs_of
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, TABLE1, WORLDS
from oodd_eval.data.files import write_text
from oodd_eval.data.registry import AnomalySpec, environment_spec, register, registered

NAME: Final = "environments"
COMMAND: Final = "python docs/figures/environments.py"
OVERVIEW_RUNG: Final = "kept90"
WORLDS_RUNG: Final = "loss10"
LINKS: Final = f"""[All environments and kinds](../{NAME}.md) ·
[how strengths are found](../data.md#anomalies-of-graded-strength)"""

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
    environments: Iterable[str] = (*ENVIRONMENTS, *WORLDS),
    progress: Callable[[str], None] = lambda _text: None,
) -> None:
    """Write the overview, ``environments.md``, and the pages with their pictures below it.

    The overview names all environments; `progress` is called with the name of each when its files
    are written.
    """
    write_text(directory / f"{NAME}.md", overview())
    for environment in environments:
        write_page(page_of(environment), directory / NAME)
        progress(environment)


def page_of(environment: str) -> Page:
    """Return the page of an environment of the benchmark, or of a world."""
    if environment in ENVIRONMENTS:
        return BenchmarkPage(environment)
    _register_worlds()
    return Page(environment, links=LINKS)


def _register_worlds() -> None:
    register([*oodd_environments(), *oodd_anomalies()])


def overview() -> str:
    """Return the text of ``environments.md``."""
    _register_worlds()
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
    strengths = [
        (f"`{k}`", *(_strength(e, k, OVERVIEW_RUNG) for e in ENVIRONMENTS)) for k in ANOMALIES
    ]
    columns = ("environment", "", "return", "the paper's", "sensors", "actions")
    return f"""# Environments and anomalies

There are {len(ENVIRONMENTS)} environments with a trained policy each, and {len(ANOMALIES)} kinds of
anomalies. Each environment has a page: its sensors and actions, and for each kind what it does
there, its strengths, what they cost the policy, and an episode beside its twin. These pages are
written by `{COMMAND}`.

## Environments

{table(environments, columns)}

Returns are means over 100 episodes of the frozen policy, with their standard deviation; the
paper's are those of its Table 2. Frames are half-way through an episode.

## Kinds of anomalies

The first {len(TABLE1)} are the paper's. A sensor anomaly corrupts what sensors say, and the policy
acts on it; an anomaly of the dynamics changes what happens. Both begin at an onset and last to the
end.

{table(kinds, ("kind", "name", "group", "what it does"))}

## Strengths

The strength at which the policy keeps 90 % of its return (`{OVERVIEW_RUNG}`), linked to all that is
known of the kind there; `> 1` where the largest sensible strength, 1, costs less. Where a ladder
has no rung of that name, as the next weaker one costs more already, that one is shown. Units differ
between kinds, and some between environments; they stand on the pages.

{table(strengths, ("kind", *ENVIRONMENTS))}

{_worlds()}"""


def _worlds() -> str:
    """Return the section on the worlds of the overview."""
    specs = [environment_spec(world) for world in WORLDS]
    worlds = [
        (
            f"[{s.name}]({NAME}/{s.name}.md)",
            f'<img src="{NAME}/{s.name}.svg" alt="{s.title}: a drawing" width="160">',
            sum(sensor.role == "measured" for sensor in s.sensors),
            len(s.actions),
        )
        for s in specs
    ]
    kinds = [
        (f"`{k.name}`", world, k.group, k.summary, _strength(world, k.name, WORLDS_RUNG))
        for world in WORLDS
        for k in registered()
        if isinstance(k, AnomalySpec) and (k.environments == (world,) or k.name in ladder_of(world))
    ]
    return f"""## Worlds

{len(WORLDS)} environments of the plug-in `oodd_worlds`, with classical controllers, noisy sensors
and parameters that differ from episode to episode. The strength is that at which the task's loss
grows by a tenth (`{WORLDS_RUNG}`).

{table(worlds, ("world", "", "measured sensors", "actions"))}

{table(kinds, ("kind", "world", "group", "what it does", "strength"))}
"""


class BenchmarkPage(Page):
    """The page of an environment of the benchmark, with what the paper says of it."""

    def __init__(self, environment: str) -> None:
        super().__init__(environment, ANOMALIES, LINKS)

    def description(self) -> str:
        """Return the task, the reward and the end of an episode."""
        text: str = _WORDS["environment"][self.environment]
        return text

    def facts(self) -> Iterator[Sequence[Any]]:
        """Return the rows of the first table, with the policy's return and the paper's."""
        ours, papers = _returns(self.environment)
        yield "simulator", f"`{self.info.simulator}`"
        yield "longest episode", f"{self.info.episode_cap} steps"
        yield "policy", self.info.policy
        yield "its mean return over 100 episodes", ours
        yield "that of the paper's policy", papers

    def headline(self, kind: str) -> str:
        """Return what a kind means in this environment."""
        info = ANOMALIES[kind]
        title = f"**{info.title}**, {info.group}{', of the paper' if kind in TABLE1 else ''}."
        return f"{title} {_meaning(self.environment, kind)}"

    def notes(self, kind: str) -> list[str]:
        """Return what the paper's Table 1 says."""
        if kind not in TABLE1:
            return []
        return [f"Table 1 of the paper: {table1_value(self.environment, kind)}."]

    def levels(self) -> str:
        """Return what rungs are, those of the paper's losses among them."""
        papers = f"At `{PAPER}` the policy loses\nwhat the paper's Table 2 says."
        text = f"{LEVELS['return']} {papers} {INTERVALS['return']}"
        if self.info.discrete:
            return text
        return (
            f"{text}\nThese strengths were measured in episodes of at most {ROBOTS_CAP} steps, "
            f"that of `{WHOLE}` in whole episodes."
        )


def _meaning(environment: str, kind: str) -> str:
    base = kind.removesuffix("-intermittent")
    known = _WORDS["kind"]["wind-l2r" if base == "wind" else base]
    family = "discrete" if ENVIRONMENTS[environment].discrete else "continuous"
    text: str = known.get(environment) or known.get(family) or known["all"]
    return text if kind == base else f"{text} On for 10 rows, off for 40, from the onset on."


def _strength(environment: str, kind: str, name: str) -> str:
    """Return the strength of a rung, linked to all that is known of the kind."""
    ladder = ladder_of(environment)
    if kind not in ladder:
        return "not calibrated"
    rungs, bound = rungs_of(environment, kind), ladder[kind]["bound"]
    # Levels with the same strength share the rung of the first of them.
    shared = [n for n in RUNGS[: RUNGS.index(name) + 1] if n in rungs][-1]
    strength = rungs[shared].strength
    reached = rungs[shared].reached and (shared == name or strength < bound)
    text = f"{strength:.3g}" if reached else f"> {bound:g}"
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


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("directory", type=Path, nargs="?", default=Path(__file__).parents[1])
    write_pages(parser.parse_args().directory, progress=print)
