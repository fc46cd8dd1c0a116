"""Dots with error bars in small panels: the one kind of figure of a reproduction.

Files are the same bytes for the same numbers: no date, no random ids, no machine's fonts.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from oodd_eval.errors import MissingExtraError
from oodd_eval.results.record import NAN

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#555555",
                  "#000000")  # fmt: skip
"""Okabe and Ito (2008): told apart with any colour vision; markers differ as well."""

MARKERS: Final = "osD^vP*X"

STYLE: Final[dict[str, Any]] = {
    "svg.hashsalt": "oodd-eval",
    "svg.fonttype": "none",
    "font.family": "DejaVu Sans",
    "font.size": 8.0,
    "axes.titlesize": 9.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#888888",
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.8,
    "xtick.color": "#333333",
    "ytick.color": "#333333",
    "legend.frameon": False,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}

DPI: Final = 110


@dataclass(frozen=True, slots=True)
class Dots:
    """One series of a panel: by category a value, its interval, the paper's digit; NaN: none."""

    label: str
    values: tuple[float, ...]
    lows: tuple[float, ...]
    highs: tuple[float, ...]
    paper: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Panel:
    """Some series over the same categories.

    Attributes
    ----------
    title, unit
        Above, and at the vertical axis.
    categories
        Labels at the horizontal axis.
    series
        In the order of the legend.
    reference
        Height of a dashed line, such as that of chance; NaN for none.
    divide
        Index of the category before which a line separates means from the rest; 0 for none.
    """

    title: str
    unit: str
    categories: tuple[str, ...]
    series: tuple[Dots, ...]
    reference: float = NAN
    divide: int = 0


@dataclass(frozen=True, slots=True)
class Figure:
    """Panels in a grid, with one legend for all.

    Attributes
    ----------
    title
        Above all.
    panels
        Row by row.
    columns
        Panels in a row.
    width, height
        Of one panel, in inches.
    share
        Which panels have the same vertical axis.
    """

    title: str
    panels: tuple[Panel, ...]
    columns: int
    width: float = 3.2
    height: float = 2.1
    share: Literal["all", "row", "none"] = "all"


def drawing_key(figure: Figure) -> str:
    """Return what decides how a figure looks, as a digest: it is written into the SVG file.

    Raises
    ------
    MissingExtraError
        Without matplotlib.
    """
    try:
        version = importlib.metadata.version("matplotlib")
    except importlib.metadata.PackageNotFoundError:
        raise _missing() from None
    content = hashlib.sha256(Path(__file__).read_bytes())
    content.update(f"{version}\0{figure!r}".encode())
    return content.hexdigest()


def _missing() -> MissingExtraError:
    return MissingExtraError(
        'figures need matplotlib: pip install "oodd-eval[plots]", or leave them out with '
        "--no-figures"
    )


def draw(figure: Figure) -> dict[str, bytes]:
    """Return the figure as PNG and SVG, by suffix.

    Raises
    ------
    MissingExtraError
        Without matplotlib.
    """
    key = drawing_key(figure)
    try:
        import matplotlib as mpl  # noqa: PLC0415  an extra, and slow to import
        from matplotlib.figure import Figure as Canvas  # noqa: PLC0415
    except ImportError:
        raise _missing() from None
    rows = math.ceil(len(figure.panels) / figure.columns)
    with mpl.rc_context(STYLE):  # type: ignore[arg-type]  # its keys are a closed list of literals
        size = figure.columns * figure.width, rows * figure.height + 0.75
        canvas = Canvas(figsize=size, layout="constrained")
        grid = canvas.subplots(rows, figure.columns, squeeze=False, sharey=figure.share)
        flat = list(grid.flat)
        for axes, panel in zip(flat, figure.panels, strict=False):
            _panel(axes, panel)
        for axes in flat[len(figure.panels) :]:
            axes.set_axis_off()
        for i, axes in enumerate(flat):
            axes.tick_params(labelleft=True)
            if figure.share != "none" and i % figure.columns:
                axes.set_ylabel("")
        canvas.suptitle(figure.title, x=0.01, ha="left", fontsize=11, fontweight="bold")
        handles, labels = _legend(figure)
        widths = [0.075 * len(label) + 0.6 for label in labels]  # inches, roughly
        one_row = sum(widths) <= size[0]
        columns = len(labels) if one_row else max(1, int(size[0] / max(widths)))
        canvas.legend(handles, labels, loc="outside lower center", ncols=columns)
        return {suffix: _saved(canvas, suffix, key) for suffix in ("png", "svg")}


def _panel(axes: Axes, panel: Panel) -> None:
    count = len(panel.series)
    step = 0.72 / max(count, 1)
    for i, dots in enumerate(panel.series):
        offset = (i - (count - 1) / 2) * step
        x = [k + offset for k in range(len(panel.categories))]
        axes.vlines(x, dots.lows, dots.highs, color=_colour(i), linewidth=1.3, alpha=0.75)
        axes.plot(x, dots.values, _marker(i), color=_colour(i), markersize=4.2, clip_on=False)
        if dots.paper:
            axes.plot(x, dots.paper, _marker(i), color=_colour(i), markersize=5.5,
                      markerfacecolor="none", markeredgewidth=0.9, alpha=0.9)  # fmt: skip
    if not math.isnan(panel.reference):
        axes.axhline(panel.reference, color="#888888", linewidth=0.9, linestyle=(0, (4, 3)))
    for k in range(1, len(panel.categories)):
        strong = k == panel.divide
        axes.axvline(k - 0.5, color="#888888" if strong else "#f0f0f0", linewidth=0.8, zorder=0)
    axes.set_xlim(-0.5, len(panel.categories) - 0.5)
    long = max(map(len, panel.categories), default=0) * len(panel.categories) > 34
    axes.set_xticks(range(len(panel.categories)), panel.categories,
                    rotation=40 if long else 0, ha="right" if long else "center",
                    rotation_mode="anchor")  # fmt: skip
    axes.tick_params(axis="x", length=0)
    axes.set_title(panel.title)
    axes.set_ylabel(panel.unit)


def _legend(figure: Figure) -> tuple[list[Any], list[str]]:
    """Return one handle per label of all panels, and one for the paper's hollow markers."""
    from matplotlib.lines import Line2D  # noqa: PLC0415  an extra

    labels = list(dict.fromkeys(d.label for p in figure.panels for d in p.series))
    first = figure.panels[0]
    place = {d.label: i for i, d in enumerate(first.series)}
    handles = [
        Line2D([], [], color=_colour(place.get(label, i)), marker=_marker(place.get(label, i)),
               linewidth=1.3, markersize=4.2)
        for i, label in enumerate(labels)
    ]  # fmt: skip
    if any(not math.isnan(x) for p in figure.panels for d in p.series for x in d.paper):
        handles.append(Line2D([], [], color="#333333", marker="o", linestyle="none",
                              markerfacecolor="none", markersize=5.5))  # fmt: skip
        labels.append("hollow: the paper's digits")
    return handles, labels


def _colour(index: int) -> str:
    return COLOURS[index % len(COLOURS)]


def _marker(index: int) -> str:
    return MARKERS[index % len(MARKERS)]


def _saved(canvas: Any, suffix: str, key: str) -> bytes:
    # Dates and versions would make files differ that show the same.
    metadata: dict[str, str | None] = {"Software": None}
    if suffix == "svg":
        metadata = {"Date": None, "Identifier": key}
    buffer = io.BytesIO()
    canvas.savefig(buffer, format=suffix, dpi=DPI, metadata=metadata)
    return buffer.getvalue()
