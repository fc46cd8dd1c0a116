"""What became of logs on their way from files to a result: nothing leaves without a word.

A `Ledger` goes from the reader through inspection, import and scan to the result. Whoever leaves
something out, holds it or changes it adds a line; what is kept as it is needs none.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal, Self

from oodd_eval.names import counted

Item = Literal["file", "recording", "episode", "column", "row", "cell", "mark"]
Fate = Literal["kept", "held", "dropped", "changed"]

_NAMED: Final = 3  # sources that a line names
_EXAMPLES: Final = 6  # sources that an entry of JSON lists
_LINES: Final = 12  # that a summary prints, and names in one of them
_CELL: Final = 60  # characters of a cell that are quoted


@dataclass(slots=True)
class LedgerEntry:
    """One thing that became of some items, for the same reason.

    Parameters
    ----------
    item
        What it happened to.
    fate
        ``"held"``: the last value stands in its place. ``"changed"``: it was read otherwise than
        it is written. ``"kept"``: nothing was done about what may be wrong.
    reason
        Why, in words that end a sentence: ``"text among numbers"``.
    name
        Of the column, label or file that it is about; empty for the logs as a whole.
    count
        Number of items.
    sources
        Number of items by recording, or file, as messages name it.
    row, cell
        Row of the first of them in the first source, from 0 on, and its text; None and empty where
        it has none.
    """

    item: Item
    fate: Fate
    reason: str
    name: str = ""
    count: int = 0
    sources: Counter[str] = field(default_factory=Counter)
    row: int | None = None
    cell: str = ""

    @property
    def first(self) -> str:
        """The first place in words, such as ``r03.csv row 60 "#N/A"``."""
        row = "" if self.row is None else f"row {self.row}"
        cell = f'"{self.cell}"' if self.cell else ""
        return " ".join(filter(None, [next(iter(self.sources), ""), row, cell]))

    def where(self, total: int = 0) -> str:
        """Return in how many sources it is, and in which, the first with its place.

        `total` is the number of all sources, 0 where that is not known.
        """
        is_counted = self.item != "file"  # their number is said before
        if is_counted and len(self.sources) == total > 1:
            return f" in all {total}"
        many = f" in {len(self.sources)}{f' of {total}' if total else ''}: "
        names = ", ".join(filter(None, [self.first, *[*self.sources][1:_NAMED]]))
        names += f" and {len(self.sources) - _NAMED} more" * (len(self.sources) > _NAMED)
        return f"{many if is_counted and len(self.sources) > 1 else ': '}{names}" if names else ""

    def line(self, total: int = 0) -> str:
        """Return the entry as a line of text.

        Parameters
        ----------
        total
            Number of sources in all; 0 where that is not known.
        """
        what = f" of {self.name}" if self.name and self.item in {"cell", "row", "mark"} else ""
        items = counted(self.count, f"{self.item}(s)")
        if self.item in {"column", "file", "recording"} and self.name:
            items, what = f"{self.item} {self.name}", ""
        return f"{self.fate}: {items}{what}, {self.reason}{self.where(total)}"

    def as_json(self) -> dict[str, Any]:
        """Return the entry as values for JSON."""
        keys = ("item", "fate", "name", "reason", "count")
        return {key: getattr(self, key) for key in keys} | {
            "sources": len(self.sources),
            "first": {"source": next(iter(self.sources), ""), "row": self.row, "cell": self.cell},
            "examples": [*self.sources][:_EXAMPLES],
        }


class Ledger:
    r"""Entries about logs, each with its first place and the number of items it is about.

    Examples
    --------
    >>> ledger = Ledger()
    >>> ledger.add("cell", "held", "text among numbers", name="a", source="r03.csv", row=60,
    ...            cell="#N/A")
    >>> print(*ledger.lines(30), sep="\n")
    held: 1 cell of a, text among numbers: r03.csv row 60 "#N/A"
    """

    def __init__(self) -> None:
        self._entries: dict[tuple[str, ...], LedgerEntry] = {}

    def add(
        self,
        item: Item,
        fate: Fate,
        reason: str,
        *,
        name: str = "",
        count: int = 1,
        source: str = "",
        row: int | None = None,
        cell: str = "",
    ) -> None:
        """Add items that share a fate; none for a count of 0.

        Parameters
        ----------
        item, fate, reason, name, count
            See `LedgerEntry`; items that agree in all but the count make one entry.
        source, row, cell
            Where the first of them is.
        """
        if count < 1:
            return
        plain = " ".join(cell.split())[:_CELL]
        entry = self._entries.setdefault(
            (item, fate, name, reason), LedgerEntry(item, fate, reason, name, row=row, cell=plain)
        )
        entry.count += count
        entry.sources[source] += count

    def merge(self, other: Self, source: str | None = None) -> None:
        """Add the entries of another ledger.

        Parameters
        ----------
        other
            The ledger.
        source
            Recording that all of them are about, in place of their sources.
        """
        for e in other:
            about: Mapping[str, Any] = {"name": e.name, "row": e.row, "cell": e.cell}
            for name, count in e.sources.items():
                where = name if source is None else source
                self.add(e.item, e.fate, e.reason, count=count, source=where, **about)

    def __iter__(self) -> Any:
        return iter(self._entries.values())

    def __bool__(self) -> bool:
        return bool(self._entries)

    def of(self, item: Item, fate: Fate | None = None) -> list[LedgerEntry]:
        """Return the entries about items of a sort, with any fate by default."""
        return [e for e in self if e.item == item and fate in {None, e.fate}]

    def lines(self, total: int = 0) -> list[str]:
        """Return the entries as lines of text, in the order in which they came.

        Parameters
        ----------
        total
            Number of recordings in all; 0 where that is not known.
        """
        return [entry.line(total) for entry in self]

    def complete(self, other: Self) -> None:
        """Add what another ledger has of things, or of their sources, and this one has not."""

        def thing(entry: LedgerEntry) -> tuple[str, ...]:
            return (entry.item, entry.name, "" if entry.item == "column" else entry.reason)

        things = {thing(entry): entry for entry in self}
        gone = {source for entry in self.of("file", "dropped") for source in entry.sources}
        for key, entry in other._entries.items():
            if entry.item in {"file", "recording"} and entry.fate == "dropped":
                entry.sources -= Counter(dict.fromkeys(gone, entry.count))
                entry.count = entry.sources.total()
            if not entry.count:
                continue
            mine = things.get(thing(entry))
            if mine is None:
                self._entries[key] = entry
            elif entry.item != "column":
                for source in entry.sources.keys() - mine.sources.keys():
                    mine.count += entry.sources[source]
                    mine.sources[source] = entry.sources[source]

    def summary(self, sensors: Sequence[str], total: int = 0) -> list[str]:
        """Return the sensors with the columns that were left out, and the other entries, in lines.

        What concerns few recordings comes first; of very many entries some are left out.

        Parameters
        ----------
        sensors
            Names of the sensors.
        total
            Number of recordings in all; 0 where that is not known.
        """
        left_out = sorted(self.of("column", "dropped"), key=lambda entry: len(entry.sources))
        columns = [f"{e.name} ({e.reason}{e.where(total)})" for e in left_out]
        line = f"sensors: {_some(sensors)}"
        line += f"; left out: {_some(columns)}" if columns else ""
        others = [entry for entry in self if entry not in left_out]
        lines = [e.line(total) for e in sorted(others, key=lambda entry: len(entry.sources))]
        more = len(lines) - _LINES
        lines = [line, *lines[:_LINES], *([f"{more} more, which --json has"] if more > 0 else [])]
        return ["".join(c if c.isprintable() else " " for c in line) for line in lines]

    def as_json(self) -> list[dict[str, Any]]:
        """Return the entries as values for JSON."""
        return [entry.as_json() for entry in self]


def _some(texts: Sequence[str]) -> str:
    more = len(texts) - _LINES
    return ", ".join(texts[:_LINES]) + (f" and {more} more" if more > 0 else "")
