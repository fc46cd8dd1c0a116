"""Keep what C libraries print away from the terminal.

PyBullet prints its build time when imported (standard error) and a line per client (standard
output) from C, past ``sys.stdout``, so that programs that parse our output would stumble over it.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def quiet_streams() -> Iterator[None]:
    """Send file descriptors 1 and 2 to the null device for the duration of the block.

    Exceptions pass as ever. Not for use while another thread prints; a process without these
    streams is left alone.
    """
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()
    try:
        saved = [(fd, os.dup(fd)) for fd in (1, 2)]
    except OSError:
        yield
        return
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        for fd, _ in saved:
            os.dup2(null, fd)
        yield
    finally:
        # C has buffers of its own: what was printed has to go while the null device is in place.
        ctypes.CDLL(None).fflush(None)
        for fd, copy in saved:
            os.dup2(copy, fd)
            os.close(copy)
        os.close(null)
