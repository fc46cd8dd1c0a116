"""Reports on a terminal or in a log, within its width."""

from collections.abc import Sequence

from rich.console import Console
from rich.text import Text

from oodd_eval.results.render.text import grid
from oodd_eval.results.report import Section
from oodd_eval.results.tables import Table


def print_sections(sections: Sequence[Section], console: Console) -> None:
    """Print tables, findings and notes of sections: what is read last stands last."""
    for section in sections:
        for table in section.tables:
            print_table(table, console)
        for sentence in section.findings:
            print_prose(sentence, console, "yellow")
        for line in section.notes:
            print_prose(line, console, "dim")
        if section.notes:
            console.print("")


def print_table(table: Table, console: Console, width: int = 0) -> None:
    """Print one table within a width, by default the console's: as it is, turned, or in parts."""
    console.print(Text(table.title, "bold"))
    for part in _fitting(table, width or console.width):
        lines = grid(part, "simple").splitlines()
        colours = ["", "", *(part.colours or [""] * (len(lines) - 2))]
        for line, colour in zip(lines, colours, strict=True):
            console.print(Text(line, colour))
        console.print("")
    if table.note:
        print_prose(table.note + "\n", console, "dim")


def print_prose(text: str, console: Console, style: str = "") -> None:
    """Print a sentence, wrapped between words."""
    console.print(Text(text, style), soft_wrap=False)


def _fitting(table: Table, width: int) -> list[Table]:
    """Return the table, the table turned, or parts of its columns, whichever first fits."""
    for whole in (table, table.transposed()):
        if _width(whole) <= width:
            return [whole]
    labels = list(range(table.labels))
    parts = [labels]
    for column in range(table.labels, len(table.header)):
        wider = [*parts[-1], column]
        if parts[-1] == labels or _width(table.columns(wider)) <= width:
            parts[-1] = wider
        else:
            parts.append([*labels, column])
    return [table.columns(part) for part in parts]


def _width(table: Table) -> int:
    return max(map(len, grid(table, "simple").splitlines()), default=0)
