// The main view: which board, what it is and says in a sentence, filters, and one sortable table of its rows.

const DEFAULTS = { board: DATA.boards[0]?.id, ...EVERYTHING, search: "", wide: false, sort: "rank", ascending: true };
const state = { ...DEFAULTS };
const FIRST = 100; // rows that a table shows before it is asked for all
let whole = false;

const currentBoard = () => DATA.boards.find((b) => b.id === state.board) ?? DATA.boards[0];

/** The address of the table as it is: what differs from a first visit. */
function tableAddress() {
  const changed = Object.entries(state).filter(([name, value]) => value !== DEFAULTS[name]);
  return "#/" + (changed.length ? `?${new URLSearchParams(changed)}` : "");
}

/** Take over what an address says; what it does not say, or says wrongly, is as on a first visit. */
function restore(text) {
  const given = new URLSearchParams(text);
  for (const [name, usual] of Object.entries(DEFAULTS)) {
    const value = given.get(name);
    state[name] = value === null ? usual : typeof usual === "boolean" ? value === "true" : value;
  }
  state.board = currentBoard().id;
}

// -- columns --------------------------------------------------------------------------------------

/** Values that others are read beside: large or small, they are no merit in a row. */
const BESIDE = /auc_placebo|_null|early_at_/;

/** A column of a metric's mean; `within` narrows the selection. */
function metricColumn(board, metric, options = {}) {
  const { title, kind, better, meaning } = DATA.metrics[metric];
  return {
    key: metric, title, unit: kind === "rate" ? "" : titleOfUnit[kind], hint: meaning, better, kind,
    // Delays at different false-alarm rates do not compare.
    marked: !BESIDE.test(metric) && (kind === "percent" || metric.includes("_at_")),
    needs: (selection) => isSummary({ ...selection, ...options.within }) ? [] : known(board, [metric]),
    of: (row, selection) => mean(board, row, metric, { ...selection, ...options.within }),
    ...options,
  };
}

/** A cost: two digits are more than what two machines agree on. */
const costText = (value) => isNumber(value) && value < 0.001 ? "< 0.001" : brief(value, 2);

/** A column of a plain number of a row. */
const plainColumn = (key, title, unit, hint, of, options = {}) =>
  ({ key, title, unit, hint, better: "lower", text: ({ value }) => costText(value), of: (row) => ({ value: of(row), cells: 1 }), ...options });

const RANK = plainColumn("rank", "Rank", "", "Position among the ranked rows by the mean over all cells; rows not told from the first share 1, and = stands where a row is not told from the row above it",
  (row) => row.place, { better: "" });

const DETECTOR = { key: "label", title: "Detector", unit: "", class: "left", better: "", hint: "Name, with settings that are not defaults; whose it is, authors, year and paper" };

const COSTS = {
  step: { title: "Scoring", unit: "\u00b5s per step", label: "microseconds per scored step" },
  fit: { title: "Fit", unit: "s", label: "seconds per fit" },
  peak: { title: "Memory", unit: "MB", label: "peak memory (MB)" },
};

/** The five columns; with one environment a column an anomaly takes the place of the worst environment. */
function headline(board, selection) {
  const environments = selection.environment === "*" ? Object.keys(board.environments) : [selection.environment];
  const one = environments.length === 1;
  const anomalies = one ? selectedAnomalies(board, selection) : [];
  const strength = (anomaly) => board.strengths[`${environments[0]}|${anomaly}`];
  const least = {
    key: "worst", title: "Worst environment", unit: "%", hint: `The least mean of ${rankingName(board)} in one environment, and which it is`, better: "higher", kind: "percent", marked: true,
    needs: ({ anomaly }) => anomaly === "*" ? [] : known(board, [board.ranking]),
    of: (row, selected) => worst(board, row, selected), under: ({ environment }) => environment && environmentOf(board, environment),
  };
  const alarms = known(board, ["found_within_20", "missed", "false_episodes"].map((metric) => `${metric}_${board.level}`)).map((metric) => metricColumn(board, metric, {
    title: DATA.metrics[metric].title.replace(/ at \d+ %/, ""), unit: `%, at ${levelOf(board)}${metric.startsWith("false") ? " [95\u00a0%]" : ""}`, interval: metric.startsWith("false"),
  }));
  return [
    ...known(board, [board.ranking]).map((metric) => metricColumn(board, metric, { interval: true, whisker: !one, unit: "% [95\u00a0%]" })),
    ...!board.parts[board.ranking] ? [] : !one ? [least] : anomalies.length < 2 ? [] : anomalies.map((anomaly) =>
      metricColumn(board, board.ranking, { key: `of-${anomaly}`, title: anomalyOf(board, anomaly).title, unit: ["%", strength(anomaly)].filter(Boolean).join(", "), hint: `${rankingTitle(board)} under ${anomalyOf(board, anomaly).title}`, within: { anomaly } })),
    ...alarms,
  ];
}

/** The five columns and, where all are asked for, means of groups, seeds, cost and every other metric. */
function columnsOf(board, selection) {
  const first = headline(board, selection);
  if (!state.wide) return first;
  const groups = selection.anomaly !== "*" ? [] : Object.keys(GROUP_TITLES).filter((group) => inGroup(board, group).length).map((group) =>
    metricColumn(board, board.ranking, { key: `group-${group}`, title: `${GROUP_TITLES[group]} anomalies`, hint: `${rankingTitle(board)} over ${group} anomalies`, within: { anomaly: `*${group}` }, interval: true }));
  const seeds = ["Lowest", "Highest"].map((title, i) => plainColumn(`seed-${i}`, `${title} seed`, "%", `${title} mean of a detector seed, over all cells`,
    (row) => row.seed_means[i], { better: "", text: ({ value }) => show(value, "percent") }));
  const costs = Object.entries(COSTS).map(([key, { title, unit, label }]) => plainColumn(key, title, unit, `Over all fits of a row: ${label}`, (row) => row.cost[key]));
  const shown = new Set(first.map(({ key }) => key));
  return [...first, ...groups, ...seeds, ...costs,
    ...board.metrics.filter((metric) => !shown.has(metric)).map((metric) => metricColumn(board, metric, { interval: board.intervals.includes(metric) }))];
}

/** A column's title with unit and meaning. */
function meaningOf({ title, unit, better, hint }) {
  const about = [unit, better && `${better} is better`].filter(Boolean).join(", ");
  return element("li", {}, element("strong", {}, title), about && ` (${about})`, `: ${sentence(hint)}`);
}

// -- what the board is ----------------------------------------------------------------------------

/** An address as a link, if it is one of the web. */
const linkTo = (url, text) => /^https?:\/\//.test(url) ? element("a", { href: url, rel: "noopener noreferrer external" }, text) : text;

/** Who a row is from: authors and year, which link to its address, and its paper. */
const creditOf = ({ authors, year, paper, url }) =>
  [linkTo(url, [authors || (url && "address"), year && `(${year})`].filter(Boolean).join(" ")), paper].filter(Boolean);

const rowLink = (row) => element("a", { href: address("detector", row.id) }, breakable(row.label));

/** The best row in a sentence: whose it is, and whether it is told from the second. */
function headlineOf(board) {
  const ranked = board.rows.filter((row) => isNumber(row.rank));
  const best = board.ranked ? ranked[0] : board.rows.find((row) => ["nominal"].includes(row.training) && isNumber(mean(board, row, board.ranking).value));
  if (!best) return element("p", { class: "headline" }, "No row is ranked.");
  const found = mean(board, best, board.ranking);
  const credit = creditOf(best).map((part, i) => [i ? ", " : " by ", part]);
  const told = ranked[1] && best !== ranked[1] && ranked[1].first;
  const band = ranked.filter((row) => row.band);
  return element("p", { class: "headline" }, board.ranked ? "Best: " : "Highest reported mean: ", element("strong", {}, rowLink(best)), credit,
    `, ${rankingName(board)} ${show(found.value, "percent")}\u00a0%${intervalOf(found, "percent")}. `,
    board.ranked && told && [`It is ${told.told ? "" : "not "}told from the second, `, rowLink(ranked[1]), `: the difference is ${gapTexts(told).join(" points ")}.`],
    band.length > 2 && ` The first band has ${band.length} rows: none of them is told from the first.`,
    board.ranked && !ranked[1] && "There is no second ranked row.");
}

/** Title, date, digest and headline of a board. */
function headOf(board) {
  const { season } = board;
  const count = (n, name) => `${n} ${name}${n === 1 ? "" : "s"}`;
  const facts = [
    board.date && `${season ? "Run until" : "Latest record of"} ${board.date}`, count(Object.keys(board.environments).length, "environment"), count(board.cells.length, "cell"),
    board.tests.length && `${board.tests.join(", ")} test ${board.paired ? "seeds" : "episodes"} each`, `protocol ${board.protocol}`, `digest ${board.digest.slice(0, 12)}`,
    board.limit !== null && `first ${board.limit} trajectories of each part: for trying only`,
  ].filter(Boolean);
  return [
    element("h1", {}, board.title),
    board.notice && element("p", { class: "notice" }, board.notice),
    headlineOf(board),
    element("p", { class: "lead" }, facts.join(" \u00b7 ")),
    season && element("details", { class: "proof" }, element("summary", {}, "Bits, digest, and what was drawn"), element("dl", { class: "facts" },
      [["Bits", season.bits], ["Split", board.split], ["Digest", board.digest], ["Seeds", season.seeds.join(", ")], ["oodd-eval", season.oodd_eval],
        ["The split again", element("code", { class: "bibtex" }, season.command)]].map(([name, value]) => [element("dt", {}, name), element("dd", {}, value)])),
      scroller(tableOf({ class: "plain" }, `${season.drawn.title}. ${season.drawn.note}`, season.drawn.header.map(sentenceCase),
        season.drawn.rows.map(([environment, ...kinds]) => lineOf(environmentOf(board, environment), kinds.map((text) => element("td", { class: "text" }, text))))))),
  ];
}

// -- rows -----------------------------------------------------------------------------------------

/** A function of rows that is worked out once for each. */
function once(of) {
  const found = new Map();
  return (row) => {
    if (!found.has(row)) found.set(row, of(row));
    return found.get(row);
  };
}

/** Rows that the search leaves, sorted by a column; what has no value stays last. */
function rowsOf(board, columns) {
  const sought = state.search.trim().toLowerCase();
  const rows = board.rows.filter((row) => !sought || [row.label, row.plugin, row.authors, row.paper, String(row.year ?? ""), ORIGINS[row.origin]?.[0] ?? ""].some((text) => text.toLowerCase().includes(sought)));
  const sign = state.ascending ? 1 : -1;
  const label = (a, b) => a.label < b.label ? -1 : Number(a.label > b.label);
  if (state.sort === "label") return rows.sort((a, b) => sign * label(a, b));
  const column = [RANK, ...columns].find((c) => c.key === state.sort) ?? RANK;
  const value = once((row) => column.of(row, state).value);
  return rows.sort((a, b) => isNumber(value(b)) - isNumber(value(a)) || sign * (value(a) - value(b)) || a.place - b.place);
}

/** Sort by another column, best first, or turn the order round. */
function sortBy({ key, better }) {
  if (state.sort === key) state.ascending = !state.ascending;
  else Object.assign(state, { sort: key, ascending: better !== "higher" });
  drawTable();
}

/** Store a control's value and draw what depends on it; the table stands as it is ranked. */
function change(name, value) {
  const board = name === "board" ? { ...DEFAULTS } : {};
  Object.assign(state, board, { [name]: value, sort: DEFAULTS.sort, ascending: DEFAULTS.ascending });
  drawControls();
  drawTable();
  document.querySelector(`#overview [name="${name}"]:is(select, :checked)`)?.focus();
}

/** The tabs of boards, the head of the board, and the controls of its table. */
function drawControls() {
  const board = currentBoard();
  const environments = Object.entries(board.environments);
  const groups = Object.keys(GROUP_TITLES).filter((group) => inGroup(board, group).length);
  const lists = {
    environment: [["*", "All environments"], ...environments],
    anomaly: [["*", "All anomalies"], ...groups.length > 1 ? groups.map((group) => [`*${group}`, `${GROUP_TITLES[group]} anomalies`]) : [], ...Object.entries(board.anomalies).map(([name, { title }]) => [name, title])],
  };
  const select = (name, title) => {
    if (!lists[name].some(([value]) => value === state[name])) state[name] = "*";
    return lists[name].length > 2 && dropdown(name, title, lists[name], state[name], (value) => change(name, value));
  };
  document.getElementById("boards").replaceChildren(...DATA.boards.length > 1
    ? [tabs("board", "Tables", DATA.boards.map((b) => [b.id, b.name]), state.board, (value) => change("board", value))] : [],
    ...DATA.suites.length ? [element("a", { href: "#/power", class: "further" }, "Weaker anomalies, worlds, logs")] : []);
  document.getElementById("head").replaceChildren(...headOf(board).filter(Boolean));
  document.getElementById("filters").replaceChildren(...[
    element("label", {}, element("span", {}, "Search"), element("input", {
      type: "search", name: "search", value: state.search, placeholder: "detector, author, paper",
      oninput: (event) => { state.search = event.target.value; drawTable(); },
    })),
    select("environment", "Environment"), select("anomaly", "Anomaly"),
    element("button", {
      type: "button", class: "action", id: "wide", "aria-pressed": String(state.wide),
      onclick: () => { change("wide", !state.wide); document.getElementById("wide").focus(); },
    }, state.wide ? "Five columns" : "All columns"),
    csvButton("leaderboard", () => document.getElementById("ranking")),
  ].filter(Boolean));
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
  const rows = rowsOf(board, columns);
  const lines = rows.slice(0, whole ? Infinity : FIRST);
  const inOrder = state.sort === RANK.key && state.ascending && !state.search && selectsAll(board);
  const key = JSON.stringify([state.board, state.environment, state.anomaly, state.wide, inOrder, lines.map(({ id }) => id).sort()]);
  if (body?.key !== key) body = { key, lines: linesOf(board, lines, columns, inOrder) };
  const focused = document.activeElement?.dataset?.sort;
  const all = [...board.ranked ? [{ ...RANK, class: "rank" }] : [], DETECTOR, ...columns];
  document.getElementById("meanings").replaceChildren(...all.map(meaningOf));
  place.replaceChildren(element("table", { id: "ranking", class: columns.length > 8 ? "board dense" : "board" },
    captionOf(what(board, rows, board.ranked && inOrder)),
    element("thead", {}, element("tr", {}, all.map(header))),
    element("tbody", {}, lines.map((row) => body.lines.get(row)))));
  if (rows.length > FIRST && !whole) {
    place.append(element("button", { type: "button", class: "action", id: "all", onclick: () => { whole = true; drawTable(); } }, `Show all ${rows.length} rows`));
  }
  if (focused) place.querySelector(`[data-sort="${CSS.escape(focused)}"]`)?.focus();
  document.getElementById("notes").replaceChildren(...notesOf(board, rows));
  history.replaceState(null, "", tableAddress());
}

const selectsAll = (board) => cellsOf(board, state).length === board.cells.length;

/** The elements of the table's lines, by row. */
function linesOf(board, rows, columns, inOrder) {
  const found = new Map(board.rows.map((row) => [row, columns.map((column) => column.of(row, state))]));
  const best = columns.map((column, i) => bestOf(column, board.rows.filter(mayBeBest).map((row) => found.get(row)[i].value)));
  const lows = board.rows.map((row) => mean(board, row, board.ranking, state)).map(({ low, value }) => low ?? value);
  const start = Math.min(0.4, Math.floor(10 * Math.min(...lows.filter(isNumber))) / 10);
  const last = inOrder && board.rows.findLast((row) => row.band);
  return new Map(rows.map((row) => [row, tableRow(board, row, columns, found.get(row), { best, start, inOrder, last: row === last })]));
}

/** Whether a row can be marked as the best: it is ranked, and knows something of the dynamics. */
const mayBeBest = (row) => isNumber(row.rank) && !row.trivial;

/** The value that a column marks; null where it marks none. */
function bestOf(column, values) {
  const numbers = values.filter(isNumber);
  if (!column.marked || !numbers.length) return null;
  return column.better === "higher" ? Math.max(...numbers) : Math.min(...numbers);
}

function header(column) {
  const active = state.sort === column.key;
  return element("th", { scope: "col", "aria-sort": active ? (state.ascending ? "ascending" : "descending") : "none", class: column.class, "data-csv": column.unit ? `${column.title} (${column.unit})` : column.title },
    element("button", { type: "button", "data-sort": column.key, title: column.hint, onclick: () => sortBy(column) },
      column.title.replace(/ %/g, "\u00a0%"), element("span", { class: "arrow", "aria-hidden": "true" }, active ? (state.ascending ? "\u25b2" : "\u25bc") : "\u2195")),
    column.unit && element("span", { class: "unit" }, column.unit));
}

function tableRow(board, row, columns, values, { best, start, inOrder, last }) {
  const out = board.ranked ? !isNumber(row.rank) : row.variant || row.training !== "nominal";
  const kinds = { trivial: row.trivial, out, band: inOrder && row.band, last };
  return element("tr", { class: Object.keys(kinds).filter((name) => kinds[name]).join(" ") || null, "data-row": row.id },
    board.ranked && element("td", { class: "rank" }, out ? UNDEFINED : String(row.rank),
      inOrder && row.equal && element("span", { class: "equal", title: `Not told from the row above: ${gapTexts(row.above).join(" points ")}` }, "=")),
    element("th", { scope: "row", "data-csv": row.label }, rowLink(row), " ", badges(row),
      element("span", { class: "under" }, creditOf(row).map((part, i) => element("span", { class: i ? "paper" : null }, i ? ", " : null, part))),
      row.state && element("span", { class: row.failed.length ? "under state" : "under" }, `${board.ranked ? "Not ranked: " : ""}${row.state}`)),
    columns.map((column, i) => {
      const found = values[i];
      const text = column.text ? column.text(found) : meanText(found, column.kind);
      const strong = mayBeBest(row) && best[i] !== null && show(found.value, column.kind) === show(best[i], column.kind);
      const under = column.under ? column.under(found) : column.interval && isNumber(found.low) && intervalOf(found, column.kind).trim();
      return element("td", { class: found.state ? "state" : column.whisker ? "wide" : null, title: found.reason || null, "data-csv": text },
        column.whisker && whisker(found, start), element(strong ? "strong" : "span", { class: "value" }, text), under && element("span", { class: "interval" }, under));
    }));
}

const ORIGINS = {
  paper: ["the paper\u2019s", "From the paper that the benchmark is of"], others: ["others\u2019", "By other authors"], project: ["ours", "By the authors of oodd-eval"],
  trivial: ["trivial", "Knows nothing of the dynamics: what a detector has to beat"], oracle: ["oracle", "Has the true equations of the environment: not ranked"],
};

/** Whose a row is, and why it is another kind of row. */
function badges(row) {
  const badge = (text, title) => [element("span", { class: "badge", title }, text), " "];
  return [
    ORIGINS[row.origin] && badge(...ORIGINS[row.origin]),
    row.variant && badge("variant", "A further row of a detector or distribution: not ranked"),
    !["nominal", "oracle"].includes(row.training) && badge(`trained on ${row.training}`, "Learns from more than nominal trajectories of the split: not ranked"),
  ];
}

/** Horizon, inputs and seeds of a row. */
const settingsOf = (row) => [`\u0394\u202f=\u202f${row.horizon}`, row.inputs.replace("+", " + "), row.seeds.length > 1 && `${row.seeds.length}\u00a0seeds`].filter(Boolean).join("\u00a0\u00b7 ");

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
function what(board, rows, inOrder) {
  const cells = cellsOf(board, state).length;
  const environment = state.environment === "*" ? "all environments" : environmentOf(board, state.environment);
  const anomaly = state.anomaly === "*" ? "all anomalies" : state.anomaly[0] === "*" ? `${state.anomaly.slice(1)} anomalies` : anomalyOf(board, state.anomaly).title;
  const shown = rows.length === board.rows.length ? `${rows.length} row${rows.length === 1 ? "" : "s"}` : `${rows.length} of ${board.rows.length} rows`;
  const marks = inOrder ? " Set off: the first band, rows not told from the first. =: not told from the row above." : "";
  return `${board.name}: ${environment}, ${anomaly} (means over ${cells} cell${cells === 1 ? "" : "s"}; ${shown}).${marks}`;
}

/** What has to stand below a table. */
function notesOf(board, rows) {
  const lines = [
    board.ranked && !selectsAll(board) && "Ranks are those over all cells of the board, whatever is selected.",
    board.ranked && rows.some((row) => row.seeds.length > 1) && `Every row has the same detector seeds (${board.season.seeds.join(", ")}), or one seed where it has no randomness. Intervals are over test episodes.`,
    Object.values(board.strengths).some(Boolean) && "Every cell has a strength of its own: the table of one environment and the page of a row name it, and means are over these strengths.",
    ...board.about,
    rows.some((row) => mean(board, row, board.ranking, state).partial) && "* A mean over fewer cells than other rows have.",
  ];
  return lines.filter(Boolean).map((text) => element("li", {}, text));
}
