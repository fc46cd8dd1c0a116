"""Check score files and curves, and recompute from the scores what an entry says.

HDF5 can hold more than numbers. A score file may hold the parts of one unit, each with two plain
datasets, and nothing else: no links to other places, no objects, no data kept outside the file, no
filter but those of this format.

Curves illustrate; nobody may choose the cells or the seed that look best, so that they are of all
cells of a row, and of its first seed.
"""

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

from oodd_eval.data.facts import TABLE1
from oodd_eval.data.parts import CALIBRATION, TWINS
from oodd_eval.data.split import Split
from oodd_eval.data.stored import check_plain
from oodd_eval.errors import OoddError, ResultsError, SplitError
from oodd_eval.leaderboard.entry import CURVES, SCORES
from oodd_eval.leaderboard.verify.files import Findings, find_text, parse_json, plain, shown
from oodd_eval.leaderboard.verify.formats import MOST_COST, ParameterName, complaint
from oodd_eval.leaderboard.verify.records import Records, compare_metrics, same
from oodd_eval.metrics.cusum import THRESHOLD
from oodd_eval.plugins.contract import MAX_WARM_UP
from oodd_eval.results import curve_file
from oodd_eval.results.directory import EXPLAINED, ORDER_BITS, ResultsDirectory
from oodd_eval.results.evaluate import rescore
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record

MOST_VALUES: Final = 20_000_000  # of a file: its size says little of its decompressed one

PARTS: Final = (CALIBRATION, TWINS, *(f"test/{anomaly}" for anomaly in TABLE1))
"""Groups of a score file."""

ROUNDED: Final = {"rel_tol": 0.01, "abs_tol": 2e-5}  # curves have three digits and five decimals

AREA: Final = 0.002  # what rounding changes of the area below a curve

_DTYPES: Final = {"scores": np.dtype(np.float64), "offsets": np.dtype(np.int64)}
_EXPLAINED: Final = dict.fromkeys(EXPLAINED, np.dtype(np.int32))  # of anomalous parts, if at all

Json = dict[str, Any]
Complaints = Iterator[tuple[str, str]]  # places in a file and what is wrong with them

_DATASET: Final[tuple[tuple[Callable[[Any, Any], object], str], ...]] = (
    (lambda d, _: isinstance(d, h5py.Dataset), "a dataset"),
    (lambda d, dtype: d.dtype == dtype, "float64 scores, int64 offsets and int32 explanations"),
    (lambda d, _: d.shape is not None and d.ndim == 1 and d.size, "one dimension and not empty"),
    (lambda d, _: d.size <= MOST_VALUES, f"at most {MOST_VALUES} values"),
    (lambda d, _: not (d.is_virtual or d.external), "data within this file"),
    (lambda d, _: not len(d.attrs), "no attributes"),
    (lambda d, _: not d.fletcher32, "no filter but gzip and shuffle"),
    (lambda d, _: _is_plain(d), "content that the file holds, as gzip in chunks of at most 64 MB"),
)
"""Predicates of an item and its expected type, each safe where those before hold."""


def _is_plain(item: h5py.Dataset) -> bool:
    try:
        check_plain(item)
    except SplitError:
        return False
    return True


def check_scores(
    directory: Path, files: Collection[str], records: Records, findings: Findings
) -> Records:
    """Check an entry's score files; return the records whose scores are there and sound."""
    present = {name for name in files if name.startswith(f"{SCORES}/")}
    wanted: dict[str, dict[str, Record]] = {}
    for where, record in records.items() if present else ():
        if record.ok:
            wanted.setdefault(f"{SCORES}/{record.scores}.h5", {})[where] = record
    for name in sorted(present - wanted.keys()):
        findings.refuse(name, "", "belongs to no record: the field scores of none names it")
    sound: dict[str, Record] = {}
    for name, own in wanted.items():
        where, record = next(iter(own.items()))
        before = findings.count
        if name not in present:
            message = f"names {name}, which is absent: an entry has all scores or none"
            findings.refuse(where, "scores", message)
            continue
        try:
            with h5py.File(directory / name, "r") as file:
                for field, message in _file(file, record.horizon):
                    findings.refuse(name, field, message)
        # A damaged file makes the library raise whatever it stumbles over.
        except (OSError, KeyError, ValueError, RuntimeError, TypeError, MemoryError) as error:
            findings.refuse(name, "", f"is damaged or no HDF5 file: {plain(str(error))}")
        if findings.count == before:
            sound |= own
    return sound


def _file(file: h5py.File, horizon: int) -> Complaints:
    if file.userblock_size:
        yield "userblock", f"has {file.userblock_size} bytes, expected none"
    yield from _attributes(file)
    groups: dict[str, Any] = {}
    yield from _children(file, "", groups)
    if isinstance(groups.get("test"), h5py.Group):
        yield from _children(groups.pop("test"), "test/", groups)
    for part in sorted(groups.keys() - set(PARTS)):
        yield plain(part), "is no part of a score file"
    for part in PARTS:
        if not isinstance(groups.get(part), h5py.Group):
            yield part, "is no group" if part in groups else "is missing"
        else:
            yield from _part(groups[part], part, horizon)


def _children(group: h5py.Group, prefix: str, found: dict[str, Any]) -> Complaints:
    """Add what lies directly in a group; links that lead elsewhere are refused unfollowed."""
    for key in group:
        link = group.get(key, getlink=True)
        if isinstance(link, h5py.HardLink):
            found[prefix + key] = group[key]
        else:
            yield prefix + plain(key), f"is a link ({type(link).__name__}), expected data"
    if prefix.rstrip("/") in PARTS:
        yield from _attributes(group, {"order"})
    elif prefix and len(group.attrs):
        yield prefix.rstrip("/"), "has attributes, expected none"


def _attributes(group: h5py.Group, names: Collection[str] = ()) -> Complaints:
    """Find attributes that are no costs, nor the order of groups, or not among some names."""
    for key, value in group.attrs.items():
        most = 2**ORDER_BITS if key == "order" else MOST_COST
        number = isinstance(value, float | np.integer) and 0 <= value <= most
        if complaint(ParameterName, key) or not number or (names and key not in names):
            yield f"attribute {plain(key)}", f"is {shown(value)}, expected a cost, or the order"


def _part(group: h5py.Group, part: str, horizon: int) -> Complaints:
    items: dict[str, Any] = {}
    found = list(_children(group, f"{part}/", items))
    explains = part not in (CALIBRATION, TWINS) and not group.keys().isdisjoint(_EXPLAINED)
    dtypes = _DTYPES | _EXPLAINED if explains else _DTYPES
    expected = {f"{part}/{key}": dtype for key, dtype in dtypes.items()}
    found += [(plain(n), "is no dataset of this format") for n in sorted(items.keys() - expected)]
    for name, dtype in expected.items():
        item = items.get(name)
        broken = (text for holds, text in _DATASET if not holds(item, dtype))
        found += [(name, f"is {plain(str(item))}, expected {text}") for text in islice(broken, 1)]
    yield from found
    if found:
        return
    scores, offsets = items[f"{part}/scores"][:], items[f"{part}/offsets"][:]
    if offsets[0] != 0 or (np.diff(offsets) < 1).any() or offsets[-1] != len(scores):
        yield f"{part}/offsets", f"do not rise from 0 to {len(scores)}, the number of scores"
        return
    for name in (name for name in EXPLAINED if explains):
        values = items[f"{part}/{name}"][:]
        if len(values) != len(scores) or ((values < 0) != np.isnan(scores)).any():
            yield f"{part}/{name}", "is not of all rows with a score, and negative for the others"
    most = max(horizon, MAX_WARM_UP)
    for i, sequence in enumerate(np.split(scores, offsets[1:-1])):
        undefined = np.isnan(sequence)
        start = len(sequence) if undefined.all() else int(np.argmin(undefined))
        if start > most or not np.isfinite(sequence[start:]).all():
            message = f"expected at most {most} undefined steps and then finite scores"
            yield f"{part}/scores", f"trajectory {i} is {plain(str(sequence))}, {message}"
            return


def check_rescored(records: Records, directory: Path, split: Split, findings: Findings) -> bool:
    """Recompute metrics from the entry's scores; return whether all could be, and agree."""
    before = findings.count
    try:
        fresh = rescore(list(records.values()), ResultsDirectory(directory), split)
    except (OoddError, ArithmeticError) as error:
        findings.refuse(SCORES, "", f"cannot be scored again: {error}")
        return False
    for (where, record), again in zip(records.items(), fresh, strict=True):
        for name in sorted(again.metrics.keys() - record.metrics):
            findings.refuse(where, f"metrics.{name}", "is missing, but the scores give it")
        for name in sorted(record.metrics.keys() - again.metrics):
            findings.refuse(where, f"metrics.{name}", "cannot be computed from the scores")
        compare_metrics(where, record, again.metrics, "the scores give", findings)
        for name in sorted(record.per_trajectory.keys() & again.per_trajectory.keys()):
            own, other = (r.per_trajectory[name] for r in (record, again))
            if own.shape != other.shape or not all(map(same, own.flat, other.flat)):
                message = "differs from what the scores give"
                findings.refuse(where, f"per_trajectory.{name}", message)
    return findings.count == before


def first_seeds(records: Iterable[Record]) -> dict[Setting, int]:
    """Return the lowest seed of each row that has an evaluated cell."""
    found: dict[Setting, int] = {}
    for record in records:
        if record.ok:
            found[record.setting] = min(found.get(record.setting, record.seed), record.seed)
    return found


def check_curves(
    contents: Mapping[str, bytes], records: Records, findings: Findings
) -> list[Json] | None:
    """Return the units of an entry's curves; None when there are none, or something is wrong."""
    before = findings.count
    name, text = find_text(contents, CURVES, findings)
    plain_json = None
    with findings.reading(name):
        plain_json = parse_json(text) if name else None
    if not name or findings.count > before:
        return None
    try:
        units: list[Json] = curve_file.check_curves(plain_json, CURVES)["units"]
    except ResultsError as error:
        # Its messages begin with the place: "curves.json: units[0].seed is False, ...".
        place, _, message = str(error).removeprefix(f"{CURVES}: ").partition(" ")
        findings.refuse(name, place.removeprefix(CURVES).rstrip(":"), message)
        return None
    undrawn = {str(record.cell): record for record in records.values() if record.ok}
    rows: dict[tuple[Setting, int], None] = {}
    for i, unit in enumerate(units):
        record = undrawn.pop(unit["cell"], None)
        if record is None:
            message = f"is {shown(unit['cell'])}, which no record is of"
            findings.refuse(name, f"units[{i}].cell", message)
            continue
        rows[record.setting, record.seed] = None
        for field, value in curve_file.identity(record).items():
            findings.expect(name, f"units[{i}].{field}", value, unit[field], "as in its record")
        if unit["example"]["index"] >= record.counts["test"]:
            findings.refuse(name, f"units[{i}].example.index", "is no test trajectory")
            continue
        for field, message in _contradictions(unit, record):
            findings.refuse(name, f"units[{i}].{field}", message)
    for cell, record in undrawn.items():
        if (record.setting, record.seed) in rows:
            message = f"lack {cell}: a row has curves of all its evaluated cells, or of none"
            findings.refuse(name, "units", message)
    first = first_seeds(records.values())
    for setting, seed in rows:
        if seed != first[setting]:
            why = f"but a row's curves are of its first seed, {first[setting]}"
            findings.refuse(name, "units", f"are of {setting.label(seed)}, {why}")
    return units if findings.count == before else None


def _contradictions(unit: Json, record: Record) -> Complaints:
    """Yield the fields of a cell's curves that contradict its record, and how."""
    fpr, tpr = (np.array(unit["roc"][name], np.float64) for name in ("fpr", "tpr"))
    low, high = (float(np.diff(fpr) @ ends) for ends in (tpr[:-1], tpr[1:]))
    area = record.value("auc_matched")
    if area < low - AREA or area > high + AREA:
        yield "roc", f"has an area from {low:.4f} to {high:.4f}, but auc_matched is {area:.4f}"
    swept = unit["delay_far"]
    far, delay, missed = map(record.value, ("far_twin", "delay_censored", "missed"))
    drawn = zip(*(swept[n] for n in ("threshold", "far", "delay_censored", "missed")), strict=True)
    if not any(all(map(_close, point, (THRESHOLD, far, delay, missed))) for point in drawn):
        told = f"far {far:.4g}, delay_censored {delay:.4g} and missed {missed:.4g}"
        yield "delay_far", f"lacks the record's {told} at threshold {THRESHOLD}"
    example = unit["example"]
    terms = record.per_trajectory.get("auc_matched", np.zeros((2, 0)))
    own = [n / d if d else math.nan for n, d in terms.T.tolist()]
    if own and not _close(example["auc_matched"], own[example["index"]]):
        yield "example.auc_matched", f"is not the record's {own[example['index']]:.4f}"


def _close(drawn: float | None, value: float) -> bool:
    """Tell whether a number is another one rounded for drawing; None is an undefined one."""
    return math.isnan(value) if drawn is None else math.isclose(drawn, value, **ROUNDED)


def check_recomputed_curves(
    units: Sequence[Json], records: Records, directory: Path, split: Split, findings: Findings
) -> None:
    """Recompute an entry's curves from its scores and compare."""
    drawn = {unit["cell"] for unit in units}
    chosen = [r for r in records.values() if str(r.cell) in drawn]
    again = {}
    with findings.reading(CURVES):
        fresh = curve_file.make_curves(chosen, ResultsDirectory(directory), split)
        again = {unit["cell"]: unit for unit in fresh["units"]}
    for i, unit in enumerate(units):
        if found := _difference(unit, again.get(unit["cell"], unit)):
            path, stored, value = found
            message = f"is {shown(stored)}, but the scores give {shown(value)}"
            findings.refuse(f"{CURVES} ({unit['cell']})", f"units[{i}]{path}", message)


def _difference(stored: Any, found: Any, path: str = "") -> tuple[str, Any, Any] | None:
    """Return the first place where two JSON values differ by more than rounding, and both."""
    if isinstance(stored, dict) and isinstance(found, dict) and stored.keys() == found.keys():
        pairs = ((f".{k}", stored[k], found[k]) for k in stored)
    elif isinstance(stored, list) and isinstance(found, list) and len(stored) == len(found):
        pairs = ((f"[{i}]", *both) for i, both in enumerate(zip(stored, found, strict=True)))
    elif isinstance(stored, float | int) and isinstance(found, float | int):
        close = math.isclose(stored, found, **ROUNDED)
        return None if close else (path, stored, found)
    else:
        return None if stored == found else (path, stored, found)
    return next(filter(None, (_difference(a, b, path + step) for step, a, b in pairs)), None)
