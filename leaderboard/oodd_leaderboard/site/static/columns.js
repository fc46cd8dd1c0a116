// What the columns of the main table are: one list for each of its views.

/** Values that others are read beside: large or small, they are no merit in a row. */
const BESIDE = ["auc_null", "auc_placebo", "auc_pool_null", "delay_null", "found_within_100_null", "found_outcome_null", "early_at_"];

/** Whether a metric's best value is marked: delays at different false-alarm rates do not compare. */
const isMarked = (metric, kind) =>
  !BESIDE.some((name) => metric.startsWith(name)) && (kind === "percent" || metric.includes("_at_"));

const PAPERS_ALARM = "The paper\u2019s alarm: meant to be false in about one row in ten";

/** Metrics of the paper's alarm. */
const PAPERS = ["delay", "delay_null", "delay_censored", "missed", "far", "far_twin"];

/** A title where a heading or a tab says that it is of the paper's alarm. */
const underHeading = (title) => title.replace(/, paper's alarm/, "");

const GROUP_TITLES = { sensor: "Sensor", dynamics: "Dynamics" };

/** A column of a metric's mean; `within` narrows the selection. */
function metricColumn(board, metric, options = {}) {
  const { title, kind, better, meaning } = DATA.metrics[metric];
  const unit = titleOfUnit[kind];
  return {
    key: options.key ?? metric,
    title: options.title ?? title,
    unit: kind === "rate" ? "" : unit,
    hint: options.hint ?? meaning,
    better,
    marked: isMarked(metric, kind),
    kind,
    interval: options.interval ?? false,
    needs: (selection) => isSummary({ ...selection, ...options.within }) ? [] : known(board, [metric]),
    of: (row, selection) => mean(board, row, metric, { ...selection, ...options.within }),
  };
}

/** A cost: two digits are more than what two machines agree on. */
const costText = (value) => isNumber(value) && value < 0.001 ? "< 0.001" : brief(value, 2);

/** A column of a plain number of a row. */
function plainColumn(key, title, unit, hint, of, options = {}) {
  return { key, title, unit, hint, better: "lower", text: costText, of: (row) => ({ value: of(row), cells: 1 }), ...options };
}

function paperColumn(metric, title, unit, kind) {
  const hint = "Digits of the paper's Table 5 for the same environments and groups";
  return {
    key: `paper_${metric}`, title, unit, hint, kind, better: metric === "auc" ? "higher" : "lower",
    of: (row, selection) => ({ value: paperMean(row, metric, selection), cells: 1 }),
    paper: true,
  };
}

const RANK = plainColumn(
  "rank", "Rank", "", "1 plus the number of rows that are significantly better over all cells",
  (row) => row.rank,
);

const ALARM_RANK = plainColumn(
  "alarm_rank", "Rank", "", "1 plus the number of rows that alarm significantly sooner: censored delay of guaranteed alarms at 5 %",
  (row) => row.alarm_rank,
);

/** Columns of the metric that ranks for each group that a board has, where all are selected. */
function groupColumns(board, selection) {
  if (selection.group !== "all" || selection.anomaly !== "all") return [];
  const some = (group) => inGroup(board, group).length && (board.paired || inGroup(board, group).length < board.anomalies.length);
  return Object.keys(GROUP_TITLES).filter(some).map((group) => metricColumn(board, board.ranking, {
    key: `matched_${group}`, title: GROUP_TITLES[group], within: { group },
    hint: `${rankingTitle(board)} over ${group} anomalies`, interval: true,
  }));
}

/** A column of how often a row is above others. */
const winsColumn = (board) =>
  plainColumn("wins", "Wins", "%", `Mean share of cells with a higher ${rankingName(board)} than another row's`,
    (row) => row.wins === null ? null : 100 * row.wins, { better: "higher", marked: true, text: (share) => isNumber(share) ? share.toFixed(0) : UNDEFINED });

/** A column of how many environments a row's lead over the next one does not rest on. */
const LEAD = plainColumn(
  "lead", "Lead", "", "In how many of the cases in which one environment is left out the mean stays above that of the next rank",
  (row) => row.lead ? Number(row.lead.split("/")[0]) : null,
  { better: "higher", text: (held, row) => isNumber(held) ? row.lead : UNDEFINED },
);

/** Columns of those of some metrics that a board has; the caption names the level of logs. */
const metricColumns = (board, metrics, interval = true) => known(board, metrics).map((metric) => metricColumn(board, metric, {
  interval: interval && board.intervals.includes(metric),
  title: !board.paired && metric.endsWith(board.level) ? DATA.metrics[metric].title.replace(` at ${levelOf(board)}`, "") : undefined,
}));

/** Columns of the metric that ranks over parts of the cells, beside that over all; `parts` are [key, title, hint, selection]. */
const rankingColumns = (board, parts) => [metricColumn(board, board.ranking), ...parts.map(([key, title, hint, within]) =>
  metricColumn(board, board.ranking, { key, title, hint: `${rankingTitle(board)} ${hint}`, within, interval: true }))];

const ROW_METRICS = ["f1_rows", "far_rows", "mar_rows", "vus_pr"];
const BESIDE_RANKING = ["auc_pool", "auc_pool_null", "auc_rows", "auc_outcome", "auc_smoothed", "auc_unpaired", "auc", "auc_placebo"];
const WITHIN = ["found_within_20", "found_within_100", "found_within_100_null"];
const OF_ALARMS = {
  true: ["delay_censored", "delay", "missed", ...WITHIN, "false_episodes", "early"],
  false: ["delay_censored", "found_outcome", "found_outcome_null", "events_found", "delay", "missed", ...WITHIN, "false_episodes", "early", "false_alarms_per_hour"],
}; // by whether episodes are paired
const AT_OTHER_LEVELS = { true: OF_ALARMS.true.slice(1), false: ["delay", "missed", "false_episodes"] };

/** The views: a board leaves out columns that it has no numbers for, and views that are `only` of the other kind. */
const LISTS = {
  ranking: {
    title: "Separability",
    columns: (board, selection) => !board.parts[board.ranking] ? [] : [
      { ...metricColumn(board, board.ranking, { interval: true }), whisker: true },
      ...groupColumns(board, selection),
      ...metricColumns(board, BESIDE_RANKING.filter((metric) => metric !== board.ranking), !board.paired),
      winsColumn(board),
      LEAD,
    ],
    empty: "This board has nominal episodes alone, so there is nothing to separate: see its alarms.",
  },
  aucs: {
    title: "AUCs",
    only: true,
    columns: (board) => [
      ...metricColumns(board, ["auc_matched", "auc_smoothed", "auc_unpaired", "auc_placebo", "auc"]),
      paperColumn("auc", "Paper\u2019s AUC", "%", "percent"),
      ...metricColumns(board, ["auc_null"]),
    ],
  },
  guaranteed: {
    title: "Alarms",
    rank: ALARM_RANK,
    sort: "alarm_rank",
    level: levelOf,
    columns: (board) => metricColumns(board, [
      ...OF_ALARMS[board.paired].map((metric) => `${metric}_${board.level}`),
      ...["at_5pct", "at_10pct", "at_1pct"].filter((suffix) => suffix !== board.level)
        .flatMap((suffix) => AT_OTHER_LEVELS[board.paired].map((metric) => `${metric}_${suffix}`)),
    ]),
    empty: "No record of this board has guaranteed alarms: too few calibration episodes.",
  },
  alarms: {
    title: "Paper\u2019s alarms",
    only: true,
    columns: (board) => [
      ...known(board, PAPERS).map((metric) => metricColumn(board, metric, { title: underHeading(DATA.metrics[metric].title), interval: true })),
      paperColumn("delay", "Paper\u2019s delay", "steps", "steps"),
      paperColumn("far", "Paper\u2019s FAR", "", "rate"),
    ],
  },
  environments: {
    title: "By environment",
    columns: (board, { environment }) => rankingColumns(board, board.environments
      .map((e) => [e, environmentOf(board, e)])
      .filter(([e, { family }]) => ["all", family, e].includes(environment))
      .map(([e, { title }]) => [e, title, `in ${title}`, { environment: e }])),
  },
  anomalies: {
    title: "By anomaly",
    columns: (board, { group, anomaly }) => rankingColumns(board, inGroup(board, group)
      .filter((a) => ["all", a].includes(anomaly))
      .map((a) => [a, anomalyOf(board, a)])
      .map(([a, { title, summary }]) => [a, title, [`under ${title}`, summary].filter(Boolean).join(": "), { anomaly: a, group: "all" }])),
  },
  rows: {
    title: "Metrics of rows",
    only: false,
    columns: (board) => metricColumns(board, ROW_METRICS),
    empty: "No record of this board has metrics of rows: they are computed on request, for comparison with published tables, and rank nothing.",
  },
  cost: {
    title: "Cost",
    over: "all fits of a row, whatever is selected",
    columns: () => [
      plainColumn("fit", "Fit", "s", "Mean seconds of a fit", (row) => row.cost.fit),
      plainColumn("step", "Score", "\u00b5s per step", "Microseconds per scored step", (row) => row.cost.step),
      plainColumn("peak", "Peak memory", "MB", "Largest resident memory of a fit", (row) => row.cost.peak),
    ],
  },
};

/** The views that a board has. */
const listsOf = (board) => Object.fromEntries(Object.entries(LISTS).filter(([, { only = board.paired }]) => only === board.paired));

/** The view that is chosen, or the first where a board has no such view. */
const listOf = (board, view) => listsOf(board)[view] ?? LISTS.ranking;

/** Columns of a view that this board has numbers for. */
function columnsOf(board, state) {
  const columns = listOf(board, state.view).columns(board, state);
  return columns.filter((c) => !c.paper || board.rows.some((row) => isNumber(c.of(row, state).value)));
}
