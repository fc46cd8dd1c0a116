// Which view an address asks for: `#/[?FILTERS]` the table, `#/detector/ROW[/PLACE/ANOMALY]` a row.

let shown = null;

function route() {
  const wanted = location.hash.replace(/^#\/?/, "");
  const [view, id, ...cell] = wanted.split("/").map(decoded);
  const found = view === "detector" ? ROWS.get(id) : null;
  const page = document.getElementById("detector");
  document.getElementById("overview").hidden = Boolean(found);
  page.hidden = !found;
  document.title = found ? `${found.row.label} \u2013 ${TITLE}` : TITLE;
  if (!found) {
    page.replaceChildren();
    restore(wanted.startsWith("?") ? wanted : "");
    drawFilters();
    drawTable();
    const link = shown && document.querySelector(`[data-row="${CSS.escape(shown)}"] a`);
    if (link) link.focus();
    shown = null;
    return;
  }
  state.board = found.board.id;
  page.replaceChildren(...detectorPage(found.board, found.row, cell).filter(Boolean));
  if (shown !== id) {
    window.scrollTo(0, 0);
    page.querySelector("h1").focus();
  } else if (cell.length) {
    page.querySelector(".heat [aria-current]")?.focus({ preventScroll: true });
  }
  shown = id;
}

/** A piece of an address; one that was damaged by hand is left as it is. */
function decoded(piece) {
  try {
    return decodeURIComponent(piece);
  } catch {
    return piece;
  }
}

const TITLE = document.title;

drawPower();
if (DATA.boards.length) {
  window.addEventListener("hashchange", route);
  route();
} else {
  document.getElementById("overview").append(element("p", { class: "note" }, "There are no entries yet."));
}
