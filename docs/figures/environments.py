"""Build the pages on environments and the tables of the page "Environments and anomalies".

The documents' site builds them (``docs/hooks.py``), and they are not committed.
``python docs/figures/environments.py [DIRECTORY]`` writes the pages with their pictures, by default
to ``docs/environments``. A page is what ``oodd-eval data page`` writes. Pages of the benchmark also
say what the paper has, and what only a person can write, from ``environments.toml``.
"""

import argparse
import json
import re
import tomllib
from collections.abc import Container, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from oodd_recording.benchmark import FROZEN
from oodd_recording.page import INTERVALS, LEVELS, Page, table
from oodd_recording.values import VALUES, spread_of
from oodd_worlds import oodd_anomalies, oodd_environments

from oodd_eval.data.condition import PAPER, ROBOTS_CAP, RUNGS, WHOLE, ladder_of, rungs_of
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, TABLE1, WORLDS
from oodd_eval.data.files import write_bytes
from oodd_eval.data.registry import AnomalySpec, environment_spec, register, registered
from oodd_eval.errors import MissingExtraError

NAME: Final = "environments"
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


def built(environments: Iterable[str] = (*ENVIRONMENTS, *WORLDS)) -> Iterator[tuple[str, bytes]]:
    """Build pages and their pictures.

    Yields
    ------
    tuple
        The name of a file, relative to ``docs/environments``, and its content. A page has no
        pictures where its simulator is not installed, as PyBullet on newer Pythons.
    """
    for environment in environments:
        page = page_of(environment)
        try:
            pictures = dict(page.pictures())
        except MissingExtraError:
            pictures = {}
        yield f"{environment}.md", page.text(pictures).encode()
        yield from pictures.items()


def page_of(environment: str) -> Page:
    """Return the page of an environment of the benchmark, or of a world."""
    if environment in ENVIRONMENTS:
        return BenchmarkPage(environment)
    _register_worlds()
    return Page(environment, links=LINKS)


def _register_worlds() -> None:
    register([*oodd_environments(), *oodd_anomalies()])


def with_tables(text: str, pictures: Container[str] = ()) -> str:
    """Return the text of ``docs/environments.md`` with its tables.

    Parameters
    ----------
    text
        Markdown with marks such as ``<!-- built: strengths -->``.
    pictures
        Names of the files of `built`; the tables show frames and drawings among these.
    """
    _register_worlds()
    tables = {
        "environments": lambda: _environments(pictures),
        "kinds": _kinds,
        "strengths": _strengths,
        "worlds": lambda: _worlds(pictures),
        "kinds of worlds": _kinds_of_worlds,
    }
    return re.sub("<!-- built: ([a-z ]+) -->", lambda match: tables[match[1]](), text)


def _image(name: str, alt: str, pictures: Container[str]) -> str:
    return f'<img src="{NAME}/{name}" alt="{alt}" width="160">' if name in pictures else ""


def _environments(pictures: Container[str]) -> str:
    rows = [
        (
            f"[{e}]({NAME}/{e}.md)",
            _image(f"{e}.png", f"{i.title}: a frame", pictures),
            *_returns(e),
            i.observation_dim,
            f"{i.action_dim}{', one a step' * i.discrete}",
        )
        for e, i in ENVIRONMENTS.items()
    ]
    return table(rows, ("environment", "", "return", "the paper's", "sensors", "actions"))


def _kinds() -> str:
    rows = [(f"`{k}`", a.title, a.group, a.summary) for k, a in ANOMALIES.items()]
    return table(rows, ("kind", "name", "group", "what it does"))


def _strengths() -> str:
    rows = [(f"`{k}`", *(_strength(e, k, OVERVIEW_RUNG) for e in ENVIRONMENTS)) for k in ANOMALIES]
    return table(rows, ("kind", *ENVIRONMENTS))


def _worlds(pictures: Container[str]) -> str:
    rows = [
        (
            f"[{s.name}]({NAME}/{s.name}.md)",
            _image(f"{s.name}.svg", f"{s.title}: a drawing", pictures),
            sum(sensor.measured for sensor in s.sensors),
            len(s.actions),
        )
        for s in map(environment_spec, WORLDS)
    ]
    return table(rows, ("world", "", "measured sensors", "actions"))


def _kinds_of_worlds() -> str:
    rows = [
        (f"`{k.name}`", world, k.group, k.summary, _strength(world, k.name, WORLDS_RUNG))
        for world in WORLDS
        for k in registered()
        if isinstance(k, AnomalySpec) and (k.environments == (world,) or k.name in ladder_of(world))
    ]
    return table(rows, ("kind", "world", "group", "what it does", "strength"))


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
    default = Path(__file__).parents[1] / NAME
    parser.add_argument("directory", type=Path, nargs="?", default=default)
    directory = parser.parse_args().directory
    for name, content in built():
        write_bytes(directory / name, content)
        print(directory / name)
