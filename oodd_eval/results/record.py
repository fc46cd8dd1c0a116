"""One evaluated cell: what it was, what came of it, and how that was computed.

A record is plain data. `Record.to_json` and `Record.from_json` are inverse to each other, with NaN
written as null, so that results can be stored, compared and published as lines of JSON.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Final

from oodd_eval.errors import ResultsError

SCHEMA: Final = 1
"""Version of the layout of a record; a reader refuses others."""

STATUSES: Final = ("ok", "error", "timeout", "oom", "invalid", "incompatible", "unavailable")
"""What may become of a cell. All but the first are failures and carry a reason."""

NAN: Final = float("nan")


@dataclass(frozen=True, slots=True)
class Metric:
    """A value with its 95 % interval over n trajectories; NaN where undefined."""

    value: float
    low: float = NAN
    high: float = NAN
    n: int = 0


@dataclass(frozen=True, slots=True)
class Record:
    """One cell: split x environment x anomaly x detector x parameters x horizon x seed.

    Attributes
    ----------
    cell
        The cell's id, such as ``mini/hopper/iid::riqn[h=1,seed=0]``.
    detector, detector_version, plugin
        Name of the detector, version of the distribution it is from, and ``distribution:plug-in``.
    parameters
        All parameters of the detector, defaults included.
    environment, anomaly, group, horizon, seed, split, split_digest
        What was evaluated.
    status, reason
        ``"ok"``, or the way in which the detector failed and one line about it.
    metrics
        Metrics by name; empty for a failed cell.
    counts
        Numbers of trajectories used, by part.
    per_trajectory
        For each metric that is a ratio of sums, its numerators and denominators in test order.
    seconds_fit, seconds_score, peak_rss_mb
        Cost of the fit this cell is from (shared by all anomalies); NaN where unknown.
    provenance
        Versions, machine, time, and the key of the score file.
    schema, protocol
        Versions of this layout and of splits, metrics and defaults.
    """

    cell: str
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
    status: str
    protocol: int
    reason: str = ""
    metrics: dict[str, Metric] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    per_trajectory: dict[str, tuple[list[float], list[float]]] = field(default_factory=dict)
    seconds_fit: float = NAN
    seconds_score: float = NAN
    peak_rss_mb: float = NAN
    provenance: dict[str, Any] = field(default_factory=dict)
    schema: int = SCHEMA

    @property
    def ok(self) -> bool:
        """Whether the cell has metrics."""
        return self.status == "ok"

    @property
    def identity(self) -> tuple[str, ...]:
        """What makes two records results of the same cell, the later replacing the earlier."""
        settings = [self.protocol, self.parameters, self.provenance.get("limit")]
        return self.cell, self.split_digest, json.dumps(settings, sort_keys=True)

    def value(self, metric: str) -> float:
        """Return a metric's value; NaN where the cell has none."""
        return self.metrics[metric].value if metric in self.metrics else NAN

    def to_json(self) -> str:
        """Return one line of JSON, keys in a fixed order, NaN as null."""
        plain = {f.name: getattr(self, f.name) for f in fields(self)}
        plain["metrics"] = {
            name: {"value": m.value, "low": m.low, "high": m.high, "n": m.n}
            for name, m in self.metrics.items()
        }
        return json.dumps(_without_nan(plain), allow_nan=False)

    @classmethod
    def from_json(cls, line: str, where: str = "record") -> Record:
        """Read a record back.

        Parameters
        ----------
        line
            One JSON object.
        where
            Where it stands, for messages: ``"out/records.jsonl:3"``.

        Raises
        ------
        ResultsError
            When it is not a record of this schema.
        """
        try:
            plain = json.loads(line)
        except json.JSONDecodeError as error:
            raise ResultsError(f"{where} is not JSON: {error}") from None
        if not isinstance(plain, dict):
            raise ResultsError(f"{where} is {type(plain).__name__}, expected a JSON object")
        if plain.get("schema") != SCHEMA:
            raise ResultsError(
                f"{where} has schema {plain.get('schema')!r}, expected {SCHEMA}: it was written by "
                "another version of oodd-eval"
            )
        names = {f.name for f in fields(cls)}
        if plain.keys() != names:
            raise ResultsError(
                f"{where} has other fields than a record: missing "
                f"{sorted(names - plain.keys())}, unknown {sorted(plain.keys() - names)}"
            )
        for name, kind in _KINDS.items():
            # bool is an int to isinstance, and never meant here.
            if not isinstance(plain[name], kind) or isinstance(plain[name], bool):
                raise ResultsError(f"{where}: {name} is {plain[name]!r:.60}, expected {kind}")
        if plain["status"] not in STATUSES:
            raise ResultsError(
                f"{where}: status is {plain['status']!r}, expected one of {', '.join(STATUSES)}"
            )
        try:
            plain["metrics"] = {k: _metric(m) for k, m in plain["metrics"].items()}
            plain["per_trajectory"] = {
                k: (_floats(pair[0]), _floats(pair[1]))
                for k, pair in plain["per_trajectory"].items()
            }
        except (TypeError, KeyError, IndexError, ValueError) as error:
            raise ResultsError(f"{where}: metrics cannot be read: {error!r}") from None
        for name in ("seconds_fit", "seconds_score", "peak_rss_mb"):
            plain[name] = _float(plain[name])
        return cls(**plain)


_KINDS: Final[Mapping[str, type]] = {
    **dict.fromkeys(("cell", "detector", "detector_version", "plugin", "environment"), str),
    **dict.fromkeys(("anomaly", "group", "split", "split_digest", "status", "reason"), str),
    **dict.fromkeys(("horizon", "seed", "protocol"), int),
    **dict.fromkeys(("parameters", "metrics", "counts", "per_trajectory", "provenance"), dict),
}


def _metric(plain: Mapping[str, Any]) -> Metric:
    return Metric(
        _float(plain["value"]), _float(plain["low"]), _float(plain["high"]), int(plain["n"])
    )


def _floats(values: Sequence[Any]) -> list[float]:
    return [_float(v) for v in values]


def _float(value: Any) -> float:
    return NAN if value is None else float(value)


def _without_nan(value: Any) -> Any:
    """Replace numbers that JSON does not know by None, at any depth."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(k): _without_nan(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(v) for v in value]
    return value
