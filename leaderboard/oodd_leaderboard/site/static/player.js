// The player of a shown trajectory: its drawings up to a time, with what stands there in words.

const PACE = 40; // milliseconds a step

let clips = 0;

/** Returns a function of a time that shows the lines of a drawing up to then. */
function revealer(plot) {
  const name = `clip-${++clips}`;
  const box = shape("rect", { x: plot.left, y: 0, width: plot.right - plot.left, height: 2000 });
  plot.drawing.prepend(shape("defs", {}, shape("clipPath", { id: name }, box)));
  const cursor = shape("line", { class: "cursor", x1: plot.right, x2: plot.right, y1: plot.top, y2: plot.bottom });
  plot.drawing.append(cursor);
  for (const node of plot.drawing.querySelectorAll(".line, .alarms line")) {
    if (node.closest(".alarms")) node.parentNode.setAttribute("clip-path", `url(#${name})`);
    else node.setAttribute("clip-path", `url(#${name})`);
  }
  return (t) => {
    const x = plot.sx(t);
    box.setAttribute("x", plot.left - 60);
    box.setAttribute("width", Math.max(0, x - plot.left) + 60.5);
    cursor.setAttribute("x1", x);
    cursor.setAttribute("x2", x);
  };
}

/** Controls that move through an example; `reveals` are those of its drawings. */
function player(example, reveals) {
  const last = example.start + Math.max(example.scores.length, example.twin?.length ?? 0) - 1;
  const slow = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
  let timer = null;
  const words = element("output", { class: "words" });
  const slider = element("input", {
    type: "range", min: example.start, max: last, step: 1, value: last, "aria-label": "Time shown",
    oninput: () => { stop(); moveTo(Number(slider.value)); },
  });
  const button = element("button", { type: "button", class: "action", onclick: () => timer ? stop() : play() }, "Play");

  function moveTo(t) {
    slider.value = t;
    for (const reveal of reveals) reveal(t);
    words.textContent = momentOf(example, t);
  }

  function stop() {
    clearInterval(timer);
    timer = null;
    button.textContent = "Play";
  }

  function play() {
    if (Number(slider.value) >= last) moveTo(example.start);
    button.textContent = "Pause";
    const stride = slow ? 10 : 1; // fewer, larger moves where motion is not wanted
    timer = setInterval(() => {
      if (!slider.isConnected) { stop(); return; }
      moveTo(Math.min(last, Number(slider.value) + stride));
      if (Number(slider.value) >= last) stop();
    }, PACE * stride);
  }

  moveTo(last);
  return element("div", { class: "player" }, button, slider, words);
}

/** What an example shows at a time, in words. */
function momentOf(example, t) {
  const at = (list) => list[t - example.start];
  const value = (list) => isNumber(at(list)) ? brief(at(list), 2) : "undefined";
  const inside = () => example.intervals.some(([start, stop]) => t >= start && t < stop) ? "anomalous" : "not known to be anomalous";
  const phase = example.intervals ? inside() : t < example.onset ? `${example.onset - t} before the onset` : `${t - example.onset} after the onset`;
  const alarm = example.alarms.includes(t) ? ", alarm" : "";
  return `t = ${t}, ${phase}: score ${value(example.scores)}, statistic ${value(example.cusum)}${alarm}`;
}
