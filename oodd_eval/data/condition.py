"""A condition is an anomaly at a strength: what is recorded, evaluated and compared.

The benchmark's strengths are chosen by what they cost the policy: the rungs of the suite ladder,
in ``ladder.json``, which ``oodd-eval data calibrate`` writes. A rung ``kept90`` is the measured
strength at which the policy keeps nearest to .90 of its nominal return. ``4th``, ``16th`` and
``64th`` are these parts of the strength of ``kept99``: they cost nothing yet.
"""

import functools
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, TABLE1, Suite, in_order
from oodd_eval.errors import SplitError
from oodd_eval.names import check_known

FRACTIONS: Final = MappingProxyType({"64th": 1 / 64, "16th": 1 / 16, "4th": 1 / 4})
"""Parts of the strength of ``kept99``, by rung of the ladder, weakest first."""

LEVELS: Final = MappingProxyType(
    {"kept99": 0.99, "kept95": 0.95, "kept90": 0.90, "kept75": 0.75, "kept50": 0.50}
)
"""Share of the nominal return that the policy keeps, by rung, weakest first."""

GROWTH: Final = MappingProxyType(
    {"loss1": 0.01, "loss5": 0.05, "loss10": 0.10, "loss25": 0.25, "loss100": 1.0}
)
"""Growth of the task's loss, by rung, weakest first, of environments whose task is a loss."""

PAPER: Final = "paper"
"""The rung at which the return's ratio is that of the paper's Table 2."""

RUNGS: Final = (*FRACTIONS, *LEVELS, *GROWTH, PAPER)
"""Names of the strengths of the benchmark's suites, weakest first, and the paper's."""

WHOLE: Final = "paper-whole"
"""The rung ``paper`` of robots, measured on whole episodes."""

ROBOTS_CAP: Final = 300
"""Longest episode of a robot at all other rungs, as in mini; other episodes run to their end."""


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


NOMINAL: Final = Condition("nominal")
"""Stands for the test part of a split that has nominal episodes alone."""


@dataclass(frozen=True, slots=True)
class Rung:
    """One strength of a kind of anomaly in one environment.

    Attributes
    ----------
    strength, low, high
        The strength, and the 95 % interval of the one at which the policy keeps that much.
    kept, kept_low, kept_high
        Share of its nominal return that the policy keeps at this strength, with 95 % interval:
        1 - (nominal return - return) / |nominal return|. NaN for ``4th``, ``16th`` and ``64th``.
    reached
        False where the largest sensible strength costs less; `strength` is that strength then.
    """

    strength: float
    low: float = float("nan")
    high: float = float("nan")
    kept: float = float("nan")
    kept_low: float = float("nan")
    kept_high: float = float("nan")
    reached: bool = True


@functools.cache
def read_ladder() -> Mapping[str, Mapping[str, Any]]:
    """Return what ``ladder.json`` has for each environment and kind."""
    file = Path(__file__).with_name("ladder.json")
    ladder: dict[str, dict[str, Any]] = json.loads(file.read_text(encoding="utf-8"))
    return ladder


def ladder_of(environment: str) -> Mapping[str, Any]:
    """Return what is calibrated in an environment, by kind; of a plug-in's from its own file."""
    if environment in ENVIRONMENTS:
        return read_ladder().get(environment, {})
    from oodd_eval.data.registry import environment_spec  # noqa: PLC0415  of what is recorded

    path = environment_spec(environment).ladder
    if path is None:
        return {}
    try:
        ladder: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))[environment]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SplitError(
            f"{str(path)!r} is no ladder of {environment}, which its plug-in names: {error!r}; "
            f"make it with `oodd-eval data calibrate --env {environment}`"
        ) from error
    return ladder


def _entry(environment: str, kind: str) -> Mapping[str, Any]:
    ladder = ladder_of(environment)
    check_known("anomaly", [*ANOMALIES, *ladder], kind)
    entry: Mapping[str, Any] | None = ladder.get(kind)
    if entry is None:
        raise SplitError(
            f"no strengths of {kind} are calibrated in {environment}: name others, or measure them "
            f"with `oodd-eval data calibrate --env {environment}`"
        )
    return entry


def rungs_of(environment: str, kind: str) -> dict[str, Rung]:
    """Return the rungs of a kind in an environment by name, weakest first.

    Levels to which the same strength is nearest share one rung, that of the highest of them; so do
    those that the largest sensible strength does not reach. `SplitError` where nothing is
    calibrated.
    """
    return {name: Rung(**rung) for name, rung in _entry(environment, kind)["rungs"].items()}


def all_rungs_of(environment: str, kind: str) -> dict[str, Rung]:
    """Return the rungs of a kind, and those of the paper's losses behind them."""
    entry = _entry(environment, kind)
    papers = {name: Rung(**entry[name]) for name in (PAPER, WHOLE) if name in entry}
    return rungs_of(environment, kind) | papers


def strength_of(environment: str, kind: str, rung: str) -> float:
    """Return the strength of a rung, the paper's among them; `UnknownNameError` for another."""
    rungs = all_rungs_of(environment, kind)
    check_known(f"rung of {kind} in {environment}", rungs, rung)
    return rungs[rung].strength


def conditions_of(
    suite: Suite, environment: str, episode_cap: int | None = None
) -> dict[Condition, float | None]:
    """Return the strength of each condition of a suite; None stands for the values of Table 1.

    What an anomaly costs a robot depends on the length of episodes: without `episode_cap` the
    suite ``paper`` takes the strengths that were measured on whole ones.
    """
    if suite == "table1":
        return {Condition(kind): None for kind in TABLE1}
    if suite == "paper":
        uncapped_robot = episode_cap is None and not ENVIRONMENTS[environment].discrete
        rung = WHOLE if uncapped_robot else PAPER
        return {Condition(a, PAPER): strength_of(environment, a, rung) for a in TABLE1}
    kinds = in_order(ladder_of(environment), ANOMALIES)
    if not kinds:
        _entry(environment, next(iter(ANOMALIES)))
    return {
        Condition(kind, name): rung.strength
        for kind in kinds
        for name, rung in rungs_of(environment, kind).items()
    }
