"""Contents of logs: recordings, their columns and clocks, and files that are not as the others."""

import contextlib
import functools
import hashlib
import itertools
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.files import lies_in
from oodd_eval.errors import TrajectoryError, UsageError
from oodd_eval.names import check_known, listed
from oodd_logs.inspection.columns import (
    EXCEPTIONS,
    FEW,
    ClockFacts,
    ColumnFacts,
    parse_dates,
    time_unit,
)
from oodd_logs.inspection.episode_keys import episode_columns
from oodd_logs.inspection.roles import Recognised, recognise, role_of
from oodd_logs.kinds import kinds
from oodd_logs.kinds.times import UNIT_NAMES, names_time, pairs_of, unit_in, unit_of
from oodd_logs.ledger import Ledger
from oodd_logs.marks import says_nominal
from oodd_logs.readers import NO_OPTIONS, Options, Reader, in_order, readers
from oodd_logs.recording import Column, Recording, Topic
from oodd_logs.selecting import plain_name, plain_unit, split_unit
from oodd_logs.splitting import split_recording

_SHORT: Final = 512  # rows up to which recordings are counted together
_PENDING: Final = 256  # recordings
_CELLS: Final = 1 << 20  # of the rows that are in memory at once
_TABLES: Final = 3  # recordings in which columns are looked for that tell episodes apart
SLOW: Final = 0.1
"""Share of the rows of the fullest topic, below which one is left out at first."""

_FEW_FILES: Final = 0.2  # share of the files that are left out where they lack a column
READ_ROWS: Final = 2_000_000
"""Rows of a topic that are looked at; of a longer one, blocks over all of it."""
_FIRST: Final = 8  # columns of which the first row may count like a clock
_ENDS: Final = 2000  # rows at either end of a recording that are compared with others
_OVERLAP: Final = 20  # rows that two recordings have to share
_PRIME: Final = np.uint64(0x100000001B3)
_TAG: Final = re.compile(
    r"(.*[_. ])?(tag|topic|variable|signal|sensor|parameter|channel|metric|measurement|point)"
    r"([_. ]?(name|id))?",
    re.IGNORECASE,
)
_LABEL: Final = re.compile(
    r"anomal|fault|fail|label|health|attack|alarm|error|class|status|stop|lost|binary"
    r"|outlier|novelty|defect",
    re.IGNORECASE,
)
_SCORE: Final = re.compile(
    r"innov|residual|test.?ratio|uncertain|disagreement|epistemic|mahalanobis|likelihood"
    r"|(?:pred|recon|chunk|forecast|model)[a-z]*[^a-z]?err"
    r"|(?:^|[^a-z])(?:scores?|mse|rmse|mae|mmd|nis|nees|nll|ood|novelty|surprise|entropy|chi2)"
    r"(?:$|[^a-z])"
    r"|[NX]KF3(?:_\d+)?\.I[MPVY]|[NX]KF4(?:_\d+)?\.S[HMPV]",  # ArduPilot's innovations and ratios
    re.IGNORECASE,
)
_VARIANCE: Final = re.compile(r"variance|(?:^|[^a-z])var(?:$|[^a-z])", re.IGNORECASE)
_DAY: Final = 86400  # seconds
_Key = TypeVar("_Key")
_Value = TypeVar("_Value")
_INTERVALS: Final = ({"file", "start"}, {"file", "onset"})


@dataclass(eq=False, slots=True)
class RecordingFacts:
    """Contents of one recording.

    Parameters
    ----------
    name
        As the reader names it.
    file
        Its file, relative to the path that was inspected.
    rows
        Number of rows of each topic.
    fields
        Values that hold for the whole recording.
    columns
        Names of its columns, below their topics if there are several.
    clocks
        Facts of the columns that may have times, by name.
    values
        Cells by value, of each column with few values.
    empty
        Columns without a number in it.
    digest
        SHA-256 of its rows.
    head, tail
        Hashes of some first and last rows, without times, texts and flags.
    """

    name: str
    file: str
    rows: Mapping[str, int]
    fields: Mapping[str, Any]
    columns: tuple[str, ...] = ()
    clocks: dict[str, ClockFacts] = field(default_factory=dict)
    values: dict[str, Mapping[float | str, int]] = field(default_factory=dict)
    empty: set[str] = field(default_factory=set)
    digest: bytes = b""
    head: NDArray[np.uint64] = field(default_factory=lambda: np.empty(0, np.uint64))
    tail: NDArray[np.uint64] = field(default_factory=lambda: np.empty(0, np.uint64))

    @property
    def length(self) -> int:
        """Rows of the longest topic."""
        return max(self.rows.values(), default=0)

    def hash_rows(self, block: Mapping[str, Column], names: Sequence[str]) -> None:
        """Take the next rows, which the columns of some names tell from others."""
        cells = (cells.tobytes() for cells in block.values())
        self.digest = hashlib.sha256(b"".join([self.digest, *cells])).digest()
        hashes = np.zeros(len(next(iter(block.values()))) if names else 0, np.uint64)
        for name in names:
            hashes = hashes * _PRIME ^ np.ascontiguousarray(block[name]).view(np.uint64)
        self.head = np.append(self.head, hashes[: _ENDS - len(self.head)])
        self.tail = np.append(self.tail, hashes)[-_ENDS:]

    def rename(self, new: Mapping[str, str]) -> None:
        """Give columns other names."""
        self.columns = tuple(new.get(name, name) for name in self.columns)
        self.clocks = {new.get(name, name): clock for name, clock in self.clocks.items()}
        self.values = {new.get(name, name): values for name, values in self.values.items()}
        self.empty = {new.get(name, name) for name in self.empty}


@dataclass(eq=False)
class Inspection:
    """Contents of logs, and the roles that columns may have.

    Parameters
    ----------
    path
        The file or folder.
    form
        Name of the format.
    options
        Options with which the files were read.
    episode
        Columns that tell the episodes of a file apart; none where a recording is one.
    recordings
        Facts of each recording, in the order of the files.
    columns
        Facts of each column by name, over all recordings.
    added
        Columns whose times are added to those of others, such as times of day, by these.
    stamps
        Columns that the format defines to be times in seconds.
    transposed
        Files whose rows and columns are exchanged; they were read so.
    equal
        Groups of files, or of recordings within a file, with the same rows.
    shared
        Number of recordings that also stand in another file, by file, of those not in `equal`.
    continued
        Two files, the last rows of the first of which are the first of the second, and how many.
    intervals
        File that says which rows of others are anomalous; empty without one.
    others
        Number of files of other formats, by ending.
    problems, unreadable
        What could not be read, and the files of which nothing is.
    ledger
        What was left out, or is not as in most of the logs.
    """

    path: Path
    form: str
    options: dict[str, Any] = field(default_factory=dict)
    episode: tuple[str, ...] = ()
    recordings: list[RecordingFacts] = field(default_factory=list)
    columns: dict[str, ColumnFacts] = field(default_factory=dict)
    added: dict[str, str] = field(default_factory=dict)
    stamps: set[str] = field(default_factory=set)
    transposed: list[str] = field(default_factory=list)
    equal: list[list[str]] = field(default_factory=list)
    shared: dict[str, int] = field(default_factory=dict)
    continued: list[tuple[str, str, int]] = field(default_factory=list)
    intervals: str = ""
    others: Counter[str] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)
    unreadable: list[str] = field(default_factory=list)
    ledger: Ledger = field(default_factory=Ledger)
    _spellings: dict[tuple[str, str], str] = field(default_factory=dict)
    _pending: list[tuple[str, int, dict[str, Column], RecordingFacts]] = field(default_factory=list)
    _rowless: list[tuple[str, str]] = field(default_factory=list)
    _written: dict[str, dict[str, list[str]]] = field(default_factory=dict)

    @cached_property
    def topics(self) -> tuple[str, ...]:
        """Names of the topics, in their order."""
        return tuple(dict.fromkeys(t for r in self.recordings for t in r.rows))

    def topic_of(self, name: str) -> str:
        """Return the topic of a column."""
        return max((t for t in self.topics if name.startswith(f"{t}.")), key=len, default="")

    def clocks(self, name: str) -> list[tuple[RecordingFacts, ClockFacts]]:
        """Return the recordings in which a column may have times, with facts of these."""
        order = self.date_order
        clocks = ((r, r.clocks[name]) for r in self.recordings if name in r.clocks)
        return [(r, clock.by_order.get(order, clock)) for r, clock in clocks]

    @cached_property
    def times(self) -> dict[str, str]:
        """Columns with the times of rows, one a topic, and their units.

        Of those that may be, the one that falls and stands still least in the median of the
        recordings; none where a hundredth of its steps do.
        """
        best: dict[str, tuple[float, str]] = {}
        for name, (falls, repeats) in self._stuck.items():
            topic, facts, share = self.topic_of(name), self.columns[name], falls + repeats
            most = min(0.01, best.get(topic, (1.0, ""))[0])
            if share < most and facts.missing < facts.cells / 2:
                best[topic] = share, name
        clocks = {name: [clock for _, clock in self.clocks(name)] for _, name in best.values()}
        return {n: "s" if n in self.stamps else time_unit(n, c) for n, c in clocks.items()}

    @cached_property
    def _stuck(self) -> dict[str, tuple[float, float]]:
        """Shares of steps that fall, and that are none, in the median recording, of likely times.

        They are likely where half of the recordings with their topic have them.
        """
        topics = Counter(topic for recording in self.recordings for topic in recording.rows)
        shares = grouped(
            (name, np.array([clock.steps.falls, clock.steps.repeats]) / max(1, rows))
            for recording in self.recordings
            for name, clock in recording.clocks.items()
            for rows in [recording.rows[self.topic_of(name)]]
        )
        likely = (name for name in shares if 2 * len(shares[name]) >= topics[self.topic_of(name)])
        return {name: tuple(np.median(shares[name], axis=0)) for name in likely}

    @cached_property
    def date_order(self) -> str:
        """Which of day and month comes first in dates; empty where none needs that.

        All cells tell; where they leave both, the one that makes the shortest steps, else the
        likelier.
        """
        readings = [c.by_order for r in self.recordings for c in r.clocks.values() if c.by_order]
        orders = [o for o in (readings or [{}])[0] if all(o in other for other in readings)]
        longest = {o: max(clocks[o].steps.longest for clocks in readings) for o in orders}
        return min(orders, key=lambda order: longest[order], default="")

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """Columns that may say which rows are anomalous, the likeliest first.

        They have few values, whole numbers with many zeros or texts, and a name that says so, or
        are missing from some recordings.
        """
        candidates = []
        for name, facts in self.columns.items():
            values: Mapping[float | str, int] = facts.values or {}
            numbers = [value for value in values if not isinstance(value, str)]
            partial = facts.recordings < len(self.recordings) and 0.0 in values
            is_good = says_nominal(name)
            often = partial or values.get(float(is_good), 0) > facts.cells / 4
            often = often or {*values} in ({-1.0, 1.0}, {-1.0, 0.0, 1.0})
            fits = bool(facts.words) or (often and all(x == round(x) for x in numbers))
            says_so = is_good or _LABEL.search(name.removeprefix(self.topic_of(name)))
            if facts.flag and fits and (partial or says_so):
                candidates.append((len(values) > 2, facts.missing > 0, not facts.text, name))
        return tuple(name for *_, name in sorted(candidates, key=lambda row: row[:-1]))

    @cached_property
    def kinds(self) -> Recognised:
        """Kinds of the columns of numbers that are no times or labels."""
        excluded = {*self.times, *self.added.values(), *self.labels, *self._scores}
        plain = {n: c for n, c in self.columns.items() if not (n in excluded or c.empty or c.text)}
        return recognise(plain)

    @cached_property
    def _scores(self) -> set[str]:
        """Columns of varying numbers that a monitor computed, by their names."""
        excluded = {*self.times, *self.added.values(), *self.labels}
        named = {n for n in self.columns if _SCORE.search(n) and not _VARIANCE.search(n)}
        facts = ((name, self.columns[name]) for name in named - excluded)
        return {n for n, c in facts if not (c.empty or c.text or c.constant or c.set_point)}

    @cached_property
    def roles(self) -> dict[str, str]:
        """Why columns are no sensors, by name: a role, or a kind; empty texts for sensors.

        Where only scores would be left, they are sensors: a monitor's column may be one.
        """
        usable = (recording for recording in self.recordings if recording.file in self.usable)
        partial = {n for r in usable for n in self._lacking(r) & self._candidates}
        roles = self._basic_roles | dict.fromkeys(partial, "partial")
        of_scores = "scores" if "" in roles.values() else ""
        return {name: of_scores if role == "scores" else role for name, role in roles.items()}

    @cached_property
    def _basic_roles(self) -> dict[str, str]:
        """Roles of columns regardless of the files that they are in."""
        names_by_role = {"times": {*self.times, *self.added.values()}, "labels": {*self.labels}}
        # Stamps that rise, but stand still too often for times of rows.
        standing = {n for n, (falls, repeats) in self._stuck.items() if falls < 0.01 <= repeats}
        names_by_role |= {"standing": standing, "scores": self._scores}
        of_kinds: dict[str, str] = {}
        together: set[str] = set()
        for kind, members in self.kinds.items():
            for names in members:
                of_kinds |= dict.fromkeys(names, "" if kinds()[kind].sensor else kind)
                together |= {*names} if len(names) > 1 else set()

        rows = {name: c.cells / max(1, c.recordings) for name, c in self.columns.items()}
        fewest = SLOW * max(rows.values(), default=0)

        def role(name: str, facts: ColumnFacts) -> str:
            roles = [role for role, names in names_by_role.items() if name in names]
            roles += [role for role in ("empty", "text") if getattr(facts, role)]
            if roles or name in together:
                return (roles or [""])[0]
            if facts.constant:
                return "constant"
            slow = "slow" if rows[name] < fewest else ""
            return of_kinds.get(name) or ("setpoints" if facts.set_point else slow)

        return {name: role(name, facts) for name, facts in self.columns.items()}

    def _lacking(self, recording: RecordingFacts) -> set[str]:
        """Return the columns that are sensors by their role, or times, and not in a recording."""
        times = {name for name in self.times if self.topic_of(name) in recording.rows}
        needed = times | self._candidates
        return (needed - {*recording.columns}) | (needed & recording.empty)

    @cached_property
    def _candidates(self) -> set[str]:
        return {name for name, role in self._basic_roles.items() if role in {"", "scores"}}

    @cached_property
    def usable(self) -> list[str]:
        """Files but for copies of others, and those that lack columns of most others.

        At most a fifth are left out so that all have a column. Where none is in all then, the files
        are those with the commonest columns.
        """
        copies = {file for same in self.equal for file in same[1:]}
        files = dict.fromkeys(r.file for r in self.recordings if r.file not in copies)
        recordings = (r for r in self.recordings if r.file in files)
        without = grouped((name, r.file) for r in recordings for name in self._lacking(r))
        left_out: set[str] = set()
        for lacking in sorted(map(set, without.values()), key=len):
            if len(left_out | lacking) <= _FEW_FILES * len(files):
                left_out |= lacking
        usable = [r for r in self.recordings if r.file in files and r.file not in left_out]
        if usable and not set.intersection(*(set(r.columns) for r in usable)):
            ((columns, _),) = Counter(r.columns for r in usable).most_common(1)
            usable = [r for r in usable if r.columns == columns]
        return list(dict.fromkeys(r.file for r in usable))

    @cached_property
    def sensors(self) -> list[str]:
        """The columns that are sensors of a first recipe."""
        named = [n for n in self.columns if n.startswith("obs:") and self.roles[n] != "scores"]
        return named or [name for name, role in self.roles.items() if not role]

    @cached_property
    def scores(self) -> list[str]:
        """The columns that are scores of a first recipe."""
        return [name for name, role in self.roles.items() if role == "scores"]

    def _names(self, topic: Topic, below: str, file: str) -> dict[str, str]:
        """Return the names of a topic's columns among all, which others may spell otherwise."""
        names = {name: f"{below}{name}" for name in topic.names}
        present = {*names.values()}
        for name, full_name in names.items():
            if full_name in self.columns:
                continue
            first = self._spellings.setdefault((below, plain_name(name)), full_name)
            units = {plain_unit(text) for text in (first, name)} - {""}
            if first not in present and len(units) < 2:
                self._written.setdefault(first, {}).setdefault(full_name, []).append(file)
                names[name] = first
        return names

    def settle(self, files: Sequence[str]) -> None:
        """Name columns as most recordings do, and say what is not as in most of them.

        Parameters
        ----------
        files
            Names of all files.
        """
        self._work_off()
        there = {recording.file for recording in self.recordings}
        for file in (f for f in files if f not in {*there, *self.unreadable, self.intervals}):
            self.unreadable.append(file)
            reason = "a broken link" if (self.path / file).is_symlink() else "no rows"
            self.ledger.add("file", "dropped", reason, source=file)
        for file, name in (pair for pair in self._rowless if pair[0] in there):
            self.ledger.add("recording", "dropped", "no rows", source=f"{file}, {name}")
        self._name_columns()
        for name, facts in self.columns.items():
            for (reason, source), (count, row, cell) in facts.exceptions.items():
                if not facts.text and name not in self.labels:
                    at: dict[str, Any] = {"source": source, "row": row, "cell": cell}
                    fate = EXCEPTIONS[reason]
                    self.ledger.add("cell", fate, reason, name=name, count=count, **at)
        usable = {*self.usable}
        used = {n for r in self.recordings if r.file in usable for n in r.columns}
        for recording in (r for r in self.recordings if r.file not in usable):
            lacking, file = self._lacking(recording) & used, recording.file
            for name in sorted(lacking & recording.empty):
                self.ledger.add("column", "kept", "no number in it", name=name, source=file)
            if lacking - recording.empty:
                units = {plain_name(name): name for name in recording.columns}
                instead = {n: units.get(plain_name(n)) for n in sorted(lacking - recording.empty)}
                lacks = [f"{n} (it has {other})" if other else n for n, other in instead.items()]
                self.ledger.add("file", "dropped", f"it lacks {listed(lacks)}", source=file)
        if self.columns.keys() - used:
            # What only files have that are left out takes no part.
            self.columns = {n: facts for n, facts in self.columns.items() if n in used}
            cached = (n for n, x in vars(type(self)).items() if isinstance(x, cached_property))
            for name in (name for name in cached if name != "usable"):
                self.__dict__.pop(name, None)
        for name, role in self.roles.items():
            if role and role not in {"times", "labels", "scores"}:
                self.ledger.add("column", "dropped", role_of(role).reason, name=name)
        kept = functools.partial(self.ledger.add, "column", "kept")
        sensors = [name for name, role in self.roles.items() if not role]
        for name, facts in self.columns.items():
            # A long table has a row for each value of one of several things.
            several = facts.text and (facts.values is None or len(facts.values) > 1)
            if several and len(sensors) < 2 and _TAG.fullmatch(name):
                mixed = ", ".join(sensors) or "other columns"
                kept(f"it says of what each row of {mixed} is: write a column for each", name=name)
        for name in self.columns:
            stem, unit = split_unit(name)
            if unit and names_time(stem) and not unit_of(unit):
                kept(f"{unit} is no unit of time, so that it has no times of rows", name=name)
        for name, unit in self.times.items():
            if unit not in {"date", "s", "ms", unit_in(name)}:
                kept(f"its numbers are taken for {UNIT_NAMES[unit]} by their size", name=name)
            clocks = (r.clocks[name] for r in self.recordings if name in r.clocks)
            if any(len(clock.by_order) > 1 for clock in clocks):
                kept(f"dates with the {self.date_order}", name=name)

    def _name_columns(self) -> None:
        """Name columns as most recordings do."""
        new: dict[str, str] = {}
        for name, others in self._written.items():
            otherwise = {file for files in others.values() for file in files}
            files = dict.fromkeys(r.file for r in self.recordings if name in r.columns)
            spellings = {name: [file for file in files if file not in otherwise], **others}
            new[name] = max(spellings, key=lambda spelling: len(spellings[spelling]))
            for other, spelled in spellings.items():
                reason = f"taken from {other!r}, as the file lacks it"
                for file in spelled if other != new[name] else ():
                    self.ledger.add("column", "changed", reason, name=new[name], source=file)
        self.columns = {new.get(name, name): facts for name, facts in self.columns.items()}
        self.added = {new.get(name, name): new.get(n, n) for name, n in self.added.items()}
        for recording in self.recordings if new else ():
            recording.rename(new)

    def add(self, recording: Recording, file: str) -> None:
        """Read the rows of a recording in blocks and keep what is in them."""
        topics = recording.topics.items()
        if not any(topic.rows for _, topic in topics):
            self._rowless.append((file, recording.name))
            return
        folder = self.path if self.path.name != file else self.path.parent
        source = recording.source.removeprefix(f"{folder}/")
        rows = {name: topic.rows for name, topic in topics}
        facts = RecordingFacts(recording.name, file, rows, dict(recording.fields))
        self.stamps |= {f"{n}.{t.time}" if n else t.time for n, t in topics if t.time}
        is_short = len(topics) == 1 and facts.length <= _SHORT
        if not is_short:
            self._work_off()
        for topic_name, topic in topics:
            names = self._names(topic, f"{topic_name}." if topic_name else "", file)
            facts.columns += tuple(names.values())
            for name in names.values():
                self.columns.setdefault(name, ColumnFacts())
            likely: list[tuple[str, ...]] = []
            stamps: dict[str, list[Column]] = {}
            numbered: list[NDArray[np.int64]] = []
            for start, block in _blocks(topic):
                if not start:
                    likely = _time_columns(topic, block)
                    stamps = {name: [] for together in likely for name in together}
                    numbers = (n for n, x in block.items() if x.dtype.kind == "f")
                    varied = (n for n in numbers if len({*block[n][:1000].tolist()}) > FEW)
                    hashed = sorted({*varied} - {*stamps})
                facts.hash_rows(block, hashed)
                waiting = {names[name]: cells for name, cells in block.items()}
                self._pending.append((source, start, waiting, facts))
                if not is_short:
                    self._work_off()
                numbered.append(np.arange(start, start + len(next(iter(block.values())))))
                for name in stamps:
                    stamps[name].append(block[name])
            for first, *more in likely:
                cells_of = [np.concatenate(stamps[name]) for name in (first, *more)]
                with contextlib.suppress(TrajectoryError):
                    if clock := ClockFacts.of(np.concatenate(numbered), cells_of):
                        facts.clocks[names[first]] = clock
                        self.added.update((names[first], names[name]) for name in more)
        self.ledger.merge(recording.ledger, source)
        self.recordings.append(facts)
        if len(self._pending) >= _PENDING:
            self._work_off()

    def _work_off(self) -> None:
        """Count the cells of blocks that have waited, column by column."""
        pending, self._pending = self._pending, []
        for _, alike in itertools.groupby(pending, key=lambda waiting: [*waiting[2]]):
            blocks = [*alike]
            for name in blocks[0][2]:
                # A text in one makes no texts of the others' numbers.
                texts = [block for block in blocks if block[2][name].dtype.kind == "U"]
                numbers = [block for block in blocks if block[2][name].dtype.kind != "U"]
                for several in filter(None, (texts, numbers)):
                    cells = [block[2][name] for block in several]
                    start, column = several[0][1], self.columns[name]
                    if not start:
                        firsts = np.cumsum([0, *map(len, cells[:-1])])
                        column.begin([source for source, *_ in several], firsts)
                    column.add(np.concatenate(cells), start)
                    for i, (*_, facts) in enumerate(several):
                        if column.values is not None:
                            facts.values[name] = column.recent[i]
                        (facts.empty.discard if column.filled[i] else facts.empty.add)(name)


def inspect_logs(
    path: Path,
    form: str = "",
    options: Options = NO_OPTIONS,
    progress: Callable[[str], None] = lambda _file: None,
    episode: tuple[str, ...] = (),
) -> Inspection:
    """Look at a file, a folder of files, or the directory of a data set.

    Rows are read in blocks. Of a topic with more than two million rows, blocks over all of it are.

    Parameters
    ----------
    path
        What to look at.
    form
        Name of the format; by default it is recognised.
    options
        Options of reading, as in a recipe's ``[read]`` table.
    progress
        Called with the name of each file before it is read.
    episode
        Columns that tell episodes of a file apart; by default they are looked for.

    Returns
    -------
    Inspection
        What is there. A file that cannot be read is among its problems.

    Raises
    ------
    UsageError
        When there is nothing of a known format, or an option is unknown.
    TrajectoryError
        When no file can be read.
    """
    reader, files, other_files = recognised(path, form)
    check_known(f"option of the format {reader.name}", reader.options, *options)
    result = Inspection(path, reader.name, dict(options), episode=episode, others=other_files)
    names = {
        file: file.name if file == path else file.relative_to(path).as_posix() for file in files
    }
    later: list[tuple[Path, Recording]] = []
    tables = 0
    for file in files:
        progress(names[file])
        try:
            for recording in reader.read(file, options):
                tables += 1
                if not result.episode and tables <= _TABLES:
                    result.episode = episode_columns(recording)
                    if result.episode and (result.recordings or later):
                        return inspect_logs(path, form, options, progress, result.episode)
                columns = [n for topic in recording.topics.values() for n in topic.names]
                if any(expected <= {*columns} for expected in _INTERVALS):
                    result.intervals = names[file]
                    continue
                # Those of a matrix, or of a text without a header, are numbered.
                stems = {re.sub(r"\d+(\[.*\])?$", "", name) for name in columns}
                is_matrix = len(recording.topics) == len(stems) == 1 < len(columns)
                is_matrix &= "header" not in reader.options or stems == {""}
                if is_matrix and not result.episode and "transpose" in reader.options:
                    later.append((file, recording))
                    continue
                for part in split_recording(recording, result.episode, lenient=True):
                    result.add(part, names[file])
        except TrajectoryError as error:
            result.problems.append(str(error))
            result.unreadable.append(names[file])
            reason = str(error).removeprefix(str(file)).lstrip(":, ")
            result.ledger.add("file", "dropped", reason, source=names[file])
    exchanged = set() if "transpose" in options else _exchanged(later)
    result.transposed = [names[file] for file in files if file in exchanged]
    for file, recording in later:
        if file not in exchanged:
            result.add(recording, names[file])
    for file in filter(exchanged.__contains__, files):
        for recording in reader.read(file, {**options, "transpose": True}):
            result.add(recording, names[file])
    if not result.recordings:
        no_rows = f"{str(path)!r} has no rows, expected some"
        raise TrajectoryError((result.problems or [no_rows])[0])
    order = {name: i for i, name in enumerate(names.values())}
    result.recordings.sort(key=lambda recording: order[recording.file])
    result.equal = _equal(result.recordings)
    equal = {file for same in result.equal for file in same}
    with_rows = grouped((facts.digest, facts.file) for facts in result.recordings)
    shared = Counter(r.file for r in result.recordings if len({*with_rows[r.digest]}) > 1)
    result.shared = {file: n for file, n in shared.items() if file not in equal}
    result.continued = _continued(result.recordings)
    # What a glob would match.
    links = (link for link in path.rglob("*") if not link.exists() and reader.fits(link))
    result.settle([*order, *(link.relative_to(path).as_posix() for link in links)])
    return result


def recognised(path: Path, form: str) -> tuple[Reader, list[Path], Counter[str]]:
    """Return the reader of a path, its files in order, and the number of others by ending."""
    formats = readers()
    if form:
        check_known("format", formats, form)
        formats = {form: formats[form]}
    if not path.exists():
        raise UsageError(f"{str(path)!r} does not exist, expected a file or folder of logs")
    if path.is_dir():
        for reader in formats.values():
            for candidates in ([path], sorted(filter(Path.is_dir, path.iterdir()))):
                if sets := [directory for directory in candidates if reader.fits(directory)]:
                    return reader, sets, Counter()
    files = [path]
    if not path.is_file():
        visible = (f for f in path.rglob("*") if "/." not in f"/{f.relative_to(path).as_posix()}")
        files = sorted(filter(Path.is_file, visible), key=lambda file: in_order(str(file)))
    best = ((max(formats.values(), key=lambda reader: reader.fits(file)), file) for file in files)
    is_said = bool(form) and path.is_file()
    by_reader = grouped((r.name, file) for r, file in best if is_said or r.fits(file))
    if not by_reader:
        endings = ", ".join(sorted({s for reader in formats.values() for s in reader.suffixes}))
        raise UsageError(
            f"{str(path)!r} has no files of a known format, expected names that end in {endings}; "
            "--format, or a recipe, says which it is"
        )
    # Beside logs, JSON files hold settings, and .bin anything.
    ambiguous = {"json", "ardupilot"}
    name = max(by_reader, key=lambda reader: (reader not in ambiguous, len(by_reader[reader])))
    read = {*by_reader[name]}
    return formats[name], by_reader[name], Counter(f.suffix for f in files if f not in read)


def refuse_logs(outputs: Iterable[Path | None], logs: Path, form: str | None) -> None:
    """Raise `UsageError` for an output in a folder of logs that would be read as one the next time.

    Parameters
    ----------
    outputs
        Files to write; None for those that were not asked for.
    logs, form
        The logs, and their format if it is said.
    """
    written = [path for path in outputs if path and lies_in(path, logs)]
    reader = recognised(logs, form or "")[0] if written else None
    for path in written:
        if reader and reader.fits(path):
            raise UsageError(
                f"{str(path)!r} would be one of the logs in {str(logs)!r} the next time, as "
                f"{reader.part}: expected a path elsewhere, choose another folder"
            )


def grouped(pairs: Iterable[tuple[_Key, _Value]]) -> dict[_Key, list[_Value]]:
    """Return the second items of pairs by the first."""
    groups: dict[_Key, list[_Value]] = defaultdict(list)
    for key, value in pairs:
        groups[key].append(value)
    return groups


def _continued(recordings: Sequence[RecordingFacts]) -> list[tuple[str, str, int]]:
    """Return files of which the last rows of the first are the first of the second."""
    varied = (r for r in recordings if len({*r.head[:_OVERLAP].tolist()}) == _OVERLAP)
    beginning = grouped((int(recording.head[0]), recording) for recording in varied)
    first_rows = np.array([*beginning], np.uint64)
    return [
        (recording.file, other.file, len(rows))
        for recording in recordings
        for i in np.flatnonzero(np.isin(recording.tail, first_rows)).tolist()
        for rows in [recording.tail[i:]]
        for other in beginning[int(rows[0])]
        if len(rows) >= _OVERLAP
        and other is not recording
        and not len(rows) == recording.length == other.length
        and np.array_equal(rows, other.head[: len(rows)])
    ]


def _equal(recordings: Sequence[RecordingFacts]) -> list[list[str]]:
    """Return the files that have the same rows as others, and the recordings of one file."""
    digests = grouped((recording.file, recording.digest) for recording in recordings)
    groups = grouped((tuple(rows), file) for file, rows in digests.items())
    if len(digests) == 1:
        groups = grouped(((recording.digest,), recording.name) for recording in recordings)
    return [same for same in groups.values() if len(same) > 1]


def _exchanged(matrices: Sequence[tuple[Path, Recording]]) -> set[Path]:
    """Return the files whose rows are columns."""
    # The first row counts like a clock, or there are as many rows as neighbours have columns, or
    # there is no neighbour to compare with and there are three times as many columns as rows.
    topics = [(file, next(iter(recording.topics.values()))) for file, recording in matrices]
    tall = Counter(len(t.names) for _, t in topics if t.rows > len(t.names))
    return {
        file
        for file, topic in topics
        if _first_row_counts(topic)
        or (len(topic.names) > topic.rows and topic.rows in tall)
        or (not tall and len(topic.names) >= max(3 * topic.rows, topic.rows + 1))
    }


def _first_row_counts(topic: Topic) -> bool:
    """Tell whether a first row of at least `_FIRST` numbers rises in equal steps."""
    if len(topic.names) < _FIRST or not topic.rows:
        return False
    row = np.concatenate([*topic.read(topic.names, 0, 1).values()])
    steps = np.diff(row) if row.dtype.kind == "f" else np.zeros(1)
    return bool(steps[0] > 0 and np.allclose(steps, steps[0], rtol=1e-3))


def _time_columns(topic: Topic, block: Mapping[str, Column]) -> list[tuple[str, ...]]:
    """Return columns that may have times of rows, and pairs of columns whose times add up."""
    texts: dict[str, str] = {}
    for name, cells in block.items():
        begins = cells[:3] if cells.dtype.kind == "U" and cells[:1].any() else cells[:0]
        if len(begins) and (seconds := parse_dates(begins)) is not None:
            texts[name] = "date" if not (seconds % _DAY).any() else "moment"
            if ":" in begins[0] and np.nanmax(np.abs(seconds)) < _DAY:
                texts[name] = "time of day"
    pairs = pairs_of(topic.names) if not topic.time else {}
    dates, times = ([n for n in texts if texts[n] == kind] for kind in ("date", "time of day"))
    pairs |= dict(zip(dates[:1], times[:1], strict=False))
    numbers = [n for n in block if block[n].dtype.kind != "U" and names_time(n)]
    likely = [topic.time] if topic.time else numbers
    plain = [*texts, *(n for n in likely if n == topic.time or unit_of(split_unit(n)[1] or "s"))]
    single = [(name,) for name in plain if name not in {*pairs, *pairs.values()}]
    return [*pairs.items(), *single]


def _blocks(topic: Topic) -> Iterator[tuple[int, dict[str, Column]]]:
    """Yield rows in blocks with the number of their first; of a long topic some of the blocks."""
    if not topic.names:
        return
    step = max(16, _CELLS // len(topic.names))
    starts = np.arange(0, topic.rows, step)
    if topic.rows > READ_ROWS:
        evenly = np.linspace(0, len(starts) - 1, READ_ROWS // step)
        starts = starts[np.unique(evenly.astype(np.intp))]
    for start in starts.tolist():
        yield start, topic.read(topic.names, start, min(start + step, topic.rows))
