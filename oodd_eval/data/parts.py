"""The parts of an environment's data: training, calibration, twins and one part per anomaly.

Names, onsets and parameters stay with the harness; a detector is handed `Trajectory` objects only.
"""

import contextlib
import copy
import functools
import itertools
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.condition import NOMINAL as NOMINAL_TEST
from oodd_eval.data.condition import Condition, in_suite_order
from oodd_eval.data.facts import BRIEF_TAIL, FIRST_ONSET, LogFacts, Quantity, Role
from oodd_eval.data.stored import StoredFile
from oodd_eval.data.trajectory import Trajectory, TrajectorySequence
from oodd_eval.errors import SplitError
from oodd_eval.names import check_known

TRAIN: Final = "train"
CALIBRATION: Final = "calibration"
TWINS: Final = "test/nominal"

NOMINAL: Final = (TRAIN, CALIBRATION, TWINS)
"""The nominal parts, which every environment has. Each part is a group of its file."""

FAILURES: Final = "failures"
"""The part with failed episodes for training, which few environments have."""

NAMES: Final = "names"  # the group that names the columns of observations and actions
_ROWS: Final = 1 << 14  # transitions of a large part that are read at once
_KEPT: Final = 1 << 24  # bytes up to which a part is decompressed once and kept


def conditions_in(groups: Iterable[str]) -> tuple[Condition, ...]:
    """Return the conditions among groups such as ``"test/iid"``, in the benchmark's order."""
    untested = (*NOMINAL, FAILURES, NAMES)
    tests = sorted(group.removeprefix("test/") for group in groups if group not in untested)
    return tuple(in_suite_order(map(Condition.parse, tests)))


class TrajectorySet(TrajectorySequence):
    """The trajectories of one part, decompressed once, or a few at a time beyond 16 MiB.

    Attributes
    ----------
    group
        Name of the part, such as ``"test/iid"``.
    lengths
        Transitions of each trajectory, int64 of shape (n,).
    seeds
        Seeds of the environment, int64 of shape (n,).
    """

    def __init__(
        self,
        parts: Mapping[str, Mapping[str, Any]],
        group: str,
        columns: list[int] | slice = slice(None),
    ) -> None:
        self._data, self._columns = parts[group], columns
        self.group = group
        self._offsets: NDArray[np.int64] = self._data["offsets"][:]
        self.lengths: NDArray[np.int64] = np.diff(self._offsets)
        self.seeds: NDArray[np.int64] = self._data["seeds"][:]

    def __len__(self) -> int:
        return len(self.lengths)

    def _one(self, i: int) -> Trajectory:
        return next(self._read(i, i + 1))

    def __iter__(self) -> Iterator[Trajectory]:
        # Several at a time: a chunk of the file holds rows of many trajectories.
        start = 0
        while start < len(self):
            most = self._offsets[start] + max(self.lengths[start], _ROWS)
            stop = int(np.searchsorted(self._offsets, most, side="right")) - 1
            yield from self._read(start, stop)
            start = stop

    @functools.cached_property
    def _rows(self) -> tuple[Any, Any]:
        """Observation and action rows: arrays of a small part, datasets of a large one."""
        observations, actions = self._data["observations"], self._data["actions"]
        if observations.nbytes + actions.nbytes > _KEPT:
            return observations, actions
        return observations[:], actions[:]

    def _read(self, start: int, stop: int) -> Iterator[Trajectory]:
        """Yield the trajectories of a range, whose rows are read at once."""
        first, last = int(self._offsets[start]), int(self._offsets[stop])
        observations, actions = self._rows
        observations, actions = observations[first + start : last + stop], actions[first:last]
        for i in range(start, stop):
            a, b = self._offsets[i : i + 2] - first
            rows = observations[a + i - start : b + i - start + 1, self._columns]
            yield Trajectory(rows, actions[a:b])

    def rewards(self, index: int) -> NDArray[np.float32]:
        """Return the rewards of trajectory number `index`, float32 of shape (T,)."""
        i = range(len(self))[index]
        rewards: NDArray[np.float32] = self._data["rewards"][
            self._offsets[i] : self._offsets[i + 1]
        ]
        return rewards

    @property
    def returns(self) -> NDArray[np.float64]:
        """Sum of rewards of each trajectory, of shape (n,)."""
        rewards = self._data["rewards"][:].astype(np.float64)
        return np.add.reduceat(rewards, self._offsets[:-1]) if len(self) else np.zeros(0)

    @property
    def terminated(self) -> NDArray[np.bool_]:
        """True for each episode that the simulator ended, False for one that the cap ended."""
        return np.asarray(self._data["terminated"][:], dtype=bool)

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """Name of each episode in its logs; empty texts where the split keeps none."""
        return self._texts("names")

    @functools.cached_property
    def tasks(self) -> tuple[str, ...]:
        """Task, or set point, of each episode; empty texts where there is only one."""
        return self._texts("tasks")

    def _texts(self, dataset: str) -> tuple[str, ...]:
        if dataset not in self._data:
            return ("",) * len(self)
        return tuple(text.decode("utf-8", "replace") for text in self._data[dataset][:])


Interval = tuple[int, int]
"""First row of an anomaly, -1 where it is not known, and the row after its last."""


class LabelledSet(TrajectorySet):
    """Anomalous episodes without twins, and the rows in which they are anomalous.

    Attributes
    ----------
    intervals
        Of each episode the rows [start, stop) that are anomalous, in order. A start of -1 is not
        known. An episode without intervals is known by its outcome alone.
    """

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        bounds = itertools.pairwise(self._data["interval_offsets"][:].tolist())
        rows = list(map(tuple, self._data["intervals"][:].tolist()))
        self.intervals: list[tuple[Interval, ...]] = [tuple(rows[a:b]) for a, b in bounds]


class AnomalousSet(TrajectorySet):
    """Anomalous trajectories and what is known of them; number i is the twin of test seed i.

    Attributes
    ----------
    onsets
        First observations that may differ from the twins', int64 of shape (n,).
    effects
        First observations that do differ, never before the onsets, int64 of shape (n,).
    redraws
        Numbers of draws that were rejected, int64 of shape (n,).
    """

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.onsets: NDArray[np.int64] = self._data["onsets"][:]
        self.effects: NDArray[np.int64] = self._data["effects"][:]
        self.redraws: NDArray[np.int64] = self._data["redraws"][:]

    @functools.cached_property
    def parameters(self) -> list[dict[str, Any]]:
        """Values that the anomaly drew for each trajectory; `SplitError` when they are no JSON."""
        values: list[dict[str, Any]] = []
        for text in self._data["parameters"][:]:
            drawn: Any = None
            with contextlib.suppress(ValueError, RecursionError):
                drawn = json.loads(text)
            if not isinstance(drawn, dict):
                raise SplitError(
                    f"{self.group}, parameters of trajectory {len(values)} are {text!r:.80}, "
                    "expected a JSON object: build or fetch the split again"
                )
            values.append(drawn)
        return values

    @property
    def tails(self) -> NDArray[np.int64]:
        """Transitions of each trajectory beyond its onset."""
        return self.lengths - self.onsets

    @property
    def brief(self) -> bool:
        """True when the median tail is under 20: the anomaly ends most episodes at once."""
        return bool(np.median(self.tails) < BRIEF_TAIL)


def check_twins(
    source: str, part: Mapping[str, Any], twins: Mapping[str, Any], *, recorded: bool
) -> None:
    """Raise `SplitError` unless an anomalous part has an episode for each twin, as labelled.

    A `recorded` episode is its twin's, bit for bit, up to its onset; before it, imported ones may
    differ. Of both the effect is the first row from the onset on that differs, or the onset where
    none does.
    """
    if len(part["seeds"]) != len(twins["seeds"]):
        raise SplitError(
            f"{source} has {len(part['seeds'])} trajectories, expected {len(twins['seeds'])}, one "
            "for each twin"
        )
    spans = (itertools.pairwise(map(int, rows["offsets"])) for rows in (part, twins))
    for i, ((start, end), (first, last)) in enumerate(zip(*spans, strict=True)):
        episode = f"{source}: trajectory {i}"
        onset, effect = int(part["onsets"][i]), int(part["effects"][i])
        if recorded and part["seeds"][i] != twins["seeds"][i]:
            raise SplitError(
                f"{episode} has the seed {part['seeds'][i]}, its twin {twins['seeds'][i]}, "
                "expected the same"
            )
        if recorded and onset < FIRST_ONSET:
            raise SplitError(
                f"{episode} has its onset at row {onset}, expected {FIRST_ONSET} or a later row"
            )
        if effect > last - first:
            raise SplitError(f"{episode} has its effect at row {effect}, behind its twin's end")
        common = min(end - start, last - first) + 1  # observations that both have
        rows = part["observations"][start + i : start + i + common]
        nominal = twins["observations"][first + i : first + i + common]
        actions = part["actions"][start : start + onset], twins["actions"][first : first + onset]
        pairs = {"observations": (rows[:onset], nominal[:onset]), "actions": actions}
        for name in (n for n, (a, b) in pairs.items() if recorded and a.tobytes() != b.tobytes()):
            raise SplitError(
                f"{source}: {name} of trajectory {i} differ from its twin's before its onset: "
                "build or fetch it again"
            )
        differs = (rows[onset:] != nominal[onset:]).any(axis=1)
        if onset + int(differs.argmax()) != effect:
            raise SplitError(
                f"{episode} first differs from its twin at row {onset + int(differs.argmax())}, "
                f"expected its effect, row {effect}"
            )


def columns_named(names: Sequence[str], name: str, environment: str) -> list[int]:
    """Return the numbers of the columns of a name, or of NAME[0], NAME[1] and so on, among names.

    Raises
    ------
    UnknownNameError
        When an environment has none.
    """
    block = [i for i, text in enumerate(names) if re.fullmatch(re.escape(name) + r"\[\d+\]", text)]
    if name not in names and not block:
        check_known(f"column of {environment}", names, name)
    return [names.index(name)] if name in names else block


class EnvironmentData:
    """The verified content of one environment, opened by `Split.environment`.

    Attributes
    ----------
    id
        Name of the environment.
    digest
        SHA-256 of all its parts.
    train
        Nominal trajectories to fit on.
    calibration
        Nominal trajectories that standardize scores and calibrate alarms.
    twins
        Nominal trajectories of the test seeds.
    anomalies
        Anomalies of this split, with ``@`` and the strength where there are several, as in
        ``iid@kept99``.
    failures
        Failed episodes to fit on, for detectors that learn from them; None where there are none.
    sensors, actions
        Names and units of the columns of observations and actions, of sensors also their roles.
    columns
        The sensors, and what monitors computed when the logs were recorded (role ``"score"``).
    discrete
        True when an action is a one-hot row.
    logs
        Facts of an environment that was imported; None for one that was recorded.
    ledger
        Sensors and what became of logs that were imported, a line each.
    """

    def __init__(
        self,
        environment: str,
        file: StoredFile,
        parts: Mapping[str, Mapping[str, Any]],
        digest: str,
        *,
        discrete: bool = False,
        logs: LogFacts | None = None,
        roles: Sequence[Role] = (),
        recordings: Mapping[str, tuple[str, ...]] | None = None,
        ledger: Sequence[str] = (),
    ) -> None:
        self.ledger = tuple(ledger)
        self.id, self.digest, self.discrete = environment, digest, discrete
        self.logs = self._logs = logs
        self._recordings = dict(recordings or {})
        self._file, self._parts = file, parts
        self.anomalies = tuple(map(str, conditions_in(parts)))
        self.sensors, self.actions = (
            tuple(map(Quantity.read, map(json.loads, names[:])))
            for names in (parts[NAMES]["sensors"], parts[NAMES]["actions"])
        )
        if roles:
            pairs = zip(self.sensors, roles, strict=True)
            self.sensors = tuple(replace(sensor, role=role) for sensor, role in pairs)
        self.columns = self.sensors
        self._show([i for i, column in enumerate(self.columns) if column.role != "score"])

    def of_columns(self, names: Sequence[str]) -> "EnvironmentData":
        """Return the same episodes with some of their columns in place of the sensors.

        Parameters
        ----------
        names
            Of `columns`. NAME stands for the columns NAME[0], NAME[1] and so on, too.

        Returns
        -------
        EnvironmentData
            It reads the same file.

        Raises
        ------
        UnknownNameError
            When there is no such column.
        """
        stored = [column.name for column in self.columns]
        numbers = [i for name in names for i in columns_named(stored, name, self.id)]
        view = copy.copy(self)
        view._show(numbers)  # noqa: SLF001  of this class
        return view

    def _show(self, columns: list[int]) -> None:
        """Let episodes have some of the stored columns as their sensors."""
        self.sensors = tuple(self.columns[i] for i in columns)
        if self._logs and self._logs.offsets:
            offsets = tuple(self._logs.offsets[i] for i in columns)
            self.logs = replace(self._logs, offsets=offsets)
        self._columns = slice(None) if columns == [*range(len(self.columns))] else columns
        groups = [group for group in (*NOMINAL, FAILURES) if group in self._parts]
        sets = {group: TrajectorySet(self._parts, group, self._columns) for group in groups}
        self.train, self.calibration, self.twins = (sets[part] for part in NOMINAL)
        self.failures = sets.get(FAILURES)

    @property
    def baseline(self) -> int:
        """Number of rows at the start of every episode that are nominal and not judged."""
        return 0 if self.logs is None else self.logs.baseline

    @property
    def paired(self) -> bool:
        """True where each anomalous episode has a nominal twin."""
        return self.logs is None or self.logs.paired

    def recordings(self, part: str) -> tuple[str, ...] | None:
        """Return for each episode of a part the recording of the logs that it is a window of.

        Parameters
        ----------
        part
            Such as ``"calibration"``.

        Returns
        -------
        tuple of str or None
            Equal texts for windows of one recording, in all parts. None where the split does not
            say it: every episode is a recording, or a simulator's, or an earlier version wrote it.
        """
        return self._recordings.get(part)

    def test_set(self, condition: str | Condition) -> TrajectorySet:
        """Return test episodes: of an anomaly, with twins or without, or ``"nominal"`` ones.

        Parameters
        ----------
        condition
            One of `anomalies`, or ``"nominal"``.

        Returns
        -------
        TrajectorySet
            An `AnomalousSet` where episodes are paired, else a `LabelledSet`.

        Raises
        ------
        UnknownNameError
            When this split has no such anomaly.
        """
        if str(condition) == str(NOMINAL_TEST):
            return self.twins
        return self.anomalous(condition) if self.paired else self.labelled(condition)

    def labelled(self, anomaly: str | Condition) -> LabelledSet:
        """Return the test episodes with one anomaly of an environment without twins.

        Parameters
        ----------
        anomaly
            One of `anomalies`, or the condition that it names.

        Returns
        -------
        LabelledSet
            In the order of the logs.

        Raises
        ------
        UnknownNameError
            When this split has no such anomaly.
        """
        check_known(f"anomaly of {self.id}", self.anomalies, str(anomaly))
        return LabelledSet(self._parts, f"test/{anomaly}", self._columns)

    def anomalous(self, anomaly: str | Condition) -> AnomalousSet:
        """Return the test trajectories with one anomaly, in the order of their twins.

        Parameters
        ----------
        anomaly
            One of `anomalies`, or the condition that it names.

        Returns
        -------
        AnomalousSet
            Trajectory number i is the counterpart of twin number i.

        Raises
        ------
        UnknownNameError
            When this split has no such anomaly.
        """
        check_known(f"anomaly of {self.id}", self.anomalies, str(anomaly))
        return AnomalousSet(self._parts, f"test/{anomaly}", self._columns)

    def arrays(self, part: str) -> dict[str, NDArray[Any]]:
        """Return the datasets of a part as they are stored.

        Parameters
        ----------
        part
            Such as ``"train"``.

        Returns
        -------
        dict
            Arrays by the names of the datasets.
        """
        return {name: dataset[:] for name, dataset in self._parts[part].items()}

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def parts_of(
    data: EnvironmentData, anomalies: Iterable[str | Condition]
) -> dict[str, TrajectorySet]:
    """Return the parts to score by name: calibration, the twins and the anomalies."""
    anomalous = {f"test/{a}": data.test_set(a) for a in anomalies}
    return {CALIBRATION: data.calibration, TWINS: data.twins, **anomalous}


def lengths_of(sets: Mapping[str, TrajectorySet], limit: int | None) -> dict[str, list[int]]:
    """Return the number of observations of each trajectory to score, by part."""
    return {part: [int(n) + 1 for n in s.lengths[:limit]] for part, s in sets.items()}
