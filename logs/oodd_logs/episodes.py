"""Episodes: what a recipe makes of recordings, nominal ones in parts, anomalous ones by kind.

Each recording is read once, and its rows wait on disk, in float64, until a part is written.
"""

import contextlib
import dataclasses
import glob
import itertools
import unicodedata
import warnings
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple, Self, cast

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.bounded import EPISODES
from oodd_eval.data.facts import ANOMALIES, Group, Quantity, in_order
from oodd_eval.data.offsets import RunningMoments, is_coarse
from oodd_eval.data.parts import CALIBRATION, FAILURES, TRAIN, TWINS
from oodd_eval.errors import TrajectoryError, UnknownNameError, UsageError
from oodd_eval.metrics.faults import FAR
from oodd_eval.names import check_known, counted, listed
from oodd_logs.kinds import Matrix
from oodd_logs.ledger import Item, Ledger
from oodd_logs.marks import (
    AnomalousRows,
    IntervalList,
    LabelCounts,
    label_problems,
    merged,
    rows_of,
)
from oodd_logs.readers import in_order as natural_order
from oodd_logs.recipe import FAILURE, AnomalousFiles, Recipe, anomaly_name
from oodd_logs.recorded import FILES, NOMINAL_ROLES, SLOWER, Recorded, StampedRows, text_of
from oodd_logs.recording import Recording
from oodd_logs.rows import Converter, Spool
from oodd_logs.selecting import (
    Layout,
    Selection,
    layout_of,
    named_columns,
    respelled,
    respellings,
    select_columns,
)
from oodd_logs.splitting import recordings_in
from oodd_logs.stamps import Steps, Times, even_rate

EVERY: Final = "every"
"""The part with all episodes of a source that `read_every_episode` made."""

_ANOMALOUS: Final = "anomalous"  # where labels name no anomaly
_SAMPLED: Final = 1 << 17  # values that tell usual deviations
_BLOCK: Final = 1 << 16  # rows that are read at once
_NO_FILES: Final = AnomalousFiles()
_NO_ROWS: Final = np.empty((0, 0)), np.empty((0, 0))
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
    recording
        Number of the recording that it is a window of; None where it is one of its own.
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
    recording: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class EpisodeFacts:
    """Facts of an episode whose rows are on disk, from the first on.

    The episode is without them; the time of the first and seconds between them are NaN without
    stamps.
    """

    part: str
    episode: Episode
    first: int
    rows: int
    begin: float
    step: float


@dataclass(slots=True, eq=False)
class EpisodeSource:
    """The episodes of a recipe, by part.

    Parameters
    ----------
    sensors, actions
        Names and units of the columns; recorded scores are behind the sensors.
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
    ledger
        What was left out, held or changed.
    recordings
        Number of recordings.
    notes
        What was read, a line each.
    offsets
        Subtracted from each sensor; empty where nothing is.
    """

    _spool: Spool
    rewards: bool
    rate: float | None
    parts: dict[str, list[EpisodeFacts]]
    ledger: Ledger
    recordings: int
    sensors: tuple[Quantity, ...] = ()
    actions: tuple[Quantity, ...] = ()
    discrete: bool = False
    groups: dict[str, Group] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    offsets: tuple[float, ...] = ()
    _kept: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        rows = self._spool.converter
        self.sensors, self.actions, self.discrete = rows.sensors, rows.actions, rows.discrete
        self._kept = tuple(range(rows.width))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self._spool.close()

    @property
    def summary(self) -> list[str]:
        """The ledger in short, a line each."""
        names = [quantity.name for quantity in self.sensors]
        sensors, scores = names[: self.measured], names[self.measured :]
        lines = self.ledger.summary(sensors, self.recordings)
        return [*lines[:1], *([f"scores: {listed(scores, 12)}"] if scores else []), *lines[1:]]

    @property
    def measured(self) -> int:
        """Number of the sensors that are no recorded scores."""
        return sum(quantity.role != "score" for quantity in self.sensors)

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
            yield dataclasses.replace(
                facts.episode,
                observations=rows[:, :width],
                actions=rows[:-1, width:-1],
                rewards=rows[:-1, -1] if self.rewards else None,
                time=time if np.isfinite(facts.begin) else None,
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
    reading = _Reading(recipe, root)
    return reading.episodes(reading.recordings_of(reading.listed()))


def make_episodes(
    recipe: Recipe, recordings: Iterable[Recorded], *, every: bool = False
) -> EpisodeSource:
    """Make episodes of recordings.

    Parameters
    ----------
    recipe
        How rows become episodes.
    recordings
        What was recorded, in that order.
    every
        Whether all are read, as by `read_every_episode`; else parts are made.
    """
    return _Reading(recipe, every=every).episodes(recordings)


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
    listed: dict[Path, set[str]] = {}
    for name, table in recipe.anomalous.items():
        for path in (path for glob_ in table.files for path in names_matching(glob_, root)):
            listed.setdefault(root / path, set()).add(f"test/{name}")
    reading = _Reading(recipe, root, every=True)
    roles = ((path, listed.get(path, {FILES})) for path in files)
    return reading.episodes(reading.recordings_of(roles))


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


def files_of(recipe: Recipe, root: Path) -> Iterator[Path]:
    """Yield the files that a recipe names, with the list of its intervals."""
    for pattern in recipe.globs:
        yield from (root / name for name in names_matching(pattern, root))
    if isinstance(recipe.intervals, str):
        yield root / recipe.intervals


class _First(NamedTuple):
    """Columns of the first recording, which all others share, and where rows are kept."""

    layout: Layout
    selection: Selection
    spool: Spool
    source: str
    choices: str


@dataclass(slots=True, eq=False)
class _Reading:
    """State of reading recordings one after another, into parts or all into `EVERY`."""

    recipe: Recipe
    root: Path = Path()
    every: bool = False
    ledger: Ledger = field(default_factory=Ledger)
    first: _First | None = None
    respellings: dict[Layout, Mapping[tuple[str, str], str]] = field(default_factory=dict)
    selections: dict[Layout, Selection] = field(default_factory=dict)
    recordings: int = 0
    parts: dict[str, list[EpisodeFacts]] = field(default_factory=dict)
    spans: list[tuple[float, float]] = field(default_factory=list)  # first and last stamps
    steps: dict[int, dict[str, Steps]] = field(default_factory=dict)  # by topic and recording
    names: set[str] = field(default_factory=set)
    problems: list[str] = field(default_factory=list)
    failures: list[Exception] = field(default_factory=list)  # of what a scan leaves out
    cut_by_outcome: set[str] = field(default_factory=set)  # parts with windows without a label
    label_counts: LabelCounts = field(default_factory=lambda: defaultdict(Counter))
    unlabelled: set[str] = field(default_factory=set)  # label columns that recordings lack
    intervals: IntervalList = field(init=False)
    unseen: frozenset[str] = field(init=False)  # tasks

    def __post_init__(self) -> None:
        if self.every:
            stamped = self.recipe.time or self.recipe.rate is not None
            gap = self.recipe.gap or (0.0 if stamped else None)
            self.recipe = dataclasses.replace(self.recipe, missing="keep", gap=gap, paired=False)
        self.intervals = IntervalList.of(self.recipe, self.root)
        self.unseen = frozenset(map(text_of, self.recipe.unseen))

    @property
    def shortest(self) -> int:
        """Rows of the shortest episode."""
        return max(2, self.recipe.baseline + 1)

    @property
    def by_stamps(self) -> bool:
        """Whether stamps order the recordings: none begins before another's end."""
        pairs = itertools.pairwise(sorted(self.spans))
        return len(self.spans) == self.recordings and all(a[1] < b[0] for a, b in pairs)

    def listed(self) -> Iterator[tuple[Path, set[str]]]:
        """Yield the files of the recipe in natural order with their roles."""
        nominal, root = self.recipe.nominal, self.root
        tables = {FILES: nominal.files, TRAIN: nominal.train, CALIBRATION: nominal.calibration}
        tables[TWINS] = (*nominal.test, *nominal.twins)
        anomalous = {f"test/{name}": table.files for name, table in self.recipe.anomalous.items()}
        matches = {pattern: names_matching(pattern, root) for pattern in self.recipe.globs}
        absent = [pattern for pattern, names in matches.items() if not names]
        # Who has a part of a set lacks files of some anomalies; where all lack, that is an error.
        there = {role: patterns for role, patterns in anomalous.items() if {*patterns} - {*absent}}
        roles: dict[Path, set[str]] = {}
        for role, patterns in (tables | (there or anomalous)).items():
            paths = {root / name for pattern in patterns for name in matches[pattern]}
            if patterns and not paths:
                names = sorted(path.name for path in root.iterdir())[:20] if root.is_dir() else []
                raise UsageError(
                    f"{' and '.join(map(repr, patterns))} match{'es' * (len(patterns) == 1)} no "
                    f"file in {str(root)!r}, which holds {', '.join(names) or 'nothing'}; --root "
                    "DIR is the folder that files of a recipe are relative to"
                )
            for path in paths:
                roles.setdefault(path, set()).add(role)
        for pattern in absent:
            self.ledger.add("file", "dropped", "no file matches", name=pattern)
        for path in sorted(roles, key=lambda path: natural_order(path.as_posix())):
            parts = ", ".join(sorted(roles[path] & NOMINAL_ROLES))
            if "," in parts:
                raise UsageError(f"{path} is in two nominal parts: {parts}")
            yield path, roles[path]

    def recordings_of(self, files: Iterable[tuple[Path, set[str]]]) -> Iterator[Recorded]:
        """Yield the recordings of files with their roles."""
        for path, roles in files:
            is_below = path.is_relative_to(self.root)
            relative = path.relative_to(self.root).as_posix() if is_below else str(path)
            if path.is_file() and not path.stat().st_size:
                self.ledger.add("file", "dropped", "no rows", source=relative)
                continue
            with self._scan_goes_on(relative, "file"):
                for recording in recordings_in(path, self.recipe, lenient=self.every):
                    yield Recorded(recording, path, relative, frozenset(roles))

    def episodes(self, recordings: Iterable[Recorded]) -> EpisodeSource:
        """Read recordings and return all episodes."""
        try:
            for recorded in recordings:
                label = recorded.label
                if any(topic.rows for topic in recorded.recording.topics.values()):
                    with self._scan_goes_on(label, "recording"):
                        self._add(recorded)
                else:
                    item: Item = "file" if label == recorded.relative else "recording"
                    self.ledger.add(item, "dropped", "no rows", source=label)
            return self._every_episode() if self.every else self._in_parts()
        except BaseException:
            if self.first:
                self.first.spool.close()
            raise

    @contextlib.contextmanager
    def _scan_goes_on(self, label: str, item: Item) -> Iterator[None]:
        """Leave out what cannot be read, where every other episode is to be read."""
        episodes = self.parts.setdefault(EVERY, []) if self.every else []
        count = len(episodes)
        try:
            yield
        except (TrajectoryError, UsageError) as error:
            if not self.every:
                raise
            del episodes[count:]
            self.failures.append(error)
            reason = str(error).replace(f"{self.root}/", "").removeprefix(label).lstrip(",: ")
            self.ledger.add(item, "dropped", reason, source=label)

    def _add(self, recorded: Recorded) -> None:
        """Read one recording and keep its episodes."""
        recipe, ledger = self.recipe, Ledger()
        recorded = self._respelled(recorded, ledger).meeting(recipe)
        recording, label = recorded.recording, recorded.label
        if not recorded.roles:
            self.ledger.add("recording", "dropped", "meets no condition (where)", source=label)
            return
        selection, first = self._selected(recording)
        outcome, kind, task = self._outcome_kind_and_task(recorded)
        recorded = dataclasses.replace(recorded, kind=kind)
        stamped = StampedRows(recorded, selection, recipe, ledger)
        marks = stamped.marks(self.intervals, is_anomalous=bool(kind or recorded.kinds))
        stretches, times = stamped.stretches()
        numbers = itertools.count()
        for stretch in stretches:
            above = first.spool.rows
            first.spool.add(stretch, stamped.topics, recording.source)
            rows = rows_of(marks, stretch.positions, stretch.tolerance)
            pieces = self._cut(recorded, stretch.rows, rows, is_cut=len(stretches) > 1)
            for part, start, stop, inside, is_piece in pieces:
                piece = next(numbers)
                name = f"{recording.name}#{piece}" if is_piece else recording.name
                is_nominal = part in NOMINAL_ROLES
                intervals = () if is_nominal else merged(inside)
                anomaly = "" if is_nominal or part == EVERY else part.removeprefix("test/")
                about: Any = outcome, task, anomaly, None, recording.fields, self.recordings
                episode = Episode(name, recording.source, *_NO_ROWS, None, intervals, *about)
                begin, step = stretch.begin_and_step(start, stop)
                facts = EpisodeFacts(part, episode, above + start, stop - start, begin, step)
                self._keep(facts, label)
        for text, counts in stamped.labels.items():
            self.label_counts[text].update(counts)
        self.unlabelled |= {*recipe.label_columns} - {*stamped.labels}
        for text in recipe.label_columns:
            if text not in selection.labels and (text in recipe.labels or recorded.kinds):
                ledger.add("recording", "kept", f"has no column {text!r}: rows count as nominal")
        for name in selection.unused:
            ledger.add("column", "dropped", "no line names it", name=name)
        ledger.merge(recording.ledger)
        self.ledger.merge(ledger, label)
        self.names |= {recorded.relative, recording.name}
        self.recordings += 1
        if times:
            self.spans.append((min(t[0] for t in times), max(t[-1] for t in times)))
        for i, steps in enumerate(map(Steps.of, times)):
            if steps.usual:
                self.steps.setdefault(i, {})[label] = steps

    def _respelled(self, recorded: Recorded, ledger: Ledger) -> Recorded:
        """Return a recording whose columns have the names of the recipe, or of the first one."""
        layout = layout_of(recorded.recording)
        if layout not in self.respellings:
            first = self.first.layout if self.first else None
            self.respellings[layout] = respellings(layout, self.recipe, first)
        names = self.respellings[layout]
        for (_, old), new in names.items():
            is_form = unicodedata.normalize("NFC", old) == unicodedata.normalize("NFC", new)
            spelled = ascii(old) if is_form else repr(old)
            ledger.add("column", "changed", f"taken from {spelled}, as the file lacks it", name=new)
        return dataclasses.replace(recorded, recording=respelled(recorded.recording, names))

    def _selected(self, recording: Recording) -> tuple[Selection, _First]:
        """Return the columns of a recording, and those of the first, in whose order they are."""
        layout, recipe, source = layout_of(recording), self.recipe, recording.source
        discrete, start = (recording.fields.get(name, 0) for name in ("discrete", "start"))
        is_discrete = str(discrete) != "0"
        choices = f"{discrete!s:.40} choices from {start!s:.40} on" if is_discrete else "numbers"
        if layout not in self.selections:
            try:
                selection = select_columns(layout, recipe, source)
            except UnknownNameError as error:
                if self.first is None:
                    raise
                raise TrajectoryError(f"{error}; {self.first.source} has it") from None
            except UsageError as error:
                problem = str(error).removeprefix(source).lstrip(": ")
                raise UsageError(f"{source}: {problem}") from None
            if self.first is None:
                if discrete and not recipe.discrete:
                    names = tuple(map(str, recording.fields.get("choices", ())))
                    recipe = dataclasses.replace(recipe, discrete=names or int(discrete))
                converter = Converter(selection, recipe, int(start) if discrete else 0)
                self.first = _First(layout, selection, Spool(converter), source, choices)
            self.selections[layout] = _in_order(selection, self.first, source)
        first = cast("_First", self.first)
        if choices != first.choices:
            expected = f"expected {first.choices} as in {first.source}"
            raise TrajectoryError(f"{source}: its actions are {choices}, {expected}")
        return self.selections[layout], first

    def _outcome_kind_and_task(self, recorded: Recorded) -> tuple[bool | None, str, str]:
        """Return outcome, anomaly and task of a recording by its fields, None or empty without."""
        recipe = self.recipe

        def value(name: str, *, last: bool = False) -> str | None:
            with contextlib.suppress(*[UnknownNameError] * self.every):
                return recorded.text(name, last=last) if name else None
            return None

        said = value(recipe.outcome, last=True)
        outcome = None if said is None else said.lower() in _TRUE
        if said and said.lower() not in _TRUE | _FALSE:
            problem = f"{recipe.outcome} is {said.lower()!r}, expected true or false"
            raise TrajectoryError(f"{recorded.source}: {problem}")
        kind = ""
        if (text := value(recipe.kinds)) is not None:
            nominal = map(text_of, recipe.nominal.where.get(recipe.kinds, ()))
            kind = "" if text in nominal else anomaly_name(text)
        if not kind and outcome is False:
            fallback = [name for name, table in recipe.anomalous.items() if not table.files]
            kind = next(iter([*recorded.kinds, *fallback]), FAILURE)
        return outcome, kind, value(recipe.task) or ""

    def _cut(
        self, recorded: Recorded, total: int, rows: Sequence[AnomalousRows], *, is_cut: bool
    ) -> Iterator[tuple[str, int, int, Sequence[AnomalousRows], bool]]:
        """Yield part, rows and anomalous rows of the episodes of a stretch, and if it was cut."""
        windows: dict[int, set[str]] = {}
        for role in sorted(recorded.roles):
            table = self.recipe.anomalous.get(role.removeprefix("test/"), _NO_FILES)
            is_nominal = self.every or role in NOMINAL_ROLES
            window = self.recipe.nominal.window if is_nominal else table.window
            windows.setdefault(self.recipe.window if window is None else window, set()).add(role)
        for window, roles in windows.items():
            has_windows = 0 < window < total
            is_piece = has_windows or is_cut
            length = window if has_windows else total
            for start in range(0, total, length):
                stop = min(start + length, total)
                inside = [
                    (max(a - start, 0 if a >= 0 or start else -1), min(b, stop) - start, name)
                    for a, b, name in rows
                    if b > start and a < stop
                ]
                parts = self._parts_of(recorded, roles, inside, is_piece=is_piece)
                # A short last window is kept where it is labelled, and where all are judged.
                is_plain = NOMINAL_ROLES & {*parts} or (parts and not inside)
                if stop - start < length and is_plain and not self.every:
                    reason, count = "at ends of recordings, less than a window", stop - start
                    self.ledger.add("row", "dropped", reason, count=count, source=recorded.label)
                elif stop - start < self.shortest:
                    if not (is_piece or self.every):
                        raise self._too_short(recorded.recording, stop - start)
                    reason = f"pieces shorter than {self.shortest} rows"
                    self.ledger.add("episode", "dropped", reason, source=recorded.label)
                else:
                    if has_windows and not inside:
                        self.cut_by_outcome |= {*parts} - NOMINAL_ROLES
                    yield from ((part, start, stop, inside, is_piece) for part in parts)

    def _parts_of(
        self, recorded: Recorded, roles: set[str], rows: Sequence[AnomalousRows], *, is_piece: bool
    ) -> list[str]:
        """Return the parts that an episode of a recording belongs to."""
        source, recipe = recorded.source, self.recipe
        if recorded.kind:
            return [f"test/{recorded.kind}"]
        nominal = sorted(roles & NOMINAL_ROLES)
        kinds = sorted(role.removeprefix("test/") for role in roles - NOMINAL_ROLES)
        unsaid = [] if any(map(self._says_rows, kinds)) else [f"test/{name}" for name in kinds]
        if self.every:
            named = [name for *_, name in rows if name]
            said = [f"test/{(named or kinds or [_ANOMALOUS])[0]}"]
            return said if rows else unsaid[:1] or [EVERY]
        if recipe.kinds or recipe.outcome:
            if not nominal:
                reason = "nominal, in files of an anomaly alone"
                self.ledger.add("recording", "dropped", reason, source=recorded.label)
            return nominal
        if not rows and (nominal or recipe.paired or unsaid):
            return nominal or [f"test/{name}" for name in kinds]
        labelled = {name for *_, name in rows}
        # Intervals may name an anomaly that has no files of its own.
        fileless = {n for n in labelled if n and not recipe.anomalous.get(n, _NO_FILES).files}
        if matching := [n for n in sorted({*kinds} | fileless) if labelled & {"", n}]:
            return [f"test/{name}" for name in matching]
        # Problems are raised at the end: names in a list of intervals, or labels, may be wrong.
        if is_piece or (rows and not nominal):
            reason = "windows of anomalous recordings without an anomalous row"
            reason = "windows with anomalous rows, of nominal files" if rows else reason
            self.ledger.add("episode", "dropped", reason, source=recorded.label)
        elif rows:
            span = f"{max(rows[0][0], 0)} to {rows[0][1] - 1}"
            self.problems.append(
                f"{source} is listed as nominal, but is anomalous in rows {span}: list it under "
                "[anomalous.NAME], or cut it with window, so that windows without anomalous rows "
                "are nominal; nominal_label names labels other than 0, false, H or nothing"
            )
        else:
            labels = {*recipe.labels, *(t for k in kinds for t in recipe.anomalous[k].labels)}
            columns = f" in {' and '.join(map(repr, sorted(labels)))}" if labels else ""
            self.problems.append(
                f"{source} has no anomalous row by its labels{columns}, expected some as it is "
                f"listed under {', '.join(kinds)}: leave it out, or list it under [nominal]"
            )
        return []

    def _says_rows(self, kind: str) -> bool:
        """Tell whether the recipe says which rows of an anomaly are anomalous."""
        recipe, table = self.recipe, self.recipe.anomalous.get(kind, _NO_FILES)
        has_onset = {recipe.onset, table.onset} != {None}
        return bool(recipe.labels or table.labels or self.intervals or has_onset)

    def _too_short(self, recording: Recording, rows: int) -> TrajectoryError:
        least, rate = self.shortest, self.recipe.rate
        why = ", more than the baseline" if least > 2 else ""
        logged = max(topic.rows for topic in recording.topics.values())
        if rate and logged >= least:
            unit = f"rate = {rate:g} and the unit of the stamps right, as in time = 'NAME[ms]'"
            why += f"; {logged} rows were logged: are {unit}?"
        problem = f"{counted(rows, 'observation(s)')}, expected at least {least}{why}"
        return TrajectoryError(f"{recording.source} has {problem}")

    def _keep(self, facts: EpisodeFacts, label: str) -> None:
        baseline, part = self.recipe.baseline, EVERY if self.every else facts.part
        if part in NOMINAL_ROLES and facts.episode.task in self.unseen:
            part = TWINS
        early = [start for start, _ in facts.episode.intervals if 0 <= start < baseline]
        if early and "#" not in facts.episode.name and not self.every:
            self.problems.append(
                f"{facts.episode.source} is anomalous from row {early[0]} on, expected its first "
                f"{baseline} rows (baseline) to be nominal"
            )
        elif early and not self.every:
            reason = "windows that are anomalous within their baseline"
            self.ledger.add("episode", "dropped", reason, source=label)
        else:
            episodes = self.parts.setdefault(part, [])
            if len(episodes) == EPISODES and not self.every:
                raise UsageError(f"{part} has more than {EPISODES} episodes, the most there are")
            episodes.append(facts)

    def _every_episode(self) -> EpisodeSource:
        """Return all episodes in one part, in the order of stamps if these tell it."""
        for error in self.intervals.unused(self.names):
            self.ledger.add("mark", "dropped", str(error))
        if self.by_stamps:
            self.parts.get(EVERY, []).sort(key=lambda facts: facts.begin)
        source = self._source(self.parts)
        for text, problem in label_problems(self.label_counts, self.unlabelled, self.recipe):
            self.ledger.add("column", "kept", problem, name=text)
        return source

    def _in_parts(self) -> EpisodeSource:
        """Return all episodes in their parts."""
        recipe, selections = self.recipe, self.selections
        if self.first is None:
            raise UsageError("there are no recordings to read, expected at least one")
        for error in self.intervals.unused(self.names):
            raise error
        labelled = {text for selection in selections.values() for text in selection.labels}
        for text in (text for text in recipe.label_columns if text not in labelled):
            columns = {name for layout in selections for name in named_columns(layout)}
            raise UnknownNameError("column with labels", text, columns)
        for _, problem in label_problems(self.label_counts, self.unlabelled, self.recipe):
            raise UsageError(problem)
        for problem in self.problems:
            raise TrajectoryError(problem)
        tasks = dict.fromkeys(f.episode.task for facts in self.parts.values() for f in facts)
        check_known("task (unseen)", tasks, *sorted(self.unseen))
        if self.unseen and self.unseen >= {*tasks}:
            raise UsageError(f"unseen names all tasks, {', '.join(tasks)}: none is for training")
        failed = self._failed_for_training()
        parts = self._shared_out()
        for part in (part for part in (TRAIN, CALIBRATION) if not parts[part]):
            why = f"[nominal] names no file with one for {part}"
            if left_out := [f"{counted(e.count, f'{e.item}(s)')}, {e.reason}" for e in self.ledger]:
                why = f"left out are {'; '.join(left_out)}"
            if count := len(self.parts.get(FILES, ())):
                why = f"the nominal files make {count}; a window cuts long recordings into several"
            raise UsageError(f"there are no {part} episodes, expected at least 1: {why}")
        present = [part.removeprefix("test/") for part in self.parts if part not in NOMINAL_ROLES]
        kinds = in_order(present, ANOMALIES)
        listed = [name for name, table in recipe.anomalous.items() if table.files]
        lacking = [name for name in listed if name not in kinds]
        if lacking and not kinds:
            raise UsageError(f"[anomalous.{lacking[0]}] has no episodes, expected at least one")
        parts |= {f"test/{kind}": self.parts[f"test/{kind}"] for kind in kinds}
        parts |= {FAILURES: failed} if failed else {}
        source = self._source(parts)
        groups = {kind: recipe.anomalous.get(kind, _NO_FILES).group for kind in kinds}
        source.groups = groups | {k: ANOMALIES[k].group for k in kinds if k in ANOMALIES}
        _settle_columns(source, recipe)
        source.notes[:0] = self._notes(source)
        if lacking:
            source.notes.append(f"no episodes of these anomalies: {', '.join(lacking)}")
        return source

    def _failed_for_training(self) -> list[EpisodeFacts]:
        """Take the first failed episodes of each task that is seen out of the parts of the test."""
        tests = (facts for part, facts in self.parts.items() if part not in NOMINAL_ROLES)
        seen = (f for facts in tests for f in facts if f.episode.task not in self.unseen)
        failed = [facts for facts in seen if facts.episode.outcome is False]
        failed.sort(key=lambda facts: facts.begin if self.by_stamps else facts.first)
        taken: set[EpisodeFacts] = set()
        for task in {facts.episode.task for facts in failed}:
            of_task = [facts for facts in failed if facts.episode.task == task]
            taken |= {*of_task[: int(np.rint(self.recipe.failures * len(of_task)))]}
        left = {part: [f for f in facts if f not in taken] for part, facts in self.parts.items()}
        self.parts = {part: facts for part, facts in left.items() if facts}
        return [facts for facts in failed if facts in taken]

    def _source(self, parts: dict[str, list[EpisodeFacts]]) -> EpisodeSource:
        if self.first is None or not any(parts.values()):
            for failure in self.failures:
                raise failure
            raise UsageError("there are no episodes to read, expected at least one")
        for steps in self.steps.values():
            median = float(np.median([s.usual for s in steps.values()]))
            for label, step in ((label, s.usual) for label, s in steps.items()):
                if not median / SLOWER < step < median * SLOWER:
                    reason = f"a row every {step:g} s, where others have one every {median:g} s"
                    self.ledger.add("recording", "kept", reason, source=label)
        rate = self.recipe.rate or even_rate(self._all_steps())
        has_rewards, count = self.first.selection.reward is not None, len(self.failures)
        about = rate, parts, self.ledger, self.recordings + count
        source = EpisodeSource(self.first.spool, has_rewards, *about)
        _say_far(source)
        return source

    def _all_steps(self) -> list[Steps]:
        return [steps for of_topic in self.steps.values() for steps in of_topic.values()]

    def _shared_out(self) -> dict[str, list[EpisodeFacts]]:
        """Return nominal episodes by part: shares of each task, in the order of the recording."""
        recipe = self.recipe
        parts: dict[str, list[EpisodeFacts]] = {p: self.parts.get(p, []) for p in _SHARED}
        episodes = list(self.parts.get(FILES, []))
        if self.by_stamps:
            episodes.sort(key=lambda facts: facts.begin)
        if recipe.order == "shuffled":
            order = np.random.default_rng(recipe.seed).permutation(len(episodes))
            episodes = [episodes[i] for i in order]
        for task in dict.fromkeys(facts.episode.task for facts in episodes):
            of_task = [facts for facts in episodes if facts.episode.task == task]
            shares = np.cumsum(recipe.nominal.parts)
            bounds = [0, *np.rint(shares * len(of_task)).astype(int).tolist(), len(of_task)]
            for part, start, stop in zip(_SHARED, bounds, bounds[1:], strict=False):
                parts[part] = parts[part] + of_task[start:stop]
        return parts

    def _notes(self, source: EpisodeSource) -> list[str]:
        recipe = self.recipe
        columns = f"{counted(source.measured, 'sensor(s)')}, "
        columns += counted(len(source.actions), "action(s)")
        scores = len(source.sensors) - source.measured
        columns += f", {counted(scores, 'score(s)')}" if scores else ""
        lines = [f"read {counted(self.recordings, 'recording(s)')}: {columns}"]
        for part, episodes in source.parts.items():
            rows = sum(facts.rows for facts in episodes)
            line = f"{part}: {counted(len(episodes), 'episode(s)')}, {counted(rows, 'row(s)')}"
            intervals = [interval for facts in episodes for interval in facts.episode.intervals]
            marked = counted(sum(b - max(a, 0) for a, b in intervals), "anomalous row(s)")
            said = f", {counted(len(intervals), 'interval(s)')} with {marked}"
            said = said if intervals else ", known by their outcome alone"
            line += "" if part in {*_SHARED, FAILURES} else said
            if episodes or part != TWINS:
                lines.append(line)
            if part in self.cut_by_outcome:
                lines.append(
                    f"warning: {part} was cut by window, and nothing says which rows are "
                    "anomalous: every window counts, also before the fault. Name the rows (labels, "
                    "intervals, or onset, 0 for a fault from the first row on), or leave out window"
                )
        if recipe.nominal.files:
            how = "in the order of their stamps" if self.by_stamps else "in the order of files"
            how = f"shuffled (seed {recipe.seed})" if recipe.order == "shuffled" else how
            lines.append(f"nominal episodes were shared out {how}")
        if recipe.failures and FAILURES not in source.parts:
            share = f"failures = {recipe.failures:g} of few"
            lines.append(f"no failed episode is for training: {share}")
        if self.steps and source.rate is None:
            steps = self._all_steps()
            shortest, longest = min(s.shortest for s in steps), max(s.longest for s in steps)
            apart = f"rows are {shortest:g} to {longest:g} s apart and taken as they are"
            lines.append(f"{apart}: rate in the recipe resamples them")
        if self.first and (choices := self.first.spool.converter.choices):
            advice = f"discrete = {choices} (--discrete {choices}) makes each a column"
            numbers = f"actions are whole numbers from 0 to {choices - 1}"
            lines.append(f"{numbers}: if they are choices, {advice}")
        return lines


def _in_order(selection: Selection, first: _First, source: str) -> Selection:
    """Return a selection with the columns of the first recording, in their order."""
    # Globs may match further columns in later files: these are unused.
    if selection == first.selection:
        return selection
    ordered: dict[str, Any] = {}
    unused = selection.unused
    for kind in ("sensors", "actions"):
        expected = [column.quantity for column in getattr(first.selection, kind)]
        by_name = {column.quantity: column for column in getattr(selection, kind)}
        if lacking := [f"{q.name}[{q.unit}]" for q in expected if q not in by_name]:
            raise TrajectoryError(
                f"{source} has {len(by_name)} {kind}, {first.source} {len(expected)}: it lacks "
                f"{', '.join(lacking[:6])}; expected the same in all files, by name and unit"
            )
        ordered[kind] = tuple(by_name[quantity] for quantity in expected)
        unused += tuple(quantity.name for quantity in by_name if quantity not in expected)
    if (selection.reward is None) != (first.selection.reward is None):
        raise TrajectoryError(f"{source}: only some of the files have rewards")
    return dataclasses.replace(selection, unused=unused, **ordered)


def _say_far(source: EpisodeSource) -> None:
    """Name the rows of values that are no measurements by their size."""
    every = [facts for episodes in source.parts.values() for facts in episodes]
    width, total = source.measured, sum(facts.rows for facts in every)
    step = max(1, total * width // _SAMPLED)
    sampled = [rows[::step, :width].copy() for facts in every for rows in source.blocks(facts)]
    sample = np.concatenate(sampled)
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # no value
        finite = np.where(np.isfinite(sample), sample, np.nan)
        low, centre, high = np.nanquantile(finite, [0.05, 0.5, 0.95], axis=0)
    most = np.where(high > low, FAR * (high - low) / 2, np.inf)
    for facts in every:
        for i, rows in enumerate(source.blocks(facts)):
            far = np.isfinite(rows[:, :width]) & (np.abs(rows[:, :width] - centre) > most)
            for row, d in np.argwhere(far).tolist():
                name, cell = source.sensors[d].name, f"{rows[row, d]:g}"
                at: dict[str, Any] = {"source": facts.episode.name, "row": i * _BLOCK + row}
                reason = "no measurement by its size"
                source.ledger.add("cell", "kept", reason, name=name, cell=cell, **at)


def _settle_columns(source: EpisodeSource, recipe: Recipe) -> None:
    """Drop constant sensors if asked to, and find offsets of those that float32 cannot tell."""
    train = _moments(source, source.parts[TRAIN])
    is_constant = train.low == train.high
    same = itertools.compress(source.sensors[source.measured :], is_constant[source.measured :])
    if names := ", ".join(q.name for q in same):  # a flag is never raised there
        source.notes.append(f"scores that are constant in training, and kept: {names}")
    is_constant[source.measured :] = False
    names = ", ".join(q.name for q, same in zip(source.sensors, is_constant, strict=True) if same)
    is_dropped = recipe.constant == "drop"
    if names:
        how = "left out as constant" if is_dropped else "constant"
        source.notes.append(f"{how} in training: {names}")
    if names and is_dropped:
        kept, width = np.flatnonzero(~is_constant).tolist(), len(source.sensors)
        if len(kept) == width - source.measured:
            raise UsageError(f"all sensors are constant in training: {names}")
        source.sensors = tuple(source.sensors[i] for i in kept)
        source._kept = (*kept, *range(width, len(source._kept)))  # noqa: SLF001
        train = _moments(source, source.parts[TRAIN])
    every = _moments(source, [facts for episodes in source.parts.values() for facts in episodes])
    # What training never shows may still move later.
    spread = np.where(train.low == train.high, every.high - every.low, train.spread)
    if (every.largest > np.finfo(np.float32).max / 2).any():
        name, largest = source.sensors[every.largest.argmax()].name, every.largest.max()
        cells = "".join(entry.where() for entry in source.ledger.of("cell", "kept"))
        raise TrajectoryError(f"sensor {name!r} reaches {largest:g}, too large for float32{cells}")
    blurred = is_coarse(spread, every.largest)
    coarse = itertools.compress(source.sensors[source.measured :], blurred[source.measured :])
    if names := ", ".join(q.name for q in coarse):  # which stay as they were recorded
        problem = f"float32 cannot tell values of these scores: {names}"
        source.notes.append(f"warning: {problem}; record them without what never changes")
    blurred[source.measured :] = False
    if blurred.any():
        source.offsets = tuple(np.where(blurred, train.mean, 0.0).tolist())
        columns = zip(source.sensors, train.mean, spread, blurred, strict=True)
        texts = [f"{q.name} ({mean:g}, spread {s:.2g})" for q, mean, s, is_so in columns if is_so]
        reason = "the training mean is subtracted, as float32 could not tell values"
        source.notes.append(f"{reason}: {', '.join(texts)}")


def _moments(source: EpisodeSource, episodes: Iterable[EpisodeFacts]) -> RunningMoments:
    moments = RunningMoments()
    for facts in episodes:
        for rows in source.blocks(facts):
            moments.add(rows[:, : len(source.sensors)])
    return moments
