"""The tables of a board, and the sentences that stand beside them."""

import functools
import itertools
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

from oodd_eval.data.condition import NOMINAL
from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, GROUPS, TABLE1, title_of
from oodd_eval.metrics import catalogue
from oodd_eval.metrics.alarms import missing_level as _too_few
from oodd_eval.metrics.alarms import no_promise, offered_levels
from oodd_eval.metrics.bootstrap import nan_mean
from oodd_eval.metrics.catalogue import PAPER, UNDEFINED, metric_info
from oodd_eval.metrics.unpaired import OUTCOME_UP_TO
from oodd_eval.names import counted
from oodd_eval.plugins.contract import training_mark
from oodd_eval.prose import Table
from oodd_eval.results.board import Board, Column, Value, cells_with, grouped
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record

BRIEF: Final = "\N{DAGGER}"
"""Marks the figures of brief cells."""

UNPROMISED: Final = "\N{DOUBLE DAGGER}"
"""Marks columns of alarms whose level too few recordings promise nothing at."""

SUPERVISED: Final = "\N{SECTION SIGN}"
"""Marks rows that learn from failures, which stand below the others."""


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


def marked(board: Board, entry: Setting) -> str:
    """Return a row's name with the mark of its band."""
    return f"{entry}{f' {SUPERVISED}' * (entry in board.supervised)}"


def texts(board: Board, entry: Setting, columns: Iterable[Column]) -> list[str]:
    """Return a row's means as printed, one a column."""
    return [show_value(board.of(entry, column), column.metric) for column in columns]


def reasons(board: Board, entries: Iterable[Setting], columns: Iterable[Column]) -> list[str]:
    """Return why rows have no figure in columns, a sentence for each reason."""
    return [
        f"Undefined for {_listed(rows, 'rows')}: {_listed(columns, 'columns')} ({reason})."
        for reason, (rows, columns) in _lacking(board, entries, columns).items()
    ]


def _lacking(
    board: Board, entries: Iterable[Setting], columns: Iterable[Column]
) -> dict[str, tuple[dict[str, None], dict[str, None]]]:
    """Return the rows and the columns without a figure by the reason for it."""
    rows = grouped(board.records, lambda r: r.setting)
    lacking: dict[str, tuple[dict[str, None], dict[str, None]]] = {}
    for entry, column in itertools.product(entries, list(columns)):
        mean = board.of(entry, column._replace(intervals=False))
        if mean.state or not math.isnan(mean.value):
            continue
        for r in rows[entry]:
            if column.environments and r.environment not in column.environments:
                continue
            if column.anomalies and r.anomaly not in column.anomalies:
                continue
            if reason := why_undefined(r, column.metric):
                of_reason = lacking.setdefault(reason, ({}, {}))
                of_reason[0][str(entry)] = of_reason[1][column.title] = None
    return lacking


def _listed(names: Collection[str], kind: str) -> str:
    """Return names one after the other, or how many they are."""
    return ", ".join(names) if len(names) <= _NAMED else f"{len(names)} {kind}"


_NAMED: Final = 8  # names in a sentence, beyond which it has their number

BLIND: Final = ("clock", "comb")  # know the time alone: their AUC says nothing of dynamics

_SIMPLE: Final = (
    *("random", "persistence", *BLIND, "range", "mahalanobis", "manifold", "rf", "rf-ewma"),
)
"""Rows that a detector with a learned model of the dynamics should beat."""

CLOCK: Final = "clock"  # the row that knows the phase of an episode and nothing else

PAPERS: Final = ("delay", "delay_null", "delay_censored", "missed", "far", "far_twin")
_PAPERS_NULLS: Final = ("delay_null", "far_twin")

POOLED: Final = ("auc_pool", "auc_pool_null", "auc_rows")
"""Metrics of rows that are known to be anomalous, in the order of the headline's columns."""

OUTCOME: Final = "auc_outcome"
"""Metric of episodes that are known by their outcome alone."""

WHOLE: Final = "auc_outcome_whole"
"""The same of whole episodes, whose length alone tells failures."""

BRIER: Final = "brier_outcome"
"""Metric of rows that learn from failures and say probabilities."""

ALARMS_OF_OUTCOMES: Final = tuple(name for name in catalogue.GUARANTEED if "outcome" in name)
"""Metrics of alarms of such episodes, without the suffix of a level."""

WORST: Final = "worst environment"
"""Heading of the column that has the environment in which a row is worst."""

MOST_NOTES: Final = 3
"""Notes below the table that a run ends with."""

_ALARMS_OF_LOGS: Final = (
    *("events_found", "delay_censored", f"found_within_{catalogue.FOUND_WITHIN[-1]}", "missed"),
    *("false_episodes", "early", "false_alarms_per_hour"),
)

ROWS: Final = tuple(name for name, info in catalogue.METRICS.items() if info.request)
"""Metrics of published tables, which rank nothing."""


@dataclass(frozen=True)
class Tables:
    """The tables of means of a board: each is a list of columns, and leaves out what no record has.

    Attributes
    ----------
    board
        The board.
    intervals
        Whether means have their 95 % intervals; false episodes always have.
    labels, label_names
        What stands before each row's figures, and the headings of that; by default its name. The
        rows have this order, by default the best mean first.
    level
        Suffix of the level of guaranteed alarms, by default the board's, or the strictest that
        its records have.
    """

    board: Board
    intervals: bool = False
    labels: Mapping[Setting, Sequence[str]] = field(default_factory=dict)
    label_names: Sequence[str] = ("detector",)
    level: str = ""

    def label(self, entry: Setting) -> Sequence[str]:
        """Return the texts before a row's figures."""
        return self.labels.get(entry, [marked(self.board, entry)])

    def headline(self) -> Table | None:
        """Return the columns that stand first everywhere, a row per detector.

        They are the metric that ranks with its interval, the worst environment (with one
        environment a column an anomaly), and found, missed and false episodes of guaranteed alarms.
        Where it is too wide, the worst anomaly stands for all. None when no record has any of them.
        """
        board, metric = self.board, self.board.ranking
        lacking = board.leaves_out([metric]) if board.paired else not self._present([metric])
        first = [] if lacking else [Column(metric, _heading(metric), intervals=True)]
        alarms = self.columns(self._at_level(*(_OUTCOMES if metric == OUTCOME else _FIRST)))
        if not first and not alarms:
            return None
        compared = [e for e in board.environments if self._present([metric], [e])]
        places, several = [Column(metric, e, [e]) for e in compared], len(compared) > 1
        if not several:
            of_kind = grouped(board.records, lambda r: r.anomaly)
            kinds = [kind for kind in board.anomalies if cells_with(metric, of_kind[kind])]
            places = [Column(metric, kind, anomalies=[kind]) for kind in kinds]
        titles = [metric_info(metric).title] * bool(first)
        titles += [f"guaranteed alarms at {percent_of(self.suffix)}"] * bool(alarms)
        title = f"{' and '.join(titles)} (%)"
        one_each = [] if several or not 1 < len(places) <= len(TABLE1) else places
        note = "\n".join(self._essentials(first, places, alarms)[:MOST_NOTES])
        wide, short = (
            replace(
                self.table(title[0].upper() + title[1:], columns),
                note=note,
                undivided=not self.intervals,
            )
            for columns in ([*first, *one_each, *alarms], [*first, *alarms])
        )
        if first and len(places) > 1:
            worst = [board.worst(entry, places) or ("", Value()) for entry in self.order]
            cells = [f"{where} {show_value(mean, metric)}".strip() for where, mean in worst]
            cells.insert(0, WORST if several else "worst anomaly")
            for row, text in zip((short.header, *short.rows), cells, strict=True):
                row.insert(short.labels + 1, text)
        return replace(wide, narrower=[short]) if one_each else short

    def _essentials(
        self, first: Sequence[Column], places: Sequence[Column], alarms: Sequence[Column]
    ) -> list[str]:
        """Return what has to be known to read the headline, the most important first."""
        board, metric, usual = self.board, self.board.ranking, self.level or catalogue.HEADLINE
        text = " ".join(t for e in self.order for t in texts(board, e, [*first, *places, *alarms]))
        undefined = ", ".join(_lacking(board, self.order, [*first, *alarms])) or "undefined"
        legend = [f"{mark}: {why}" for mark, why in _MARKS.items() if mark in text]
        legend += [f"{UNDEFINED}: {undefined}"] * (UNDEFINED in text)
        promises = {unpromised(r, self.suffix) for r in board.records if r.ok}
        legend += [f"{UNPROMISED}: {why}" for why in sorted(promises) if why]
        legend += [f"{SUPERVISED}: learns from failures"] * bool(board.supervised)
        knowing = {str(r.setting): None for r in board.records if r.training not in _RANKED}
        legend += [f"not ranked, for what they know: {', '.join(knowing)}"] * bool(knowing)
        few = next(iter(_lacking(board, self.order, [Column(f"false_episodes_{usual}")])), "")
        promise = "; no share of them is promised"
        if "" in promises:
            promise = f"; the threshold promises at most {percent_of(self.suffix)}"
            promise += f" ({few.partition(',')[0]})" * (self.suffix != usual)
        notes = [
            f"The first {counted(board.limit or 0, _PART)}: for trying." * bool(board.limit),
            f"{'; '.join(legend)}." * bool(legend),
            f"{_FALSE}{promise}." if alarms else _joined(*missing_level(board, usual)),
            f"{metric_info(metric).title}: {_MEANINGS[metric]}; 50 is chance." * bool(first),
            "Means are over all strengths." * _has_strengths(board),
            _FINDS * any(column.metric.startswith("missed") for column in alarms),
        ]
        return [f"{note[0].upper()}{note[1:]}" for note in notes if note]

    @functools.cached_property
    def suffix(self) -> str:
        """The level of guaranteed alarms: the one asked for, the board's, or the strictest."""
        levels = self.board.present(f"false_episodes_{level}" for level in catalogue.LEVELS)
        usual = f"false_episodes_{self.board.level}"
        strictest = usual if usual in levels or not levels else levels[-1]
        return self.level or strictest.removeprefix("false_episodes_")

    def separability(self) -> Table | None:
        """Return the metric that ranks by anomaly group and by environment; None without any."""
        board, metric = self.board, self.board.ranking
        compared = [e for e in board.environments if self._present([metric], [e])]
        places = [Column(metric, e, [e]) for e in compared * (board.paired or len(compared) > 1)]
        columns = [*by_group(board, "mean"), *places]
        title = metric_info(metric).title
        title = f"{title[0].upper()}{title[1:]} (%) by group and environment"
        enough = bool(compared) and len(columns) > 1
        return self.table(title, self._with_ends(columns), unranked(board)) if enough else None

    def all_alarms(self) -> list[Table]:
        """Return guaranteed alarms at every level that records have, with their nulls."""
        levels = [replace(self, level=suffix) for suffix in catalogue.LEVELS]
        return [table for of_level in levels if (table := of_level.guaranteed())]

    def guaranteed(self) -> Table | None:
        """Return guaranteed alarms at the level of the tables; None when no record has them."""
        columns = self.columns(self._at_level(*catalogue.GUARANTEED))
        if not columns:
            return None
        names = [column.metric for column in columns]
        hours, *censored = self._at_level("false_alarms_per_hour", "delay_censored")
        hourly = f"{metric_info(hours).noun}, " * (hours in names)
        steps = "delays in steps, " * any(metric_info(name).unit == "steps" for name in names)
        units = f"{steps}{hourly}the rest in %" if steps or hourly else "%"
        note = CENSORED if {*censored} <= {*names} else ""
        title = f"Guaranteed alarms at {percent_of(self.suffix)} ({units})"
        return self.table(title, columns, note)

    def seeds(self) -> Table | None:
        """Return the means of the lowest and the highest detector seed; None with one seed each."""
        board, metric = self.board, self.board.ranking
        means = {entry: board.seed_means(entry, metric) for entry in self.order}
        info = metric_info(metric)
        rows = [
            [*self.label(e), str(len(m)), *map(info.text, (min(m), max(m)))]
            for e, m in means.items()
            if len(m) > 1
        ]
        header = [*self.label_names, "seeds", "lowest", "highest"]
        title = f"{info.title[0].upper()}{info.title[1:]} by detector seed (%)"
        return Table(title, header, rows, len(self.label_names), _FIXED) if rows else None

    def papers(self) -> Table:
        """Return what the paper's alarm does, mean over cells, under a heading of its own."""
        columns = self.columns(PAPERS)
        note = explained({c.title: c.metric for c in columns if c.metric in _PAPERS_NULLS})
        return self.table(f"{PAPER} (delays in steps, the rest as shares)", columns, note)

    def attribution(self) -> Table | None:
        """Return what detectors that explain say at their guaranteed alarms; None without any."""
        names = {*catalogue.ATTRIBUTION}
        records = [r for r in self.board.records if r.metrics.keys() & names]
        if not records:
            return None
        explaining = {r.setting for r in records}
        columns, level = self.columns(catalogue.ATTRIBUTION), metric_info(min(names)).level
        title = f"Attribution at {level} (onset error in rows, the rest in %)"
        return self.table(title, columns, _ATTRIBUTION, [e for e in self.order if e in explaining])

    def all_metrics(self) -> Table:
        """Return every metric without an alarm, mean over all cells, with nulls and the placebo."""
        usual = [n for n, info in catalogue.METRICS.items() if info.cells != "unpaired"]
        infos = map(metric_info, self.board.present(catalogue.METRICS) or usual)
        printed = [i for i in infos if i.unit == "percent" and not i.request and not i.paper]
        columns = [Column(info.name, info.title, intervals=self.intervals) for info in printed]
        return self.table("All metrics of separability (%), mean over cells", columns)

    def anomaly_groups(self) -> list[Table]:
        """Return AUC, delay and false-alarm rate by environment: the paper's Table 5.

        There is a table for each horizon and group of anomalies, none where records lack all three.
        """
        groups = [*filter(self.board.in_group, GROUPS)] if self.board.present(_TABLE_5) else []
        return [self._anomaly_group(h, g) for h in self.board.horizons for g in groups]

    def _anomaly_group(self, horizon: int, group: str) -> Table:
        """Return one of them; AVG is over detectors, without trivial rows if there are others."""
        board = self.board
        entries = [e for e in self.order if e.horizon == horizon]
        averaged = [e for e in entries if not board.is_trivial(e)] or entries
        rows = []
        for environment, metric in itertools.product(board.environments, _TABLE_5):
            column = Column(metric, "", [environment], board.in_group(group), self.intervals)
            means = {e: board.of(e, column) for e in entries}
            partial = any(means[e].state or means[e].partial for e in averaged)
            average = Value(nan_mean(means[e].value for e in averaged), cells=1, partial=partial)
            labels = [title_of(environment), metric_info(metric).short]
            rows.append([*labels, *(show_value(v, metric) for v in (*means.values(), average))])
        title = f"{PAPER}. AUC (%), delay (steps), false-alarm rate (FAR), {group}, Δ = {horizon}"
        # The title says the horizon.
        header = ["Environment", "Result", *(str(replace(e, horizon=1)) for e in entries), "AVG"]
        left_out = ", ".join(str(e) for e in entries if e not in averaged)
        note = f"AVG is the mean without the trivial rows: {left_out}." if left_out else ""
        table = Table(title, header, rows, labels=2, note=note)
        if len(board.environments) > 1:
            return table
        title += f", {title_of(board.environments[0])}"
        return replace(table.columns(range(1, len(header))), title=title, labels=1)

    def by_anomaly(self, entry: Setting, metric: str = "") -> Table:
        """Return one detector's metric by environment and anomaly, by default that which ranks."""
        board, info = self.board, metric_info(metric or self.board.ranking)
        cells = {
            e: [Column(info.name, a, [e], [a], self.intervals) for a in board.anomalies]
            for e in board.environments
        }
        rows = [[title_of(e), *texts(board, entry, columns)] for e, columns in cells.items()]
        note = " ".join(reasons(board, [entry], itertools.chain(*cells.values())))
        title = f"{entry}: {info.title}{' (%)' * (info.unit == 'percent')} by anomaly"
        header = ["Environment", *board.anomalies]
        return Table(title, header, rows, note=note)

    def of_logs(self) -> list[Table]:
        """Return what a board without twins has beside its headline.

        Each of several environments has a table of its own.
        """
        environments = self.board.environments
        places = [(), *([name] for name in environments if len(environments) > 1)]
        candidates = [*map(self._figures, places), self.published()]
        return [table for table in candidates if table]

    def published(self) -> Table | None:
        """Return metrics of rows as published tables have them; None when no record has any."""
        return self._of_logs(_PUBLISHED, ROWS)

    def _figures(self, environments: Sequence[str]) -> Table | None:
        """Return all figures of scores and guaranteed alarms, of all environments or of some."""
        alarms = self._at_level(*_ALARMS_OF_LOGS, *ALARMS_OF_OUTCOMES)
        said = self._present((*POOLED[:2], alarms[0], BRIER), environments)
        note = _joined(
            explained({_heading(name): name for name in said}),
            CENSORED * bool(self._present(self._at_level("delay_censored"), environments)),
            _SAME_ROW * bool(self._present([OUTCOME], environments)),
        )
        names = (*POOLED, *OUTCOME_UP_TO, *alarms, BRIER)
        return self._of_logs("Scores and alarms (%, but for steps)", names, environments, note)

    def _of_logs(
        self, title: str, names: Iterable[str], environments: Sequence[str] = (), note: str = ""
    ) -> Table | None:
        """Return means of the metrics that the board has; None without any."""
        suffix, columns = self.suffix, []
        for info in map(metric_info, self._present(names, environments)):
            text = _heading(info.name) + " (steps)" * (info.unit == "steps")
            text += f" (≤ {percent_of(suffix)})" * info.name.startswith("false_episodes")
            columns.append(Column(info.name, text, environments))
        title += f" at {percent_of(suffix)}" * any(metric_info(c.metric).level for c in columns)
        title += f": {', '.join(environments)}" * bool(environments)
        return self.table(title, self._with_ends(columns), note) if columns else None

    @functools.cached_property
    def order(self) -> list[Setting]:
        """The rows, those with labels in the order of these, otherwise the best mean first."""
        return [*self.labels] or best_first(self.board)

    def _at_level(self, *names: str) -> list[str]:
        return [f"{name}_{self.suffix}" for name in names]

    def _present(self, names: Iterable[str], environments: Sequence[str] = ()) -> list[str]:
        """Return the metrics that any record has a value of, of some environments or of all."""
        records = self.board.records
        selected = [r for r in records if not environments or r.environment in environments]
        return [name for name in names if cells_with(name, selected)]

    def columns(self, names: Iterable[str]) -> list[Column]:
        """Return means over all cells, under headings that name no alarm and no level."""
        present = self.board.present(names)
        return self._with_ends([Column(name, metric_info(name).noun) for name in present])

    def _with_ends(self, columns: Iterable[Column]) -> list[Column]:
        """Return columns with intervals where all have them, or where they are exact."""
        exact = {c.metric for c in columns if metric_info(c.metric).interval == "exact"}
        return [c._replace(intervals=self.intervals or c.metric in exact) for c in columns]

    def table(
        self, title: str, columns: Sequence[Column], note: str = "", entries: Sequence[Setting] = ()
    ) -> Table:
        """Return columns with a row per detector, by default all in the order of the tables."""
        rows = entries or self.order
        cells = [[*self.label(e), *texts(self.board, e, columns)] for e in rows]
        header = [*self.label_names, *(c.title + self._mark(c) for c in columns)]
        note = _joined(note, *reasons(self.board, rows, columns))
        return Table(title, header, cells, len(self.label_names), note)

    def _mark(self, column: Column) -> str:
        """Return the mark of a column of alarms whose level promises nothing in some row."""
        suffix = f"at_{column.metric.rpartition('_at_')[2]}"
        cells = [r for r in self.board.records if r.environment in column.environments]
        return UNPROMISED * any(unpromised(r, suffix) for r in cells or self.board.records)


_TABLE_5: Final = ("auc", "delay", "far")
_FIRST: Final = (f"found_within_{catalogue.FOUND_WITHIN[0]}", "missed", "false_episodes")
_OUTCOMES: Final = ("found_outcome", "balanced_outcome", "false_episodes")
_FALSE: Final = "False episodes: nominal ones with an alarm"
_FINDS: Final = "Found, missed: anomalous episodes with an alarm within 20 rows, and with none."
_MEANINGS: Final = {
    catalogue.RANKING: "how often a row scores higher under the anomaly",
    POOLED[0]: "how often anomalous rows score above nominal ones",
    OUTCOME: "how often a failure scores above a success",
}
_SAME_ROW: Final = (
    "Episodes are compared up to the same row, as failures run into the time limit. The row clock "
    "shows how much of this the phase of the episode alone gives."
)
_MARKS: Final = {
    "*": "over fewer cells than the split has",
    BRIEF: "half of the episodes end within 20 rows",
}
_RANKED: Final = ("nominal", "failures")  # what rows that are ranked, or in a band, learn from
_PART: Final = "trajector(y/ies) of each part"
_FIXED: Final = (
    "Detector seeds are fixed: intervals are over test episodes and calibration episodes, and say "
    "nothing of further seeds."
)
_PUBLISHED: Final = "Metrics of rows, for comparison with published tables; they rank nothing"
_ATTRIBUTION: Final = (
    "Of the detectors that explain their scores, at the first guaranteed alarm: how often the "
    "sensor that they name first is a corrupted one, over sensor anomalies, how far the onset that "
    "they name is from the effect, the median of a cell, and how well the named parts are those at "
    "fault, pooled over episodes, beside chance and the largest readings."
)

CENSORED: Final = "Delay censored counts a miss as the whole remainder of its episode."
"""Sentence below each table with the delay that ranks."""


def by_group(board: Board, title: str) -> list[Column]:
    """Return the metric that ranks over all cells, and over each group of anomalies."""
    of_groups = [Column(board.ranking, g, anomalies=kinds) for g, kinds in board.groups.items()]
    return [Column(board.ranking, title), *of_groups]


def best_first(board: Board) -> list[Setting]:
    """Return the rows of a board by their mean of `ordering_metric`, the best first.

    Rows without a value in some expected cell come last, and below them in the same order those
    that learn from failures.
    """
    metric = ordering_metric(board)
    means = {entry: board.of(entry, Column(metric)) for entry in board.entries}

    def order(entry: Setting) -> tuple[bool, bool, float, str]:
        mean = means[entry]
        undefined = math.isnan(mean.value)
        value = 0.0 if undefined else -mean.value
        return entry in board.supervised, undefined or mean.partial, value, str(entry)

    return sorted(means, key=order)


def ordering_metric(board: Board) -> str:
    """Return the metric that rows stand by: the one that ranks them.

    Where no record has it, as in some graded suites, the share that is found decides.
    """
    share_found = f"found_within_{catalogue.FOUND_WITHIN[-1]}_{board.level}"
    return share_found if board.leaves_out([board.ranking]) else board.ranking


def _heading(name: str) -> str:
    return "null" if name == POOLED[1] else metric_info(name).noun


def _joined(*sentences: str) -> str:
    return " ".join(filter(None, sentences))


def percent_of(suffix: str) -> str:
    """Return the level of a suffix as printed."""
    return f"{100 * catalogue.LEVELS[suffix]:g} %"


def explained(columns: Mapping[str, str]) -> str:
    """Return what columns show, from the catalogue's summaries of their metrics."""
    meanings = (f"{title} = {metric_info(metric).meaning}" for title, metric in columns.items())
    return f"{'; '.join(meanings)}." if columns else ""


def missing_level(board: Board, suffix: str) -> list[str]:
    """Return how many calibration episodes a level takes that rows have no figures at."""
    title = f"guaranteed alarms at {percent_of(suffix)}"
    return reasons(board, board.entries, [Column(f"false_episodes_{suffix}", title)])


def unpromised(record: Record, suffix: str) -> str:
    """Return why a level's figures of a record come with no promise; empty where they do.

    Parameters
    ----------
    record
        Of a cell; one that failed has no figures.
    suffix
        The level.

    Returns
    -------
    str
        A phrase without a full stop, see `oodd_eval.metrics.alarms.no_promise`.
    """
    numbers = record.recordings.get("calibration", ())
    if f"false_episodes_{suffix}" not in record.metrics:
        return ""
    return no_promise(len(numbers), len({*numbers}), catalogue.LEVELS[suffix], record.alarm)


def unranked(board: Board) -> str:
    """Return a note on the rows that no board ranks, for what they know; empty without one."""
    marks = {str(r.setting): training_mark(r.training) for r in board.records}
    marked_rows = [f"{row} ({mark})" if mark != row else row for row, mark in marks.items() if mark]
    return f"Not ranked, for what they know: {', '.join(marked_rows)}." if marked_rows else ""


def failures(board: Board) -> Table | None:
    """Return why fits failed; None when none did."""
    rows = [[r.environment, r.cell.label, r.status, r.reason] for r in board.failures()]
    header = ["environment", "detector", "state", "reason"]
    return Table("Failures", header, rows, labels=4) if rows else None


def findings(board: Board) -> list[str]:
    """Return a sentence where a simple row has a higher mean than detectors: matched AUC or AUC.

    The AUC of what knows the time alone is left out: the clock's is 1 by construction.
    Without twins it is the metric that ranks, and on outcomes `outcome_findings` has the clock.
    """
    sentences = []
    for simple in (e for e in board.entries if e.detector in _SIMPLE):
        timed = simple.detector == CLOCK and board.ranking == OUTCOME and board.present([WHOLE])
        metrics = [] if timed else [board.ranking]
        metrics += ["auc"] * (board.paired and simple.detector not in BLIND)
        for info in map(metric_info, metrics):
            below = []
            for entry in board.entries:
                same_kind = board.is_trivial(entry) or simple.detector == entry.detector
                if simple.horizon == entry.horizon and not same_kind:
                    value, lower = board.compare(simple, entry, info.name)
                    if value > lower:
                        below.append(_against(board, entry, info.text(lower), info.text(value)))
            if below:
                than = _listed(below, "rows")
                sentences.append(f"{simple} has a higher mean {info.title} than {than}.")
    return sentences


def _against(board: Board, entry: Setting, value: str, simple: str) -> str:
    """Return a row with its figure and that of a simple row."""
    band = ", trained on failures" * (entry in board.supervised)
    return f"{entry}{band} ({value} against {simple})"


def phase_findings(board: Board) -> list[str]:
    """Return a sentence where what knows the time alone does as well as detectors within episodes.

    Left out are rows that nobody takes for a detector of dynamics, rows at chance, which follow no
    phase either, and environments whose episodes have no phase that they share: their pooled AUC
    compares rows of all numbers, where that of the clock is not one half by ties alone.
    """
    sentences = []
    for clock in (entry for entry in board.entries if entry.detector == CLOCK):
        pooled = {e: board.of(clock, Column(POOLED[0], "", [e])) for e in board.environments}
        if records := [r for r in board.records if pooled[r.environment].value == 0.5]:
            why = "which then is the phase of the episode, not the dynamics"
            sentences += _no_better(Board(records), clock, POOLED[-1], why, chance=False)
    return sentences


def outcome_findings(board: Board) -> list[str]:
    """Return a sentence where what knows the time alone tells failures as well as detectors do.

    It is said of records that have the AUC of whole episodes, beside which that at equal time
    stands.
    """
    clocks = [e for e in board.entries if e.detector == CLOCK and board.present([WHOLE])]
    pairs = itertools.product(clocks, _TIME_ALONE.items())
    return [s for clock, (name, why) in pairs for s in _no_better(board, clock, name, why)]


def _no_better(
    board: Board, clock: Setting, metric: str, why: str, *, chance: bool = True
) -> list[str]:
    """Return a sentence on the rows that are no better than the clock, or but for those at chance.

    There is none without such rows.
    """
    info, listed = metric_info(metric), []
    for entry in (e for e in board.entries if e.detector not in _SENSELESS):
        time, value = board.compare(clock, entry, metric)
        mean = board.of(entry, Column(metric, intervals=not chance))
        if time >= value and (chance or not mean.low <= 0.5 <= mean.high):
            listed.append(_against(board, entry, info.text(value), info.text(time)))
    sentence = (
        f"{clock}, which knows the time alone, is as good as or better than these rows in "
        f"{info.title}, {why}: {', '.join(listed)}."
    )
    return [sentence] * bool(listed)


_TIME_ALONE: Final = {
    WHOLE: "which then is the length of the episode, not the failure",
    OUTCOME: "at equal time, where it cannot tell failures",
}

_SENSELESS: Final = (*BLIND, "random")  # rows whose AUC nobody takes for the dynamics


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
    if _has_strengths(board):
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


def _has_strengths(board: Board) -> bool:
    """Tell whether an anomaly of some environment has several strengths."""
    cells = {(r.environment, r.anomaly, r.strength) for r in board.records}
    return len(cells) > len({cell[:2] for cell in cells})


def uncalibrated(board: Board) -> list[str]:
    """Return which rows' alarms have intervals without the noise of the calibration episodes."""
    lacking = dict.fromkeys(str(r.setting) for r in board.records if _lacks_draws(r))
    if not lacking:
        return []
    have = [str(entry) for entry in board.entries if str(entry) not in lacking]
    named = ", ".join(lacking)
    if len(have) < len(lacking):
        named = f"all rows but {', '.join(have)}" if have else "all rows"
    sentence = "Intervals of alarms leave out the noise of the calibration"
    return [f"{sentence} episodes where records of earlier versions do not say it: {named}."]


def _lacks_draws(record: Record) -> bool:
    alarms = "far" in record.metrics or any("false_episodes" in name for name in record.metrics)
    return alarms and not record.calibration_draws and record.alarm != "flag"


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


def why_undefined(record: Record, metric: str) -> str:
    """Return why a record has no value of a metric; empty where it has one, or no reason is known.

    Parameters
    ----------
    record
        Of a cell; one that failed has its own reason.
    metric
        See ``oodd-eval list metrics``.

    Returns
    -------
    str
        A phrase without a full stop.
    """
    if not record.ok or not math.isnan(record.value(metric)):
        return ""
    info = metric_info(metric)
    if metric in record.metrics:
        return info.undefined
    if info.cells == "paired" and not record.paired:
        return "the episodes have no nominal twins"
    if info.cells == "unpaired" and record.paired:
        return "it is for episodes without nominal twins"
    withheld, _, reason = record.note.partition(" are withheld: ")
    if metric in withheld.split(", "):
        return reason
    if info.level and (reason := _left_out(record, metric)):
        return reason
    if metric in catalogue.ATTRIBUTION:
        return "the detector does not explain its scores"
    if record.condition == NOMINAL:
        return "there are no anomalous episodes"
    if metric == BRIER:
        return "scores are no probabilities that were learnt from failures"
    return "it is computed with --row-metrics alone" if info.request else ""


def _left_out(record: Record, metric: str) -> str:
    """Return how many calibration episodes a metric's level takes; empty if there are enough."""
    suffix = f"at_{metric.rpartition('_at_')[2]}"
    for note in record.note.split("; "):  # a rolling calibration takes more
        if note.startswith(f"guaranteed alarms at {metric_info(metric).level} are left out: "):
            return note.partition(": ")[2]
    episodes = record.counts.get("calibration")
    if episodes is None or suffix in offered_levels(episodes, record.alarm):
        return ""
    return _too_few(episodes, catalogue.LEVELS[suffix], record.alarm)
