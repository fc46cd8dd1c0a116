// Two detectors side by side: their numbers, the difference, all cells of both, one cell's curves.

function pairPage(board, rows, chosen) {
  const [first, second] = rows;
  const cell = chosenCell(first, chosen);
  const go = (i) => (id) => { location.hash = address("compare", ...rows.map((row, k) => k === i ? id : row.id)); };
  const options = (other) => board.rows.filter((row) => row !== other).map((row) => [row.id, row.label]);
  const link = (...place) => address("compare", first.id, second.id, ...place);
  return [
    element("p", { class: "back" }, element("a", { href: tableAddress() }, "\u2190 All detectors")),
    element("h1", { tabindex: "-1" }, `${first.label} and ${second.label}`),
    element("p", { class: "lead" }, boardTitle(board)),
    element("form", { class: "choices", autocomplete: "off" },
      dropdown("first", "First", options(second), first.id, go(0)), dropdown("second", "Second", options(first), second.id, go(1))),
    section("Difference", "difference", verdictText(board, first, second)),
    section("Numbers", "numbers", pairTable(board, rows)),
    section("Cells", "cells",
      heat(board, first, cell, (selection) => difference(board, rows, selection), link,
        `${first.label} minus ${second.label}: ${rankingName(board)} in points of per cent; teal is where ${first.label} finds more`),
      element("p", { class: "note" }, "Choose a cell to see both rows\u2019 curves below.")),
    section(cellTitle(board, cell), "cell",
      element("div", { class: "pair" }, rows.map((row) => element("div", {},
        element("h3", {}, element("a", { href: address("detector", row.id, cell.environment, cell.anomaly) }, row.label)),
        cellPart(board, row, PARTS.get(row.part).cells.find((c) => c.environment === cell.environment && c.anomaly === cell.anomaly) ?? cell))))),
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

function pairTable(board, rows) {
  return scroller(csvButton("side-by-side", () => document.getElementById("pair")),
    element("table", { class: "plain", id: "pair" }, captionOf("Means over all cells with 95 % intervals"),
      element("thead", {}, element("tr", {}, element("th", { scope: "col", class: "left" }, "Metric"), rows.map((row) => element("th", { scope: "col" }, row.label)))),
      element("tbody", {}, board.metrics.map((metric) => {
        const { title, kind, meaning } = DATA.metrics[metric];
        const unit = kind === "rate" ? "" : ` (${titleOfUnit[kind]})`;
        return element("tr", {}, element("th", { scope: "row", title: meaning }, title + unit), rows.map((row) => {
          const found = mean(board, row, metric);
          const ends = isNumber(found.low) ? ` [${show(found.low, kind)}, ${show(found.high, kind)}]` : "";
          return element("td", {}, meanText(found, kind) + ends);
        }));
      }))));
}
