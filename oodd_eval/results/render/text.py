"""Reports as text with markup, for people: Markdown, HTML and LaTeX."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from html import escape as escape_html
from typing import Final

from oodd_eval.prose import Section, Table, grid
from oodd_eval.results.render import renders
from oodd_eval.results.report import Report

MANY: Final = 6
"""Findings beyond which Markdown folds them away."""

_LATEX: Final = str.maketrans(
    {c: f"\\{c}" for c in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    | {"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", "[": "{[}", "]": "{]}"}
    | {"Δ": r"$\Delta$", "µ": r"$\mu$", "≤": r"$\leq$", "†": r"$\dagger$", "\N{EN DASH}": "--"}
)

_PAGE: Final = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
:root {{ color-scheme: light dark; font: 1rem/1.5 system-ui, sans-serif; }}
body {{ margin: 1rem auto; max-width: 70rem; padding: 0 1rem; overflow-wrap: anywhere; }}
table {{ border-collapse: collapse; display: block; overflow: auto; white-space: nowrap; }}
th, td {{ border-bottom: 1px solid #8888; padding: 0.2rem 0.6rem; }}
</style>
</head>
<body>
<h1>{title}</h1>
{sections}</body>
</html>
"""


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


def markdown_table(table: Table, bold: Collection[tuple[int, int]] = ()) -> str:
    """Return a table as Markdown under its title, its note below it; `bold` are row and column."""
    note = f"\n{escape(table.note)}\n" if table.note else ""
    rows = [
        [f"**{escape(text)}**" if (i, j) in bold else escape(text) for j, text in enumerate(row)]
        for i, row in enumerate(table.rows)
    ]
    escaped = replace(table, header=[*map(escape, table.header)], rows=rows)
    return f"### {escape(table.title)}\n\n{grid(escaped, 'pipe')}\n{note}"


def escape(text: str) -> str:
    """Keep text from being read as table or HTML: names and reasons are other people's."""
    flat = " ".join(text.split())
    for character in "\\|<>*_`[":
        flat = flat.replace(character, f"\\{character}")
    return flat


@renders("html", "HTML")
def html(report: Report) -> str:
    """Return a report as a page of HTML; wide tables scroll, the page does not."""
    title = escape_html(report.title)
    return _PAGE.format(title=title, sections=html_sections(report.sections, level=2))


def html_sections(sections: Sequence[Section], level: int = 3) -> str:
    """Return sections as HTML, without a page around it; their titles have headings of a level."""
    marks = {
        "title": f"<h{level}>{{}}</h{level}>",
        "sentence": "<p>{}</p>",
        "table": f"<h{level + 1}>{{}}</h{level + 1}>",
    }
    # tabulate's layout escapes the cells.
    parts = (
        grid(part, "html") if isinstance(part, Table) else marks[kind].format(escape_html(part))
        for kind, part in _parts(sections)
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
        for kind, part in _parts(report.sections)
    )
    return "\n\n".join(parts) + "\n"


def _parts(sections: Sequence[Section]) -> Iterator[tuple[str, str | Table]]:
    """Yield titles, sentences, and tables after their titles, in the order of a report."""
    for section in sections:
        yield "title", section.title
        sentences = filter(None, (section.verdict, *section.facts, *section.findings))
        yield from (("sentence", line) for line in sentences)
        for table in section.tables:
            yield from (("table", table.title), ("", table))
            yield from [("sentence", table.note)] * bool(table.note)
        yield from (("sentence", line) for line in section.notes)


def _latex(text: str) -> str:
    return " ".join(text.split()).translate(_LATEX)
