// The page of one row: facts, all cells, curves of the chosen cell, comparisons, the paper's digits.

function detectorPage(board, row, chosen) {
  return [
    element("p", { class: "back" }, element("a", { href: tableAddress() }, `\u2190 ${board.name}`)),
    element("h1", { tabindex: "-1" }, breakable(row.label), " ", badges(row)),
    element("p", { class: "lead" }, creditOf(row).map((part) => [part, " \u00b7 "]), settingsOf(row)),
    summary(board, row),
    tested(board, row),
    ...cellSections(board, row, chosen),
    paperPart(board, row),
    section("All metrics", "metrics", metricsTable(board, row)),
    section("Where it is from", "source", facts(board, row)),
  ];
}

/** All cells, and numbers and drawings of the one that an address names. */
function cellSections(board, row, chosen) {
  const cell = chosenCell(board, row, chosen);
  return [
    section("Cells", "cells", heat(board, row, cell),
      element("p", { class: "note" }, "Choose a cell to see its curves below.")),
    section(cellTitle(board, cell), "cell", cellPart(board, row, cell)),
  ];
}

/** The cell that an address names, or the first one with a result. */
function chosenCell(board, row, [place, kind]) {
  const failed = new Set(row.failed.map(([i]) => i));
  const cells = board.cells.map(([environment, anomaly], i) => ({ environment, anomaly, run: !row.missing.includes(i), ok: !failed.has(i) })).filter(({ run }) => run);
  return cells.find(({ environment, anomaly }) => environment === place && anomaly === kind) ?? cells.find(({ ok }) => ok) ?? cells[0];
}

const section = (title, id, ...content) =>
  element("section", { id, "aria-labelledby": `${id}-title` }, element("h2", { id: `${id}-title` }, title), content);

function summary(board, row) {
  const card = (title, value, under, hint) => element("div", { class: "card", title: hint },
    element("dt", {}, title), element("dd", {}, value, element("span", { class: "under" }, under)));
  const ranked = board.rows.filter((r) => isNumber(r.rank)).length;
  const rank = !board.ranked ? null : row.rank ? card("Rank", String(row.rank), `of ${ranked} ranked${row.band ? ", first band" : ""}`) : card("Rank", UNDEFINED, row.state);
  const numbers = headline(board, EVERYTHING).filter(({ key }) => !key.startsWith("of-")).map((column) => {
    const found = column.of(row, EVERYTHING);
    return card(`${column.title} (${column.unit.replace(/ \[.*/, "")})`, meanText(found, column.kind), column.under?.(found) ?? intervalOf(found, column.kind).trim(), column.hint);
  });
  const seeds = row.seeds.length > 1 ? card("Detector seeds (%)", row.seed_means.map((value) => show(value, "percent")).join(" to "), `lowest and highest mean of ${row.seeds.length}`) : null;
  const cost = card("Cost", `${costText(row.cost.fit)} s`, `per fit; ${costText(row.cost.step)} \u00b5s per step, ${costText(row.cost.peak)} MB`);
  return element("dl", { class: "cards" }, numbers[0], rank, numbers.slice(1), seeds, cost);
}

/** The two tests of a row: against the row above it, and against the first. */
function tested(board, row) {
  const rows = new Map(board.rows.map((r) => [r.label, r]));
  const tests = [["the row above", row.above], ["the first", row.first]].filter(([, test]) => test);
  return tests.length ? section("Told apart?", "tested", scroller(tableOf({ class: "plain" },
    `How far mean ${rankingName(board)} is below others, in percentage points: paired bootstrap, the interval at the level that Holm\u2019s correction asks for`,
    ["Against", "Below by", "Interval", "Verdict"],
    tests.map(([name, test]) => lineOf([`${name}, `, rowLink(rows.get(test.row))], [...gapTexts(test),
      element("td", { class: "text" }, test.told ? "told apart" : "not told apart")]))))) : null;
}

/** A metric's title with its unit. */
function withUnit(metric) {
  const { title, kind } = DATA.metrics[metric];
  return (kind === "rate" ? title : `${title}\u00a0(${titleOfUnit[kind]})`).replace(/ %/g, "\u00a0%");
}

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

/** The metric that ranks by environment and anomaly; every value is a link to its cell. */
function heat(board, row, chosen) {
  const of = (selection) => mean(board, row, board.ranking, selection);
  const tip = (found) => isNumber(found.low) ? `95 % interval ${show(found.low, "percent")} to ${show(found.high, "percent")}` : null;
  const text = (found) => meanText({ ...found, partial: false }, "percent");
  const one = (environment, anomaly) => {
    const found = of({ environment, anomaly });
    if (!found.cells) return element("td", {});
    const current = environment === chosen.environment && anomaly === chosen.anomaly;
    const link = element("a", { href: address("detector", row.id, environment, anomaly), "aria-current": current ? "true" : null }, text(found));
    return painted(element("td", { class: current ? "current" : null, title: tip(found) }, link), found.value);
  };
  const total = (selection) => {
    const found = of({ ...EVERYTHING, ...selection });
    return painted(element("td", { class: "total", title: tip(found) }, text(found)), found.value);
  };
  const groups = [...Object.keys(GROUP_TITLES), ""].filter((g) => inGroup(board, g).length);
  const ordered = groups.flatMap((g) => inGroup(board, g));
  const caption = captionOf(`${rankingTitle(board)} (%): teal is better than chance, orange is worse`);
  if (ownKinds(board)) return scroller(element("table", { class: "heat" }, caption, ...linesOfKinds(board, groups, one, total)));
  return scroller(element("table", { class: "heat" },
    caption,
    element("thead", {},
      groups.some(Boolean) && element("tr", {}, element("td", {}), groups.map((g) =>
        element(g ? "th" : "td", { scope: g && "colgroup", colspan: inGroup(board, g).length }, GROUP_TITLES[g])), element("td", {})),
      element("tr", {}, element("th", { scope: "col", class: "left" }, "Environment"),
        ordered.map((a) => element("th", { scope: "col", title: anomalyOf(board, a).summary || null }, anomalyOf(board, a).title)),
        element("th", { scope: "col" }, "Mean"))),
    element("tbody", {},
      Object.entries(board.environments).map(([environment, title]) => element("tr", {}, element("th", { scope: "row" }, title),
        ordered.map((a) => one(environment, a)), total({ environment }))),
      element("tr", { class: "total" }, element("th", { scope: "row" }, "Mean"),
        ordered.map((a) => total({ anomaly: a })), total({})))));
}

/** Whether most anomalies are of few environments, as those that a season draws for each. */
const ownKinds = (board) => board.cells.length < 0.6 * Object.keys(board.environments).length * Object.keys(board.anomalies).length;

/** Head and body of such a board's cells: an environment's own stand side by side, each with its name and strength. */
function linesOfKinds(board, groups, one, total) {
  const environments = Object.entries(board.environments);
  const kinds = (environment, group) => inGroup(board, group).filter((a) => board.cells.some(([e, kind]) => e === environment && kind === a));
  const widths = groups.map((g) => Math.max(...environments.map(([e]) => kinds(e, g).length)));
  const cell = (environment, anomaly) => {
    const node = one(environment, anomaly);
    const strength = board.strengths[`${environment}|${anomaly}`];
    (node.querySelector("a") ?? node).prepend(element("span", { class: "kind" }, anomalyOf(board, anomaly).title, strength && element("span", {}, strength)));
    return node;
  };
  const wide = (node, i) => Object.assign(node, { colSpan: widths[i] });
  return [
    element("thead", {}, element("tr", {}, element("th", { scope: "col", class: "left" }, "Environment"),
      groups.map((g, i) => wide(element("th", { scope: "colgroup" }, GROUP_TITLES[g] ?? ""), i)), element("th", { scope: "col" }, "Mean"))),
    element("tbody", {}, environments.map(([environment, title]) => element("tr", {}, element("th", { scope: "row" }, title),
      groups.map((g, i) => [...kinds(environment, g).map((a) => cell(environment, a)),
        ...Array.from({ length: widths[i] - kinds(environment, g).length }, () => element("td", {}))]), total({ environment }))),
    element("tr", { class: "total" }, element("th", { scope: "row" }, "Mean"), groups.map((g, i) => wide(total({ anomaly: `*${g}` }), i)), total({}))),
  ];
}

/** Numbers and drawings of one cell. */
function cellPart(board, row, cell) {
  const of = (metric) => mean(board, row, metric, { environment: cell.environment, anomaly: cell.anomaly });
  const { state, reason } = of(board.ranking);
  if (state) return element("p", { class: "failure" }, element("strong", {}, state), `: ${reason}`);
  const text = (metric) => {
    const { kind } = DATA.metrics[metric];
    return show(of(metric).value, kind) + ({ percent: "\u202f%", steps: " steps" }[kind] ?? "") + intervalOf(of(metric), kind);
  };
  const sentence = element("p", {}, board.paired ? sentenceOfCell(board, cell, text) : sentenceOfLogs(board, of, text));
  const curves = curvesOf(row, `${cell.environment}/${cell.anomaly}`);
  if (!curves) return [sentence, element("p", { class: "note" }, "There are no curves for this cell.")];
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
  const { summary } = anomalyOf(board, cell.anomaly);
  return `${summary ? `What changes: ${summary}. ` : ""}Matched AUC ${text("auc_matched")}. ${guaranteed}At the paper\u2019s threshold: delay ${text("delay")}, ` +
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

/** Ours beside the digits of the paper's Table 5, where it has them. */
function paperPart(board, row) {
  if (board.season || paperMean(row, "auc") === null) return null;
  const groups = Object.keys(GROUP_TITLES).filter((g) => inGroup(board, g).length);
  const columns = ["auc", "delay", "far"].flatMap((metric) => groups.map((group) => ({ metric, group })));
  const numbers = (environment) => columns.flatMap(({ metric, group }) => {
    const selection = { environment, anomaly: `*${group}` };
    const { kind } = DATA.metrics[metric];
    return [element("td", {}, meanText(mean(board, row, metric, selection), kind)),
      element("td", { class: "paper" }, show(paperMean(row, metric, selection), kind))];
  });
  return section("Beside the paper", "paper", scroller(element("table", { class: "plain" },
    captionOf("Here, and in the paper\u2019s Table 5 (\u0394 = 1). Policies, split and alarm unit are not the paper\u2019s, so digits are not expected to agree."),
    element("thead", {},
      element("tr", {}, element("td", {}), columns.map(({ metric, group }) => element("th", { scope: "colgroup", colspan: 2 },
        `${DATA.metrics[metric].title}, ${group}`))),
      element("tr", {}, element("th", { scope: "col", class: "left" }, "Environment"),
        columns.map(() => ["here", "paper"].map((t) => element("th", { scope: "col", class: t === "paper" ? "paper" : null }, t))))),
    element("tbody", {}, [...Object.keys(board.environments), "*"].map((e) => element("tr", { class: e === "*" ? "total" : null },
      element("th", { scope: "row" }, board.environments[e] ?? "Mean"), numbers(e)))))));
}

function metricsTable(board, row) {
  return scroller(tableOf({ class: "plain" }, "Means over all cells", ["Metric", "Mean", "95 % interval", "Meaning"], board.metrics.map((metric) => {
    const { kind, meaning } = DATA.metrics[metric];
    const found = mean(board, row, metric);
    return lineOf(withUnit(metric), [meanText(found, kind), intervalOf(found, kind).trim(), element("td", { class: "text" }, meaning)]);
  })));
}

/** What is known of where a row is from. Only http addresses become links. */
function facts(board, row) {
  const text = (value) => typeof value === "string" ? value : JSON.stringify(value);
  const { entry, version, parameters, day, command } = PARTS.get(row.part);
  const wheels = board.season?.installed[row.detector] ?? [];
  const bibtex = bibtexOf(row);
  return element("dl", { class: "facts" }, [
    ["Plug-in", `${row.plugin} ${version}`], ["Run on", day],
    ["Parameters", Object.entries(parameters).map(([name, value]) => `${name} = ${text(value)}`).join(", ")],
    ["Seeds", row.seeds.join(", ")],
    ["Installed", entry.requirement], ["SHA-256", entry.sha256],
    ["With", wheels.map(({ distribution, version: of, sha256 }) => element("div", {}, `${distribution} ${of}, SHA-256 ${sha256.slice(0, 12)}`))],
    ["Reported in", entry.reported], ["Run it", command && [board.season?.command, command].filter(Boolean).map((line) => element("code", { class: "bibtex" }, line))],
    ["Authors", entry.authors], ["Paper", entry.paper], ["Year", entry.year && String(entry.year)], ["Licence", entry.licence],
    ["Address", linkTo(entry.url, entry.url)],
    ["Citation", bibtex && element("div", {}, element("pre", { class: "bibtex" }, bibtex),
      element("button", { type: "button", class: "action", onclick: () => download("entry.bib", bibtex, "text/plain") }, "BibTeX"))],
  ].filter(([, value]) => value?.length || value instanceof Element).map(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]));
}

/** How a row's paper is cited; nothing where its entry names none. */
function bibtexOf(row) {
  const plain = (text) => String(text).replace(/[\\{}]/g, "");
  const lines = [["title", row.paper], ["author", row.authors.replaceAll(", ", " and ")], ["year", row.year], ["url", /^https?:/.test(row.url) ? row.url : ""]].filter(([, value]) => value);
  return row.paper && `@misc{${row.detector.replace(/[^A-Za-z0-9-]/g, "-")},\n${lines.map(([name, value]) => `  ${name} = {${plain(value)}}`).join(",\n")}\n}\n`;
}
