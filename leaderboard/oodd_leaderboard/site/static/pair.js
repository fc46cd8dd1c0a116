// Two detectors side by side: a picture and their figures in short, all cells, one cell's curves, all numbers.

function pairPage(board, rows, chosen) {
  const [first, second] = rows;
  const cell = chosenCell(first, chosen);
  const go = (i) => (id) => { location.hash = address("compare", ...rows.map((row, k) => k === i ? id : row.id)); };
  const options = (other) => board.rows.filter((row) => row !== other).map((row) => [row.id, row.label]);
  const link = (...place) => address("compare", first.id, second.id, ...place);
  return [
    element("p", { class: "back" }, element("a", { href: tableAddress() }, "\u2190 All detectors")),
    element("h1", { tabindex: "-1" }, breakable(`${first.label} and ${second.label}`)),
    element("p", { class: "lead" }, boardTitle(board)),
    element("form", { class: "choices", autocomplete: "off" },
      dropdown("first", "First", options(second), first.id, go(0)), dropdown("second", "Second", options(first), second.id, go(1))),
    section("Difference", "difference", verdictText(board, first, second),
      element("div", { class: "figures" }, pairFigure(board, rows), shortTable(board, rows))),
    section("Cells", "cells",
      heat(board, first, cell, (selection) => difference(board, rows, selection), link,
        `${first.label} minus ${second.label}: ${rankingName(board)} in points of per cent; teal is where ${first.label} finds more`),
      element("p", { class: "note" }, "Choose a cell to see both rows\u2019 curves below.")),
    section(cellTitle(board, cell), "cell",
      element("div", { class: "pair" }, rows.map((row) => element("div", {},
        element("h3", {}, element("a", { href: address("detector", row.id, cell.environment, cell.anomaly) }, row.label)),
        cellPart(board, row, PARTS.get(row.part).cells.find((c) => c.environment === cell.environment && c.anomaly === cell.anomaly) ?? cell))))),
    section("All metrics", "numbers", pairTable(board, rows)),
  ];
}

/** What the ranking's test says of two rows. */
function verdictText(board, first, second) {
  const part = PARTS.get(first.part);
  const found = part.comparisons.find(([other]) => other === second.label);
  if (!found) return element("p", {}, "The ranking compares every row with primary rows only, and only rows with all cells: it has no test of these two.");
  const [, gap, low, high] = found;
  const verdict = verdictOf(part, second.label);
  const words = { better: `${first.label} is significantly better`, worse: `${second.label} is significantly better` }[verdict] ?? "the two cannot be told apart";
  return element("p", {}, `Mean ${rankingName(board)} differs by ${signed(gap)} points, 95 % interval ${signed(low)} to ${signed(high)}: ${words} (paired bootstrap over test ${board.paired ? "seeds" : "episodes"}, ${board.resamples} resamples, Holm\u2019s correction over the board).`);
}

/** The difference of two rows' means, shown about the middle of the scale of colours. */
function difference(board, rows, selection) {
  const [one, other] = rows.map((row) => meanOfRow(board, row, board.ranking, selection));
  const defined = isNumber(one.value) && isNumber(other.value);
  return { ...one, value: defined ? one.value - other.value : null, state: one.state || other.state, low: null, high: null, gap: true };
}

/** Both rows' means of the metric that ranks with their intervals, by environment or, where there is one, by anomaly. */
function pairFigure(board, rows) {
  const byEnvironment = board.environments.length > 1;
  const lines = [
    ...byEnvironment ? board.environments.map((environment) => [environmentOf(board, environment).title, { environment }])
      : board.anomalies.map((anomaly) => [anomalyOf(board, anomaly).title, { anomaly }]),
    ["Mean", {}],
  ].map(([title, selection]) => ({ title, means: rows.map((row) => meanOfRow(board, row, board.ranking, { ...EVERYTHING, ...selection })) }));
  const lows = lines.flatMap(({ means }) => means.map((m) => m.low ?? m.value)).filter(isNumber);
  const low = Math.floor(10 * Math.min(0.9, ...lows)) * 10;
  const [step, left, height] = [30, 112, 30 * lines.length + 56];
  const plot = chart(`${rankingTitle(board)} of both`, { range: [low, 100], ticks: ticks(low, 100), label: `${rankingName(board)} (%)` },
    { range: [0, 1], ticks: [], label: "" }, { width: 400, height, left });
  lines.forEach(({ title, means }, i) => {
    const y = plot.top + step * (i + 0.5);
    plot.drawing.append(shape("text", { class: "label", x: left - 10, y: y + 4, "text-anchor": "end" }, title));
    means.forEach(({ value, low: from, high: to }, k) => {
      if (!isNumber(value)) return;
      const at = y + (k ? 5 : -5);
      if (isNumber(from)) plot.drawing.append(shape("line", { class: `line series-${k}`, x1: plot.sx(100 * from), x2: plot.sx(100 * to), y1: at, y2: at }));
      plot.drawing.append(shape("circle", { class: `dot series-${k}`, cx: plot.sx(100 * value), cy: at, r: 4 }));
    });
  });
  return figure([plot.drawing], rows.map((row, k) => [`series-${k}`, row.label]),
    `Further to the right is better. Bars are 95 % intervals${byEnvironment ? " of an environment\u2019s mean over its anomalies" : ""}.`);
}

/** Five figures of both rows, or as many of them as the board has. */
function shortTable(board, rows) {
  const metrics = shortList(board).filter((metric) => metric === board.ranking || !metric.startsWith("auc"));
  const short = (title, meaning, texts) => lineOf([title, element("span", { class: "under" }, sentence(meaning))], texts, meaning);
  return scroller(tableOf({ class: "plain short", id: "short" }, "In short: means over all cells",
    ["Metric", ...rows.map((row) => breakable(row.label))], [
      ...metrics.map((metric) => short(withUnit(metric), DATA.metrics[metric].meaning, rows.map((row) => meanText(mean(board, row, metric), DATA.metrics[metric].kind)))),
      short("Score (\u00b5s per step)", "Microseconds per scored step", rows.map((row) => costText(row.cost.step))),
    ]));
}

function pairTable(board, rows) {
  return scroller(csvButton("side-by-side", () => document.getElementById("pair")),
    element("table", { class: "plain", id: "pair" }, captionOf("Means over all cells with 95 % intervals"),
      element("thead", {}, element("tr", {}, element("th", { scope: "col", class: "left" }, "Metric"), rows.map((row) => element("th", { scope: "col" }, breakable(row.label))))),
      metricLines(board, 3, (metric) => rows.map((row) => {
        const { kind } = DATA.metrics[metric];
        const found = mean(board, row, metric);
        return element("td", {}, meanText(found, kind) + intervalOf(found, kind));
      }))));
}
