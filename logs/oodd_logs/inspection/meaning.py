"""Guesses of what logs mean: what each column is, which files are nominal, at which rate they are.

`oodd_logs.inspection.report` puts them into words, `draft` into a recipe.
"""

import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from oodd_eval.data.facts import ANOMALIES
from oodd_logs.inspection.columns import ColumnFacts
from oodd_logs.inspection.logs import SLOW, Inspection, RecordingFacts, grouped
from oodd_logs.kinds.times import SCALES
from oodd_logs.marks import NOMINAL_WORDS, likely_nominal
from oodd_logs.stamps import GAP_STEPS

_TASK: Final = re.compile(r"(?:^|_)(?:task|setpoint|set_point)(?:_id|_index)?$", re.IGNORECASE)
_WINDOWS: Final = 100  # episodes that long recordings are cut to, roughly
_SHORTEST: Final = 50  # rows of a window
ENOUGH: Final = 38
"""Nominal episodes of which a third is enough for a threshold."""
_LAYOUTS: Final = {"onset", "seed", "terminated", "truncated", "parameters", "discrete", "start"}


class Sorting(NamedTuple):
    """Nominal files, and the files of each anomaly."""

    nominal: tuple[str, ...]
    anomalous: Mapping[str, tuple[str, ...]]
    reason: str


def fields_of(logs: Inspection) -> dict[str, Counter[Any]]:
    """Return the values of fields with few values, and episodes with each."""
    values = grouped(
        (name, value)
        for recording in logs.recordings
        for name, value in recording.fields.items()
        if isinstance(value, str | bool | int) and name not in _LAYOUTS
    )
    most = max(8, len(logs.recordings) // 4)
    return {name: c for name, v in values.items() if len(c := Counter(v)) <= most}


def keys_of_fields(logs: Inspection) -> dict[str, str]:
    """Return the fields of episodes that are ``"outcome"``, ``"kinds"`` and ``"task"``, by key."""
    keys: dict[str, str] = {}
    for name, counts in fields_of(logs).items():
        if len(counts) < 2:
            continue
        if all(isinstance(value, bool) for value in counts):
            keys.setdefault("outcome", name)
        elif any(NOMINAL_WORDS.search(str(value)) for value in counts):
            keys.setdefault("kinds", name)
        elif _TASK.search(name):
            keys.setdefault("task", name)
    return keys


def nominal_values(logs: Inspection) -> tuple[float | str, ...]:
    """Return the values of the label that are nominal, those of most rows where none says so."""
    values: Mapping[float | str, int] = logs.columns[logs.labels[0]].values or {}
    likely, _ = likely_nominal(logs.labels[0], values)
    return likely or (max(values, key=lambda value: values[value]),)


def anomalous_rows(logs: Inspection) -> list[int]:
    """Return the number of rows of each recording whose label has none of its nominal values."""
    nominal = nominal_values(logs)
    counts = (recording.values.get(logs.labels[0], {}) for recording in logs.recordings)
    return [sum(n for value, n in c.items() if value not in nominal) for c in counts]


def sort_files(logs: Inspection) -> Sorting:
    """Tell files apart by labels, else by their names."""
    files, by = tuple(logs.usable), "intervals"
    if logs.labels:
        pairs, by = zip(logs.recordings, anomalous_rows(logs), strict=True), logs.labels[0]
        rows = {recording.file for recording, n in pairs if n}
        anomalous = [file for file in files if file in rows]
        if len(anomalous) < len(files):
            return _by_kind(files, anomalous, f"files told apart by {by}")
    if logs.labels or logs.intervals:
        return Sorting(files, {"fault": files}, f"windows told apart by {by}")
    words = {file: str(Path(file).with_suffix("")).replace("_", " ") for file in files}
    anomalous = [file for file in files if not NOMINAL_WORDS.search(words[file])]
    if len(anomalous) < len(files) and not {"outcome", "kinds"} & {*keys_of_fields(logs)}:
        return _by_kind(files, anomalous, "files told apart by their names")
    return Sorting(files, {}, "")


def _by_kind(files: Sequence[str], anomalous: Sequence[str], reason: str) -> Sorting:
    """Name anomalies by the folders of their files, or by what their names do not share."""
    texts = {file: str(Path(file).with_suffix("")).lower() for file in files}
    parts = {file: re.split(r"[\s_.,/\-]+", text) for file, text in texts.items()}
    shared = set.intersection(*map(set, parts.values()))
    # The number of a log, as in r12, where nominal ones are numbered likewise, is no anomaly.
    nominal = tuple(file for file in files if file not in {*anomalous})
    stems = {word: re.sub(r"\d+", "", word) for words in parts.values() for word in words}
    numbered = {"", *(stems[word] for file in nominal for word in parts[file])}
    kinds: dict[str, list[str]] = defaultdict(list)
    for file in anomalous:
        folder = Path(file).parent.name
        words = [w for w in parts[file] if w not in shared]
        words = [w for w in words if w == stems[w] or stems[w] not in numbered]
        name = folder if folder and len({Path(f).parent for f in files}) > 1 else "-".join(words)
        kinds[name_of(name, "fault", ANOMALIES)].append(file)
    return Sorting(nominal, {kind: tuple(names) for kind, names in kinds.items()}, reason)


def name_of(text: str, otherwise: str, reserved: Mapping[str, Any]) -> str:
    """Return a text as the name of a split, an environment or an anomaly."""
    name = re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")[:50].strip("-") or otherwise
    return f"my-{name}" if name in reserved or name == "nominal" else name


def window_of(logs: Inspection) -> int:
    """Return rows that cut long nominal recordings into enough; 0 where they are short."""
    nominal, times, rows = nominal_recordings(logs), logs.times, 0.0
    for recording in nominal:
        seconds = [
            recording.rows[logs.topic_of(name)] * clock.steps.usual * SCALES[times[name]]
            for name, clock in recording.clocks.items()
            if name in times
        ]
        rows += max(seconds) * float(rate_of(logs)) if seconds else recording.length
    window = max(_SHORTEST, int(rows) // _WINDOWS)
    if len(nominal) >= ENOUGH or rows < 20 * window:
        return 0
    return int(round(window, -max(0, len(str(window)) - 2)))


def lacks_rows(logs: Inspection) -> bool:
    """Tell whether recordings are anomalous of which nothing says since which row."""
    if logs.labels or logs.intervals:
        return False
    files = {file for names in sort_files(logs).anomalous.values() for file in names}
    without = any(r.file in files and "onset" not in r.fields for r in logs.recordings)
    return without or bool({"outcome", "kinds"} & {*keys_of_fields(logs)})


def nominal_recordings(logs: Inspection) -> list[RecordingFacts]:
    """Return the recordings of files that seem to be nominal, at least in part."""
    files = sort_files(logs).nominal
    return [recording for recording in logs.recordings if recording.file in files]


def step_of(logs: Inspection, name: str) -> float:
    """Return seconds between rows by a column with times, in the median of the recordings."""
    steps = [clock.steps.usual for _, clock in logs.clocks(name)]
    return float(np.median(steps)) * SCALES[logs.times[name]]


def rate_of(logs: Inspection) -> str:
    """Return the rows in a second to which recordings are resampled.

    It is the rate of the slowest topic, or of the slowest recording, among those that have at least
    a tenth of the fastest's: a value that is held for several rows looks like a sensor that stands
    still.
    """
    times = logs.times
    steps = [step_of(logs, name) for name in times]
    if len(times) == 1:
        ((name, unit),) = times.items()
        steps = [clock.steps.usual * SCALES[unit] for _, clock in logs.clocks(name)]
    steps = [step for step in steps if step > 0]
    step = max((s for s in steps if s * SLOW <= min(steps)), default=1.0)
    text = f"{1 / step:.4g}"
    is_round = abs(float(f"{step:.4g}") / step - 1) < 1e-6  # a row every 60 s, say
    return text if abs(float(text) * step - 1) < 1e-6 or not is_round else f"{1 / step:.10g}"


def gap_of(logs: Inspection) -> float:
    """Return seconds without a row at which recordings are cut, in steps of the recipe's rate."""
    return GAP_STEPS / float(rate_of(logs))


def cuts_of(logs: Inspection) -> tuple[int, int]:
    """Return the number of gaps, and of rows that are earlier than the row before."""
    steps = [clock.steps for name in logs.times for _, clock in logs.clocks(name)]
    return sum(s.gaps for s in steps), sum(s.falls for s in steps)


def lacks_values(name: str, facts: ColumnFacts) -> bool:
    """Tell whether values are missing, other than commands after the last observation."""
    after = name.startswith(("action:", "reward")) and facts.missing <= facts.recordings
    return bool(facts.missing or facts.words) and not facts.constant and not after
