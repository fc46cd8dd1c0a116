// The main view: filters, and one sortable table of a board's rows.

const DEFAULTS = {
  board: DATA.boards[0]?.id, ...EVERYTHING, horizon: "all", inputs: "all", search: "", trivial: true,
  view: "ranking", sort: "auc_matched", ascending: false,
};
const state = { ...DEFAULTS };
const unfolded = new Set();
const FIRST = 100; // detectors that a table shows before it is asked for all
let whole = false;

/** The address of the table as it is: what differs from a first visit. */
function tableAddress() {
  const changed = Object.entries(state).filter(([name, value]) => value !== DEFAULTS[name]);
  return "#/" + (changed.length ? `?${new URLSearchParams(changed)}` : "");
}

/** Take over what an address says; what it does not say, or says wrongly, is as on a first visit. */
function restore(text) {
  const given = new URLSearchParams(text);
  const known = {
    board: (v) => DATA.boards.some((b) => b.id === v),
    group: (v) => Object.hasOwn(GROUP_TITLES, v),
    view: (v) => Object.hasOwn(LISTS, v),
  };
  for (const [name, usual] of Object.entries(DEFAULTS)) {
    const value = given.get(name);
    if (typeof usual === "boolean") state[name] = value === null ? usual : value === "true";
    else state[name] = value !== null && (known[name]?.(value) ?? true) ? value : usual;
  }
}

/** Rows that the filters leave. */
function rowsOf(board) {
  const sought = state.search.trim().toLowerCase();
  return board.rows.filter((row) =>
    (state.horizon === "all" || String(row.horizon) === state.horizon) &&
    (state.inputs === "all" || row.inputs === state.inputs) &&
    (state.trivial || !row.trivial) &&
    (!sought || [row.label, row.plugin, row.submitter].some((text) => text.toLowerCase().includes(sought))));
}

/**
 * Sorted rows as they stand in the table: each detector's first row, with the others below it where
 * they are unfolded. First is the primary row, or the best of those that the filters leave.
 */
function folded(rows) {
  const byDetector = groupedBy(rows, (row) => row.detector);
  const first = new Map([...byDetector].map(([detector, own]) => [own.find((row) => row.primary) ?? own[0], detector]));
  return rows.filter((row) => first.has(row)).slice(0, whole ? Infinity : FIRST).flatMap((row) => {
    const others = byDetector.get(row.detector).filter((other) => other !== row);
    const open = unfolded.has(row.detector);
    return [{ row, others: others.length, open }, ...(open ? others.map((other) => ({ row: other, variant: true })) : [])];
  });
}

function groupedBy(items, key) {
  const found = new Map();
  for (const item of items) {
    if (!found.has(key(item))) found.set(key(item), []);
    found.get(key(item)).push(item);
  }
  return found;
}

/** A function of rows that is worked out once for each. */
function once(of) {
  const known = new Map();
  return (row) => {
    if (!known.has(row)) known.set(row, of(row));
    return known.get(row);
  };
}

/** The ranks that stand in a view. */
function rankOfView(board = currentBoard()) {
  const rank = listOf(board, state.view).rank ?? RANK;
  return board.paired || rank === RANK ? rank : { ...rank, hint: "1 plus the number of rows that are significantly better by the first column" };
}

/** The key of the column that the table is sorted by; on a first visit that of the metric that ranks. */
const sortKey = (board) => state.sort === DEFAULTS.sort ? board.ranking : state.sort;

/** Sort by a column, by the metric that ranks when the view has no such column; what has no value last. */
function sorted(board, rows, columns) {
  const label = (a, b) => a.label < b.label ? -1 : Number(a.label > b.label);
  if (state.sort === "label") return [...rows].sort((a, b) => (state.ascending ? 1 : -1) * label(a, b));
  const matched = once((row) => mean(board, row, board.ranking, state).value);
  const column = [rankOfView(), ...columns].find((c) => c.key === sortKey(board));
  const value = column ? once((row) => column.of(row, state).value) : matched;
  const sign = column && state.ascending ? 1 : -1;
  return [...rows].sort((a, b) => {
    const [x, y] = [value(a), value(b)];
    const defined = isNumber(y) - isNumber(x);
    return defined || sign * (x - y) || matched(b) - matched(a) || label(a, b);
  });
}

/** Sort by another column, best first, or turn the order round. */
function sortBy(key, better) {
  if (sortKey(currentBoard()) === key) state.ascending = !state.ascending;
  else Object.assign(state, { sort: key, ascending: better !== "higher" });
  drawTable();
}

let drawing = 0;
let body = null; // lines of the table that stands there: they are kept where only their order changes

/** Draw the table, once the data that its columns need is there. */
async function drawTable() {
  const own = ++drawing;
  const board = currentBoard();
  const columns = columnsOf(board, state);
  const place = document.getElementById("table");
  const needed = [...new Set(columns.flatMap((column) => column.needs?.(state) ?? []))];
  if (needed.some((metric) => !partOf(board, metric))) {
    place.setAttribute("aria-busy", "true");
    try {
      await loadMetrics(board, needed);
    } catch (error) {
      if (own === drawing) place.replaceChildren(notLoaded(error));
      return;
    }
    if (own !== drawing) return;
  }
  place.removeAttribute("aria-busy");
  markNavigation(state.view === "guaranteed" ? ALARMS : "");
  const rows = sorted(board, rowsOf(board), columns);
  const lines = folded(rows);
  const { sort, ascending, ...shown } = state;
  const key = JSON.stringify([shown, [...unfolded], whole || lines.map(({ row }) => row.id)]);
  if (body?.key !== key) body = { key, lines: linesOf(board, rows, lines, columns) };
  const focused = document.activeElement?.dataset?.key;
  const all = [{ ...rankOfView(), class: "rank" }, DETECTOR, ...columns];
  explain(all);
  const table = element("table", { id: "ranking", class: "board" },
    captionOf(what(board, rows)),
    element("thead", {}, element("tr", {}, all.map((column) => header(column, all)))),
    element("tbody", {}, lines.map(({ row }) => body.lines.get(row))),
  );
  const detectors = new Set(rows.map((row) => row.detector)).size;
  place.replaceChildren(columns.length ? table : element("p", { class: "note" }, listOf(board, state.view).empty));
  if (detectors > FIRST && !whole) {
    place.append(element("button", { type: "button", class: "action", id: "all", onclick: () => { whole = true; drawTable(); } }, `Show all ${detectors} detectors`));
  }
  if (focused) place.querySelector(`[data-key="${CSS.escape(focused)}"]`)?.focus();
  document.getElementById("notes").replaceChildren(...notesOf(board, rows));
  history.replaceState(null, "", tableAddress());
}

/** The elements of the table's lines, by row. */
function linesOf(board, rows, lines, columns) {
  const found = new Map(rows.map((row) => [row, columns.map((column) => column.of(row, state))]));
  const best = columns.map((column, i) => bestOf(column, rows.filter((r) => !r.trivial).map((r) => found.get(r)[i].value)));
  const start = axisStart(board);
  return new Map(lines.map((line) => [line.row, tableRow(line, columns, found.get(line.row), best, start)]));
}

/** The value that a column marks; null where it marks none. */
function bestOf(column, values) {
  const numbers = values.filter(isNumber);
  if (!column.marked || !numbers.length) return null;
  return column.better === "higher" ? Math.max(...numbers) : Math.min(...numbers);
}

const DETECTOR = {
  key: "label", title: "Detector", unit: "", class: "left",
  hint: "Name, and settings that are not defaults; below it horizon, inputs and seeds",
};

/** A column's title, which ends its lines before a number and its unit, not between. */
const columnTitle = (column) => column.title.replace(/ %/g, "\u00a0%");

/** A column's title with unit and meaning. */
function meaningOf(column) {
  const better = column.better && !["rank", "alarm_rank"].includes(column.key) ? `${column.better} is better` : "";
  const about = [column.unit, better].filter(Boolean).join(", ");
  return [element("strong", {}, columnTitle(column)), about && ` (${about})`, `: ${column.hint}.`];
}

/** Say above the table what a column means: the one that it is sorted by, or the one under pointer or focus. */
function sayMeaning(columns, column) {
  const sorted = columns.find((c) => c.key === sortKey(currentBoard())) ?? columns[0];
  document.getElementById("meaning").replaceChildren(...meaningOf(column ?? sorted).filter(Boolean));
}

/** What all columns and marks of the table mean, to be unfolded above it. */
function explain(columns) {
  sayMeaning(columns, null);
  document.getElementById("meanings").replaceChildren(...columns.map((column) => element("li", {}, meaningOf(column))));
}

function header(column, columns) {
  const active = sortKey(currentBoard()) === column.key;
  const order = active ? (state.ascending ? "ascending" : "descending") : "none";
  return element("th", { scope: "col", "aria-sort": order, class: column.class },
    element("button", {
      type: "button", "data-sort": column.key, "data-key": column.key, title: column.hint,
      onclick: () => sortBy(column.key, column.better),
      onfocus: () => sayMeaning(columns, column), onblur: () => sayMeaning(columns, null),
      onpointerenter: () => sayMeaning(columns, column), onpointerleave: () => sayMeaning(columns, null),
    }, columnTitle(column), element("span", { class: "arrow", "aria-hidden": "true" },
      active ? (state.ascending ? "\u25b2" : "\u25bc") : "\u2195")),
    column.unit && element("span", { class: "unit" }, column.unit));
}

function tableRow({ row, others, open, variant }, columns, values, best, start) {
  const rank = rankOfView().of(row).value;
  return element("tr", { class: [row.trivial && "trivial", variant && "variant"].filter(Boolean).join(" ") || null, "data-row": row.id },
    element("td", { class: "rank" }, isNumber(rank) ? String(rank) : element("span", { title: row.state }, UNDEFINED),
      rankOfView() === RANK && row.ties && element("span", { class: "ties", title: "Tie groups: rows that share a letter cannot be told apart" }, row.ties)),
    element("th", { scope: "row" },
      element("a", { href: address("detector", row.id) }, breakable(row.label)), " ", badges(row),
      element("span", { class: "under" }, underLabel(row)),
      others ? foldButton(row, others, open) : null),
    columns.map((column, i) => {
      const found = values[i];
      const text = column.text ? column.text(found.value, row) : meanText(found, column.kind);
      const strong = isNumber(found.value) && !row.trivial && found.value === best[i];
      return element("td", { class: found.state ? "state" : column.whisker ? "wide" : null, title: found.state ? found.reason : null, "data-csv": text },
        column.whisker && whisker(found, start),
        element(strong ? "strong" : "span", { class: "value" }, text),
        column.interval && isNumber(found.low) && element("span", { class: "interval" },
          `[${show(found.low, column.kind)}, ${show(found.high, column.kind)}]`));
    }));
}

/** The button that shows or hides the other rows of a detector. */
function foldButton(row, others, open) {
  const text = `${others} variant${others === 1 ? "" : "s"}`;
  return element("button", {
    type: "button", class: "fold", "aria-expanded": String(open), "data-key": `fold-${row.detector}`,
    onclick: () => {
      if (!unfolded.delete(row.detector)) unfolded.add(row.detector);
      drawTable();
    },
  }, open ? `\u2212 hide ${text}` : `+ ${text}`);
}

/** What stands under a label: horizon, inputs, seeds. */
function underLabel(row) {
  const parts = [`\u0394\u202f=\u202f${row.horizon}`];
  if (row.inputs) parts.push(row.inputs.replace("+", " + "));
  if (row.seeds.length > 1) parts.push(`${row.seeds.length}\u00a0seeds`);
  return parts.join("\u00a0\u00b7 ");
}

/** True for a row that learns from more than nominal trajectories of the split. */
function isTrainedOnMore(row) {
  return !["nominal", "oracle"].includes(row.training);
}

function badges(row) {
  return [
    row.trivial && element("span", { class: "badge", title: "Knows nothing of the dynamics: what a detector has to beat" }, "trivial"),
    isTrainedOnMore(row) && element("span", { class: "badge", title: "Learns from more than nominal trajectories of the split: not ranked" }, `trained on ${row.training}`),
    row.training === "oracle" && element("span", { class: "badge", title: "Has the true equations of the environment: not ranked" }, "oracle"),
  ];
}

/** Where the axis of the small drawings begins: it is the same for all rows and ends at 1. */
function axisStart(board) {
  const lows = board.rows.map((r) => mean(board, r, board.ranking, state)).map((m) => m.low ?? m.value);
  return Math.min(0.4, Math.floor(10 * Math.min(...lows.filter(isNumber))) / 10);
}

/** A small drawing of a mean with its interval. */
function whisker(found, left) {
  if (!isNumber(found.value)) return null;
  const x = (value) => (4 + 112 * (value - left) / (1 - left)).toFixed(1);
  const upright = (name, value, y) => shape("line", { class: name, x1: x(value), x2: x(value), y1: y, y2: 16 - y });
  const bar = isNumber(found.low) && [
    shape("line", { class: "bar", x1: x(found.low), x2: x(found.high), y1: 8, y2: 8 }),
    upright("bar", found.low, 4.5), upright("bar", found.high, 4.5),
  ];
  return shape("svg", { class: "whisker", viewBox: "0 0 120 16", width: 120, height: 16, "aria-hidden": "true" },
    shape("line", { class: "axis", x1: x(left), x2: x(1), y1: 8, y2: 8 }),
    upright("half", 0.5, 1), bar, shape("circle", { cx: x(found.value), cy: 8, r: 2.8 }));
}

/** What the table is over, in words. */
function what(board, rows) {
  const cells = cellsOf(board, state).length;
  const where = state.environment === "all" ? "all environments"
    : { classic: "classic-control environments", bullet: "Bullet environments" }[state.environment]
      ?? environmentOf(board, state.environment).title;
  const anomalies = state.anomaly !== "all" ? anomalyOf(board, state.anomaly).title
    : state.group === "all" ? "all anomalies" : `${state.group} anomalies`;
  const shown = rows.length === board.rows.length ? `${rows.length} rows` : `${rows.length} of ${board.rows.length} rows`;
  const { title: name, over, level } = listOf(board, state.view);
  const title = level && !board.paired ? `${name} at ${level(board)}` : name;
  return over ? `${title}: ${over} (${shown})`
    : `${title}: ${where}, ${anomalies} (means over ${cells} cell${cells === 1 ? "" : "s"}; ${shown})`;
}

/** Sentences below a table that has such rows. */
const NOTES = [
  [isTrainedOnMore, "Rows trained on more than nominal trajectories of the split are not ranked."],
  [(row) => row.training === "oracle", "An oracle has the true equations of the environment. It says how far the limit is, and is not ranked."],
  [(row) => row.lead && isSummary(state), "Lead: in how many of the cases in which one environment is left out the row\u2019s mean stays above that of the next rank."],
];

/** What has to stand below a table. */
function notesOf(board, rows) {
  const limit = board.limit === null ? "" : `, limited to the first ${board.limit} trajectories of each part: for trying only`;
  const lines = [
    `Split ${board.split}, digest ${board.digest.slice(0, 12)}, protocol ${board.protocol}, ` +
    `${board.paired ? `${board.tests.join(", ")} test seeds per environment` : "episodes without twins"}${limit}. Tables never mix splits or protocols.`,
    ...board.about,
    selectsLess(state) && "Ranks, tie groups and wins are those over all cells of the board, whatever is selected.",
    !isSummary(state) && `Over single environments or anomalies only ${rankingName(board)} has intervals here; every detector's page has those of single cells.`,
    ...NOTES.map(([applies, sentence]) => rows.some(applies) && sentence),
    ...rows.filter((row) => row.state).map((row) => `Not ranked: ${row.label}, ${row.state}.`),
    ...[...groupedBy(rows.filter((row) => row.caption), (row) => row.caption)].map(([caption, own]) => `${own.map((row) => row.label).join(", ")}: ${caption}`),
    rows.some((row) => mean(board, row, board.ranking, state).partial) && "* A mean over fewer cells than other rows have.",
  ];
  return lines.filter(Boolean).map((line) => element("li", {}, line));
}

const selectsLess = (selection) => Object.keys(EVERYTHING).some((name) => selection[name] !== "all");
