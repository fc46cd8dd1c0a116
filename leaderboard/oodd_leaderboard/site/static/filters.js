// The form above the main table. Every control changes `state` and draws the table again.

function drawFilters() {
  const board = DATA.boards.find((b) => b.id === state.board);
  const environments = [
    ["all", "All environments"],
    ...["classic", "bullet"]
      .filter((family) => board.environments.some((e) => environmentOf(board, e).family === family))
      .map((family) => [family, family === "classic" ? "Classic control" : "Bullet"]),
    ...board.environments.map((e) => [e, environmentOf(board, e).title]),
  ];
  const groups = [["all", board.paired ? "Both groups" : "All groups"], ...Object.entries(GROUP_TITLES).filter(([g]) => inGroup(board, g).length)];
  if (groups.length === 1) state.group = "all";
  const anomalies = [["all", "All anomalies"], ...inGroup(board, state.group).map((a) => [a, anomalyOf(board, a).title])];
  const horizons = [...new Set(board.rows.map((row) => row.horizon))].sort((a, b) => a - b);
  const inputs = [...new Set(board.rows.map((row) => row.inputs).filter(Boolean))].sort();
  if (!listsOf(board)[state.view]) Object.assign(state, { view: "ranking", sort: DEFAULTS.sort, ascending: false });
  const views = Object.entries(listsOf(board)).map(([name, list]) => [name, list.title]);
  document.getElementById("filters").replaceChildren(
    element("label", {}, element("span", {}, "Search"), element("input", {
      type: "search", name: "search", value: state.search, placeholder: "detector, plug-in, submitter",
      oninput: (event) => { state.search = event.target.value; drawTable(); },
    })),
    select("board", "Split", DATA.boards.map((b) => [b.id, boardTitle(b)])),
    select("environment", "Environment", environments),
    ...(groups.length > 1 ? [select("group", "Group", groups)] : []),
    select("anomaly", "Anomaly", anomalies),
    select("horizon", "Horizon", [["all", "All horizons"], ...horizons.map((h) => [String(h), `\u0394 = ${h}`])]),
    select("inputs", "Inputs", [["all", "All inputs"], ...inputs.map((i) => [i, i.replace("+", " + ")])]),
    tabs("view", "Columns", views, state.view, (value) => { change("view", value); }),
    element("label", { class: "check" }, element("input", {
      type: "checkbox", name: "trivial", checked: state.trivial,
      onchange: (event) => { state.trivial = event.target.checked; drawTable(); },
    }), " trivial rows"),
    csvButton("leaderboard", () => document.getElementById("ranking")),
  );
}

function boardTitle(board) {
  const limit = board.limit === null ? "" : `, first ${board.limit}`;
  return `${board.split} (${board.digest.slice(0, 8)}), protocol ${board.protocol}${limit}`;
}

function select(name, label, options) {
  if (!options.some(([value]) => value === state[name])) state[name] = options[0][0];
  return dropdown(name, label, options, state[name], (value) => change(name, value));
}

/** Store a control's value and draw what depends on it. */
function change(name, value) {
  state[name] = value;
  if (name === "group") state.anomaly = "all";
  if (name === "view") Object.assign(state, { sort: LISTS[value]?.sort ?? DEFAULTS.sort, ascending: Boolean(LISTS[value]?.sort) });
  if (name === "board" || name === "group") {
    drawFilters();
    document.querySelector(`#filters [name="${name}"]`).focus();
  }
  drawTable();
}
