"""The page of an environment: what it is, its sensors and actions, what can befall it.

``oodd-eval data page`` writes the page of any registered environment. The benchmark's own pages say
more (``docs/figures/environments.py``).
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from oodd_eval.data.condition import FRACTIONS, Rung, all_rungs_of, ladder_of, rungs_of
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, Quantity
from oodd_eval.data.files import write_bytes, write_text
from oodd_eval.data.registry import AnomalySpec, anomaly_spec, environment_spec
from oodd_eval.names import check_known
from oodd_recording.calibrate import setup_of
from oodd_recording.closed_loop import record_anomalous
from oodd_recording.pictures import frame, pictured_twin, plot
from oodd_recording.policies import CustomPolicy
from oodd_recording.registered import MEASURED, info_of, kinds_of
from oodd_recording.values import SENSOR_SHARE, bound_of, spread_of, unit_of

PICTURED: Final = ("kept75", "loss25")
"""The rung of a plotted episode, or the strongest where the bound costs less."""

PART: Final = 0.25
"""Of the bound: the strength of a plotted episode of a kind that is not calibrated."""

_TASKS: Final = {
    "return": "return, the sum of rewards",
    "loss": "loss, 1 - reward in a row, and 1 in each row after an early end",
}
LEVELS: Final = {
    "return": "A rung is a strength at which the policy keeps that share of its return; `4th`, "
    "`16th` and `64th`\nare these parts of the strength of `kept99`, and cost nothing yet.",
    "loss": "A rung is a strength at which the loss after the onset, from row 60 on, grows by that "
    "share.",
}
INTERVALS: Final = {
    "return": "Intervals are 95 %: of the strength at which the share is kept, and\nof the share "
    "that is kept at the strength.",
    "loss": "Intervals are\n95 %: of the strength at which it grows so, and of the growth at the "
    "strength.",
}
_PLOTS: Final = (
    "A plot shows one sensor of an episode (orange) and of its nominal twin (grey) around the "
    "onset: of\nthe sensors that may have changed, the one that differs most. A dot marks the end "
    "of the episode."
)
_NO_PLOTS: Final = (
    "Its simulator was not installed where this page was built: episodes are not plotted."
)
_NOISE: Final = (
    " The noise is\nthe standard deviation of what is added to each row before the controller sees "
    "it."
)


class Page:
    """The page of an environment as Markdown, and its pictures.

    Parameters
    ----------
    environment
        Name of a registered environment. Its sensors are measured, where they are not known, in ten
        nominal episodes.
    kinds
        Kinds of anomalies to describe; by default those of the environment's ladder, and those of
        plug-ins that can be recorded in it.
    links
        A line of Markdown below the numbers of the environment.

    Raises
    ------
    UnknownNameError
        Where there is no such environment, or a kind cannot be recorded in it.
    """

    def __init__(self, environment: str, kinds: Iterable[str] = (), links: str = "") -> None:
        self.environment, self.links = environment, links
        self.info, self.spec = info_of(environment), environment_spec(environment)
        self.setup = setup_of(environment)
        self.ladder = ladder_of(environment)
        possible = sorted(kinds_of(environment), key=lambda kind: kind in ANOMALIES)
        default = [kind for kind in possible if kind in self.ladder or kind not in ANOMALIES]
        self.kinds = list(kinds) or default
        check_known(f"anomaly that {environment} can have", possible, *self.kinds)
        self.further = [kind for kind in possible if kind not in self.kinds]

    # What is asked of a page

    def text(self, pictures: Collection[str] = ()) -> str:
        """Return the Markdown.

        Parameters
        ----------
        pictures
            Names of the files that `pictures` yielded; the page shows these.
        """
        lead, heading, sections = f"\n{self.description()}".partition("\n## ")
        alts = {"png": "a frame half-way through an episode", "svg": "a drawing"}
        files = ((f"{self.environment}.{suffix}", alt) for suffix, alt in alts.items())
        parts = [
            f"# {self.info.title}",
            *(f"![{self.info.title}: {alt}]({name})" for name, alt in files if name in pictures),
            lead.strip(),
            table(self.facts(), ("", f"`{self.environment}`")),
            self.links,
            f"{heading}{sections}".strip(),
            *self._columns(),
            *(self._anomalies(pictures) if self.kinds else ()),
        ]
        return "\n\n".join(filter(None, parts)) + "\n"

    def pictures(self) -> Iterator[tuple[str, bytes]]:
        """Draw the picture of the environment, where there is one, and a plot of each kind.

        Yields
        ------
        tuple
            The name of a file, relative to the page, and its content.
        """
        twin = pictured_twin(self.setup)
        image = self.spec.picture() if self.spec.picture else frame(self.environment, twin)
        if isinstance(image, str):
            yield f"{self.environment}.svg", image.encode()
        elif image is not None:
            yield f"{self.environment}.png", image
        for kind in self.kinds:
            name, strength = self.pictured(kind)
            episode = record_anomalous(self.setup, kind, strength, twin)
            drawn = plot(self.environment, f"{kind} at {name} ({strength:g})", episode, twin)
            yield f"{self.environment}/{kind}.svg", drawn.encode()

    def pictured(self, kind: str) -> tuple[str, float]:
        """Return the name of a strength, and the strength, of the episode that is plotted."""
        if kind not in self.ladder:
            return "a quarter of its bound", PART * bound_of(self.environment, kind)
        rungs = rungs_of(self.environment, kind)
        name = next((name for name in PICTURED if name in rungs), [*rungs][-1])
        return name, rungs[name].strength

    # What some pages say in words of their own

    def description(self) -> str:
        """Return what the environment is, as Markdown; sections of it follow the table of facts."""
        return self.spec.description

    def facts(self) -> Iterable[Sequence[Any]]:
        """Return the rows of the first table."""
        yield "longest episode", f"{self.info.episode_cap} steps"
        yield "task", _TASKS[self.spec.task]
        if packages := ", ".join(f"{name} {version(name)}" for name in self.spec.packages):
            yield "simulated by", packages
        policy = self.setup.policy
        if isinstance(policy, CustomPolicy):
            yield "controller", f"code{', with memory' if policy.has_memory else ''}"
        else:
            yield "controller", f"policy file `{Path(str(self.spec.policy)).name}`"

    def headline(self, kind: str) -> str:
        """Return the first paragraph on a kind of anomaly."""
        spec = anomaly_spec(kind)
        title = ANOMALIES[kind].title if kind in ANOMALIES else kind.replace("-", " ").capitalize()
        summary = f"{spec.summary[:1].upper()}{spec.summary[1:]}".removesuffix(".")
        return f"**{title}**, {spec.group}. {' '.join([f'{summary}.', *_course(spec)])}"

    def notes(self, kind: str) -> list[str]:
        """Return further paragraphs on a kind, which stand before its strengths."""
        del kind
        return []

    def levels(self) -> str:
        """Return the paragraph that says what rungs are."""
        return f"{LEVELS[self.spec.task]} {INTERVALS[self.spec.task]}"

    # Sections

    def _columns(self) -> Iterator[str]:
        """Return the sections on sensors and actions."""
        sensors, spread = self.info.sensors, spread_of(self.environment)
        breakable = MEASURED[self.environment].sensors
        columns = _quantities("sensor", sensors)
        if any(sensor.role != "measured" for sensor in sensors):
            columns["role"] = [sensor.role for sensor in sensors]
        noise = [f"{sensor.noise:g}" if sensor.noise else "" for sensor in sensors]
        if any(noise):
            columns["noise"] = noise
        columns["spread"] = [f"{spread[i]:.3g}" for i in range(len(sensors))]
        columns["may break"] = ["yes" if i in breakable else "" for i in range(len(sensors))]
        yield "## Sensors"
        yield table(zip(*columns.values(), strict=True), tuple(columns))
        count = max(1, int(SENSOR_SHARE * len(sensors)))
        whose = "" if self.environment in ENVIRONMENTS else " of the benchmark"
        yield (
            "The unit is what the number 1 means; the spread is the standard deviation in nominal "
            f"operation. A\nsensor anomaly{whose} corrupts {count} of those that may break, drawn "
            f"for each episode.{_NOISE if any(noise) else ''}"
        )
        columns = _quantities("action", self.info.actions)
        if scaled := not self.info.discrete and {*zip(*self.info.limits, strict=True)} != {(-1, 1)}:
            limits = zip(("low", "high"), self.info.limits, strict=True)
            columns |= {name: [f"{end:g}" for end in ends] for name, ends in limits}
        yield "## Actions"
        yield table(zip(*columns.values(), strict=True), tuple(columns))
        if self.info.discrete:
            yield "One of them is chosen in each step; in trajectories it is a one-hot row."
        else:
            yield f"All of them are commanded in each step{'' if scaled else ', from -1 to 1'}."

    def _anomalies(self, pictures: Collection[str]) -> Iterator[str]:
        """Return the sections on anomalies."""
        plots = {kind: f"{self.environment}/{kind}.svg" for kind in self.kinds}
        yield "## Anomalies"
        if self.ladder:
            yield self.levels()
        yield _PLOTS if {*plots.values()} & {*pictures} else _NO_PLOTS
        if self.further and self.environment not in ENVIRONMENTS:
            names = ", ".join(f"`{kind}`" for kind in self.further)
            yield f"These kinds can be recorded as well: {names}."
        for kind in self.kinds:
            yield from self._kind(kind)
            if plots[kind] in pictures:
                name, strength = self.pictured(kind)
                about = f"One sensor of an episode under {kind} at {name} ({strength:g})"
                yield f"![{about}, and of its twin]({plots[kind]})"

    def _kind(self, kind: str) -> Iterator[str]:
        """Return the section on a kind of anomaly."""
        yield f"### {kind}"
        yield self.headline(kind)
        yield from self.notes(kind)
        unit, bound = unit_of(self.environment, kind), bound_of(self.environment, kind)
        yield f"Strength: {unit}; at most {bound:g}."
        if kind in self.ladder:
            cost = "return kept" if self.spec.task == "return" else "growth of the loss"
            rungs = all_rungs_of(self.environment, kind)
            rows = [_rung(name, rung, self.spec.task) for name, rung in rungs.items()]
            yield table(rows, ("rung", "strength", cost, "reached"))


def _quantities(kind: str, quantities: Sequence[Quantity]) -> dict[str, Sequence[Any]]:
    """Return the columns of a table with numbers, names and units."""
    units = ["" if quantity.unit == "1" else quantity.unit for quantity in quantities]
    names = [quantity.name for quantity in quantities]
    return {"": range(len(names)), kind: names, "unit": units}


def _course(spec: AnomalySpec) -> Iterator[str]:
    """Return sentences on how an anomaly changes in time."""
    if spec.ramp:
        yield f"It grows to its strength over {spec.ramp} rows."
    if spec.pulses:
        yield f"It is on for {spec.pulses[0]} rows and off for {spec.pulses[1]}, again and again."
    if spec.lasts:
        yield f"It ends after {spec.lasts} rows."


def _rung(name: str, rung: Rung, task: str) -> Sequence[str]:
    """Return a row of the table of strengths."""
    if name in FRACTIONS:
        return f"`{name}`", f"{rung.strength:g}", "", ""
    interval = f" ({rung.low:g} to {rung.high:g})" if rung.low < rung.high else ""
    shares = rung.kept, rung.kept_low, rung.kept_high
    cost, low, high = (f"{100 * x:.0f}" for x in shares)
    if task == "loss":  # of which little grows much: tenths of a percent count
        grown = (1 - rung.kept, 1 - rung.kept_high, 1 - rung.kept_low)
        cost, low, high = (f"{round(100 * x, 1) + 0:g}" for x in grown)
    reached = "yes" if rung.reached else "no: this is the largest"
    return f"`{name}`", f"{rung.strength:g}{interval}", f"{cost} % ({low} to {high})", reached


def table(rows: Iterable[Sequence[Any]], header: Sequence[str]) -> str:
    """Return a table as Markdown."""
    lines = (header, ["---"] * len(header), *rows)
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


def write_page(
    page: Page, directory: Path, progress: Callable[[str], None] = lambda _text: None
) -> Path:
    """Write a page and its pictures into a directory; the same versions write the same bytes.

    Parameters
    ----------
    page
        The page, which becomes ``ENVIRONMENT.md``; a plot is ``ENVIRONMENT/KIND.svg``.
    directory
        Made if it is not there.
    progress
        Called with the name of each picture when it is written.

    Returns
    -------
    pathlib.Path
        The page.
    """
    pictures = []
    for name, content in page.pictures():
        write_bytes(directory / name, content)
        pictures.append(name)
        progress(name)
    path = directory / f"{page.environment}.md"
    write_text(path, page.text(pictures))
    return path
