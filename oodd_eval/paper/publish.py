"""Write a reproduction: tables, figures, claims and the page that joins them, from records alone.

::

    README.md             the claims, every figure, the paper's tables
    claims.csv            every claim with its verdicts
    tables/<id>.md, .csv  every number of an experiment; CSV in full precision
    figures/<id>.png, .svg

The same records give the same bytes. Files are replaced in one step each.
"""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Sequence
from pathlib import Path

from oodd_eval.errors import OutputError
from oodd_eval.paper import captions, paper, returns, verdicts
from oodd_eval.paper.evidence import Evidence
from oodd_eval.paper.experiments import EXPERIMENTS, TABLE_2, Experiment, setups_of
from oodd_eval.paper.figures import figures, returns_figure
from oodd_eval.paper.header import Header
from oodd_eval.paper.numbers import Numbers, compute, csv_lines, layout, without_intervals
from oodd_eval.paper.plots import Figure, draw, drawing_key
from oodd_eval.paper.schedule import own_records
from oodd_eval.results.record import Record
from oodd_eval.results.tables.markdown import table as padded_table
from oodd_eval.results.tables.tables import Table


def publish(
    directory: Path,
    header: Header,
    records: Sequence[Record],
    found: returns.Returns | None,
    *,
    pictures: bool = True,
) -> None:
    """Write every table and figure of what there is; what is missing says so.

    Parameters
    ----------
    directory
        Where to; made when it is absent.
    header
        What is reproduced.
    records
        Any; those of other data, setups or seeds are left out.
    found
        Returns for Table 2; None where they were not read.
    pictures
        Whether to draw figures; those that are there already are linked in any case.

    Raises
    ------
    OutputError
        When a file cannot be written.
    MissingExtraError
        When figures are wanted and matplotlib is not installed.
    """
    own = own_records(records, header.split_digest, header.tier, setups_of(EXPERIMENTS))
    evidence = Evidence(own)
    page = [*captions.opening(header, own)]
    made = verdicts.rulings(evidence, found)
    put(directory / "claims.csv", _csv(verdicts.csv_lines(made)))
    page += ["## Claims", "", verdicts.summary(made), "", verdicts.RULE, ""]
    page += [_untitled(verdicts.table(made)), ""]
    page += _returns(directory, header, found, pictures=pictures)
    for experiment in EXPERIMENTS:
        page += _experiment(directory, header, experiment, evidence, pictures=pictures)
    page += captions.failures(own)
    put(directory / "README.md", "\n".join(page) + "\n")


def _experiment(
    directory: Path,
    header: Header,
    experiment: Experiment,
    evidence: Evidence,
    *,
    pictures: bool,
) -> list[str]:
    """Write an experiment's files and return its section of the page."""
    head = [f"## {captions.heading(experiment)}", ""]
    if not evidence.has(experiment.setups):
        return [*head, "Not run.", ""]
    numbers = compute(experiment, evidence)
    caption = captions.caption(header, experiment, numbers)
    put(directory / "tables" / f"{experiment.id}.csv", _csv(csv_lines(numbers)))
    whole = [f"# {captions.heading(experiment)}", "", caption, ""]
    for title, metrics in (("As in the paper", experiment.metrics), ("Beyond", experiment.beyond)):
        if metrics:
            whole += [f"## {title}", "", *map(markdown_table, layout(experiment, numbers, metrics))]
    put(directory / "tables" / f"{experiment.id}.md", "\n".join(whole))
    links = []
    for name, figure in figures(experiment, numbers).items():
        links += _picture(directory, name, figure, pictures=pictures)
    more = f"tables/{experiment.id}"
    return [
        *head,
        caption,
        "",
        *links,
        *map(markdown_table, _short(experiment, numbers)),
        f"All numbers, with intervals: [as tables]({more}.md), [as CSV]({more}.csv).",
        "",
    ]


def _short(experiment: Experiment, numbers: Numbers) -> list[Table]:
    """Return the tables for the page: wide ones without their intervals."""
    wide = experiment.across == "scopes" and experiment.rows != "mean"
    return layout(experiment, without_intervals(numbers) if wide else numbers, experiment.metrics)


def _returns(
    directory: Path, header: Header, found: returns.Returns | None, *, pictures: bool
) -> list[str]:
    head = [f"## {captions.TABLE_2_HEADING}", ""]
    if not found:
        return [*head, "Not run.", ""]
    put(directory / "tables" / f"{TABLE_2}.csv", _csv(returns.numbers(found)))
    caption = captions.of_returns(header)
    table = markdown_table(returns.table(found))
    whole = [f"# {captions.TABLE_2_HEADING}", "", caption, "", table]
    put(directory / "tables" / f"{TABLE_2}.md", "\n".join(whole))
    theirs = [[float(paper.returns(e)[k]) for k in returns.KINDS]
              for e in returns.environments(found)]  # fmt: skip
    links = _picture(directory, TABLE_2, returns_figure(found, theirs), pictures=pictures)
    return [*head, caption, "", *links, table, f"[{TABLE_2}.csv](tables/{TABLE_2}.csv)", ""]


def _picture(directory: Path, name: str, figure: Figure, *, pictures: bool) -> list[str]:
    """Draw a figure, or leave the one that is there; return its place in the page."""
    place = directory / "figures"
    if pictures and not _is_drawn(place, name, figure):
        for suffix, content in draw(figure).items():
            put(place / f"{name}.{suffix}", content)
    if not (place / f"{name}.png").exists():
        return []
    return [f"![{figure.title}](figures/{name}.png)", "", f"[as SVG](figures/{name}.svg)", ""]


def _is_drawn(place: Path, name: str, figure: Figure) -> bool:
    """Whether the files there show these numbers already: drawing takes seconds a figure."""
    svg, png = place / f"{name}.svg", place / f"{name}.png"
    return (
        svg.is_file()
        and png.is_file()
        and drawing_key(figure) in svg.read_text(encoding="utf-8", errors="replace")[:4000]
    )


def markdown_table(table: Table) -> str:
    """Return a table as Markdown without the padding, which would make up most of the page."""
    flat = re.sub(r" {2,}", " ", padded_table(table))
    return re.sub(r"-{3,}", "---", flat)


def _untitled(table: Table) -> str:
    return markdown_table(table).split("\n", 2)[2]


def _csv(lines: Sequence[Sequence[str]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue()


def put(path: Path, content: str | bytes) -> None:
    """Write a file in one step; one that has this content already is left alone.

    Raises
    ------
    OutputError
        When it cannot be written.
    """
    data = content.encode() if isinstance(content, str) else content
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        if path.exists() and path.read_bytes() == data:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(data)
        temporary.replace(path)
    except OSError as error:
        raise OutputError(f"{str(path)!r} cannot be written: {error.strerror}") from error
    finally:
        temporary.unlink(missing_ok=True)
