"""The figures of a reproduction: numbers as dots with error bars in small panels.

Files are the same bytes for the same numbers: no date, no random ids, no machine's fonts.
"""

import hashlib
import io
import itertools
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, Final, NamedTuple

from oodd_eval.data.facts import ENVIRONMENTS, TABLE1, paper_tables
from oodd_eval.errors import MissingExtraError
from oodd_eval.metrics.catalogue import metric_info
from oodd_eval.results.record import NAN
from oodd_paper.estimates import Estimate, Numbers, mean_return
from oodd_paper.experiments import Experiment, Grid
from oodd_paper.inputs import KINDS, Returns

STYLE: Final = Path(__file__).with_name("pictures.mplstyle")

LOOK: Final = 1  # raise it when a change of this module changes how figures look

MARKERS: Final = "osD^vP*X"
DRAWN: Final = ("auc", "auc_matched", "delay", "delay_censored", "far")
# Labels that fit below an axis.
SHORT: Final = {
    "calibration": "calibr.",
    "components": "compon.",
    "shutdown": "shutd.",
    "wind-l2r": "wind →",
    "wind-r2l": "wind ←",
    "all": "mean",
}


class Dots(NamedTuple):
    """One series of a panel: by category a value, its interval, the paper's digit; NaN: none."""

    label: str
    values: tuple[float, ...]
    lows: tuple[float, ...]
    highs: tuple[float, ...]
    paper: tuple[float, ...] = ()


class Panel(NamedTuple):
    """Series over the same categories, a dashed line at `reference`, another before `divide`."""

    title: str
    unit: str
    categories: tuple[str, ...]
    series: tuple[Dots, ...]
    reference: float = NAN
    divide: int = 0


class Picture(NamedTuple):
    """Panels in rows of some columns, with one legend for all."""

    title: str
    panels: tuple[Panel, ...]
    grid: Grid


def pictures_of(experiment: Experiment, numbers: Numbers) -> dict[str, Picture]:
    """Return an experiment's pictures by file name; none where nothing of it was run."""
    if not any(n.estimate.environments for n in numbers.values()):
        return {}
    grid, name, title = experiment.picture, experiment.id, experiment.title
    metrics = [m for m in (*experiment.metrics, *experiment.beyond) if m in DRAWN]
    if grid.axis != "scopes":
        return {name: Picture(title, _panels(experiment, numbers, metrics), grid)}
    names = {m: name + ("" if m in experiment.metrics else "-matched") for m in metrics}
    titles = {m: f"{title}: {metric_info(m).in_paper}" for m in metrics}
    return {names[m]: Picture(titles[m], _panels(experiment, numbers, [m]), grid) for m in metrics}


def _panels(experiment: Experiment, numbers: Numbers, metrics: Sequence[str]) -> tuple[Panel, ...]:
    """Return a panel for each metric and value off the axis, with a colour per label."""
    # Labels have a horizon before the colon. Means over models, or of too few environments, are
    # left to the tables: beside others they would mislead.
    axis, scopes = experiment.picture.axis, {s.id: s for s in experiment.scopes}
    titles = experiment.row_titles
    labels = {
        s.label.rpartition(": ")[::2]: s.label for s in experiment.series if len(s.settings) == 1
    }
    horizons = list(dict.fromkeys(horizon for horizon, _ in labels))
    whole = {"rows": list(titles), "scopes": list(scopes), "horizons": horizons}
    outer = {key: names if key != axis else names[:1] for key, names in whole.items()}
    categories = tuple((SHORT | titles).get(name, name) for name in whole[axis])
    panels = []
    for metric, scope, row, horizon in itertools.product(
        metrics, outer["scopes"], outer["rows"], outer["horizons"]
    ):
        at = {"rows": row, "scopes": scope, "horizons": horizon}
        places = [at | {axis: name} for name in whole[axis]]
        info = metric_info(metric)
        scale, chance, unit = 1.0, NAN, "steps" if info.unit == "steps" else "rate per step"
        if info.unit == "percent":
            scale, chance, unit = 100.0, 50.0, f"{info.in_paper} (%)"
        dots = []
        for label in (label for before, label in labels if before == horizon):
            in_series = [
                numbers[p["rows"], labels[p["horizons"], label], p["scopes"], metric]
                for p in places
            ]
            run = [Estimate() if n.estimate.partial else n.estimate for n in in_series]
            dots.append(_dots(label, run, scale, [scale * n.paper for n in in_series]))
        over = scopes[scope].title.lower()
        title = experiment.picture.panel.format(
            metric=info.in_paper, row=titles[row], horizon=horizon, scope=scope, anomalies=over
        )
        divide = 0 if axis == "horizons" else len(places) - 1
        panels.append(Panel(title, unit, categories, tuple(dots), chance, divide))
    return tuple(panels)


def _dots(
    label: str, run: Sequence[Estimate], scale: float, paper: Iterable[float], zero: float = 0.0
) -> Dots:
    values, lows, highs = (tuple(scale * (e.ends[k] - zero) for e in run) for k in range(3))
    return Dots(label, values, lows, highs, tuple(paper))


def returns_picture(returns: Returns) -> Picture:
    """Return Table 2 as changes in percent of the nominal return, ours and the paper's."""
    panels = []
    names = tuple(SHORT.get(a, a) for a in TABLE1)
    for environment in (e for e in ENVIRONMENTS if e in returns):
        paper = paper_tables()["table2_policy_return"][environment]
        nominal, first = mean_return(returns, environment, "nominal").value, float(paper["nominal"])
        estimates = [mean_return(returns, environment, kind) for kind in KINDS[1:]]
        theirs = [100 * (float(paper[kind]) - first) / abs(first) for kind in KINDS[1:]]
        label = "ours, with intervals of the mean under the anomaly"
        ours = _dots(label, estimates, 100 / abs(nominal), theirs, zero=nominal)
        panels.append(Panel(ENVIRONMENTS[environment].title, "change in %", names, (ours,), 0.0))
    title = "Change of the policies' return under each anomaly, % of the nominal return"
    return Picture(title, tuple(panels), Grid(width=9.2, height=2.0, share="none"))


def drawing_key(picture: Picture) -> str:
    """Return what decides how a picture looks, as a digest: it is written into the SVG file."""
    content = f"{LOOK}\0{STYLE.read_text('utf-8')}\0{_matplotlib().__version__}\0{picture!r}"
    return hashlib.sha256(content.encode()).hexdigest()


def _matplotlib() -> ModuleType:
    try:
        import matplotlib as mpl  # noqa: PLC0415  an extra, and slow to import
    except ImportError:
        todo = 'pip install "oodd-eval[plots]", or leave them out with --no-figures'
        raise MissingExtraError(f"figures need matplotlib: {todo}") from None
    return mpl


def draw(picture: Picture) -> dict[str, bytes]:
    """Return the picture as PNG and SVG, by suffix; MissingExtraError without matplotlib."""
    key, form = drawing_key(picture), picture.grid
    from matplotlib.figure import Figure  # noqa: PLC0415  an extra

    rows = math.ceil(len(picture.panels) / form.columns)
    with _matplotlib().rc_context(fname=STYLE):
        canvas = Figure(figsize=(form.width, rows * form.height + 0.75), layout="constrained")
        grid = canvas.subplots(rows, form.columns, squeeze=False, sharey=form.share)
        flat = list(grid.flat)
        for axes, panel in zip(flat, picture.panels, strict=False):
            _panel(axes, panel)
        for axes in flat[len(picture.panels) :]:
            axes.set_axis_off()
        for i, axes in enumerate(flat):
            axes.tick_params(labelleft=True)
            if form.share != "none" and i % form.columns:
                axes.set_ylabel("")
        canvas.suptitle(picture.title, x=0.01, ha="left")
        handles, labels = _legend(picture)
        widths = [0.075 * len(label) + 0.6 for label in labels]  # inches, roughly
        columns = len(labels) if sum(widths) <= form.width else int(form.width / max(widths)) or 1
        canvas.legend(handles, labels, loc="outside lower center", ncols=columns)
        # Dates and versions would make files differ that show the same.
        metadata = {"png": {"Software": None}, "svg": {"Date": None, "Identifier": key}}
        files = {suffix: io.BytesIO() for suffix in metadata}
        for suffix, file in files.items():
            canvas.savefig(file, format=suffix, metadata=metadata[suffix])
    return {suffix: file.getvalue() for suffix, file in files.items()}


def _panel(axes: Any, panel: Panel) -> None:
    count, places = len(panel.series), range(len(panel.categories))
    for i, dots in enumerate(panel.series):
        x = [k + (i - (count - 1) / 2) * 0.72 / count for k in places]
        line = {"color": f"C{i}", "marker": MARKERS[i % len(MARKERS)], "linestyle": "none"}
        axes.vlines(x, dots.lows, dots.highs, color=f"C{i}", alpha=0.75)
        axes.plot(x, dots.values, **line, clip_on=False)
        if dots.paper:
            axes.plot(
                x,
                dots.paper,
                **line,
                markersize=5.5,
                markerfacecolor="none",
                markeredgewidth=0.9,
                alpha=0.9,
            )
    if not math.isnan(panel.reference):
        axes.axhline(panel.reference, color="#888888", linewidth=0.9, linestyle=(0, (4, 3)))
    for k in places[1:]:
        strong = k == panel.divide
        axes.axvline(k - 0.5, color="#888888" if strong else "#f0f0f0", linewidth=0.8, zorder=0)
    axes.set_xlim(-0.5, len(places) - 0.5)
    long = max(map(len, panel.categories), default=0) * len(places) > 34
    axes.set_xticks(
        places,
        panel.categories,
        rotation=40 if long else 0,
        ha="right" if long else "center",
        rotation_mode="anchor",
    )
    axes.set_title(panel.title)
    axes.set_ylabel(panel.unit)


def _legend(picture: Picture) -> tuple[list[Any], list[str]]:
    """Return one handle per label of all panels, and one for the paper's hollow markers."""
    from matplotlib.lines import Line2D  # noqa: PLC0415  an extra

    series = [one for panel in picture.panels for one in panel.series]
    labels = list(dict.fromkeys(one.label for one in series))
    markers = [MARKERS[i % len(MARKERS)] for i in range(len(labels))]
    handles = [Line2D([], [], color=f"C{i}", marker=marker) for i, marker in enumerate(markers)]
    if any(not math.isnan(x) for one in series for x in one.paper):
        handles.append(
            Line2D(
                [],
                [],
                color="#333333",
                marker="o",
                linestyle="none",
                markerfacecolor="none",
                markersize=5.5,
            )
        )
        labels.append("hollow: the paper's digits")
    return handles, labels
