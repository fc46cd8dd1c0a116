"""What people see of a study: tables on a terminal, as Markdown and as pages with plots."""

import json
import math
from collections.abc import Collection, Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Final, TypeAlias

import numpy as np
from oodd_recording.svg import BOTTOM, LEFT, WIDTH, Axes, label, svg

from oodd_eval.data.facts import ENVIRONMENTS, in_order, title_of
from oodd_eval.data.files import write_text
from oodd_eval.metrics.catalogue import INTERVENTIONS
from oodd_eval.names import counted
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
_FEWEST: Final = 5  # seeds that can show something: a coin falls alike five times in 6 %
_FILES: Final = files("oodd_interventions")


def sections(records: Records) -> list[Section]:
    """Return the tables of each act of a study, then those of what was named.

    Parameters
    ----------
    records
        As `oodd_interventions.columns.records_of` returns them, or those of one environment.
    """
    acts = dict.fromkeys(record["act"] for record in records)
    parts = [_of_act(act, [r for r in records if r["act"] == act]) for act in acts]
    act = next(iter(acts))
    rows = [r for r in _overall(records) if r["act"] == act and _value(r, "named_precision") > -1]
    title = f"Parts named at alarms for {act} to act on (onset error in rows, the rest in %)"
    named = [_table(title, rows, NAMINGS)] * bool(rows)
    notes = ["The return is the sum of an episode's rewards; [95 % intervals] are over seeds."]
    notes += [f"{info.title}: {info.summary}." for info in INTERVENTIONS.values()]
    return [*parts, Section("Namings, and what the columns are", tables=named, notes=notes)]


def _of_act(act: str, records: Records) -> Section:
    """Return the tables of one act, and the sentence that says what it is worth."""
    rows = sorted(_overall(records), key=lambda r: -_value(r, _SAVED, -math.inf))
    cells = [r for r in records if r["anomaly"] != ALL]
    several = len({r["environment"] for r in cells}) > 1
    saved: dict[str, dict[str, str]] = {}
    for r in (r for r in records if r["environment"] != ALL and several == (r["anomaly"] == ALL)):
        if not math.isnan(_value(r, _SAVED)):  # else what it cannot mend has a table of its own
            name = r["environment" if several else "anomaly"]
            saved.setdefault(name, {})[row_of(r)] = f"{_text(r, _SAVED)} ({_text(r, _PLACEBO)})"
    names = in_order(saved, ENVIRONMENTS)
    lines = []
    for r in rows:
        overall = [_ends(r["intervention"][_SAVED]), _text(r, _PLACEBO), _text(r, _HARM)]
        lines.append([row_of(r), *overall, *(saved[name].get(row_of(r), "") for name in names)])
    tests = {row_of(r): r["behind"] for r in rows if "behind" in r}
    behind = [f"{row} is {_ends(t)} behind {t['row']}, p {t['p']:.2g}" for row, t in tests.items()]
    note = f"Paired by seeds: {'; '.join(behind)}." * bool(behind)
    title = f"Return saved by {act}, in brackets the placebo (%)"
    header = ["detector", "mean", "placebo", "harm on nominal", *names]
    tables = [Table(title, header, lines, note=note)]
    title = f"What {act} prevents and costs (delay in rows, the rest in %)"
    tables.append(_table(title, rows, [*INTERVENTIONS][2:]))
    tables += _useless(act, [r for r in cells if math.isnan(_value(r, _SAVED))])
    seeds = cells[0]["intervention"]["acted"]["n"]
    return Section(f"Acting by {act}", tables=tables, verdict=_verdict(act, rows[0], seeds))


def _verdict(act: str, best: InterventionRecord, seeds: int) -> str:
    """Return what the alarm of the best row is worth, for those who see these tables first."""
    saved = best["intervention"][_SAVED]
    if saved["value"] is None:
        return (
            f"{act} cannot mend these faults: at once and on the true parts it saves less than 5 % "
            "of the nominal return."
        )
    doubt = "" if saved["low"] > max(0.0, _value(best, _PLACEBO)) else "not shown to be "
    if seeds < _FEWEST:
        doubt = f"not shown by {counted(seeds, 'seed(s)')} to be "
    return (
        f"The alarm of {row_of(best)} is {doubt}worth having: {act} at the alarm saves "
        f"{_ends(saved)} % of the return that {act} at once, on the true parts, would save; "
        f"at another episode's alarm it saves {_text(best, _PLACEBO)} %. Of the nominal return "
        f"false alarms cost {_text(best, _HARM)} %, and acting where nothing needs it "
        f"{_text(best, 'availability_cost')} %."
    )


def _useless(act: str, cells: Records) -> list[Table]:
    """Return the table of faults that an act cannot mend, if there are any."""
    rows, text = list(dict.fromkeys(map(row_of, cells))), COLUMNS[_HARM].text
    lines: dict[tuple[str, ...], dict[str, str]] = {}
    for r in cells:
        arms = [r["returns"][arm] for arm in ("twin", "never", "watchdog")]
        twin, never, watchdog = np.array(arms, float)  # NaN where there is none
        nominal = abs(twin) or math.nan
        fault = r["environment"], r["anomaly"], text(float(twin - never) / nominal)
        lines.setdefault(fault, {})[row_of(r)] = text(float(never - watchdog) / nominal)
    title = f"Faults that {act} cannot mend: their cost, and that of acting (% of nominal return)"
    texts = [[*labels, *(line.get(row, "") for row in rows)] for labels, line in lines.items()]
    header = ["environment", "anomaly", "fault", *rows]
    return [Table(title, header, texts, labels=2)] * bool(cells)


def _table(title: str, rows: Records, names: Collection[str]) -> Table:
    """Return a table with a row a detector, and a column a name."""
    lines = [[row_of(r), *(_text(r, name) for name in names)] for r in rows]
    return Table(title, ["detector", *(COLUMNS[n].short for n in names)], lines)


def _overall(records: Records) -> Records:
    """Return the records of all environments, or else of the one that there is."""
    whole = [r for r in records if r["anomaly"] == ALL]
    return [r for r in whole if r["environment"] == ALL] or whole


def _value(record: InterventionRecord, name: str, undefined: float = math.nan) -> float:
    value = record["intervention"][name]["value"]
    return undefined if value is None else float(value)


def _text(record: InterventionRecord, name: str) -> str:
    return COLUMNS[name].text(_value(record, name))


def _ends(figure: Mapping[str, float | None]) -> str:
    """Return a share of the return saved with its interval."""
    numbers = (math.nan if (x := figure[end]) is None else x for end in ("value", "low", "high"))
    return "{} [{}, {}]".format(*map(COLUMNS[_SAVED].text, numbers))


def write_pages(directory: Path, cells: Sequence[RawCell]) -> None:
    """Write ``records.jsonl``, ``report.md`` and a page an environment of the cells of a study."""
    records = records_of(cells)
    lines = (json.dumps(record, sort_keys=True) + "\n" for record in records)
    write_text(directory / "records.jsonl", "".join(lines))
    write_text(directory / REPORT, "\n".join(map(markdown_section, sections(records))))
    template = Template((_FILES / "page.html").read_text("utf-8"))
    for name in dict.fromkeys(cell["environment"] for cell in cells):
        tables = html_sections(sections([r for r in records if r["environment"] == name]))
        drawn = [plot(cell) for cell in cells if cell["environment"] == name]
        plots = (f'<div role="img" aria-label="{escape(words)}">{x}</div>' for x, words in drawn)
        parts = {"title": escape(title_of(name)), "tables": tables, "plots": "\n".join(plots)}
        write_text(directory / f"{name}.html", template.substitute(parts))


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
    marks = [axes.mark(0, 'class="effect"')]
    marks += [axes.mark(late[len(late) // 2], 'class="alarm"')] if late else []
    texts = [label(LEFT, 16, title, "start", "bold"), label(LEFT, 34, alarms, "start")]
    shapes = [f"<style>{(_FILES / 'plot.css').read_text('utf-8')}</style>", *axes.ends()]
    steps = [*range(0, size, -(-size // _POINTS)), size - 1]
    for i, (arm, line) in enumerate(gains.items()):
        shapes.append(axes.line(((first + step, line[step]) for step in steps), f'class="{arm}"'))
        x, y = LEFT + 130 * (i % 3), BOTTOM + 38 + 18 * (i // 3)
        shapes.append(f'<path class="{arm}" d="M{x} {y - 4}h18"/>')
        texts.append(label(x + 24, y, arm, "start"))
    ends = ", ".join(f"{arm} {line[-1]:.3g}" for arm, line in gains.items())
    words = f"{title}: {alarms}; gained until the end: {ends}"
    return svg(WIDTH, BOTTOM + 66, [*shapes, *marks, *texts]), words
