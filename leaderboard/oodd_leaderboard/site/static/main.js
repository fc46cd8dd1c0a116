// Which view an address asks for: `#/[?FILTERS]` the table, `#/detector/ROW[/ENVIRONMENT/ANOMALY]` a row,
// `#/power`, `#/cost` and `#/heat` the overviews.

const PAGES = {
  detector: {
    find: ([id]) => ROWS.get(id), parts: ({ row }) => [row.part], draw: ({ board, row }, [, ...cell]) => detectorPage(board, row, cell),
    again: ({ board, row }, [, ...cell]) => cellSections(board, row, cell), title: ({ row }) => row.label,
  },
  power: { find: () => DATA.suites.length ? {} : null, draw: () => powerPage(), title: () => "Weaker anomalies, worlds, logs" },
  cost: { find: () => ({ board: currentBoard() }), draw: ({ board }) => costPage(board), title: () => "Quality and cost" },
  heat: {
    find: () => ({ board: currentBoard() }), parts: ({ board }) => known(board, [board.ranking]).map((metric) => board.parts[metric]),
    draw: ({ board }) => heatPage(board), title: () => "Detectors by cells",
  },
};

let shown = null;
let turn = 0;

async function route() {
  const own = ++turn;
  const wanted = location.hash.replace(/^#\/?/, "");
  const [view, ...rest] = wanted.split("?")[0].split("/").map(decoded);
  const page = Object.hasOwn(PAGES, view) ? PAGES[view] : null;
  const found = page?.find(rest);
  const place = document.getElementById("detector");
  markNavigation(found ? view : "");
  document.getElementById("overview").hidden = Boolean(found);
  place.hidden = !found;
  document.title = found ? `${page.title(found)} \u2013 ${TITLE}` : TITLE;
  if (!found) {
    place.replaceChildren();
    restore(wanted.startsWith("?") ? wanted : "");
    drawControls();
    await drawTable();
    const link = shown && document.querySelector(`[data-row="${CSS.escape(shown)}"] a`);
    if (link) link.focus();
    shown = null;
    return;
  }
  if (found.board) state.board = found.board.id;
  const parts = page.parts?.(found) ?? [];
  if (parts.some((name) => !PARTS.has(name))) {
    place.replaceChildren(element("p", { class: "note", role: "status" }, "Loading \u2026"));
    try {
      await Promise.all(parts.map(load));
    } catch (error) {
      if (own === turn) place.replaceChildren(notLoaded(error));
      return;
    }
    if (own !== turn) return;
  }
  if (page.again && shown === rest[0] && document.getElementById("cell")) {
    // Another cell of the same row: what is below stays, which with hundreds of rows is long.
    for (const node of page.again(found, rest)) document.getElementById(node.id).replaceWith(node);
  } else place.replaceChildren(...[page.draw(found, rest)].flat().filter(Boolean));
  const id = [view, ...rest.slice(0, 1)].join("/");
  if (shown !== id && shown !== rest[0]) {
    window.scrollTo(0, 0);
    place.querySelector("h1").focus();
  } else if (rest.length > 1) {
    place.querySelector(".heat [aria-current]")?.focus({ preventScroll: true });
  }
  shown = view === "detector" ? rest[0] : id;
}

/** Say in the navigation which page this is. */
function markNavigation(view) {
  for (const link of document.querySelectorAll("header.site nav a[href^='#']")) {
    if (link.getAttribute("href") === `#/${view}`) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
}

/** A piece of an address; one that was damaged by hand is left as it is. */
function decoded(piece) {
  try {
    return decodeURIComponent(piece);
  } catch {
    return piece;
  }
}

/** Light or dark: what was chosen here before, else what the system says. */
function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  const other = theme === "dark" ? "light" : "dark";
  document.getElementById("theme").textContent = other === "dark" ? "Dark" : "Light";
  document.getElementById("theme").setAttribute("aria-label", `Switch to ${other} colours`);
}

function kept(value) {
  try {
    if (value) localStorage.setItem("oodd-theme", value);
    return localStorage.getItem("oodd-theme");
  } catch {
    return null; // A page from disk may have no storage.
  }
}

const TITLE = document.title;
const system = window.matchMedia("(prefers-color-scheme: dark)");

setTheme(kept() ?? (system.matches ? "dark" : "light"));
system.addEventListener("change", () => { if (!kept()) { setTheme(system.matches ? "dark" : "light"); route(); } });
document.getElementById("theme").addEventListener("click", () => {
  kept(isDark() ? "light" : "dark");
  setTheme(isDark() ? "light" : "dark");
  route();
});
if (DATA.boards.every((board) => board.paired)) for (const node of document.querySelectorAll(".of-logs")) node.remove();
if (DATA.boards.length) {
  window.addEventListener("hashchange", route);
  route();
} else {
  document.getElementById("more").hidden = true;
  document.getElementById("head").append(element("h1", {}, "Leaderboard"), element("p", { class: "note" }, "There are no entries yet."));
}
