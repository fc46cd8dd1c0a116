// Detection power: what rows find of weaker anomalies, drawn over the strength or over its cost.

const power = { metric: 0, axis: "strength", hidden: null };
const POWER_SHOWN = 8; // rows of a split that are drawn at first, as many as there are colours

const POWER_AXES = {
  strength: { title: "strength", place: 0, bend: Math.log10 },
  lost: { title: "return lost", place: 1, label: "return lost (%)" },
};

/** The page of further suites: detection thresholds and power against strength, and tables of the others. */
function powerPage() {
  const metrics = DATA.suites[0].metrics.map((metric, i) => [i, metric.title]);
  const axes = Object.entries(POWER_AXES).map(([name, axis]) => [name, `over ${axis.title}`]);
  const labels = [...new Set(DATA.suites.flatMap((suite) => suite.rows.filter((row) => !row.trivial).map((row) => row.label)))];
  if (!power.hidden) {
    const first = DATA.suites.flatMap((suite) => suite.rows.filter((row) => !row.trivial).slice(0, POWER_SHOWN).map((row) => row.label));
    power.hidden = new Set(labels.filter((label) => ![...first, "riqn"].includes(label)));
  }
  const again = () => document.getElementById("detector").replaceChildren(...powerPage());
  const set = (name) => (value) => { power[name] = value; again(); };
  return [
    element("h1", { tabindex: "-1" }, "Weaker anomalies, worlds, logs"),
    element("p", { class: "lead" }, "What rows find of anomalies that cost a policy less and less of its return, with the weakest strength that they find, their detection threshold; then rows on other nominal operation and on public logs. The project ran all of them; nothing here is ranked."),
    labels.length ? element("form", { class: "choices", "aria-label": "What to draw", autocomplete: "off" },
      tabs("power-metric", "Measure", metrics, power.metric, set("metric")), tabs("power-axis", "Drawn", axes, power.axis, set("axis")),
      element("fieldset", { class: "boxes" }, element("legend", {}, "Rows"), labels.map((label) => element("label", {}, element("input", {
        type: "checkbox", name: "power-row", value: label, checked: !power.hidden.has(label),
        onchange: (event) => {
          if (event.target.checked) power.hidden.delete(label);
          else power.hidden.add(label);
          again();
          document.querySelector(`[name="power-row"][value="${CSS.escape(label)}"]`).focus();
        },
      }), ` ${label}`)))) : "",
    element("section", { id: "power", "aria-label": "Further suites" }, DATA.suites.map(suitePart)),
  ];
}

/** A suite under its heading; where it is not graded, its tables alone, folded. */
const suitePart = (suite) => element("details", { open: suite.rows.length > 0 },
  element("summary", {}, element("h2", {}, [...new Set([suite.name, suite.split])].join(": "))), suite.rows.length ? powerOf(suite) : suite.tables.map(powerTable));

/** Chart and tables of one split with graded strengths. */
function powerOf(suite) {
  // What strengths of a task's loss cost of a return is not known.
  const costs = suite.rows.some((row) => row.points.some((points) => points.some((p) => isNumber(p[POWER_AXES.lost.place]))));
  const axis = costs ? POWER_AXES[power.axis] : POWER_AXES.strength;
  const metric = suite.metrics[power.metric];
  const chosen = suite.rows.filter((row) => !power.hidden.has(row.label)).map((row) => ({ ...row, points: row.points[power.metric].filter((p) => isNumber(p[axis.place])) }));
  const drawn = chosen.filter((row) => row.points.length);
  if (!drawn.length) {
    const reason = chosen.length ? `The records of split ${suite.split} do not have this measure.` : "No row is chosen.";
    return [element("p", { class: "note" }, reason), suite.tables.map(powerTable)].flat();
  }
  const xs = drawn.flatMap((row) => row.points.map((p) => p[axis.place]));
  const x = axis.bend
    ? { range: [Math.min(...xs) / 1.2, Math.max(...xs) * 1.2], ticks: [0.001, 0.01, 0.1, 1, 10, 100, 1000], label: suite.unit ? `strength (1: ${suite.unit})` : "strength", bend: axis.bend }
    : { range: [0, 100 * Math.max(0.01, ...xs)], ticks: ticks(0, 100 * Math.max(0.01, ...xs)), label: axis.label };
  x.ticks = x.ticks.filter((t) => t >= x.range[0] && t <= x.range[1]);
  const low = metric.chance ? 40 : 0;
  const y = { range: [low, 100], ticks: ticks(low, 100), label: `${metric.title} (%)` };
  const plot = chart(`${metric.title} over ${axis.title}, split ${suite.split}`, x, y, { width: 560, height: 340 });
  const legend = [];
  const named = suite.rows.filter((row) => !row.trivial).map((row) => row.label);
  for (const row of drawn.filter((r) => r.trivial)) plot.drawing.append(powerLine(plot, row, axis, NULL));
  for (const row of drawn.filter((r) => !r.trivial)) {
    const i = named.indexOf(row.label); // so that a row keeps its colour when others are left out
    const kind = `series-${i % 8}${i % 16 >= 8 ? " dashed" : ""}${i >= 16 ? " dotted" : ""}`;
    legend.push([kind, row.label]);
    plot.drawing.append(powerLine(plot, row, axis, kind));
  }
  if (drawn.some((r) => r.trivial)) legend.push([NULL, "trivial rows"]);
  return [
    figure([plot.drawing], legend,
      `Split ${suite.split}, digest ${suite.digest.slice(0, 12)}. Means over environments and kinds of anomalies, from the weakest rung of their ladders to the strongest.`),
    suite.tables.map(powerTable),
  ].flat();
}

const powerLine = (plot, row, axis, kind) =>
  line(plot, row.points.map((p) => (axis.bend ? 1 : 100) * p[axis.place]), row.points.map((p) => 100 * p[2]), kind);

function powerTable({ title, note, header, rows }) {
  const table = tableOf({ class: "plain" }, `${sentence(title)} ${note}`, header, rows.map(([label, ...cells]) => lineOf(label, cells)));
  return element("div", { class: "scroll", tabindex: 0, role: "group", "aria-label": "Scrolls sideways" }, csvButton("suite", () => table), table);
}
