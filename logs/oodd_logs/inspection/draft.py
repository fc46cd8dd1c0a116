"""A first recipe for logs, as TOML with remarks."""

import fnmatch
import glob
import re
import textwrap
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, SPLITS
from oodd_eval.names import listed
from oodd_logs.inspection.logs import Inspection
from oodd_logs.inspection.meaning import (
    cuts_of,
    fields_of,
    gap_of,
    keys_of_fields,
    lacks_rows,
    lacks_values,
    name_of,
    rate_of,
    sort_files,
    window_of,
)
from oodd_logs.inspection.report import number, time_lines
from oodd_logs.inspection.roles import line_of, role_of, toml
from oodd_logs.kinds import kinds
from oodd_logs.marks import NOMINAL_WORDS, likely_nominal, plain_label
from oodd_logs.recipe import MISSING_ROWS


def draft(logs: Inspection, prefix: str = "", name: str = "") -> str:
    """Return a first recipe for logs as TOML with comments.

    Parameters
    ----------
    logs
        What is in them.
    prefix
        Folder of the files as seen from that of the recipe; empty where it is the same.
    name
        Of the split and the environment; by default that of the file or folder.

    Returns
    -------
    str
        The recipe; `oodd_logs.recipe.Recipe.parse` takes it.
    """
    stem = name or logs.path.resolve().stem
    name = name_of(stem, "logs", {**SPLITS, **ENVIRONMENTS})
    options = {"format": logs.form, **logs.options}
    options |= {"transpose": logs.transposed} if logs.transposed else {}
    lines = [
        f"# A first recipe for {logs.path.name}, written by `oodd-eval data inspect`.",
        "# Edit it, then import it with `oodd-eval data import`. What is behind # is not in use.",
        f"split = {toml(name)}",
        f"environment = {toml(name)}",
        '# source = "https://..."  # with licence and citation: `data info` shows them',
        "",
        *_draft_rows(logs),
        *_draft_columns(logs),
        *_draft_labels(logs),
        "",
        "[read]",
        *(f"{key} = {toml(value)}" for key, value in options.items()),
        "",
        *_draft_files(logs, prefix),
    ]
    for i, line in enumerate(lines):
        if line.startswith("#"):  # a line break in a name would end the remark
            lines[i] = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)
    return "\n".join(lines) + "\n"


def _draft_rows(logs: Inspection) -> Iterator[str]:
    """Yield keys that say how rows become episodes."""
    times = logs.times
    if logs.episode:
        columns = logs.episode if len(logs.episode) > 1 else logs.episode[0]
        yield f"episode = {toml(columns)}  # tells the episodes of a file apart"
    if len(times) == 1 and len(logs.topics) == 1:
        ((name, unit),) = times.items()
        yield from time_lines(logs, name, unit)
    if times:
        yield f"rate = {rate_of(logs)}  # rows in a second"
    else:
        yield "# rate = 10  # rows in a second, if it is known: then there are alarms per hour"
    if any(cuts_of(logs)) or len(times) > 1:
        yield f"gap = {number(gap_of(logs))}  # seconds without a row, at which recordings are cut"
    window = window_of(logs)
    is_cut = window > 0 and not lacks_rows(logs)
    if is_cut:
        yield f"window = {window}  # rows of an episode, to which long recordings are cut"
        yield "clock = false  # row t of a window has nothing to do with row t of another"
    elif window:
        yield f"# window = {window}  # rows of an episode, once labels, intervals or an onset say"
        yield "#   which rows are anomalous: without them all windows of a faulty recording count"
        yield "#   as anomalous, also those before the fault"
    yield "# baseline = 100  # rows at the start of every episode that are nominal, if they are"
    if not is_cut:
        yield "# clock = false  # if row t of one episode has nothing to do with row t of another"
    yield ""


def _draft_columns(logs: Inspection) -> Iterator[str]:
    """Yield the sensors and what becomes of them."""
    sensors, remarks = logs.sensors, defaultdict(list)
    wrapper = textwrap.TextWrapper(98, initial_indent="# ", subsequent_indent="#   ")
    if any(name.startswith("obs:") for name in sensors):
        yield "# sensors and actions are the columns obs:NAME[UNIT] and action:NAME[UNIT]"
    else:
        yield "sensors = ["
        yield from (f"  {toml(name)}," for name in sensors)
        yield "]"
        yield '# actions = ["cmd*"]  # what was commanded, if columns say so'
        for name, role in logs.roles.items():
            if role not in {"", "scores"}:
                remarks[role_of(role).reason].append(name)
        for reason, names in remarks.items():
            yield from wrapper.wrap(f"left out, {reason}: {listed(names, 40)}")
    if logs.scores:
        yield f"scores = {_several(logs.scores)}  # by name what a monitor computed: no sensors"
    for name, members in logs.kinds.items():
        used = {names: value for names, value in members.items() if {*names} <= {*sensors}}
        if line := line_of(kinds()[name], used):
            yield line
        elif used:
            yield from wrapper.wrap(f"{name}: {listed([n for names in used for n in names], 40)}")
    facts = {name: logs.columns[name] for name in (*sensors, *logs.scores)}
    if "missing-code" in logs.kinds or any(lacks_values(n, column) for n, column in facts.items()):
        most = max(max(column.longest, column.leading) for column in facts.values())
        yield 'missing = "hold"  # the last value; or "drop" rows, or "refuse"'
        if most > MISSING_ROWS:
            yield f"missing_rows = {most}  # in a run, at most"


def _draft_labels(logs: Inspection) -> Iterator[str]:
    """Yield the keys that say what is anomalous."""
    keys = keys_of_fields(logs)
    if logs.intervals:
        yield f"intervals = {toml(logs.intervals)}"
    elif logs.labels:
        label, *alternatives = logs.labels
        also = f"  # or {listed(alternatives)}" if alternatives else ""
        yield f"labels = {toml(label)}{also}"
        counts: Mapping[float | str, int] = logs.columns[label].values or {}
        values, reason = likely_nominal(label, counts)
        plain = toml([*map(plain_label, values or [*counts][:1])])
        if not values:
            yield f"# nominal_label = {plain}  # say which of the labels is that of nominal rows"
        elif values not in {(0.0,), ("H",)}:
            yield f"nominal_label = {plain}{reason and f'  #{reason[1:]}: check it'}"
    elif key := next((key for key in ("outcome", "kinds") if key in keys), ""):
        yield f"{key} = {toml(keys[key])}"
    else:
        yield '# labels = "fault"  # a column that is 0 where nominal; or intervals = "labels.csv"'
    if "task" in keys:
        yield f"task = {toml(keys['task'])}"


def _draft_files(logs: Inspection, prefix: str) -> Iterator[str]:
    """Yield the tables that say which files are nominal, and which have which anomaly."""
    sorting = sort_files(logs)
    files = list(dict.fromkeys(r.file for r in logs.recordings))
    if unusable := [file for file in files if file not in logs.usable]:
        yield f"# left out, as copies of others or with other columns: {listed(unusable, 40)}"
    if logs.unreadable:
        yield f"# left out, as they cannot be read or have no rows: {listed(logs.unreadable, 40)}"
        files = list(dict.fromkeys([*files, *logs.unreadable]))
    yield "[nominal]" + (f"  # {sorting.reason}" if sorting.reason else "")
    yield f"files = {_globs(files, sorting.nominal, prefix)}"
    keys = {} if logs.labels or logs.intervals else keys_of_fields(logs)
    if "kinds" in keys and "outcome" not in keys:
        values = [v for v in fields_of(logs)[keys["kinds"]] if NOMINAL_WORDS.search(str(v))]
        yield f"where = {{{toml(keys['kinds'])} = {toml(values)}}}"
    tested = sorting.anomalous or {"outcome", "kinds"} & {*keys}
    yield "parts = [0.4, 0.3, 0.3]  # training, calibration and test" + (
        "" if tested else ", in the order of the files"
    )
    for kind, names in sorting.anomalous.items():
        yield ""
        yield f"[anomalous.{kind}]"
        yield f"files = {_globs(files, names, prefix)}"
        if kind not in ANOMALIES:
            yield '# group = "sensor"  # by default "dynamics"'
    if not tested:
        yield from ("", "# [anomalous.NAME]", '# files = ["faulty/*.csv"]')


def _globs(files: Sequence[str], names: Sequence[str], prefix: str) -> str:
    """Return names among files as TOML, as globs that match no other file where there are some."""
    globs, left = [], {*names}
    for name in names:
        folder, file = Path(name).parent, Path(name)
        plain = glob.escape(file.stem)
        stems = "*", re.sub(r"[\W\d_]*\d[\W\d_]*", "*", plain), re.sub(r"\d+$", "*", plain)
        for pattern in (str(folder / f"{stem}{file.suffix}") for stem in stems):
            among = {f for f in files if Path(f).parent == folder and fnmatch.fnmatch(f, pattern)}
            if name in left and len(among) > 1 and among <= left:
                globs.append(pattern)
                left -= among
        if name in left:
            globs.append(glob.escape(name))
            left.remove(name)
    return _several([Path(prefix, pattern).as_posix() for pattern in globs])


def _several(texts: Sequence[str]) -> str:
    """Return texts as TOML, in several lines where they are many."""
    lines = (f"  {toml(text)}," for text in texts)
    return toml(texts) if len(texts) < 4 else "\n".join(["[", *lines, "]"])
