"""Facts of the benchmark: environments, anomalies, split definitions and protocol version.

The module needs neither simulators nor data. Values of the paper are from Danesh & Fern (2021).
"""

import functools
import json
import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal, get_args

from oodd_eval.errors import UsageError

PROTOCOL: Final = 3
"""Version of split semantics, metrics and defaults together; a change of any of them bumps it."""

Group = Literal["sensor", "dynamics"]

Role = Literal[
    "measured",
    "reference",
    "memory",
    "position",
    "velocity",
    "angle",
    "cosine",
    "sine",
    "contact",
    "setpoint",
    "effort",
    "score",
]
_UNMEASURED: Final = ("reference", "memory", "setpoint", "score")
_STORED: Final = ("reference", "memory", "score")  # with names; manifests list all roles


@dataclass(frozen=True, slots=True)
class Quantity:
    """A sensor or an action.

    Parameters
    ----------
    name
        Of the sensor or action.
    unit
        What the number 1 means: ``"rad"``, or ``"10 rad/s"`` where the simulator divides angular
        speeds by ten, or ``"1"`` for a plain number.
    role
        ``"measured"`` by a sensor, a ``"reference"`` or ``"setpoint"`` that the controller
        follows, or its ``"memory"``. Of what is measured it may also say more: ``"position"``,
        ``"velocity"``, ``"angle"`` or its ``"cosine"`` and ``"sine"``, ``"contact"`` (0 without)
        or ``"effort"``. Velocities are x, y, z of one frame, in one unit up to a factor a column;
        one angle turns the plane of the first two, three are roll, pitch and yaw, and two are roll
        and pitch of velocities that yaw turns no more. Only what is measured has noise, or breaks.
        A ``"score"`` is what a monitor computed when the log was recorded: no sensor.
    noise
        Standard deviation of the sensor's noise in nominal operation, in `unit`.
    """

    name: str
    unit: str
    role: Role = "measured"
    noise: float = 0.0

    def __post_init__(self) -> None:
        if self.role not in get_args(Role) or not 0 <= self.noise < math.inf:
            raise UsageError(
                f"{self.name!r} has role {self.role!r} and noise {self.noise!r}, expected one of "
                f"{', '.join(get_args(Role))}, and a number from 0"
            )
        if self.noise and not self.measured:
            raise UsageError(f"{self.name!r} is not measured ({self.role}): expected no noise")

    @classmethod
    def read(cls, row: Mapping[str, Any]) -> "Quantity":
        """Return the quantity that a row of a manifest describes.

        Parameters
        ----------
        row
            What `row` returns; further keys are ignored.

        Returns
        -------
        Quantity
        """
        return cls(**{field.name: row[field.name] for field in fields(cls) if field.name in row})

    @property
    def measured(self) -> bool:
        """True for what a sensor measures; False for references, set points and memory."""
        return self.role not in _UNMEASURED

    @property
    def row(self) -> dict[str, Any]:
        """Name, unit, and what differs from its default, as files store them.

        Of roles only references, memory and scores are part of it, and so of digests.
        """
        row: dict[str, Any] = {"name": self.name, "unit": self.unit}
        row |= {"role": self.role} if self.role in _STORED else {}
        return row | ({"noise": self.noise} if self.noise else {})


def roles_of(quantities: Iterable[object]) -> tuple[Role, ...]:
    """Return the roles of sensors, one each, as detectors get them; none where no role says more.

    Parameters
    ----------
    quantities
        Sensors; names without a role count as measured.

    Returns
    -------
    tuple of Role
        Empty where all are just measured.

    Examples
    --------
    >>> roles_of([Quantity("height", "m", "position"), Quantity("heat", "K")])
    ('position', 'measured')
    >>> roles_of([Quantity("heat", "K")])
    ()
    """
    roles: tuple[Role, ...] = tuple(getattr(q, "role", "measured") for q in quantities)
    return roles if {*roles} - {"measured"} else ()


@dataclass(frozen=True, slots=True)
class EnvironmentInfo:
    """One environment.

    Parameters
    ----------
    id, title, simulator
        Its name here, the paper's, and Gymnasium's.
    family
        Kind of simulator: ``"classic"``, ``"bullet"``, or ``"custom"`` for a plug-in's.
    discrete
        Whether actions are discrete; they are one-hot rows then.
    sensors, actions
        Names and units of the columns of observations and of action rows.
    episode_cap
        Longest episode in transitions.
    paper_return
        Mean return of the paper's policy in its Table 2; NaN for a custom environment.
    low, high
        Ends of each action, in its unit; empty for -1 to 1, or where actions are discrete.
    """

    id: str
    title: str
    simulator: str
    family: Literal["classic", "bullet", "custom"]
    discrete: bool
    sensors: tuple[Quantity, ...]
    actions: tuple[Quantity, ...]
    episode_cap: int
    paper_return: float = float("nan")
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()

    @property
    def observation_dim(self) -> int:
        """Number of sensors."""
        return len(self.sensors)

    @property
    def action_dim(self) -> int:
        """Width of an action row: the number of actions where they are discrete."""
        return len(self.actions)

    @property
    def limits(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """The lowest and the highest value of each action, where they are not discrete."""
        width = self.action_dim
        return self.low or (-1.0,) * width, self.high or (1.0,) * width

    @property
    def policy(self) -> Literal["IQN", "TD3"]:
        """The algorithm of the nominal policy."""
        return "IQN" if self.discrete else "TD3"


@dataclass(frozen=True, slots=True)
class AnomalyInfo:
    """One kind of anomaly.

    Parameters
    ----------
    id, title
        Its name here and the paper's.
    group
        ``"sensor"`` or ``"dynamics"``.
    summary
        One line: what changes.
    unit, bound, units, needs, needs_discrete, environments
        How it is recorded, see `oodd_eval.data.registry.AnomalySpec`.
    """

    id: str
    title: str
    group: Group
    summary: str
    unit: str
    bound: float
    units: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    needs: tuple[str, ...] = ()
    needs_discrete: tuple[str, ...] = ()
    environments: tuple[str, ...] = ()


Suite = Literal["table1", "ladder", "paper"]


@dataclass(frozen=True, slots=True)
class SplitDefinition:
    """The recipe of a split: trajectories of each part, longest episode, seeds.

    Parameters
    ----------
    name
        Name of the split.
    train, calibration, test
        Numbers of trajectories, per anomaly for the last.
    episode_cap
        Transitions of the longest episode; None for the simulator's own limit.
    seed_base
        Trajectory seeds are ``seed_base * 10**6 + offset of the part + index``.
    suite
        The anomalies: ``"table1"`` are those of the paper's Table 1, ``"ladder"`` all kinds at
        several strengths, ``"paper"`` the paper's at the strength at which its policies lost what
        its Table 2 says.
    base
        Split whose training and calibration parts, and test seeds, are taken, if any.
    noise
        Noise of every sensor in nominal operation, in shares of its spread.
    strengths
        Strengths of all conditions, in place of a suite.
    drawn
        SHA-256 of 128 random bits, from which NumPy's ``SeedSequence`` makes 128 bits for each
        episode, and which the split does not hold. Then the base is 0, and the rule of `seed_base`
        gives an episode's number. Empty where it gives the seed.
    environments
        Those of the split; empty for the seven of the benchmark.
    by_environment
        Values of `episode_cap`, `noise` and `strengths` that are an environment's own.
    """

    name: str
    train: int
    calibration: int
    test: int
    episode_cap: int | None
    seed_base: int
    suite: Suite = "table1"
    base: str = ""
    noise: float = 0.0
    strengths: Mapping[str, float] = field(default_factory=dict)
    drawn: str = ""
    environments: tuple[str, ...] = ()
    by_environment: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def of(self, environment: str) -> "SplitDefinition":
        """Return the definition with the values that are an environment's own.

        Parameters
        ----------
        environment
            Its name.

        Returns
        -------
        SplitDefinition
        """
        return replace(self, by_environment={}, **self.by_environment.get(environment, {}))

    @property
    def recipe(self) -> dict[str, Any]:
        """The manifest's ``definition``: all fields but those that are at their default."""
        recipe = {field.name: getattr(self, field.name) for field in fields(self)}
        # Older manifests lack these.
        later = {"suite": "table1", "base": "", "noise": 0.0, "strengths": {}, "drawn": ""}
        later |= {"environments": [], "by_environment": {}}
        recipe["environments"] = list(self.environments)  # as JSON has it
        return {n: value for n, value in recipe.items() if n not in later or value != later[n]}


_TABLES: Final = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def _environment(row: Mapping[str, Any]) -> EnvironmentInfo:
    columns = {
        name: tuple(Quantity(*column) for column in row[name]) for name in ("sensors", "actions")
    }
    return EnvironmentInfo(**{**row, **columns})


ENVIRONMENTS: Final = MappingProxyType(
    {row["id"]: _environment(row) for row in _TABLES["environment"]}
)
"""Environments by id, in the order of the paper's tables."""

ANOMALIES: Final = MappingProxyType({row["id"]: AnomalyInfo(**row) for row in _TABLES["anomaly"]})
"""Kinds of anomalies by id: those of the paper in the order of its Table 2, then further ones."""

TABLE1: Final = tuple(ANOMALIES)[:8]
"""The kinds of the paper's Table 1."""

GROUPS: Final[tuple[Group, ...]] = ("sensor", "dynamics")

Order = Literal["recorded", "shuffled"]


@dataclass(frozen=True, slots=True)
class LogFacts:
    """Facts of an environment that was imported from logs, as a split's manifest keeps them.

    Parameters
    ----------
    paired
        Whether each anomalous episode has a nominal twin. Without twins there is any number of
        nominal test episodes and of episodes of each anomaly.
    clock
        Whether row t of one episode may be compared with row t of another.
    baseline
        Number of rows at the start of every episode that are nominal and not judged.
    rate
        Rows in a second; None where it is not known.
    order
        Whether training, calibration and test follow one another as they were recorded.
    offsets
        Subtracted from each sensor in float64, in its unit; empty where nothing was.
    source, licence, citation
        Where the logs are from; empty where the recipe does not say it.
    """

    paired: bool = True
    clock: bool = True
    baseline: int = 0
    rate: float | None = None
    order: Order = "recorded"
    offsets: tuple[float, ...] = ()
    source: str = ""
    licence: str = ""
    citation: str = ""


WORLDS: Final = ("arm", "drone", "tank")
"""Environments of the plug-in `oodd_worlds`, of which splits are published, too."""

LONG_NAMES: Final = MappingProxyType({name: f"worlds/{name}" for name in WORLDS})
"""Long names of the environments that published splits and seasons call by short ones."""


def short_name(name: str) -> str:
    """Return the short name of an environment or a kind.

    Parameters
    ----------
    name
        A short name, or a long one, ``PLUGIN/NAME``.

    Returns
    -------
    str
        What stands behind the plug-in.
    """
    return name.rpartition("/")[2]


_SPLITS: Final = (
    # Protocol 1 used the seed bases 1 to 3: nothing tuned on its splits has seen these episodes.
    SplitDefinition("mini", 40, 40, 10, 300, 4),
    SplitDefinition("standard", 500, 200, 50, None, 5),
    # The first trajectories of standard: its seed base, the same episodes.
    SplitDefinition("reduced", 500, 50, 20, None, 5),
    SplitDefinition("paper", 10_000, 1_000, 1_000, None, 6),
    # The training and calibration episodes of others, so that a fit serves both.
    SplitDefinition("ladder", 40, 40, 10, 300, 4, "ladder", "mini"),
    SplitDefinition("mini-paper", 40, 40, 10, 300, 4, "paper", "mini"),
    SplitDefinition("reduced-paper", 500, 50, 20, None, 5, "paper", "reduced"),
    SplitDefinition("noisy-1", 40, 40, 10, 300, 7, noise=0.01),
    SplitDefinition("noisy-5", 40, 40, 10, 300, 8, noise=0.05),
    SplitDefinition("ladder-noisy-1", 40, 40, 10, 300, 7, "ladder", "noisy-1", noise=0.01),
    # Of the plug-in oodd_worlds, at the strengths of its ladder.
    SplitDefinition("worlds", 40, 40, 10, None, 9, "ladder", environments=WORLDS),
    SplitDefinition("worlds-standard", 500, 200, 50, None, 9, "ladder", environments=WORLDS),
)

LICENCE: Final = "MIT"
"""Of the published splits and of their policies, as of all that is in the repository."""

SPLITS: Final = MappingProxyType({split.name: split for split in _SPLITS})
"""The published splits by name."""

CUSTOM_SEED_BASES: Final = range(10, 900)
"""Seed bases of custom splits: published splits have those below, policies those above."""

NAME_PATTERN: Final = "[a-z0-9][a-z0-9_-]{0,63}"
"""Names of environments and anomalies: they become names of files and groups."""

FIRST_ONSET: Final = 30
"""First row at which a recorded anomaly may begin."""

BRIEF_TAIL: Final = 20
"""A part whose episodes last fewer transitions beyond their onsets, in the median, is *brief*."""

PART_OFFSETS: Final = MappingProxyType({"train": 0, "calibration": 300_000, "test": 600_000})
"""Seed offset of each part within the million seeds of a split's base."""


def in_order(names: Iterable[str], known: Iterable[str]) -> list[str]:
    """Return names, each once: known ones in their order, then the others as they come.

    Parameters
    ----------
    names, known
        Environments or anomalies.

    Returns
    -------
    list of str
        The names.

    Examples
    --------
    >>> in_order(["mine", "hopper", "cartpole", "mine"], ENVIRONMENTS)
    ['cartpole', 'hopper', 'mine']
    """
    position = {name: i for i, name in enumerate(known)}
    return sorted(dict.fromkeys(names), key=lambda name: position.get(name, len(position)))


def title_of(environment: str) -> str:
    """Return the paper's title of an environment; of any other, its name.

    Parameters
    ----------
    environment
        Its name.

    Returns
    -------
    str
        The title.
    """
    return ENVIRONMENTS[environment].title if environment in ENVIRONMENTS else environment


@functools.cache
def paper_tables() -> Mapping[str, Any]:
    """Return the numbers of the paper's tables, with the names of this module.

    Returns
    -------
    mapping
        Numbers by table, read-only.
    """
    file = Path(__file__).with_name("paper_tables.json")
    tables: Mapping[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return tables
