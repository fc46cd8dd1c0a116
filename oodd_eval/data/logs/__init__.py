"""Logs of users: episodes as other programs wrote them, read without running anything.

A part of a data set (training, say) is a folder with a file for each episode, a file with a group
for each, or the directory of a Minari dataset. Every module of this package that has a `Reader`
named ``READER`` adds a format; nothing else lists them.
"""

import csv
import importlib
import io
import pkgutil
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.bounded import EPISODE, read_bytes
from oodd_eval.data.facts import Quantity
from oodd_eval.errors import TrajectoryError, UsageError
from oodd_eval.names import check_known

ONSETS: Final = "onsets.csv"
ARRAYS: Final = ("observations", "actions", "rewards", "onset")
"""Arrays that an episode may have in formats that name them."""

Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class Log:
    """One episode as it was logged.

    Parameters
    ----------
    name
        That of its file or group, and of its twin's.
    source
        File, and group if there are several, as messages name it.
    observations
        Array of shape (T + 1, D).
    actions
        Array of shape (T, A), or of shape (T,); None where they are not known.
    rewards
        Array of shape (T,); None where they are not known.
    onset
        Number of the first row that may differ from the twin's; None for nominal episodes.
    seed
        Seed of the environment, if any.
    terminated
        True when the task ended the episode, False when a time limit did.
    parameters
        Values that the anomaly drew.
    """

    name: str
    source: str
    observations: Array
    actions: Array | None = None
    rewards: Array | None = None
    onset: int | None = None
    seed: int | None = None
    terminated: bool = False
    parameters: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Logs:
    """The episodes of one part, and what its files say of the columns.

    Parameters
    ----------
    read
        Yields the episodes; `TrajectoryError` when one cannot be read.
    sensors, actions
        Names and units of the columns; empty where the files do not name them.
    discrete
        Number of actions where each is a whole number; 0 where they are amounts or it is not known.
    start
        The lowest of these whole numbers.
    """

    read: Callable[[], Iterator[Log]]
    sensors: tuple[Quantity, ...] = ()
    actions: tuple[Quantity, ...] = ()
    discrete: int = 0
    start: int = 0


@dataclass(frozen=True, slots=True)
class Reader:
    """A format of logs.

    Parameters
    ----------
    name
        As users choose it.
    part
        What a part has to be, for messages.
    open
        Returns the logs of a part, of which no episode is read yet.
    suffixes
        Endings of a part that is one file; empty where it is a folder.
    tests
        Pattern of names of test parts, whose first group is the anomaly's name: where one matches,
        only those that match count.
    """

    name: str
    part: str
    open: Callable[[Path], Logs]
    suffixes: tuple[str, ...] = ()
    tests: str = "$."


def open_logs(form: str, part: Path) -> Logs:
    """Return the episodes of a part in one of `FORMATS`; nothing but names is read so far.

    Raises
    ------
    UsageError
        When the format is unknown, or there is nothing to read.
    TrajectoryError
        When what is there cannot be read; reading the episodes raises it, too.
    """
    check_known("format", FORMATS, form)
    if not part.exists():
        raise UsageError(f"{str(part)!r} does not exist, expected {FORMATS[form].part}")
    return FORMATS[form].open(part)


def test_parts(form: str, folder: Path) -> dict[str, Path]:
    """Return the parts with test episodes by name, ``nominal`` and the anomalies."""
    check_known("format", FORMATS, form)
    reader = FORMATS[form]
    if not folder.is_dir():
        raise UsageError(f"{str(folder)!r} is no folder, expected one with the test episodes")
    parts = {
        path.stem if reader.suffixes else path.name: path
        for path in sorted(folder.iterdir())
        if not path.name.startswith(".")
        and (path.suffix in reader.suffixes if reader.suffixes else path.is_dir())
    }
    matches = {name: re.fullmatch(reader.tests, name) for name in parts}
    if any(matches.values()):
        return {match[1]: parts[name] for name, match in matches.items() if match}
    return parts


def quantity(text: str) -> Quantity:
    """Return the name and the unit of a column such as ``"pressure[bar]"``; no unit is 1.

    >>> quantity("pressure[bar]"), quantity("switch")
    (Quantity(name='pressure', unit='bar'), Quantity(name='switch', unit='1'))
    """
    match = re.fullmatch(r"\s*([^\[\]]*[^\[\]\s])\s*(?:\[([^\[\]]+)\])?\s*", text)
    if not match or not text.isprintable():
        raise UsageError(f"{text!r} is no name of a column, expected one such as 'pressure[bar]'")
    return Quantity(match[1], match[2] or "1")


def unreadable(source: object, error: BaseException) -> TrajectoryError:
    """Return the error for a file that a library cannot read."""
    return TrajectoryError(f"{source} cannot be read: {type(error).__name__}: {error}")


def in_order(name: str) -> list[Any]:
    """Return what sorts ``episode_10`` behind ``episode_9``."""
    return [(1, int(p), "") if p.isdigit() else (0, 0, p) for p in re.split(r"([0-9]+)", name)]


def episode_files(folder: Path, suffix: str) -> list[Path]:
    """Return the files of a folder with an ending, in the order of the episodes."""
    files = sorted(path for path in folder.glob(f"*{suffix}") if path.name != ONSETS)
    if not files:
        raise UsageError(f"{str(folder)!r} has no files *{suffix}, expected one an episode")
    return sorted(files, key=lambda path: in_order(path.stem))


def read_onsets(folder: Path) -> dict[str, int]:
    """Return the onsets of episodes by name from ``onsets.csv``; none where it is absent."""
    path, onsets = folder / ONSETS, {}
    if not path.exists():
        return {}
    text = read_bytes(path, EPISODE.most, TrajectoryError).decode("utf-8-sig", errors="replace")
    rows = csv.DictReader(io.StringIO(text, newline=""))
    try:
        for row in rows:
            onsets[Path(row["file"]).stem] = int(row["onset"])
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        expected = "the columns file and onset, a whole number"
        raise TrajectoryError(
            f"{path}, line {rows.line_num}: {error!r}, expected {expected}"
        ) from None
    return onsets


def whole_number(source: str, name: str, value: Any) -> int | None:
    """Return a number that a file gives as an array or scalar, if it does; one value, no text."""
    if value is None:
        return None
    array = np.asarray(value)
    if array.size == 1 and array.dtype.kind in "iuf" and float(array.item()).is_integer():
        number = int(array.item())
        if abs(number) < 2**63:
            return number
    raise TrajectoryError(f"{source}: {name} is {value!r:.80}, expected one whole number")


def _formats() -> Iterator[Reader]:
    for module in pkgutil.iter_modules(__path__, f"{__name__}."):
        yield importlib.import_module(module.name).READER


FORMATS: Final[Mapping[str, Reader]] = {reader.name: reader for reader in _formats()}
"""Readers by the names of their formats."""
