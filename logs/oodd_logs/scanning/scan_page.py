"""A scan as one page of HTML: every episode in a table, a picture of each odd one.

The page needs nothing else: no scripts, fonts or pictures of other files, and it is dark where its
reader's system is.
"""

import html
import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.names import counted
from oodd_logs.marks import runs_of
from oodd_logs.scanning.scan import Scan, ScannedEpisode

Floats = NDArray[np.float64]

PICTURES: Final = 100
"""Odd episodes that have a picture: of more, the first ones."""
SENSORS: Final = 3
AROUND: Final = 100
"""Rows before and after the first odd row in which sensors are drawn."""
POINTS: Final = 600
"""Columns of a curve: of more rows, the smallest and the largest value of each column are drawn."""
LOGARITHMIC: Final = 20.0
"""Multiple of the threshold from which on a statistic is drawn on a logarithmic scale."""

NUMBERS: Final = ("rows", "largest", "p", "q", "first odd row")
TITLES: Final = ("episode", *NUMBERS, "look at", "faults", "label in the logs")

_LEFT, _RIGHT, _WIDTH = 76, 12, 860
_TALL, _LOW, _GAP = 150, 84, 44

_LEGEND: Final = (
    "In the pictures the line is the first odd row, shaded are rows with a statistic above the "
    "threshold; sensors are drawn around the first odd row."
)

_STYLE: Final = """
:root { color-scheme: light dark; --text: #1b1f24; --dim: #5a6472; --ground: #fff; --line: #d9dee5;
  --curve: #0b62a8; --odd: #b3261e; --shade: #b3261e22; --mark: #fdecea; }
@media (prefers-color-scheme: dark) { :root { --text: #e6e9ee; --dim: #9aa5b3; --ground: #15181c;
  --line: #343b45; --curve: #6db3f2; --odd: #ff8a80; --shade: #ff8a8026; --mark: #3a2321; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.5rem 1rem 4rem; max-width: 60rem; color: var(--text);
  background: var(--ground); font: 15px/1.5 system-ui, sans-serif; }
h1 { font-size: 1.5rem; margin: 0 0 .5rem; } h2 { font-size: 1.1rem; margin: 2.2rem 0 .3rem;
  overflow-wrap: anywhere; }
p { margin: .3rem 0; } .dim { color: var(--dim); } a { color: var(--curve); }
.wide { overflow-x: auto; margin-top: 1rem; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .6rem; text-align: left; border-bottom: 1px solid var(--line);
  vertical-align: top; white-space: nowrap; }
td.words { white-space: normal; min-width: 9rem; } th { color: var(--dim); font-weight: 600; }
.number { text-align: right; } tr.odd { background: var(--mark); }
tr.odd td:first-child { box-shadow: inset 3px 0 var(--odd); }
svg { display: block; width: 100%; min-width: 36rem; height: auto; }
svg text { fill: var(--dim); font: 12px system-ui, sans-serif; } svg .name { fill: var(--text); }
svg .frame { fill: none; stroke: var(--line); } svg .shade { fill: var(--shade); }
svg .curve { fill: none; stroke: var(--curve); stroke-width: 1.3; stroke-linejoin: round; }
svg .limit { stroke: var(--odd); stroke-dasharray: 5 4; } svg .first { stroke: var(--odd); }
"""


def page(scan: Scan, title: str = "Scan") -> str:
    """Return a scan as HTML.

    Parameters
    ----------
    scan
        What to show.
    title
        Heading of the page, such as the name of the logs.

    Returns
    -------
    str
        A whole document.
    """
    heading, odd = html.escape(title), [i for i, scanned in enumerate(scan.episodes) if scanned.odd]
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    text = [
        f'<!doctype html><html lang="en"><head>{head}<title>{heading}</title>',
        f"<style>{_STYLE}</style></head><body><h1>{heading}</h1>",
        f"<p><strong>{summary(scan)}</strong> Judged by {html.escape(scan.judge)}.</p>",
        *(f'<p class="dim">{html.escape(note)}</p>' for note in scan.notes),
        *([f'<p class="dim">{_LEGEND}</p>'] if odd else []),
    ]
    for i in odd[:PICTURES]:
        scanned = scan.episodes[i]
        about = html.escape(describe(scanned))
        if scanned.label:
            about += f' <span class="dim">The logs say: {html.escape(scanned.label)}.</span>'
        text.append(
            f'<h2 id="episode-{i}">{html.escape(scanned.episode.name)}</h2><p>{about}</p>'
            f'<div class="wide">{picture(scanned, scan.sensors)}</div>'
        )
    if len(odd) > PICTURES:
        text.append(f"<p>And {len(odd) - PICTURES} more odd episodes without a picture.</p>")
    text.append(f"<h2>All episodes</h2>{_table(scan.episodes)}")
    return "\n".join([*text, "</body></html>\n"])


def _table(episodes: Sequence[ScannedEpisode]) -> str:
    names = titles(episodes)
    lines = ["".join(f"<th{' class=number' * (name in NUMBERS)}>{name}</th>" for name in names)]
    for i, scanned in enumerate(episodes):
        name, *texts = map(html.escape, cells(scanned))
        line = f'<td><a href="#episode-{i}">{name}</a></td>' if scanned.odd else f"<td>{name}</td>"
        for title, text in zip(names[1:], texts, strict=False):
            line += f"<td class={'number' if title in NUMBERS else 'words'}>{text}</td>"
        lines.append(line)
    odd = [False, *(scanned.odd for scanned in episodes)]
    rows = [f"<tr{' class=odd' * o}>{line}</tr>" for o, line in zip(odd, lines, strict=True)]
    return f'<div class="wide"><table>{chr(10).join(rows)}</table></div>'


def titles(episodes: Sequence[ScannedEpisode]) -> tuple[str, ...]:
    """Return the titles of `cells`; the last one, of labels, where any episode has one."""
    return TITLES if any(scanned.label for scanned in episodes) else TITLES[:-1]


def cells(one: ScannedEpisode, *, brief: bool = False) -> list[str]:
    """Return an episode as texts in the order of `TITLES`; if brief, what is most important."""
    suspects = one.suspects[:SENSORS] if brief else one.suspects
    faults = dict.fromkeys(fault.fault if brief else str(fault) for fault in one.faults)
    return [
        one.episode.name,
        str(len(one.scores)),
        figure(one.largest),
        p_value(one.p),
        p_value(one.q),
        "" if one.first is None else str(one.first),
        ", ".join(suspects) if one.odd else "",
        ", ".join(faults),
        one.label,
    ]


def summary(scan: Scan) -> str:
    """Return how many episodes are odd, in a sentence."""
    rate = f"false discovery rate {scan.fdr:g}"
    episodes = counted(len(scan.episodes), "episode(s)")
    verb = "is" if 1 in (len(scan.odd), len(scan.episodes)) else "are"
    return f"{len(scan.odd)} of {episodes} {verb} odd ({rate})."


def describe(one: ScannedEpisode) -> str:
    """Return what is odd about an episode, in a sentence or two."""
    parts = []
    if one.since is not None and one.row is not None:
        parts.append(
            f"Statistic above its threshold from row {one.row} on, beginning at row {one.since}; "
            f"p = {p_value(one.p)}, q = {p_value(one.q)}."
        )
        shares = [f"{name} {share:.0%}" for name, share in list(one.sensors.items())[:SENSORS]]
        parts.append(f"Evidence: {', '.join(shares)}.")
    if one.faults:
        parts.append(f"Faults of the stream: {', '.join(map(str, one.faults))}.")
    return " ".join(parts)


def picture(one: ScannedEpisode, names: Sequence[str]) -> str:
    """Return the statistic with its threshold, and suspected sensors around the first odd row."""
    columns = {name: one.episode.observations[:, d] for d, name in enumerate(names)}
    suspects = [name for name in [*one.suspects, *one.sensors, *names] if name in columns]
    first, rows = one.first or 0, len(one.scores)
    around = range(max(0, first - AROUND), min(rows, first + AROUND + 1))
    statistic = np.where(np.isfinite(one.statistic), one.statistic, np.nan)
    title, limit = "statistic", one.threshold
    logarithmic = 0 < limit * LOGARITHMIC < one.largest < math.inf
    if logarithmic:
        statistic = np.log10(np.maximum(statistic, limit / 1e3))
        title, limit = "statistic (log)", math.log10(limit)
    panels = [_panel(statistic, title, 0, _TALL, range(rows), one, limit, logarithmic=logarithmic)]
    height = _TALL + _GAP
    for name in list(dict.fromkeys(suspects))[:SENSORS]:
        panels.append(_panel(columns[name], name, height, _LOW, around, one))
        height += _LOW + _GAP
    label = html.escape(f"Statistic and sensors of {one.episode.name}")
    box = f'viewBox="0 0 {_WIDTH} {height}"'
    return f'<svg {box} role="img" aria-label="{label}">{"".join(panels)}</svg>'


def _tag(name: str, content: str | None = None, **attributes: str | float) -> str:
    """Return an element; numbers with a point get one decimal."""
    tag = f"<{name}"
    for key, value in attributes.items():
        text = f"{value:.1f}" if isinstance(value, float) else value
        tag += f' {key.strip("_").replace("_", "-")}="{text}"'
    return tag + ("/>" if content is None else f">{content}</{name}>")


def _panel(
    values: Floats,
    name: str,
    top: int,
    height: int,
    rows: range,
    scanned: ScannedEpisode,
    limit: float = math.nan,
    *,
    logarithmic: bool = False,
) -> str:
    """Return a curve of some rows in its frame, with limit and odd rows."""
    top, begin, end = top + 18, rows.start, rows.stop
    visible, is_limited = values[begin:end], math.isfinite(limit)
    finite = np.append(visible[np.isfinite(visible)], limit if is_limited else [])
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    if low == high:
        low, high = low - 1, high + 1
    width, right, bottom = _WIDTH - _LEFT - _RIGHT, _WIDTH - _RIGHT, top + height

    def x(row: float) -> float:
        return _LEFT + width * (row - begin) / max(1, end - begin - 1)

    def y(value: float) -> float:
        return bottom - 4 - (height - 8) * (value - low) / (high - low)

    def text(at: float, line: float, content: str, anchor: str = "end") -> str:
        return _tag("text", content, x=at, y=line, text_anchor=anchor)

    parts = [
        _tag("rect", class_="shade", x=x(a), y=top, width=max(1.0, x(b - 1) - x(a)), height=height)
        for start, stop in scanned.intervals
        if (a := max(start, begin)) < (b := min(stop, end))
    ]
    parts.append(_tag("rect", class_="frame", x=_LEFT, y=top, width=width, height=height))
    if is_limited:
        parts.append(_tag("line", class_="limit", x1=_LEFT, x2=right, y1=y(limit), y2=y(limit)))
    if scanned.first is not None and scanned.first in rows:
        at = x(scanned.first)
        parts.append(_tag("line", class_="first", y1=top, y2=bottom, x1=at, x2=at))
    for run in runs_of(np.isfinite(visible)):
        points = " ".join(f"{x(begin + r):.1f},{y(v):.1f}" for r, v in _thinned(visible, *run))
        parts.append(_tag("polyline", class_="curve", points=points))
    for line, value in ((top + 12, high), (bottom - 4, low)):
        parts.append(text(_LEFT - 6, line, figure(10**value if logarithmic else value)))
    parts.append(_tag("text", html.escape(name), class_="name", x=_LEFT, y=top - 5))
    if is_limited:
        parts.append(text(right, top - 5, f"dashed: threshold {figure(scanned.threshold)}"))
    parts.append(text(float(_LEFT), bottom + 13, f"row {begin}", "start"))
    parts.append(text(float(right), bottom + 13, f"row {end - 1}"))
    return "".join(parts)


def _thinned(values: Floats, start: int, stop: int) -> list[tuple[int, float]]:
    """Return points of a curve: of many rows, smallest and largest value of each column."""
    rows = np.arange(start, stop)
    if len(values) > 2 * POINTS:
        size = math.ceil(len(values) / POINTS)
        extremes: set[int] = {start, stop - 1}
        for part in np.split(rows, range(size, len(rows), size)):
            extremes |= {int(part[values[part].argmin()]), int(part[values[part].argmax()])}
        rows = np.array(sorted(extremes))
    return [(int(row), float(values[row])) for row in rows]


def figure(value: float) -> str:
    """Return a number with three digits; empty where it is not finite.

    >>> figure(12.3456), figure(123456.0), figure(float("nan"))
    ('12.3', '1.23e+05', '')
    """
    return f"{value:.3g}" if math.isfinite(value) else ""


def p_value(p: float) -> str:
    """Return a p-value as it is read.

    >>> p_value(0.04321), p_value(1.0), p_value(1e-9), p_value(float("nan"))
    ('0.0432', '1', '<0.0001', '')
    """
    return "<0.0001" if p < 1e-4 else figure(p)
