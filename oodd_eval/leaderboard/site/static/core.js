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
