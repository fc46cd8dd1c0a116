"""Numbers of the worlds: each with its unit and its source, in a TOML file beside the code."""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from oodd_eval import Quantity

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

HERE: Final = Path(__file__).parent
ASSUMED: Final = "assumed"
"""The source of a number that no publication gives."""


@dataclass(frozen=True, slots=True)
class Fact:
    """A number, or a row of numbers.

    Parameters
    ----------
    name, unit
        What it is.
    value
        The number in that unit, or a list of numbers.
    source
        The publication that has it, or `ASSUMED`.
    spread
        Standard deviation between nominal episodes, relative to the value; or of a number that is
        drawn uniformly, its two ends.
    """

    name: str
    unit: str
    value: Any
    source: str
    spread: Any = 0.0


@dataclass(frozen=True, slots=True)
class World:
    """Facts of a world.

    Attributes
    ----------
    facts
        Its numbers by name.
    sensors, actions
        Columns of its rows, with roles and noise.
    noise_sources
        Where the noise of each sensor is from, by the sensor's name.
    """

    facts: Mapping[str, Fact]
    sensors: tuple[Quantity, ...]
    actions: tuple[Quantity, ...]
    noise_sources: Mapping[str, str]

    def value(self, name: str) -> Any:
        """Return the nominal number of a fact, or its row of numbers as float64."""
        import numpy as np  # noqa: PLC0415  slow to import, and not needed to list worlds

        value = self.facts[name].value
        return np.array(value, np.float64) if isinstance(value, list) else float(value)

    def drawn(self, name: str, rng: np.random.Generator) -> Any:
        """Return a fact as it is in one nominal episode."""
        fact, value = self.facts[name], self.value(name)
        if isinstance(fact.spread, list):
            return float(rng.uniform(*fact.spread))
        size = getattr(value, "shape", None)
        factor = 1 + fact.spread * rng.standard_normal(size)
        return value * factor if size is not None else float(value * factor)

    def noise(self) -> NDArray[np.float64]:
        """Return the standard deviation of each sensor's noise, of shape (D,)."""
        import numpy as np  # noqa: PLC0415  slow to import

        return np.array([sensor.noise for sensor in self.sensors])


@functools.cache
def read_world(name: str) -> World:
    """Read the facts of a world from its TOML file."""
    content = tomllib.loads((HERE / f"{name}.toml").read_text(encoding="utf-8"))
    rows = [*content["sensor"], *content["action"]]
    sources = {row["name"]: row.get("source", ASSUMED) for row in rows if row.get("noise")}
    return World(
        {row["name"]: Fact(**row) for row in content["fact"]},
        tuple(map(Quantity.read, content["sensor"])),
        tuple(map(Quantity.read, content["action"])),
        sources,
    )
