"""Import logs as an environment of a split of one's own, which every command then takes.

Test episodes come in pairs: an anomalous episode and its nominal twin have the same name. A twin is
an episode of the same task from the same start. Matched metrics compare the two from the onset on.
"""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from oodd_eval._version import __version__
from oodd_eval.data import layout
from oodd_eval.data.facts import (
    ANOMALIES,
    ENVIRONMENTS,
    GROUPS,
    NAME_PATTERN,
    SPLITS,
    Group,
    Quantity,
    in_order,
)
from oodd_eval.data.logs import Log, Logs, open_logs, test_places
from oodd_eval.data.parts import CALIBRATION, TRAIN, TWINS
from oodd_eval.data.split import Split, data_home
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import TrajectoryError, UsageError
from oodd_eval.names import check_known

IMPORTED: Final = "imported"
"""Word that a manifest has in place of the recipe and of the policy's digest."""

MOST_EPISODES: Final = 200_000

_Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Columns:
    """Names and units of the columns; `discrete` actions are numbered from `start` on."""

    sensors: tuple[Quantity, ...]
    actions: tuple[Quantity, ...]
    discrete: bool = False
    start: int = 0


class _Episode(NamedTuple):
    """A log that is as it must be."""

    log: Log
    trajectory: Trajectory
    rewards: NDArray[Any]


def import_data(
    name: str,
    environment: str,
    *,
    form: str,
    train: Path,
    calibration: Path,
    test: Path | None = None,
    sensors: Sequence[Quantity] = (),
    actions: Sequence[Quantity] = (),
    discrete: int = 0,
    groups: Mapping[str, str] | None = None,
    output: Path | None = None,
    progress: Callable[[str], None] = lambda _part: None,
) -> Split:
    """Import logs as one environment of a split; one of that name gets it as a further one.

    `name` and `environment` are one's own: no published split, no environment of the benchmark.
    `form` is one of `oodd_eval.data.logs.FORMATS`. `train` and `calibration` are places of nominal
    episodes: to fit on, and for the thresholds of alarms. `test` is a folder with the place
    ``nominal`` of the twins and one place for each anomaly, with its name; None for a split to
    watch with, which cannot be evaluated. `sensors` and `actions` are names and units of the
    columns, by default the files' own, else numbers; `discrete` is the number of actions where each
    is a whole number from 0 on, else 0. `groups` are those of anomalies that the benchmark does not
    know, by default ``"dynamics"``. `output` is the directory of the split, by default where splits
    are found. `progress` is called with the name of each part when it is read.

    Raises
    ------
    UsageError
        When a name is taken or wrong, or a place has nothing to read.
    TrajectoryError
        When an episode is not as it must be; the message names its file.
    """
    for kind, known, given in (("split", SPLITS, name), ("environment", ENVIRONMENTS, environment)):
        if given in known:
            raise UsageError(f"{given!r} is the benchmark's {kind}: choose a name of your own")
        _check_name(kind, given)
    directory = output or data_home() / name
    entries = _others(directory, name, environment)
    places = {} if test is None else test_places(form, test)
    kinds = _kinds(places, test, groups or {})
    logs = open_logs(form, train)
    columns = _columns(logs, sensors, actions, discrete)

    def episodes(place: Path) -> list[_Episode]:
        return [_episode(log, columns) for log in _read(open_logs(form, place), place)]

    def parts() -> Iterator[tuple[str, _Arrays]]:
        for part, place in ((TRAIN, train), (CALIBRATION, calibration)):
            yield part, _stacked(episodes(place), columns)
            progress(part)
        twins = episodes(places["nominal"]) if places else []
        yield TWINS, _stacked(twins, columns)
        progress(TWINS)
        for kind in kinds:
            yield f"test/{kind}", _anomalous(places[kind], episodes(places[kind]), twins, columns)
            progress(f"test/{kind}")

    own = layout.own_facts(environment, discrete=columns.discrete, groups=kinds)
    entries[environment] = layout.write_environment(
        directory / f"{environment}.h5",
        parts(),
        IMPORTED,
        sensors=columns.sensors,
        actions=columns.actions,
        own=own,
    )
    ordered = {e: entries[e] for e in in_order(entries, ENVIRONMENTS)}
    versions = {"oodd-eval": __version__, "numpy": np.__version__}
    layout.write_manifest(directory, _recipe(name), ordered, 0, versions)
    return Split(directory)


def _check_name(kind: str, name: str) -> None:
    if not re.fullmatch(NAME_PATTERN, name):
        raise UsageError(
            f"{name!r} cannot be the name of a {kind}: expected lower-case letters, digits and "
            "hyphens, at most 64"
        )


def _recipe(name: str) -> dict[str, str]:
    return {"name": name, "source": IMPORTED}


def _others(directory: Path, name: str, environment: str) -> dict[str, Any]:
    """Return the entries of the environments that the split has already."""
    if not (directory / layout.MANIFEST).exists():
        return {}
    manifest = layout.read_manifest(directory)
    if manifest["definition"] != _recipe(name):
        raise UsageError(
            f"{str(directory)!r} holds the split {manifest['name']!r}, which was not imported as "
            f"{name!r}: choose another name"
        )
    if environment in manifest["environments"]:
        raise UsageError(
            f"split {name!r} has an environment {environment!r} already: choose another name, or "
            f"remove {str(directory)!r} to import it anew"
        )
    return dict(manifest["environments"])


def _kinds(
    places: Mapping[str, Path], test: Path | None, groups: Mapping[str, str]
) -> dict[str, Group]:
    """Return the anomalies that there are, with their groups."""
    anomalies = [name for name in places if name != "nominal"]
    if test is not None and "nominal" not in places:
        raise UsageError(
            f"{str(test)!r} has {', '.join(places) or 'nothing'}, expected a place 'nominal', too: "
            "each anomalous episode needs a nominal twin of the same name to be compared with"
        )
    for name in anomalies:
        _check_name("anomaly", name)
    check_known(f"anomaly in {test}", anomalies, *groups)
    check_known("group", GROUPS, *groups.values())
    if wrong := [n for n, g in groups.items() if n in ANOMALIES and ANOMALIES[n].group != g]:
        shipped = ANOMALIES[wrong[0]].group
        raise UsageError(f"{wrong[0]!r} is a {shipped} anomaly of the benchmark: use another name")
    found: dict[str, Group] = {}
    for name in in_order(anomalies, ANOMALIES):
        own: Group = "sensor" if groups.get(name) == "sensor" else "dynamics"
        found[name] = ANOMALIES[name].group if name in ANOMALIES else own
    return found


def _columns(
    logs: Logs, sensors: Sequence[Quantity], actions: Sequence[Quantity], discrete: int
) -> Columns:
    """Return names and units of the columns, counted in the first episode."""
    log = next(logs.read(), None)
    if log is None:
        raise UsageError("there are no training episodes, expected at least one")
    width = _matrix(log, "observations", log.observations).shape[1]
    number = discrete or logs.discrete
    commands = np.empty((0, 0)) if log.actions is None else log.actions
    if not number and commands.ndim == 1 and commands.dtype.kind in "iub":
        raise UsageError(
            f"{log.where}: actions are whole numbers, expected the number of actions beside them: "
            "--discrete N, or rows of shape (T, 1) where they are amounts"
        )
    count = number or (commands.shape[1] if commands.ndim == 2 else 1)
    return Columns(
        _named("sensor", "--sensors", width, sensors, logs.sensors),
        _named(
            "action",
            "--actions",
            count if log.actions is not None else 0,
            actions,
            logs.actions if len(logs.actions) == count else (),
        ),
        bool(number),
        logs.start,
    )


def _named(kind: str, option: str, count: int, *named: Sequence[Quantity]) -> tuple[Quantity, ...]:
    found = next((tuple(own) for own in named if own), None)
    found = found or tuple(Quantity(f"{kind} {i}", "1") for i in range(count))
    names = [quantity.name for quantity in found]
    plain = all(f"{quantity.name}{quantity.unit}".isprintable() for quantity in found)
    if len(found) != count or len({*names}) < len(names) or not plain:
        raise UsageError(
            f"there are {count} {kind}s, named {', '.join(names)}: expected as many different "
            f"names ({option})"
        )
    return found


def _read(logs: Logs, place: Path) -> Iterator[Log]:
    """Yield the episodes of a place, which are neither none nor too many."""
    count = 0
    for count, log in enumerate(logs.read(), start=1):
        if count > MOST_EPISODES:
            raise UsageError(f"{place} has more than {MOST_EPISODES} episodes: import fewer")
        yield log
    if not count:
        raise UsageError(f"{place} has no episodes, expected at least one")


def _matrix(log: Log, what: str, array: NDArray[Any]) -> NDArray[Any]:
    if array.ndim != 2:
        raise TrajectoryError(
            f"{log.where}: {what} have shape {array.shape}, expected (rows, columns)"
        )
    return array


def _episode(log: Log, columns: Columns) -> _Episode:
    """Check one episode."""
    rows = _matrix(log, "observations", log.observations)
    actions = None if log.actions is None else _commands(log, log.actions, columns)
    try:
        trajectory = Trajectory(rows, actions)
    except TrajectoryError as error:
        raise TrajectoryError(f"{log.where}: {error}") from None
    found = trajectory.observation_dim, trajectory.action_dim
    expected = len(columns.sensors), len(columns.actions)
    if found != expected:
        raise TrajectoryError(
            f"{log.where} has {found[0]} sensors and {found[1]} columns of actions, expected "
            f"{expected[0]} and {expected[1]} as in the first training episode"
        )
    steps = trajectory.transitions
    if not steps:
        raise TrajectoryError(f"{log.where} has 1 observation, expected at least 2")
    rewards = np.zeros(steps) if log.rewards is None else log.rewards
    if rewards.shape != (steps,) or not np.isfinite(rewards).all():
        raise TrajectoryError(
            f"{log.where}: rewards have shape {rewards.shape}, expected {steps} finite numbers, "
            "one a transition"
        )
    return _Episode(log, trajectory, rewards)


def _commands(log: Log, actions: NDArray[Any], columns: Columns) -> NDArray[Any]:
    """Return actions as rows; a discrete one as a one-hot row."""
    if not columns.discrete:
        return _matrix(log, "actions", actions[:, None] if actions.ndim == 1 else actions)
    count, codes = len(columns.actions), actions.ravel() - columns.start
    if codes.size != len(actions):
        raise TrajectoryError(
            f"{log.where}: actions have shape {actions.shape}, expected (T,) as they are discrete"
        )
    wrong = ~np.isin(codes, np.arange(count))
    if wrong.any():
        i, first = int(wrong.argmax()), columns.start
        raise TrajectoryError(
            f"{log.where}: action {i} is {actions.ravel()[i]}, expected a whole number from "
            f"{first} to {first + count - 1}"
        )
    return np.eye(count, dtype=np.float32)[codes.astype(np.intp)]


def _stacked(episodes: Sequence[_Episode], columns: Columns) -> _Arrays:
    """Return the datasets of a nominal part, empty where there are no episodes."""
    rows = [np.empty((0, len(columns.sensors)), np.float32)]
    actions = [np.empty((0, len(columns.actions)), np.float32)]
    seeds = [e.log.seed for e in episodes]
    return {
        "observations": np.concatenate(rows + [e.trajectory.observations for e in episodes]),
        "actions": np.concatenate(actions + [e.trajectory.actions for e in episodes]),
        "rewards": np.concatenate([np.empty(0), *(e.rewards for e in episodes)]),
        "offsets": np.cumsum([0, *(e.trajectory.transitions for e in episodes)]),
        "seeds": np.array(range(len(seeds)) if None in seeds else seeds, np.int64),
        "terminated": np.array([e.log.terminated for e in episodes], np.uint8),
    }


def _anomalous(
    place: Path, episodes: Sequence[_Episode], twins: Sequence[_Episode], columns: Columns
) -> _Arrays:
    """Return the datasets of an anomaly, in the order of the twins."""
    by_name = {e.log.name: e for e in episodes}
    names = {twin.log.name for twin in twins}
    if odd := sorted(by_name.keys() ^ names):
        where = "has no nominal twin" if odd[0] in by_name else "is missing"
        raise TrajectoryError(
            f"{place}: episode {odd[0]!r} {where}, expected the episodes of 'nominal' and no "
            "others, each under the name of its twin"
        )
    ordered = [by_name[twin.log.name] for twin in twins]
    effects = [_effect(e, twin) for e, twin in zip(ordered, twins, strict=True)]
    return _stacked(ordered, columns) | {
        "onsets": np.array([e.log.onset for e in ordered], np.int64),
        "effects": np.array(effects, np.int64),
        "redraws": np.zeros(len(ordered), np.int64),
        "parameters": layout.pack_parameters([e.log.parameters for e in ordered]),
    }


def _effect(episode: _Episode, twin: _Episode) -> int:
    """Return the first row from the onset on that differs from the twin's."""
    where, onset = episode.log.where, episode.log.onset
    rows, others = episode.trajectory.observations, twin.trajectory.observations
    common = min(len(rows), len(others))
    if onset is None:
        raise TrajectoryError(
            f"{where} has no onset, the first row that may differ, expected 'onset' in the file "
            "or a line of onsets.csv beside it"
        )
    if not 0 <= onset < common:
        raise TrajectoryError(
            f"{where}: the onset is row {onset}, expected 0 to {common - 1}, the last row that "
            "the episode and its twin both have"
        )
    differs = (rows[onset:common] != others[onset:common]).any(axis=1)
    if not differs.any():
        raise TrajectoryError(f"{where} equals its twin from its onset, row {onset}, on")
    return onset + int(differs.argmax())
