// The page of one row: facts, all cells, curves of the chosen cell, comparisons, the paper's digits.

function detectorPage(board, row, chosen) {
  const others = board.rows.filter((other) => other !== row).map((other) => [other.id, other.label]);
  return [
    element("p", { class: "back" }, element("a", { href: tableAddress() }, "\u2190 All detectors")),
    element("h1", { tabindex: "-1" }, breakable(row.label), " ", badges(row)),
    element("p", { class: "lead" }, `${boardTitle(board)} \u00b7 `, underLabel(row)),
    summary(board, row),
    others.length ? element("form", { class: "choices", autocomplete: "off" },
      dropdown("against", "Beside", [["", "choose a detector"], ...others], "", (id) => { if (id) location.hash = address("compare", row.id, id); })) : null,
    ...cellSections(board, row, chosen),
    comparisons(board, row),
    paperPart(board, row),
    section("All metrics", "metrics", metricsTable(board, row)),
    section("Where it is from", "source", facts(row)),
  ];
}

/** All cells, and numbers and drawings of the one that an address names. */
function cellSections(board, row, chosen) {
  const cell = chosenCell(row, chosen);
  return [
    section("Cells", "cells", heat(board, row, cell),
      element("p", { class: "note" }, "Choose a cell to see its curves below.")),
    section(cellTitle(board, cell), "cell", cellPart(board, row, cell)),
  ];
}

/** The cell that an address names, or the first one with a result. */
function chosenCell(row, chosen) {
  const { cells } = PARTS.get(row.part);
  return cells.find((c) => chosen && c.environment === chosen[0] && c.anomaly === chosen[1]) ?? cells.find((c) => !c.status) ?? cells[0];
}

const section = (title, id, ...content) =>
  element("section", { id, "aria-labelledby": `${id}-title` }, element("h2", { id: `${id}-title` }, title), content);

function summary(board, row) {
  const card = (title, value, under, hint) => element("div", { class: "card", title: hint },
    element("dt", {}, title), element("dd", {}, value, element("span", { class: "under" }, under)));
  const of = (metric) => mean(board, row, metric);
  const text = (metric) => meanText(of(metric), DATA.metrics[metric].kind);
  const interval = (metric) => {
    const { low, high } = of(metric);
    const { kind } = DATA.metrics[metric];
    return isNumber(low) ? `95 % interval ${show(low, kind)} to ${show(high, kind)}` : "no interval";
  };
  const rank = card("Rank", row.rank ? String(row.rank) : UNDEFINED, !row.rank ? row.state
    : `of ${board.rows.filter((r) => r.rank).length} ranked${row.ties && `, tie groups ${row.ties}`}`);
  const cost = card("Cost", `${costText(row.cost.fit)} s`, `per fit; ${costText(row.cost.step)} \u00b5s per step, ${costText(row.cost.peak)} MB`);
  const clock = board.rows.find((r) => r.label === "clock");
  const beside = (metric) => metric === "auc_rows" && clock
    ? `the time alone ${meanText(mean(board, clock, metric), "percent")}` : interval(metric);
  const numbers = shortList(board).map((metric) =>
    card(withUnit(metric), text(metric), beside(metric), DATA.metrics[metric].meaning));
  return element("dl", { class: "cards" }, numbers[0], rank, numbers.slice(1), cost);
}

/** Metrics that describe a row in short: what it separates, then its guaranteed alarms, or else the paper's. */
function shortList(board) {
  const separability = board.paired ? [board.ranking] : [board.ranking, "auc_rows", "auc_outcome"];
  const guaranteed = known(board, [board.paired ? "found_within_20" : "events_found", "delay_censored", "false_episodes"].map((metric) => `${metric}_${board.level}`));
  return [...known(board, [...new Set(separability)]), ...guaranteed.length ? guaranteed : known(board, ["delay_censored", "missed", "far_twin"])];
}

/** A metric's title with its unit. */
function withUnit(metric) {
  const { title, kind } = DATA.metrics[metric];
  return (kind === "rate" ? title : `${title}\u00a0(${titleOfUnit[kind]})`).replace(/ %/g, "\u00a0%");
}

/** A board's metrics under headings: what separates, guaranteed alarms, its level's first, the paper's alarm. */
function headings(board) {
  const of = (metric) => /_at_\d/.test(metric) ? "Guaranteed alarms" : metric.startsWith("auc") ? "Separability"
    : PAPERS.includes(metric) ? PAPERS_ALARM : "Further metrics";
  const ofLevel = (metric) => metric.endsWith(board.level);
  const groups = groupedBy([...board.metrics].sort((a, b) => ofLevel(b) - ofLevel(a)), of);
  return ["Separability", "Guaranteed alarms", PAPERS_ALARM, "Further metrics"].filter((title) => groups.has(title)).map((title) => [title, groups.get(title)]);
}

/** Lines of a table for each metric of a board, under headings; `cells` gives those of one metric. */
const metricLines = (board, columns, cells) => headings(board).map(([title, metrics]) => element("tbody", {},
  element("tr", { class: "heading" }, element("th", { scope: "rowgroup", colspan: columns }, title)),
  metrics.map((metric) => element("tr", {}, element("th", { scope: "row", title: DATA.metrics[metric].meaning }, underHeading(withUnit(metric))), cells(metric)))));

/** Colours of an AUC: from the page's own at chance to teal at 1, or to orange at 0. */
function colours(value) {
  if (!isNumber(value)) return {};
  const far = Math.min(1, Math.abs(value - 0.5) * 2);
  const [above, under, none] = isDark() ? [[64, 178, 196], [214, 120, 60], [23, 29, 36]] : [[14, 98, 116], [178, 84, 24], [255, 255, 255]];
  const end = value >= 0.5 ? above : under;
  const back = none.map((v, i) => Math.round(v + (end[i] - v) * 0.9 * far));
  // White or black, whichever stands out more.
  const [r, g, b] = back.map((v) => (v / 255) ** 2.2);
  return { back: `rgb(${back.join(" ")})`, front: 0.2126 * r + 0.7152 * g + 0.0722 * b > 0.179 ? "#000" : "#fff" };
}

/** A field with the colours of a value. */
function painted(node, value) {
  const { back, front } = colours(value);
  if (back) Object.assign(node.style, { backgroundColor: back, color: front });
  return node;
}

/**
 * The metric that ranks by environment and anomaly; every value is a link to its cell at `link`. `of` gives
 * the number of a selection.
 */
function heat(board, row, chosen, of = (selection) => meanOfRow(board, row, board.ranking, selection),
  link = (...cell) => address("detector", row.id, ...cell), caption = `${rankingTitle(board)} (%): teal is better than chance, orange is worse`) {
  const cellAt = (e, a) => of({ environment: e, group: "all", anomaly: a });
  const shade = (found) => found.gap && isNumber(found.value) ? 0.5 + found.value : found.value;
  const filled = (found, content, extra = {}) => painted(element("td", extra, content), shade(found));
  const text = (found) => found.gap && !found.state ? signed(found.value) : meanText({ ...found, partial: false }, "percent") || "";
  const tip = (found) => isNumber(found.low) ? `95 % interval ${show(found.low, "percent")} to ${show(found.high, "percent")}` : null;
  const one = (e, a) => {
    const found = cellAt(e, a);
    if (!found.cells) return element("td", {});
    const current = e === chosen.environment && a === chosen.anomaly;
    const node = element("a", { href: link(e, a), "aria-current": current ? "true" : null }, text(found));
    return filled(found, node, { class: current ? "current" : null, title: tip(found) });
  };
  const total = (selection) => {
    const found = of({ ...EVERYTHING, ...selection });
    return filled(found, text(found), { class: "total", title: tip(found) });
  };
  const groups = [...Object.keys(GROUP_TITLES), ""].filter((g) => inGroup(board, g).length);
  const ordered = groups.flatMap((g) => inGroup(board, g));
  return scroller(element("table", { class: "heat" },
    captionOf(caption),
    element("thead", {},
      groups.some(Boolean) && element("tr", {}, element("td", {}), groups.map((g) => g
        ? element("th", { scope: "colgroup", colspan: inGroup(board, g).length }, GROUP_TITLES[g])
        : element("td", { colspan: inGroup(board, g).length })), element("td", {})),
      element("tr", {}, element("th", { scope: "col", class: "left" }, "Environment"),
        ordered.map((a) => element("th", { scope: "col", title: anomalyOf(board, a).summary || null }, anomalyOf(board, a).title)),
        element("th", { scope: "col" }, "Mean"))),
    element("tbody", {},
      board.environments.map((e) => element("tr", {}, element("th", { scope: "row" }, environmentOf(board, e).title),
        ordered.map((a) => one(e, a)), total({ environment: e }))),
      element("tr", { class: "total" }, element("th", { scope: "row" }, "Mean"),
        ordered.map((a) => total({ anomaly: a })), total({})))));
}

/** Numbers and drawings of one cell. */
function cellPart(board, row, cell) {
  const selection = { environment: cell.environment, group: "all", anomaly: cell.anomaly };
  const of = (metric) => meanOfRow(board, row, metric, selection);
  const { state, reason } = of(board.ranking);
  if (state) return element("p", { class: "failure" }, element("strong", {}, state), `: ${reason}`);
  const text = (metric) => {
    const { kind } = DATA.metrics[metric];
    return show(of(metric).value, kind) + ({ percent: "\u202f%", steps: " steps" }[kind] ?? "") + intervalOf(of(metric), kind);
  };
  const sentence = element("p", {}, board.paired ? sentenceOfCell(board, cell, text) : sentenceOfLogs(board, of, text));
  const curves = curvesOf(row, `${cell.environment}/${cell.anomaly}`);
  if (!curves) return [sentence, element("p", { class: "note" }, "This entry has no curves for this cell.")];
  const seed = board.paired && row.seeds.length > 1 ? element("p", { class: "note" }, `Curves of detector seed ${curves.seed}; numbers are means over seeds.`) : null;
  return [sentence, seed,
    element("div", { class: "figures" }, rocFigure(curves.roc, of(board.paired ? "auc_matched" : "auc_pool").value, board.paired), delayFigure(curves.delay_far)),
    exampleFigure(curves.example, sensorsOf(board, cell, curves.example))];
}

/** The figures of a cell with twins in words; `text` gives those of a metric. */
function sentenceOfCell(board, cell, text) {
  const guaranteed = !board.metrics.includes("delay_at_5pct") ? "" :
    `Guaranteed alarms at 5 %: delay ${text("delay_at_5pct")}, missed ${text("missed_at_5pct")}, ` +
    `found within 20 rows ${text("found_within_20_at_5pct")}, false episodes ${text("false_episodes_at_5pct")}. `;
  return `What changes: ${DATA.anomalies[cell.anomaly].summary}. Matched AUC ${text("auc_matched")}. ${guaranteed}At the paper\u2019s threshold: delay ${text("delay")}, ` +
    `against ${text("delay_null")} from false alarms alone; missed ${text("missed")}; ` +
    `false-alarm rate ${text("far_twin")} on nominal twins. Brackets are 95 % intervals.`;
}

/** The same without twins: the figures that the cell has. */
function sentenceOfLogs(board, of, text) {
  const metrics = [
    "auc_pool", "auc_pool_null", "auc_rows", "auc_outcome",
    ...["found_outcome", "events_found", "delay", "missed", "false_episodes", "false_alarms_per_hour"].map((m) => `${m}_${board.level}`),
  ];
  const parts = known(board, metrics).filter((metric) => isNumber(of(metric).value)).map((metric) => {
    const { title } = DATA.metrics[metric];
    return `${/^[A-Z][a-z]/.test(title) ? title[0].toLowerCase() + title.slice(1) : title} ${text(metric)}`;
  });
  return parts.length ? `This cell: ${parts.join(", ")}. Brackets are 95 % intervals.` : "No metric of this cell has a value.";
}

/** A promise of what sensors read in an example, where the site has that; null where not. */
function sensorsOf(board, cell, example) {
  const name = board.episodes[cell.environment];
  return name ? load(name).then((episodes) => episodes[`${cell.anomaly}/${example.index}`] ?? null) : null;
}

/** Curves of one cell of a row, in their units; undefined where there are none. */
function curvesOf(row, name) {
  const cell = PARTS.get(row.part).curves[name];
  if (!cell) return undefined;
  const { scores, twin, score_step, cusum, twin_cusum, cusum_step } = cell.example;
  const scaled = (values, step) => step === null || !values ? values : values.map((v) => v === null ? null : v * step);
  const example = {
    ...cell.example,
    scores: scaled(scores, score_step),
    twin: scaled(twin, score_step),
    cusum: scaled(cusum, cusum_step),
    twin_cusum: scaled(twin_cusum, cusum_step),
  };
  return { ...cell, example };
}

/** The row against every other ranked row. */
function comparisons(board, row) {
  const part = PARTS.get(row.part);
  const found = [...part.comparisons];
  if (!found.length) return null;
  const links = new Map(board.rows.map((r) => [r.label, r.id]));
  return section("Against the others", "comparisons", scroller(tableOf({ class: "plain" },
    `Differences in mean ${rankingName(board)} (percentage points) over all cells, by paired bootstrap (${board.resamples} resamples) with Holm\u2019s correction over the board`,
    ["Detector", "Difference", "95 % interval", "Verdict", "Cells won (%)"],
    found.sort((a, b) => a[1] - b[1]).map(([other, difference, low, high]) => lineOf(
      element("a", { href: address("compare", row.id, links.get(other)) }, breakable(other)),
      [signed(difference), `[${signed(low)}, ${signed(high)}]`,
        element("td", { class: verdictOf(part, other).split(" ")[0] }, verdictOf(part, other)),
        isNumber(part.wins[other]) ? (100 * part.wins[other]).toFixed(0) : UNDEFINED])))));
}

/** Whether a row is better or worse than another, after Holm's correction over the board. */
function verdictOf(part, other) {
  const found = part.comparisons.find(([name]) => name === other);
  if (!found) return "not compared";
  return found[4] <= 0.05 ? "better" : part.worse_than.includes(other) ? "worse" : "not told apart";
}

/** A difference in percentage points with its sign; what is rounded to nothing has none. */
function signed(share) {
  if (!isNumber(share)) return UNDEFINED;
  const size = Math.abs(100 * share).toFixed(1);
  return size === "0.0" ? size : `${share < 0 ? "\u2212" : "+"}${size}`;
}

/** Ours beside the digits of the paper's Table 5, where it has them. */
function paperPart(board, row) {
  if (!board.paired || paperMean(row, "auc") === null) return null;
  const groups = Object.keys(GROUP_TITLES).filter((g) => inGroup(board, g).length);
  const columns = ["auc", "delay", "far"].flatMap((metric) => groups.map((group) => ({ metric, group })));
  const numbers = (environment) => columns.flatMap(({ metric, group }) => {
    const selection = { environment, group, anomaly: "all" };
    const { kind } = DATA.metrics[metric];
    return [element("td", {}, meanText(meanOfRow(board, row, metric, selection), kind)),
      element("td", { class: "paper" }, show(paperMean(row, metric, selection), kind))];
  });
  return section("Beside the paper", "paper", scroller(element("table", { class: "plain" },
    captionOf("Here, and in the paper\u2019s Table 5 (\u0394 = 1). Policies, split and alarm unit are not the paper\u2019s, so digits are not expected to agree."),
    element("thead", {},
      element("tr", {}, element("td", {}), columns.map(({ metric, group }) => element("th", { scope: "colgroup", colspan: 2 },
        `${DATA.metrics[metric].title}, ${group}`))),
      element("tr", {}, element("th", { scope: "col", class: "left" }, "Environment"),
        columns.map(() => ["here", "paper"].map((t) => element("th", { scope: "col", class: t === "paper" ? "paper" : null }, t))))),
    element("tbody", {}, [...board.environments, "all"].map((e) => element("tr", { class: e === "all" ? "total" : null },
      element("th", { scope: "row" }, DATA.environments[e]?.title ?? "Mean"), numbers(e)))))));
}

function metricsTable(board, row) {
  return scroller(element("table", { class: "plain" },
    captionOf("Means over all cells"),
    element("thead", {}, element("tr", {}, ["Metric", "Mean", "95 % interval", "Meaning"].map((t, i) =>
      element("th", { scope: "col", class: i % 3 ? null : "left" }, t)))),
    metricLines(board, 4, (metric) => {
      const { kind, meaning } = DATA.metrics[metric];
      const found = mean(board, row, metric);
      return [element("td", {}, meanText(found, kind)), element("td", {}, intervalOf(found, kind).trim()), element("td", { class: "text" }, meaning)];
    })));
}

/** What the entry says of itself. Only http addresses become links. */
function facts(row) {
  const list = (known) => element("dl", { class: "facts" }, known.filter(([, value]) => value).map(([name, value]) =>
    [element("dt", {}, name), element("dd", {}, value)]));
  const text = (value) => typeof value === "string" ? value : JSON.stringify(value);
  const { entry, version, parameters, command } = PARTS.get(row.part);
  return [
    list([
      ["Plug-in", `${row.plugin} ${version}`],
      ["Parameters", Object.entries(parameters).map(([name, value]) => `${name} = ${text(value)}`).join(", ")],
      ["Seeds", row.seeds.join(", ")],
    ]),
    element("h3", {}, entry.title || entry.id),
    list([
      ["Entry", entry.id],
      ["Submitted by", entry.submitter],
      ["Date", entry.created],
      ["To run it again", element("code", {}, command)],
      ["Citation", element("div", {}, element("pre", { class: "bibtex" }, bibtexOf(row, entry)),
        element("button", { type: "button", class: "action", onclick: () => download(`${entry.id}.bib`, bibtexOf(row, entry), "text/plain") }, "BibTeX"))],
      ["Address", /^https?:\/\//.test(entry.url)
        ? element("a", { href: entry.url, rel: "noopener noreferrer external" }, entry.url) : entry.url],
      ["Source digest", entry.source_digest],
      ["Note", entry.caption],
    ]),
  ];
}

/** How an entry is cited: its own BibTeX, or one made of what it says. */
function bibtexOf(row, entry) {
  if (/^\s*@\w+\s*\{/.test(entry.citation)) return entry.citation;
  const plain = (text) => text.replace(/[\\{}]/g, "");
  const lines = [
    ["title", `${plain(entry.title || entry.id)} (${plain(row.label)})`], ["author", `{${plain(entry.submitter)}}`],
    ["year", entry.created.slice(0, 4)], ["url", /^https?:\/\//.test(entry.url) ? plain(entry.url) : ""],
    ["note", ["Entry of the oodd-eval leaderboard", plain(entry.citation)].filter(Boolean).join(". ")],
  ].filter(([name, value]) => value && !(name === "author" && value === "{}"));
  return `@misc{oodd-eval-${entry.id.replace(/[^A-Za-z0-9-]/g, "-")},\n${lines.map(([name, value]) => `  ${name} = {${value}}`).join(",\n")}\n}\n`;
}
