"""The tables of a board, as texts in cells; renderers set them for a terminal or as Markdown."""

import itertools
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, GROUPS, TABLE1, title_of
from oodd_eval.metrics import catalogue
from oodd_eval.metrics.catalogue import RANKING, UNDEFINED, metric_info
from oodd_eval.results.identity import Setting
from oodd_eval.results.tables.board import Board, RankedBoard, Standing, Value

_BLIND: Final = ("clock", "comb")  # know the time alone: their AUC says nothing of dynamics

_SIMPLE: Final = ("random", "persistence", *_BLIND, "range", "mahalanobis", "rf", "rf-ewma")
"""Rows that a detector with a learned model of the dynamics should beat."""

_FEW: Final = 30  # test seeds per environment below which a board calls comparisons weak
_BRIEF: Final = "\N{DAGGER}"  # marks the figures of brief cells

_ALARMS: Final = (
    "delay",
    "missed",
    *(f"found_within_{k}" for k in catalogue.FOUND_WITHIN),
    f"found_within_{catalogue.FOUND_WITHIN[-1]}_null",
    "false_episodes",
    "early",
)
"""Columns of a table of guaranteed alarms. The null of the longest span is the largest."""

_PAPER: Final = ("delay", "delay_null", "delay_censored", "missed", "far", "far_twin")
"""Columns of alarms at the paper's threshold."""

_LABELS: Final = ("rank", "detector", "settings")


@dataclass(frozen=True, slots=True)
class Table:
    """A titled table of texts, the first `labels` columns set to the left, with a note below it."""

    title: str
    header: list[str]
    rows: list[list[str]]
    labels: int = 1
    note: str = ""

    @property
    def alignment(self) -> tuple[str, ...]:
        """``"left"`` or ``"right"`` for every column, as tabulate takes it."""
        return tuple("left" if i < self.labels else "right" for i in range(len(self.header)))

    def columns(self, indices: Sequence[int]) -> "Table":
        """Return the table with these columns only."""
        rows = [[row[i] for i in indices] for row in self.rows]
        return replace(self, header=[self.header[i] for i in indices], rows=rows)

    def transposed(self) -> "Table":
        """Return the table with rows and columns exchanged."""
        whole = [list(column) for column in zip(self.header, *self.rows, strict=True)]
        return replace(self, header=whole[0], rows=whole[1:], labels=1)


def show_value(value: Value, metric: str) -> str:
    """Return a mean as printed: a number, a dash where undefined, a failure's state, or nothing.

    A star marks a mean over fewer cells than other rows have, a dagger one of brief cells only.
    """
    if not value.cells:
        return ""
    number = metric_info(metric).text
    text = value.state or number(value.value)
    if not math.isnan(value.low):
        text += f" [{number(value.low)}, {number(value.high)}]"
    return text + "*" * value.partial + _BRIEF * value.brief


class _Mean(NamedTuple):
    """A column: the mean of a metric over some of a board's cells."""

    title: str
    metric: str
    environments: Sequence[str]
    anomalies: Sequence[str]
    intervals: bool = False


def _texts(board: Board, entry: Setting, columns: Iterable[_Mean]) -> list[str]:
    return [
        show_value(board.mean(entry, environments, anomalies, metric, intervals=intervals), metric)
        for _, metric, environments, anomalies, intervals in columns
    ]


def _by_group(board: Board, title: str, *, intervals: bool) -> list[_Mean]:
    """Return matched AUC over all cells, and over each group of anomalies."""
    chosen = {title: board.anomalies} | {g: board.in_group(g) for g in GROUPS if board.in_group(g)}
    return [_Mean(t, RANKING, board.environments, a, intervals) for t, a in chosen.items()]


def _overall(
    board: Board, names: Iterable[str], intervals: Collection[str] = (), *, level: bool = True
) -> list[_Mean]:
    titles = {n: metric_info(n).title for n in names}
    titles |= {} if level else {n: t.partition(" at ")[0].lower() for n, t in titles.items()}
    over = board.environments, board.anomalies
    return [_Mean(title, n, *over, n in intervals) for n, title in titles.items()]


def separability(board: Board, *, intervals: bool = False) -> Table:
    """Return matched AUC by anomaly group and by environment, the best mean first.

    Beside the mean over all cells stand that of smoothed scores and that against another twin.
    """
    columns = _by_group(board, "mean", intervals=intervals)
    over = board.environments, board.anomalies
    columns += [_Mean(n, f"auc_{n}", *over, intervals) for n in ("smoothed", "unpaired")]
    columns += [_Mean(e, RANKING, [e], board.anomalies, intervals) for e in board.environments]
    means = {entry: board.mean(entry, *over, RANKING).value for entry in board.entries}
    order = sorted(means, key=lambda e: math.inf if math.isnan(means[e]) else -means[e])
    rows = [[str(entry), *_texts(board, entry, columns)] for entry in order]
    title = "Separability: matched AUC (%), higher is better. The leaderboard ranks by this."
    return Table(title, ["detector", *(c.title for c in columns)], rows)


def guaranteed(
    board: Board,
    suffix: str = "",
    *,
    intervals: bool = False,
    nulls: bool = False,
    standings: Sequence[Standing] = (),
) -> Table | None:
    """Return guaranteed alarms at a level, mean over cells; None when no record has them.

    The level is by default ``at_5pct``, or the strictest that the records have. False episodes
    always have `intervals`. With `nulls` each figure stands beside what false alarms alone give.
    Where `standings` are given, rows are in their order and have their places.
    """
    suffix = suffix or _strictest(board)
    bases = _ALARMS if not nulls else catalogue.GUARANTEED
    names = _present(board, (f"{name}_{suffix}" for name in bases))
    if not names:
        return None
    with_ends = [n for n in names if intervals or metric_info(n).interval == "exact"]
    columns = _overall(board, names, with_ends, level=False)
    level = f"{100 * catalogue.LEVELS[suffix]:g} %"
    title = f"Guaranteed alarms at {level} (delays in steps, the rest in %)"
    note = (
        f"The threshold promises an alarm in at most {level} of nominal episodes; false episodes "
        "is the share of this split's nominal twins that raised one."
    )
    return replace(_by_metric(board, title, columns, standings), note=note)


def attribution(
    board: Board, *, intervals: bool = False, standings: Sequence[Standing] = ()
) -> Table | None:
    """Return what detectors that explain say at their guaranteed alarms; None without any."""
    explaining = {r.setting for r in board.records if r.metrics.keys() & {*catalogue.ATTRIBUTION}}
    if not explaining:
        return None
    names = catalogue.ATTRIBUTION
    own = board if standings else Board([r for r in board.records if r.setting in explaining])
    columns = _overall(own, names, names if intervals else (), level=False)
    title = f"Attribution at {metric_info(names[0]).level} (onset error in rows, the rest in %)"
    note = (
        "Of the detectors that explain their scores, at the first guaranteed alarm: how often the "
        "sensor that they name first is a corrupted one, over sensor anomalies, and how far the "
        "onset that they name is from the effect, the median of a cell."
    )
    placed = [one for one in standings if one.entry in explaining]
    return replace(_by_metric(own, title, columns, placed), note=note)


def _strictest(board: Board) -> str:
    """Return the suffix of the headline level, or of the strictest one that records have."""
    found = [s for s in catalogue.LEVELS if _present(board, [f"false_episodes_{s}"])]
    return catalogue.HEADLINE if catalogue.HEADLINE in found or not found else found[-1]


def anomaly_groups(
    board: Board, horizon: int, groups: Sequence[str] = GROUPS, *, intervals: bool = False
) -> Table:
    """Return AUC, delay and false-alarm rate by environment and anomaly group: the paper's Table 5.

    The columns AVG are means over the detectors, trivial ones left out where there are others.
    """
    entries = [e for e in board.entries if e.horizon == horizon]
    averaged = [e for e in entries if not board.is_trivial(e)] or entries
    groups = [g for g in groups if board.in_group(g)]
    # The title says the horizon.
    labels = [*(str(replace(e, horizon=1)) for e in entries), "AVG"]
    header = ["Environment", "Result"]
    for group in groups:
        header += [f"{group}: {label}" if len(groups) > 1 else label for label in labels]
    rows = []
    for environment, metric in itertools.product(board.environments, ("auc", "delay", "far")):
        row = [title_of(environment), metric_info(metric).title]
        for group in groups:
            over = [environment], board.in_group(group), metric
            means = {e: board.mean(e, *over, intervals=intervals) for e in entries}
            several = [means[e] for e in averaged]
            defined = [v.value for v in several if not math.isnan(v.value)]
            mean = sum(defined) / len(defined) if defined else math.nan
            average = Value(mean, cells=1, partial=any(v.state or v.partial for v in several))
            row += [show_value(v, metric) for v in [*means.values(), average]]
        rows.append(row)
    of = f"{groups[0]}-injected anomalies" if len(groups) == 1 else "by anomaly group"
    title = f"AUC (%), delay (steps), false-alarm rate, {of}, Δ = {horizon}"
    left_out = [str(e) for e in entries if e not in averaged]
    note = f"AVG is the mean without the trivial rows: {', '.join(left_out)}." if left_out else ""
    return Table(title, header, rows, labels=2, note=note)


def all_metrics(board: Board, *, intervals: bool = False) -> Table:
    """Return every metric without a level, mean over all cells, with nulls and the placebo."""
    names = _present(board, catalogue.METRICS) or [*catalogue.METRICS]
    columns = _overall(board, names, names if intervals else ())
    return _by_metric(board, "All metrics, mean over cells", columns)


def all_alarms(board: Board, *, intervals: bool = False) -> list[Table]:
    """Return guaranteed alarms at every level that records have, with their nulls."""
    tables = (guaranteed(board, s, intervals=intervals, nulls=True) for s in catalogue.LEVELS)
    return [table for table in tables if table]


def by_anomaly(
    board: Board, entry: Setting, metric: str = RANKING, *, intervals: bool = False
) -> Table:
    """Return one detector's metric by environment and anomaly."""
    rows = []
    for e in board.environments:
        columns = [_Mean(a, metric, [e], [a], intervals) for a in board.anomalies]
        rows.append([title_of(e), *_texts(board, entry, columns)])
    info = metric_info(metric)
    unit = " (%)" if info.unit == "percent" else ""
    title = f"{entry}: {info.title}{unit} by anomaly"
    return Table(title, ["Environment", *board.anomalies], rows)


def failures(board: Board) -> Table | None:
    """Return why fits failed; None when none did."""
    rows = [[r.environment, r.cell.label, r.status, r.reason] for r in board.failures()]
    header = ["environment", "detector", "state", "reason"]
    return Table("Failures", header, rows, labels=4) if rows else None


def ranking(ranks: RankedBoard, trust: Mapping[Setting, str]) -> Table:
    """Return ranks by matched AUC, with what a reader needs to judge them; trust is by row."""
    columns = _by_group(ranks.board, metric_info(RANKING).title, intervals=True)
    columns += _overall(ranks.board, ("auc_smoothed", "auc_unpaired", "auc", "auc_placebo"))
    rows = []
    for one in ranks.standings:
        rank, detector, settings = _labels(one)
        inputs = one.inputs.replace("observations+actions", "+actions") or UNDEFINED
        alarms = _place(one.alarm_rank, one)
        rows.append(
            [
                rank,
                one.ties or UNDEFINED,
                alarms,
                detector,
                settings,
                inputs,
                trust.get(one.entry, UNDEFINED),
                *_texts(ranks.board, one.entry, columns),
                _percent(one.wins),
            ]
        )
    header = [
        "rank",
        "ties",
        "alarm rank",
        "detector",
        "settings",
        "inputs",
        "trust",
        *(c.title for c in columns),
        "win rate",
    ]
    return Table("Ranking by matched AUC (%)", header, rows, labels=7)


def alarms(ranks: RankedBoard) -> list[Table]:
    """Return guaranteed alarms at the headline level, and alarms at the paper's threshold."""
    first = guaranteed(ranks.board, intervals=True, standings=ranks.standings)
    columns = _overall(ranks.board, _present(ranks.board, _PAPER))
    title = "Alarms at the paper's threshold"
    return [*filter(None, [first]), _by_metric(ranks.board, title, columns, ranks.standings)]


def cost(ranks: RankedBoard) -> Table:
    """Return seconds per fit, microseconds per scored step and peak memory."""
    rows = [[*_labels(one), *map(_digits, one.cost)] for one in ranks.standings]
    header = [*_LABELS, "fit (s)", "score (µs per step)", "peak memory (MB)"]
    return Table("Cost", header, rows, labels=3)


def wins(ranks: RankedBoard) -> Table | None:
    """Return in which share of cells the row beats the column; None with fewer than two rows."""
    labels = list(ranks.ranking.ranks)
    rates = {pair: _percent(rate) for pair, rate in ranks.rates.items()}
    rows = [[row, *(rates.get((row, other), "") for other in labels)] for row in labels]
    title = "Win rates: share of cells (%) in which the row's matched AUC is above the column's"
    return Table(title, ["detector", *labels], rows) if len(labels) > 1 else None


def findings(board: Board) -> list[str]:
    """Return a sentence for every detector that a simple row beats, in matched AUC or AUC.

    The AUC of what knows the time alone is left out: the clock's is 1 by construction.
    """
    sentences = []
    for entry, simple in itertools.product(board.entries, board.entries):
        own_kind = board.is_trivial(entry) or simple.detector == entry.detector
        if simple.detector not in _SIMPLE or simple.horizon != entry.horizon or own_kind:
            continue
        names = ("auc_matched",) if simple.detector in _BLIND else ("auc_matched", "auc")
        for info in map(metric_info, names):
            theirs, own, cells = board.compare(simple, entry, info.name)
            if theirs > own:
                sentences.append(
                    f"{simple} beats {entry} in mean {info.title}: {info.text(theirs)} against "
                    f"{info.text(own)} over {cells} cell{'s' if cells != 1 else ''}."
                )
    return sentences


def notes(board: Board) -> list[str]:
    """Return what has to stand below the tables of a board."""
    seeds = ", ".join(map(str, board.test_seeds()))
    facts = f"digest {board.digest[:12]}, protocol {board.protocol}"
    lines = [f"Split {board.split}, {facts}, test seeds per environment: {seeds}."]
    if board.limit is not None:
        lines.append(f"Limited to the first {board.limit} trajectories of each part: for trying.")
    benchmark = {*board.environments} <= {*ENVIRONMENTS}
    for group in filter(board.in_group, GROUPS) if benchmark else ():
        own = [a for a in TABLE1 if ANOMALIES[a].group == group]
        if missing := [a for a in own if a not in board.anomalies]:
            lines.append(f"Means over {group} anomalies are without {', '.join(missing)}.")
    if board.brief:
        names = ", ".join("/".join(place) for place in board.brief)
        lines.append(
            f"Brief cells, marked {_BRIEF}: {names}. Half of their episodes end within 20 rows of "
            "the onset."
        )
    if changed := sum(bool(r.provenance.get("git_dirty")) for r in board.records):
        lines.append(f"Made with uncommitted changes of oodd-eval's checkout: {changed} cells.")
    lines.append(
        f"Means over cells; {UNDEFINED} is undefined (no alarm, say), an empty field was not run, "
        "* marks a mean over fewer cells than other rows have. A failure is shown as its state."
    )
    return lines


def ranking_notes(ranks: RankedBoard) -> list[str]:
    """Return what has to stand below a ranking."""
    lines = [f"Not ranked: {one.entry}, {one.state}." for one in ranks.standings if one.state]
    if not all(one.primary for one in ranks.standings):
        lines.append(
            "A variant is a further row of a detector. It has the rank that it would have, and "
            "pushes no other row down."
        )
    if any(one.below for one in ranks.standings):
        lines.append(
            "Ranked are rows that maintainers have run again on seeds of their own. The others "
            "stand below, in brackets the rank that they would have, and push no row down."
        )
    if ranks.alarms.ranks:
        title = metric_info(catalogue.ALARM_RANKING).title
        lines.append(f"Alarm rank: the same by {title[0].lower()}{title[1:]}, lower is better.")
        without = (one for one in ranks.standings if one.alarm_state and not one.state)
        lines += [f"Without an alarm rank: {one.entry}, {one.alarm_state}." for one in without]
    seeds = ranks.board.test_seeds()
    if seeds and seeds[0] < _FEW and len(ranks.ranking.ranks) > 1:
        lines.append(
            f"With {seeds[0]} test seeds per environment small differences stay hidden: rows that "
            "share a letter may well differ."
        )
    return lines


def _by_metric(
    board: Board, title: str, columns: Sequence[_Mean], standings: Sequence[Standing] = ()
) -> Table:
    """Return columns with a row per detector, or per standing with its place."""
    labels = {one.entry: _labels(one) for one in standings} or {e: [str(e)] for e in board.entries}
    rows = [[*label, *_texts(board, entry, columns)] for entry, label in labels.items()]
    first = _LABELS if standings else ("detector",)
    return Table(title, [*first, *(c.title for c in columns)], rows, labels=len(first))


def _present(board: Board, names: Iterable[str]) -> list[str]:
    """Return the metrics that any record has."""
    found = {name for record in board.records for name in record.metrics}
    return [name for name in names if name in found]


def _labels(one: Standing) -> list[str]:
    """Return rank, detector (marked where it is trivial), and settings with the number of seeds."""
    overrides = [f"{k}={v}" for k, v in one.entry.overrides.items()]
    several = [f"{one.seeds} seeds"] if one.seeds > 1 else []
    return [
        _place(one.rank, one),
        one.entry.detector + " (trivial)" * one.trivial + " (variant)" * (not one.primary),
        ", ".join([f"Δ={one.entry.horizon}", *overrides, *several]),
    ]


def _place(rank: int | None, one: Standing) -> str:
    """Return a rank as printed: in brackets where it is the one that the row would have."""
    return UNDEFINED if rank is None else f"({rank})" if one.below else str(rank)


def _percent(rate: float) -> str:
    return UNDEFINED if math.isnan(rate) else f"{100 * rate:.0f}"


def _digits(value: float) -> str:
    """Return two significant digits, or the whole part of what is larger; at least 0.001."""
    if math.isnan(value):
        return UNDEFINED
    if 0 < value < 0.001:
        return "< 0.001"
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"
