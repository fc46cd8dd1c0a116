"""Results as scripts and notebooks use them: records, and the scores and episodes behind them."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator, Sequence
from html import escape
from importlib import import_module
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from oodd_eval.data.parts import CALIBRATION, TWINS, AnomalousSet, EnvironmentData, LabelledSet
from oodd_eval.data.split import Split
from oodd_eval.errors import MissingExtraError, ResultsError, UsageError
from oodd_eval.metrics.catalogue import LEVELS, metric_info
from oodd_eval.names import check_known, counted, select
from oodd_eval.prose import terminal_text
from oodd_eval.results import plots
from oodd_eval.results.board import Conditions, boards, level_of
from oodd_eval.results.directory import ResultsDirectory, ScoreFile
from oodd_eval.results.evaluate import Rules, ScoredEpisode, must_be_of, stored_scores, with_stream
from oodd_eval.results.identity import Setting
from oodd_eval.results.record import Record, summary
from oodd_eval.results.render.text import html_sections
from oodd_eval.results.report import Report, flat
from oodd_eval.results.standings import PairedComparison, compare_rows, row_named
from oodd_eval.results.strengths import (
    COSTS,
    DETECTION,
    NO_UNITS,
    Point,
    Strengths,
    curve,
    threshold_rows,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Results(Sequence[Record]):
    """The records of an evaluation, one a cell; made by `evaluate` and `load_results`.

    A row is a detector with its settings, named as tables name it: ``"rf"`` or ``"riqn[h=10]"``.
    Where there is only one it need not be named.

    Parameters
    ----------
    records
        In any order.
    directory
        Where their scores are, if anywhere.
    split
        The split that they are of; by default the one of that name on this machine.
    """

    def __init__(
        self,
        records: Sequence[Record],
        directory: ResultsDirectory | None = None,
        split: Split | None = None,
    ) -> None:
        self.records = list(records)
        self._directory, self._split = directory, split

    def __len__(self) -> int:
        """Return the number of cells."""
        return len(self.records)

    @overload
    def __getitem__(self, index: int) -> Record: ...
    @overload
    def __getitem__(self, index: slice) -> Results: ...
    def __getitem__(self, index: int | slice) -> Record | Results:
        """Return a record, or the results of a slice."""
        if isinstance(index, slice):
            return Results(self.records[index], self._directory, self._split)
        return self.records[index]

    def __repr__(self) -> str:
        """Return one line: how many cells of what, and how many failed."""
        splits = ", ".join(dict.fromkeys(r.split for r in self)) or "nothing"
        cells = counted(len(self), "cell(s)")
        return f"Results({cells} of {splits}: {', '.join(self.rows)}; {summary(self)})"

    def __str__(self) -> str:
        """Return what ``oodd-eval show`` prints: why cells failed, and where one's row stands."""
        if not self.records:
            return repr(self)
        failures = [*self._failures, summary(self), ""] if self._failures else []
        return "\n".join([*failures, terminal_text(self._report.sections).rstrip("\n")])

    def _repr_html_(self) -> str:
        """Return the tables that ``oodd-eval show`` prints, for notebooks."""
        lines = repr(self), *self._failures
        tables = html_sections(self._report.sections)
        return "".join(f"<p>{escape(text)}</p>\n" for text in lines) + tables

    @property
    def _report(self) -> Report:
        units = self._split.units if self._split else NO_UNITS
        return Report(self.records, detail="brief", units=units)

    @property
    def _failures(self) -> list[str]:
        """Return why cells failed, a line each."""
        failed = (r for board in boards(self) for r in board.failures())
        return [f"{r.status}: {r.cell}: {r.reason}" for r in failed]

    @property
    def rows(self) -> tuple[str, ...]:
        """Names of the rows."""
        return tuple(dict.fromkeys(str(r.setting) for r in self.records))

    @property
    def ok(self) -> bool:
        """True if no cell failed."""
        return all(r.ok for r in self.records)

    def mean(self, metric: str = "", row: str = "") -> float:
        """Return a row's mean of a metric over all cells, as the tables have it.

        Parameters
        ----------
        metric
            See ``oodd-eval list metrics``; by default the one that tables order rows by:
            ``auc_matched``, or ``auc_pool`` where episodes have no twins.
        row
            Name of the row.

        Returns
        -------
        float
            In the metric's unit, shares from 0 to 1; NaN where it is undefined or a cell failed.

        Raises
        ------
        UnknownNameError, UsageError
            For an unknown metric or row, or without a name where there are several rows.
        """
        if metric:
            metric_info(metric)
        setting = self._row(row)
        (board,) = boards([r for r in self.records if r.setting == setting])
        name = metric or board.ranking
        return board.mean(setting, board.environments, board.anomalies, name).value

    def compare(self, first: str, second: str, metric: str = "") -> PairedComparison:
        """Tell whether one row is better than another, by the paired bootstrap over test seeds.

        Parameters
        ----------
        first, second
            Names of the rows.
        metric
            Any metric that is a mean over trajectories; by default the one of `mean`.

        Returns
        -------
        PairedComparison
            Difference, interval, p-value and verdict.

        Raises
        ------
        UsageError, ResultsError
            As `oodd_eval.results.standings.compare_rows`.
        """
        return compare_rows(self.records, first, second, metric)

    def to_rows(self) -> list[dict[str, Any]]:
        """Return a flat mapping for each cell: its identity, its metrics, and its cost.

        Returns
        -------
        list of dict
            All with the same keys, NaN where a cell lacks a metric.
        """
        return flat(self.records)

    def to_frame(self) -> Any:
        """Return `to_rows` as a data frame.

        Returns
        -------
        pandas.DataFrame

        Raises
        ------
        MissingExtraError
            Without pandas.
        """
        try:
            pandas = import_module("pandas")
        except ImportError:
            advice = "to_frame needs pandas: pip install pandas, or use to_rows"
            raise MissingExtraError(advice) from None
        return pandas.DataFrame(self.to_rows())

    def scores(
        self, environment: str, anomaly: str, i: int = 0, *, row: str = "", seed: int | None = None
    ) -> ScoredEpisode:
        """Return one episode of a cell with its scores.

        Parameters
        ----------
        environment, anomaly
            The cell.
        i
            Place of the episode among the cell's, from 0.
        row
            Name of the row.
        seed
            Seed of the detector; by default the lowest.

        Returns
        -------
        ScoredEpisode

        Raises
        ------
        UnknownNameError, UsageError
            When these results have no such cell or episode.
        ResultsError
            When the cell failed, or its scores were not kept.
        """
        setting = self._row(row)
        records = [r for r in self.records if r.setting == setting]
        check_known("environment of these results", {r.environment for r in records}, environment)
        records = [r for r in records if r.environment == environment]
        kind = f"anomaly of these results in {environment}"
        check_known(kind, {str(r.condition) for r in records}, anomaly)
        by_seed = {r.seed: r for r in records if str(r.condition) == anomaly}
        seed = min(by_seed) if seed is None else seed
        if seed not in by_seed:
            raise UsageError(f"no detector seed {seed}: expected one of {sorted(by_seed)}")
        record = by_seed[seed]
        if not record.ok:
            raise ResultsError(f"{record.cell} has no scores, it failed: {record.reason}")
        (episodes,) = self._episodes([record])
        if not 0 <= i < len(episodes):
            cell = f"{environment}/{anomaly}"
            raise UsageError(f"{cell} has no episode {i}: expected 0 to {len(episodes) - 1}")
        return episodes[i]

    def thresholds(self) -> list[dict[str, Any]]:
        """Return a flat mapping for each row, environment and anomaly with several strengths.

        Returns
        -------
        list of dict
            Its ``threshold``, and ``low`` and ``high`` of the 95 % interval, are in the anomaly's
            unit: 0 where it is below the ``weakest`` strength, infinity where it is above the
            ``strongest``. ``kept99`` is the strength that costs 1 % of the return, or that
            raises the task's loss by 1 % (``loss1``), NaN where strengths are your own.
        """
        return threshold_rows(self.records)

    def plot_trajectory(
        self, environment: str, anomaly: str, i: int = 0, *, row: str = "", seed: int | None = None
    ) -> Figure:
        """Draw an episode: the sensors that leave their twin's course, and the statistic.

        Without a twin they are the sensors that are farthest from nominal episodes, and the rows
        that are known to be anomalous are shaded.

        Parameters
        ----------
        environment, anomaly, i, row, seed
            As those of `scores`.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        MissingExtraError
            Without matplotlib; other errors are those of `scores`.
        """
        return plots.trajectory(self.scores(environment, anomaly, i, row=row, seed=seed))

    def plot_power(self, *rows: str) -> Figure:
        """Draw which share of episodes has an alarm at 5 % by how many rows after the effect.

        Without twins it is at the level that tables show, from the start of the first interval.

        Parameters
        ----------
        rows
            Names of rows; by default all.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        ResultsError
            When no row has an alarm at 5 %; others as those of `plot_trajectory`.
        """
        curves = {}
        for setting in map(self._row, rows or self.rows):
            records = [r for r in self.records if r.setting == setting and r.ok]
            curves[str(setting)] = [e for episodes in self._episodes(records) for e in episodes]
        return plots.power(curves)

    def plot_ladder(
        self, *rows: str, metric: str = DETECTION, environments: str = "all", anomalies: str = "all"
    ) -> Figure:
        """Draw a metric against the strength of anomalies and against the return that they cost.

        Parameters
        ----------
        rows
            Names of rows; by default all.
        metric
            By default the share of episodes with an alarm within 100 rows, where at most 5 % of
            nominal episodes have one; dotted is what false alarms alone give.
        environments, anomalies
            What is averaged over: comma lists and globs, as on the command line. Strengths are in
            units of the strength that costs 1 % of the return or raises the task's loss by 1 %, as
            each anomaly has its own unit; strengths of your own are in the unit of the anomaly.

        Returns
        -------
        matplotlib.figure.Figure

        Raises
        ------
        ResultsError
            When there are no results at several strengths; others as those of `plot_trajectory`.
        """
        info = metric_info(metric)
        over = select("environment", environments, dict.fromkeys(r.environment for r in self))
        kinds = select("anomaly", anomalies, dict.fromkeys(r.anomaly for r in self))
        records = [r for r in self if r.environment in over and r.anomaly in kinds]
        settings = [
            self._row(name) for name in rows or dict.fromkeys(str(r.setting) for r in records)
        ]
        curves: list[dict[str, list[Point]]] = [
            {str(s): curve([r for r in records if r.setting == s], name) for s in settings}
            for name in filter(None, (metric, info.null))
        ]
        if not any(curves[0].values()):
            raise ResultsError(
                f"no results at several strengths with {metric}: run a split that has some"
            )
        unit = COSTS.get(Strengths.of(records).base, "")
        return plots.ladder(curves[0], curves[-1] if info.null else {}, info, unit)

    def _row(self, name: str) -> Setting:
        if name or len(self.rows) == 1:
            return row_named(self.records, name or self.rows[0])
        raise UsageError(f"{len(self.rows)} rows, expected row= as one of {', '.join(self.rows)}")

    def _episodes(self, records: Sequence[Record]) -> Iterator[list[ScoredEpisode]]:
        """Yield all episodes of each record. An environment is opened once, which takes long."""
        with contextlib.ExitStack() as stack:
            opened = functools.cache(lambda split: stack.enter_context(split.opened()))
            for record in records:
                if self._directory is None:
                    raise ResultsError(f"{record.cell}: the scores of these results were not kept")
                split = self._split or self._directory.split_of(record)
                must_be_of(split, record)
                data: EnvironmentData = opened(split)(record.environment)
                file = stored_scores([record], self._directory, data)
                of_board = [r for r in self.records if Conditions.of(r) == Conditions.of(record)]
                joining = file.parts[TWINS] if record.rolling else None
                file = with_stream(file, data, [record.condition], record.limit, record.alarm)
                calibration, numbers = file.parts[CALIBRATION], record.recordings
                rules = Rules.fit(calibration, record.alarm, joining, numbers, file.stream)
                yield _scored(record, file, data, rules, level_of(of_board))


def _scored(
    record: Record, file: ScoreFile, data: EnvironmentData, rules: Rules, level: str
) -> list[ScoredEpisode]:
    """Return the episodes of a cell, beside their twins where there are some."""
    episodes = data.test_set(record.condition)
    scores, n = file.parts[record.condition.part], len(episodes)
    nothing: Sequence[Any] = [None] * n
    intervals: Sequence[Any] = [()] * n
    twins, twin_scores, statistics, nominal = nothing, nothing, nothing, None
    rule = rules.guaranteed.get(level)
    if isinstance(episodes, AnomalousSet):
        twins, twin_scores = data.twins, file.parts[TWINS]
        starts, effects = episodes.onsets.tolist(), episodes.effects.tolist()
    else:
        intervals = episodes.intervals if isinstance(episodes, LabelledSet) else intervals
        starts = [
            next((start for start, _ in spans[:1] if start >= 0), None) for spans in intervals
        ]
        effects = starts
        statistics = [*map(rules.calibration.joint, scores, file.stream[record.condition.part])]
        reference = data.twins if len(data.twins) else data.train
        rows = np.concatenate([episode.observations for episode in reference])
        nominal = np.array([rows.mean(axis=0, dtype=float), rows.std(axis=0, dtype=float)])
    sensors = tuple(sensor.name for sensor in data.sensors)
    return [
        ScoredEpisode(
            record.cell,
            i,
            scores[i],
            twin_scores[i],
            episodes[i],
            twins[i],
            starts[i],
            effects[i],
            sensors,
            rule,
            intervals[i],
            nominal,
            LEVELS[level],
            statistics[i],
        )
        for i in range(len(scores))
    ]
