// The index of the page, parts that are loaded when they are needed, and means over selected cells.

const DATA = JSON.parse(document.getElementById("data").textContent);
const ROWS = new Map(DATA.boards.flatMap((board) => board.rows.map((row) => [row.id, { board, row }])));
const EVERYTHING = { environment: "*", anomaly: "*" };

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

/** A board's name of an environment or anomaly; and of an anomaly its group and what it does. */
const environmentOf = (board, name) => board.environments[name];
const anomalyOf = (board, name) => board.anomalies[name];

/** The title of a cell, with the strength of its anomaly where it has several. */
function cellTitle(board, { environment, anomaly }) {
  const strength = board.strengths[`${environment}|${anomaly}`];
  return `${environmentOf(board, environment)}, ${anomalyOf(board, anomaly).title}${strength ? ` (${strength})` : ""}`;
}

/** The title of the metric that a board ranks by, as it begins a sentence, or within one. */
const rankingTitle = (board) => DATA.metrics[board.ranking].title;
const rankingName = (board) => board.paired ? "matched AUC" : rankingTitle(board).replace(/^P/, "p");

/** The level of a board's guaranteed alarms, such as 5 %. */
const levelOf = (board) => `${board.level.replace(/\D/g, "")}\u00a0%`;

const GROUP_TITLES = { sensor: "Sensor", dynamics: "Dynamics" };

/** Anomalies of a board that belong to a group; those of no group belong to "". */
const inGroup = (board, group) => Object.keys(board.anomalies).filter((a) => anomalyOf(board, a).group === group);

/** Whether a cell is among those selected. A selection is an environment and an anomaly; `*` is all, `*sensor` a group. */
function selects(board, { environment, anomaly }, cell) {
  return ["*", cell.environment].includes(environment) &&
    ["*", `*${anomalyOf(board, cell.anomaly).group}`, cell.anomaly].includes(anomaly);
}

/** The name of a selection's mean where a part of the data has its interval. */
const keyOf = ({ environment, anomaly }) => `${environment}|${anomaly}`;

const places = new Map();

/** Places of a selection's cells in the board's list, worked out once. */
function cellsOf(board, selection) {
  const key = `${board.id}|${keyOf(selection)}`;
  if (!places.has(key)) {
    places.set(key, board.cells.flatMap(([environment, anomaly], i) =>
      selects(board, selection, { environment, anomaly }) ? [i] : []));
  }
  return places.get(key);
}

/** Anomalies of the selected cells. */
const selectedAnomalies = (board, selection) => [...new Set(cellsOf(board, selection).map((i) => board.cells[i][1]))];

/** Whether the index has means over a selection: over all environments and one group or both. */
const isSummary = ({ environment, anomaly }) => environment === "*" && anomaly[0] === "*";

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
 * selection is averaged from the part of the metric or of the row, whichever is loaded.
 */
function mean(board, row, metric, selection = EVERYTHING) {
  const chosen = cellsOf(board, selection);
  const missing = chosen.filter((i) => row.missing.includes(i)).length;
  const count = chosen.length - missing;
  const found = { value: null, low: null, high: null, state: "", reason: "", cells: count, partial: count > 0 && missing > 0 };
  if (!count) return found;
  const failed = row.failed.find(([place]) => chosen.includes(place));
  if (failed) return { ...found, state: failed[1], reason: failed[2] };
  const [index, place, key] = [board.metrics.indexOf(metric), board.intervals.indexOf(metric), keyOf(selection)];
  if (isSummary(selection)) {
    const [values, lows, highs] = row.means[key] ?? [[], [], []];
    const unit = wholeDigits(DATA.metrics[metric].kind);
    const number = (whole) => isNumber(whole) ? whole / unit : null;
    return { ...found, value: number(values[index]), low: number(lows[place]), high: number(highs[place]) };
  }
  const [part, own] = [partOf(board, metric), PARTS.get(row.part)];
  if (!part && !own) return found;
  const values = part ? part.values[row.part] : own.values[index];
  [found.low, found.high] = (part ? part.intervals[row.part]?.[key] : own.intervals[key]?.[place]) ?? [null, null];
  return { ...found, value: meanOf(chosen.map((i) => values[i])) };
}

/** The least mean of the metric that ranks in one environment, and its name. */
function worst(board, row, selection = EVERYTHING) {
  if (selection.anomaly === "*") return { value: null, ...row.worst, cells: 1 };
  const means = Object.keys(board.environments).map((environment) => ({ environment, ...mean(board, row, board.ranking, { ...selection, environment }) }));
  return means.filter(({ value }) => isNumber(value)).sort((a, b) => a.value - b.value)[0] ?? { value: null, cells: 1 };
}

/**
 * The paper's digits for a row, averaged over the selected environments and groups.
 *
 * They exist for four detectors at horizon 1 with default settings, by environment and group.
 */
function paperMean(row, metric, selection = EVERYTHING) {
  if (row.horizon !== 1 || Object.keys(row.overrides).length || selection.anomaly[0] !== "*") return null;
  const found = Object.entries(DATA.paper).filter(([environment]) => ["*", environment].includes(selection.environment))
    .flatMap(([, byMetric]) => Object.entries(byMetric[metric] ?? {}))
    .filter(([group]) => ["*", `*${group}`].includes(selection.anomaly)).map(([, byDetector]) => byDetector[row.detector]);
  // One that is missing would make the mean one over other cells.
  if (!found.length || !found.every(isNumber)) return null;
  return metric === "auc" ? meanOf(found) / 100 : meanOf(found);
}

/** A value as text with marks: a state in place of a failed value, a star for a partial mean. */
function meanText(found, kind) {
  if (!found.cells) return "";
  return (found.state || show(found.value, kind)) + (found.partial ? "*" : "");
}

/** The interval of a mean in brackets, behind a space; nothing where there is none. */
const intervalOf = ({ low, high }, kind) => isNumber(low) ? ` [${show(low, kind)}, ${show(high, kind)}]` : "";

/** A difference in percentage points with its sign; what is rounded to nothing has none. */
function signed(share, digits = 1) {
  if (!isNumber(share)) return UNDEFINED;
  const size = Math.abs(100 * share).toFixed(digits);
  return Number(size) ? `${share < 0 ? "\u2212" : "+"}${size}` : size;
}

/** A tested difference in points and its interval, with digits enough to show whether it leaves out 0. */
function gapTexts({ difference, low, high, told }) {
  const ends = [low, high].filter(isNumber);
  if (!ends.length) return [signed(difference), "(no interval: too few test episodes)"];
  const digits = [1, 2, 3].find((n) => ends[told ? "every" : "some"]((end) => Number((100 * end).toFixed(n)))) ?? 4;
  return [signed(difference, digits), `[${signed(low, digits)}, ${signed(high, digits)}]`];
}
