"""Episodes: what a recipe makes of recordings, nominal ones in parts, anomalous ones by kind.

Each recording is read once, and its rows wait on disk, in float64, until a part is written.
"""

import dataclasses
import glob
import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.bounded import EPISODES
from oodd_eval.data.facts import ANOMALIES, Group, Quantity, in_order
from oodd_eval.data.offsets import RunningMoments, is_coarse
from oodd_eval.data.parts import CALIBRATION, TRAIN, TWINS
from oodd_eval.errors import TrajectoryError, UnknownNameError, UsageError
from oodd_eval.names import check_known, counted
from oodd_logs.marks import AnomalousRows, IntervalList, merged, rows_of
from oodd_logs.readers import in_order as natural_order
from oodd_logs.readers import reader_for
from oodd_logs.recipe import FAILURE, AnomalousFiles, Recipe, anomaly_name
from oodd_logs.recorded import FILES, NOMINAL_ROLES, Recorded, StampedRows, text_of
from oodd_logs.recording import Recording
from oodd_logs.rows import Converter, Matrix, Spool, Tally, spool_stretch
from oodd_logs.selecting import (
    ChosenColumn,
    Layout,
    Selection,
    layout_of,
    named_columns,
    select_columns,
)
from oodd_logs.stamps import Steps, Stretch, Times, even_rate

EVERY: Final = "every"
"""The part with all episodes of a source that `read_every_episode` made."""

_LISTED: Final = 12  # columns without a use that are named
_ANOMALOUS: Final = "anomalous"  # where labels name no anomaly
_BLOCK: Final = 1 << 16  # rows that are read at once
_NO_FILES: Final = AnomalousFiles()
_SHARED: Final = (TRAIN, CALIBRATION, TWINS)
_TRUE: Final = {"1", "1.0", "true", "yes", "success", "ok"}
_FALSE: Final = {"0", "0.0", "false", "no", "failure", ""}


@dataclass(frozen=True, slots=True, eq=False)
class Episode:
    """An episode of logs.

    Parameters
    ----------
    name
        Of its recording, with a number behind ``#`` where that was cut.
    source
        File, as messages name it.
    observations, actions
        Arrays of shape (R, D) and (R - 1, A), float64.
    rewards
        Array of shape (R - 1,); None where they are not known.
    intervals
        Rows [start, stop) that are anomalous; a start of -1 is not known.
    outcome
        Whether it succeeded; None where that is not known.
    task
        Its task, or set point.
    kind
        Name of the anomaly; empty for a nominal episode.
    time
        Seconds of its rows, where the recording has stamps.
    fields
        Values that hold for the whole recording.
    """

    name: str
    source: str
    observations: Matrix
    actions: Matrix
    rewards: NDArray[np.float64] | None
    intervals: tuple[tuple[int, int], ...] = ()
    outcome: bool | None = None
    task: str = ""
    kind: str = ""
    time: Times | None = None
    fields: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class EpisodeFacts:
    """Facts of an episode whose rows are on disk; see `Episode`."""

    part: str
    name: str
    source: str
    first: int
    rows: int
    intervals: tuple[tuple[int, int], ...]
    outcome: bool | None
    task: str
    begin: float
    step: float
    fields: Mapping[str, Any]


@dataclass(slots=True, eq=False)
class EpisodeSource:
    """The episodes of a recipe, by part.

    Parameters
    ----------
    sensors, actions
        Names and units of the columns.
    discrete
        Whether actions are one-hot rows.
    rewards
        Whether rewards were logged.
    rate
        Rows in a second, where that is known.
    parts
        Facts of the episodes by part: ``train``, ``calibration``, ``test/nominal``, ``test/KIND``.
    groups
        Groups of the anomalies.
    unused
        Columns that no line of the recipe names.
    notes
        What was read and left out, a line each.
    offsets
        Subtracted from each sensor; empty where nothing is.
    """

    sensors: tuple[Quantity, ...]
    actions: tuple[Quantity, ...]
    discrete: bool
    rewards: bool
    _spool: Spool
    _kept: tuple[int, ...]
    rate: float | None = None
    parts: dict[str, list[EpisodeFacts]] = field(default_factory=dict)
    groups: dict[str, Group] = field(default_factory=dict)
    unused: tuple[str, ...] = ()
    notes: list[str] = field(default_factory=list)
    offsets: tuple[float, ...] = ()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Remove the rows from disk."""
        self._spool.close()

    def rows(self, facts: EpisodeFacts, start: int, stop: int) -> Matrix:
        """Return rows of an episode.

        Parameters
        ----------
        facts
            One of `parts`.
        start, stop
            First and the row after the last.

        Returns
        -------
        array of shape (rows, sensors + actions + 1)
            Observations without their offsets, actions, the reward.
        """
        rows = self._spool.read(facts.first + start, facts.first + stop)[:, self._kept]
        if self.offsets:
            rows[:, : len(self.sensors)] -= self.offsets
        return rows

    def blocks(self, facts: EpisodeFacts, start: int = 0, behind: int = 0) -> Iterator[Matrix]:
        """Yield rows of an episode in blocks, from some row on, but for the last `behind`."""
        for first in range(start, facts.rows - behind, _BLOCK):
            yield self.rows(facts, first, min(first + _BLOCK, facts.rows - behind))

    def episodes(self, part: str) -> Iterator[Episode]:
        """Yield the episodes of a part, each with its rows, without their offsets.

        Parameters
        ----------
        part
            One of `parts`.
        """
        check_known("part", self.parts, part)
        width = len(self.sensors)
        for facts in self.parts[part]:
            rows = self.rows(facts, 0, facts.rows)
            time = facts.begin + facts.step * np.arange(facts.rows, dtype=np.float64)
            yield Episode(
                facts.name,
                facts.source,
                rows[:, :width],
                rows[:-1, width:-1],
                rows[:-1, -1] if self.rewards else None,
                facts.intervals,
                facts.outcome,
                facts.task,
                "" if facts.part in {EVERY, *NOMINAL_ROLES} else facts.part.removeprefix("test/"),
                time if np.isfinite(facts.begin) else None,
                facts.fields,
            )


def read_episodes(recipe: Recipe, root: Path) -> EpisodeSource:
    """Read the recordings that a recipe names and make episodes of them.

    Parameters
    ----------
    recipe
        The recipe.
    root
        Folder that its files are relative to.

    Returns
    -------
    EpisodeSource
        A context manager: its rows are on disk until it is closed.

    Raises
    ------
    UsageError
        When files or columns are not there, or the recipe does not fit the logs.
    TrajectoryError
        When a recording cannot be read; the message names file and row.
    """
    absent: list[str] = []
    recordings = _recorded(recipe, root, absent)
    source = make_episodes(recipe, recordings, IntervalList.of(recipe, root))
    source.notes += absent
    return source


def make_episodes(
    recipe: Recipe, recordings: Iterable[Recorded], intervals: IntervalList
) -> EpisodeSource:
    """Make episodes of recordings, see `read_episodes`.

    Parameters
    ----------
    recipe
        The recipe.
    recordings
        What was recorded, in that order.
    intervals
        Anomalous rows by file.
    """
    return _filled(_Maker(recipe, intervals), recordings)


def _filled(maker: "_Maker", recordings: Iterable[Recorded]) -> EpisodeSource:
    try:
        for recorded in recordings:
            maker.add(recorded)
        return maker.finish()
    except BaseException:
        maker.close()
        raise


def read_every_episode(recipe: Recipe, root: Path, files: Sequence[Path]) -> EpisodeSource:
    """Read recordings whatever their labels say, as for a scan.

    All episodes are in the part ``"every"``, in recorded order, with the name of the anomaly that
    labels give them. Missing values stay NaN, gaps cut a recording, and nothing is subtracted.

    Parameters
    ----------
    recipe
        How rows become episodes. Fields and label columns that a recording lacks are not missed.
    root
        Folder that its files are relative to.
    files
        The files to read. What the recipe lists them as tells their anomalies.

    Returns
    -------
    EpisodeSource
        A context manager: its rows are on disk until it is closed.

    Raises
    ------
    UsageError
        When columns are not there, or the recipe does not fit the logs.
    TrajectoryError
        When a recording cannot be read; the message names file and row.
    """
    stamped = recipe.time or recipe.rate is not None
    gap = recipe.gap or (0.0 if stamped else None)
    recipe = dataclasses.replace(recipe, missing="keep", gap=gap, paired=False)
    listed: dict[Path, set[str]] = {}
    for name, table in recipe.anomalous.items():
        for pattern in table.files:
            for path in names_matching(pattern, root):
                listed.setdefault(root / path, set()).add(f"test/{name}")
    recordings = (
        Recorded(recording, path, path.relative_to(root).as_posix(), frozenset(roles))
        for path in files
        for roles in [listed.get(path, {FILES})]
        for recording in reader_for(path, recipe.format).read(path, recipe.options)
    )
    return _filled(_EveryMaker(recipe, IntervalList.of(recipe, root)), recordings)


def matching_files(patterns: Sequence[str], root: Path) -> list[Path]:
    """Return the files, or directories of data sets, that globs match, in natural order.

    Raises
    ------
    UsageError
        When none of the globs matches anything.
    """
    names = [name for pattern in patterns for name in names_matching(pattern, root)]
    if patterns and not names:
        there = sorted(path.name for path in root.iterdir())[:20] if root.is_dir() else []
        raise UsageError(
            f"{' and '.join(map(repr, patterns))} match{'es' * (len(patterns) == 1)} no file in "
            f"{str(root)!r}, which holds {', '.join(there) or 'nothing'}; --root DIR is the folder "
            "that files of a recipe are relative to"
        )
    files = dict.fromkeys(root / name for name in names)
    return sorted(files, key=lambda path: natural_order(path.as_posix()))


def _recorded(recipe: Recipe, root: Path, notes: list[str]) -> Iterator[Recorded]:
    """Yield the recordings of a recipe's files, in natural order; note globs without any."""
    tables = {
        FILES: recipe.nominal.files,
        TRAIN: recipe.nominal.train,
        CALIBRATION: recipe.nominal.calibration,
        TWINS: (*recipe.nominal.test, *recipe.nominal.twins),
    }
    anomalous = {f"test/{name}": table.files for name, table in recipe.anomalous.items()}
    globs = dict.fromkeys(itertools.chain(*tables.values(), *anomalous.values()))
    absent = [pattern for pattern in globs if not names_matching(pattern, root)]
    # Who has a part of a set lacks files of some anomalies; where all lack, that is an error.
    there = {role: patterns for role, patterns in anomalous.items() if {*patterns} - {*absent}}
    roles: dict[Path, set[str]] = {}
    for role, patterns in (tables | (there or anomalous)).items():
        for path in matching_files(patterns, root):
            roles.setdefault(path, set()).add(role)
    if absent:
        notes.append(f"no file matches {', '.join(absent)}")
    for path in sorted(roles, key=lambda path: natural_order(path.as_posix())):
        nominal_roles = roles[path] & NOMINAL_ROLES
        if len(nominal_roles) > 1:
            raise UsageError(f"{path} is in two nominal parts: {', '.join(sorted(nominal_roles))}")
        relative = path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)
        for recording in reader_for(path, recipe.format).read(path, recipe.options):
            yield Recorded(recording, path, relative, frozenset(roles[path]))


def names_matching(pattern: str, root: Path) -> list[str]:
    """Return the names of files that a glob matches.

    Parameters
    ----------
    pattern
        The glob.
    root
        Folder that it and the names are relative to.

    Returns
    -------
    list of str
    """
    # Patterns may be whole paths, which `Path.glob` refuses.
    return glob.glob(pattern, root_dir=root, recursive=True)  # noqa: PTH207


class _Maker:
    """Takes recordings one at a time and makes episodes of them."""

    def __init__(self, recipe: Recipe, intervals: IntervalList) -> None:
        self._recipe, self._intervals = recipe, intervals
        self._tally = Tally()
        self._left_out: Counter[str] = Counter()
        self._selections: dict[Layout, tuple[Selection, _Base]] = {}
        self._parts: dict[str, list[EpisodeFacts]] = {}
        self._spans: list[tuple[float, float]] = []  # first and last stamps of recordings
        self._steps: list[Steps] = []
        self._recordings = 0
        self._names: set[str] = set()
        self._problems: list[str] = []
        self._cut_by_outcome: set[str] = set()  # parts with windows that no label is of
        self._base: _Base | None = None

    def close(self) -> None:
        """Remove what was kept."""
        if self._base:
            self._base.spool.close()

    # One recording

    def add(self, recorded: Recorded) -> None:
        """Read one recording and keep its episodes."""
        recorded = recorded.meeting(self._recipe)
        if not recorded.roles:
            self._left_out["recording(s) that meet no condition (where)"] += 1
            return
        recording, layout = recorded.recording, layout_of(recorded.recording)
        if layout not in self._selections:
            chosen = self._select(layout, recording)
            base = self._base = self._base or _Base.of(recording, chosen, self._recipe)
            self._selections[layout] = base.in_order(chosen, recording), base
        selection, base = self._selections[layout]
        if (choices := _choices(recording)) != base.choices:
            raise TrajectoryError(
                f"{recording.source}: its actions are {choices}, expected {base.choices} as in "
                f"{base.source}"
            )
        self._recordings += 1
        self._names |= {recorded.relative, recording.name}
        outcome = self._outcome(recorded)
        kind = self._kind_of(recorded, outcome)
        task = self._value(recorded, self._recipe.task) or ""
        taken = StampedRows(recorded, selection, self._recipe, self._tally)
        is_anomalous = bool(kind or recorded.kinds)
        marks = taken.marks(self._intervals, is_anomalous=is_anomalous)
        stretches, times = taken.stretches()
        if times:
            self._spans.append((min(t[0] for t in times), max(t[-1] for t in times)))
            self._steps += [steps for t in times if (steps := Steps.of(t)).usual]
        count = 0
        for stretch in stretches:
            first = base.spool.rows
            spool_stretch(base.spool, stretch, taken.topics, base.converter, recording.source)
            rows = rows_of(marks, stretch.positions, stretch.tolerance)
            is_cut = len(stretches) > 1
            for part, start, stop, inside, is_piece in self._cut(
                recorded, kind, stretch.rows, rows, is_cut=is_cut
            ):
                name = f"{recording.name}#{count}" if is_piece else recording.name
                count += 1
                self._keep(
                    EpisodeFacts(
                        part,
                        name,
                        recording.source,
                        first + start,
                        stop - start,
                        () if part in NOMINAL_ROLES else merged(inside),
                        outcome,
                        task,
                        *_times(stretch, start, stop),
                        recording.fields,
                    )
                )

    def _select(self, layout: Layout, recording: Recording) -> Selection:
        try:
            return select_columns(layout, self._recipe, recording.source)
        except UnknownNameError as error:
            if self._base is None:
                raise
            raise TrajectoryError(f"{error}; {self._base.source} has it") from None

    def _cut(
        self,
        recorded: Recorded,
        kind: str,
        total: int,
        rows: Sequence[AnomalousRows],
        *,
        is_cut: bool,
    ) -> Iterator[tuple[str, int, int, Sequence[AnomalousRows], bool]]:
        """Yield part, rows and anomalous rows of the episodes of a stretch, and if it was cut."""
        for window, roles in self._windows(recorded).items():
            has_windows = 0 < window < total
            is_piece = has_windows or is_cut
            length = window if has_windows else total
            for start in range(0, total, length):
                stop = min(start + length, total)
                inside = _clipped(rows, start, stop)
                parts = self._targets(recorded, roles, kind, inside, is_piece=is_piece)
                if stop - start < length and self._takes_whole_windows(parts, inside):
                    self._left_out["row(s) at ends of recordings, less than a window"] += (
                        stop - start
                    )
                elif stop - start < max(2, self._recipe.baseline + 1):
                    self._refuse_short(recorded.recording, stop - start, is_piece=is_piece)
                else:
                    if has_windows and not inside:
                        self._cut_by_outcome |= {*parts} - NOMINAL_ROLES
                    yield from ((part, start, stop, inside, is_piece) for part in parts)

    def _takes_whole_windows(self, parts: Sequence[str], inside: Sequence[AnomalousRows]) -> bool:
        """Whether a short last window is dropped (labelled ones are kept)."""
        return bool(NOMINAL_ROLES & {*parts} or (parts and not inside))

    def _windows(self, recorded: Recorded) -> dict[int, set[str]]:
        """Return the roles of a recording by the length of their windows."""
        windows: dict[int, set[str]] = {}
        for role in sorted(recorded.roles):
            tables = self._recipe.anomalous
            is_nominal = role in NOMINAL_ROLES
            table = self._recipe.nominal if is_nominal else tables[role.removeprefix("test/")]
            length = self._recipe.window if table.window is None else table.window
            windows.setdefault(length, set()).add(role)
        return windows

    def _targets(
        self,
        recorded: Recorded,
        roles: set[str],
        kind: str,
        inside: Sequence[AnomalousRows],
        *,
        is_piece: bool,
    ) -> list[str]:
        """Return the parts that an episode of a recording belongs to."""
        source, recipe = recorded.source, self._recipe
        nominal = sorted(roles & NOMINAL_ROLES)
        kinds = {role.removeprefix("test/") for role in roles - NOMINAL_ROLES}
        if kind:
            return [f"test/{kind}"]
        if recipe.kinds or recipe.outcome:
            self._left_out["nominal recording(s) in files of an anomaly alone"] += not nominal
            return nominal
        labelled = {name for *_, name in inside}
        # Intervals may name an anomaly that has no files of its own.
        kinds |= {n for n in labelled if n and not recipe.anomalous.get(n, _NO_FILES).files}
        if not inside:
            if nominal:
                return nominal
            if recipe.paired or not any(self._says_rows(name) for name in kinds):
                return [f"test/{name}" for name in sorted(kinds)]
            if is_piece:
                self._left_out["window(s) of anomalous recordings without an anomalous row"] += 1
                return []
            # Raised at the end, as the names in a list of intervals may be wrong.
            self._problems.append(
                f"{source} has no anomalous row by its labels, expected some as it is listed under "
                f"{', '.join(sorted(kinds))}: leave it out, or list it under [nominal]"
            )
            return []
        matching = [f"test/{name}" for name in sorted(kinds) if labelled & {"", name}]
        if not matching and nominal and not is_piece:
            start, stop, _ = inside[0]
            raise TrajectoryError(
                f"{source} is listed as nominal, but is anomalous in rows {max(start, 0)} to "
                f"{stop - 1}: list it under [anomalous.NAME], or cut it with window, so that the "
                "windows without anomalous rows are nominal; labels of nominal rows other than 0, "
                "false, H or nothing are named by nominal_label"
            )
        self._left_out["window(s) with anomalous rows, of nominal files"] += not matching
        return matching

    def _says_rows(self, kind: str) -> bool:
        """Tell whether the recipe says which rows of an anomaly are anomalous."""
        recipe, table = self._recipe, self._recipe.anomalous.get(kind, _NO_FILES)
        onset = recipe.onset if table.onset is None else table.onset
        return bool(recipe.labels or table.labels or self._intervals or onset is not None)

    def _value(self, recorded: Recorded, name: str, *, last: bool = False) -> str | None:
        """Return the value of a field or column; None where the recipe names none."""
        return recorded.text(name, last=last) if name else None

    def _kind_of(self, recorded: Recorded, outcome: bool | None) -> str:
        """Return the anomaly that a field or the outcome names; empty for a nominal recording."""
        recipe = self._recipe
        text = self._value(recorded, recipe.kinds)
        if text is not None:
            nominal = map(text_of, recipe.nominal.where.get(recipe.kinds, ()))
            return "" if text in nominal else anomaly_name(text)
        if outcome is False:
            fallback = [name for name, table in recipe.anomalous.items() if not table.files]
            return next(iter([*recorded.kinds, *fallback]), FAILURE)
        return ""

    def _outcome(self, recorded: Recorded) -> bool | None:
        text = self._value(recorded, self._recipe.outcome, last=True)
        if text is None:
            return None
        text = text.lower()
        if text not in _TRUE | _FALSE:
            raise TrajectoryError(
                f"{recorded.source}: {self._recipe.outcome} is {text!r}, expected true or false"
            )
        return text in _TRUE

    def _refuse_short(self, recording: Recording, rows: int, *, is_piece: bool) -> None:
        least = max(2, self._recipe.baseline + 1)
        if not is_piece:
            why = ", more than the baseline" if least > 2 else ""
            logged = max(topic.rows for topic in recording.topics.values())
            if self._recipe.rate and logged >= least:
                why += (
                    f"; {logged} rows were logged: are rate = {self._recipe.rate:g} and the unit "
                    "of the stamps right, as in time = 'NAME[ms]'?"
                )
            raise TrajectoryError(
                f"{recording.source} has {counted(rows, 'observation(s)')}, expected at least "
                f"{least}{why}"
            )
        self._left_out[f"piece(s) shorter than {least} rows"] += 1

    def _keep(self, facts: EpisodeFacts) -> None:
        baseline = self._recipe.baseline
        if early := [start for start, _ in facts.intervals if 0 <= start < baseline]:
            if "#" not in facts.name:
                raise TrajectoryError(
                    f"{facts.source} is anomalous from row {early[0]} on, expected its first "
                    f"{baseline} rows (baseline) to be nominal"
                )
            self._left_out["window(s) that are anomalous within their baseline"] += 1
            return
        episodes = self._parts.setdefault(facts.part, [])
        if len(episodes) == EPISODES:
            raise UsageError(f"{facts.part} has more than {EPISODES} episodes, the most there are")
        episodes.append(facts)

    # All of them

    def finish(self) -> EpisodeSource:
        """Return all episodes, in parts."""
        if self._base is None:
            raise UsageError("there are no recordings to read, expected at least one")
        self._intervals.check_all_used(self._names)
        labelled = {text for s, _ in self._selections.values() for text in s.labels}
        for text in (text for text in self._recipe.label_columns if text not in labelled):
            columns = {name for layout in self._selections for name in named_columns(layout)}
            raise UnknownNameError("column with labels", text, columns)
        for problem in self._problems:
            raise TrajectoryError(problem)
        parts = self._shared_out()
        for part in (TRAIN, CALIBRATION):
            if not parts[part]:
                raise UsageError(
                    f"there are no {part} episodes, expected at least 1: "
                    f"{self._nominal_problem(part)}"
                )
        kinds = in_order(
            (part.removeprefix("test/") for part in self._parts if part not in NOMINAL_ROLES),
            ANOMALIES,
        )
        listed = [name for name, table in self._recipe.anomalous.items() if table.files]
        lacking = [name for name in listed if name not in kinds]
        if lacking and not kinds:
            raise UsageError(f"[anomalous.{lacking[0]}] has no episodes, expected at least one")
        parts |= {f"test/{kind}": self._parts[f"test/{kind}"] for kind in kinds}
        unused = dict.fromkeys(name for s, _ in self._selections.values() for name in s.unused)
        source = self._source(parts)
        source.groups = {kind: self._group(kind) for kind in kinds}
        source.unused = tuple(unused)
        _settle_columns(source, self._recipe)
        source.notes[:0] = self._notes(source)
        if lacking:
            source.notes.append(f"no episodes of these anomalies: {', '.join(lacking)}")
        return source

    def _source(self, parts: dict[str, list[EpisodeFacts]]) -> EpisodeSource:
        if self._base is None or not parts:
            raise UsageError("there are no episodes to read, expected at least one")
        converter = self._base.converter
        rewards, columns = self._base.selection.reward is not None, tuple(range(converter.width))
        source = EpisodeSource(
            converter.sensors,
            converter.actions,
            converter.discrete,
            rewards,
            self._base.spool,
            columns,
        )
        source.rate, source.parts = self._recipe.rate, parts
        if source.rate is None and self._steps:
            source.rate = even_rate(self._steps)
        return source

    def _group(self, kind: str) -> Group:
        if kind in ANOMALIES:
            return ANOMALIES[kind].group
        return self._recipe.anomalous.get(kind, _NO_FILES).group

    def _nominal_problem(self, part: str) -> str:
        if count := len(self._parts.get(FILES, ())):
            return f"the nominal files make {count}; a window cuts long recordings into several"
        if left_out := [counted(n, what) for what, n in self._left_out.items() if n]:
            return f"left out are {', '.join(left_out)}"
        return f"[nominal] names no file with one for {part}"

    def _shared_out(self) -> dict[str, list[EpisodeFacts]]:
        """Return nominal episodes by part: shares of each task, in the order of the recording."""
        parts: dict[str, list[EpisodeFacts]] = {p: self._parts.get(p, []) for p in _SHARED}
        episodes = list(self._parts.get(FILES, []))
        if self._by_stamps():
            episodes.sort(key=lambda facts: facts.begin)
        if self._recipe.order == "shuffled":
            order = np.random.default_rng(self._recipe.seed).permutation(len(episodes))
            episodes = [episodes[i] for i in order]
        tasks = dict.fromkeys(facts.task for facts in episodes)
        for task in tasks:
            of_task = [facts for facts in episodes if facts.task == task]
            shares = np.cumsum(self._recipe.nominal.parts)
            bounds = [0, *np.rint(shares * len(of_task)).astype(int).tolist(), len(of_task)]
            for part, start, stop in zip(_SHARED, bounds, bounds[1:], strict=False):
                parts[part] = parts[part] + of_task[start:stop]
        return parts

    def _by_stamps(self) -> bool:
        """Tell whether stamps order the recordings: none begins before another's end."""
        spans = sorted(self._spans)
        return len(spans) == self._recordings and all(
            a[1] < b[0] for a, b in itertools.pairwise(spans)
        )

    def _lost(self) -> list[str]:
        """Return a line for each reason for which rows were dropped, held or left out."""
        return [
            *self._tally.lines(),
            *(f"left out: {counted(n, what)}" for what, n in self._left_out.items() if n),
        ]

    def _notes(self, source: EpisodeSource) -> list[str]:
        sizes = (
            f"{counted(len(source.sensors), 'sensor(s)')}, "
            f"{counted(len(source.actions), 'action(s)')}"
        )
        lines = [f"read {counted(self._recordings, 'recording(s)')}: {sizes}"]
        for part, episodes in source.parts.items():
            rows = sum(facts.rows for facts in episodes)
            line = f"{part}: {counted(len(episodes), 'episode(s)')}, {counted(rows, 'row(s)')}"
            if part not in _SHARED:
                intervals = [i for facts in episodes for i in facts.intervals]
                anomalous = sum(stop - max(start, 0) for start, stop in intervals)
                line += (
                    f", {counted(len(intervals), 'interval(s)')} with "
                    f"{counted(anomalous, 'anomalous row(s)')}"
                    if intervals
                    else ", known by their outcome alone"
                )
            if episodes or part != TWINS:
                lines.append(line)
            if part in self._cut_by_outcome:
                lines.append(
                    f"warning: {part} was cut by window, and nothing says which rows are "
                    "anomalous: every window counts as anomalous, also those before the fault. "
                    "Name the anomalous rows (labels, intervals, or onset, which is 0 where the "
                    "fault is there from the first row on), or leave out window"
                )
        if self._recipe.nominal.files:
            how = "in the order of their stamps" if self._by_stamps() else "in the order of files"
            if self._recipe.order == "shuffled":
                how = f"shuffled (seed {self._recipe.seed})"
            lines.append(f"nominal episodes were shared out {how}")
        if self._steps and source.rate is None:
            shortest = min(steps.shortest for steps in self._steps)
            longest = max(steps.longest for steps in self._steps)
            lines.append(
                f"rows are {shortest:g} to {longest:g} s apart and taken as they are: rate in the "
                "recipe resamples them"
            )
        lines += self._lost()
        if self._base and (choices := self._base.converter.choices):
            lines.append(
                f"actions are whole numbers from 0 to {choices - 1}: if they are choices, "
                f"discrete = {choices} (--discrete {choices}) makes each a column"
            )
        if source.unused:
            further = len(source.unused) - _LISTED
            more = f" and {further} more, which data inspect lists" if further > 0 else ""
            listed = ", ".join(source.unused[:_LISTED])
            lines.append(f"columns that no line names: {listed}{more}")
        return lines


@dataclass(frozen=True, slots=True, eq=False)
class _Base:
    """Columns of the first recording, which all others share, and where rows are kept."""

    selection: Selection
    converter: Converter
    spool: Spool
    source: str
    choices: str

    @classmethod
    def of(cls, recording: Recording, selection: Selection, recipe: Recipe) -> "_Base":
        number = recording.fields.get("discrete", 0)
        if number and not recipe.discrete:
            names = tuple(map(str, recording.fields.get("choices", ())))
            recipe = dataclasses.replace(recipe, discrete=names or int(number))
        start = int(recording.fields.get("start", 0)) if number else 0
        converter = Converter(selection, recipe, start)
        spool = Spool(converter.width)
        return cls(selection, converter, spool, recording.source, _choices(recording))

    def in_order(self, selection: Selection, recording: Recording) -> Selection:
        """Return a selection with the columns of the first recording, in their order."""
        # Globs may match further columns in later files: these are unused.
        if selection == self.selection:
            return selection
        sensors, actions = (
            self._ordered(kind, getattr(self.selection, kind), getattr(selection, kind), recording)
            for kind in ("sensors", "actions")
        )
        if (selection.reward is None) != (self.selection.reward is None):
            raise TrajectoryError(f"{recording.source}: only some of the files have rewards")
        chosen = {*sensors, *actions}
        further = (c for c in (*selection.sensors, *selection.actions) if c not in chosen)
        unused = (*selection.unused, *(column.quantity.name for column in further))
        return dataclasses.replace(selection, sensors=sensors, actions=actions, unused=unused)

    def _ordered(
        self,
        kind: str,
        expected: Sequence[ChosenColumn],
        actual: Sequence[ChosenColumn],
        recording: Recording,
    ) -> tuple[ChosenColumn, ...]:
        by_name = {column.quantity: column for column in actual}
        quantities = [column.quantity for column in expected]
        if lacking := [q for q in quantities if q not in by_name]:
            names = ", ".join(f"{q.name}[{q.unit}]" for q in lacking[:6])
            raise TrajectoryError(
                f"{recording.source} has {len(actual)} {kind}, {self.source} {len(expected)}: it "
                f"lacks {names}; expected the same in all files, by name and unit"
            )
        return tuple(by_name[quantity] for quantity in quantities)


def _times(stretch: Stretch, start: int, stop: int) -> tuple[float, float]:
    """Return time of the first row and seconds between rows, NaN without stamps."""
    if stretch.positions.dtype.kind != "f":
        return float("nan"), float("nan")
    times = stretch.positions[start:stop]
    return float(times[0]), float((times[-1] - times[0]) / max(1, len(times) - 1))


class _EveryMaker(_Maker):
    """Makes episodes of all rows, of which labels only tell the names of anomalies."""

    def _windows(self, recorded: Recorded) -> dict[int, set[str]]:
        window = self._recipe.nominal.window
        return {self._recipe.window if window is None else window: {*recorded.roles}}

    def _targets(
        self,
        recorded: Recorded,
        roles: set[str],
        kind: str,
        inside: Sequence[AnomalousRows],
        *,
        is_piece: bool,
    ) -> list[str]:
        del recorded, is_piece
        by_files = sorted(role for role in roles - NOMINAL_ROLES)
        names = [f"test/{name}" for *_, name in inside if name]
        if kind:
            return [f"test/{kind}"]
        if inside:
            return (names or by_files or [f"test/{_ANOMALOUS}"])[:1]
        labelled = any(self._says_rows(role.removeprefix("test/")) for role in by_files)
        return by_files[:1] if by_files and not labelled else [EVERY]

    def _takes_whole_windows(self, parts: Sequence[str], inside: Sequence[AnomalousRows]) -> bool:
        del parts, inside
        return False

    def _value(self, recorded: Recorded, name: str, *, last: bool = False) -> str | None:
        try:
            return super()._value(recorded, name, last=last)
        except UnknownNameError:
            return None

    def _refuse_short(self, recording: Recording, rows: int, *, is_piece: bool) -> None:
        del is_piece
        super()._refuse_short(recording, rows, is_piece=True)

    def _keep(self, facts: EpisodeFacts) -> None:
        self._parts.setdefault(EVERY, []).append(facts)

    def finish(self) -> EpisodeSource:
        source = self._source(self._parts)
        if self._by_stamps():
            self._parts[EVERY].sort(key=lambda facts: facts.begin)
        source.notes += self._lost()
        return source


def _clipped(rows: Sequence[AnomalousRows], start: int, stop: int) -> list[AnomalousRows]:
    """Return the anomalous rows within a window, counted from its start."""
    return [
        (a - start if a > start else 0 if a >= 0 or start else -1, min(b, stop) - start, kind)
        for a, b, kind in rows
        if b > start and a < stop
    ]


def _settle_columns(source: EpisodeSource, recipe: Recipe) -> None:
    """Drop constant sensors if asked to, and find offsets of those that float32 cannot tell."""
    train = _moments(source, source.parts[TRAIN])
    is_constant = train.low == train.high
    names = ", ".join(q.name for q, same in zip(source.sensors, is_constant, strict=True) if same)
    if names and recipe.constant == "drop":
        kept, width = np.flatnonzero(~is_constant), len(source.sensors)
        if not len(kept):
            raise UsageError(f"all sensors are constant in training: {names}")
        source.notes.append(f"left out as constant in training: {names}")
        source.sensors = tuple(source.sensors[i] for i in kept)
        source._kept = (*kept.tolist(), *range(width, len(source._kept)))  # noqa: SLF001
        train = _moments(source, source.parts[TRAIN])
    elif names:
        source.notes.append(f"constant in training: {names}")
    every = _moments(source, [facts for episodes in source.parts.values() for facts in episodes])
    # What training never shows may still move later.
    spread = np.where(train.low == train.high, every.high - every.low, train.spread)
    if (every.largest > np.finfo(np.float32).max / 2).any():
        i = int(every.largest.argmax())
        raise TrajectoryError(
            f"sensor {source.sensors[i].name!r} reaches {every.largest[i]:g}, too large for float32"
        )
    blurred = is_coarse(spread, every.largest)
    if blurred.any():
        source.offsets = tuple(np.where(blurred, train.mean, 0.0).tolist())
        texts = [
            f"{source.sensors[i].name} ({train.mean[i]:g}, spread {spread[i]:.2g})"
            for i in np.flatnonzero(blurred)
        ]
        source.notes.append(
            f"the training mean is subtracted, as float32 could not tell values: {', '.join(texts)}"
        )


def _moments(source: EpisodeSource, episodes: Iterable[EpisodeFacts]) -> RunningMoments:
    moments = RunningMoments()
    for facts in episodes:
        for rows in source.blocks(facts):
            moments.add(rows[:, : len(source.sensors)])
    return moments


def _choices(recording: Recording) -> str:
    number, start = (str(recording.fields.get(name, 0)) for name in ("discrete", "start"))
    return f"{number:.40} choices from {start:.40} on" if number != "0" else "numbers"
