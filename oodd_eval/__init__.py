"""oodd-eval: does a detector notice when the dynamics of a controlled system change?"""

from oodd_eval._version import __version__

__all__ = ["__version__"]
