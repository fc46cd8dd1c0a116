"""Checks of fitted detectors in files, for those that offer save and load."""

from __future__ import annotations

import contextlib
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from oodd_eval.plugins.causality import difference
from oodd_eval.plugins.conformance.bench import (
    Bench,
    CheckFailedError,
    CheckSkipped,
    doing,
    listed,
    scores_of,
)
from oodd_eval.plugins.conformance.kit import check
from oodd_eval.plugins.contract import Detector, StorableDetector

_PICKLE_SUFFIXES = frozenset({".pkl", ".pickle", ".joblib", ".dill"})


@check
def save_and_load(bench: Bench) -> None:
    """A new detector that loads what was saved gives the same scores, bit for bit."""
    with _saved(bench.fitted()) as place:
        loaded = _loaded(bench, place)
        for trajectory in bench.problem.nominal(2):
            expected = scores_of(bench.fitted(), trajectory)
            if wrong := difference(scores_of(loaded, trajectory), expected):
                raise CheckFailedError(f"a detector that loaded a saved fit differs: {wrong}")


@check
def shared_fit(bench: Bench) -> None:
    """One saved fit serves all values of the parameters that the spec says the fit ignores."""
    _storable(bench.fitted())
    if "horizon" not in bench.subject.fit_ignores:
        raise CheckSkipped("does not say that fits ignore the horizon")
    other = bench.subject.horizon + 2
    with _saved(bench.fitted()) as place:
        loaded = _loaded(bench, place, horizon=other)
        trajectory = bench.problem.nominal(1)[0]
        expected = scores_of(bench.fit(horizon=other), trajectory)
        if wrong := difference(scores_of(loaded, trajectory), expected):
            raise CheckFailedError(
                f"a fit of horizon {bench.subject.horizon}, loaded for horizon {other}, differs "
                f"from a fit of horizon {other}: {wrong}; it must not be in fit_ignores"
            )


@check
def saved_files(bench: Bench) -> None:
    """Saved files hold data, not pickled objects, which could run anything when loaded."""
    with _saved(bench.fitted()) as place:
        for path in listed(place):
            if reason := _pickled(path):
                raise CheckFailedError(
                    f"save wrote {path.relative_to(place)}, {reason}: expected JSON, npz without "
                    "objects, or safetensors"
                )


def _storable(detector: Detector) -> StorableDetector:
    offered = [callable(getattr(detector, name, None)) for name in ("save", "load")]
    if not any(offered):
        raise CheckSkipped("has no save and load")
    if not all(offered) or not isinstance(detector, StorableDetector):
        raise CheckFailedError("has only one of save and load: expected both, or none")
    return detector


@contextlib.contextmanager
def _saved(detector: Detector) -> Iterator[Path]:
    """Give the directory that a detector saved itself in."""
    storable = _storable(detector)
    with tempfile.TemporaryDirectory(prefix="oodd-check-") as name:
        place = Path(name)
        with doing("save"):
            storable.save(place)
        if not listed(place):
            raise CheckFailedError("save wrote no file into the directory that it was given")
        yield place


def _loaded(bench: Bench, place: Path, **changes: Any) -> Detector:
    detector = _storable(bench.make(**changes))
    with doing("load"):
        detector.load(place)
    return detector


def _pickled(path: Path) -> str:
    """Say in which way a file is, or holds, a pickle; empty if it does not."""
    if path.suffix in _PICKLE_SUFFIXES:
        return "a pickle by its name"
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            for name in archive.namelist():
                if Path(name).suffix in _PICKLE_SUFFIXES:
                    return f"which holds the pickle {name}"
                if name.endswith(".npy"):
                    with archive.open(name) as file:
                        if _holds_objects(file):
                            return f"which holds Python objects in {name}"
        return ""
    with path.open("rb") as file:
        # A pickle of protocol 2 or later begins with these two bytes.
        start = file.read(2)
        if start[:1] == b"\x80" and start[1:] in (b"\x02", b"\x03", b"\x04", b"\x05"):
            return "a pickle by its first bytes"
        file.seek(0)
        if path.suffix == ".npy" and _holds_objects(file):
            return "which holds Python objects"
    return ""


def _holds_objects(file: Any) -> bool:
    version = np.lib.format.read_magic(file)
    read = (
        np.lib.format.read_array_header_1_0 if version == (1, 0)
        else np.lib.format.read_array_header_2_0
    )  # fmt: skip
    return bool(read(file)[2].hasobject)


CHECKS = (save_and_load, shared_fit, saved_files)
