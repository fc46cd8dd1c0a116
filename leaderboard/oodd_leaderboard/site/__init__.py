"""The leaderboard's site: a page and data files beside it, from disk or from any web server.

The page holds styles, scripts and the index of all rows. Its content security policy allows that
style and script, by digest, and scripts beside the page: the data files, loaded when needed. Each
calls one function with its name and its content as JSON text. What they hold is computed in
`oodd_leaderboard.site.content`.
"""

import base64
import hashlib
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from oodd_eval._version import __version__
from oodd_leaderboard.reported import REPORTED, LeaderboardSection, SuiteSection
from oodd_leaderboard.site.content import Json, site_data

PAGE: Final = "index.html"
PARTS: Final = "data"  # directory of the data files

SCRIPTS: Final = (
    "core.js",
    "model.js",
    "columns.js",
    "table.js",
    "filters.js",
    "plots.js",
    "player.js",
    "power.js",
    "overviews.js",
    "detector.js",
    "pair.js",
    "main.js",
)
"""Parts of the page's one script, in order."""

_STATIC = Path(__file__).with_name("static")


def files(
    sections: Sequence[LeaderboardSection],
    suites: Sequence[SuiteSection] = (),
    *,
    project: str = "",
) -> dict[str, str]:
    """Return the files of a leaderboard's site by name; the same entries give the same bytes.

    `project` is the address of code and documents; without it the page does not link to them.
    """
    data, parts = site_data(sections, suites)
    contents = {PAGE: index(data | {"project": project})}
    for name, part in parts.items():
        contents[f"{PARTS}/{name}.js"] = data_file(name, part)
    return contents


def index(data: Json) -> str:
    """Return the page with its index of all rows."""
    script = "(() => {\n" + "\n".join(_static(name) for name in SCRIPTS) + "})();\n"
    style = _static("style.css")
    parts = {
        "version": __version__,
        "reported": REPORTED,
        "style": style,
        "style-hash": _digest(style),
        "script": script,
        "script-hash": _digest(script),
        "data": embedded(data),
    }
    # One pass, so that nothing in the data is taken for a place to fill in.
    return re.sub(r"@([a-z-]+)@", lambda match: parts[match[1]], _static("page.html"))


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
