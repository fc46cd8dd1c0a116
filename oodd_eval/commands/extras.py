"""Turn a missing optional dependency into the command that installs it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from oodd_eval.errors import MissingExtraError


@contextmanager
def extra(name: str, what: str) -> Iterator[None]:
    """Within this context a module that is not installed means that an extra is missing.

    Raises
    ------
    MissingExtraError
        Naming the module, the work and the command.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if isinstance(error, MissingExtraError) or (error.name or "").startswith("oodd_eval"):
            raise
        raise MissingExtraError(
            f'{what} needs {error.name}: pip install "oodd-eval[{name}]"'
        ) from error
