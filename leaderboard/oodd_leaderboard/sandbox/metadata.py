"""Metadata of installed distributions, and of those in a stranger's packages: read as data."""

import os
import re
from contextlib import suppress
from importlib.metadata import Distribution, EntryPoint, distributions
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
_MODULE = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*")
_ENDINGS: Final = (".dist-info", "egg-info")  # in these Python looks for metadata


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
    installed, names = installed_versions(), set[str]()
    try:
        found = [p for p in packages.iterdir() if p.name.lower().endswith(_ENDINGS)]
    except OSError as error:
        raise PluginError(f"{str(packages)!r} cannot be read: {error.strerror}") from None
    if len(found) > MOST_DISTRIBUTIONS:
        raise PluginError(f"{len(found)} distributions, expected at most {MOST_DISTRIBUTIONS}")
    for directory in sorted(found):
        try:
            name, version = _checked(directory)
        except Exception as error:  # noqa: BLE001  metadata may break its reader in many ways
            reason = printable(f"{directory.name}: {describe(error)}")
            raise PluginError(f"its metadata cannot be used: {reason}") from None
        if (held := installed.get(normalized(name))) is not None:
            raise PluginError(
                f"distribution {name} {version} takes the name of {normalized(name)} {held}, which "
                "is installed here"
            )
        if normalized(name) in names:
            raise PluginError(f"two distributions are called {name}")
        names.add(normalized(name))


def _checked(directory: Path) -> tuple[str, str]:
    """Return name and version of a distribution; raise anything for metadata of another form."""
    if not directory.name.endswith(".dist-info") or directory.is_symlink():
        raise PluginError("expected a directory NAME-VERSION.dist-info")
    for file in ("METADATA", "PKG-INFO", "entry_points.txt"):
        if os.path.lexists(directory / file):
            read_bytes(directory / file, MOST_BYTES, PluginError)
    distribution = Distribution.at(directory)
    name, version = named(distribution)
    for kind, text in ("distribution", name), *(("plug-in", p.name) for p in _points(distribution)):
        if not _NAME.fullmatch(text):
            raise PluginError(f"name of a {kind} is {text!r:.80}, expected letters, digits, . _ -")
    for point in _points(distribution):
        if not _MODULE.fullmatch(point.module):
            raise PluginError(f"plug-in {point.name} is {point.value!r:.80}, expected a module")
    return name, version


def _points(distribution: Distribution) -> list[EntryPoint]:
    return [p for p in distribution.entry_points if p.group == PROJECT]
