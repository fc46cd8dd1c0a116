"""Recipes: what turns logs as they are into a frozen split, written down as TOML.

A recipe names files, columns and labels, and says how rows become episodes. Nothing in it is run.
"""

import datetime as dt
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Final, Literal, cast, get_args, get_origin, get_type_hints

from oodd_eval.data.bounded import read_toml
from oodd_eval.data.facts import (
    ANOMALIES,
    ENVIRONMENTS,
    GROUPS,
    NAME_PATTERN,
    SPLITS,
    Group,
    Order,
    Role,
)
from oodd_eval.errors import UnknownNameError, UsageError
from oodd_eval.names import check_known
from oodd_logs.kinds import kinds_by_key, missing_codes
from oodd_logs.kinds.naming import read_names, read_text, wrong_value

FAILURE: Final = "failure"
"""Kind of the episodes that failed, where a recipe names no other."""

SHARES: Final = (0.4, 0.3, 0.3)
"""Shares of training, calibration and test among nominal episodes, unless a recipe says others."""

MISSING_ROWS: Final = 20
"""Most rows in a run whose missing values are held or dropped, unless a recipe says others."""


DateOrder = Literal["", "day first", "month first"]
Missing = Literal["refuse", "hold", "drop", "keep"]
"""Treatments of missing values; they are kept, as NaN, for scans alone."""
Interval = tuple[str, int | float | str | None, int | float | str | None, str]
"""File, start, stop and kind; a start or stop is a row, a time, or None where it is not known."""


def check_name(kind: str, name: str) -> None:
    """Raise `UsageError` unless a text can name a split, an environment or an anomaly."""
    if not re.fullmatch(NAME_PATTERN, name):
        raise UsageError(
            f"{name!r} cannot be the name of {'an' if kind[0] in 'ae' else 'a'} {kind}: expected "
            "lower-case letters, digits, hyphens and underscores, at most 64"
        )


def anomaly_name(text: str) -> str:
    """Return a name of an anomaly made of any text.

    >>> anomaly_name("Front Collision (2)")
    'front-collision-2'
    """
    plain = re.sub(r"[^a-z0-9_]+", "-", text.lower()).strip("-_")
    return plain[:64] or FAILURE


# Readers of values: each takes what messages call the key, and the value.


def _globs(key: str, value: Any) -> tuple[str, ...]:
    patterns = read_names(key, value)
    for pattern in patterns:
        if pattern.startswith(("/", "~")) or re.match(r"[A-Za-z]:|.*\\", pattern):
            raise wrong_value(key, pattern, "paths relative to the recipe's folder, or to --root")
        if ".." in pattern.split("/"):
            raise wrong_value(key, pattern, "paths without '..': choose a folder above with --root")
    return patterns


def _number(key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1e12:
        raise wrong_value(key, value, "a number above 0")
    return float(value)


def _whole(least: int, also: int | None = None) -> Callable[[str, Any], int]:
    def read(key: str, value: Any) -> int:
        is_whole = isinstance(value, int) and not isinstance(value, bool)
        if not is_whole or not (least <= value < 2**53 or value == also):
            zero = f", or {also} for none" if also is not None else ""
            raise wrong_value(key, value, f"a whole number from {least} on{zero}")
        return int(value)

    return read


def _share(key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1:
        raise wrong_value(key, value, "a share from 0 to 1")
    return float(value)


def _one_of(types: Any, expected: str) -> Callable[[str, Any], Any]:
    def read(key: str, value: Any) -> Any:
        if not isinstance(value, types):
            raise wrong_value(key, value, expected)
        return value

    return read


_flag: Final = _one_of(bool, "true or false")
_scalar: Final = _one_of(str | int | float | bool, "a text, number or truth value")
_table: Final = _one_of(Mapping, "a table")


def _choice(*names: str) -> Callable[[str, Any], str]:
    def read(key: str, value: Any) -> str:
        if value not in names:
            raise UnknownNameError(f"value of {key}", str(value), names)
        return str(value)

    return read


def _scalars(key: str, value: Any) -> tuple[Any, ...]:
    values = value if isinstance(value, list | tuple) else [value]
    return tuple(_scalar(key, element) for element in values)


def _conditions(key: str, value: Any) -> dict[str, tuple[Any, ...]]:
    return {name: _scalars(f"{key}.{name}", values) for name, values in _table(key, value).items()}


def _roles(key: str, value: Any) -> dict[str, tuple[str, ...]]:
    roles = [role for role in get_args(Role) if role != "score"]  # which the key scores gives
    check_known(f"role of {key}", roles, *_table(key, value))
    return _blocks(key, value)


def _blocks(key: str, value: Any) -> dict[str, tuple[str, ...]]:
    for name in (name for name in _table(key, value) if not re.fullmatch(r"[^\[\]]+", name)):
        raise wrong_value(f"a name of {key}", name, "one without brackets, as they get numbers")
    return {name: read_names(f"{key}.{name}", globs) for name, globs in value.items()}


def _discrete(key: str, value: Any) -> int | tuple[str, ...]:
    if isinstance(value, list | tuple):
        return read_names(key, value)
    return _whole(0)(key, value)


def _shares(key: str, value: Any) -> tuple[float, ...]:
    shares = value if isinstance(value, list | tuple) else ()
    numbers = all(isinstance(s, int | float) and 0 <= s <= 1 for s in shares)
    if len(shares) not in {2, 3} or not numbers or abs(sum(shares) - 1) > 1e-6 or 0 in shares[:2]:
        expected = "shares of training, calibration and test with the sum 1, the first two above 0"
        raise wrong_value(key, value, expected)
    return tuple(map(float, shares))


def _intervals(key: str, value: Any) -> str | tuple[Interval, ...]:
    if isinstance(value, str):
        return _globs(key, value)[0]
    rows = value if isinstance(value, list | tuple) else [value]
    intervals = []
    for row in rows:
        if not isinstance(row, list | tuple) or len(row) not in {3, 4}:
            raise wrong_value(key, row, "[file, start, stop] or [file, start, stop, kind]")
        kind = read_text(key, row[3]) if len(row) == 4 else ""
        intervals.append((read_text(key, row[0]), _moment(key, row[1]), _moment(key, row[2]), kind))
    return tuple(intervals)


def _moment(key: str, value: Any) -> int | float | str | None:
    """Return a row, a time or a stamp; None for an empty text: it is not known."""
    if value == "":
        return None
    if isinstance(value, dt.date):
        return value.isoformat()
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise wrong_value(key, value, "a row, a time in seconds with a decimal point, or ISO 8601")
    return value


Text = Annotated[str, read_text]
Texts = Annotated[tuple[str, ...], read_names]
Globs = Annotated[tuple[str, ...], _globs]
Conditions = Annotated[Mapping[str, tuple[Any, ...]], _conditions]
Flag = Annotated[bool, _flag]
Number = Annotated[float | None, _number]
Row = Annotated[int | None, _whole(0)]
Stop = Annotated[int | None, _whole(1)]
Length = Annotated[int, _whole(2, also=0)]
Whole = Annotated[int, _whole(0)]


@dataclass(frozen=True, slots=True)
class NominalFiles:
    """Files of nominal episodes: the table ``[nominal]`` of a recipe.

    Parameters
    ----------
    files
        Globs of files whose episodes are shared out by `parts`.
    parts
        Shares of training, calibration and test among the episodes of `files`.
    train, calibration, test
        Globs of files with episodes of that part.
    twins
        Globs of files with the nominal twins of a paired recipe.
    where
        Values of a field, or of a column, that nominal episodes have; empty for no condition.
    window
        In place of the recipe's.
    """

    files: Globs = ()
    parts: Annotated[tuple[float, ...], _shares] = SHARES
    train: Globs = ()
    calibration: Globs = ()
    test: Globs = ()
    twins: Globs = ()
    where: Conditions = field(default_factory=dict)
    window: Annotated[int | None, _whole(2, also=0)] = None


@dataclass(frozen=True, slots=True)
class AnomalousFiles:
    """Files of episodes with one anomaly: a table ``[anomalous.NAME]`` of a recipe.

    Parameters
    ----------
    files
        Globs of files; empty where `Recipe.kinds` or `Recipe.outcome` tells the episodes apart.
    group
        Group of the anomaly.
    where
        Values of a field, or of a column, that these episodes have; empty for no condition.
    labels
        In place of the recipe's.
    onset, stop
        First anomalous row of each file, and the row after the last; None where not the same.
    window
        In place of the recipe's.
    """

    files: Globs = ()
    group: Annotated[Group, _choice(*GROUPS)] = "dynamics"
    where: Conditions = field(default_factory=dict)
    labels: Texts = ()
    onset: Row = None
    stop: Stop = None
    window: Annotated[int | None, _whole(2, also=0)] = None


def _nominal(key: str, value: Any) -> NominalFiles:
    return NominalFiles(**_checked("[nominal]", _table(key, value), NominalFiles))


def _anomalous(key: str, value: Any) -> dict[str, AnomalousFiles]:
    tables = {}
    for name, table in _table(key, value).items():
        source = f"[anomalous.{name}]"
        content = _checked(source, _table(source, table), AnomalousFiles)
        if name in ANOMALIES:
            content.setdefault("group", ANOMALIES[name].group)
        tables[name] = AnomalousFiles(**content)
    return tables


@dataclass(frozen=True, slots=True)
class Recipe:
    """A recipe that makes one environment of a split from logs.

    Parameters
    ----------
    split, environment
        Names of both.
    source, licence, citation
        Where the logs are from.
    time
        Column with time stamps, ``NAME[s]``, ``[ms]`` and the like, or dates; several whose times
        add up, such as date and time of day, or seconds and nanoseconds; empty for the format's
        own, or none.
    dates
        Which of day and month comes first in dates; empty where the cells of each file tell.
    rate
        Rows in a second of the result, to which rows are resampled, the last value held; None for
        rows as they are.
    gap
        Seconds without a row beyond which a recording is cut; None refuses long gaps, and 0, for
        scans, cuts there.
    episode
        Columns that tell the episodes of a file apart: keys that have a value an episode, flags of
        first or last rows, or a counter that starts anew; see `oodd_logs.splitting`.
    sensors, actions
        Globs over columns or ``topic.field``, in order; ``"new = old"`` renames, ``NAME[UNIT]``
        names the unit. Without sensors, the columns ``obs:NAME[UNIT]`` and ``action:NAME[UNIT]``.
    reward
        Column with rewards.
    scores
        Globs over columns that a monitor computed when the log was recorded, as for `sensors`:
        columns with the role ``"score"`` behind the sensors, which no detector sees that does not
        name them.
    discrete
        Number of actions, or their names, where each action is a whole number from 0 on.
    columns
        What the keys of kinds of columns say, such as ``angles``, by key; see `oodd_logs.kinds`.
    roles
        Globs of sensors by their role, see `oodd_eval.Quantity`. Sine and cosine of angles that are
        replaced by them have these roles where the sensor's is ``"angle"``.
    blocks
        Globs of sensors and scores, by the name of their block: they become ``NAME[0]``,
        ``NAME[1]`` and so on, once all else that the recipe says is done.
    constant
        What becomes of sensors that are constant in the training part: ``"keep"`` or ``"drop"``.
    missing
        What missing values do: ``"refuse"``, ``"hold"`` the last value, or ``"drop"`` the row.
    missing_rows
        Most rows in a run that are held or dropped.
    labels
        Columns that are nominal where they are 0, empty, false, ``"H"`` or `nominal_label`.
    nominal_label
        Values of the labels of nominal rows, in place of these.
    intervals
        Anomalous rows, or times, of files.
    onset, stop
        First anomalous row of each anomalous file, and the row after the last, if always the same.
    outcome
        Field, or column, that is true of episodes that succeeded: others are anomalous.
    failures
        Share of the failed episodes of each task, the first as recorded, that are for training.
    kinds
        Field, or column, whose value names the anomaly of each episode.
    task
        Field, or column, with the task or set point of each episode.
    unseen
        Tasks whose episodes are all for the test.
    baseline
        Number of rows at the start of every episode that are nominal and not judged; 0 for none.
    window
        Rows to which longer recordings are cut; 0 for whole recordings.
    clock
        Whether row t of one episode may be compared with row t of another.
    order
        Whether parts follow one another as recorded, or episodes are shuffled before.
    seed
        Of the shuffling.
    paired
        Whether each anomalous episode has a nominal twin in a file of the same name.
    format
        Format of the files; empty to tell by their endings.
    options
        Of the format's reader.
    nominal
        Where nominal episodes are.
    anomalous
        Where anomalous episodes are, by the name of the anomaly.
    """

    split: Text
    environment: Text
    source: Text = ""
    licence: Text = ""
    citation: Text = ""
    time: Texts = ()
    dates: Annotated[DateOrder, _choice("day first", "month first")] = ""
    rate: Number = None
    gap: Number = None
    episode: Texts = ()
    sensors: Texts = ()
    actions: Texts = ()
    reward: Text = ""
    scores: Texts = ()
    discrete: Annotated[int | tuple[str, ...], _discrete] = 0
    columns: Mapping[str, Any] = field(default_factory=dict)
    roles: Annotated[Mapping[str, tuple[str, ...]], _roles] = field(default_factory=dict)
    blocks: Annotated[Mapping[str, tuple[str, ...]], _blocks] = field(default_factory=dict)
    constant: Annotated[Literal["keep", "drop"], _choice("keep", "drop")] = "keep"
    missing: Annotated[Missing, _choice("refuse", "hold", "drop")] = "refuse"
    missing_rows: Whole = MISSING_ROWS
    labels: Texts = ()
    nominal_label: Annotated[tuple[Any, ...], _scalars] = ()
    intervals: Annotated[str | tuple[Interval, ...], _intervals] = ()
    onset: Row = None
    stop: Stop = None
    outcome: Text = ""
    failures: Annotated[float, _share] = 0.0
    kinds: Text = ""
    task: Text = ""
    unseen: Annotated[tuple[Any, ...], _scalars] = ()
    baseline: Length = 0
    window: Length = 0
    clock: Flag = True
    order: Annotated[Order, _choice("recorded", "shuffled")] = "recorded"
    seed: Whole = 0
    paired: Flag = False
    format: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    nominal: Annotated[NominalFiles, _nominal] = field(default_factory=NominalFiles)
    anomalous: Annotated[Mapping[str, AnomalousFiles], _anomalous] = field(default_factory=dict)

    @property
    def label_columns(self) -> tuple[str, ...]:
        """Columns with labels, of all anomalies."""
        further = (column for table in self.anomalous.values() for column in table.labels)
        return tuple(dict.fromkeys([*self.labels, *further]))

    @property
    def globs(self) -> tuple[str, ...]:
        """Globs of all files that it names."""
        nominal = self.nominal
        parts = nominal.files, nominal.train, nominal.calibration, nominal.test, nominal.twins
        listed = chain(*parts, *(table.files for table in self.anomalous.values()))
        return tuple(dict.fromkeys(listed))

    @classmethod
    def load(cls, path: Path) -> "Recipe":
        """Read a recipe.

        Parameters
        ----------
        path
            A TOML file.

        Returns
        -------
        Recipe

        Raises
        ------
        UsageError
            When the file cannot be read or is no recipe; the message names the key.
        """
        return cls.parse(read_toml(path, UsageError), str(path))

    @classmethod
    def parse(cls, content: Mapping[str, Any], source: str = "the recipe") -> "Recipe":
        """Check the content of a recipe.

        Parameters
        ----------
        content
            Keys and tables as in TOML.
        source
            What messages call it.

        Returns
        -------
        Recipe

        Raises
        ------
        UsageError
            For an unknown or wrong key, with the nearest one, or keys that contradict each other.
        """
        values = _checked(source, content, cls)
        if "split" not in values:
            raise UsageError(f"{source} lacks the key 'split', the name of the split to make")
        options = dict(values.pop("read", {}))
        values["columns"] = {key: values.pop(key) for key in kinds_by_key() if key in values}
        if codes := values["columns"].get(missing_codes.KEY):
            options[missing_codes.KEY] = codes
        values["format"] = read_text("[read]: format", options.pop("format", ""))
        recipe = cls(**{"environment": values["split"], "options": options} | values)
        recipe.check(source)
        return recipe

    def check(self, source: str = "the recipe") -> None:
        """Raise `UsageError` when names are taken or wrong, or keys contradict each other.

        Parameters
        ----------
        source
            What messages call the recipe.

        Raises
        ------
        UsageError
            With the key and what to do.
        """
        for kind, reserved, name in (
            ("split", SPLITS, self.split),
            ("environment", ENVIRONMENTS, self.environment),
        ):
            if name in reserved:
                raise UsageError(f"{name!r} is the benchmark's {kind}: choose a name of your own")
            check_name(kind, name)
        for name, table in self.anomalous.items():
            check_name("anomaly", name)
            if name == "nominal":
                raise UsageError(f"{source}: 'nominal' cannot be the name of an anomaly")
            check_known("group", GROUPS, table.group)
            if name in ANOMALIES and ANOMALIES[name].group != table.group:
                shipped = ANOMALIES[name].group
                raise UsageError(f"{name!r} is a {shipped} anomaly of the benchmark: rename it")
        nominal = self.nominal
        if not (nominal.files or nominal.train):
            raise UsageError(f"{source}: [nominal] names neither files nor train, expected one")
        if nominal.files and (nominal.train or nominal.calibration):
            expected = "either files with their shares, or train, calibration and test"
            raise UsageError(f"{source}: [nominal] has both files and parts, expected {expected}")
        if nominal.train and not nominal.calibration:
            raise UsageError(f"{source}: [nominal] names train, but no calibration for thresholds")
        if self.paired and self.anomalous and not nominal.twins:
            expected = "nominal episodes with the file names of the anomalous ones"
            raise UsageError(f"{source}: paired = true needs [nominal] twins: {expected}")
        for key in ("window", "baseline", "outcome", "kinds", "task"):
            if self.paired and getattr(self, key):
                raise UsageError(f"{source}: paired = true and {key} exclude each other")
        if nominal.twins and not self.paired:
            raise UsageError(f"{source}: [nominal] names twins, expected paired = true with them")
        if self.gap is not None and not self.time and self.rate is None:
            raise UsageError(f"{source}: gap needs stamps: name their column with time")
        if self.failures and not self.outcome:
            raise UsageError(f"{source}: failures are known by their outcome: name its field, too")
        if self.unseen and not self.task:
            raise UsageError(f"{source}: unseen names tasks: name the field with them (task), too")
        if self.stop is not None and self.onset is None:
            raise UsageError(f"{source}: stop is the end of what onset begins: name onset, too")


_Reader = Callable[[str, Any], Any]


def _readers(table: type) -> dict[str, _Reader]:
    """Return the readers of a table's keys, which stand beside their types, by key."""
    hints = get_type_hints(table, include_extras=True)
    return {
        key: hint.__metadata__[0] for key, hint in hints.items() if get_origin(hint) is Annotated
    }


def _checked(source: str, content: Mapping[str, Any], table: type) -> dict[str, Any]:
    """Return the values of keys, each checked by its reader; unknown keys are errors."""
    readers = _readers(table)
    if table is Recipe:
        kinds = {key: cast("_Reader", kind.check) for key, kind in kinds_by_key().items()}
        readers = {**readers, "read": _table, **kinds}
    check_known(f"key of {source}", readers, *content)
    return {key: readers[key](f"{source}: {key}", value) for key, value in content.items()}


KEYS: Final = ("read", *_readers(Recipe))
"""Keys of a recipe but for those of kinds of columns, in the order in which one is written."""
