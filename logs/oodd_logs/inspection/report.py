"""A report on logs before they are imported, in words and as a table."""

import re
import textwrap
from collections import Counter
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
from tabulate import tabulate

from oodd_eval.names import counted, listed
from oodd_logs.inspection.logs import READ_ROWS, Inspection
from oodd_logs.inspection.meaning import (
    ENOUGH,
    anomalous_rows,
    cuts_of,
    fields_of,
    gap_of,
    keys_of_fields,
    lacks_rows,
    lacks_values,
    nominal_recordings,
    nominal_values,
    rate_of,
    sort_files,
    step_of,
    window_of,
)
from oodd_logs.inspection.roles import ROLES, line_of, role_of, toml
from oodd_logs.kinds import kinds
from oodd_logs.kinds.number_lists import FIGURES
from oodd_logs.kinds.times import SCALES, UNIT_NAMES
from oodd_logs.marks import likely_nominal, plain_label
from oodd_logs.readers import quantity
from oodd_logs.recipe import MISSING_ROWS
from oodd_logs.stamps import GAP_STEPS

_SEEN: Final = "training has seen the test"
_LINES: Final = 12  # of the ledger
_MANY: Final = 60  # columns beyond which the table has only those that look like something


class Advice(NamedTuple):
    """Something to know of logs: a word for it, and what it is and what to write into a recipe."""

    topic: str
    text: str


def advise(logs: Inspection) -> list[Advice]:
    """Return what to know of logs, and what to write into a recipe.

    Parameters
    ----------
    logs
        What is in them.

    Returns
    -------
    list of Advice
        What is amiss with files first, then columns, then what is nominal.
    """
    parts = (_of_files, _of_times, _of_columns, _of_labels)
    return [advice for part in parts for advice in part(logs)]


def _of_files(logs: Inspection) -> Iterator[Advice]:
    for problem in logs.problems[:3]:
        yield Advice("unreadable", problem)
    if logs.others:
        endings = ", ".join(f"{n} {s or 'without an ending'}" for s, n in logs.others.items())
        files = counted(logs.others.total(), "file(s)")
        yield Advice("others", f"{files} of other formats: {endings}")
    if any(recording.length > READ_ROWS for recording in logs.recordings):
        cells = max(column.cells for column in logs.columns.values())
        rows = sum(recording.length for recording in logs.recordings)
        yield Advice("sample", f"{cells} of {rows} rows were looked at, in blocks over all of them")
    for same in logs.equal:
        yield Advice("equal", f"{listed(same)}: the same rows; name one, or {_SEEN}")
    if logs.shared:
        counts = listed([f"{n} of {file}" for file, n in logs.shared.items()])
        text = f"episodes that stand in another file, too: {counts}; name one of the files, or "
        yield Advice("shared", text + _SEEN)
    for first, second, n in logs.continued[:3]:
        text = f"the last {n} rows of {first} are the first of {second}: leave one out, or {_SEEN}"
        yield Advice("continued", text)
    if logs.transposed:
        text = f"rows and columns of {listed(logs.transposed)} are exchanged (and were read so): "
        yield Advice("transposed", f"{text}write transpose = {toml(logs.transposed)} below [read]")
    usable = {*logs.usable}
    headers = Counter(frozenset(r.columns) for r in logs.recordings if r.file in usable)
    if len(headers) > 1:
        in_all = frozenset.intersection(*headers)
        partial = [name for name in logs.columns if name not in in_all]
        sizes = ", ".join(f"{len(names)} columns in {n}" for names, n in headers.most_common(3))
        text = f"episodes differ in their columns ({sizes}): not in all, as sensors have to be: "
        yield Advice("headers", text + listed(partial))


def _of_times(logs: Inspection) -> Iterator[Advice]:
    times, rate = logs.times, rate_of(logs)
    if not times:
        yield Advice("time", "no column has times: rows count as equally spaced")
    if len(times) > 1:
        text = f"{len(times)} topics at rates of their own are joined: write rate = {rate}, and "
        yield Advice("topics", f"{text}sensors as topic.field")
    if len(times) != 1:
        return
    ((name, unit),) = times.items()
    clocks, step, cuts = logs.clocks(name), step_of(logs, name), "cuts recordings there"
    keys = ", ".join(time_lines(logs, name, unit) + ([f"rate = {rate}"] if step > 0 else []))
    text = f"{name} has {UNIT_NAMES[unit]}, a row every {number(step)} s: write {keys}"
    yield Advice("time", text)
    rates = [(r, clock.steps.usual * SCALES[unit]) for r, clock in clocks]
    if other_rates := [(r.file, other) for r, other in rates if abs(other - step) > 0.1 * step]:
        steps = listed(sorted({number(other) for _, other in other_rates}))
        files = listed([file for file, _ in other_rates])
        text = f"a row every {steps} s in {files}: rate = {rate} resamples all to the slowest, so "
        yield Advice("rates", f"{text}that no value is held for several rows")
    gaps, falls = cuts_of(logs)
    gap = number(gap_of(logs))
    if gaps:
        recording, clock = max(clocks, key=lambda pair: pair[1].steps.longest)
        longest, row = number(clock.steps.longest * SCALES[unit]), clock.steps.after + 1
        text = f"{counted(gaps, 'gap(s)')} of more than {GAP_STEPS} steps, the longest {longest} s "
        yield Advice("gaps", f"{text}before row {row} of {recording.file}: gap = {gap} {cuts}")
    if falls:
        text = f"{counted(falls, 'row(s)')} earlier than the row before: gap = {gap} {cuts}"
        yield Advice("falls", text)


def _of_columns(logs: Inspection) -> Iterator[Advice]:
    roles = logs.roles
    for role in ROLES:
        names = [name for name in roles if roles[name] == role]
        if names and ROLES[role].advice:
            text = ROLES[role].advice.format(names=listed(names), first=toml(names[0]))
            yield Advice(role, text)
    plain = {n: logs.columns[n] for n in roles if roles[n] in {"", "scores", "partial", "slow"}}
    if missing := {n: c.missing / c.cells for n, c in plain.items() if lacks_values(n, c)}:
        worst = max(missing, key=lambda name: missing[name])
        longest = max(plain[name].longest for name in missing)
        leading = max(plain[name].leading for name in missing)
        text = f"{listed([*missing])}: {_share(missing[worst])} of values are missing"
        text += f" in {worst}, fewer in others" if len(missing) > 1 else ""
        text += f", up to {counted(longest, 'row(s)')} in a run"
        text += f", {counted(leading, 'row(s)')} at the start" if leading else ""
        most = f", missing_rows = {longest}" if longest > MISSING_ROWS else ""
        yield Advice("missing", f'{text}: write missing = "hold"{most}')
    for name, members in logs.kinds.items():
        kind, names = kinds()[name], [n for together in members for n in together]
        text = kind.words.format(names=listed(names), line=line_of(kind, members))
        yield Advice(f"{name}s", text)
    if coarse := [n for n, c in plain.items() if c.coarse and n not in logs.scores]:
        spread, mean = plain[coarse[0]].numbers.spread, plain[coarse[0]].numbers.mean
        text = (
            f"{listed(coarse)}: little change for the size ({coarse[0]}: {number(spread)} around "
        )
        text += f"{number(mean)}), which float32 would lose: the import subtracts training's mean "
        yield Advice("float32", f"{text}in float64")


def _of_labels(logs: Inspection) -> Iterator[Advice]:
    if logs.intervals:
        text = f'{logs.intervals} names rows of files: write intervals = "{logs.intervals}"'
        yield Advice("intervals", text)
    if labels := logs.labels:
        values = nominal_values(logs)
        _, reason = likely_nominal(labels[0], logs.columns[labels[0]].values or {})
        plain = [*map(plain_label, values)]
        anomalous = anomalous_rows(logs)
        rows = sum(sum(r.values.get(labels[0], {}).values()) for r in logs.recordings)
        text = f"{labels[0]} may say what is anomalous: {sum(anomalous)} of {rows} rows, in "
        text += f"{sum(map(bool, anomalous))} of {counted(len(logs.recordings), 'episode(s)')}: "
        text += f"write labels = {toml(labels[0])}"
        text += "" if values == (0.0,) else f", nominal_label = {toml(plain)}{reason}"
        text += f"; perhaps {listed(labels[1:])}" if len(labels) > 1 else ""
        yield Advice("labels", text)
    keys = keys_of_fields(logs)
    for name, counts in fields_of(logs).items():
        common = ", ".join(f"{value} ({n})" for value, n in counts.most_common(6))
        key = "".join(f': write {key} = "{name}"' for key in keys if keys[key] == name)
        yield Advice("fields", f"{name} of each episode: {common}{key}")
    if not (sort_files(logs).anomalous or labels or {"outcome", "kinds"} & {*keys}):
        text = "nothing says what is anomalous: all counts as nominal until a recipe names files "
        yield Advice("nominal", f"{text}below [anomalous.NAME]")
    if 0 < (nominal := len(nominal_recordings(logs))) < ENOUGH:
        window = window_of(logs)
        advised = f": window = {window} cuts recordings into more" if window else ""
        if window and lacks_rows(logs):
            advised += ", once labels, intervals or an onset say which rows are anomalous"
        text = (
            f"{counted(nominal, 'nominal episode(s)')}: an alarm that at most 10 % of them raise "
        )
        text += "needs 9 for calibration alone, one at 5 % 19 (twice as many for detectors whose "
        yield Advice("few", f"{text}alarm is a CUSUM){advised}")


def looks_like(logs: Inspection) -> dict[str, str]:
    """Return in words what each column looks like; an empty text for a plain number."""
    of_kinds = {
        name: f"{kind}: {number(value)}" if value else kind
        for kind, members in logs.kinds.items()
        for names, value in members.items()
        for name in names
    }
    looks = {}
    for name, role in logs.roles.items():
        facts, words = logs.columns[name], {"kind": of_kinds.get(name, "")}
        words["unit"] = UNIT_NAMES.get(logs.times.get(name, ""), "added")
        texts = map(number, sorted(facts.values or {}, key=str))
        words["values"] = "many values" if facts.values is None else ", ".join(texts)
        in_words = role_of(role).looks.format_map(words) if role else ""
        looks[name] = in_words or words["kind"] or "float32 is too coarse" * facts.coarse
    return looks


def describe_logs(logs: Inspection, width: int = 80) -> str:
    """Return what is in logs as text for a terminal.

    Parameters
    ----------
    logs
        What is in them.
    width
        Of the terminal, in characters.

    Returns
    -------
    str
        A heading, a table of topics if there are several, one of columns, and advice.
    """
    files = len({recording.file for recording in logs.recordings})
    lengths = [recording.length for recording in logs.recordings] or [0]
    least, most = min(lengths), max(lengths)
    span = f"{least} to {most} rows, {np.median(lengths):g} in the median"
    heading = f"{logs.path.name or logs.path}: {logs.form}, {counted(files, 'file(s)')}, "
    heading += f"{counted(len(logs.recordings), 'episode(s)')} "
    heading += f"by {listed(logs.episode)} " if logs.episode else ""
    heading += f"of {span if least < most else f'{most} rows'}"
    parts = ["\n".join(textwrap.wrap(heading, width))]
    if len(logs.topics) > 1:
        parts.append(_topic_table(logs))
    parts.append(_column_table(logs, width))
    roles = {e.name for e in logs.ledger.of("column", "dropped")} & {*logs.columns}
    said = [e for e in logs.ledger if e.fate != "dropped" or e.name not in roles]
    lines = [entry.line(len(logs.recordings)) for entry in said[:_LINES]]
    lines += [f"{len(said) - _LINES} more, which --json has"] if len(said) > _LINES else []
    advice = [*advise(logs), *(Advice("ledger", line) for line in lines)]
    indent = max((len(topic) for topic, _ in advice), default=0) + 2
    wrapper = textwrap.TextWrapper(min(width, 110), break_on_hyphens=False)
    wrapper.subsequent_indent = " " * indent
    parts.append("\n".join(wrapper.fill(f"{a.topic:{indent}}{a.text}") for a in advice))
    return "\n\n".join(filter(None, parts))


def _topic_table(logs: Inspection) -> str:
    steps = {logs.topic_of(name): step_of(logs, name) for name in logs.times}
    rows = []
    for topic in logs.topics:
        counts = [r.rows[topic] for r in logs.recordings if topic in r.rows]
        columns = sum(column.startswith(f"{topic}.") for column in logs.columns)
        rate = f"{1 / steps[topic]:.4g} Hz" if steps.get(topic) else ""
        rows.append([topic, f"{np.median(counts):g}", rate, str(columns)])
    header = ["topic", "rows", "rate", "columns"]
    return str(tabulate(rows, header, "simple", colalign=["left", *["right"] * 3]))


def _column_table(logs: Inspection, width: int) -> str:
    """Return a row for each column; of very many, for those that look like something."""
    looks, times = looks_like(logs), logs.times
    names = [*looks]
    if len(looks) > _MANY:
        odd = [n for n in looks if looks[n] not in {"", "constant", "empty"} and n not in times]
        names = odd[:_MANY]
    rows = []
    for name in names:
        facts, column = logs.columns[name], quantity(name) if _WITH_UNIT.fullmatch(name) else None
        title, unit = (column.name, column.unit) if column and column.unit != "1" else (name, "")
        stem, _, figure = name.rpartition(".")
        if figure in FIGURES and {f"{stem}.{each}" for each in FIGURES} <= {*names}:
            if figure != "mean":  # which stands for the list
                continue
            title = f"{stem}.{'/.'.join(FIGURES)}"
        span = [] if facts.text or facts.empty else [facts.numbers.low, facts.numbers.high]
        low, high = map(number, span or ["", ""])
        missing = _share(facts.missing / facts.cells) if facts.missing else ""
        rows.append([title, unit, low, high, missing, looks[name]])
    header = ["column", "unit", "from", "to", "missing", "looks like"]
    kept = [i for i, title in enumerate(header) if i < 1 or any(row[i] for row in rows)]
    before = sum(max([len(header[i]), *(len(row[i]) for row in rows)]) + 2 for i in kept if i < 5)
    for row in rows:
        row[-1] = "\n".join(textwrap.wrap(row[-1], max(16, width - before)))
    cells, titles = [[row[i] for i in kept] for row in rows], [header[i] for i in kept]
    align = ["right" if 1 < i < 5 else "left" for i in kept] if rows else None
    table = tabulate(cells, titles, "simple", colalign=align, disable_numparse=True)
    text = "\n".join(line.rstrip() for line in table.splitlines())
    if left_out := len(looks) - len(names):
        text += f"\n\nand {left_out} more columns, most of them plain numbers or constants"
    return text


_WITH_UNIT: Final = re.compile(r"[^\[\]]+(\[[^\[\]]+\])?")


def number(value: float | str) -> str:
    """Return a number as a table has it, whole ones without a point; a text as it is.

    Examples
    --------
    >>> number(3.0), number(0.0265878), number(5400123.25)
    ('3', '0.02659', '5400123')
    """
    if isinstance(value, str):
        return value
    if np.isfinite(value) and value == round(value) and abs(value) < 1e7:
        return str(int(value))
    return f"{value:.4g}" if abs(value) < 1e4 else f"{value:.7g}"


def _share(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 0.995 else f"{100 * share:.3g} %"


def time_lines(logs: Inspection, name: str, unit: str) -> list[str]:
    """Return the lines of a recipe for a column with the times of rows, and its unit."""
    lines = []
    if name not in logs.stamps:
        suffix = "" if unit in {"date", "s"} or "[" in name else f"[{unit}]"
        columns = [f"{name}{suffix}", *filter(None, [logs.added.get(name)])]
        lines.append(f"time = {toml(columns if columns[1:] else columns[0])}")
    return [*lines, *([f"dates = {toml(logs.date_order)}"] if logs.date_order else [])]


def as_json(logs: Inspection) -> dict[str, Any]:
    """Return what is in logs as values for JSON: columns, kinds, advice, the ledger."""
    looks = looks_like(logs)
    columns = []
    for name, facts in logs.columns.items():
        moments = {k: getattr(facts.numbers, k) for k in ("low", "high", "mean")}
        span = {k: float(x) if facts.numbers.count else None for k, x in moments.items()}
        counts = {k: getattr(facts, k) for k in ("recordings", "cells", "missing")}
        role = {"role": logs.roles[name] or "sensor", "looks": looks[name]}
        columns.append({"name": name, **role, **counts, **span})
    return {
        "path": str(logs.path),
        "format": logs.form,
        "episodes": [{"file": r.file, "name": r.name, "rows": r.length} for r in logs.recordings],
        "times": logs.times,
        "columns": columns,
        "kinds": {
            kind: [{"columns": names, "value": value} for names, value in members.items()]
            for kind, members in logs.kinds.items()
        },
        "advice": [advice._asdict() for advice in advise(logs)],
        "ledger": logs.ledger.as_json(),
    }
