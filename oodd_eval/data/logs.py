"""Logs of one's own: episodes in NumPy, HDF5, CSV and Minari files, read without running anything.

A part of a data set (training, say) is a place: a folder with a file for each episode (numpy, csv),
an HDF5 file with a group for each, or the directory of a Minari dataset. Every episode has
observations of shape (T + 1, D); actions of shape (T, A) and rewards of shape (T,) may be unknown.
"""

import array
import csv
import json
import re
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Final

import h5py
import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from oodd_eval.data.facts import Quantity
from oodd_eval.data.stored import BROKEN, child
from oodd_eval.errors import SplitError, TrajectoryError, UsageError
from oodd_eval.names import check_known

MOST_BYTES: Final = 2**28  # of one array, and of one text file
MOST_LINE: Final = 2**20  # characters of a line of a CSV file
ONSETS: Final = "onsets.csv"
ARRAYS: Final = ("observations", "actions", "rewards", "onset")
_NUMBERS: Final = "fiub"  # kinds of dtypes
_METHODS: Final = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # those that NumPy writes
_BROKEN: Final = (*BROKEN, EOFError, zipfile.BadZipFile, zlib.error)

Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class Log:
    """One episode as it was logged; `name` is that of its file or group, and of its twin's."""

    name: str
    where: str
    observations: Array
    actions: Array | None = None
    rewards: Array | None = None
    onset: int | None = None
    seed: int | None = None
    terminated: bool = False
    parameters: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Logs:
    """The episodes of one place, and as much as it tells of the columns.

    `sensors` and `actions` are empty where columns have no names. `discrete` is the number of
    actions of which each is a whole number from `start` on, 0 where they are not discrete or that
    is not known.
    """

    read: Callable[[], Iterator[Log]]
    sensors: tuple[Quantity, ...] = ()
    actions: tuple[Quantity, ...] = ()
    discrete: int = 0
    start: int = 0


def open_logs(form: str, place: Path) -> Logs:
    """Return the episodes of a place in one of `FORMATS`; nothing but names is read so far.

    Raises
    ------
    UsageError
        When the format is unknown, or there is nothing to read.
    TrajectoryError
        When what is there cannot be read; so does reading the episodes.
    """
    check_known("format", FORMATS, form)
    if not place.exists():
        raise UsageError(f"{str(place)!r} does not exist, expected {FORMATS[form].expected}")
    return FORMATS[form].open(place)


def test_places(form: str, place: Path) -> dict[str, Path]:
    """Return the places of test episodes by name: ``nominal`` and the anomalies.

    They are folders below `place`, or HDF5 files. Minari datasets may be called as an export calls
    them, such as ``test-iid-v0``: then only those that begin with ``test-`` count.
    """
    check_known("format", FORMATS, form)
    if not place.is_dir():
        raise UsageError(f"{str(place)!r} is no folder, expected one with the test episodes")
    found = {}
    for path in sorted(p for p in place.iterdir() if not p.name.startswith(".")):
        if form == "hdf5" and path.suffix in {".h5", ".hdf5"}:
            found[path.stem] = path
        elif form != "hdf5" and path.is_dir():
            found[path.name] = path
    exported = {name: re.fullmatch(r"test-(.+)-v\d+", name) for name in found}
    if form == "minari" and any(exported.values()):
        return {match[1]: found[name] for name, match in exported.items() if match}
    return found


def quantity(text: str) -> Quantity:
    """Return the name and the unit of a column such as ``"pressure[bar]"``; no unit is 1.

    >>> quantity("pressure[bar]"), quantity("switch")
    (Quantity(name='pressure', unit='bar'), Quantity(name='switch', unit='1'))
    """
    found = re.fullmatch(r"\s*([^\[\]]*[^\[\]\s])\s*(?:\[([^\[\]]+)\])?\s*", text)
    if not found or not text.isprintable():
        raise UsageError(f"{text!r} is no name of a column, expected one such as 'pressure[bar]'")
    return Quantity(found[1], found[2] or "1")


def _broken(where: str, error: BaseException) -> TrajectoryError:
    return TrajectoryError(f"{where} cannot be read: {type(error).__name__}: {error}")


def _must_be_numbers(where: str, dtype: np.dtype[Any], count: int) -> None:
    if dtype.kind not in _NUMBERS:
        raise TrajectoryError(f"{where} has dtype {dtype.str}, expected numbers")
    if count * dtype.itemsize > MOST_BYTES:
        raise TrajectoryError(
            f"{where} has {count * dtype.itemsize} bytes, expected at most {MOST_BYTES} an array: "
            "split the episode"
        )


def _files(place: Path, suffix: str) -> list[Path]:
    files = sorted(p for p in place.glob(f"*{suffix}") if p.name != ONSETS)
    if not files:
        raise UsageError(f"{str(place)!r} has no files *{suffix}, expected one an episode")
    return sorted(files, key=lambda p: _natural(p.stem))


def _natural(name: str) -> list[Any]:
    """Return what sorts ``episode_10`` behind ``episode_9``."""
    return [(1, int(p), "") if p.isdigit() else (0, 0, p) for p in re.split(r"([0-9]+)", name)]


def _onsets(place: Path) -> dict[str, int]:
    """Read ``onsets.csv`` of a folder: the columns file and onset; nothing where there is none."""
    path, found = place / ONSETS, {}
    if not path.exists():
        return {}
    with _text(path) as lines:
        for i, row in enumerate(csv.DictReader(lines), start=2):
            try:
                found[Path(row["file"]).stem] = int(row["onset"])
            except (KeyError, TypeError, ValueError) as error:
                expected = "the columns file and onset, a whole number"
                raise TrajectoryError(f"{path}, line {i}: {error!r}, expected {expected}") from None
    return found


def _text(path: Path) -> IO[str]:
    if path.stat().st_size > MOST_BYTES:
        raise TrajectoryError(f"{path} has more than {MOST_BYTES} bytes: split the episode")
    return path.open(encoding="utf-8-sig", newline="")


def _open_numpy(place: Path) -> Logs:
    def read() -> Iterator[Log]:
        onsets = _onsets(place)
        for path in _files(place, ".npz"):
            found = _npz(path)
            if "observations" not in found:
                raise TrajectoryError(f"{path} lacks the array observations")
            if found.get("onset", np.zeros(())).size != 1:
                raise TrajectoryError(f"{path}: onset is an array, expected one whole number")
            onset = int(found["onset"].item()) if "onset" in found else onsets.get(path.stem)
            arrays = found.get("actions"), found.get("rewards")
            yield Log(path.stem, str(path), found["observations"], *arrays, onset)

    return Logs(read)


def _npz(path: Path) -> dict[str, Array]:
    """Return the arrays of a file that are known; their sizes are looked at first."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name for name in ARRAYS if f"{name}.npy" in archive.namelist()]
            for name in names:
                if archive.getinfo(f"{name}.npy").compress_type not in _METHODS:
                    raise zipfile.BadZipFile(f"{name} is neither stored nor deflated")
                with archive.open(f"{name}.npy") as member:
                    old = npy.read_magic(member) == (1, 0)
                    header = npy.read_array_header_1_0 if old else npy.read_array_header_2_0
                    shape, _, dtype = header(member)
                _must_be_numbers(f"{path}, {name}", dtype, int(np.prod(shape, dtype=np.float64)))
        with np.load(path, allow_pickle=False) as stored:
            return {name: stored[name] for name in names}
    except TrajectoryError:
        raise
    except _BROKEN as error:
        raise _broken(str(path), error) from error


def _open_csv(place: Path) -> Logs:
    files = _files(place, ".csv")
    columns, _ = next(_lines(files[0]))
    named = {
        kind: tuple(quantity(c.partition(":")[2]) for c in columns if c.startswith(f"{kind}:"))
        for kind in ("obs", "action")
    }
    if not named["obs"]:
        expected = "obs:NAME[UNIT] for sensors, action:NAME[UNIT] for actions, and maybe reward"
        raise TrajectoryError(f"{files[0]} has the columns {columns}, expected {expected}")

    def read() -> Iterator[Log]:
        onsets = _onsets(place)
        for path in files:
            found = _table(path, columns)
            actions = found["action"] if named["action"] else None
            rewards = found["reward"].ravel() if "reward" in columns else None
            onset = onsets.get(path.stem)
            yield Log(path.stem, str(path), found["obs"], actions, rewards, onset)

    return Logs(read, named["obs"], named["action"])


def _lines(path: Path) -> Iterator[tuple[list[str], int]]:
    """Yield header and rows of a file with their line numbers, without empty rows at its end.

    They come one at a time: in memory, the text of a cell takes 20 times its bytes in the file.
    """
    empty: tuple[list[str], int] | None = None
    number = 0
    try:
        with _text(path) as text:
            pieces = iter(lambda: text.readline(MOST_LINE + 1), "")
            for number, row in enumerate(csv.reader(_bounded(pieces)), start=1):
                if number > 1 and not any(row):
                    empty = empty or (row, number)
                    continue
                if empty:
                    yield empty
                yield row, number
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise _broken(str(path), error) from error
    if not number:
        yield [], 1


def _bounded(lines: Iterator[str]) -> Iterator[str]:
    for line in lines:
        if len(line) > MOST_LINE:
            raise csv.Error(f"a line has more than {MOST_LINE} characters")
        yield line


def _table(path: Path, columns: list[str]) -> dict[str, Array]:
    """Return the numbers of each kind of columns; only observations follow the last transition."""
    rows = _lines(path)
    header, _ = next(rows)
    if header != columns:
        raise TrajectoryError(
            f"{path} has the columns {header}, expected those of the other files: {columns}"
        )
    own = {
        kind: [i for i, c in enumerate(columns) if c.partition(":")[0] == kind]
        for kind in ("obs", "action", "reward")
    }
    found = {kind: array.array("d") for kind in own}
    before: tuple[list[str], int] | None = None
    for row, number in rows:
        if before:
            for kind in ("action", "reward"):
                found[kind].extend(_numbers(path, columns, own[kind], *before))
        found["obs"].extend(_numbers(path, columns, own["obs"], row, number))
        before = row, number
        if 8 * sum(map(len, found.values())) > MOST_BYTES:
            most = MOST_BYTES // 8
            raise TrajectoryError(f"{path} has more than {most} numbers: split the episode")
    return {kind: np.array(found[kind]).reshape(-1, len(own[kind]) or 1) for kind in own}


def _numbers(
    path: Path, columns: list[str], own: list[int], row: list[str], number: int
) -> Iterator[float]:
    for c in own:
        try:
            yield float(row[c])
        except (ValueError, IndexError):
            got = repr(row[c]) if c < len(row) else "nothing"
            raise TrajectoryError(
                f"{path}, line {number}, column {columns[c]!r}: {got}, expected a number"
            ) from None


def _open_hdf5(place: Path) -> Logs:
    return Logs(lambda: _groups(place))


def _groups(path: Path) -> Iterator[Log]:
    """Read the groups of an HDF5 file, each an episode; nothing may lie in another file."""
    try:
        with h5py.File(path, "r") as file:
            for name in sorted(file, key=_natural):
                yield _group(f"{path}, group {name}", name, child(file, name))
    except TrajectoryError:
        raise
    except SplitError as error:
        raise TrajectoryError(str(error)) from None
    except _BROKEN as error:
        raise _broken(str(path), error) from error


def _group(where: str, name: str, group: Any) -> Log:
    if not isinstance(group, h5py.Group):
        raise TrajectoryError(f"{where} is a dataset, expected a group for each episode")
    found: dict[str, Array] = {}
    for part in (*ARRAYS, "terminations"):
        if part in group:
            dataset = child(group, part)
            if not isinstance(dataset, h5py.Dataset):
                raise TrajectoryError(f"{where}, {part} is a group, expected an array of numbers")
            _must_be_numbers(f"{where}, {part}", dataset.dtype, dataset.size)
            found[part] = dataset[()]
    if "observations" not in found:
        raise TrajectoryError(f"{where} lacks the dataset observations")
    said = {k: group.attrs[k] for k in ("onset", "seed", "parameters") if k in group.attrs}
    said |= {k: v for k, v in found.items() if k == "onset"}
    number = {k: int(np.asarray(said[k]).item()) for k in ("onset", "seed") if k in said}
    drawn = json.loads(said["parameters"]) if "parameters" in said else {}
    ended = bool(np.any(found["terminations"])) if "terminations" in found else False
    return Log(
        name,
        where,
        found["observations"],
        found.get("actions"),
        found.get("rewards"),
        number.get("onset"),
        number.get("seed"),
        ended,
        drawn if isinstance(drawn, dict) else {},
    )


def _open_minari(place: Path) -> Logs:
    """Open a Minari dataset: a Box of observations in a row, Box or Discrete actions."""
    data, metadata = place / "data" / "main_data.hdf5", place / "data" / "metadata.json"
    if not data.exists() or not metadata.exists():
        raise UsageError(
            f"{str(place)!r} is no Minari dataset in HDF5, expected data/main_data.hdf5 and "
            "data/metadata.json in it"
        )
    try:
        with _text(metadata) as text:
            said = json.load(text)
        spaces = [json.loads(said[f"{kind}_space"]) for kind in ("observation", "action")]
        types = [space["type"] for space in spaces]
        named = [
            tuple(Quantity(str(row["name"]), str(row["unit"])) for row in said.get(kind, ()))
            for kind in ("sensors", "actions")
        ]
        discrete, start = (
            int(spaces[1].get(k, 0)) if types[1] == "Discrete" else 0 for k in ("n", "start")
        )
    except (*_BROKEN, AttributeError) as error:
        raise _broken(str(metadata), error) from error
    if types[0] != "Box" or types[1] not in {"Box", "Discrete"}:
        raise TrajectoryError(
            f"{metadata}: observations are {types[0]} and actions {types[1]}, expected a Box of "
            "observations and a Box of actions or Discrete ones: flatten them first"
        )
    return Logs(lambda: _groups(data), named[0], named[1], discrete, start)


@dataclass(frozen=True, slots=True)
class _Format:
    open: Callable[[Path], Logs]
    expected: str


FORMATS: Final[Mapping[str, _Format]] = {
    "minari": _Format(_open_minari, "the directory of a Minari dataset"),
    "numpy": _Format(_open_numpy, "a folder with a file *.npz for each episode"),
    "hdf5": _Format(_open_hdf5, "an HDF5 file with a group for each episode"),
    "csv": _Format(_open_csv, "a folder with a file *.csv for each episode"),
}
"""Formats by name, with what a place has to be."""
