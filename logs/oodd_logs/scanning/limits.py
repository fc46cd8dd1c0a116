"""How few and how many episodes and rows a scan takes."""

from typing import Final

SHORTEST: Final = 2
"""Rows of the shortest episode that is judged."""
FITS: Final = 20
"""Most fits: more episodes than this are judged in as many groups, each by a fit on the others."""
WINDOWS: Final = 40
"""Windows that a single recording is cut into."""
