"""Logs of users: recordings as other programs wrote them, read without running anything.

Every module of this package that has a `Reader` named ``READER`` adds a format; plug-ins add
others by the hook ``oodd_readers``. A reader opens one file (or the directory of a data set) and
yields recordings, whose rows are read when they are asked for.
"""

import contextlib
import dataclasses
import fnmatch
import functools
import importlib
import pkgutil
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from oodd_eval.data.facts import NAME_PATTERN, Quantity
from oodd_eval.errors import (
    MissingExtraError,
    OoddError,
    PluginError,
    TrajectoryError,
    UnknownNameError,
    UsageError,
)
from oodd_eval.names import check_known
from oodd_logs.kinds import missing_codes
from oodd_logs.readers.cells import check_width, without_codes
from oodd_logs.recording import Column, Recording, Topic

Options = Mapping[str, Any]
"""Values of a recipe's ``[read]`` table by name, without the format."""

NO_OPTIONS: Final[Options] = MappingProxyType({})

TOPICS: Final = {"topics": "list of globs over the names of topics"}
TRANSPOSE: Final = {"transpose": "true, or globs of the files in which a row is a sensor"}


@dataclass(frozen=True, slots=True)
class Reader:
    """A format of logs.

    Parameters
    ----------
    name
        As recipes choose it: lower-case letters, digits and hyphens.
    part
        What `read` opens, for messages: ``"a CSV file"``.
    suffixes
        Endings of file names by which the format is recognised, in lower case and with the dot.
    open
        Called with the path of a file or directory and the options of the recipe; yields its
        recordings. It may raise anything for content that is damaged.
    extra
        Extra of the project whose libraries the format needs; empty where it needs none.
    options
        Names of the options that it takes, with what they are.
    directory_markers
        Paths relative to a directory by which a data set in one is recognised, as globs:
        ``"meta/info.json"``. Empty for formats that are files.
    """

    name: str
    part: str
    suffixes: tuple[str, ...]
    open: Callable[[Path, Options], Iterable[Recording]]
    extra: str = ""
    options: Mapping[str, str] = field(default_factory=dict)
    directory_markers: tuple[str, ...] = ()

    def fits(self, path: Path) -> int:
        """Tell by a name whether a file or directory is of this format.

        Parameters
        ----------
        path
            The file or directory.

        Returns
        -------
        int
            Length of the ending that says so, 1 for a directory; 0 for what is of another format.
        """
        if path.is_dir():
            return int(any(next(path.glob(marker), None) for marker in self.directory_markers))
        name = path.name.lower()
        return max((len(suffix) for suffix in self.suffixes if name.endswith(suffix)), default=0)

    def read(self, path: Path, options: Options = NO_OPTIONS) -> Iterator[Recording]:
        """Yield the recordings of a file, or of the directory of a data set.

        Parameters
        ----------
        path
            The file or directory.
        options
            Those of `options` that a recipe sets, and ``missing_codes`` as it has them, in every
            format.

        Yields
        ------
        Recording
            In the order of the file; numbers in names count as numbers.

        Raises
        ------
        UsageError
            When an option is unknown or wrong, or there is nothing at the path.
        MissingExtraError
            When a library is not installed.
        TrajectoryError
            When the content cannot be read. Reading rows raises it, too.
        """
        options = dict(options)
        codes = missing_codes.check(missing_codes.KEY, options.pop(missing_codes.KEY, ()))
        check_known(f"option of the format {self.name}", self.options, *options)
        if not path.exists() and not path.is_symlink():
            raise UsageError(f"{str(path)!r} does not exist, expected {self.part}")
        if path.is_dir() and not self.directory_markers:
            raise UsageError(f"{str(path)!r} is a directory, expected {self.part}")
        if not path.is_dir() and not path.is_file():
            raise TrajectoryError(
                f"{path} is no plain file, but a broken link, a pipe or a device: remove it"
            )
        with readable(path):
            for recording in self.open(path, options):
                check_width(recording.source, sum(len(t.names) for t in recording.topics.values()))
                topics = {name: _guarded(t, recording) for name, t in recording.topics.items()}
                guarded = dataclasses.replace(recording, topics=topics)
                yield without_codes(guarded, codes) if codes else guarded


def readers() -> Mapping[str, Reader]:
    """Return the readers by name: the project's, and those of plug-ins that were registered."""
    return MappingProxyType({**shipped_readers(), **_registered})


def reader_for(path: Path, form: str = "") -> Reader:
    """Return the reader of a format by name, or that of a file or directory.

    Raises
    ------
    UnknownNameError
        When there is no such format.
    UsageError
        When the path is of none.
    """
    offered = readers()
    if form:
        check_known("format", offered, form)
        return offered[form]
    reader = max(offered.values(), key=lambda reader: reader.fits(path))
    if not reader.fits(path):
        advice = f"name it, [read] format = one of {', '.join(offered)}"
        raise UsageError(f"{path} has no ending of a known format: {advice}")
    return reader


def register_readers(offered: Iterable[Reader]) -> None:
    """Make readers of plug-ins known in this process; `check_reader` says which may be.

    Where several share a name, or it is one of the project's, it is ``PLUGIN/NAME``.
    """
    for reader in offered:
        check_reader(dataclasses.replace(reader, name=str(reader.name).rpartition("/")[2]))
        _registered[reader.name] = reader


def check_reader(reader: Reader) -> None:
    """Raise `PluginError` for a reader with a wrong name, or wrong suffixes."""
    if not re.fullmatch(NAME_PATTERN, str(reader.name)):
        raise PluginError(
            f"{reader.name!r} cannot be the name of a reader, expected lower-case letters, digits "
            "and hyphens"
        )
    wrong = [s for s in reader.suffixes if s != s.lower() or not s.startswith(".")]
    if isinstance(reader.suffixes, str) or wrong or not callable(reader.open):
        raise PluginError(
            f"reader {reader.name!r} has the suffixes {reader.suffixes!r:.80}, expected a tuple of "
            "lower-case endings such as '.log', and a function to open files with"
        )


def library(module: str, extra: str = "logs") -> Any:
    """Return a module of a library that an extra installs.

    Raises
    ------
    MissingExtraError
        When it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        package = module.partition(".")[0]
        if not (error.name or "").startswith(package):
            raise
        advice = f"pip install 'oodd-eval[{extra}]'"
        raise MissingExtraError(f"these logs need {package}: {advice}") from None


@contextlib.contextmanager
def readable(source: object) -> Iterator[None]:
    """Raise `TrajectoryError`, with the source, for whatever a library raises in the block."""
    try:
        yield
    except OoddError:
        raise
    except Exception as error:
        raise unreadable(source, error) from error


def unreadable(source: object, error: BaseException) -> TrajectoryError:
    """Return the error for a file that a library cannot read."""
    said = " ".join(str(error).split())[:300]
    if isinstance(error, UnicodeDecodeError):
        said += "; if it is text, [read] encoding = 'cp1252', or another, may be that of the file"
    return TrajectoryError(f"{source} cannot be read: {type(error).__name__}: {said}")


def in_order(name: str) -> list[Any]:
    """Return what sorts ``episode_10`` behind ``episode_9``."""
    return [(1, int(p), "") if p.isdigit() else (0, 0, p) for p in re.split(r"([0-9]+)", name)]


def quantity(text: str) -> Quantity:
    """Return the name and the unit of a column such as ``"pressure[bar]"``; no unit is 1.

    >>> quantity("pressure[bar]").row, quantity("switch").row
    ({'name': 'pressure', 'unit': 'bar'}, {'name': 'switch', 'unit': '1'})
    """
    match = re.fullmatch(r"\s*([^\[\]]*[^\[\]\s])\s*(?:\[([^\[\]]+)\])?\s*", text)
    if not match or not text.isprintable():
        raise UsageError(f"{text!r} is no name of a column, expected one such as 'pressure[bar]'")
    return Quantity(match[1], match[2] or "1")


def is_transposed(path: Path, options: Options) -> bool:
    """Tell whether a recipe says that rows and columns of a file are exchanged.

    The option ``transpose`` is true, or a list of globs over the names of files.
    """
    expected = "true, false or a list of globs"
    value = option(
        options, "transpose", False, lambda v: isinstance(v, bool) or are_texts(v), expected
    )
    globs = ["*"] if value is True else value or []
    return any(fnmatch.fnmatch(path.name, glob) or path.match(glob) for glob in globs)


def chosen(names: Iterable[str], options: Options, name: str = "topics") -> list[str]:
    """Return the names that an option selects, a glob or a list of globs; all without it.

    Raises
    ------
    UsageError
        When a glob fits none.
    """
    available = [*names]
    globs = option(
        options, name, ["*"], lambda v: isinstance(v, str) or are_texts(v), "a list of globs"
    )
    globs = [globs] if isinstance(globs, str) else globs
    for glob in globs:
        if available and not fnmatch.filter(available, glob):
            raise UnknownNameError(name.removesuffix("s"), glob, available)
    return [name for name in available if any(fnmatch.fnmatch(name, glob) for glob in globs)]


def option(
    options: Options, name: str, default: Any, fits: Callable[[Any], Any], expected: str
) -> Any:
    """Return the value of an option; `UsageError` where it is not what is expected."""
    value = options.get(name, default)
    if not fits(value):
        raise UsageError(f"[read] {name} = {value!r:.80}, expected {expected}")
    return value


def are_texts(value: Any) -> bool:
    """Tell whether a value is a list of texts."""
    return isinstance(value, list) and all(isinstance(text, str) for text in value)


def _guarded(topic: Topic, recording: Recording) -> Topic:
    columns = dict.fromkeys(topic.names)

    def read(names: Sequence[str], start: int, stop: int) -> dict[str, Column]:
        check_known(f"column of {recording.source}", columns, *names)
        if not names:
            return {}
        with readable(recording.source):
            return topic.read(names, max(0, start), min(stop, topic.rows))

    return dataclasses.replace(topic, read=read)


@functools.cache
def shipped_readers() -> dict[str, Reader]:
    """Return the readers of the project by name."""
    modules = [
        importlib.import_module(m.name) for m in pkgutil.iter_modules(__path__, f"{__name__}.")
    ]
    return {module.READER.name: module.READER for module in modules if hasattr(module, "READER")}


_registered: Final[dict[str, Reader]] = {}
