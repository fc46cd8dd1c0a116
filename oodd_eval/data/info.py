"""A description of a split: sizes, sensors, lengths, onsets, returns, and the paper's Table 2."""

import textwrap
from collections.abc import Mapping, Sequence
from contextlib import closing
from typing import Final

import numpy as np
from numpy.typing import NDArray
from tabulate import tabulate

from oodd_eval.data.facts import paper_tables, title_of
from oodd_eval.data.layout import part_sizes
from oodd_eval.data.parts import AnomalousSet, EnvironmentData
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
Rows = list[list[str]]
Returns = Mapping[str, NDArray[np.float64]]  # by kind: ``nominal`` and anomalies


def describe(split: Split) -> str:
    """Return all there is to know of a split as plain text; opens and verifies every file."""
    manifest = split.manifest
    definition = manifest["definition"]
    text = "{train} training, {calibration} calibration trajectories, {test} test seeds; "
    how = "imported"
    if "seed_base" in definition:
        cap = definition["episode_cap"] or "the simulator's"
        seeds = f"seed base {definition['seed_base']}"
        how = f"episode cap {cap}; {seeds}; generator {manifest['generator']}"
    sizes = text.format_map(part_sizes(manifest))
    lines = [f"split {split.name}, digest {split.digest}\n{sizes}{how}\nin {split.path}"]
    returns: dict[str, Returns] = {}
    for name in split.environments:
        entry = manifest["environments"][name]
        size = (split.path / entry["file"]).stat().st_size / 1e6
        title = f"{title_of(name)}: {size:.2f} MB, policy {entry['policy'][:12]}"
        with closing(split.environment(name)) as data:
            lines += ["", _table(title, HEADER, group_rows(data)), "", *column_lines(data)]
            lines += strength_lines(split, name)
            returns[name] = collect_returns(data)
    title = "Table 2: mean return of the policies, nominal and under each anomaly"
    recorded = {kind for by_kind in returns.values() for kind in by_kind}
    kinds = ["nominal", *(n for n in split.anomalies if n in recorded and "@" not in n)]
    return "\n".join(
        [*lines, "", _table(title, ["Environment", "", *kinds], return_rows(returns, kinds))]
    )


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
        mean = f"{part.returns.mean():.1f} ± {part.returns.std():.1f}" if len(part) else ""
        rows.append([part.group, *sizes, *drawn, mean])
    return rows


def column_lines(data: EnvironmentData) -> list[str]:
    """Return numbers, names and units of sensors and actions as lines of text."""
    lines = []
    for kind, quantities in (("sensors", data.sensors), ("actions", data.actions)):
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


def _span(values: NDArray[np.int64]) -> str:
    """Return the range of some integers, as one number when they are equal."""
    return "..".join(map(str, sorted({values.min(), values.max()}))) if len(values) else ""


def _table(title: str, header: Sequence[str], rows: Rows) -> str:
    # Numbers are formatted already; tabulate would parse them and drop zeros behind the point.
    return f"{title}\n\n{tabulate(rows, header, 'simple', disable_numparse=True)}"
