"""Check score files before a number is read from them: HDF5 can hold more than numbers.

A file may hold the parts of one unit, each with two plain datasets, and nothing else: no links to
other places, no objects, no data kept outside the file, no filter but those of this format.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

from oodd_eval.data.facts import ANOMALIES
from oodd_eval.data.layout import TWINS
from oodd_eval.leaderboard.entry import SCORES
from oodd_eval.leaderboard.verify import rules
from oodd_eval.leaderboard.verify.cells import Records
from oodd_eval.leaderboard.verify.findings import Findings, shown
from oodd_eval.plugins.contract import MAX_WARM_UP
from oodd_eval.results.record import Record
from oodd_eval.scoring.unit import CALIBRATION

MOST_VALUES: Final = 20_000_000
"""Most scores of one file: its compressed size says little of what it unpacks to."""

PARTS: Final = (CALIBRATION, TWINS, *(f"test/{anomaly}" for anomaly in ANOMALIES))
"""Groups of a score file."""

_DTYPES: Final = {"scores": np.dtype(np.float64), "offsets": np.dtype(np.int64)}
_FILTERS: Final = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE}


def check_scores(
    directory: Path, files: Mapping[str, int], records: Records, findings: Findings
) -> dict[str, Record]:
    """Check an entry's score files.

    Returns
    -------
    The records, by where they stand, whose scores are there and sound.
    """
    present = {name for name in files if name.startswith(f"{SCORES}/")}
    if not present:
        return {}
    wanted: dict[str, dict[str, Record]] = {}
    for where, record in records.items():
        if record.ok:
            name = f"{SCORES}/{record.scores}.h5"
            wanted.setdefault(name, {})[where] = record
    for name in sorted(present - wanted.keys()):
        findings.refuse(name, "", "belongs to no record: no provenance.scores names it")
    sound: dict[str, Record] = {}
    for name, own in wanted.items():
        where, record = next(iter(own.items()))
        if name not in present:
            findings.refuse(
                where, "provenance.scores",
                f"names {name}, which is not there: an entry has all scores or none",
            )  # fmt: skip
        elif _check_file(directory / name, name, record.horizon, findings):
            sound |= own
    return sound


def _check_file(path: Path, name: str, horizon: int, findings: Findings) -> bool:
    before = findings.count
    try:
        with h5py.File(path, "r") as file:
            _check_content(file, name, horizon, findings)
    # A damaged file makes the library raise whatever it stumbles over.
    except (OSError, KeyError, ValueError, RuntimeError, TypeError, MemoryError) as error:
        findings.refuse(name, "", f"is damaged or no HDF5 file: {shown(str(error))[1:-1]}")
    return findings.count == before


def _check_content(file: h5py.File, name: str, horizon: int, findings: Findings) -> None:
    if file.userblock_size:
        findings.refuse(name, "userblock", f"has {file.userblock_size} bytes, expected none")
    for key, value in file.attrs.items():
        # What a fit cost: its time, its memory, the steps it scored.
        if (
            rules.parameter_name(key)
            or not isinstance(value, float | np.integer)
            or not (0 <= value < np.inf)
        ):
            findings.refuse(
                name, f"attribute {shown(key)[1:-1]}",
                f"is {shown(value)}, expected a cost: a finite number of at least 0",
            )  # fmt: skip
    groups: dict[str, Any] = {}
    for key, item in _children(file, name, "", findings).items():
        if key == "test" and isinstance(item, h5py.Group):
            groups |= {
                f"test/{k}": v for k, v in _children(item, name, "test/", findings).items()
            }  # fmt: skip
        else:
            groups[key] = item
    for part in sorted(groups.keys() - set(PARTS)):
        findings.refuse(name, shown(part)[1:-1], "is no part of a score file")
    for part in PARTS:
        if part not in groups:
            findings.refuse(name, part, "is missing")
        elif not isinstance(groups[part], h5py.Group):
            findings.refuse(name, part, "is no group")
        else:
            _check_part(groups[part], name, part, horizon, findings)


def _children(group: h5py.Group, name: str, prefix: str, findings: Findings) -> dict[str, Any]:
    """Return what lies directly in a group; links that lead elsewhere are refused unfollowed."""
    found = {}
    for key in group:
        if isinstance(group.get(key, getlink=True), h5py.HardLink):
            found[key] = group[key]
        else:
            kind = type(group.get(key, getlink=True)).__name__
            findings.refuse(
                name, f"{prefix}{shown(key)[1:-1]}", f"is a link ({kind}), expected data"
            )
    if prefix and len(group.attrs):
        findings.refuse(name, prefix.rstrip("/"), "has attributes, expected none")
    return found


def _check_part(group: h5py.Group, name: str, part: str, horizon: int, findings: Findings) -> None:
    before = findings.count
    items = _children(group, name, f"{part}/", findings)
    for key in sorted(items.keys() - _DTYPES.keys()):
        findings.refuse(name, f"{part}/{shown(key)[1:-1]}", "is no dataset of a score file")
    for key, dtype in _DTYPES.items():
        field = f"{part}/{key}"
        if key not in items:
            findings.refuse(name, field, "is missing")
        elif complaint := _dataset(items[key], dtype):
            findings.refuse(name, field, complaint)
    if findings.count > before:
        return
    offsets, scores = items["offsets"][:], items["scores"]
    if offsets[0] != 0 or (np.diff(offsets) < 1).any() or offsets[-1] != len(scores):
        findings.refuse(
            name, f"{part}/offsets",
            f"do not rise from 0 to {len(scores)}, the number of scores, by at least 1 each",
        )  # fmt: skip
        return
    for i, sequence in enumerate(np.split(scores[:], offsets[1:-1])):
        if complaint := _sequence(sequence, horizon):
            findings.refuse(name, f"{part}/scores", f"trajectory {i} {complaint}")
            return


def _dataset(item: Any, dtype: np.dtype[Any]) -> str:
    """Complain of what is not a plain one-dimensional dataset of a type."""
    if not isinstance(item, h5py.Dataset):
        return "is no dataset"
    if item.dtype != dtype:
        return f"has dtype {item.dtype.str}, expected {dtype}"
    if item.shape is None or item.ndim != 1 or not item.size:
        return f"has shape {item.shape}, expected one dimension and not empty"
    if item.size > MOST_VALUES:
        return f"has {item.size} values, expected at most {MOST_VALUES}"
    if item.is_virtual or item.external is not None:
        return "keeps its data in other files"
    if len(item.attrs):
        return "has attributes, expected none"
    pipeline = item.id.get_create_plist()
    filters = {pipeline.get_filter(i)[0] for i in range(pipeline.get_nfilters())}
    if extra := filters - _FILTERS:
        return f"is packed by filter {min(extra)}, expected gzip and shuffle at most"
    return ""


def _sequence(scores: np.ndarray[Any, np.dtype[np.float64]], horizon: int) -> str:
    """Complain of scores that break the contract: NaN in one leading block only, no infinity."""
    if np.isinf(scores).any():
        return f"is infinite at t = {int(np.flatnonzero(np.isinf(scores))[0])}"
    undefined = np.flatnonzero(np.isnan(scores))
    block = len(undefined)
    if block and undefined[-1] != block - 1:
        return f"is NaN at t = {int(undefined[-1])}, after a defined score"
    if block > (most := max(horizon, MAX_WARM_UP)):
        return f"is NaN for t < {block}, expected at most {most} undefined steps"
    return ""
