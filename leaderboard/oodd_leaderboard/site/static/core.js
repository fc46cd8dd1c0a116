"use strict";
// Elements, numbers and small things that every other part uses. Text enters the page as text
// nodes only, so that nothing in a submitted name or note is read as HTML.

const UNDEFINED = "\u2013";

/** Make an element: attributes by name, `on…` as listeners, true as empty, null left out. */
function element(tag, attributes = {}, ...children) {
  return build(document.createElement(tag), attributes, children);
}

/** Make an element of a drawing. */
function shape(tag, attributes = {}, ...children) {
  return build(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);
}

function build(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else node.setAttribute(name, value === true ? "" : value);
  }
  for (const child of children.flat(Infinity)) {
    if (child !== null && child !== undefined && child !== false) node.append(child);
  }
  return node;
}

/** A table's caption. It stays in sight where the table is wider than the window. */
const captionOf = (text) => element("caption", {}, element("span", {}, text));

/** A name of parts that may stand on two lines: it breaks behind punctuation, never within a word or number. */
const breakable = (text) => text.split(/(?<=[[\](),=:_/]|\.(?!\d))/).flatMap((piece, i) => i ? [element("wbr"), piece] : [piece]);

/** A text with a capital at its beginning, and one as a sentence. */
const sentenceCase = (text) => text && text[0].toUpperCase() + text.slice(1);
const sentence = (text) => text && sentenceCase(text) + (/[.!?]$/.test(text) ? "" : ".");

const isNumber = (value) => typeof value === "number" && Number.isFinite(value);

/** Mean of the numbers among some values; null when there is none. */
function meanOf(values) {
  const defined = values.filter(isNumber);
  return defined.length ? defined.reduce((a, b) => a + b, 0) / defined.length : null;
}

/** One number as printed: AUCs in percent, delays in steps, rates as they are. */
function show(value, kind) {
  if (!isNumber(value)) return UNDEFINED;
  if (kind === "percent") return (100 * value).toFixed(1);
  return kind === "steps" ? value.toFixed(1) : value.toFixed(3);
}

/** A number to a few significant digits, for costs and axes. */
function brief(value, digits = 3) {
  if (!isNumber(value)) return UNDEFINED;
  if (value !== 0 && (Math.abs(value) >= 1e6 || Math.abs(value) < 1e-4)) {
    return value.toExponential(0).replace("e+", "e");
  }
  return String(Number(Math.abs(value) >= 100 ? value.toFixed(0) : value.toPrecision(digits)));
}

const titleOfUnit = { percent: "%", steps: "steps", rate: "share" };

/** Ids as they may stand in an address, piece by piece. */
const address = (...pieces) => "#/" + pieces.map(encodeURIComponent).join("/");

/** A table as CSV: what stands in its cells, without marks of sorting. */
function csvOf(table) {
  const text = (cell) => (cell.dataset.csv ?? cell.textContent).replace(/\s+/g, " ").trim();
  const quoted = (value) => /[",\n]/.test(value) ? `"${value.replaceAll('"', '""')}"` : value;
  // A spreadsheet would run a text that begins like a formula.
  const safe = (value) => /^[=+@\t]/.test(value) ? `'${value}` : value;
  return [...table.rows].map((row) => [...row.cells].map((cell) => quoted(safe(text(cell)))).join(",")).join("\n") + "\n";
}

/** Hand a text over as a file. */
function download(name, text, type = "text/csv") {
  const link = element("a", { href: URL.createObjectURL(new Blob([text], { type })), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

/** A button that hands over the table that `find` returns when it is pressed. */
const csvButton = (name, find) =>
  element("button", { type: "button", class: "action", onclick: () => download(`${name}.csv`, csvOf(find())) }, "CSV");

/** A group of radio buttons that look like tabs; `choose` is called with the chosen value. */
function tabs(name, legend, options, chosen, choose) {
  return element("fieldset", { class: "views" }, element("legend", {}, legend), options.map(([value, title]) =>
    element("label", {}, element("input", {
      type: "radio", name, value, checked: String(value) === String(chosen), onchange: () => {
        choose(value);
        document.querySelector(`[name="${name}"][value="${CSS.escape(String(value))}"]`)?.focus();
      },
    }), element("span", {}, title))));
}

/** A drop-down list with its label. */
function dropdown(name, label, options, chosen, choose) {
  return element("label", {}, element("span", {}, label), element("select", { name, onchange: (event) => choose(event.target.value) },
    options.map(([value, text]) => element("option", { value, selected: value === chosen }, text))));
}

/** A table: its caption, titles of columns, the first to the left, and its lines. */
const tableOf = (attributes, caption, titles, lines) => element("table", attributes, captionOf(caption),
  element("thead", {}, element("tr", {}, titles.map((title, i) => element("th", { scope: "col", class: i ? null : "left" }, title)))),
  element("tbody", {}, lines));

/** A line of a table: its heading, and cells that are texts or elements. */
const lineOf = (heading, cells, hint = null) => element("tr", {}, element("th", { scope: "row", title: hint }, heading),
  cells.map((cell) => cell instanceof Element && cell.tagName === "TD" ? cell : element("td", {}, cell)));

const isDark = () => document.documentElement.dataset.theme === "dark";

/** A box that scrolls sideways when its content is wider than the page, by keyboard, too. */
const scroller = (...children) =>
  element("div", { class: "scroll", tabindex: 0, role: "group", "aria-label": "Scrolls sideways" }, children);
