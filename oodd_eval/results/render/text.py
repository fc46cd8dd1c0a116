"""Reports as text with markup, for people: Markdown, HTML and LaTeX."""

from collections.abc import Callable, Sequence
from html import escape as escape_html
from typing import Final

from rich.console import Console
from rich.text import Text
from tabulate import tabulate

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
    parts = [f"{escape(fact)}\n" for fact in section.facts]
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
    parts = []
    for section in report.sections:
        parts += [f"<h3>{escape_html(section.title)}</h3>"]
        parts += [f"<p>{escape_html(line)}</p>" for line in (*section.facts, *section.findings)]
        for table in section.tables:
            # tabulate's layout escapes the cells.
            parts += [f"<h4>{escape_html(table.title)}</h4>", grid(table, "html")]
            parts += [f"<p>{escape_html(table.note)}</p>"] if table.note else []
        parts += [f"<p>{escape_html(line)}</p>" for line in section.notes]
    return "\n".join(parts) + "\n"


@renders("latex", "LaTeX, a tabular for each table")
def latex(report: Report) -> str:
    """Return a report as LaTeX, to be copied or included; it needs no package."""
    parts = []
    for section in report.sections:
        parts.append(f"\\section*{{{_latex(section.title)}}}")
        parts += [_latex(line) for line in (*section.facts, *section.findings)]
        for table in section.tables:
            parts.append(f"\\subsection*{{{_latex(table.title)}}}")
            parts += [grid(table, "latex_raw", _latex), *([_latex(table.note)] * bool(table.note))]
        parts += [_latex(line) for line in section.notes]
    return "\n\n".join(parts) + "\n"


def _latex(text: str) -> str:
    return " ".join(text.split()).translate(_LATEX)


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
