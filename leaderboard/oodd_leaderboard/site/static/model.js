// The index of the page, parts that are loaded when they are needed, and means over selected cells.

const DATA = JSON.parse(document.getElementById("data").textContent);
const ROWS = new Map(DATA.boards.flatMap((board) => board.rows.map((row) => [row.id, { board, row }])));
const EVERYTHING = { environment: "all", group: "all", anomaly: "all" };

const PARTS = new Map();
const awaited = new Map();

/** What data files call, with their name and their content as JSON. */
window.ooddPart = (name, text) => PARTS.set(name, JSON.parse(text));

/** Load one data file from beside the page, once; a promise of its content. */
function load(name) {
  if (!awaited.has(name)) {
    awaited.set(name, new Promise((resolve, reject) => {
      const source = `data/${name}.js`;
      const script = element("script", {
        src: source,
        onload: () => PARTS.has(name) ? resolve(PARTS.get(name)) : reject(new Error(`${source} is not what it was built as`)),
        onerror: () => { awaited.delete(name); reject(new Error(`${source} is not there`)); },
      });
      document.head.append(script);
    }));
  }
  return awaited.get(name);
}

/** What stands in place of something whose data did not load. */
const notLoaded = (error) => element("p", { class: "failure", role: "alert" },
  `Data of this page is missing: ${error.message}. Keep the directory "data" beside index.html, or build the site again with "oodd-eval leaderboard build".`);

/** What is known of an environment or an anomaly: logs have names of their own. */
const environmentOf = (board, name) => (board.own ?? DATA).environments[name];
const anomalyOf = (board, name) => (board.own ?? DATA).anomalies[name];

/** The title of a cell. */
const cellTitle = (board, { environment, anomaly }) => `${environmentOf(board, environment).title}, ${anomalyOf(board, anomaly).title}`;

/** The title of the metric that a board ranks by, as it begins a sentence, or within one. */
const rankingTitle = (board) => DATA.metrics[board.ranking].title;
const rankingName = (board) => board.paired ? "matched AUC" : rankingTitle(board).replace(/^P/, "p");

/** The level of a board's guaranteed alarms, such as 5 %. */
const levelOf = (board) => `${board.level.replace(/\D/g, "")} %`;

/** Whether a cell is among those selected. */
function selects(board, selection, cell) {
  const { environment, group, anomaly } = selection;
  const { family } = environmentOf(board, cell.environment);
  return (
    (environment === "all" || environment === family || environment === cell.environment) &&
    (group === "all" || group === anomalyOf(board, cell.anomaly).group) &&
    (anomaly === "all" || anomaly === cell.anomaly)
  );
}

/** The name of a selection's mean where a part of the data has its interval. */
const keyOf = ({ environment, group, anomaly }) => `${environment}|${anomaly !== "all" ? anomaly : group}`;

const places = new Map();

/** Places of a selection's cells in the board's list, worked out once. */
function cellsOf(board, selection) {
  const key = [board.id, selection.environment, selection.group, selection.anomaly].join("|");
  if (!places.has(key)) {
    places.set(key, board.cells.flatMap(([environment, anomaly], i) =>
      selects(board, selection, { environment, anomaly }) ? [i] : []));
  }
  return places.get(key);
}

/** Whether the index has means over a selection: over all environments and one group or both. */
const isSummary = ({ environment, anomaly }) => environment === "all" && anomaly === "all";

/** The part that a board's metric is in. */
const partOf = (board, metric) => PARTS.get(board.parts[metric]);

/** Load what means of metrics over a selection need, beyond the index. */
const loadMetrics = (board, metrics) => Promise.all(metrics.map((metric) => load(board.parts[metric])));

/** Metrics that a board has data of. */
const known = (board, metrics) => metrics.filter((metric) => board.parts[metric]);

const wholeDigits = (kind) => kind === "steps" ? 10 : 1000;

/**
 * Mean of a metric over the selected cells, detector seeds included.
 *
 * `state` is a failed cell's, and then there is no value; `partial` tells that other rows have
 * cells here that this one lacks. Over all environments and anomalies it is the index's; any other
 * selection is averaged from the metric's part, where it is loaded.
 */
function mean(board, row, metric, selection = EVERYTHING) {
  const chosen = cellsOf(board, selection);
  const missing = chosen.filter((i) => row.missing.includes(i)).length;
  const count = chosen.length - missing;
  const found = { value: null, low: null, high: null, state: "", reason: "", cells: count, partial: count > 0 && missing > 0 };
  if (!count) return found;
  const failed = row.failed.find(([place]) => chosen.includes(place));
  if (failed) return { ...found, state: failed[1], reason: failed[2] };
  if (isSummary(selection)) {
    const [values, lows, highs] = row.means[selection.group] ?? [[], [], []];
    const unit = wholeDigits(DATA.metrics[metric].kind);
    const number = (whole) => isNumber(whole) ? whole / unit : null;
    const place = board.intervals.indexOf(metric);
    return { ...found, value: number(values[board.metrics.indexOf(metric)]), low: number(lows[place]), high: number(highs[place]) };
  }
  const part = partOf(board, metric);
  if (!part) return found;
  found.value = meanOf(chosen.map((i) => part.values[row.part][i]));
  const key = chosen.length === 1 ? board.cells[chosen[0]].join("|") : keyOf(selection);
  [found.low, found.high] = part.intervals[row.part]?.[key] ?? [null, null];
  return found;
}

/** The same from a row's own part, which has intervals of single cells, too. */
function meanOfRow(board, row, metric, selection = EVERYTHING) {
  if (isSummary(selection)) return mean(board, row, metric, selection);
  const part = PARTS.get(row.part);
  const cells = part.cells.filter((cell) => selects(board, selection, cell));
  const found = { value: null, low: null, high: null, state: "", cells: cells.length, partial: false };
  const failed = cells.find((cell) => cell.status);
  if (failed) return { ...found, state: failed.status, reason: failed.reason };
  const index = board.metrics.indexOf(metric);
  found.value = meanOf(cells.map((cell) => cell.values[index]));
  const place = board.intervals.indexOf(metric);
  const known = part.intervals[keyOf(selection)]?.[place];
  if (known) [found.low, found.high] = known;
  else if (cells.length === 1 && place >= 0) [found.low, found.high] = [cells[0].low[place], cells[0].high[place]];
  return found;
}

/**
 * The paper's digits for a row, averaged over the selected environments and groups.
 *
 * They exist for four detectors at horizon 1 with default settings, by environment and group.
 */
function paperMean(row, metric, selection = EVERYTHING) {
  if (row.horizon !== 1 || Object.keys(row.overrides).length || selection.anomaly !== "all") return null;
  const found = [];
  for (const [environment, byMetric] of Object.entries(DATA.paper)) {
    for (const [group, byDetector] of Object.entries(byMetric[metric] ?? {})) {
      const family = DATA.environments[environment].family;
      const chosen = ["all", family, environment].includes(selection.environment);
      if (chosen && ["all", group].includes(selection.group)) found.push(byDetector[row.detector]);
    }
  }
  // One that is missing would make the mean one over other cells.
  if (!found.length || !found.every(isNumber)) return null;
  const value = meanOf(found);
  return metric === "auc" ? value / 100 : value;
}

/** Anomalies of a board that belong to a group; those of no group belong to "". */
const inGroup = (board, group) => board.anomalies.filter((a) => group === "all" || anomalyOf(board, a).group === group);

/** A value as text with marks: a state in place of a failed value, a star for a partial mean. */
function meanText(found, kind) {
  if (!found.cells) return "";
  return (found.state || show(found.value, kind)) + (found.partial ? "*" : "");
}

/** The interval of a mean in brackets, behind a space; nothing where there is none. */
const intervalOf = ({ low, high }, kind) => isNumber(low) ? ` [${show(low, kind)}, ${show(high, kind)}]` : "";
