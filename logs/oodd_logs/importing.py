"""Import logs as an environment of a split of one's own, which every command then takes.

What a recipe says is done in `oodd_logs.episodes`; here its episodes are written. Where test
episodes come in pairs, an anomalous episode and its nominal twin have the same name, and metrics
compare the two from the onset on.
"""

import dataclasses
import glob
import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from oodd_eval._version import __version__
from oodd_eval.data import layout
from oodd_eval.data.facts import (
    ANOMALIES,
    ENVIRONMENTS,
    GROUPS,
    Group,
    LogFacts,
    Quantity,
    in_order,
)
from oodd_eval.data.files import only_writer, refuse_inputs
from oodd_eval.data.layout import IMPORTED, Blocks
from oodd_eval.data.parts import CALIBRATION, FAILURES, NOMINAL, TRAIN, TWINS
from oodd_eval.data.split import Split, data_home
from oodd_eval.errors import TrajectoryError, UnknownNameError, UsageError
from oodd_eval.names import check_known
from oodd_logs.episodes import EpisodeFacts, EpisodeSource, files_of, make_episodes, read_episodes
from oodd_logs.ledger import Ledger
from oodd_logs.marks import read_intervals
from oodd_logs.readers import readers
from oodd_logs.recipe import AnomalousFiles, Interval, NominalFiles, Recipe
from oodd_logs.recorded import Recorded
from oodd_logs.selecting import with_sensors
from oodd_logs.splitting import split_recording

ONSETS: Final = "onsets.csv"
"""File beside those of a part that names their onsets."""

_ANOMALY: Final = "anomaly"  # kind of episodes in a list of which some are anomalous
_NAME_BYTES: Final = 200

_Arrays = dict[str, NDArray[Any] | Blocks]


Say = Callable[[str], object]


def import_recipe(
    recipe: Recipe,
    root: Path,
    output: Path | None = None,
    *,
    replace: bool = False,
    progress: Say = str,
    report: Say = str,
    ledger: Ledger | None = None,
    names: Mapping[str, Sequence[Quantity]] | None = None,
) -> Split:
    """Import logs as a recipe says, as one environment of a split.

    A split of that name that was imported gets a further environment.

    Parameters
    ----------
    recipe
        The recipe.
    root
        Folder that its files are relative to.
    output
        Directory of the split, by default where splits are found.
    replace
        Whether an environment of that name that was imported earlier is imported anew.
    progress
        Called with the name of each part when it is written.
    report
        Called with each line of what was read and what was left out.
    ledger
        Takes all that was left out, held or changed.
    names
        Names and units in place of the files' own, of ``"sensors"`` and ``"actions"``.

    Returns
    -------
    Split
        The split with the environment in it.

    Raises
    ------
    UsageError
        When a name is taken, files or columns are not there, or the split would replace a log.
    TrajectoryError
        When a recording is not as it must be; the message names file and row.
    """
    recipe.check()
    directory = output or data_home() / recipe.split
    _entries(recipe, directory, replace=replace)
    for name in (layout.MANIFEST, f"{recipe.environment}.h5"):
        refuse_inputs(directory / name, files_of(recipe, root), "the split's file")
    with read_episodes(recipe, root) as source:
        for path in _unnamed_files(recipe, root):
            name = path.relative_to(root).as_posix()
            source.ledger.add("file", "dropped", "no line names it", source=name)
        (Ledger() if ledger is None else ledger).merge(source.ledger)
        for kind, quantities in (names or {}).items():
            if quantities:
                _name(source, kind, quantities)
        say = {"progress": progress, "report": report}
        return _write(recipe, directory, source, replace=replace, **say)


def import_data(
    name: str,
    environment: str,
    *,
    form: str,
    train: Path,
    calibration: Path,
    test: Path | None = None,
    sensors: Sequence[Quantity] = (),
    actions: Sequence[Quantity] = (),
    discrete: int = 0,
    groups: Mapping[str, str] | None = None,
    output: Path | None = None,
    **say: Any,
) -> Split:
    """Import parts in one format, of which test episodes have twins: a recipe in short.

    Parameters
    ----------
    name
        Name of the split: no published one.
    environment
        Name of the environment: none of the benchmark.
    form
        Name of a format, as `oodd_logs.readers.readers` has it.
    train, calibration
        Parts with nominal episodes: to fit on, and for the thresholds of alarms. A part is a folder
        of files, one file, or the directory of a data set.
    test
        Folder with the part ``nominal`` of the twins and one part for each anomaly, under its name;
        None for a split to watch with, which cannot be evaluated.
    sensors, actions
        Names and units of the columns; by default the files' own, else numbers.
    discrete
        Number of actions where each is a whole number from 0 on, else 0.
    groups
        Groups of anomalies that the benchmark does not know, by default ``"dynamics"``.
    output
        Directory of the split, by default where splits are found.
    **say
        ``replace`` and others of `import_recipe`.

    Returns
    -------
    Split
        The split with the environment in it.

    Raises
    ------
    UsageError
        When a name is taken or wrong, or a part has nothing to read.
    TrajectoryError
        When an episode is not as it must be; the message names its file.
    """
    check_known("format", readers(), form)
    tests = {} if test is None else _test_parts(form, test)
    files = {kind: _files_of(form, path) for kind, path in tests.items()}
    kinds = in_order((kind for kind in tests if kind != "nominal"), ANOMALIES)
    if test is not None and "nominal" not in tests:
        raise UsageError(
            f"{str(test)!r} has {', '.join(tests) or 'nothing'}, expected a part 'nominal', too, "
            "with a twin of the same name each; a recipe imports episodes without twins"
        )
    group_of = cast("dict[str, Group]", dict(groups or {}))
    check_known(f"anomaly in {test}", kinds, *group_of)
    check_known("group", GROUPS, *group_of.values())
    group_of = {k: ANOMALIES[k].group for k in kinds if k in ANOMALIES} | group_of
    anomalous = {
        kind: AnomalousFiles(files[kind], group_of.get(kind, "dynamics")) for kind in kinds
    }
    train_files, calibration_files = (_files_of(form, part) for part in (train, calibration))
    twins, intervals = files.get("nominal", ()), tuple(_onsets(tests[kind] for kind in kinds))
    nominal = NominalFiles(train=train_files, calibration=calibration_files, twins=twins)
    recipe = Recipe(name, environment, discrete=discrete, paired=True, format=form)
    keys: dict[str, Any] = {"nominal": nominal, "anomalous": anomalous, "intervals": intervals}
    recipe = dataclasses.replace(recipe, **keys)
    recipe.check()
    names = {"sensors": sensors, "actions": actions}
    return import_recipe(recipe, Path(), output, names=names, **say)


def _files_of(form: str, part: Path) -> tuple[str, ...]:
    """Return the files of a part as patterns that match nothing else."""
    reader = readers()[form]
    if not part.exists():
        raise UsageError(f"{str(part)!r} does not exist, expected {reader.part}, or a folder of it")
    files = [part]
    if part.is_dir() and not reader.fits(part):
        files = [p for p in part.iterdir() if p.is_file() and reader.fits(p) and _is_log(p)]
    if not files:
        file_kind = " or ".join(f"*{suffix}" for suffix in reader.suffixes) or reader.part
        raise UsageError(f"{str(part)!r} has no files {file_kind}, expected one an episode")
    return tuple(glob.escape(str(path)) for path in files)


def _is_log(path: Path) -> bool:
    return path.name != ONSETS and not path.name.startswith(".")


def _unnamed_files(recipe: Recipe, root: Path) -> Iterator[Path]:
    """Yield files beside those that a recipe names, of the same kind."""
    named = {path for path in files_of(recipe, root) if path.is_file()}
    kinds = {path.suffix for path in named}
    for folder in dict.fromkeys(path.parent for path in sorted(named)):
        beside = {path for path in folder.iterdir() if path.suffix in kinds and _is_log(path)}
        yield from sorted(path for path in beside - named if path.is_file())


def _test_parts(form: str, folder: Path) -> dict[str, Path]:
    """Return the parts with test episodes by name, ``nominal`` and the anomalies."""
    if not folder.is_dir():
        raise UsageError(f"{str(folder)!r} is no folder, expected one with the test episodes")
    reader = readers()[form]
    parts = {
        path.name if path.is_dir() else path.stem: path
        for path in sorted(folder.iterdir())
        if _is_log(path) and (path.is_dir() or reader.fits(path))
    }
    # Exports of splits lie beside their training parts.
    exported = {name: re.fullmatch(r"test-(.+)-v\d+", name) for name in parts}
    if any(exported.values()):
        return {match[1]: parts[name] for name, match in exported.items() if match}
    return parts


def _onsets(parts: Iterable[Path]) -> Iterator[Interval]:
    """Yield the onsets that files beside the episodes name, with the paths of these."""
    for part in parts:
        if not (part / ONSETS).exists():
            continue
        there = {path.name: path for path in part.iterdir()}
        there |= {path.stem: path for path in there.values() if path.name != ONSETS}
        for name, start, stop, kind in read_intervals(part / ONSETS):
            if name not in there:
                raise UnknownNameError(f"file of {part / ONSETS}", name, there)
            yield str(there[name]), start, stop, kind


def _name(source: EpisodeSource, kind: str, quantities: Sequence[Quantity]) -> None:
    """Give the sensors or actions some names; `UsageError` where these are not as many."""
    count, names = len(getattr(source, kind)), [quantity.name for quantity in quantities]
    if len(names) != count or len({*names}) < count:
        named = f"there are {count} {kind}, named {', '.join(names)}"
        raise UsageError(f"{named}: expected as many different names (--{kind})")
    is_discrete = kind == "actions" and source.discrete
    setattr(source, kind, tuple(Quantity(q.name, "1") if is_discrete else q for q in quantities))


def import_frames(
    name: str,
    *,
    train: Sequence[Any],
    calibration: Sequence[Any],
    test: Sequence[Any] | Mapping[str, Sequence[Any]] = (),
    labels: str | Sequence[str] = (),
    output: Path | None = None,
    replace: bool = False,
    report: Say = print,
    **keys: Any,
) -> Split:
    """Import episodes that are in memory: data frames, arrays or lists of mappings.

    Parameters
    ----------
    name
        Name of the split, and of its environment unless `keys` name that.
    train, calibration
        Nominal episodes. An episode is a data frame of pandas or polars, or a table of arrow's,
        with a row a step; an array of shape (rows, sensors), maybe masked or with named fields; a
        pair of such an array and one of actions; a mapping from columns to their values, or a list
        of mappings. Of lazy frames the rows are collected.
    test
        Test episodes by the name of their anomaly, ``"nominal"`` for nominal ones; or a list, in
        which those with anomalous labels are of the kind ``"anomaly"``.
    labels
        Columns that are 0 or false in nominal rows.
    output
        Directory of the split, by default where splits are found.
    replace
        Whether an environment of that name that was imported earlier is imported anew.
    report
        Called with each line of what was read and what was left out.
    **keys
        Keys of a recipe: ``sensors``, ``actions``, ``time``, ``rate``, ``baseline`` and so on. All
        columns that none of them names are sensors by default.

    Returns
    -------
    Split
        As all commands take it.

    Raises
    ------
    UsageError
        When a key is wrong, or the recipe does not fit the episodes.
    TrajectoryError
        When an episode is not as it must be; the message names it and its row.

    Examples
    --------
    >>> import tempfile
    >>> rows = np.random.default_rng(0).normal(size=(40, 30, 2))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     split = import_frames(
    ...         "arm", train=rows[:20], calibration=rows[20:], output=Path(folder), report=len
    ...     )
    ...     split.environments
    ('arm',)
    """
    from oodd_logs.frames import recordings_of  # noqa: PLC0415  for callers in Python

    tests = dict(test) if isinstance(test, Mapping) else {"": test}
    content: dict[str, Any] = {"split": name, **({"labels": labels} if labels else {}), **keys}
    content["nominal"] = {"train": TRAIN, "calibration": CALIBRATION, **keys.get("nominal", {})}
    tables = keys.get("anomalous", {})
    kinds: dict[str, Any] = {kind: {"files": kind} for kind in tests if kind != "nominal"}
    kinds = {_ANOMALY: {}} if "" in tests else kinds
    content["anomalous"] = {kind: files | tables.get(kind, {}) for kind, files in kinds.items()}
    recipe = Recipe.parse(content, "import_frames")
    parts = {TRAIN: train, CALIBRATION: calibration}
    parts |= {f"test/{kind}" if kind else "test": episodes for kind, episodes in tests.items()}
    either = {TWINS, f"test/{_ANOMALY}"}
    recorded = [
        Recorded(recording, Path(title), title, frozenset(either if part == "test" else {part}))
        for part, episodes in parts.items()
        for title, table in recordings_of(f"{part}-", episodes, next(iter(recipe.time), ""))
        for recording in split_recording(table, recipe.episode)
    ]
    if recorded:
        recipe = with_sensors(recipe, recorded[0].recording)
    directory = output or data_home() / recipe.split
    _entries(recipe, directory, replace=replace)
    with make_episodes(recipe, recorded) as source:
        return _write(recipe, directory, source, replace=replace, progress=str, report=report)


def _entries(recipe: Recipe, directory: Path, *, replace: bool) -> Mapping[str, Any]:
    """Return the entries of a manifest; `UsageError` for a name of what is not to be replaced."""
    if not (directory / layout.MANIFEST).exists():
        return {}
    manifest = layout.read_manifest(directory)
    name, environment = recipe.split, recipe.environment
    if manifest["definition"] != {"name": name, "source": IMPORTED}:
        raise UsageError(
            f"{str(directory)!r} holds the split {manifest['name']!r}, which was not imported "
            f"as {name!r}: choose another name"
        )
    if environment in manifest["environments"] and not replace:
        raise UsageError(
            f"split {name!r} has an environment {environment!r} already: choose another name, "
            "or replace it (--replace, replace=True)"
        )
    return cast("Mapping[str, Any]", manifest["environments"])


def _write(
    recipe: Recipe, directory: Path, source: EpisodeSource, *, replace: bool, **say: Say
) -> Split:
    """Write episodes as an environment, and the manifest."""
    keys = ("paired", "clock", "baseline", "order", "source", "licence", "citation")
    from_recipe = {key: getattr(recipe, key) for key in keys}
    facts = LogFacts(rate=source.rate, offsets=source.offsets, **from_recipe)
    environment_facts = layout.own_facts(
        recipe.environment, discrete=source.discrete, groups=source.groups, sensors=source.sensors
    )
    with only_writer(directory):
        # Another import may have added an environment meanwhile.
        entries = _entries(recipe, directory, replace=replace)
        entry = layout.write_environment(
            directory / f"{recipe.environment}.h5",
            _groups(source, say["progress"], paired=recipe.paired),
            IMPORTED,
            sensors=source.sensors,
            actions=source.actions,
            custom=environment_facts,
            # What earlier versions could import keeps its digest.
            logs=None if facts == LogFacts() else facts,
            recordings=_recordings(source),
        )
        # No part of the digest: it is of the episodes.
        entries = {**entries, recipe.environment: entry | {"ledger": source.summary}}
        ordered = {name: entries[name] for name in in_order(entries, ENVIRONMENTS)}
        versions = {"oodd-eval": __version__, "numpy": np.__version__}
        definition = {"name": recipe.split, "source": IMPORTED}
        layout.write_manifest(directory, definition, ordered, 0, versions)
    for line in (*source.notes, *source.summary):
        say["report"](line)
    return Split(directory)


def _groups(source: EpisodeSource, progress: Say, *, paired: bool) -> Iterator[tuple[str, _Arrays]]:
    """Yield the datasets of each part."""
    for part, episodes in source.parts.items():
        is_anomalous = part not in {*NOMINAL, FAILURES}
        twins = paired and is_anomalous
        arrays = _with_twins(source, part, episodes) if twins else _rows(source, episodes)
        if not paired:
            arrays["names"] = _texts([facts.episode.name for facts in episodes])
            arrays["tasks"] = _texts([facts.episode.task for facts in episodes])
        if is_anomalous and not paired:
            intervals = [interval for facts in episodes for interval in facts.episode.intervals]
            arrays["intervals"] = np.array(intervals, np.int64).reshape(-1, 2)
            counts = [len(facts.episode.intervals) for facts in episodes]
            arrays["interval_offsets"] = np.cumsum([0, *counts])
        yield part, arrays
        progress(part)


def _recordings(source: EpisodeSource) -> dict[str, list[int]]:
    """Return the recording of each episode by part, empty where each episode is one."""
    parts = source.parts.items()
    recordings = {part: [f.episode.recording or 0 for f in facts] for part, facts in parts}
    every = [*itertools.chain(*recordings.values())]
    return recordings if len({*every}) < len(every) else {}


def _texts(texts: Sequence[str]) -> NDArray[np.bytes_]:
    packed = [text.encode("utf-8", "backslashreplace")[:_NAME_BYTES] for text in texts]
    return np.array(packed, dtype=f"S{max(map(len, packed), default=0) or 1}")


def _rows(source: EpisodeSource, episodes: Sequence[EpisodeFacts]) -> _Arrays:
    """Return the datasets that every part has; the rows are read when they are written."""
    width, total = len(source.sensors), sum(facts.rows for facts in episodes)
    steps = total - len(episodes)

    def read(columns: slice | int, behind: int) -> Iterator[NDArray[np.float32]]:
        for facts in episodes:
            for rows in source.blocks(facts, behind=behind):
                yield rows[:, columns].astype(np.float32)

    seeds = [facts.episode.fields.get("seed") for facts in episodes]
    ended = [bool(facts.episode.fields.get("terminated", False)) for facts in episodes]
    return {
        "observations": Blocks((total, width), partial(read, slice(width), 0)),
        "actions": Blocks((steps, len(source.actions)), partial(read, slice(width, -1), 1)),
        "rewards": Blocks((steps,), partial(read, -1, 1)),
        "offsets": np.cumsum([0, *(facts.rows - 1 for facts in episodes)]),
        "seeds": np.array(range(len(seeds)) if None in seeds else seeds, np.int64),
        "terminated": np.array(ended, np.uint8),
    }


def _with_twins(source: EpisodeSource, part: str, episodes: Sequence[EpisodeFacts]) -> _Arrays:
    """Return the datasets of an anomaly, in the order of the twins."""
    by_name = _by_name(part, episodes)
    twins = _by_name(TWINS, source.parts[TWINS])
    if unpaired := sorted(by_name.keys() ^ twins.keys()):
        problem = "has no nominal twin" if unpaired[0] in by_name else "is missing"
        raise TrajectoryError(
            f"{part}: episode {unpaired[0]!r} {problem}, expected the names of the twins and no "
            "others; episodes without twins need a recipe without paired = true"
        )
    ordered = [by_name[name] for name in twins]
    effects = [_effect(source, by_name[name], twin) for name, twin in twins.items()]
    drawn = [dict(facts.episode.fields.get("parameters", {})) for facts in ordered]
    return _rows(source, ordered) | {
        "onsets": np.array([facts.episode.intervals[0][0] for facts in ordered], np.int64),
        "effects": np.array(effects, np.int64),
        "redraws": np.zeros(len(ordered), np.int64),
        "parameters": layout.pack_parameters(drawn),
    }


def _by_name(part: str, episodes: Sequence[EpisodeFacts]) -> dict[str, EpisodeFacts]:
    by_name: dict[str, EpisodeFacts] = {}
    for facts in episodes:
        if by_name.setdefault(facts.episode.name, facts) is not facts:
            name = repr(facts.episode.name)
            raise TrajectoryError(f"{part} has two episodes named {name}, expected one of each")
    return by_name


def _effect(source: EpisodeSource, facts: EpisodeFacts, twin: EpisodeFacts) -> int:
    """Return the first row from the onset on that differs from the twin's."""
    common, width = min(facts.rows, twin.rows), len(source.sensors)
    row = onset = facts.episode.intervals[0][0] if facts.episode.intervals else -1
    name = facts.episode.source
    if onset < 0:
        raise TrajectoryError(
            f"{name} has no onset, the first row that may differ, expected 'onset' in the file, a "
            "line of onsets.csv beside it, or labels, intervals or onset in a recipe"
        )
    if onset >= common:
        expected = f"0 to {common - 1}, the last row that the episode and its twin both have"
        raise TrajectoryError(f"{name}: the onset is row {onset}, expected {expected}")
    for blocks in zip(source.blocks(facts, onset), source.blocks(twin, onset), strict=False):
        rows, nominal = (block[: common - row, :width].astype(np.float32) for block in blocks)
        differs = (rows != nominal).any(axis=1)
        if differs.any():
            return row + int(differs.argmax())
        row += len(rows)
    raise TrajectoryError(f"{name} equals its twin from its onset, row {onset}, on")
