// The main view: filters, and one sortable table of a board's rows.

const state = {
  board: DATA.boards[0]?.id, ...EVERYTHING, horizon: "all", inputs: "all", trivial: true,
  view: "ranking", sort: "auc_matched", ascending: false,
};

/** Rows that the filters leave. */
function rowsOf(board) {
  return board.rows.filter((row) =>
    (state.horizon === "all" || String(row.horizon) === state.horizon) &&
    (state.inputs === "all" || row.inputs === state.inputs) &&
    (state.trivial || !row.trivial));
}

/** Sort by a column, by matched AUC when the view has no such column; what has no value last. */
function sorted(board, rows, columns) {
  const label = (a, b) => a.label.localeCompare(b.label);
  if (state.sort === "label") return [...rows].sort((a, b) => (state.ascending ? 1 : -1) * label(a, b));
  const matched = (row) => mean(board, row, "auc_matched", state).value;
  const column = [RANK, ...columns].find((c) => c.key === state.sort);
  const value = column ? (row) => column.of(row, state).value : matched;
  const sign = column && state.ascending ? 1 : -1;
  return [...rows].sort((a, b) => {
    const [x, y] = [value(a), value(b)];
    const defined = isNumber(y) - isNumber(x);
    return defined || sign * (x - y) || matched(b) - matched(a) || label(a, b);
  });
}

/** Sort by another column, best first, or turn the order round. */
function sortBy(key, better) {
  if (state.sort === key) state.ascending = !state.ascending;
  else Object.assign(state, { sort: key, ascending: better !== "higher" });
  drawTable();
}

function drawTable() {
  const board = DATA.boards.find((b) => b.id === state.board);
  const columns = columnsOf(board, state);
  const rows = sorted(board, rowsOf(board), columns);
  const focused = document.activeElement?.dataset?.sort;
  const table = element("table", { id: "ranking", class: "board" },
    element("caption", {}, captionOf(board, rows)),
    element("thead", {}, element("tr", {}, [
      header(RANK),
      header({ key: "label", title: "Detector", unit: "", hint: "Name, and settings that are not defaults", left: true, better: "lower" }),
      ...columns.map(header),
    ])),
    element("tbody", {}, rows.map((row) => tableRow(board, row, columns, rows))),
  );
  const place = document.getElementById("table");
  place.replaceChildren(columns.length ? table : element("p", { class: "note" }, LISTS[state.view].empty));
  if (focused) place.querySelector(`[data-sort="${focused}"]`)?.focus();
  document.getElementById("notes").replaceChildren(...notesOf(board, rows));
}

function header(column) {
  const active = state.sort === column.key;
  const order = active ? (state.ascending ? "ascending" : "descending") : "none";
  return element("th", { scope: "col", "aria-sort": order, class: column.left && "left" },
    element("button", {
      type: "button", "data-sort": column.key, title: column.hint,
      onclick: () => sortBy(column.key, column.better),
    }, column.title, element("span", { class: "arrow", "aria-hidden": "true" },
      active ? (state.ascending ? "\u25b2" : "\u25bc") : "\u2195")),
    column.unit && element("span", { class: "unit" }, column.unit));
}

function tableRow(board, row, columns, rows) {
  const best = (column) => {
    const numbers = rows.filter((r) => !r.trivial).map((r) => column.of(r, state).value).filter(isNumber);
    return column.better === "higher" ? Math.max(...numbers) : Math.min(...numbers);
  };
  return element("tr", { class: row.trivial ? "trivial" : null, "data-row": row.id },
    element("td", { class: "rank" }, row.rank ?? element("span", { title: row.state }, UNDEFINED),
      row.ties && element("span", { class: "ties", title: "Tie groups: rows that share a letter cannot be told apart" }, row.ties)),
    element("th", { scope: "row" },
      element("a", { href: address("detector", row.id) }, row.label), " ", badges(row),
      element("span", { class: "under" }, underLabel(row))),
    columns.map((column) => {
      const found = column.of(row, state);
      const text = column.plain
        ? (isNumber(found.value) ? (column.fixed ? found.value.toFixed(column.digits) : brief(found.value)) : UNDEFINED)
        : meanText(found, column.kind);
      const strong = isNumber(found.value) && !row.trivial && column.marked && found.value === best(column);
      return element("td", { class: found.state ? "state" : column.whisker ? "wide" : null, title: found.state ? reasonOf(row) : null },
        element(strong ? "strong" : "span", { class: "value" }, text),
        column.whisker && whisker(board, found),
        column.interval && isNumber(found.low) && element("span", { class: "interval" },
          `[${show(found.low, column.kind)}, ${show(found.high, column.kind)}]`));
    }));
}

/** What stands under a label: inputs, horizon, seeds. */
function underLabel(row) {
  const parts = [`\u0394\u202f=\u202f${row.horizon}`];
  if (row.inputs) parts.push(row.inputs.replace("+", " + "));
  if (row.seeds.length > 1) parts.push(`${row.seeds.length} seeds`);
  return parts.join(" \u00b7 ");
}

const TRUST = {
  "reported": "Numbers as submitted, checked for consistency",
  "re-scored": "Recomputed here from the submitted scores",
  "re-run": "Fitted and scored again",
};

function badges(row) {
  return [
    row.trivial && element("span", { class: "badge", title: "Knows nothing of the dynamics: what a detector has to beat" }, "trivial"),
    " ", element("span", { class: `badge ${row.trust}`, title: TRUST[row.trust] ?? "" }, row.trust),
  ];
}

const reasonOf = (row) => row.cells.find((cell) => cell.status)?.reason ?? "";

/** A small drawing of a mean with its interval, on an axis that all rows share. */
function whisker(board, found) {
  if (!isNumber(found.value)) return null;
  const lows = board.rows.map((r) => mean(board, r, "auc_matched", state)).map((m) => m.low ?? m.value);
  const left = Math.min(0.4, Math.floor(10 * Math.min(...lows.filter(isNumber))) / 10);
  const x = (value) => (4 + 172 * (value - left) / (1 - left)).toFixed(1);
  const upright = (name, value, y) => shape("line", { class: name, x1: x(value), x2: x(value), y1: y, y2: 16 - y });
  const bar = isNumber(found.low) && [
    shape("line", { class: "bar", x1: x(found.low), x2: x(found.high), y1: 8, y2: 8 }),
    upright("bar", found.low, 4.5), upright("bar", found.high, 4.5),
  ];
  return shape("svg", { class: "whisker", viewBox: "0 0 180 16", width: 180, height: 16, "aria-hidden": "true" },
    shape("line", { class: "axis", x1: x(left), x2: x(1), y1: 8, y2: 8 }),
    upright("half", 0.5, 1), bar, shape("circle", { cx: x(found.value), cy: 8, r: 2.8 }));
}

/** What the table is over, in words. */
function captionOf(board, rows) {
  const cells = cellsOf(board, state);
  const where = state.environment === "all" ? "all environments"
    : { classic: "classic-control environments", bullet: "Bullet environments" }[state.environment]
      ?? DATA.environments[state.environment].title;
  const what = state.anomaly !== "all" ? DATA.anomalies[state.anomaly].title
    : state.group === "all" ? "all anomalies" : `${state.group} anomalies`;
  const shown = rows.length === board.rows.length ? `${rows.length} rows` : `${rows.length} of ${board.rows.length} rows`;
  return `${LISTS[state.view].title}: ${where}, ${what} (means over ${cells} cell${cells === 1 ? "" : "s"}; ${shown})`;
}

/** What has to stand below a table. */
function notesOf(board, rows) {
  const limit = board.limit === null ? "" : `, limited to the first ${board.limit} trajectories of each part: for trying only`;
  const lines = [
    `Split ${board.split}, digest ${board.digest.slice(0, 12)}, protocol ${board.protocol}, ` +
    `${board.tests.join(", ")} test seeds per environment${limit}. Tables never mix splits or protocols.`,
  ];
  if (selectsLess(state)) {
    lines.push("Ranks, tie groups and wins are those over all cells of the board, whatever is selected.");
  }
  for (const row of rows.filter((r) => r.state)) lines.push(`Not ranked: ${row.label}, ${row.state}.`);
  const captions = new Map();
  for (const row of rows) {
    for (const { caption } of row.entries) {
      if (caption) captions.set(caption, [...(captions.get(caption) ?? []), row.label]);
    }
  }
  for (const [caption, labels] of captions) lines.push(`${labels.join(", ")}: ${caption}`);
  if (rows.some((row) => mean(board, row, "auc_matched", state).partial)) {
    lines.push("* A mean over fewer cells than other rows have.");
  }
  return lines.map((line) => element("li", {}, line));
}

const selectsLess = (selection) => Object.keys(EVERYTHING).some((name) => selection[name] !== "all");
