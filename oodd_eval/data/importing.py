"""Import logs as an environment of a split of one's own, which every command then takes.

Test episodes come in pairs: an anomalous episode and its nominal twin have the same name. A twin is
an episode of the same task from the same start. Matched metrics compare the two from the onset on.
"""

import itertools
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from oodd_eval._version import __version__
from oodd_eval.data import layout
from oodd_eval.data.bounded import EPISODES
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
from oodd_eval.data.logs import Log, Logs, open_logs, test_parts
from oodd_eval.data.parts import CALIBRATION, TRAIN, TWINS
from oodd_eval.data.split import Split, data_home
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import TrajectoryError, UsageError
from oodd_eval.names import check_known

IMPORTED: Final = "imported"
"""Word that a manifest has in place of the recipe and of the policy's digest."""

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

    Parameters
    ----------
    name
        Name of the split: no published one.
    environment
        Name of the environment: none of the benchmark.
    form
        Name of a format, one of `oodd_eval.data.logs.FORMATS`.
    train, calibration
        Parts with nominal episodes: to fit on, and for the thresholds of alarms.
    test
        Folder with the part ``nominal`` of the twins and one part for each anomaly, under its name;
        None for a split to watch with, which cannot be evaluated.
    sensors, actions
        Names and units of the columns; by default the files' own, else numbers.
    discrete
        Number of actions where each is a whole number from 0 on, else 0.
    groups
        Groups of anomalies that the benchmark does not know, by default ``"dynamics"``.
    output
        Directory of the split, by default where splits are found.
    progress
        Called with the name of each part when it is read.

    Returns
    -------
    Split
        The split with the environment in it.

    Raises
    ------
    UsageError
        When a name is taken or wrong, or a part has nothing to read.
    TrajectoryError
        When an episode is not as it must be; the message names its file.
    """
    for kind, reserved, chosen in (
        ("split", SPLITS, name),
        ("environment", ENVIRONMENTS, environment),
    ):
        if chosen in reserved:
            raise UsageError(f"{chosen!r} is the benchmark's {kind}: choose a name of your own")
        _check_name(kind, chosen)
    directory = output or data_home() / name
    recipe = {"name": name, "source": IMPORTED}
    entries = _earlier_entries(directory, recipe, environment)
    tests = {} if test is None else test_parts(form, test)
    kinds = _kinds(tests, test, groups or {})
    columns = _columns(open_logs(form, train), sensors, actions, discrete)

    def episodes(source: Path) -> list[_Episode]:
        logs = open_logs(form, source).read()
        read = [_episode(log, columns) for log in itertools.islice(logs, EPISODES)]
        if not read or next(logs, None):
            raise UsageError(f"{source} has {len(read) or 'no'} episodes, expected 1 to {EPISODES}")
        return read

    def parts() -> Iterator[tuple[str, _Arrays]]:
        for part, source in ((TRAIN, train), (CALIBRATION, calibration)):
            yield part, _stacked(episodes(source), columns)
            progress(part)
        twins = episodes(tests["nominal"]) if tests else []
        yield TWINS, _stacked(twins, columns)
        progress(TWINS)
        for kind in kinds:
            yield f"test/{kind}", _anomalous(tests[kind], episodes(tests[kind]), twins, columns)
            progress(f"test/{kind}")

    facts = layout.own_facts(environment, discrete=columns.discrete, groups=kinds)
    entries[environment] = layout.write_environment(
        directory / f"{environment}.h5",
        parts(),
        IMPORTED,
        sensors=columns.sensors,
        actions=columns.actions,
        custom=facts,
    )
    ordered = {e: entries[e] for e in in_order(entries, ENVIRONMENTS)}
    versions = {"oodd-eval": __version__, "numpy": np.__version__}
    layout.write_manifest(directory, recipe, ordered, 0, versions)
    return Split(directory)


def _check_name(kind: str, name: str) -> None:
    if not re.fullmatch(NAME_PATTERN, name):
        raise UsageError(
            f"{name!r} cannot be the name of a {kind}: expected lower-case letters, digits and "
            "hyphens, at most 64"
        )


def _earlier_entries(
    directory: Path, recipe: Mapping[str, str], environment: str
) -> dict[str, Any]:
    """Return the entries of the environments that the split has already."""
    if not (directory / layout.MANIFEST).exists():
        return {}
    manifest = layout.read_manifest(directory)
    name = recipe["name"]
    if manifest["definition"] != recipe:
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
    tests: Mapping[str, Path], test: Path | None, groups: Mapping[str, str]
) -> dict[str, Group]:
    """Return the anomalies of the test parts, with their groups."""
    anomalies = [name for name in tests if name != "nominal"]
    if test is not None and "nominal" not in tests:
        raise UsageError(
            f"{str(test)!r} has {', '.join(tests) or 'nothing'}, expected a part 'nominal', too: "
            "each anomalous episode needs a nominal twin of the same name to be compared with"
        )
    for name in anomalies:
        _check_name("anomaly", name)
    check_known(f"anomaly in {test}", anomalies, *groups)
    check_known("group", GROUPS, *groups.values())
    if wrong := [n for n, g in groups.items() if n in ANOMALIES and ANOMALIES[n].group != g]:
        shipped = ANOMALIES[wrong[0]].group
        raise UsageError(f"{wrong[0]!r} is a {shipped} anomaly of the benchmark: use another name")
    return {
        name: ANOMALIES[name].group
        if name in ANOMALIES
        else cast("Group", groups.get(name, "dynamics"))
        for name in in_order(anomalies, ANOMALIES)
    }


def _columns(
    logs: Logs, sensors: Sequence[Quantity], actions: Sequence[Quantity], discrete: int
) -> Columns:
    """Return names and units of the columns, counted in the first episode."""
    log = next(logs.read(), None)
    if log is None:
        raise UsageError("there are no training episodes, expected at least one")
    if log.observations.ndim != 2:
        raise TrajectoryError(
            f"{log.source}: observations have shape {log.observations.shape}, expected "
            "(rows, columns)"
        )
    width = log.observations.shape[1]
    number = discrete or logs.discrete
    commands = np.empty((0, 0)) if log.actions is None else log.actions
    if not number and commands.ndim == 1 and commands.dtype.kind in "iub":
        raise UsageError(
            f"{log.source}: actions are whole numbers, expected the number of actions beside them: "
            "--discrete N, or rows of shape (T, 1) where they are amounts"
        )
    count = number or (commands.shape[1] if commands.ndim == 2 else 1)
    named = logs.actions if len(logs.actions) == count else ()
    count = 0 if log.actions is None else count
    return Columns(
        _named("sensor", width, sensors or logs.sensors),
        _named("action", count, actions or named),
        bool(number),
        logs.start,
    )


def _named(kind: str, count: int, quantities: Sequence[Quantity]) -> tuple[Quantity, ...]:
    columns = tuple(quantities) or tuple(Quantity(f"{kind} {i}", "1") for i in range(count))
    names = [quantity.name for quantity in columns]
    plain = all(f"{quantity.name}{quantity.unit}".isprintable() for quantity in columns)
    if len(columns) != count or len({*names}) < len(names) or not plain:
        raise UsageError(
            f"there are {count} {kind}s, named {', '.join(names)}: expected as many different "
            f"names (--{kind}s)"
        )
    return columns


def _episode(log: Log, columns: Columns) -> _Episode:
    """Check one episode."""
    actions = None if log.actions is None else _commands(log, log.actions, columns)
    try:
        trajectory = Trajectory(log.observations, actions)
    except TrajectoryError as error:
        raise TrajectoryError(f"{log.source}: {error}") from None
    widths = trajectory.observation_dim, trajectory.action_dim
    expected = len(columns.sensors), len(columns.actions)
    if widths != expected:
        raise TrajectoryError(
            f"{log.source} has {widths[0]} sensors and {widths[1]} columns of actions, expected "
            f"{expected[0]} and {expected[1]} as in the first training episode"
        )
    steps = trajectory.transitions
    if not steps:
        raise TrajectoryError(f"{log.source} has 1 observation, expected at least 2")
    rewards = np.zeros(steps) if log.rewards is None else log.rewards
    if rewards.shape != (steps,) or not np.isfinite(rewards).all():
        raise TrajectoryError(
            f"{log.source}: rewards have shape {rewards.shape}, expected {steps} finite numbers, "
            "one a transition"
        )
    return _Episode(log, trajectory, rewards)


def _commands(log: Log, actions: NDArray[Any], columns: Columns) -> NDArray[Any]:
    """Return actions as rows; a discrete one as a one-hot row."""
    if not columns.discrete:
        return actions[:, None] if actions.ndim == 1 else actions
    count, codes = len(columns.actions), actions.ravel() - columns.start
    if codes.size != len(actions):
        raise TrajectoryError(
            f"{log.source}: actions have shape {actions.shape}, expected (T,) as they are discrete"
        )
    wrong = ~np.isin(codes, np.arange(count))
    if wrong.any():
        i, first = int(wrong.argmax()), columns.start
        raise TrajectoryError(
            f"{log.source}: action {i} is {actions.ravel()[i]}, expected a whole number from "
            f"{first} to {first + count - 1}"
        )
    return np.eye(count, dtype=np.float32)[codes.astype(np.intp)]


def _stacked(episodes: Sequence[_Episode], columns: Columns) -> _Arrays:
    """Return the datasets of a nominal part, empty where there are no episodes."""
    rows, actions = (np.empty((0, len(c)), "f4") for c in (columns.sensors, columns.actions))
    seeds = [e.log.seed for e in episodes]
    return {
        "observations": np.concatenate([rows, *(e.trajectory.observations for e in episodes)]),
        "actions": np.concatenate([actions, *(e.trajectory.actions for e in episodes)]),
        "rewards": np.concatenate([np.empty(0), *(e.rewards for e in episodes)]),
        "offsets": np.cumsum([0, *(e.trajectory.transitions for e in episodes)]),
        "seeds": np.array(range(len(seeds)) if None in seeds else seeds, np.int64),
        "terminated": np.array([e.log.terminated for e in episodes], np.uint8),
    }


def _anomalous(
    source: Path, episodes: Sequence[_Episode], twins: Sequence[_Episode], columns: Columns
) -> _Arrays:
    """Return the datasets of an anomaly, in the order of the twins."""
    by_name = {e.log.name: e for e in episodes}
    names = {twin.log.name for twin in twins}
    if unpaired := sorted(by_name.keys() ^ names):
        problem = "has no nominal twin" if unpaired[0] in by_name else "is missing"
        raise TrajectoryError(
            f"{source}: episode {unpaired[0]!r} {problem}, expected the episodes of 'nominal' and "
            "no others, each under the name of its twin"
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
    source, onset = episode.log.source, episode.log.onset
    rows, nominal = episode.trajectory.observations, twin.trajectory.observations
    common = min(len(rows), len(nominal))
    if onset is None:
        raise TrajectoryError(
            f"{source} has no onset, the first row that may differ, expected 'onset' in the file "
            "or a line of onsets.csv beside it"
        )
    if not 0 <= onset < common:
        raise TrajectoryError(
            f"{source}: the onset is row {onset}, expected 0 to {common - 1}, the last row that "
            "the episode and its twin both have"
        )
    differs = (rows[onset:common] != nominal[onset:common]).any(axis=1)
    if not differs.any():
        raise TrajectoryError(f"{source} equals its twin from its onset, row {onset}, on")
    return onset + int(differs.argmax())
