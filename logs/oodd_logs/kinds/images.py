"""Images, clouds of points and other bytes in messages: no sensors, so that they are left out."""

from collections.abc import Iterable
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
    is_image = isinstance(value, bytes | bytearray | memoryview)
    if isinstance(value, str):
        is_image = len(value) > LONGEST_TEXT
    elif isinstance(value, np.ndarray):
        is_image = value.dtype.itemsize == 1 and value.size > LONGEST
    elif isinstance(value, list) and len(value) > PIXELS:
        is_image = all(type(x) is int and 0 <= x < 256 for x in value)
    return () if is_image else None


KIND: Final = Kind("images", "an image or other bytes: no sensor", flatten=_flatten)
