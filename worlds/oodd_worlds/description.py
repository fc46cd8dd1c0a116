"""Descriptions of the worlds, for their pages: words, and all numbers with their sources."""

import itertools
from collections.abc import Iterable, Sequence
from typing import Any

from oodd_eval import Quantity
from oodd_worlds.facts import ASSUMED, HERE, Fact, read_world


def describe(name: str) -> str:
    """Return the description of a world as Markdown: the words of ``NAME.md``, then its numbers."""
    words, world = (HERE / f"{name}.md").read_text(encoding="utf-8").strip(), read_world(name)
    facts = [
        (f.name, "" if f.unit == "1" else f.unit, _value(f.value), _spread(f), _marked(f.source))
        for f in world.facts.values()
    ]
    noisy = [sensor for sensor in world.sensors if sensor.noise]

    def noise(sensor: Quantity) -> tuple[str, str, str]:
        return sensor.unit, f"{sensor.noise:g}", _marked(world.noise_sources[sensor.name])

    noises = [
        (", ".join(sensor.name for sensor in sensors), *row)
        for row, sensors in itertools.groupby(noisy, noise)
    ]
    return f"""{words}

## Numbers

{_table(("number", "unit", "value", "between episodes", "source"), facts)}

Between episodes a number is drawn anew: uniformly from one end to another, or normally with a
standard deviation in percent of its value, each item on its own. Where the source is *{ASSUMED}*,
no publication has the number: it is ours.

## Noise of sensors

{_table(("sensors", "unit", "standard deviation", "source"), noises)}
"""


def _value(value: Any) -> str:
    """Return a number, or a row of numbers; one text where all are the same."""
    if not isinstance(value, list):
        return f"{value:g}"
    texts = [f"{item:g}" for item in value]
    return f"{texts[0]} each" if len({*texts}) == 1 else ", ".join(texts)


def _spread(fact: Fact) -> str:
    if isinstance(fact.spread, list):
        return " to ".join(f"{end:g}" for end in fact.spread)
    return f"{100 * fact.spread:g} %" if fact.spread else ""


def _marked(source: str) -> str:
    """Return a source in which a number that no publication has stands out."""
    return source.replace(ASSUMED, f"*{ASSUMED}*", 1) if source.startswith(ASSUMED) else source


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = (header, ["---"] * len(header), *rows)
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
