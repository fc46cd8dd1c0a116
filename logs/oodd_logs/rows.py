"""Rows of a recording for an episode: read in blocks, missing values held, columns converted.

Nothing here holds more than a block of a recording; what comes out is float64.
"""

import contextlib
import itertools
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import Quantity, Role
from oodd_eval.errors import OutputError, TrajectoryError, UsageError
from oodd_logs.kinds import Conversion, Matrix, kinds_by_key
from oodd_logs.kinds.angles import FULL_TURN
from oodd_logs.kinds.naming import matching
from oodd_logs.ledger import Ledger
from oodd_logs.readers.cells import mixed
from oodd_logs.recipe import Recipe
from oodd_logs.recording import CELLS, Column, Recording, read_column
from oodd_logs.selecting import ChosenColumn, Selection
from oodd_logs.stamps import Stretch

_MOST_CHOICES: Final = 64
_MOST_ACTIONS: Final = 1000  # of discrete ones, each a column


class TopicRows:
    """The chosen columns of one topic, without missing values, read once from front to back.

    Parameters
    ----------
    recording
        What is read.
    name
        Of the topic.
    selection
        Chosen columns of the recording.
    recipe
        Says what missing values do; text among numbers is missing.
    ledger
        Of the recording; takes what is held and dropped.
    """

    def __init__(
        self, recording: Recording, name: str, selection: Selection, recipe: Recipe, ledger: Ledger
    ) -> None:
        self._topic, self._source = recording.topics[name], recording.source
        self._count = self._topic.rows
        rewards = (selection.reward,) if selection.reward else ()
        columns = (*selection.sensors, *selection.actions, *rewards)
        self.indices = [i for i, column in enumerate(columns) if column.topic == name]
        self._columns = [columns[i].column for i in self.indices]
        self._unique = list(dict.fromkeys(self._columns))
        # What a last action led to was not recorded: it may be missing.
        self._may_end = np.array([i >= len(selection.sensors) for i in self.indices], bool)
        self._policy, self._most = recipe.missing, recipe.missing_rows
        self._say = ledger.add
        self._position = 0
        self._last = np.full(len(self._columns), np.nan)
        self._runs = np.zeros(len(self._columns), np.int64)
        self._step = max(64, CELLS // max(1, len(self._columns)))
        self._words: dict[str, Column] = {}  # texts among the numbers that were read last
        self._shares: dict[str, str] = {}

    def usable(self) -> NDArray[np.int64]:
        """Return the numbers of the rows that missing values leave.

        Raises
        ------
        TrajectoryError
            When more rows in a run are dropped than the recipe allows.
        """
        if self._policy == "refuse":
            return np.arange(self._count)
        firsts = np.full(len(self._columns), -1)
        complete = np.zeros(self._count, bool)
        for start in range(0, self._count, self._step):
            present = np.isfinite(self._cells(start, min(start + self._step, self._count)))
            now = (firsts < 0) & present.any(axis=0)
            firsts[now] = start + present.argmax(axis=0)[now]
            present[-1:] |= self._may_end & (start + len(present) == self._count)
            complete[start : start + len(present)] = present.all(axis=1)
            if self._policy != "drop" and firsts.min(initial=0) >= 0:
                break
        lacking = [name for name, row in zip(self._columns, firsts, strict=True) if row < 0]
        if self._policy == "keep" and lacking:  # for the scan to say
            return np.arange(self._count)
        kept = np.flatnonzero(complete)
        if lacking or (self._policy == "drop" and not len(kept)):
            problem = f"column {lacking[0]!r} has no value" if lacking else "no row has all values"
            advice = "expected some: leave the column or the file out"
            raise TrajectoryError(f"{self._source}: {problem}, {advice}")
        if self._policy != "drop":
            first = self._position = int(firsts.max(initial=0))
            late = self._columns[int(firsts.argmax())] if first else ""
            self._say("row", "dropped", "before the first value", name=late, count=first, row=0)
            self._hold_before(first)
            return np.arange(first, self._count - (self._policy == "keep" and self._ending()))
        dropped = np.diff(kept) - 1
        if dropped.max(initial=0) > self._most:
            row = int(kept[int(dropped.argmax())]) + 1
            raise self._too_long(row, "", int(dropped.max()))
        count, row = self._count - len(kept), int(complete.argmin())
        self._say("row", "dropped", "missing values", count=count, row=row)
        return kept

    def _hold_before(self, first: int) -> None:
        """Take the last values of rows that are dropped, for columns without one in the next."""
        for start in range(0, first, self._step):
            cells = self._cells(start, min(start + self._step, first))
            rows = np.where(np.isfinite(cells), np.arange(len(cells))[:, None], -1).max(axis=0)
            self._last = np.where(rows < 0, self._last, cells[rows, np.arange(len(rows))])
            self._runs = np.where(rows < 0, self._runs + len(cells), len(cells) - 1 - rows)

    def _ending(self) -> int:
        """Return how many last rows lack values of some columns, as where a logger was ended."""
        most = max(1, min(self._most, self._count // 10))
        lacks = np.isnan(self._cells(self._count - most, self._count))[::-1]
        ends = np.where(lacks.all(axis=0), 0, lacks.argmin(axis=0))
        ends[self._may_end & (ends == 1)] = 0
        count = int(ends.max(initial=0))
        names = ", ".join(n for n, end in zip(self._columns, ends, strict=True) if end)
        reason, row = "last ones without a value", self._count - count
        self._say("row", "dropped", reason, name=names, count=count, row=row)
        return count

    def rows(self, numbers: NDArray[np.int64]) -> Matrix:
        """Return rows by their numbers, which never fall, from one call to the next either.

        Raises
        ------
        TrajectoryError
            For text, and for missing values that the recipe refuses; the message names the row.
        """
        out = np.empty((len(numbers), len(self._columns)))
        done = int(np.searchsorted(numbers, self._position))
        out[:done] = self._last
        end = int(numbers[-1]) + 1
        if self._policy != "hold" and done < len(numbers):
            self._position = int(numbers[done])  # rows between stay unread
        while self._position < end:
            start, stop = self._position, min(self._position + self._step, end)
            cells = self._cells(start, stop)
            if stop == self._count:
                # Actions and rewards that the last row lacks are those of the row before.
                before = cells[-2] if len(cells) > 1 else self._last
                ends = self._may_end & ~np.isfinite(cells[-1])
                cells[-1, ends] = np.nan_to_num(before[ends])
            if self._policy != "drop":
                self._fill(cells, start)
            upto = int(np.searchsorted(numbers, stop))
            out[done:upto] = cells[numbers[done:upto] - start]
            done, self._position = upto, stop
            self._last = cells[-1].copy()
        return out

    def _fill(self, cells: Matrix, start: int) -> None:
        """Replace missing values by the last ones, or refuse them."""
        missing = ~np.isfinite(cells)
        if not missing.any():
            self._runs[:] = 0
            return
        for j in np.flatnonzero(missing.any(axis=0)).tolist():
            bad, numbers, name = missing[:, j], np.arange(len(cells)), self._columns[j]
            words = self._words.get(name, np.zeros(len(cells), "U1"))
            is_text, is_inf = words != "", np.isinf(cells[:, j])
            reasons = {"text among numbers": is_text, "infinite": is_inf}
            reasons["missing"] = bad & ~is_text & ~is_inf
            for reason, which in reasons.items():
                row, count = int(which.argmax()), int(which.sum())
                cell = str(words[row]) or str(cells[row, j]) * bool(is_inf[row])
                if self._policy == "refuse" and count:
                    value = f"{cell!r:.60}" if is_text[row] else cell or reason
                    raise TrajectoryError(
                        f"{self._source}, row {start + row}, column {name!r} is {value}, expected "
                        f"a finite number{self._shares.get(name, '')}: missing = 'hold' or 'drop' "
                        "in a recipe says what to do"
                    )
                at: dict[str, Any] = {"name": name, "row": start + row, "cell": cell}
                self._say("cell", "held", reason, count=count, **at)
            if self._policy == "keep":
                continue
            held = np.maximum.accumulate(np.where(bad, -1, numbers))
            runs = np.where(held < 0, numbers + 1 + self._runs[j], numbers - held)
            if runs.max() > self._most:
                row, longest = start + int(runs.argmax()), int(runs.max())
                raise self._too_long(row - longest + 1, name, longest)
            cells[:, j] = np.where(held < 0, self._last[j], cells[np.maximum(held, 0), j])
            self._runs[j] = runs[-1]
        self._runs[~missing[-1]] = 0

    def _too_long(self, row: int, column: str, rows: int) -> TrajectoryError:
        problem = f"column {column!r} is missing" if column else "values are missing"
        return TrajectoryError(
            f"{self._source}, row {row}: {problem} for at least {rows} rows, expected at most "
            f"{self._most}: a larger missing_rows allows it, else leave the column or file out"
        )

    def _cells(self, start: int, stop: int) -> Matrix:
        cells = self._topic.read(self._unique, start, stop)
        self._words = {}
        for name, values in cells.items():
            if values.dtype.kind == "U":
                cells[name], is_text = mixed(values)
                self._words[name] = np.where(is_text, values, "")
                if is_text.any() and name not in self._shares:
                    self._shares[name] = self._share(name, start + int(is_text.argmax()))
        return np.stack([cells[name] for name in self._columns], axis=1).astype(np.float64)

    def _share(self, name: str, row: int) -> str:
        """Return in how many rows a column has text; `TrajectoryError` where these are most."""
        texts: Counter[str] = Counter()
        present = 0
        for _start, cells in read_column(self._topic, name):
            is_text = mixed(cells)[1]
            texts.update(cells[is_text].tolist())
            present += int((np.strings.str_len(cells) > 0).sum())
        if 2 * texts.total() >= present:
            raise TrajectoryError(
                f"{self._source}, row {row}, column {name!r} is {next(iter(texts))!r:.60}, "
                "expected a number: it holds texts such as "
                f"{', '.join(map(repr, [*texts][:4]))}; leave it out, or name it under labels"
            )
        return f", as in all but {texts.total()} of its rows"


class Converter:
    """Makes rows of observations, actions and rewards of the cells of the chosen columns.

    Parameters
    ----------
    selection
        Columns of the first recording.
    recipe
        What becomes of its columns, and its discrete actions.
    start
        Number of the first discrete action.

    Attributes
    ----------
    sensors, actions
        Names and units of the result.
    """

    def __init__(self, selection: Selection, recipe: Recipe, start: int = 0) -> None:
        self._inputs = len(selection.sensors), len(selection.actions)
        columns = [column.quantity for column in selection.sensors]
        scores = [quantity for quantity in columns if quantity.role == "score"]  # the last ones
        quantities = _with_roles(columns[: len(columns) - len(scores)], recipe)
        by_first: dict[int, Conversion] = {}
        converted: dict[int, str] = {}
        for key, value in recipe.columns.items():
            kind = kinds_by_key()[key]
            for conversion in kind.convert(value, quantities) if kind.convert else ():
                by_first[min(conversion.inputs)] = conversion
                for i in conversion.inputs:
                    if i in converted:
                        name = quantities[i].name
                        raise UsageError(
                            f"{name!r} is named below {converted[i]} and {key}, expected one"
                        )
                    converted[i] = key
        quantities += scores
        order = [i for i in range(len(quantities)) if i in by_first or i not in converted]
        self._parts = [
            by_first.get(i, Conversion((i,), (quantities[i],), lambda: np.asarray)) for i in order
        ]
        self._made: list[Callable[[Matrix], Matrix]] = []
        outputs = [quantity for part in self._parts for quantity in part.outputs]
        self.sensors = tuple(_in_blocks(outputs, recipe))
        for sensor in self.sensors:
            if sensor.role == "angle" and sensor.unit in FULL_TURN:
                expected = "rad; list it under angles, too, to replace it by sine and cosine"
                problem = f"the angle {sensor.name!r} is in {sensor.unit}, expected {expected}"
                raise UsageError(f"roles: {problem}")
        self._start = start
        self.actions = _actions(selection.actions, recipe)
        self.discrete = bool(recipe.discrete)
        self._choices: set[float] | None = set() if len(self.actions) == 1 else None

    @property
    def width(self) -> int:
        """Columns of a converted row: sensors, actions, the reward."""
        return len(self.sensors) + len(self.actions) + 1

    def convert(self, cells: Matrix, source: str, first: int) -> Matrix:
        """Return converted rows.

        Parameters
        ----------
        cells
            Cells of sensors, actions and maybe rewards.
        source, first
            What messages call the recording, and the row of the first cells.
        """
        sensors, actions = self._inputs
        if not first:
            self._made = [part.make() for part in self._parts]
        pairs = zip(self._parts, self._made, strict=True)
        blocks = [make(cells[:, part.inputs]) for part, make in pairs]
        commands, rewards = np.split(cells[:, sensors:], [actions], axis=1)
        if self._choices is not None:
            self._choices |= {*np.unique(commands).tolist()[: _MOST_CHOICES + 1]}
            self._choices = self._choices if len(self._choices) <= _MOST_CHOICES else None
        blocks.append(self._one_hot(commands, source, first) if self.discrete else commands)
        return np.hstack([*blocks, rewards if rewards.size else np.zeros((len(cells), 1))])

    @property
    def choices(self) -> int:
        """Number of the choices that actions seem to be: few whole numbers; 0 if not."""
        numbers = self._choices or {-1.0}
        is_whole = all(0 <= n < _MOST_CHOICES and n.is_integer() for n in numbers)
        return int(max(numbers)) + 1 if is_whole and not self.discrete else 0

    def _one_hot(self, commands: Matrix, source: str, first: int) -> Matrix:
        count, codes = len(self.actions), commands[:, 0] - self._start
        for i in np.flatnonzero(~np.isin(codes, np.arange(count)))[:1].tolist():
            expected = f"a whole number from {self._start} to {self._start + count - 1}"
            problem = f"action {first + i} is {commands[i, 0]:g}, expected {expected}"
            raise TrajectoryError(f"{source}: {problem}")
        return np.eye(count)[codes.astype(np.intp)]


def _with_roles(sensors: Sequence[Quantity], recipe: Recipe) -> list[Quantity]:
    """Return sensors with the roles that a recipe names, one each."""
    roles = _members("role", recipe.roles, sensors)
    return [replace(q, role=cast("Role", roles.get(i, q.role))) for i, q in enumerate(sensors)]


def _in_blocks(sensors: Sequence[Quantity], recipe: Recipe) -> list[Quantity]:
    """Return sensors with the names of their blocks, and numbers behind these."""
    blocks = _members("block", recipe.blocks, sensors)
    numbers: dict[str, Iterator[int]] = defaultdict(itertools.count)
    renamed = {i: f"{blocks[i]}[{next(numbers[blocks[i]])}]" for i in sorted(blocks)}
    named = [replace(q, name=renamed.get(i, q.name)) for i, q in enumerate(sensors)]
    names = [quantity.name for quantity in named]
    for name in (name for name in renamed.values() if names.count(name) > 1):
        raise UsageError(f"blocks: another column is called {name!r}: give the block another name")
    return named


def _members(
    kind: str, globs: Mapping[str, Sequence[str]], sensors: Sequence[Quantity]
) -> dict[int, str]:
    """Return the role, or block, of the sensors that have one, by their positions."""
    named: dict[int, str] = {}
    for name, patterns in globs.items():
        for i in matching(patterns, sensors, f"sensor whose {kind} is {name}"):
            if i in named:
                both = f"{named[i]} and {name}"
                raise UsageError(f"{kind}s: {sensors[i].name!r} is {both}, expected one {kind}")
            named[i] = name
    return named


def _actions(columns: Sequence[ChosenColumn], recipe: Recipe) -> tuple[Quantity, ...]:
    """Return names and units of actions: of discrete ones, those of the columns of one-hot rows."""
    if not recipe.discrete or not columns:
        return tuple(column.quantity for column in columns)
    if len(columns) > 1:
        raise UsageError(f"there are {len(columns)} columns of actions, expected one: discrete")
    if isinstance(recipe.discrete, tuple):
        return tuple(Quantity(name, "1") for name in recipe.discrete)
    if recipe.discrete > _MOST_ACTIONS:
        raise UsageError(
            f"there are {recipe.discrete} discrete actions, expected at most {_MOST_ACTIONS}, each "
            "a column: import them as amounts, without discrete"
        )
    return tuple(Quantity(f"action {i}", "1") for i in range(recipe.discrete))


class Spool:
    """Rows on disk until they are written into a split: a part's rows never all lie in memory.

    Parameters
    ----------
    converter
        Makes the rows.
    """

    def __init__(self, converter: Converter) -> None:
        self.converter, self._width, self.rows = converter, converter.width, 0
        # Open as long as the spool is.
        self._file = tempfile.TemporaryFile(prefix="oodd-eval-")  # noqa: SIM115

    def add(self, stretch: Stretch, topics: dict[str, TopicRows], source: str) -> None:
        """Read the rows of a stretch from all topics, and add them.

        Parameters
        ----------
        stretch
            Numbers of the rows.
        topics
            The topics with chosen columns.
        source
            What messages call the recording.

        Raises
        ------
        OutputError
            When the disk is full.
        """
        step = max(64, CELLS // self._width)
        width = sum(len(rows.indices) for rows in topics.values())
        for start in range(0, stretch.rows, step):
            stop = min(start + step, stretch.rows)
            cells = np.empty((stop - start, width))
            for name, rows in topics.items():
                cells[:, rows.indices] = rows.rows(stretch.sources[name][start:stop])
            block = self.converter.convert(cells, source, start)
            try:
                self._file.seek(self.rows * self._width * 8)
                self._file.write(np.ascontiguousarray(block, "<f8").data)
                self._file.flush()
            except OSError as error:
                raise OutputError(
                    f"rows cannot be kept in {tempfile.gettempdir()!r} while they are read: "
                    f"{error}; the variable TMPDIR names another folder"
                ) from error
            self.rows += len(block)

    def read(self, start: int, stop: int) -> Matrix:
        """Return the rows of a range."""
        self._file.seek(start * self._width * 8)
        content = self._file.read((stop - start) * self._width * 8)
        return np.frombuffer(content, "<f8").reshape(-1, self._width)

    def close(self) -> None:
        """Remove the rows."""
        with contextlib.suppress(OSError):  # rows that a full disk did not take
            self._file.close()
