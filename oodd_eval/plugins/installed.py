"""Entry points of installed distributions, any of which may have broken metadata."""

import functools
import re
from collections.abc import Iterable, Sequence
from importlib.metadata import Distribution, EntryPoint, EntryPoints, distributions, entry_points
from pathlib import Path
from typing import Any, Final, NamedTuple

LONGEST_NAME: Final = 200  # of distributions, versions and plug-ins


class BrokenMetadata(NamedTuple):
    """A distribution whose metadata cannot be used: its directory, and the reason.

    It `is_ours` when its entry points name this project, so that a plug-in is lost with it.
    """

    distribution: str
    reason: str
    is_ours: bool


def points_of(
    groups: Sequence[str], packages: Sequence[Path] = ()
) -> tuple[list[list[EntryPoint]], list[BrokenMetadata]]:
    """Return the entry points of some groups, and distributions that are left out as broken.

    They are those of some directories of `packages`, or of the environment.
    """
    broken: list[BrokenMetadata] = []
    try:
        every = [] if packages else [entry_points(group=group) for group in groups]
    except Exception:  # noqa: BLE001  one is broken; which one is found by looking at each
        every = []
    if not every:
        path: dict[str, Any] = {"path": [*map(str, packages)]} if packages else {}
        points = EntryPoints(_each(distributions(**path), broken))
        every = [points.select(group=group) for group in groups]
    return [[p for p in points if _is_sound(p, broken)] for points in every], broken


def _is_sound(point: EntryPoint, broken: list[BrokenMetadata]) -> bool:
    try:
        named(point.dist)
        short = 0 < len(point.name) <= LONGEST_NAME
        return short and point.name.isprintable() and point.module.isprintable()
    except Exception as error:  # noqa: BLE001
        broken.append(_broken(point.dist, error))
        return False


def _each(every: Iterable[Distribution], broken: list[BrokenMetadata]) -> list[EntryPoint]:
    """Return the entry points of every sound distribution, and add the others to a list."""
    # Of two with one name the first on the path counts, as it is the one that is imported.
    points: dict[str, list[EntryPoint]] = {}
    for distribution in every:
        try:
            name = normalized(named(distribution)[0])
            points.setdefault(name, [*distribution.entry_points])
        except Exception as error:  # noqa: BLE001
            broken.append(_broken(distribution, error))
    return [point for listed in points.values() for point in listed]


@functools.lru_cache(maxsize=256)
def named(distribution: Distribution | None) -> tuple[str, str]:
    """Return name and version, for which a distribution reads its files anew every time."""
    if distribution is None:
        return "unknown distribution", ""
    texts = distribution.metadata["Name"], distribution.metadata["Version"]
    for kind, text in zip(("name", "version"), texts, strict=True):
        if not isinstance(text, str) or not text.isprintable() or not 0 < len(text) <= LONGEST_NAME:
            raise ValueError(f"its {kind} is {text!r:.100}, expected a short line")
    return texts


def normalized(name: str) -> str:
    """Return the name of a distribution as indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _broken(distribution: Distribution | None, error: Exception) -> BrokenMetadata:
    """Return a broken distribution; its directory is named, as its metadata cannot be trusted."""
    directory = str(getattr(distribution, "_path", "unknown distribution"))
    reason = f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
    reason = f"its metadata cannot be read, reinstall or remove it: {reason}"
    try:
        is_ours = b"oodd_eval" in (Path(directory) / "entry_points.txt").read_bytes()
    except OSError:
        is_ours = False
    return BrokenMetadata(directory, reason, is_ours)
