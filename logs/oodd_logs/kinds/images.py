"""Images, clouds of points and other bytes in messages: no sensors, so that they are left out."""

from collections.abc import Iterable, Mapping
from typing import Any, Final

import numpy as np

from oodd_logs.kinds import Kind
from oodd_logs.kinds.number_lists import LONGEST

LONGEST_TEXT: Final = 1000
"""Characters of a text that is kept; longer ones are images, too, or documents."""

PIXELS: Final = 4096
"""Numbers from which on a matrix in a row is an image, as is a list of whole ones up to 255."""


def _flatten(_name: str, value: Any) -> Iterable[tuple[str, Any]] | None:
    """Return nothing in place of bytes; None for all else."""
    if isinstance(value, dict):
        return None
    if isinstance(value, str):
        return () if len(value) > LONGEST_TEXT else None
    if isinstance(value, bytes | bytearray | memoryview):
        return ()
    if isinstance(value, np.ndarray):
        return () if value.dtype.itemsize == 1 and value.size > LONGEST else None
    if isinstance(value, list) and len(value) > LONGEST and isinstance(value[0], Mapping | list):
        return None
    if isinstance(value, list) and len(value) > PIXELS:
        pixels = all(type(x) is int and 0 <= x < 256 for x in value)
        return () if pixels else None
    return None


KIND: Final = Kind("images", "an image or other bytes: no sensor", flatten=_flatten)
