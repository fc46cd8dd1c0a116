"""A description of a split: sizes, sensors, lengths, onsets or intervals, returns, Table 2."""

import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from typing import Final

import numpy as np
from numpy.typing import NDArray
from tabulate import tabulate

from oodd_eval.data import layout
from oodd_eval.data.facts import ENVIRONMENTS, paper_tables, title_of
from oodd_eval.data.parts import AnomalousSet, EnvironmentData, LabelledSet, TrajectorySet
from oodd_eval.data.split import Split

HEADER: Final = (
    "group",
    "trajectories",
    "transitions",
    "length",
    "onset",
    "effect",
    "tail",
    "redraws",
    "return",
)
LOGS_HEADER: Final = (
    "part",
    "episodes",
    "tasks",
    "rows",
    "length",
    "intervals",
    "anomalous rows",
    "outcome only",
    "return",
)
_WRAPPER: Final = textwrap.TextWrapper(100, subsequent_indent="  ", break_long_words=False)
Rows = list[list[str]]
Returns = Mapping[str, NDArray[np.float64]]  # by kind: ``nominal`` and anomalies


def describe(
    split: Split, remarks: Callable[[EnvironmentData], Iterable[str]] = lambda _data: ()
) -> str:
    """Return all there is to know of a split as plain text; opens and verifies every file.

    `remarks` returns what else is to be said of an environment that was imported.
    """
    manifest = split.manifest
    definition = manifest["definition"]
    text = "{train} training, {calibration} calibration trajectories, {test} test seeds; "
    how = "imported"
    if "seed_base" in definition:
        caps = {
            definition.get("by_environment", {})
            .get(name, {})
            .get("episode_cap", definition["episode_cap"])
            for name in split.environments
        }
        cap = " or ".join(str(cap or "the simulator's") for cap in sorted(caps, key=str))
        seeds = f"seed base {definition['seed_base']}"
        if "drawn" in definition:
            seeds = f"seeds of 128 random bits with SHA-256 {definition['drawn'][:12]}"
        how = f"episode cap {cap}; {seeds}; generator {manifest['generator']}"
    else:
        text = "{train} training, {calibration} calibration and {test} nominal test episodes; "
    sizes = text.format_map(layout.part_sizes(manifest))
    lines = [f"split {split.name}, digest {split.digest}\n{sizes}{how}\nin {split.path}"]
    lines += [f"licence {manifest['licence']}"] if "licence" in manifest else []
    returns: dict[str, Returns] = {}
    for name in split.environments:
        entry = manifest["environments"][name]
        size = (split.path / entry["file"]).stat().st_size / 1e6
        recorded = "seed_base" in definition
        origin = f"policy {entry['policy'][:12]}" if recorded else "imported from logs"
        title = f"{title_of(name)}: {size:.2f} MB, {origin}"
        with closing(split.environment(name)) as data:
            lines += ["", *environment_lines(data, title)]
            lines += strength_lines(split, name)
            if data.logs:
                sentences = (*data.ledger, *remarks(data))
                lines += (line for sentence in sentences for line in _WRAPPER.wrap(sentence))
            if name in ENVIRONMENTS and data.logs is None:
                returns[name] = collect_returns(data)
    if returns:
        kinds = {kind for by_kind in returns.values() for kind in by_kind}
        columns = ["nominal", *(n for n in split.anomalies if n in kinds and "@" not in n)]
        title = "Table 2: mean return of the policies, nominal and under each anomaly"
        header = ["Environment", "", *columns]
        lines += ["", _table(title, header, return_rows(returns, columns))]
    return "\n".join(lines)


def environment_lines(data: EnvironmentData, title: str) -> list[str]:
    """Return a table of the parts of an environment, without empty columns, its logs, sensors."""
    header, rows = (HEADER, group_rows(data)) if data.paired else (LOGS_HEADER, log_rows(data))
    filled = [i for i in range(len(header)) if any(row[i] for row in rows)]
    rows = [[row[i] for i in filled] for row in rows]
    table = _table(title, [header[i] for i in filled], rows)
    return [table, "", *log_lines(data), *column_lines(data)]


def log_lines(data: EnvironmentData) -> list[str]:
    """Return where logs are from and how their rows are meant; nothing for recorded ones."""
    logs = data.logs
    if logs is None:
        return []
    facts = {"source": logs.source, "licence": logs.licence, "citation": logs.citation}
    facts["rate"] = "" if logs.rate is None else f"{logs.rate:g} rows/s"
    if logs.baseline:
        facts["baseline"] = (
            f"the first {logs.baseline} rows of every episode are nominal and not judged"
        )
    facts["clock"] = (
        "row t of an episode is compared with row t of others"
        if logs.clock
        else "rows are compared with all rows of other episodes"
    )
    facts["order"] = "as recorded" if logs.order == "recorded" else "shuffled"
    pairs = zip(data.sensors, logs.offsets, strict=False)
    shifted = [f"{q.name} {x:.9g}" for q, x in pairs if x]
    facts["offsets"] = f"subtracted in float64: {', '.join(shifted)}" if shifted else ""
    return [line for n, v in facts.items() if v for line in _WRAPPER.wrap(f"{n}: {v}")]


def log_rows(data: EnvironmentData) -> Rows:
    """Return the rows of a table with the columns of `LOGS_HEADER`.

    Intervals and anomalous rows are those of episodes with intervals, of whose rows the share is.
    """
    rows = []
    tests = data.twins, *map(data.labelled, data.anomalies)
    for part in (data.train, data.failures, data.calibration, *tests):
        if part is None:
            continue
        labels = ["", "", ""]
        if isinstance(part, LabelledSet):
            labelled = [(i, spans) for i, spans in enumerate(part.intervals) if spans]
            anomalous = sum(stop - max(start, 0) for _, spans in labelled for start, stop in spans)
            of = sum(int(part.lengths[i]) + 1 for i, _ in labelled)
            share = f"{anomalous} ({anomalous / of:.0%})" if of else ""
            alone = len(part) - len(labelled)
            labels = [str(sum(len(spans) for _, spans in labelled)), share, str(alone or "")]
        tasks = {task for task in part.tasks if task}
        sizes = [str(part.lengths.sum() + len(part)), _span(part.lengths + 1)]
        count = str(len(tasks) or "")
        rows.append([part.group, str(len(part)), count, *sizes, *labels, _mean_return(part)])
    return rows


def group_rows(data: EnvironmentData) -> Rows:
    """Return the rows of a table with the columns of `HEADER`.

    The effect is counted from the onset, the tail is the median of the transitions beyond it.
    """
    rows = []
    anomalous = map(data.anomalous, data.anomalies)
    for part in (data.train, data.calibration, data.twins, *anomalous):
        drawn = ["", "", "", ""]
        if isinstance(part, AnomalousSet):
            tail = f"{np.median(part.tails):g}{' brief' if part.brief else ''}"
            after = f"+{_span(part.effects - part.onsets)}"
            drawn = [_span(part.onsets), after, tail, str(part.redraws.sum())]
        sizes = [str(len(part)), str(part.lengths.sum()), _span(part.lengths)]
        rows.append([part.group, *sizes, *drawn, _mean_return(part)])
    return rows


def column_lines(data: EnvironmentData) -> list[str]:
    """Return numbers, names and units of sensors, recorded scores and actions as lines of text."""
    lines = []
    scores = [column for column in data.columns if column.role == "score"]
    kinds = {"sensors": data.sensors, "scores": scores, "actions": data.actions}
    for kind, quantities in ((kind, columns) for kind, columns in kinds.items() if columns):
        units = [f" [{quantity.unit}]" if quantity.unit != "1" else "" for quantity in quantities]
        named = [f"{i} {q.name}{u}" for i, (q, u) in enumerate(zip(quantities, units, strict=True))]
        # Lines break between quantities, not within one.
        text = ", ".join(name.replace(" ", "\u00a0") for name in named)
        wrapper = textwrap.TextWrapper(100, subsequent_indent="  ", break_on_hyphens=False)
        lines += [line.replace("\u00a0", " ") for line in wrapper.wrap(f"{kind}: {text}")]
    return lines


def strength_lines(split: Split, environment: str) -> list[str]:
    """Return the strengths of each kind of anomaly with their numbers and unit, one line a kind."""
    units = split.manifest["environments"][environment].get("units", {})
    kinds: dict[str, list[str]] = {}
    for condition, number in split.strengths(environment).items():
        name = condition.strength
        text = f"{number:g}" if name in {"", f"{number:g}"} else f"{name} = {number:g}"
        kinds.setdefault(condition.anomaly, []).append(text)
    return [
        f"strengths of {kind}{f' ({units[kind]})' if kind in units else ''}: {', '.join(texts)}"
        for kind, texts in kinds.items()
    ]


def collect_returns(data: EnvironmentData) -> Returns:
    """Return the returns of the test part by kind."""
    return {"nominal": data.twins.returns} | {a: data.anomalous(a).returns for a in data.anomalies}


def return_rows(returns: Mapping[str, Returns], kinds: Sequence[str]) -> Rows:
    """Return mean returns by environment and kind, ours above the paper's, which has no cap."""
    rows = []
    for environment, by_kind in returns.items():
        ours = [f"{by_kind[k].mean():.1f}" if len(by_kind.get(k, ())) else "" for k in kinds]
        rows.append([title_of(environment), "ours", *ours])
        if paper := paper_tables()["table2_policy_return"].get(environment):
            rows.append(["", "paper", *(f"{paper[k]:.1f}" if k in paper else "" for k in kinds)])
    return rows


def _mean_return(part: TrajectorySet) -> str:
    """Return mean and spread of returns; an empty text where no reward was recorded."""
    returns = part.returns
    return f"{returns.mean():.1f} ± {returns.std():.1f}" if returns.any() else ""


def _span(values: NDArray[np.int64]) -> str:
    """Return the range of some integers, as one number when they are equal."""
    return "..".join(map(str, sorted({values.min(), values.max()}))) if len(values) else ""


def _table(title: str, header: Sequence[str], rows: Rows) -> str:
    # Numbers are formatted already; tabulate would parse them and drop zeros behind the point.
    return f"{title}\n\n{tabulate(rows, header, 'simple', disable_numparse=True)}"
