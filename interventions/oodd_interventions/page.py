"""What people see of a study: tables on a terminal, as Markdown and as pages with plots."""

import json
import math
from collections.abc import Collection, Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np
from oodd_recording.svg import BOTTOM, LEFT, WIDTH, Axes, label, svg

from oodd_eval.data.facts import ENVIRONMENTS, in_order, title_of
from oodd_eval.data.files import write_text
from oodd_eval.metrics.catalogue import INTERVENTIONS
from oodd_eval.prose import Section, Table
from oodd_eval.results.render.text import html_sections, markdown_section
from oodd_interventions.columns import (
    ALL,
    ARMS,
    COLUMNS,
    NAMINGS,
    InterventionRecord,
    RawCell,
    records_of,
    row_of,
)

Records: TypeAlias = Sequence[InterventionRecord]

REPORT: Final = "report.md"

_SAVED, _PLACEBO, _HARM = "return_saved", "placebo_saved", "harm_on_nominal"
_POINTS: Final = 200  # of a line in a plot, about
_ARMS: Final = (
    "Lines are the reward gained on the healthy twins, summed up from left to right, mean over "
    "episodes. Never: nothing acts; watchdog: acts at the alarm; oracle: acts at once on the true "
    "parts; placebo: acts at another episode's alarm; on the twins false: acts at false alarms; "
    "forced: acts as in the faulty partner. The full upright line is the effect of the fault, the "
    "dotted one the median alarm."
)
_STYLES: Final = files("oodd_interventions")


def sections(records: Records) -> list[Section]:
    """Return the tables of each act of a study, then those of what was named.

    Parameters
    ----------
    records
        As `oodd_interventions.columns.records_of` returns them, or those of one environment.
    """
    acts = dict.fromkeys(record["act"] for record in records)
    parts = [_of_act(act, [r for r in records if r["act"] == act]) for act in acts]
    rows = {row_of(r): r for r in _overall(records) if not math.isnan(_value(r, "named_precision"))}
    title = "Parts named at the alarm (onset error in rows, the rest in %)"
    named = [_table(title, [*rows.values()], NAMINGS)] * bool(rows)
    notes = ["The return is the sum of an episode's rewards; [95 % intervals] are over seeds."]
    notes += [f"{info.title}: {info.summary}." for info in INTERVENTIONS.values()]
    return [*parts, Section("Namings, and what the columns are", tables=named, notes=notes)]


def _of_act(act: str, records: Records) -> Section:
    """Return the tables of one act, and the sentence that says what it is worth."""
    rows = sorted(_overall(records), key=lambda r: -np.nan_to_num(_value(r, _SAVED), nan=-math.inf))
    cells = [r for r in records if r["anomaly"] != ALL]
    several = len({r["environment"] for r in cells}) > 1
    parts = [r for r in records if r["environment"] != ALL and (r["anomaly"] == ALL) == several]
    saved = {(row_of(r), r["environment" if several else "anomaly"]): _saved(r) for r in parts}
    names = in_order((name for _, name in saved), ENVIRONMENTS)
    header = ["detector", "mean", "harm on nominal", "behind the best", *names]
    lines = []
    for r in rows:
        row, mean = row_of(r), f"{_ends(r['intervention'][_SAVED])} ({_text(r, _PLACEBO)})"
        behind = f"{_ends(test)}, p {test['p']:.2g}" if (test := r.get("behind")) else ""
        of_names = (saved.get((row, name), "") for name in names)
        lines.append([row, mean, _text(r, _HARM), behind, *of_names])
    table = Table(f"Return saved by {act}, in brackets the placebo (%)", header, lines, wrap=True)
    if not any(line[3] for line in lines):  # one row, or one of several environments
        table = table.columns([i for i in range(len(header)) if i != 3])
    title = f"What {act} prevents and costs (delay in rows, the rest in %)"
    tables = [
        table,
        _table(title, rows, [*INTERVENTIONS][2:]),
        *_useless(act, [r for r in cells if math.isnan(_value(r, _SAVED))]),
    ]
    return Section(f"Acting by {act}", tables=tables, verdict=_verdict(act, rows[0]))


def _verdict(act: str, best: InterventionRecord) -> str:
    """Return what the alarm of the best row is worth, for those who see these tables first."""
    saved = best["intervention"][_SAVED]
    if saved["value"] is None:
        return f"{act} cannot mend these faults: it saves less than 5 % of the nominal return."
    doubt = "" if saved["low"] > max(0.0, _value(best, _PLACEBO)) else "not shown to be "
    return (
        f"The alarm of {row_of(best)} is {doubt}worth having: {act} at the alarm saves "
        f"{_ends(saved)} % of the return that {act} at once, on the true parts, would save; "
        f"at another episode's alarm it saves {_text(best, _PLACEBO)} %, and false alarms cost "
        f"{_text(best, _HARM)} % of a healthy episode's return."
    )


def _useless(act: str, cells: Records) -> list[Table]:
    """Return the table of faults that an act cannot mend, if there are any."""
    lines: dict[tuple[str, str], dict[str, str]] = {}
    for r in cells:
        never, nominal = r["returns"]["never"], r["returns"]["twin"]
        line = lines.setdefault((r["environment"], r["anomaly"]), {})
        for name, lost in (
            ("fault", nominal - never),
            (row_of(r), never - r["returns"]["watchdog"]),
        ):
            line[name] = COLUMNS[_HARM].text(lost / abs(nominal))
    header = list(dict.fromkeys(name for line in lines.values() for name in line))
    texts = [[*labels, *(line.get(name, "") for name in header)] for labels, line in lines.items()]
    title = f"Faults that {act} cannot mend: their cost, and that of acting (% of nominal return)"
    return [Table(title, ["environment", "anomaly", *header], texts, 2, wrap=True)] * bool(cells)


def _table(title: str, rows: Records, names: Collection[str]) -> Table:
    """Return a table with a row a detector, and a column a name."""
    lines = [[row_of(r), *(_text(r, name) for name in names)] for r in rows]
    return Table(title, ["detector", *(COLUMNS[n].short for n in names)], lines, wrap=True)


def _overall(records: Records) -> Records:
    """Return the records of all environments, or else of the one that there is."""
    whole = [r for r in records if r["anomaly"] == ALL]
    return [r for r in whole if r["environment"] == ALL] or whole


def _value(record: InterventionRecord, name: str) -> float:
    value = record["intervention"][name]["value"]
    return math.nan if value is None else float(value)


def _text(record: InterventionRecord, name: str) -> str:
    return COLUMNS[name].text(_value(record, name))


def _saved(record: InterventionRecord) -> str:
    return f"{_text(record, _SAVED)} ({_text(record, _PLACEBO)})"


def _ends(figure: Mapping[str, float | None]) -> str:
    """Return a share of the return saved with its interval."""
    numbers = (math.nan if (x := figure[end]) is None else x for end in ("value", "low", "high"))
    value, low, high = map(COLUMNS[_SAVED].text, numbers)
    return f"{value} [{low}, {high}]"


def write_pages(directory: Path, cells: Sequence[RawCell]) -> None:
    """Write ``records.jsonl``, ``report.md`` and a page an environment of the cells of a study."""
    records = records_of(cells)
    lines = (json.dumps(record, sort_keys=True) + "\n" for record in records)
    write_text(directory / "records.jsonl", "".join(lines))
    write_text(directory / REPORT, "\n".join(map(markdown_section, sections(records))))
    for name in dict.fromkeys(cell["environment"] for cell in cells):
        title, parts = escape(title_of(name)), [r for r in records if r["environment"] == name]
        body = html_sections(sections(parts)) + f"<h3>Over time</h3><p>{_ARMS}</p>"
        body += "".join(_figure(cell) for cell in cells if cell["environment"] == name)
        head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        head += f"<title>{title}</title><style>{(_STYLES / 'page.css').read_text('utf-8')}</style>"
        page = f"<head>{head}</head><body><h2>What an alarm saves: {title}</h2>{body}</body>"
        write_text(directory / f"{name}.html", f'<!doctype html>\n<html lang="en">{page}</html>\n')


def plot(cell: RawCell) -> tuple[str, str]:
    """Return an SVG picture of what the arms of a cell gain over time, and its content in words."""
    first, curves = cell["curves"]["first"], cell["curves"]["arms"]
    size = max(map(len, curves.values()))
    rewards = {arm: np.nan_to_num(np.array(curves[arm], float)) for arm in ARMS}
    sums = {arm: np.cumsum(np.pad(x, (0, size - len(x)))) for arm, x in rewards.items()}
    gains = {arm: sums[arm] - sums["twin"] for arm in ARMS[1:]}
    low, high = min(map(np.min, gains.values())), max(map(np.max, gains.values()))
    axes = Axes(first, first + size - 1, float(low), float(high))
    alarmed = [e for e in cell["episodes"] if e["alarm"] is not None]
    late = sorted(e["alarm"] - e["effect"] for e in alarmed if e["alarm"] >= e["effect"])
    title = f"{row_of(cell)}, {cell['anomaly']}, {cell['act']}"
    alarms = f"{len(late)} of {len(cell['episodes'])} episodes alarm"
    shapes = [
        label(LEFT, 16, title, "start", "bold"),
        label(LEFT, 34, alarms, "start"),
        *axes.ends(),
    ]
    shapes.append(axes.mark(0, 'class="effect"'))
    if late:
        shapes.append(axes.mark(late[len(late) // 2], 'class="alarm"'))
    steps = [*range(0, size, -(-size // _POINTS)), size - 1]
    for i, (arm, line) in enumerate(gains.items()):
        shapes.append(axes.line(((first + step, line[step]) for step in steps), f'class="{arm}"'))
        x, y = LEFT + 130 * (i % 3), BOTTOM + 38 + 18 * (i // 3)
        shapes += [f'<path class="{arm}" d="M{x} {y - 4}h18"/>', label(x + 24, y, arm, "start")]
    style = f"<style>{(_STYLES / 'plot.css').read_text('utf-8')}</style>"
    ends = ", ".join(f"{arm} {line[-1]:.3g}" for arm, line in gains.items())
    return svg(
        WIDTH, BOTTOM + 66, [style, *shapes]
    ), f"{title}: {alarms}; gained until the end: {ends}"


def _figure(cell: RawCell) -> str:
    drawing, text = plot(cell)
    return f'<div class="plot" role="img" aria-label="{escape(text)}">{drawing}</div>'
