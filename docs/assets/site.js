// What the theme leaves open for those who use no pointer: a name of the search, and code and tables
// that scroll sideways by keyboard.
document.querySelector(".md-search")?.setAttribute("aria-label", "Search");

function reachScrolling() {
  for (const box of document.querySelectorAll(".md-typeset pre > code, .md-typeset__scrollwrap")) {
    if (box.scrollWidth > box.clientWidth) box.tabIndex = 0;
    else box.removeAttribute("tabindex");
  }
}

window.addEventListener("load", reachScrolling);
window.addEventListener("resize", reachScrolling);
