"""One evaluated cell: its identity, what came of it, and how that was computed.

A record is plain data. `Record.to_json` and `Record.from_json` are inverse to each other, with NaN
written as null, so that results can be stored, compared and published as lines of JSON.
"""

import functools
import itertools
import json
import math
import platform
import string
import subprocess
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BeforeValidator,
    GetPydanticSchema,
    TypeAdapter,
    ValidationError,
)

from oodd_eval._version import __version__
from oodd_eval.data.bounded import without_nan
from oodd_eval.data.condition import Condition
from oodd_eval.errors import ResultsError
from oodd_eval.metrics.catalogue import metric_info
from oodd_eval.plugins.contract import Alarm, Training
from oodd_eval.results.identity import Cell, Setting

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

    A record has dozens of draws of each of thirty metrics. Each is kept as one character: its
    distance from the mean of the draws in steps of half their standard deviation, which adds a
    fiftieth to their variance. Intervals are computed from what is kept.

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


_Coded = Annotated[dict[str, tuple[float, str]], AfterValidator(CodedDraws.read)]
Draws = Annotated[CodedDraws, GetPydanticSchema(lambda _, read: read(_Coded))]
"""A record's draws: read from an object of pairs of a number and a text."""

SCHEMA: Final = 3
"""Version of the layout of a record; a reader refuses others."""

Status = Literal["ok", "error", "timeout", "oom", "invalid", "incompatible", "unavailable"]
"""States of a cell. All but the first are failures and carry a reason."""

STATUSES: Final[tuple[Status, ...]] = get_args(Status)

NAN: Final = float("nan")

Number = Annotated[float, BeforeValidator(lambda value: NAN if value is None else value)]
"""A number that is read from null where it is NaN."""


def _as_many(terms: tuple[list[float], list[float]]) -> tuple[list[float], list[float]]:
    if len(terms[0]) != len(terms[1]):
        raise ValueError(f"{len(terms[0])} numerators and {len(terms[1])} denominators")
    return terms


_Pair = Annotated[tuple[list[float], list[float]], AfterValidator(_as_many)]
Terms = Annotated[NDArray[np.float64], GetPydanticSchema(lambda _, read: read(_Pair))]
"""Numerators and denominators of a ratio of sums: shape (2, n)."""


@dataclass(frozen=True, slots=True)
class Metric:
    """A metric of one cell.

    Attributes
    ----------
    value, low, high
        The value with its 95 % interval, in the unit of records; NaN where undefined.
    n
        Number of trajectories that count.
    """

    value: Number
    low: Number = NAN
    high: Number = NAN
    n: int = 0

    __pydantic_config__: ClassVar = {"extra": "forbid", "strict": True}


@dataclass(frozen=True, slots=True, eq=False)
class Record:
    """One cell: split x environment x anomaly x detector x parameters x horizon x seed.

    Attributes
    ----------
    detector, detector_version, plugin, plugin_source
        Name of the detector, version of the distribution it is from, ``distribution:plug-in``, and
        the digest of the plug-in's code.
    parameters, overrides
        All parameters that decide scores, defaults included; those that are not at their default.
    inputs
        ``"observations"`` or ``"observations+actions"``.
    alarm
        Statistic of its guaranteed alarms: ``"cusum"``, or ``"score"`` for a
        detector that accumulates by itself.
    deterministic
        Whether its seed changes nothing.
    training
        What the detector learns from, as it declares (`DetectorSpec`).
    environment, anomaly, strength, group, horizon, seed, split, split_digest, limit
        The evaluation. `strength` is a name, empty where an anomaly has only one; `limit` is the
        number of trajectories of each part that were used, None for all.
    magnitude
        The strength as a number in the anomaly's unit; None where the split names none, and in
        records that were written before it was kept.
    status, reason
        ``"ok"``, or the way in which the detector failed and one line about it.
    metrics
        Metrics by name; empty for a failed cell.
    brief
        Whether half of the cell's episodes are so short that fewer than 20 rows are left to detect
        anything in.
    counts
        Numbers of trajectories used, by part; ``nominal`` are nominal test episodes that are no
        twins, ``test`` the anomalous ones.
    recordings
        Numbers of the recordings that these are windows of, one an episode, of ``calibration``,
        ``nominal`` and ``test``; empty where each episode is a recording.
    per_trajectory
        For each metric that is a ratio of sums, its numerators and denominators in test order:
        shape (2, n). Without twins, nominal test episodes come first, then the anomalous ones.
    calibration_draws
        For each metric of alarms by how much resamples of the calibration episodes change it;
        empty in records that were written before they were kept, and with a rolling calibration.
    scores
        Key of the file with the scores.
    seconds_fit, seconds_score, steps_scored, peak_rss_mb
        Cost of the fit this cell is from (shared by all anomalies); `seconds_score` is for
        `steps_scored` observations. NaN or None where unknown.
    provenance
        Versions, machine, device and time: nothing that decides identity.
    paired
        Whether each anomalous episode has a nominal twin.
    rolling
        Whether nominal test episodes joined the calibration of its alarms, in recorded order.
    note
        What is missing among the metrics, and why; empty where nothing is.
    protocol, schema
        Versions of splits, metrics and defaults, and of this layout.
    """

    detector: str
    detector_version: str
    plugin: str
    parameters: dict[str, Any]
    environment: str
    anomaly: str
    group: str
    horizon: int
    seed: int
    split: str
    split_digest: str
    status: Status
    protocol: int
    plugin_source: str = ""
    overrides: dict[str, Any] = field(default_factory=dict)
    inputs: str = ""
    alarm: Alarm = "cusum"
    deterministic: bool = False
    training: Training = "nominal"
    strength: str = ""
    magnitude: float | None = None
    limit: int | None = None
    reason: str = ""
    metrics: dict[str, Metric] = field(default_factory=dict, repr=False)
    brief: bool = False
    counts: dict[str, int] = field(default_factory=dict)
    recordings: dict[str, tuple[int, ...]] = field(default_factory=dict)
    per_trajectory: Mapping[str, Terms] = field(default_factory=dict, repr=False)
    calibration_draws: Draws = field(default_factory=CodedDraws, repr=False)
    scores: str = ""
    seconds_fit: Number = NAN
    seconds_score: Number = NAN
    steps_scored: int | None = None
    peak_rss_mb: Number = NAN
    provenance: dict[str, Any] = field(default_factory=dict, repr=False)
    paired: bool = True
    rolling: bool = False
    note: str = ""
    schema: int = SCHEMA

    __pydantic_config__: ClassVar = {"extra": "forbid", "strict": True}

    def __eq__(self, other: object) -> bool:
        """Compare all fields."""
        if not isinstance(other, Record):
            return NotImplemented
        both = [[getattr(r, n) for n in _PLAIN] for r in (self, other)]
        return both[0] == both[1] and same_terms(self.per_trajectory, other.per_trajectory)

    __hash__ = None  # type: ignore[assignment]

    @property
    def ok(self) -> bool:
        """True if the cell has metrics."""
        return self.status == "ok"

    @property
    def setting(self) -> Setting:
        """The row of a board that the record belongs to."""
        return Setting.of(self.detector, self.horizon, self.overrides, rolling=self.rolling)

    @property
    def cell(self) -> Cell:
        """The evaluation; its text is what users see."""
        return Cell(self.split, self.environment, self.condition, self.setting, self.seed)

    @property
    def condition(self) -> Condition:
        """The anomaly at its strength."""
        return Condition(self.anomaly, self.strength)

    @property
    def position(self) -> tuple[str, str]:
        """Environment and condition: the column of a board that the record belongs to."""
        return self.environment, str(self.condition)

    @property
    def recordings_of_terms(self) -> tuple[int, ...]:
        """Recordings of the episodes that terms are of; empty where each episode is one."""
        return (*self.recordings.get("nominal", ()), *self.recordings.get("test", ()))

    @property
    def identity(self) -> tuple[str, ...]:
        """Equal for two results of the same cell, of which the later replaces the earlier."""
        conditions = [self.protocol, self.parameters, self.limit]
        return str(self.cell), self.split_digest, json.dumps(conditions, sort_keys=True)

    def value(self, metric: str) -> float:
        """Return a metric's value; NaN where the cell has none, `UnknownNameError` if none could.

        See ``oodd-eval list metrics``.
        """
        if metric not in self.metrics:
            metric_info(metric)
            return NAN
        return self.metrics[metric].value

    def to_json(self) -> str:
        """Return one line of JSON, keys in a fixed order, NaN as null.

        Without a number of its strength the record has no ``magnitude``, as before there was one;
        ``training``, ``paired``, ``rolling``, ``note``, ``recordings`` and ``calibration_draws``
        are left out where they say nothing.
        """
        silent: dict[str, Any] = {"training": "nominal", "magnitude": None, "paired": True}
        silent |= {"rolling": False, "note": "", "recordings": {}}
        silent["calibration_draws"] = CodedDraws()
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        plain = {n: v for n, v in values.items() if n not in silent or v != silent[n]}
        plain["metrics"] = {
            name: {"value": m.value, "low": m.low, "high": m.high, "n": m.n}
            for name, m in self.metrics.items()
        }
        plain = without_nan(plain | {"per_trajectory": {}})  # terms are finite, and many
        plain["per_trajectory"] = {n: terms.tolist() for n, terms in self.per_trajectory.items()}
        if self.calibration_draws:
            plain["calibration_draws"] = self.calibration_draws.coded
        return json.dumps(plain, allow_nan=False)

    @classmethod
    def from_json(cls, line: str, where: str = "record") -> "Record":
        """Read a record back; `ResultsError` when the line is not a record of this schema.

        `where` says in messages where it stands, such as ``"out/records.jsonl:3"``.
        """
        try:
            record = _READER.validate_json(line)
        except ValidationError as error:
            raise ResultsError(f"{where} {_problem(line, error)}") from None
        if record.schema != SCHEMA:
            raise ResultsError(f"{where} {_other_schema(record.schema)}")
        # Safe though frozen: the record has not been returned yet.
        object.__setattr__(record, "per_trajectory", _compact(record.per_trajectory))
        return record


_READER: Final = TypeAdapter(Record)
_PLAIN: Final = tuple(f.name for f in fields(Record) if f.name != "per_trajectory")


class CompactTerms(Mapping[str, Terms]):
    """Terms by metric in little memory: boards hold those of tens of thousands of records.

    Whole numbers, which most terms are, take two bytes each.

    Parameters
    ----------
    names
        The metrics.
    terms
        Float64 array of shape (metrics, 2, n).
    """

    __slots__ = ("_others", "_position", "_whole")

    def __init__(self, names: tuple[str, ...], terms: NDArray[np.float64]) -> None:
        is_uint16 = ((terms >= 0) & (terms <= _MOST_WHOLE) & (terms % 1 == 0)).all(axis=(1, 2))
        self._position = _positions(names, tuple(is_uint16.tolist()))
        self._whole, self._others = terms[is_uint16].astype(np.uint16), terms[~is_uint16]

    def __getitem__(self, name: str) -> Terms:
        """Return numerators and denominators of a metric: float64 of shape (2, n)."""
        is_uint16, i = self._position[name]
        terms: Terms = self._whole[i].astype(np.float64) if is_uint16 else self._others[i]
        return terms

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the metrics."""
        return iter(self._position)

    def __len__(self) -> int:
        """Return the number of metrics."""
        return len(self._position)


_MOST_WHOLE: Final = np.iinfo(np.uint16).max


@functools.lru_cache(maxsize=1024)
def _positions(names: tuple[str, ...], is_uint16: tuple[bool, ...]) -> dict[str, tuple[bool, int]]:
    """Return for each metric whether its terms are whole, and its position among its like."""
    counts = {True: itertools.count(), False: itertools.count()}
    return {name: (flag, next(counts[flag])) for name, flag in zip(names, is_uint16, strict=True)}


def _compact(terms: Mapping[str, Any]) -> Mapping[str, Terms]:
    """Return lists of terms as arrays."""
    if len({len(numerators) for numerators, _ in terms.values()}) != 1:
        return {name: np.array(pair) for name, pair in terms.items()}
    return CompactTerms(tuple(terms), np.array([*terms.values()], np.float64))


def same_terms(first: Mapping[str, Terms], second: Mapping[str, Terms]) -> bool:
    """Tell whether terms are equal to the last bit."""
    if first.keys() != second.keys():
        return False
    return all(np.array_equal(terms, second[name]) for name, terms in first.items())


def _problem(line: str, error: ValidationError) -> str:
    """Describe the first problem of a line that is no record, after `where`."""
    try:
        plain = json.loads(line)
    except (ValueError, RecursionError):
        plain = None
    if isinstance(plain, dict) and plain.get("schema") != SCHEMA:
        return _other_schema(plain.get("schema"))
    first = error.errors(include_url=False, include_context=False)[0]
    path = ".".join(map(str, first["loc"]))
    value = "" if first["type"] in {"missing", "json_invalid"} else f", got {first['input']!r:.60}"
    return f"is no record: {path + ': ' if path else ''}{first['msg']}{value}"


def _other_schema(schema: object) -> str:
    return (
        f"has schema {schema!r:.20}, expected {SCHEMA}: it was written by another version of "
        "oodd-eval; run again, or install that version to read it"
    )


PACKAGES: Final = ("h5py", "numpy", "scikit-learn", "scipy", "torch")  # scores depend on them

_HOME: Final = Path(__file__).parents[1]


def gather(command: str = "") -> dict[str, Any]:
    """Return the provenance of results computed now, on this machine."""
    return {
        "oodd_eval": __version__,
        **_commit(),
        # A path that is no UTF-8 is no JSON either.
        "command": command.encode(errors="replace").decode(),
        "python": platform.python_version(),
        "packages": packages(),
        "platform": platform.platform(),
        "cpu": _cpu(),
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def packages() -> dict[str, str]:
    """Return the installed versions of `PACKAGES`."""
    versions = {}
    for name in PACKAGES:
        with suppress(Exception):  # of a package that is not there, or whose metadata is broken
            versions[name] = str(version(name))
    return versions


def _commit() -> dict[str, Any]:
    """Return commit and dirty flag when the harness runs from a checkout of its own.

    Tracked files of the packages alone make it dirty: results and notes change no score.
    """
    try:
        _git("ls-files", "--error-unmatch", "__init__.py")
        changes = _git("status", "-s", "--untracked-files=no", "--", ":(top,glob)**/oodd_*/**")
        return {"git_commit": _git("rev-parse", "HEAD"), "git_dirty": bool(changes)}
    except (OSError, subprocess.SubprocessError):
        return {"git_commit": None, "git_dirty": None}


def _git(*arguments: str) -> str:
    # Whichever git is on the path. Killed while it holds the index, it would leave a lock behind.
    command = ["git", "--no-optional-locks", *arguments]
    text = subprocess.check_output(  # noqa: S603  fixed arguments
        command, cwd=_HOME, stderr=subprocess.DEVNULL, encoding="utf-8", timeout=10
    )
    return text.strip()


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(names, "") or platform.processor() or platform.machine()


def summary(records: Sequence[Record]) -> str:
    """Return how many cells came to which status, such as ``48 ok, 8 timeout``."""
    counts = Counter(r.status for r in records)
    return ", ".join(f"{counts[s]} {s}" for s in STATUSES if counts[s]) or "no cells"
