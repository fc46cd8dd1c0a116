"""Facts of one recording by its recipe: values that hold for all of it, stamps, anomalous rows."""

import contextlib
import dataclasses
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.parts import CALIBRATION, TRAIN, TWINS
from oodd_eval.errors import TrajectoryError, UnknownNameError, UsageError
from oodd_logs.kinds.times import orders_of, parse_times, past_midnight, unit_in
from oodd_logs.ledger import Fate, Ledger
from oodd_logs.marks import (
    IntervalList,
    LabelCounts,
    Mark,
    anomalous_cells,
    are_signed,
    counted_labels,
    runs_of,
)
from oodd_logs.readers.cells import mixed
from oodd_logs.readers.packed import stem
from oodd_logs.recipe import Recipe, anomaly_name
from oodd_logs.recording import Recording, read_column
from oodd_logs.rows import TopicRows
from oodd_logs.selecting import Selection, find_columns, layout_of, named_columns
from oodd_logs.stamps import Steps, Stretch, Times, check_stamps, cut_at_gaps, on_grid, set_forward

FILES: Final = "files"
"""Role of the nominal files whose episodes are shared out."""

SLOWER: Final = 1.5
"""Times the usual step, from which on a clock is another one."""

NOMINAL_ROLES: Final = frozenset({FILES, TRAIN, CALIBRATION, TWINS})


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """A recording, and what a recipe says that its file holds.

    Parameters
    ----------
    recording
        The recording.
    path
        Its file.
    relative
        The same below the folder of the recipe.
    roles
        What its file is listed as: ``"files"`` to be shared out, parts such as ``"train"``, and
        ``"test/NAME"`` of anomalies.
    kind
        Anomaly that its fields tell; empty where they tell none.
    """

    recording: Recording
    path: Path
    relative: str
    roles: frozenset[str]
    kind: str = ""

    @property
    def source(self) -> str:
        """Its name in messages."""
        return self.recording.source

    @property
    def label(self) -> str:
        """Its name in the ledger: its source, with the file as it is named below the folder."""
        return self.source.replace(str(self.path), self.relative, 1)

    @property
    def kinds(self) -> list[str]:
        """Names of the anomalies among its roles."""
        return sorted(role.removeprefix("test/") for role in self.roles - NOMINAL_ROLES)

    def meeting(self, recipe: Recipe) -> "Recorded":
        """Return it with those of its roles whose conditions its values meet."""
        # Other values of kinds name anomalies.
        nominal = {k: values for k, values in recipe.nominal.where.items() if k != recipe.kinds}
        conditions = {f"test/{name}": table.where for name, table in recipe.anomalous.items()}
        conditions |= dict.fromkeys(NOMINAL_ROLES, nominal)
        kept = frozenset(
            role
            for role in self.roles
            if all(self.text(k) in map(text_of, values) for k, values in conditions[role].items())
        )
        return dataclasses.replace(self, roles=kept)

    def text(self, name: str, *, last: bool = False) -> str:
        """Return the value of a field, or of a column: the only one, or that of the last row.

        Raises
        ------
        UnknownNameError
            When there is neither.
        TrajectoryError
            When the column has several values.
        """
        fields = {"file": self.path.stem, **self.recording.fields}
        if name in fields:
            return text_of(fields[name])
        layout = layout_of(self.recording)
        columns = find_columns(layout, name)
        if not columns:
            available = [*fields, *named_columns(layout)]
            raise UnknownNameError(f"field or column of {self.source}", name, available)
        topic, column = self.recording.topics[columns[0].topic], columns[0].column
        if last:
            cells = topic.read([column], topic.rows - 1, topic.rows)[column]
            return text_of(cells[-1].item())
        blocks = (np.unique(cells).tolist()[:5] for _start, cells in read_column(topic, column))
        distinct = {text_of(value) for values in blocks for value in values}
        if len(distinct) != 1:
            values = ", ".join(sorted(distinct)[:3]) or "no value"
            raise TrajectoryError(
                f"{self.source}: {name} is {values}, expected one value in a recording"
            )
        return distinct.pop()


def text_of(value: Any) -> str:
    """Return a value as text, the same for equal numbers and truth values of any type."""
    if isinstance(value, bool | np.bool_):
        return "1" if value else "0"
    if isinstance(value, int | float | np.number) and float(value).is_integer():
        return str(int(value))
    text = str(value).strip()
    return {"true": "1", "false": "0"}.get(text.lower(), text)


class StampedRows:
    """The chosen columns of a recording, the stretches of its rows, and which are anomalous.

    Parameters
    ----------
    recorded
        The recording.
    selection
        Its chosen columns.
    recipe
        Says at which rate and where to cut, and what is anomalous.
    ledger
        Takes rows that are dropped, and marks of none.

    Attributes
    ----------
    topics
        Rows of the topics with chosen columns.
    labels
        Cells of label columns, once `marks` has read them.

    Raises
    ------
    TrajectoryError
        When a cell is no stamp, or is missing and the recipe refuses that.
    """

    def __init__(
        self, recorded: Recorded, selection: Selection, recipe: Recipe, ledger: Ledger
    ) -> None:
        self._recorded, self._selection = recorded, selection
        self._recipe, self._ledger = recipe, ledger
        self.labels: LabelCounts = {}
        self.topics = {
            name: TopicRows(recorded.recording, name, selection, recipe, ledger)
            for name in selection.topics
        }
        is_timed = bool(recipe.time) or recipe.rate is not None
        self._logged = {name: self._read(name) for name in (selection.times if is_timed else ())}
        self._stamps = self._logged
        if recipe.gap and len(self.topics) == 1:
            self._stamps = {n: set_forward(times, recipe.gap) for n, times in self._logged.items()}

    def _read(self, topic: str) -> Times:
        """Return the stamps of a topic in seconds, NaN where a row has none."""
        source, rows = self._recorded.source, self._recorded.recording.topics[topic]
        is_strict = self._recipe.missing == "refuse"
        stamps = np.zeros(rows.rows)
        for column in self._selection.times[topic] if rows.rows else ():
            # All at once: one cell may tell day from month in the others.
            cells = np.concatenate([cells for _start, cells in read_column(rows, column.column)])
            unit = column.quantity.unit
            if unit == "1" and len(self._selection.times[topic]) > 1:
                unit = unit_in(column.column)
            orders = orders_of(cells) if cells.dtype.kind == "U" and not self._recipe.dates else ()
            order = orders[0] if len(orders) == 1 else self._recipe.dates
            arguments = unit, order, f"{source}, column {column.column!r}"
            try:
                times = _seconds(cells, *arguments)
            except TrajectoryError:
                times = np.empty(0) if is_strict else _tolerant(cells, *arguments)
                if is_strict or 2 * np.isnan(times).sum() >= len(times):
                    raise
            lacking = np.flatnonzero(~np.isfinite(times))
            cell = str(cells[lacking[0]]) if len(lacking) and cells.dtype.kind == "U" else ""
            self._say("dropped", "without a stamp", lacking, cell=cell, name=column.column)
            is_clock = cells.dtype.kind == "U" and len(self._selection.times[topic]) == 1
            stamps += past_midnight(times) if is_clock else times
        missing = ~np.isfinite(stamps)
        if missing.any() and is_strict:
            raise TrajectoryError(
                f"{source}, row {int(missing.argmax())} has no stamp: missing = 'drop' in the "
                "recipe leaves such rows out"
            )
        return stamps

    def _say(self, fate: Fate, reason: str, rows: NDArray[Any], **more: Any) -> None:
        """Add rows by their numbers to the ledger, with their first."""
        if len(rows):
            more |= {"count": len(rows), "row": int(rows[0]), "source": self._recorded.label}
            self._ledger.add(more.pop("item", "row"), fate, reason, **more)

    @contextlib.contextmanager
    def _scan_goes_on(self, kind: str = "") -> Iterator[None]:
        """Leave out marks that a recording does not have where it is scanned."""
        try:
            yield
        except (TrajectoryError, UsageError) as error:
            if self._recipe.missing != "keep":
                raise
            reason = str(error).removeprefix(f"{self._recorded.source}: ")
            self._ledger.add("mark", "dropped", reason, name=kind, source=self._recorded.label)

    def stretches(self) -> tuple[list[Stretch], list[Times]]:
        """Return the rows that become episodes, on an even grid or as they are, and their stamps.

        Returns
        -------
        tuple
            Stretches without gaps, and the stamps of each topic; none without stamps.

        Raises
        ------
        UsageError
            When topics cannot be joined.
        TrajectoryError
            When stamps are wrong, or there is a gap.
        """
        source, recipe = self._recorded.source, self._recipe
        usable = {name: rows.usable() for name, rows in self.topics.items()}
        is_timed = all(name in self._stamps for name in usable)
        if len(usable) > 1 and (not is_timed or recipe.rate is None):
            raise UsageError(
                f"{source}: sensors are of the topics {', '.join(usable)}, whose rows are joined "
                "by their stamps: name time, unless the format has it, and rate"
            )
        if not is_timed:
            ((name, numbers),) = usable.items()
            return [Stretch(len(numbers), usable, numbers)], []
        timed = {}
        for name, numbers in usable.items():
            rows = numbers[np.isfinite(self._stamps[name][numbers])]
            times = self._stamps[name][rows]
            is_kept = np.ones(len(rows), bool)
            if recipe.missing == "keep":  # whatever is recorded is judged
                is_kept = times > np.append(-np.inf, np.maximum.accumulate(times)[:-1])
                self._say("dropped", "stamped before a row above it, or as it", rows[~is_kept])
            elif recipe.rate is not None:  # the later of two rows with one stamp holds
                is_kept = times != np.append(times[1:], np.inf)
                self._say("dropped", "stamped as the row below it", rows[~is_kept])
            rows, times = rows[is_kept], times[is_kept]
            if not len(rows):
                of_topic = f" of topic {name!r}" if name else ""
                raise TrajectoryError(f"{source} has no rows{of_topic}, expected some")
            check_stamps(times, rows, source, resampled=recipe.rate is not None)
            usable[name], timed[name] = rows, times
        stretches = []
        used = {name: np.zeros(len(times), bool) for name, times in timed.items()}
        for first, last in cut_at_gaps(timed, recipe.gap, recipe.rate, source):
            inside = {n: (times >= first) & (times <= last) for n, times in timed.items()}
            used = {name: used[name] | mask for name, mask in inside.items()}
            if recipe.rate is None:
                ((name, mask),) = inside.items()
                rows = usable[name][mask]
                stretches.append(Stretch(len(rows), {name: rows}, timed[name][mask]))
            else:
                stretch = on_grid(timed, first, last, recipe.rate, source)
                for name, numbers in stretch.sources.items():
                    rows, steps = usable[name], Steps.of(timed[name]).usual * recipe.rate
                    if steps < SLOWER:  # rates agree
                        repeated = rows[numbers[1:][np.diff(numbers) == 0]]
                        self._say("held", "longer than a row", repeated, name=name)
                    if steps > 1 / SLOWER:
                        passed = rows[np.setdiff1d(np.arange(numbers[0], numbers[-1]), numbers)]
                        self._say("dropped", "sooner than a row after others", passed, name=name)
                sources = {n: usable[n][numbers] for n, numbers in stretch.sources.items()}
                stretches.append(dataclasses.replace(stretch, sources=sources))
        cuts = [stretch.sources[name][:1] for stretch in stretches[1:]]
        self._say("changed", "cut at gaps or earlier stamps", np.concatenate([[], *cuts]))
        for name, mask in used.items():
            self._say("dropped", "where another topic has none", usable[name][~mask], name=name)
        return stretches, [*timed.values()]

    def marks(self, intervals: IntervalList, *, is_anomalous: bool) -> list[Mark]:
        """Return the anomalous rows, in seconds where there are stamps.

        Parameters
        ----------
        intervals
            Anomalous rows by file.
        is_anomalous
            Whether the recipe's onset holds for the recording.
        """
        recorded, recipe = self._recorded, self._recipe
        marks = []
        for text, column in self._selection.labels.items():
            owners = [name for name, table in recipe.anomalous.items() if text in table.labels]
            blocks, counts = [np.zeros(0, np.bool_)], self.labels.setdefault(text, Counter())
            for start, cells in read_column(recorded.recording.topics[column.topic], column.column):
                labels = self._labels(cells, start, column.column)
                before = bool(blocks[-1][-1:].any())
                blocks.append(anomalous_cells(labels, recipe, before=before))
                counts.update(counted_labels(labels))
            if recipe.missing == "keep" and are_signed(counts, recipe):
                continue  # a scan says so, and judges by no label
            marks += [
                Mark(begin, end, kind)
                for start, stop in runs_of(np.concatenate(blocks))
                for kind in ([""] if text in recipe.labels else owners)
                # Rows without stamps mark nothing.
                if (begin := self._position(start, column.topic, "begin"))
                < (end := self._position(stop, column.topic, "end"))
            ]
        path, name = recorded.path, recorded.recording.name
        is_cut = bool(recipe.episode) and name != stem(path)
        with self._scan_goes_on():
            listed = intervals.of_recording(path, name, recorded.relative, is_cut=is_cut)
            for _, first, stop, kind in listed:
                with self._scan_goes_on(kind):
                    marks.append(self._mark(first, stop, kind and anomaly_name(kind)))
        tables = {name: recipe.anomalous[name] for name in recorded.kinds}
        onsets = [(table.onset, table.stop, name) for name, table in tables.items()]
        onset = recorded.recording.fields.get("onset")
        onset = recipe.onset if onset is None and is_anomalous else onset
        for first, stop, kind in (*onsets, (onset, recipe.stop, "")):
            if first is not None:
                marks.append(self._mark(int(first), stop, kind))
        return marks

    def _labels(self, cells: NDArray[Any], start: int, name: str) -> NDArray[Any]:
        """Return labels, as numbers where they are; say which are missing, or other texts."""
        numbers, is_text = (
            mixed(cells) if cells.dtype.kind == "U" else (cells, np.zeros(len(cells), bool))
        )
        if not np.isfinite(numbers).any():
            return cells
        absent = ~np.isfinite(numbers) & ~is_text
        if 2 * absent.sum() < len(cells):
            self._say("held", "no label", start + np.flatnonzero(absent), name=name, item="cell")
        if 2 * is_text.sum() < len(cells):
            cell, rows = str(cells[is_text.argmax()]), start + np.flatnonzero(is_text)
            reason = "a label that is text among numbers"
            self._say("kept", reason, rows, cell=cell, name=name, item="cell")
        return cells if is_text.any() else numbers

    def _mark(self, start: Any, stop: Any, kind: str) -> Mark:
        """Return the mark of an interval; `TrajectoryError` where the recording has none of it."""
        topic, expected = self._selection.topics[0], ""
        begin = -np.inf if start is None else self._position(start, topic, "begin")
        end = np.inf if stop is None else self._position(stop, topic, "end")
        if not begin < end:
            expected = "an end behind its start"
        elif topic in self._stamps:
            times = self._stamps[topic]
            if end <= np.nanmin(times) or begin > np.nanmax(times):
                expected = f"a part of the recording, whose {self._first_and_last(topic)}"
        if expected:
            anomaly = f"{self._recorded.source}: an anomaly is from {start} to {stop}"
            raise TrajectoryError(f"{anomaly}, expected {expected}")
        return Mark(begin, end, kind)

    def _first_and_last(self, topic: str) -> str:
        """Return the first and the last stamp of a topic as they are recorded, in words."""
        columns = [column.column for column in self._selection.times[topic]]
        rows = self._recorded.recording.topics[topic]
        cells = rows.read(columns, 0, rows.rows)
        ends = np.flatnonzero(np.isfinite(self._stamps[topic]))[[0, -1]].tolist()
        first, last = (" ".join(str(cells[name][i]) for name in columns) for i in ends)
        return f"first stamp is {first} and its last {last}"

    def _position(self, moment: float | str, topic: str, side: str) -> float:
        """Return where a row or time is: in seconds, or rows without stamps."""
        source, count = self._recorded.source, self._recorded.recording.topics[topic].rows
        stamps, most = self._stamps.get(topic), count - (side == "begin")
        if isinstance(moment, int):
            if not 0 <= moment <= most:
                times = ""
                if stamps is not None and count:
                    times = f"; a time has a point, as in {moment}.0: the recording's "
                    times += self._first_and_last(topic)
                raise TrajectoryError(
                    f"{source}: an anomaly is said to {side} at row {moment}, expected 0 to "
                    f"{most}, as there are {count} rows{times}"
                )
            if stamps is None:
                return float(moment) if moment < count else np.inf
            later = stamps[moment:]
            return float(next(iter(later[np.isfinite(later)]), np.inf))
        if stamps is None:
            raise UsageError(
                f"{source}: {moment!r} is a time, but there are no stamps: name their column with "
                "time, or name rows, which are whole numbers"
            )
        columns, dates = self._selection.times[topic], self._recipe.dates
        unit = columns[0].quantity.unit if len(columns) == 1 else ""
        time = float(_seconds(np.array([moment]), unit, dates, f"{source}: an anomaly")[0])
        logged = self._logged[topic]
        # Where the clock was set back, a time is that of the first rows that have it.
        rows = np.append(np.flatnonzero(logged >= time), np.flatnonzero(np.isfinite(logged))[-1:])
        return float(time + (stamps - logged)[rows[:1]].sum())


def _tolerant(cells: NDArray[Any], unit: str, order: str, source: str) -> Times:
    """Return stamps, NaN for the cells that are none."""
    try:
        return _seconds(cells, unit, order, source)
    except TrajectoryError:
        if len(cells) == 1:
            return np.array([np.nan])
    middle = len(cells) // 2
    halves = (_tolerant(x, unit, order, source) for x in (cells[:middle], cells[middle:]))
    return np.append(*halves)


def _seconds(cells: NDArray[Any], unit: str, order: str, source: str) -> Times:
    if cells.dtype.kind == "U":
        stamps, is_text = mixed(cells)
        if np.isfinite(stamps).sum() > is_text.sum():  # numbers, and few texts
            if is_text.any():
                row = int(is_text.argmax())
                text = f"{str(cells[row])!r:.60}"
                raise TrajectoryError(f"{source}: row {row}: {text}, expected a number")
            cells = stamps
    try:
        return parse_times(cells, "" if cells.dtype.kind == "U" else unit, order)
    except (TrajectoryError, UsageError) as error:
        raise TrajectoryError(f"{source}: {error}") from None
