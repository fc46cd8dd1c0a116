"""The leaderboard's site: a page and data files beside it, from disk or from any web server.

The page holds styles, scripts and the index of all rows. Its content security policy allows that
style and script, by digest, and scripts beside the page: the data files, loaded when needed. Each
calls one function with its name and its content as JSON text. What they hold is computed in
`oodd_leaderboard.site.content`.
"""

import base64
import hashlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from oodd_eval._version import __version__, repository
from oodd_leaderboard.reported import LeaderboardSection, SuiteSection
from oodd_leaderboard.seasons import SeasonBoard
from oodd_leaderboard.site.content import Json, season_line, site_data

PAGE: Final = "index.html"
PARTS: Final = "data"  # directory of the data files

SCRIPTS: Final = (
    "core.js",
    "model.js",
    "table.js",
    "plots.js",
    "player.js",
    "power.js",
    "overviews.js",
    "detector.js",
    "main.js",
)
"""Parts of the page's one script, in order."""

LINKS: Final = {
    "home": ("Home", "README.md"),
    "submit": ("Submit", "docs/submitting.md"),
    "cite": ("Cite", "docs/cite.md"),
    "source": ("Source", "."),
}
"""Titles of the links that every page has beside the board, and where they lead in a checkout."""

_WITHOUT: Final = {"home": "../README.md", "submit": "../README.md#how-to-take-part"}
"""Links of a site that knows neither repository nor checkout: the page beside it."""

_STATIC = Path(__file__).with_name("static")


def project(directory: Path) -> str:
    """Return where the project's files are as seen from a directory, with a slash at the end.

    They are in the repository, in the checkout that the directory is in, or in that of this module;
    empty where there is none of them.
    """
    if address := repository():
        return f"{address}/blob/main/"
    here = directory.absolute()
    places = (*here.parents, *Path(__file__).parents)
    checkout = next((p for p in places if (p / LINKS["submit"][1]).is_file()), None)
    return os.path.relpath(checkout, here) + "/" if checkout else ""


def links(leaderboard: Path) -> dict[str, str]:
    """Return where the links of a site lead, by name; `leaderboard` is what its directory is in."""
    if not (base := project(leaderboard / "site")):
        return _WITHOUT
    addresses = {name: base + path for name, (_, path) in LINKS.items()}
    return addresses | (
        dict.fromkeys(("home", "source"), address) if (address := repository()) else {}
    )


def files(
    sections: Sequence[LeaderboardSection],
    suites: Sequence[SuiteSection] = (),
    seasons: Sequence[SeasonBoard] = (),
    *,
    links: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, str]:
    """Return the files of a leaderboard's site by name; the same input gives the same bytes.

    `links` are addresses by the names of `LINKS`; the page leaves out those that are not there.
    """
    data, parts = site_data(sections, suites, seasons)
    contents = {PAGE: index(data, season_line(seasons), links)}
    for name, part in parts.items():
        contents[f"{PARTS}/{name}.js"] = data_file(name, part)
    return contents


def index(data: Json, season: str = "", links: Mapping[str, str] = MappingProxyType({})) -> str:
    """Return the page with its index of all rows."""
    script = "(() => {\n" + "\n".join(_static(name) for name in SCRIPTS) + "})();\n"
    style = _static("style.css")
    parts = {
        "version": __version__,
        "season": escape(season),
        "links": "\n".join(_anchors(links)),
        "style": style,
        "style-hash": _digest(style),
        "script": script,
        "script-hash": _digest(script),
        "data": embedded(data),
    }
    # One pass, so that nothing in the data is taken for a place to fill in.
    return re.sub(r"@([a-z-]+)@", lambda match: parts[match[1]], _static("page.html"))


def _anchors(addresses: Mapping[str, str]) -> list[str]:
    """Return the links that every page has: home, the board, then the others."""
    home, *others = ((title, addresses.get(name, "")) for name, (title, _) in LINKS.items())
    ordered = [home, ("Board", "#/"), *others]
    return [f'<a href="{escape(to)}">{title}</a>' for title, to in ordered if to]


def data_file(name: str, value: Any) -> str:
    """Return a script that hands a value over as JSON text, in which nothing can act as code."""
    text = embedded(value).replace("\\", "\\\\").replace("'", "\\'")
    return f"ooddPart('{name}','{text}');\n"


def embedded(value: Any) -> str:
    r"""Return JSON that may stand in a script element: no markup in it can end the element."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _static(name: str) -> str:
    return (_STATIC / name).read_text(encoding="utf-8")


def _digest(content: str) -> str:
    """Return a style's or script's name in a content security policy."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"
