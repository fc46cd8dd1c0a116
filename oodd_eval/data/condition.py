"""A condition is an anomaly at a strength: what is recorded, evaluated and compared."""

from collections.abc import Iterable
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from oodd_eval.data.facts import ANOMALIES

FRACTIONS: Final = MappingProxyType({"64th": 1 / 64, "16th": 1 / 16, "4th": 1 / 4})
"""Parts of the strength of ``kept99``, by rung of the ladder, weakest first."""

LEVELS: Final = MappingProxyType(
    {"kept99": 0.99, "kept95": 0.95, "kept90": 0.90, "kept75": 0.75, "kept50": 0.50}
)
"""Share of the nominal return that the policy keeps, by rung, weakest first."""

PAPER: Final = "paper"
"""The rung at which the return's ratio is that of the paper's Table 2."""

RUNGS: Final = (*FRACTIONS, *LEVELS, PAPER)
"""Names of the strengths of the benchmark's suites, weakest first, and the paper's."""


@dataclass(frozen=True, slots=True)
class Condition:
    """A kind of anomaly and the name of its strength, written ``iid@kept99``.

    Parameters
    ----------
    anomaly
        Name of the kind.
    strength
        Name of the strength; empty where the anomaly has only one.

    Examples
    --------
    >>> Condition.parse("iid@kept99")
    Condition(anomaly='iid', strength='kept99')
    >>> str(Condition("iid"))
    'iid'
    """

    anomaly: str
    strength: str = ""

    @classmethod
    def parse(cls, text: str) -> "Condition":
        """Read what `str` writes.

        Parameters
        ----------
        text
            Such as ``"iid"`` or ``"iid@kept99"``.

        Returns
        -------
        Condition
        """
        anomaly, _, strength = text.partition("@")
        return cls(anomaly, strength)

    def __str__(self) -> str:
        """Return the text that names it in files, on the command line and in tables."""
        return f"{self.anomaly}@{self.strength}" if self.strength else self.anomaly

    @property
    def part(self) -> str:
        """Name of the part of an environment's file with its episodes, such as ``test/iid``."""
        return f"test/{self}"


def in_suite_order(conditions: Iterable[Condition]) -> list[Condition]:
    """Return conditions, each once: by kind in the benchmark's order, then by strength.

    Rungs of the ladder come first, in its order, then strengths whose names are numbers.

    Parameters
    ----------
    conditions
        Of any environments; kinds that the benchmark lacks come last, as they come.
    """
    distinct = dict.fromkeys(conditions)
    kinds = list(dict.fromkeys([*ANOMALIES, *(c.anomaly for c in distinct)]))
    return sorted(distinct, key=lambda c: (kinds.index(c.anomaly), *_rank(c.strength)))


def _rank(strength: str) -> tuple[int, float, str]:
    """Return a key that sorts names of strengths."""
    rungs = ("", *RUNGS)
    if strength in rungs:
        return rungs.index(strength), 0.0, ""
    try:
        return len(rungs), float(strength), ""
    except ValueError:
        return len(rungs) + 1, 0.0, strength
