// For those who use no pointer: the search has a name, and what scrolls sideways does so by keyboard.
document.querySelector(".md-search")?.setAttribute("aria-label", "Search");

function reachScrolling() {
  for (const box of document.querySelectorAll(".md-typeset pre > code, .md-typeset__scrollwrap, .md-typeset p:has(> img)")) {
    if (box.scrollWidth > box.clientWidth) box.tabIndex = 0;
    else box.removeAttribute("tabindex");
  }
}

window.addEventListener("load", reachScrolling);
window.addEventListener("resize", reachScrolling);
