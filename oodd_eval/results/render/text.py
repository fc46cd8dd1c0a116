"""Reports as text with markup, for people: Markdown, HTML and LaTeX."""

import io
import re
import textwrap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from html import escape as escape_html
from typing import Any, Final

from rich.console import Console
from rich.text import Text
from tabulate import tabulate

from oodd_eval.prose import print_prose
from oodd_eval.results.render import renders
from oodd_eval.results.report import Report, Section
from oodd_eval.results.tables import Table

MANY: Final = 6
"""Findings beyond which Markdown folds them away."""

_LATEX: Final = str.maketrans(
    {c: f"\\{c}" for c in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | {"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", "[": "{[}", "]": "{]}"}
    | {"Δ": r"$\Delta$", "µ": r"$\mu$", "≤": r"$\leq$", "†": r"$\dagger$", "\N{EN DASH}": "--"}
)


def grid(table: Table, layout: str, escape: Callable[[str], str] = str) -> str:
    """Return header and rows of a table in one of tabulate's layouts."""
    return str(
        tabulate(
            [[escape(cell) for cell in row] for row in table.rows],
            [escape(name) for name in table.header],
            layout,
            colalign=table.alignment if table.rows else None,
            disable_numparse=True,
        )
    )


@renders("markdown", "Markdown, everything in it")
def markdown(report: Report) -> str:
    """Return a report as Markdown."""
    sections = [markdown_section(section) for section in report.sections] or ["No records.\n"]
    return "\n".join([f"# {report.title}", "", *sections])


def markdown_section(section: Section) -> str:
    """Return a section as Markdown under its title."""
    parts = [f"**{escape(section.verdict)}**\n"] if section.verdict else []
    parts += [f"{escape(fact)}\n" for fact in section.facts]
    return "\n".join([f"## {escape(section.title)}\n", *parts, markdown_body(section)])


def markdown_body(section: Section) -> str:
    """Return findings, tables and notes of a section as Markdown."""
    findings = [escape(sentence) for sentence in section.findings]
    if len(findings) > MANY:
        summary = f"{len(findings)} times a simple row has a higher mean than a learned one"
        parts = [f"<details><summary><b>{summary}</b></summary>\n"]
        parts += [*(f"- {sentence}" for sentence in findings), "\n</details>\n"]
    else:
        parts = [f"**{sentence}**\n" for sentence in findings]
    parts += map(markdown_table, section.tables)
    if section.folded:
        parts += [f"<details><summary>{escape(section.fold)}</summary>", ""]
        parts += [*map(markdown_table, section.folded), "</details>", ""]
    return "\n".join([*parts, *markdown_list(section.notes)]) + "\n"


def markdown_list(lines: Sequence[str]) -> list[str]:
    """Return sentences as items of a list."""
    return [f"- {escape(line)}" for line in lines]


def markdown_table(table: Table) -> str:
    """Return a table as Markdown under its title, its note below it."""
    note = f"\n{escape(table.note)}\n" if table.note else ""
    return f"### {escape(table.title)}\n\n{grid(table, 'pipe', escape)}\n{note}"


def escape(text: str) -> str:
    """Keep text from being read as table or HTML: names and reasons are other people's."""
    flat = " ".join(text.split())
    for character in "\\|<>*_`[":
        flat = flat.replace(character, f"\\{character}")
    return flat


@renders("html", "HTML")
def html(report: Report) -> str:
    """Return a report as HTML, without a page around it."""
    marks = {"title": "<h3>{}</h3>", "sentence": "<p>{}</p>", "table": "<h4>{}</h4>"}
    # tabulate's layout escapes the cells.
    parts = (
        grid(part, "html") if isinstance(part, Table) else marks[kind].format(escape_html(part))
        for kind, part in _parts(report)
    )
    return "\n".join(parts) + "\n"


@renders("latex", "LaTeX, a tabular for each table")
def latex(report: Report) -> str:
    """Return a report as LaTeX, to be copied or included; it needs no package."""
    marks = {"title": r"\section*{{{}}}", "sentence": "{}", "table": r"\subsection*{{{}}}"}
    parts = (
        grid(part, "latex_raw", _latex)
        if isinstance(part, Table)
        else marks[kind].format(_latex(part))
        for kind, part in _parts(report)
    )
    return "\n\n".join(parts) + "\n"


def _parts(report: Report) -> Iterator[tuple[str, str | Table]]:
    """Yield titles, sentences, and tables after their titles, in the order of a report."""
    for section in report.sections:
        yield "title", section.title
        sentences = filter(None, (section.verdict, *section.facts, *section.findings))
        yield from (("sentence", line) for line in sentences)
        for table in section.tables:
            yield from (("table", table.title), ("", table))
            yield from [("sentence", table.note)] * bool(table.note)
        yield from (("sentence", line) for line in section.notes)


def _latex(text: str) -> str:
    return " ".join(text.split()).translate(_LATEX)


def print_sections(sections: Sequence[Section], console: Console) -> None:
    """Print the verdict, tables, findings and notes of sections: what is read last stands last."""
    for section in sections:
        if section.verdict:
            print_prose(section.verdict + "\n", console, "bold")
        for table in section.tables:
            print_table(table, console)
        for sentence in section.findings:
            print_prose(sentence, console, "yellow")
        for line in section.notes:
            print_prose(line, console, "dim")
        if section.notes:
            console.print("")


def terminal_text(sections: Sequence[Section]) -> str:
    """Return what `print_sections` prints, as wide as the terminal, without colours."""
    text = io.StringIO()
    plain: dict[str, Any] = {"highlight": False, "markup": False, "soft_wrap": True}
    print_sections(sections, Console(file=text, color_system=None, force_jupyter=False, **plain))
    return text.getvalue()


def print_table(table: Table, console: Console, width: int = 0) -> None:
    """Print one table within a width, by default the console's: as it is, turned, or in parts."""
    if table.wrap:
        print_prose(table.title, console, "bold")
    else:
        console.print(Text(table.title, "bold"))
    for part in _fitting(table, width or console.width):
        lines = grid(part, "simple").splitlines()
        colours = ["", "", *(part.colours or [""] * (len(lines) - 2))]
        for line, colour in zip(lines, colours, strict=True):
            console.print(Text(line, colour))
        console.print("")
    if table.note:
        print_prose(table.note + "\n", console, "dim")


def _fitting(table: Table, width: int) -> list[Table]:
    """Return the table, the table turned, or parts of its columns, whichever first fits."""
    whole = [table, table.transposed()]
    if table.wrap:
        whole += [_wrapped(one, width) for one in whole]
        table = whole[-2]
    for one in whole:
        if _width(one) <= width:
            return [one]
    labels = list(range(table.labels))
    parts = [labels]
    for column in range(table.labels, len(table.header)):
        wider = [*parts[-1], column]
        if parts[-1] == labels or _width(table.columns(wider)) <= width:
            parts[-1] = wider
        else:
            parts.append([*labels, column])
    return [table.columns(part) for part in parts]


def _wrapped(table: Table, width: int) -> Table:
    """Return a table whose headings and labels take several lines where they are long."""
    most = max(_NARROW, width // 3)

    def lines(text: str, room: int) -> str:
        wrapper = textwrap.TextWrapper(room)
        wrapper.wordsep_re = _PARTS
        return "\n".join(wrapper.wrap(text))

    columns = [[row[i] for row in table.rows] for i in range(len(table.header))]
    longest = [max(map(len, column), default=0) for column in columns]
    header = [
        lines(text, most if i < table.labels else max(longest[i], _NARROW))
        for i, text in enumerate(table.header)
    ]
    rows = [
        [lines(text, most) if i < table.labels else text for i, text in enumerate(row)]
        for row in table.rows
    ]
    return replace(table, header=header, rows=rows)


_NARROW: Final = 9
"""Width of a column that headings are wrapped to where its figures are narrower."""

_PARTS: Final = re.compile(r"(\s+|[^-\[,:.=\s]*[-\[,:.=]+)")
"""Ends of lines are between words, and in names behind what separates their parts."""


def _width(table: Table) -> int:
    return max(map(len, grid(table, "simple").splitlines()), default=0)
