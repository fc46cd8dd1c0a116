"""The tables of a board, and the sentences that stand beside them."""

import itertools
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

from oodd_eval.data.condition import NOMINAL
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, GROUPS, TABLE1, title_of
from oodd_eval.metrics import catalogue
from oodd_eval.metrics.bootstrap import nan_mean
from oodd_eval.metrics.catalogue import PAPER, UNDEFINED, metric_info
from oodd_eval.names import counted
from oodd_eval.plugins.contract import training_mark
from oodd_eval.results.board import Board, Value, grouped
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record
from oodd_eval.results.standings import RankedBoard, Standing
from oodd_eval.results.undefined import why_undefined

BRIEF: Final = "\N{DAGGER}"
"""Marks the figures of brief cells."""


@dataclass(frozen=True, slots=True)
class Table:
    """A titled table of texts, the first `labels` columns set to the left, with a note below it.

    On a terminal each row has the colour of its position in `colours`, if there are any, and
    `wrap` lets headings and names take several lines where the table is too wide.
    """

    title: str
    header: list[str]
    rows: list[list[str]]
    labels: int = 1
    note: str = ""
    colours: Sequence[str] = ()
    wrap: bool = False

    @property
    def alignment(self) -> tuple[str, ...]:
        """``"left"`` or ``"right"`` for every column, as tabulate takes it."""
        return tuple("left" if i < self.labels else "right" for i in range(len(self.header)))

    def columns(self, indices: Sequence[int]) -> "Table":
        """Return the table with these columns only."""
        rows = [[row[i] for i in indices] for row in self.rows]
        return replace(self, header=[self.header[i] for i in indices], rows=rows)

    def transposed(self) -> "Table":
        """Return the table with rows and columns exchanged.

        Of several labels a first one stands where it changes: a group of columns has its name once.
        """
        whole = [list(column) for column in zip(self.header, *self.rows, strict=True)]
        header = whole[0]
        if self.labels > 1:
            pairs = itertools.pairwise(header)
            header = [header[0], *("" if text == before else text for before, text in pairs)]
        return replace(self, header=header, rows=whole[1:], labels=1, colours=())


def show_value(value: Value, metric: str) -> str:
    """Return a mean as printed: a number, a dash where undefined, a failure's state, or nothing.

    A star marks a mean in which expected cells are missing, a dagger one of brief cells only.
    """
    if not value.cells:
        return ""
    number = metric_info(metric).text
    text = value.state or number(value.value)
    if not math.isnan(value.low):
        text += f" [{number(value.low)}, {number(value.high)}]"
    return text + "*" * value.partial + BRIEF * value.brief


class Mean(NamedTuple):
    """A column: the mean of a metric over some of a board's cells."""

    title: str
    metric: str
    environments: Sequence[str]
    anomalies: Sequence[str]
    intervals: bool = False


def texts(board: Board, entry: Setting, columns: Iterable[Mean]) -> list[str]:
    """Return a row's means as printed, one a column."""
    return [
        show_value(board.mean(entry, environments, anomalies, metric, intervals=intervals), metric)
        for _, metric, environments, anomalies, intervals in columns
    ]


def reasons(board: Board, entries: Iterable[Setting], columns: Iterable[Mean]) -> list[str]:
    """Return why rows have no figure in columns, a sentence for each reason."""
    rows = grouped(board.records, lambda r: r.setting)
    lacking: dict[str, dict[str, dict[str, None]]] = {}  # columns and rows by reason
    over = [(c, {*itertools.product(c.environments, c.anomalies)}) for c in columns]
    for entry, (column, cells) in itertools.product(entries, over):
        mean = board.mean(entry, column.environments, column.anomalies, column.metric)
        if mean.state or not math.isnan(mean.value):
            continue
        of_cells = (r for r in rows[entry] if (r.environment, r.anomaly) in cells)
        for reason in dict.fromkeys(why_undefined(r, column.metric) for r in of_cells):
            of_reason = lacking.setdefault(reason, {"columns": {}, "rows": {}})
            of_reason["columns"][column.title] = of_reason["rows"][str(entry)] = None
    return [
        f"Undefined for {_listed(of, 'rows')}: {_listed(of, 'columns')} ({reason})."
        for reason, of in lacking.items()
        if reason
    ]


def _listed(names: Mapping[str, Collection[str]], kind: str) -> str:
    """Return the names of a kind one after the other, or how many they are."""
    chosen = names[kind]
    return ", ".join(chosen) if len(chosen) <= _NAMED else f"{len(chosen)} {kind}"


_NAMED: Final = 8  # names in a sentence, beyond which it has their number

BLIND: Final = ("clock", "comb")  # know the time alone: their AUC says nothing of dynamics

_SIMPLE: Final = (
    "random",
    "persistence",
    *BLIND,
    "range",
    "mahalanobis",
    "manifold",
    "rf",
    "rf-ewma",
)
"""Rows that a detector with a learned model of the dynamics should beat."""

_FEW: Final = 30  # test seeds per environment below which a board calls comparisons weak

_ALARMS: Final = (
    "delay_censored",
    "missed",
    *(f"found_within_{k}" for k in catalogue.FOUND_WITHIN),
    f"found_within_{catalogue.FOUND_WITHIN[-1]}_null",
    "false_episodes",
    "early",
)
"""Columns of a table of guaranteed alarms. The null of the longest span is the largest."""

_PAPER: Final = ("delay", "delay_null", "delay_censored", "missed", "far", "far_twin")
"""Columns of the paper's alarm."""

_PAPERS_NULLS: Final = ("delay_null", "far_twin")

_LABELS: Final = ("rank", "detector", "settings")


def _by_group(board: Board, title: str, *, intervals: bool) -> list[Mean]:
    """Return the metric that ranks over all cells, and over each group of anomalies."""
    chosen = {title: board.anomalies} | board.groups
    return [Mean(t, board.ranking, board.environments, a, intervals) for t, a in chosen.items()]


def over_all(
    board: Board, names: Iterable[str], intervals: Collection[str] = (), *, short: bool = False
) -> list[Mean]:
    """Return columns of means over all cells; `short` where a heading names alarm or level."""
    infos = map(metric_info, names)
    titles = {info.name: info.noun if short else info.title for info in infos}
    over = board.environments, board.anomalies
    return [Mean(title, n, *over, n in intervals) for n, title in titles.items()]


def separability(board: Board, *, intervals: bool = False) -> Table:
    """Return matched AUC by anomaly group and by environment, the best mean first.

    Beside the mean over all cells stand that of smoothed scores and that against another twin,
    where records have them.
    """
    columns = _by_group(board, "mean", intervals=intervals)
    over = board.environments, board.anomalies
    present = board.present(_BESIDE_MATCHED)
    columns += [Mean(name.removeprefix("auc_"), name, *over, intervals) for name in present]
    columns += [Mean(e, board.ranking, [e], board.anomalies, intervals) for e in board.environments]
    entries = best_first(board)
    rows = [[str(entry), *texts(board, entry, columns)] for entry in entries]
    title = "Separability: matched AUC (%), higher is better. The leaderboard ranks by this."
    beside = {c.title: c.metric for c in columns if c.metric in present}
    notes = [explained(beside), unranked(board), *reasons(board, entries, columns)]
    note = " ".join(filter(None, notes))
    return Table(title, ["detector", *(c.title for c in columns)], rows, note=note)


_BESIDE_MATCHED: Final = ("auc_smoothed", "auc_unpaired")


def unranked(board: Board) -> str:
    """Return a note on the rows that no board ranks, for what they know; empty without one."""
    marks = {str(r.setting): training_mark(r.training) for r in board.records}
    known = [f"{row} ({mark})" if mark != row else row for row, mark in marks.items() if mark]
    return f"Not ranked, for what they know: {', '.join(known)}." if known else ""


def best_first(board: Board) -> list[Setting]:
    """Return the rows of a board by their mean of the metric that ranks them, the best first."""
    over = board.environments, board.anomalies
    means = {entry: board.mean(entry, *over, board.ranking).value for entry in board.entries}
    return sorted(means, key=lambda e: math.inf if math.isnan(means[e]) else -means[e])


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
    levels = [level for level in catalogue.LEVELS if board.present([f"false_episodes_{level}"])]
    strictest = catalogue.HEADLINE if catalogue.HEADLINE in levels or not levels else levels[-1]
    asked, suffix = suffix or catalogue.HEADLINE, suffix or strictest
    bases = _ALARMS if not nulls else catalogue.GUARANTEED
    names = board.present(f"{name}_{suffix}" for name in bases)
    if not names:
        return None
    with_ends = [n for n in names if intervals or metric_info(n).interval == "exact"]
    columns = over_all(board, names, with_ends, short=True)
    level = f"{100 * catalogue.LEVELS[suffix]:g} %"
    hours = f"false_alarms_per_hour_{suffix}"
    hourly = f"{metric_info(hours).noun}, " * (hours in names)
    steps = "delays in steps, " * any(name.startswith("delay") for name in names)
    units = f"{steps}{hourly}the rest in %" if steps or hourly else "%"
    title = f"Guaranteed alarms at {level} ({units})"
    episodes = "nominal twins" if board.paired else "nominal test episodes"
    note = (
        f"The threshold promises an alarm in at most {level} of nominal episodes; false episodes "
        f"is the share of this split's {episodes} that raised one."
    )
    if f"delay_censored_{suffix}" in names:
        note = f"{note} {CENSORED}"
    if asked != suffix:
        note = " ".join([note, *lowered_level(board, asked, suffix)])
    return by_metric(board, title, columns, standings, note)


CENSORED: Final = "Delay censored counts a miss as the whole remainder of its episode."
"""Sentence below each table with the delay that ranks."""


def missing_level(board: Board, suffix: str) -> list[str]:
    """Return how many calibration episodes a level takes that rows have no figures at."""
    level = f"guaranteed alarms at {100 * catalogue.LEVELS[suffix]:g} %"
    column = Mean(level, f"false_episodes_{suffix}", board.environments, board.anomalies)
    return reasons(board, board.entries, [column])


def lowered_level(board: Board, asked: str, level: str) -> list[str]:
    """Return which rows have no figures at a level, and that another stands for all rows."""
    lacking = missing_level(board, asked)
    if level != asked and lacking:
        lacking.append(f"So all rows are shown at {100 * catalogue.LEVELS[level]:g} %.")
    return lacking


def papers(board: Board, standings: Sequence[Standing] = (), *, intervals: bool = False) -> Table:
    """Return what the paper's alarm does, mean over cells, under a heading of its own."""
    names = board.present(_PAPER)
    columns = over_all(board, names, names if intervals else (), short=True)
    note = explained({c.title: c.metric for c in columns if c.metric in _PAPERS_NULLS})
    title = f"{PAPER} (delays in steps, the rest as shares)"
    return by_metric(board, title, columns, standings, note)


def explained(columns: Mapping[str, str]) -> str:
    """Return what columns show, from the catalogue's summaries of their metrics."""
    meanings = (f"{title} = {metric_info(metric).meaning}" for title, metric in columns.items())
    return f"{'; '.join(meanings)}." if columns else ""


def attribution(
    board: Board, *, intervals: bool = False, standings: Sequence[Standing] = ()
) -> Table | None:
    """Return what detectors that explain say at their guaranteed alarms; None without any."""
    explaining = {r.setting for r in board.records if r.metrics.keys() & {*catalogue.ATTRIBUTION}}
    if not explaining:
        return None
    names = catalogue.ATTRIBUTION
    if not standings:
        board = Board([r for r in board.records if r.setting in explaining])
    columns = over_all(board, names, names if intervals else (), short=True)
    title = f"Attribution at {metric_info(names[0]).level} (onset error in rows, the rest in %)"
    note = (
        "Of the detectors that explain their scores, at the first guaranteed alarm: how often the "
        "sensor that they name first is a corrupted one, over sensor anomalies, and how far the "
        "onset that they name is from the effect, the median of a cell."
    )
    ranks = [standing for standing in standings if standing.entry in explaining]
    return by_metric(board, title, columns, ranks, note)


def anomaly_groups(board: Board, *, intervals: bool = False) -> list[Table]:
    """Return AUC, delay and false-alarm rate by environment: the paper's Table 5.

    There is a table for each horizon and group of anomalies, and none where records lack all three.
    """
    if not board.present(("auc", "delay", "far")):
        return []
    groups = filter(board.in_group, GROUPS)
    everything = itertools.product(board.horizons, groups)
    return [_anomaly_group(board, h, group, intervals=intervals) for h, group in everything]


def _anomaly_group(board: Board, horizon: int, group: str, *, intervals: bool) -> Table:
    """Return one of them; AVG is over detectors, without trivial rows where there are others."""
    entries = [e for e in board.entries if e.horizon == horizon]
    averaged = [e for e in entries if not board.is_trivial(e)] or entries
    rows = []
    for environment, metric in itertools.product(board.environments, ("auc", "delay", "far")):
        over = [environment], board.in_group(group), metric
        means = {e: board.mean(e, *over, intervals=intervals) for e in entries}
        partial = any(means[e].state or means[e].partial for e in averaged)
        average = Value(nan_mean(means[e].value for e in averaged), cells=1, partial=partial)
        labels = [title_of(environment), metric_info(metric).short]
        rows.append([*labels, *(show_value(v, metric) for v in (*means.values(), average))])
    title = f"{PAPER}. AUC (%), delay (steps), false-alarm rate (FAR), {group}, Δ = {horizon}"
    # The title says the horizon.
    header = ["Environment", "Result", *(str(replace(e, horizon=1)) for e in entries), "AVG"]
    left_out = [str(e) for e in entries if e not in averaged]
    note = f"AVG is the mean without the trivial rows: {', '.join(left_out)}." if left_out else ""
    if len(board.environments) == 1:  # the title says it
        title += f", {title_of(board.environments[0])}"
        return Table(title, header[1:], [row[1:] for row in rows], labels=1, note=note)
    return Table(title, header, rows, labels=2, note=note)


def all_metrics(board: Board, *, intervals: bool = False) -> Table:
    """Return every metric without an alarm, mean over all cells, with nulls and the placebo."""
    usual = [n for n, info in catalogue.METRICS.items() if info.cells != "unpaired"]
    names = board.present(catalogue.METRICS) or usual
    infos = map(metric_info, names)
    names = [info.name for info in infos if not info.request and not info.paper]
    columns = over_all(board, names, names if intervals else ())
    return by_metric(board, "All metrics of separability (%), mean over cells", columns)


def all_alarms(board: Board, *, intervals: bool = False) -> list[Table]:
    """Return guaranteed alarms at every level that records have, with their nulls."""
    tables = (guaranteed(board, s, intervals=intervals, nulls=True) for s in catalogue.LEVELS)
    return [table for table in tables if table]


def by_anomaly(board: Board, entry: Setting, metric: str = "", *, intervals: bool = False) -> Table:
    """Return one detector's metric by environment and anomaly, by default the one that ranks."""
    metric = metric or board.ranking
    rows, columns = [], []
    for e in board.environments:
        of_environment = [Mean(a, metric, [e], [a], intervals) for a in board.anomalies]
        rows.append([title_of(e), *texts(board, entry, of_environment)])
        columns += of_environment
    note = " ".join(reasons(board, [entry], columns))
    info = metric_info(metric)
    unit = " (%)" if info.unit == "percent" else ""
    title = f"{entry}: {info.title}{unit} by anomaly"
    header = ["Environment", *board.anomalies]
    return Table(title, header, rows, note=note, wrap=not board.paired)


def failures(board: Board) -> Table | None:
    """Return why fits failed; None when none did."""
    rows = [[r.environment, r.cell.label, r.status, r.reason] for r in board.failures()]
    header = ["environment", "detector", "state", "reason"]
    return Table("Failures", header, rows, labels=4) if rows else None


def ranking(ranks: RankedBoard, trust: Mapping[Setting, str]) -> Table:
    """Return ranks by separability, with what a reader needs to judge them; trust is by row."""
    title = metric_info(ranks.board.ranking).title
    columns = _by_group(ranks.board, title, intervals=True)
    beside: Sequence[str] = ("auc_smoothed", "auc_unpaired", "auc", "auc_placebo")
    if not ranks.board.paired:
        beside = ranks.board.present(n for n in _BESIDE if n != ranks.board.ranking)
    columns += over_all(ranks.board, beside)
    rows = []
    for row in ranks.standings:
        rank, detector, settings = _labels(row)
        inputs = row.inputs.replace("observations+actions", "+actions") or UNDEFINED
        labels = [rank, row.ties or UNDEFINED, row.printed(row.alarm_rank), detector, settings]
        labels += [inputs, trust.get(row.entry, UNDEFINED)]
        means = texts(ranks.board, row.entry, columns)
        rows.append([*labels, *means, _percent(row.wins), row.lead or UNDEFINED])
    labels = ["rank", "ties", "alarm rank", "detector", "settings", "inputs", "trust"]
    header = [*labels, *(c.title for c in columns), "win rate", "lead"]
    return Table(f"Ranking by {title} (%)", header, rows, labels=7)


_BESIDE: Final = ("auc_pool_null", "auc_rows", "auc_outcome")
"""Columns beside the metric that ranks rows without twins."""


def cost(ranks: RankedBoard) -> Table:
    """Return seconds per fit, microseconds per scored step and peak memory."""
    rows = [[*_labels(row), *map(_digits, row.cost)] for row in ranks.standings]
    header = [*_LABELS, "fit (s)", "score (µs per step)", "peak memory (MB)"]
    return Table("Cost", header, rows, labels=3)


def wins(ranks: RankedBoard) -> Table | None:
    """Return in which share of cells the row beats the column; None with fewer than two rows."""
    labels = list(ranks.ranking.ranks)
    rates = {pair: _percent(rate) for pair, rate in ranks.rates.items()}
    rows = [[row, *(rates.get((row, column), "") for column in labels)] for row in labels]
    metric = metric_info(ranks.board.ranking).title
    title = f"Win rates: share of cells (%) in which the row's {metric} is above the column's"
    return Table(title, ["detector", *labels], rows) if len(labels) > 1 else None


def findings(board: Board) -> list[str]:
    """Return a sentence where a simple row has a higher mean than a detector: matched AUC or AUC.

    The AUC of what knows the time alone is left out: the clock's is 1 by construction.
    Without twins it is the metric that ranks.
    """
    sentences = []
    for entry, simple in itertools.product(board.entries, board.entries):
        same_kind = board.is_trivial(entry) or simple.detector == entry.detector
        if simple.detector not in _SIMPLE or simple.horizon != entry.horizon or same_kind:
            continue
        names = [board.ranking]
        names += ["auc"] * (board.paired and simple.detector not in BLIND)
        for info in map(metric_info, names):
            value, lower, cells = board.compare(simple, entry, info.name)
            if value > lower:
                sentences.append(
                    f"{simple} has a higher mean {info.title} than {entry}: {info.text(value)} "
                    f"against {info.text(lower)} over {counted(cells, 'cell(s)')}."
                )
    return sentences


def withheld(board: Board) -> list[str]:
    """Return what records say of themselves, such as why they have no matched AUC."""
    cells = grouped((r for r in board.records if r.note), lambda r: r.note)
    return [
        f"{', '.join(dict.fromkeys('/'.join(r.position) for r in records))} "
        f"({', '.join(dict.fromkeys(str(r.setting) for r in records))}): {note}."
        for note, records in cells.items()
    ]


def notes(board: Board) -> list[str]:
    """Return what has to stand below the tables of a board."""
    seeds = ", ".join(map(str, board.test_seeds()))
    facts = f"digest {board.digest[:12]}, protocol {board.protocol}"
    lines = [f"Split {board.split}, {facts}, test seeds per environment: {seeds}."]
    if not board.paired:
        lines = [f"Split {board.split}, {facts}, episodes without twins.", *_episodes(board)]
    if board.limit is not None:
        first = counted(board.limit, "trajector(y/ies)")
        lines.append(f"Limited to the first {first} of each part: for trying.")
    cells = {(r.environment, r.anomaly, r.strength) for r in board.records}
    if len(cells) > len({cell[:2] for cell in cells}):
        lines.append(
            "Anomalies have several strengths: means are over all of them, but for columns that "
            "are named by strengths."
        )
    benchmark = board.paired and {*board.environments} <= {*ENVIRONMENTS}
    for group in filter(board.in_group, GROUPS) if benchmark else ():
        of_group = [a for a in TABLE1 if ANOMALIES[a].group == group]
        if missing := [a for a in of_group if a not in board.anomalies]:
            lines.append(f"Means over {group} anomalies are without {', '.join(missing)}.")
    if board.brief:
        names = ", ".join("/".join(cell) for cell in board.brief)
        lines.append(
            f"Brief cells, marked {BRIEF}: {names}. Half of their episodes end within 20 rows of "
            "the onset."
        )
    lines += uncalibrated(board)
    if changed := sum(bool(r.provenance.get("git_dirty")) for r in board.records):
        dirty = counted(changed, "cell(s)")
        lines.append(f"Made with uncommitted changes of oodd-eval's checkout: {dirty}.")
    lines.append(
        f"Means over cells; {UNDEFINED} is undefined, an empty field was not run, * marks a mean "
        "over fewer cells than the split has there. A failure is shown as its state."
    )
    return lines


def uncalibrated(board: Board) -> list[str]:
    """Return which rows' alarms have intervals without the noise of the calibration episodes."""
    lacking = dict.fromkeys(str(r.setting) for r in board.records if _lacks_draws(r))
    if not lacking:
        return []
    have = [str(entry) for entry in board.entries if str(entry) not in lacking]
    named = ", ".join(lacking)
    if len(have) < len(lacking):
        named = f"all rows but {', '.join(have)}" if have else "all rows"
    sentence = "Intervals of alarms, and ranks by them, leave out the noise of the calibration"
    return [f"{sentence} episodes where records of earlier versions do not say it: {named}."]


def _lacks_draws(record: Record) -> bool:
    alarms = "far" in record.metrics or any("false_episodes" in name for name in record.metrics)
    return alarms and not record.calibration_draws


def _episodes(board: Board) -> list[str]:
    """Return how many episodes each environment without twins has."""
    lines = []
    for environment in board.environments:
        cells = [r for r in board.records if r.environment == environment and r.ok]
        counts = {name: n for r in cells for name, n in r.counts.items()}
        tests = {str(r.condition): r.counts.get("test", 0) for r in cells if r.condition != NOMINAL}
        listed = [f"{n} {name}" for name, n in tests.items()]
        named = [f"{counts[k]} {text}" for k, text in _PARTS.items() if k in counts]
        lines.append(f"Episodes of {environment}: {', '.join([*named, *listed])}.")
    return lines


_PARTS: Final = {"train": "training", "calibration": "calibration", "nominal": "nominal test"}


def ranking_notes(
    ranks: RankedBoard, *, whole: bool = True, rows: Sequence[Standing] = ()
) -> list[str]:
    """Return what has to stand below a ranking.

    Not `whole` is one without columns of lead and alarms and without text above it. `rows` are
    those that are printed, by default all.
    """
    rows = rows or ranks.standings
    lines = [] if whole else [_RANK]
    lines += [f"Not ranked: {row.entry}, {row.state}." for row in rows if row.state]
    if not all(row.primary for row in rows):
        lines.append(
            "A variant is a further row of a detector. It has the rank that it would have, and "
            "pushes no other row down."
        )
    if any(row.clone_of for row in rows):
        lines.append(
            "A row with = and another's name has that row's scores. It has the same rank, and "
            "pushes no other row down."
        )
    if any(row.training not in {"nominal", "oracle"} for row in rows):
        lines.append("Rows trained on more than nominal trajectories of the split are not ranked.")
    if any(row.training == "oracle" for row in rows):
        lines.append(
            "An oracle has the true equations of the environment. It says how far the limit is, "
            "and is not ranked."
        )
    if any(row.below for row in rows):
        lines.append(
            "Ranked are rows that maintainers have run again on seeds of their own. The others "
            "stand below, in brackets the rank that they would have, and push no row down."
        )
    if whole and any(row.lead for row in rows):
        lines.append(
            "Lead: in how many of the cases in which one environment is left out the row's mean "
            "stays above that of the next rank."
        )
    if ranks.alarms.ranks:
        info = metric_info(ranks.board.alarm_ranking)
        if whole:
            lines.append(f"Alarm rank: the rank by {info.phrase}, {info.better} is better.")
        without = (row for row in rows if row.alarm_state and not row.state)
        lines += [f"Without an alarm rank: {row.entry}, {row.alarm_state}." for row in without]
        lines += uncalibrated(ranks.board)
    seeds = ranks.board.test_seeds()
    if seeds and seeds[0] < _FEW and len(ranks.ranking.ranks) > 1:
        episodes = "test seeds per environment" if ranks.board.paired else "anomalous episodes"
        lines.append(
            f"With {seeds[0]} {episodes} small differences stay hidden: rows that "
            "share a letter may well differ."
        )
    return lines


_RANK: Final = (
    "Rank is 1 + the number of primary rows that are significantly better, so ranks need not "
    "follow the means."
)


def by_metric(
    board: Board,
    title: str,
    columns: Sequence[Mean],
    standings: Sequence[Standing] = (),
    note: str = "",
) -> Table:
    """Return columns with a row per detector, or per standing with its place."""
    labels = {row.entry: _labels(row) for row in standings} or {e: [str(e)] for e in board.entries}
    rows = [[*label, *texts(board, entry, columns)] for entry, label in labels.items()]
    first = _LABELS if standings else ("detector",)
    header = [*first, *(c.title for c in columns)]
    note = " ".join(filter(None, [note, *reasons(board, labels, columns)]))
    return Table(title, header, rows, labels=len(first), note=note, wrap=not board.paired)


def _labels(row: Standing) -> list[str]:
    """Return rank, detector (marked where it is trivial), and settings with the number of seeds."""
    overrides = [f"{k}={v}" for k, v in row.entry.overrides.items()]
    several = [f"{row.seeds} seeds"] if row.seeds > 1 else []
    settings = ", ".join([f"Δ={row.entry.horizon}", *overrides, *several])
    return [row.printed(row.rank), row.entry.detector + row.marks, settings]


def _percent(rate: float) -> str:
    return UNDEFINED if math.isnan(rate) else f"{100 * rate:.0f}"


def _digits(value: float) -> str:
    """Return two significant digits, or the whole part of what is larger; at least 0.001."""
    if math.isnan(value):
        return UNDEFINED
    if 0 < value < 0.001:
        return "< 0.001"
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"
