// Drawings of one cell: ROC curve, delay against false-alarm rate, one trajectory with its twin.

const TWIN = "twin";
const ANOMALOUS = "anomalous";
const NULL = "null";

/** A scale from numbers to positions; `bend` makes it other than linear. */
function scale([from, to], [start, stop], bend = (v) => v) {
  const [low, high] = [bend(from), bend(to)];
  return (value) => start + ((bend(value) - low) / (high - low || 1)) * (stop - start);
}

/** About `n` round numbers between two. */
function ticks(from, to, n = 5) {
  const rough = (to - from) / n || 1;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * ([1, 2, 5].find((m) => m * power >= rough) ?? 10);
  const found = [];
  for (let t = Math.ceil(from / step - 1e-9) * step; t <= to + 1e-9 * step; t += step) found.push(Number(t.toPrecision(12)));
  return found;
}

/** Linear up to about `unit`, logarithmic beyond: for numbers with a few very large among them. */
const bent = (unit) => (value) => Math.asinh(value / unit);

/** 0 and powers of ten times a unit, on both sides, within a range; not more than can be read. */
function bentTicks(unit, from, to) {
  const positive = [];
  for (let t = unit; t <= Math.max(to, -from); t *= 10) positive.push(t);
  const every = Math.ceil(positive.length / 5);
  const kept = positive.filter((_, i) => i % every === 0);
  return [...kept.map((t) => -t).reverse(), 0, ...kept].filter((t) => t >= from && t <= to);
}

/** Ticks that are at least `room` apart where they are drawn. */
function apart(values, position, room) {
  const kept = [];
  for (const value of values) {
    if (!kept.length || Math.abs(position(value) - position(kept.at(-1))) >= room) kept.push(value);
  }
  return kept;
}

/** An empty chart with axes: `x` and `y` are {range, ticks, label, bend}; no label, no text. */
function chart(name, x, y, options = {}) {
  const { width = 440, height = 300, left = 58, right = 14, top = 12, bottom = x.label ? 44 : 26 } = options;
  const sx = scale(x.range, [left, width - right], x.bend);
  const sy = scale(y.range, [height - bottom, top], y.bend);
  const [across, up] = [apart(x.ticks, sx, 30), apart(y.ticks, sy, 13)];
  const drawing = shape("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": name, class: options.class },
    shape("g", { class: "grid" },
      across.map((t) => shape("line", { x1: sx(t), x2: sx(t), y1: top, y2: height - bottom })),
      up.map((t) => shape("line", { x1: left, x2: width - right, y1: sy(t), y2: sy(t) }))),
    shape("g", { class: "axis" },
      across.map((t) => shape("text", { x: sx(t), y: height - bottom + 16, "text-anchor": "middle" }, brief(t))),
      up.map((t) => shape("text", { x: left - 7, y: sy(t) + 4, "text-anchor": "end" }, brief(t))),
      x.label && shape("text", { class: "label", x: (left + width - right) / 2, y: height - 6, "text-anchor": "middle" }, x.label),
      shape("text", {
        class: "label", "text-anchor": "middle",
        transform: `translate(14 ${(top + height - bottom) / 2}) rotate(-90)`,
      }, y.label)));
  // Drawn at most a little larger than designed, so that letters are alike in all charts.
  drawing.style.maxWidth = `${Math.round(1.3 * width)}px`;
  return { drawing, sx, sy, left, right: width - right, top, bottom: height - bottom };
}

/** A line through points; null breaks it. */
function line(plot, xs, ys, kind) {
  let path = "";
  let open = false;
  ys.forEach((y, i) => {
    if (!isNumber(y)) { open = false; return; }
    path += `${open ? "L" : "M"}${plot.sx(xs[i]).toFixed(1)} ${plot.sy(y).toFixed(1)}`;
    open = true;
  });
  return shape("path", { class: `line ${kind}`, d: path });
}

/** A figure: drawings, legend, caption, and the numbers behind them. */
function figure(drawings, legend, caption, numbers) {
  return element("figure", {},
    scroller(drawings),
    legend.length ? element("ul", { class: "legend" }, legend.map(([kind, text]) => element("li", {},
      shape("svg", { width: 26, height: 10, viewBox: "0 0 26 10", "aria-hidden": "true" },
        kind === "point"
          ? shape("circle", { class: kind, cx: 13, cy: 5, r: 4 })
          : shape("line", { class: `line ${kind}`, x1: 1, x2: 25, y1: 5, y2: 5 })), text))) : null,
    element("figcaption", {}, caption),
    numbers && element("details", {}, element("summary", {}, "Numbers"), scroller(numbers())));
}

function numbersTable(columns) {
  const names = Object.keys(columns);
  return element("table", { class: "numbers" },
    element("thead", {}, element("tr", {}, names.map((n) => element("th", { scope: "col" }, n)))),
    element("tbody", {}, columns[names[0]].map((_, i) => element("tr", {}, names.map((n) => element("td", {}, brief(columns[n][i])))))));
}

function rocFigure(roc, area, paired = true) {
  if (!roc.fpr.length) return element("p", { class: "note" }, "No ROC curve: no trajectory has scores of both classes.");
  const unit = { range: [0, 1], ticks: [0, 0.2, 0.4, 0.6, 0.8, 1] };
  const plot = chart("ROC curve", { ...unit, label: "false-positive rate" }, { ...unit, label: "true-positive rate" },
    { width: 330, height: 320 });
  plot.drawing.append(
    line(plot, [0, 1], [0, 1], NULL),
    line(plot, [0, ...roc.fpr], [0, ...roc.tpr], ANOMALOUS));
  return figure([plot.drawing], [[ANOMALOUS, `this detector (${paired ? "matched" : "pooled"} AUC ${show(area, "percent")} %)`], [NULL, "no better than chance (50 %)"]],
    paired ? "Scores from the onset on against the nominal twin\u2019s at the same times, averaged over test trajectories at equal false-positive rates."
      : "Anomalous rows against the same rows of nominal test episodes (without a common clock against all their rows), averaged over episodes at equal false-positive rates.",
    () => numbersTable({ "false-positive rate": roc.fpr, "true-positive rate": roc.tpr }));
}

/** False-alarm rates run from 0 to a few tenths; a square root gives the small ones room. */
function farAxis(far, paired) {
  const top = Math.max(0.01, ...far) * 1.02;
  const marks = [0, 0.001, 0.01, 0.03, 0.1, 0.2, 0.3, 0.5, 0.8].filter((t) => t <= top);
  return { range: [0, top], ticks: marks, label: `achieved false-alarm rate on nominal ${paired ? "twins" : "test episodes"} (alarms per step)`, bend: Math.sqrt };
}

function delayFigure(points) {
  const paired = Boolean(points.null_censored);
  if (!points.far.length) {
    return element("p", { class: "note" }, paired ? "No curve: no score of the twins is defined."
      : "No curve of delays: no episode has a known start, or no score of nominal test episodes is defined.");
  }
  const x = farAxis(points.far, paired);
  const high = Math.max(1, ...points.delay_censored, ...points.null_censored ?? []) * 1.05;
  const plot = chart("Delay against false-alarm rate", { ...x, label: null }, { range: [0, high], ticks: ticks(0, high), label: "delay (steps)" }, { height: 210 });
  if (paired) plot.drawing.append(line(plot, points.far, points.null_censored, TWIN));
  plot.drawing.append(line(plot, points.far, points.delay_censored, ANOMALOUS));
  const missed = chart("Missed trajectories against false-alarm rate", x, { range: [0, 1], ticks: [0, 0.5, 1], label: "missed" }, { height: 110 });
  missed.drawing.append(line(missed, points.far, points.missed, ANOMALOUS));
  const legend = [[ANOMALOUS, "anomalous trajectories"]];
  if (paired) legend.push([TWIN, "nominal twins: what false alarms alone give"]);
  const at = points.threshold.indexOf(DATA.threshold);
  if (at >= 0) {
    plot.drawing.append(shape("circle", { class: "point", cx: plot.sx(points.far[at]), cy: plot.sy(points.delay_censored[at]), r: 4.5 }));
    missed.drawing.append(shape("circle", { class: "point", cx: missed.sx(points.far[at]), cy: missed.sy(points.missed[at]), r: 4.5 }));
    legend.push(["point", `the paper\u2019s threshold, ${DATA.threshold}`]);
  }
  return figure([plot.drawing, missed.drawing], legend,
    `Mean delay from the ${paired ? "onset" : "first anomalous row"} to the first alarm, a miss counting as the whole remainder of the episode, over the whole range of CUSUM thresholds; below it the share of trajectories without an alarm. The scale of false-alarm rates is a square root. Left is stricter: fewer false alarms, longer delay.`,
    () => numbersTable({
      "threshold": points.threshold, "false-alarm rate": points.far, "delay (steps)": points.delay_censored,
      "missed": points.missed, ...(paired ? { "twins\u2019 delay (steps)": points.null_censored } : {}),
    }));
}

/** A vertical axis over some numbers: linear, or bent where a few are very large (no step). */
function axisOf(values, unit, step, label) {
  const numbers = values.filter(isNumber);
  const low = Math.min(0, ...numbers);
  const high = Math.max(unit, ...numbers);
  if (step === null) {
    return { range: [low * 1.1, high * 1.1], ticks: bentTicks(unit, low * 1.1, high * 1.1), label, bend: bent(unit) };
  }
  const room = 0.05 * (high - low);
  const range = [low < 0 ? low - room : 0, high + room];
  return { range, ticks: ticks(...range, 6), label };
}

/** Drawings of sensors, the twin's dashed, over the same time as an example. */
function sensorCharts(sensors, example, x, wide, onset) {
  return sensors.map(({ name, step, own, twin }) => {
    const part = (values) => values.slice(example.start, example.start + Math.max(example.scores.length, example.twin.length)).map((v) => v * step);
    const [first, second] = [part(own), part(twin)];
    const all = [...first, ...second];
    const range = [Math.min(...all), Math.max(...all, Math.min(...all) + step)];
    const plot = chart(`Sensor: ${name}`, { ...x, label: null }, { range, ticks: ticks(...range, 3), label: "" }, { ...wide, height: 130, top: 24 });
    plot.drawing.append(shape("text", { class: "label", x: plot.left, y: 14 }, name), onset(plot, false),
      line(plot, second.map((_, i) => example.start + i), second, TWIN),
      line(plot, first.map((_, i) => example.start + i), first, ANOMALOUS));
    return plot;
  });
}

/**
 * Scores and statistic of one episode: beside its twin's, from the onset on, or without a twin with its anomalous
 * rows shaded. `sensors` is a promise of what its sensors read.
 */
function exampleFigure(example, sensors = null) {
  const paired = Boolean(example.twin);
  const last = example.start + Math.max(example.scores.length, example.twin?.length ?? 0) - 1;
  const x = { range: [example.start, last], ticks: ticks(example.start, last, 10), label: "observation row t" };
  const wide = { width: 920, class: "wide" };
  const drawn = (plot, twin, own) => [[twin, TWIN], [own, ANOMALOUS]].filter(([values]) => values)
    .map(([values, kind]) => line(plot, values.map((_, i) => example.start + i), values, kind));
  const onset = (plot, text) => shape("g", { class: "onset" },
    shape("line", { x1: plot.sx(example.onset), x2: plot.sx(example.onset), y1: plot.top, y2: plot.bottom }),
    text && shape("text", { x: plot.sx(example.onset), y: plot.top - 6, "text-anchor": "middle" }, `onset \u03c4 = ${example.onset}`));
  const shades = (plot) => shape("g", { class: "anomalous-rows" }, example.intervals.map(([start, stop]) => {
    const [from, to] = [Math.max(start, example.start), Math.min(stop - 1, last)].map((t) => plot.sx(t));
    return to < plot.left || from > plot.right || to < from ? null : shape("rect", {
      class: start < 0 ? "unknown" : null, x: from, width: Math.max(1, to - from), y: plot.top, height: plot.bottom - plot.top,
    });
  }));
  const anomalous = paired ? onset : shades;

  const scoreAxis = axisOf([...example.scores, ...example.twin ?? []], 1, example.score_step, "score (s.d.)");
  const cusumAxis = axisOf([...example.cusum, ...example.twin_cusum ?? []], DATA.threshold, example.cusum_step, "CUSUM");
  const scores = chart("Scores", { ...x, label: null }, scoreAxis, { ...wide, height: 210, top: 22 });
  scores.drawing.append(anomalous(scores, true), ...drawn(scores, example.twin, example.scores));
  const cusum = chart("CUSUM statistic and alarms", x, cusumAxis, { ...wide, height: paired ? 250 : 240, bottom: paired ? 84 : 74 });
  cusum.drawing.append(anomalous(cusum, false),
    shape("line", { class: "threshold", x1: cusum.left, x2: cusum.right, y1: cusum.sy(DATA.threshold), y2: cusum.sy(DATA.threshold) }),
    ...drawn(cusum, example.twin_cusum, example.cusum), alarmStrip(cusum, example.alarms, ANOMALOUS, 26),
    ...paired ? [alarmStrip(cusum, example.twin_alarms, TWIN, 40)] : []);

  const first = (alarms) => {
    const found = alarms.find((t) => t >= example.onset);
    return found === undefined ? "none in this window" : found === example.onset ? "at the onset" : `${found - example.onset} step${found === example.onset + 1 ? "" : "s"} after the onset`;
  };
  const reveals = [revealer(scores), revealer(cusum)];
  const controls = player(example, reveals);
  const above = sensors && element("figure", {});
  sensors?.then((found) => {
    for (const plot of sensorCharts(found ?? [], example, x, wide, onset)) {
      above.append(scroller(plot.drawing));
      reveals.push(revealer(plot));
    }
  }, (error) => above.append(notLoaded(error)));
  const area = paired ? example.auc_matched : example.auc_pool;
  const spans = example.intervals?.map(([start, stop]) => start < 0 ? `up to ${stop - 1}, from an unknown row on` : `${start} to ${stop - 1}`);
  const labelled = !spans ? "" : spans.length ? `Anomalous rows, shaded: ${spans.join("; ")}. ` : "Which of its rows are anomalous is not known. ";
  const alarms = paired ? ` First alarm from the onset on: anomalous ${first(example.alarms)}, twin ${first(example.twin_alarms)}.` : "";
  return [controls, above ?? [], figure([scores.drawing, cusum.drawing],
    [[ANOMALOUS, `anomalous ${paired ? "trajectory" : "episode"}`], ...paired ? [[TWIN, "its nominal twin"]] : [], ["threshold", `alarm threshold ${DATA.threshold}`]],
    `Test ${paired ? "trajectory" : "episode"} ${example.index}, the one with the median ${paired ? "matched" : "pooled"} AUC (${area === null ? "undefined" : `${show(area, "percent")} %`}) of this cell, ` +
    `rows ${example.start} to ${last} of ${example.length}. ${labelled}` +
    `Scores in standard deviations from the mean of the calibration scores; CUSUM statistic with drift ${DATA.drift}, before the reset that an alarm brings; marks below it are alarms.${alarms}` +
    `${scoreAxis.bend || cusumAxis.bend ? " Where values are very large the upright scale is logarithmic." : ""}`)];
}

/** Marks below a chart, one for each alarm. */
function alarmStrip(plot, alarms, kind, below) {
  const y = plot.bottom + below;
  return shape("g", { class: `alarms ${kind}` },
    shape("text", { x: plot.left - 7, y: y + 8, "text-anchor": "end" }, kind === TWIN ? "twin\u2019s" : "alarms"),
    alarms.map((t) => shape("line", { x1: plot.sx(t), x2: plot.sx(t), y1: y, y2: y + 9 })));
}
