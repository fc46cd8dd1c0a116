// Which view an address asks for: `#/` the table, `#/detector/ROW[/ENVIRONMENT/ANOMALY]` a row.

let shown = null;

function route() {
  const [view, id, ...cell] = location.hash.replace(/^#\/?/, "").split("/").map(decoded);
  const found = view === "detector" ? ROWS.get(id) : null;
  const page = document.getElementById("detector");
  document.getElementById("overview").hidden = Boolean(found);
  page.hidden = !found;
  document.title = found ? `${found.row.label} \u2013 ${TITLE}` : TITLE;
  if (!found) {
    page.replaceChildren();
    const link = shown && document.querySelector(`[data-row="${CSS.escape(shown)}"] a`);
    if (link) link.focus();
    shown = null;
    return;
  }
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

if (DATA.boards.length) {
  drawFilters();
  drawTable();
  window.addEventListener("hashchange", route);
  route();
} else {
  document.getElementById("overview").append(element("p", { class: "note" }, "There are no entries yet."));
}
