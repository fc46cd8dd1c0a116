"""From the chunks of a build to the groups of a split's file, without holding them all."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import ANOMALIES
from oodd_eval.data.layout import TWINS, Blocks, dtypes_of

_PER_STEP: Final = ("observations", "actions", "rewards")
"""Arrays with a row per step; all others have one per trajectory."""


class Joined(Mapping[str, Mapping[str, NDArray[Any] | Blocks]]):
    """Groups of an environment, joined from their chunks while they are written.

    What grows with the steps comes in blocks, one chunk at a time: a part may be larger than
    memory. The rest is one entry per trajectory.

    Parameters
    ----------
    files
        By part, the npz files of its chunks in the order of their seeds; an array is named
        ``<group>:<dataset>``, with lengths in the place of offsets.
    """

    def __init__(self, files: Mapping[str, Sequence[Path]]) -> None:
        self._files = files
        self._names = ["train", "calibration", TWINS, *(f"test/{a}" for a in ANOMALIES)]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, group: str) -> dict[str, NDArray[Any] | Blocks]:
        small = [name for name in dtypes_of(group) if name not in {*_PER_STEP, "offsets"}]
        parts = {name: list(self._stored(group, name)) for name in ("lengths", *small)}
        joined: dict[str, NDArray[Any] | Blocks] = {
            name: np.concatenate(parts[name]) for name in small
        }
        lengths = np.concatenate(parts["lengths"])
        joined["offsets"] = np.concatenate([[0], np.cumsum(lengths)])
        total = int(lengths.sum())
        for name in _PER_STEP:
            first = next(self._stored(group, name))
            rows = total + len(lengths) if name == "observations" else total
            joined[name] = Blocks(
                (rows, *first.shape[1:]), functools.partial(self._stored, group, name)
            )
        return joined

    def _stored(self, group: str, name: str) -> Iterator[NDArray[Any]]:
        """Yield one array of every chunk that holds it."""
        for file in self._files[group.split("/", maxsplit=1)[0]]:
            with np.load(file, allow_pickle=False) as stored:
                if f"{group}:{name}" in stored.files:
                    yield stored[f"{group}:{name}"]
