"""Keep what C libraries print away from standard output.

PyBullet prints its build time when imported and a line per client from C, past ``sys.stdout``, so
that programs that parse our output would stumble over it.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def quiet_stdout() -> Iterator[None]:
    """Send file descriptor 1 to the null device for the duration of the block.

    Not for use while another thread prints. A process without a standard output is left alone.
    """
    if sys.stdout is not None:
        sys.stdout.flush()
    try:
        saved = os.dup(1)
    except OSError:
        yield
        return
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 1)
        yield
    finally:
        # C buffers of its own: what it printed has to go while the null device is in place.
        ctypes.CDLL(None).fflush(None)
        os.dup2(saved, 1)
        os.close(saved)
        os.close(null)
