"""Files of text, packed by gzip or not, within bounds of what they unpack to."""

import gzip
import io
from pathlib import Path
from typing import Any, Final, TextIO

from oodd_eval.data.bounded import EPISODE

_LARGEST: Final = 8 * EPISODE.most  # bytes
_RATIO: Final = 100  # unpacked bytes for a packed one, of files of some size
_SOME: Final = 2**26  # bytes


def stem(path: Path) -> str:
    """Return the name of a file without its ending, and without ``.gz`` behind that."""
    return Path(path.name.removesuffix(".gz")).stem


def open_bytes(path: Path) -> io.BufferedReader:
    """Open a file for reading; its first bytes tell whether it is packed.

    Reading raises `TrajectoryError` where it unpacks to more than a log does.
    """
    with path.open("rb") as file:
        if file.read(2) != b"\x1f\x8b":
            return path.open("rb")
        file.seek(max(0, path.stat().st_size - 4))
        size = int.from_bytes(file.read(), "little")
    unpacked = _Unpacked(path)
    file = io.BufferedReader(unpacked, 2**17)
    if size > unpacked.most:  # or its end is cut: both are found here, before rows are
        while file.read(2**20):
            pass
        file.seek(0)
    return file


def open_text(path: Path, encoding: str) -> TextIO:
    """Open a file of text for reading, see `open_bytes`."""
    return io.TextIOWrapper(open_bytes(path), encoding)


def read_text(path: Path, encoding: str) -> str:
    """Return a text that is read at once; `TrajectoryError` where it is too large for that."""
    most = EPISODE.most // 4
    with open_bytes(path) as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise EPISODE.failure(f"{path} has more than {most} bytes")
    return io.TextIOWrapper(io.BytesIO(content), encoding).read()


class _Unpacked(gzip.GzipFile):
    """A packed file that is not read on where it unpacks to too much."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "rb")
        self.most = min(_LARGEST, max(_SOME, _RATIO * path.stat().st_size))

    def readinto(self, buffer: Any) -> int:
        """Read some bytes into a buffer."""
        content = self.read(len(buffer))
        if self.tell() > self.most:
            raise EPISODE.failure(f"{self.name} unpacks to more than {self.most} bytes")
        buffer[: len(content)] = content
        return len(content)
