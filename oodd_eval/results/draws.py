"""Changes of a cell's figures with its calibration episodes, in few characters.

A record has dozens of draws of each of thirty metrics. Each is kept as one character: its distance
from the mean of the draws in steps of half their standard deviation, which adds a fiftieth to
their variance. Intervals are computed from what is kept.
"""

import math
import string
from collections.abc import Iterable, Iterator, Mapping
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import GetPydanticSchema
from pydantic_core import core_schema

Floats = NDArray[np.float64]

ALPHABET: Final = string.digits + string.ascii_uppercase + string.ascii_lowercase
"""Characters of distances from -30 steps on."""

CENTRE: Final = 30  # of 100 numbers none is as far as ten standard deviations from the mean
STEPS: Final = 2  # in a standard deviation
_EVEN: Final = 1e-6  # of a step: what lies between two is rounded alike by all processors

_LETTERS: Final = np.frombuffer(ALPHABET.encode(), np.uint8)
_CODES: Final = np.zeros(256)
_CODES[_LETTERS] = np.arange(len(ALPHABET)) - CENTRE


class CodedDraws(Mapping[str, Floats]):
    """Deviations of metrics from the mean of their draws, by metric: shape (draws,).

    Those of a metric that no draw changes are an empty array.

    Parameters
    ----------
    coded
        For each metric the length of a step, and a character a draw.
    """

    __slots__ = ("coded",)

    def __init__(self, coded: Mapping[str, tuple[float, str]] | None = None) -> None:
        self.coded = dict(coded or {})

    @classmethod
    def of(cls, values: Mapping[str, Floats]) -> "CodedDraws":
        """Keep the values of metrics in every draw; undefined ones count as their mean."""
        return cls({name: _coded(draws) for name, draws in values.items()})

    @classmethod
    def read(cls, coded: Mapping[str, tuple[float, str]]) -> "CodedDraws":
        """Return draws as records have them; raise `ValueError` for what none can be."""
        sizes = {len(text) for _, text in coded.values() if text}
        if len(sizes) > 1:
            raise ValueError(f"expected as many draws of each metric, got {sorted(sizes)}")
        for name, (step, text) in coded.items():
            if not 0 <= step < math.inf or not {*text} <= {*ALPHABET}:
                raise ValueError(f"draws of {name}: expected a step and letters or digits")
        return cls(coded)

    def only(self, names: Iterable[str]) -> "CodedDraws":
        """Return the draws of some metrics."""
        return CodedDraws({name: self.coded[name] for name in names if name in self.coded})

    def __getitem__(self, name: str) -> Floats:
        """Return the deviations of a metric."""
        step, text = self.coded[name]
        deviations: Floats = step * _CODES[np.frombuffer(text.encode(), np.uint8)]
        return deviations

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the metrics."""
        return iter(self.coded)

    def __len__(self) -> int:
        """Return the number of metrics."""
        return len(self.coded)

    def __eq__(self, other: object) -> bool:
        """Compare what is kept."""
        return isinstance(other, CodedDraws) and self.coded == other.coded

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        """Return what is kept."""
        return f"CodedDraws({self.coded!r})"


def _coded(draws: Floats) -> tuple[float, str]:
    defined = draws[~np.isnan(draws)]
    if not defined.size or defined.min() == defined.max():
        return 0.0, ""
    mean = defined.mean()
    deviations = np.where(np.isnan(draws), 0.0, draws - mean)
    step = float(f"{math.sqrt(np.mean(deviations**2)) / STEPS * (1 + _EVEN):.3g}")
    codes = np.floor(deviations / step + 0.5 + _EVEN).clip(-CENTRE, CENTRE).astype(int)
    return step, _LETTERS[CENTRE + codes].tobytes().decode()


def _schema(_: Any, handler: Any) -> core_schema.CoreSchema:
    return core_schema.no_info_after_validator_function(
        CodedDraws.read, handler(dict[str, tuple[float, str]])
    )


Draws = Annotated[CodedDraws, GetPydanticSchema(_schema)]
"""A record's draws: read from an object of pairs of a number and a text."""
