// Detection power: what rows find of weaker anomalies, drawn over the strength or over its cost.

const power = { metric: 0, axis: "strength" };

const POWER_AXES = {
  strength: { title: "strength", place: 0, label: "strength (1: costs 1 % of the return)", bend: Math.log10 },
  lost: { title: "return lost", place: 1, label: "return lost (%)" },
};

function drawPower() {
  const place = document.getElementById("power");
  place.hidden = !DATA.power.length;
  if (place.hidden) return;
  const metrics = DATA.power[0].metrics.map((metric, i) => [i, metric.title]);
  const axes = Object.entries(POWER_AXES).map(([name, axis]) => [name, `over ${axis.title}`]);
  place.replaceChildren(
    element("h2", {}, "Weaker anomalies"),
    element("form", { class: "choices", "aria-label": "What to draw", autocomplete: "off" },
      powerChoice("metric", "Measure", metrics), powerChoice("axis", "Drawn", axes)),
    ...DATA.power.flatMap(powerOf));
}

function powerChoice(name, legend, options) {
  return element("fieldset", { class: "views" }, element("legend", {}, legend), options.map(([value, title]) =>
    element("label", {}, element("input", {
      type: "radio", name: `power-${name}`, value, checked: power[name] === value,
      onchange: () => {
        power[name] = value;
        drawPower();
        document.querySelector(`[name="power-${name}"][value="${value}"]`).focus();
      },
    }), element("span", {}, title))));
}

/** Chart and tables of one split with graded strengths. */
function powerOf(suite) {
  const axis = POWER_AXES[power.axis];
  const metric = suite.metrics[power.metric];
  const drawn = suite.rows.map((row) => ({ ...row, points: row.points[power.metric].filter((p) => isNumber(p[axis.place])) }));
  const xs = drawn.flatMap((row) => row.points.map((p) => p[axis.place]));
  const x = axis.bend
    ? { range: [Math.min(...xs) / 1.2, Math.max(...xs) * 1.2], ticks: [0.001, 0.01, 0.1, 1, 10, 100, 1000], label: axis.label, bend: axis.bend }
    : { range: [0, 100 * Math.max(0.01, ...xs)], ticks: ticks(0, 100 * Math.max(0.01, ...xs)), label: axis.label };
  x.ticks = x.ticks.filter((t) => t >= x.range[0] && t <= x.range[1]);
  const low = metric.chance ? 40 : 0;
  const y = { range: [low, 100], ticks: ticks(low, 100), label: `${metric.title} (%)` };
  const plot = chart(`${metric.title} over ${axis.title}, split ${suite.split}`, x, y, { width: 560, height: 340 });
  const legend = [];
  for (const row of drawn.filter((r) => r.trivial)) plot.drawing.append(powerLine(plot, row, axis, NULL));
  for (const row of drawn.filter((r) => !r.trivial)) {
    const kind = `series-${legend.length % 8}${legend.length >= 4 ? " dashed" : ""}`;
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

function powerTable(table) {
  const [first, ...others] = table.header;
  return element("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": table.title },
    element("table", { class: "plain" }, captionOf(`${table.title}. ${table.note}`),
      element("thead", {}, element("tr", {}, element("th", { scope: "col", class: "left" }, first), others.map((text) => element("th", { scope: "col" }, text)))),
      element("tbody", {}, table.rows.map(([label, ...cells]) =>
        element("tr", {}, element("th", { scope: "row" }, label), cells.map((text) => element("td", {}, text)))))));
}
