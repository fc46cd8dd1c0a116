"""How few and how many episodes and rows a scan takes."""

from typing import Final

SHORTEST: Final = 2
"""Rows of the shortest episode that is judged."""
FITS: Final = 5
"""Fits of each of the two passes: each judges episodes that it has not seen."""
WINDOWS: Final = 40
"""Windows that a single recording is cut into."""
