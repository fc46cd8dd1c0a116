// Pages over all rows of a board: quality against cost, and a map of detectors by cells.

const overview = { columns: "anomaly", cost: "step" };

/** Rows that stand for their detectors: all but variants. */
const primaries = (board) => board.rows.filter((row) => !row.variant);

const redraw = (draw) => document.getElementById("detector").replaceChildren(...draw.flat().filter(Boolean));

/** The metric that ranks against what a detector costs. */
function costPage(board) {
  const cost = COSTS[overview.cost];
  const drawn = primaries(board).map((row) => ({ row, x: row.cost[overview.cost], y: mean(board, row, board.ranking) }))
    .filter(({ x, y }) => isNumber(x) && x > 0 && isNumber(y.value));
  const again = (value) => { overview.cost = value; redraw(costPage(board)); };
  const xs = drawn.map(({ x }) => x);
  const ys = drawn.map(({ y }) => 100 * y.value);
  const range = [Math.min(...xs) / 1.5, Math.max(...xs) * 1.5];
  const low = Math.floor(Math.min(50, ...ys) / 10) * 10;
  const plot = chart(`${rankingTitle(board)} against ${cost.title.toLowerCase()}`,
    { range, ticks: [-3, -2, -1, 0, 1, 2, 3, 4, 5].map((p) => 10 ** p).filter((t) => t >= range[0] && t <= range[1]), label: cost.label, bend: Math.log10 },
    { range: [low, 100], ticks: ticks(low, 100), label: `${rankingName(board)} (%)` }, { width: 860, height: 480, class: "wide" });
  plot.drawing.setAttribute("role", "group");
  const spots = drawn.map(({ row, x, y }) => ({ row, x, y, left: plot.sx(x), top: plot.sy(100 * y.value) }));
  const taken = spots.map(({ left, top }) => boxAbout(left, top));
  for (const { row, x, y, left, top } of spots) {
    const label = labelPlace(left, top, row.label, plot, taken);
    plot.drawing.append(shape("a", { href: address("detector", row.id), class: row.trivial ? "spot trivial" : "spot", "aria-label": `${row.label}: ${rankingName(board)} ${show(y.value, "percent")} %, ${costText(x)} ${cost.label}` },
      label.far && shape("line", { class: "leader", x1: left, y1: top, x2: label.x, y2: label.y - 4 }),
      shape("circle", { cx: left, cy: top, r: 5 }),
      shape("text", { x: label.x, y: label.y, "text-anchor": label.anchor }, row.label)));
  }
  return [
    element("h1", { tabindex: "-1" }, "Quality and cost"),
    element("p", { class: "lead" }, `${board.title} \u00b7 one row a detector. Rows may have been measured on different machines: compare orders of magnitude.`),
    element("form", { class: "choices", autocomplete: "off" },
      tabs("cost-axis", "Cost of", Object.entries(COSTS).map(([key, { title }]) => [key, title.toLowerCase()]), overview.cost, again),
      csvButton("quality-and-cost", () => document.getElementById("costs"))),
    figure([plot.drawing], [], "Up and to the left is better: more is found, for less."),
    element("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Quality and cost as a table" }, tableOf({ class: "plain", id: "costs" },
      "The same as numbers", ["Detector", `${rankingTitle(board)} (%)`, "Score (\u00b5s per step)", "Fit (s)", "Memory (MB)"],
      drawn.map(({ row, y }) => lineOf(rowLink(row), [meanText(y, "percent"), ...["step", "fit", "peak"].map((name) => costText(row.cost[name]))])))),
  ];
}

/** The room of a point in the figure of costs. */
const boxAbout = (x, y) => ({ left: x - 6, right: x + 6, top: y - 6, bottom: y + 6 });

const ruler = document.createElement("canvas").getContext("2d");

/**
 * Where a label stands beside its point: at the nearest place where it covers no point and no label before
 * it. `far` asks for a line from the point to it. With no such place it stands where it covers least.
 */
function labelPlace(x, y, text, plot, taken) {
  ruler.font = "12px system-ui, 'DejaVu Sans', sans-serif";
  const wide = 1.1 * ruler.measureText(text).width;
  const heights = [4, ...Array.from({ length: 40 }, (_, i) => 4 + 7 * Math.ceil((i + 1) / 2) * (i % 2 ? 1 : -1))];
  const boxes = [9, 30, 60].flatMap((gap) => heights.flatMap((dy) => ["start", "end"].map((anchor) => {
    const at = x + (anchor === "end" ? -gap : gap);
    const left = anchor === "end" ? at - wide : at;
    return { left, right: left + wide, top: y + dy - 11, bottom: y + dy + 3, x: at, y: y + dy, anchor, far: gap > 9 || Math.abs(dy - 4) > 14 };
  }))).filter((box) => box.left > plot.left && box.right < plot.right && box.top > plot.top - 8 && box.bottom < plot.bottom)
    .sort((a, b) => Math.hypot(a.x - x, a.y - y - 4) - Math.hypot(b.x - x, b.y - y - 4));
  const covered = (box) => taken.reduce((sum, other) => sum +
    Math.max(0, Math.min(box.right, other.right) - Math.max(box.left, other.left)) *
    Math.max(0, Math.min(box.bottom, other.bottom) - Math.max(box.top, other.top)), 0);
  const chosen = boxes.find((box) => covered(box) === 0) ?? boxes.reduce((a, b) => covered(b) < covered(a) ? b : a);
  taken.push({ ...chosen, left: chosen.left - 6, right: chosen.right + 6 });
  return chosen;
}

/** The metric that ranks of every detector by anomaly, environment or cell. */
function heatPage(board) {
  const again = (value) => { overview.columns = value; redraw(heatPage(board)); };
  const columns = {
    anomaly: Object.entries(board.anomalies).map(([anomaly, { title, summary }]) => ({ title, hint: summary, selection: { environment: "*", anomaly } })),
    environment: Object.entries(board.environments).map(([environment, title]) => ({ title, selection: { environment, anomaly: "*" } })),
    cell: board.cells.map(([environment, anomaly]) => ({ title: cellTitle(board, { environment, anomaly }), selection: { environment, anomaly }, cell: [environment, anomaly] })),
  }[overview.columns];
  const rows = primaries(board);
  const options = [["anomaly", "Anomalies"], ["environment", "Environments"], ["cell", "Cells"]];
  return [
    element("h1", { tabindex: "-1" }, "Detectors by cells"),
    element("p", { class: "lead" }, `${board.title} \u00b7 ${rankingName(board)} (%), one row a detector`),
    element("form", { class: "choices", autocomplete: "off" }, tabs("heat-columns", "Columns", options, overview.columns, again),
      csvButton("heatmap", () => document.getElementById("heatmap"))),
    element("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Heat map" },
      element("table", { class: columns.length > 12 ? "heat tight" : "heat", id: "heatmap" },
        captionOf("The colour of the page is 50, chance; teal is better, orange is worse than chance"),
        element("thead", {}, element("tr", {}, element("th", { scope: "col", class: "left" }, "Detector"),
          columns.map(({ title, hint }) => element("th", { scope: "col", title: hint }, element("span", {}, title))), element("th", { scope: "col" }, "Mean"))),
        element("tbody", {}, rows.map((row) => element("tr", { class: row.trivial ? "trivial" : null },
          element("th", { scope: "row" }, rowLink(row)),
          columns.map(({ selection, cell }) => heatCell(mean(board, row, board.ranking, selection), cell && address("detector", row.id, ...cell))),
          heatCell(mean(board, row, board.ranking), null, "total")))))),
  ];
}

/** One coloured number, a link where there is an address. */
function heatCell(found, href, name = null) {
  const text = meanText(found, "percent");
  const node = element("td", { class: name, title: found.state ? found.reason : null }, href && text ? element("a", { href }, text) : text);
  return painted(node, found.value);
}
