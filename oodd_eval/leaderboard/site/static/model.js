// The data of the page, and means over the cells that the filters select.

const DATA = JSON.parse(document.getElementById("data").textContent);
const ROWS = new Map(DATA.boards.flatMap((board) => board.rows.map((row) => [row.id, { board, row }])));
const EVERYTHING = { environment: "all", group: "all", anomaly: "all" };

/** Whether a cell is among those selected. */
function selects(selection, cell) {
  const { environment, group, anomaly } = selection;
  const family = DATA.environments[cell.environment].family;
  return (
    (environment === "all" || environment === family || environment === cell.environment) &&
    (group === "all" || group === DATA.anomalies[cell.anomaly].group) &&
    (anomaly === "all" || anomaly === cell.anomaly)
  );
}

/** Number of different cells, seeds aside. */
const distinct = (cells) => new Set(cells.map((c) => `${c.environment}/${c.anomaly}`)).size;

const counted = new Map();

/** Number of different cells of a selection that any row of a board has; counted once. */
function cellsOf(board, selection) {
  const key = [board.id, selection.environment, selection.group, selection.anomaly].join("|");
  if (!counted.has(key)) {
    counted.set(key, distinct(board.rows.flatMap((row) => row.cells.filter((c) => selects(selection, c)))));
  }
  return counted.get(key);
}

/**
 * Mean of a metric over the selected cells, detector seeds included.
 *
 * `state` is a failed cell's, and then there is no value; `partial` tells that other rows have
 * cells here that this one lacks. The interval is the precomputed one, or a single cell's own.
 */
function mean(board, row, metric, selection = EVERYTHING) {
  const cells = row.cells.filter((cell) => selects(selection, cell));
  const count = distinct(cells);
  const found = { value: null, low: null, high: null, state: "", cells: count, partial: false };
  if (!count) return found;
  found.partial = count < cellsOf(board, selection);
  const failed = cells.find((cell) => cell.status);
  if (failed) return { ...found, state: failed.status };
  const index = board.metrics.indexOf(metric);
  found.value = meanOf(cells.map((cell) => cell.values[index]));
  const key = `${selection.environment}|${selection.anomaly !== "all" ? selection.anomaly : selection.group}`;
  const place = board.intervals.indexOf(metric);
  const known = row.intervals[key]?.[place];
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

/** Anomalies of a board that belong to a group. */
const inGroup = (board, group) => board.anomalies.filter((a) => group === "all" || DATA.anomalies[a].group === group);

/** A value as text with marks: a state in place of a failed value, a star for a partial mean. */
function meanText(found, kind) {
  if (!found.cells) return "";
  return (found.state || show(found.value, kind)) + (found.partial ? "*" : "");
}
