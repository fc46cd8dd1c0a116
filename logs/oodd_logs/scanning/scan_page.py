"""A scan as one page of HTML: ranked episodes in bands, with pictures of their suspects.

The page needs nothing else: no scripts, fonts or pictures of other files, and it is dark where its
reader's system is.
"""

import html
import math
from collections.abc import Callable, Sequence
from importlib.resources import files
from typing import Final

import numpy as np
from numpy.typing import NDArray

from oodd_logs.marks import runs_of
from oodd_logs.scanning.scan import Scan, ScannedEpisode

Floats = NDArray[np.float64]
Link = Callable[[ScannedEpisode], str]

PICTURES: Final = 100
"""Most episodes that have a picture."""
SENSORS: Final = 3
"""Suspects of an episode that are drawn and listed."""
AROUND: Final = 250
"""Rows before and after the first odd row in which sensors of longer episodes are drawn."""
POINTS: Final = 600
"""Columns of a curve: of more rows, the smallest and the largest value of each column are drawn."""
NUMBERS: Final = ("row", "time", "p", "q")
TITLES: Final = ("episode", *NUMBERS, "sensors", "reason", "label in the logs")
WORDS: Final = {"surely": "odd", "look at": "look", "fine": "fine"}
"""A word for each band, with which its lines begin."""

_HEADINGS: Final = {"surely": "Odd", "look at": "To look at", "fine": "The next ones, fine"}
_FEWEST: Final = 5  # other episodes with a usual range
_USUAL: Final = (5, 95)  # per cent of their values
_LEFT, _RIGHT, _WIDTH, _HEIGHT, _GAP = 76, 12, 860, 100, 44
_LEGEND: Final = (
    "In the pictures the vertical line is the odd row, the band holds the middle nine tenths of "
    "the other episodes at the same row, and shaded are rows with a statistic above the threshold."
)
_STYLE: Final = files("oodd_logs.scanning") / "scan_page.css"


def page(
    scan: Scan,
    title: str = "Scan",
    *,
    first: int = 10,
    link: Link = lambda _: "",
    notes: Sequence[str] = (),
) -> str:
    """Return a scan as HTML.

    Parameters
    ----------
    scan
        What to show.
    title
        Heading of the page, such as the name of the logs.
    first
        Number of episodes that have a picture whatever their band.
    link
        Returns the address that opens an episode in a viewer; empty where there is none.
    notes
        Sentences about the logs, besides those of the scan.

    Returns
    -------
    str
        A whole document.
    """
    heading = html.escape(title)
    notable = [s for s in scan.ranked if s.position <= first or s.band != "fine"]
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    text = [
        f'<!doctype html><html lang="en"><head>{head}<title>{heading}</title>',
        f"<style>{_STYLE.read_text('utf-8')}</style></head><body><h1>{heading}</h1>",
        f"<p><strong>{summary(scan)}</strong> Judged by {html.escape(scan.judge)}.</p>",
        *(f'<p class="dim">{html.escape(remark)}</p>' for remark in (*notes, *scan.notes)),
        f'<p class="dim">{_LEGEND}</p>',
    ]
    drawn = notable[:PICTURES]
    for band, name in _HEADINGS.items():
        in_band = [scanned for scanned in drawn if scanned.band == band]
        text += [f'<h2 class="{WORDS[band]}">{name}</h2>'] * bool(in_band)
        text += [_article(scanned, scan, link(scanned)) for scanned in in_band]
    if len(notable) > PICTURES:
        text.append(f"<p>And {len(notable) - PICTURES} more without a picture.</p>")
    text.append(f"<h2>All episodes</h2>{_table(scan, {scanned.position for scanned in drawn})}")
    return "\n".join([*text, "</body></html>\n"])


def _article(scanned: ScannedEpisode, scan: Scan, address: str) -> str:
    sentences = [f"{scanned.reason}."] if scanned.reason else []
    if not math.isnan(scanned.p):
        sentences.append(f"p {p_value(scanned.p)}, q {p_value(scanned.q)}.")
    sentences += [f"The logs say: {scanned.label}."] if scanned.label else []
    about = html.escape(" ".join(sentences))
    if address:
        row = "" if scanned.first is None else f" at row {scanned.first}"
        about += f' <a href="{html.escape(address)}">Open in Foxglove{row}</a>'
    name = html.escape(scanned.episode.name)
    return (
        f'<h3 id="episode-{scanned.position}">{scanned.position}. {name}</h3><p>{about}</p>'
        f'<div class="wide">{picture(scanned, scan)}</div>'
    )


def _table(scan: Scan, drawn: set[int]) -> str:
    titles, rows = table_of(scan.ranked)
    lines = ["<th></th>" + "".join(f"<th{_class(title)}>{title}</th>" for title in titles)]
    for scanned, texts in zip(scan.ranked, rows, strict=True):
        name, *others = [
            f"<td{_class(title)}>{html.escape(text)}</td>"
            for title, text in zip(titles, texts, strict=True)
        ]
        if scanned.position in drawn:
            link = f'<a href="#episode-{scanned.position}">{html.escape(scanned.episode.name)}</a>'
            name = f"<td>{link}</td>"
        word = WORDS[scanned.band]
        lines.append(f"<td class={word}>{word}</td>{name}{''.join(others)}")
    body = "\n".join(f"<tr>{line}</tr>" for line in lines)
    return f'<div class="wide"><table>{body}</table></div>'


def _class(title: str) -> str:
    return " class=number" * (title in NUMBERS) or " class=words" * (title != "episode")


def table_of(episodes: Sequence[ScannedEpisode]) -> tuple[list[str], list[list[str]]]:
    """Return titles and cells of a table of episodes, without columns that are empty."""
    rows = [
        [
            scanned.episode.name,
            "" if scanned.first is None else str(scanned.first),
            ""
            if (time := scanned.as_json()["first_odd_time"]) is None
            else f"{round(time, 3):.13g}",
            p_value(scanned.p),
            p_value(scanned.q),
            ", ".join(scanned.suspects[:SENSORS]),
            scanned.reason,
            scanned.label,
        ]
        for scanned in episodes
    ]
    kept = [i for i in range(len(TITLES)) if any(row[i] for row in rows)]
    return [TITLES[i] for i in kept], [[row[i] for i in kept] for row in rows]


def summary(scan: Scan) -> str:
    """Return how many episodes are in each band, in a sentence."""
    bands = [scanned.band for scanned in scan.episodes]
    return (
        f"{len(scan.odd)} of {len(bands)} episodes are odd (false discovery rate {scan.fdr:g}); "
        f"{bands.count('look at')} to look at; {bands.count('fine')} fine."
    )


def picture(scanned: ScannedEpisode, scan: Scan) -> str:
    """Return the suspects beside the other episodes, and a statistic that exceeds its threshold."""
    rows, first = len(scanned.scores), scanned.first
    span = range(rows)
    if first is not None and rows > 2 * AROUND:
        span = range(max(0, first - AROUND), min(rows, first + AROUND + 1))
    columns = {name: d for d, name in enumerate(scan.sensors)}
    names = [name for name in [*scanned.suspects, *scanned.sensors, *columns] if name in columns]
    panels: list[str] = []
    for name in list(dict.fromkeys(names))[: min(SENSORS, max(1, len(scanned.suspects)))]:
        values = [other.episode.observations[:, columns[name]] for other in scan.episodes
                  if other is not scanned]  # fmt: skip
        observations = scanned.episode.observations[:, columns[name]]
        panels.append(
            _panel(len(panels), observations, name, span, scanned, usual=_usual(values, span))
        )
    if scanned.intervals:
        statistic = np.where(np.isfinite(scanned.statistic), scanned.statistic, np.nan)
        panels.append(
            _panel(len(panels), statistic, "statistic", span, scanned, limit=scanned.threshold)
        )
    label = html.escape(f"Suspects of {scanned.episode.name}")
    box = f'viewBox="0 0 {_WIDTH} {len(panels) * (_HEIGHT + _GAP)}"'
    return f'<svg {box} role="img" aria-label="{label}">{"".join(panels)}</svg>'


def _usual(values: Sequence[Floats], span: range) -> Floats:
    """Return a low and a high value of the other episodes for each row, NaN where they are few."""
    rows = np.full((len(values), len(span)), np.nan)
    for row, column in zip(rows, values, strict=True):
        part = column[span.start : span.stop]
        row[: len(part)] = part
    usual = np.full((2, len(span)), np.nan)
    enough = np.isfinite(rows).sum(axis=0) >= _FEWEST
    usual[:, enough] = np.nanpercentile(rows[:, enough], _USUAL, axis=0)
    return usual


def _panel(
    number: int,
    values: Floats,
    name: str,
    span: range,
    scanned: ScannedEpisode,
    *,
    usual: Floats | None = None,
    limit: float = math.nan,
) -> str:
    """Return a curve of some rows in its frame, with what is usual, a limit and odd rows."""
    top, begin, end = 18 + number * (_HEIGHT + _GAP), span.start, span.stop
    bottom, right = top + _HEIGHT, _WIDTH - _RIGHT
    visible, band = values[begin:end], np.empty((2, 0)) if usual is None else usual
    drawn = np.concatenate([visible, band.ravel(), [limit]])
    drawn = drawn[np.isfinite(drawn)]
    low, high = (float(drawn.min()), float(drawn.max())) if len(drawn) else (0.0, 1.0)
    if low == high:
        low, high = low - 1, high + 1

    def x(row: float) -> float:
        return _LEFT + (right - _LEFT) * (row - begin) / max(1, end - begin - 1)

    def y(value: float) -> float:
        return bottom - 4 - (_HEIGHT - 8) * (value - low) / (high - low)

    def points(curve: Floats, start: int, stop: int) -> list[tuple[float, float]]:
        return [(x(begin + r), y(v)) for r, v in _thinned(curve, start, stop)]

    def path(kind: str, *corners: tuple[float, float]) -> str:
        d = " ".join(f"{a:.1f},{b:.1f}" for a, b in corners)
        return f'<path class="{kind}" d="M{d}"/>'

    def text(at: float, line: float, content: str, more: str = 'text-anchor="end"') -> str:
        return f'<text x="{at}" y="{line}" {more}>{html.escape(content)}</text>'

    def box(kind: str, left: float, stop: float) -> str:
        return path(kind, (left, top), (stop, top), (stop, bottom), (left, bottom), (left, top))

    parts = [
        box("shade", x(a), max(x(a) + 1, x(b - 1)))
        for start, stop in scanned.intervals
        if (a := max(start, begin)) < (b := min(stop, end))
    ]
    parts.append(box("frame", _LEFT, right))
    parts += [
        path("usual", *points(band[1], *run), *points(band[0], *run)[::-1])
        for run in runs_of(np.isfinite(band[0] + band[1]))
    ]
    parts += [path("curve", *points(visible, *run)) for run in runs_of(np.isfinite(visible))]
    if scanned.first is not None and scanned.first in span:
        parts.append(path("first", (x(scanned.first), top), (x(scanned.first), bottom)))
    if math.isfinite(limit):
        parts.append(path("limit", (_LEFT, y(limit)), (right, y(limit))))
        parts.append(text(right, top - 5, f"dashed: threshold {figure(limit)}"))
    parts.append(text(_LEFT, top - 5, name, 'class="name"'))
    parts += [text(_LEFT - 6, top + 12, figure(high)), text(_LEFT - 6, bottom - 4, figure(low))]
    parts.append(text(_LEFT, bottom + 13, f"row {begin}", ""))
    return "".join([*parts, text(right, bottom + 13, f"row {end - 1}")])


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
