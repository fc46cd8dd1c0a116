"""Metadata of installed distributions, and of those in a stranger's packages: read as data."""

import os
import re
from contextlib import suppress
from importlib.metadata import Distribution, distributions
from pathlib import Path
from typing import Final

from oodd_eval._version import __version__
from oodd_eval.data.bounded import read_bytes
from oodd_eval.errors import PluginError
from oodd_eval.plugins import PROJECT
from oodd_eval.plugins.discovery import describe, printable
from oodd_eval.plugins.installed import named, normalized

MOST_DISTRIBUTIONS: Final = 200
MOST_BYTES: Final = 10**6  # of a file of metadata
_NAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9._-]{0,98}[A-Za-z0-9])?")  # also of plug-ins


def installed_versions() -> dict[str, str]:
    """Return the versions of the environment's distributions by normalized name."""
    versions = {"oodd-eval": __version__}
    for distribution in distributions():
        with suppress(Exception):  # Broken metadata names nothing.
            name, version = named(distribution)
            versions.setdefault(normalized(name), version)
    return versions


def check_packages(packages: Path) -> None:
    """Raise `PluginError` for metadata in a stranger's packages that pip does not make of a wheel.

    A distribution that has the name of an installed one is refused, too. Nothing is imported.
    """
    installed = installed_versions()
    # Python looks for metadata in these.
    directories = [
        p for p in packages.iterdir() if p.name.lower().endswith((".dist-info", "egg-info"))
    ]
    if len(directories) > MOST_DISTRIBUTIONS:
        raise PluginError(
            f"{len(directories)} distributions, expected at most {MOST_DISTRIBUTIONS}"
        )
    for directory in directories:
        try:
            name, version = _checked(directory)
        except Exception as error:  # noqa: BLE001  metadata may break its reader in many ways
            reason = printable(f"{directory.name}: {describe(error)}")
            raise PluginError(f"its metadata cannot be used: {reason}") from None
        if (held := installed.get(normalized(name))) is not None:
            raise PluginError(
                f"its {name} {version} has the name of {held}, which is installed here"
            )


def _checked(directory: Path) -> tuple[str, str]:
    """Return name and version of a distribution; raise anything for metadata of another form."""
    for file in ("METADATA", "PKG-INFO", "entry_points.txt"):
        if os.path.lexists(directory / file):
            read_bytes(directory / file, MOST_BYTES, PluginError)
    distribution = Distribution.at(directory)
    points = [p.name for p in distribution.entry_points if p.group == PROJECT]
    for name in (named(distribution)[0], *points):
        if not _NAME.fullmatch(name):
            raise PluginError(f"it names {name!r:.80}, expected letters, digits, '.', '_' and '-'")
    return named(distribution)
