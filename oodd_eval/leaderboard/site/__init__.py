"""The leaderboard's site: one HTML file that works from disk, without a server or a network.

Data is embedded as JSON, styles and scripts are in the page, and its content security policy
allows nothing else, by digest. What the page shows is in `oodd_eval.leaderboard.site.data`.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from oodd_eval._version import __version__
from oodd_eval.errors import OutputError
from oodd_eval.leaderboard.entry import SubmittedEntry
from oodd_eval.leaderboard.site.data import site_data

PAGE: Final = "index.html"

SCRIPTS: Final = (
    "core.js",
    "model.js",
    "columns.js",
    "table.js",
    "filters.js",
    "plots.js",
    "detector.js",
    "main.js",
)
"""Parts of the page's one script, in order."""

_STATIC = Path(__file__).with_name("static")


def render(entries: Sequence[SubmittedEntry], output: Path) -> Path:
    """Write the site of some entries into a directory and return its page.

    Parameters
    ----------
    entries
        As read by `oodd_eval.leaderboard.entry.read_entries`.
    output
        Directory; it is made where it is missing.

    Raises
    ------
    ResultsError
        When the curves of an entry cannot be read.
    OutputError
        When the page cannot be written.
    """
    text = page(entries)
    path = output / PAGE
    try:
        output.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{str(path)!r} cannot be written: {error}") from None
    return path


def page(entries: Sequence[SubmittedEntry]) -> str:
    """Return the page of some entries; the same entries give the same text."""
    data, curves = site_data(entries)
    script = "(() => {\n" + "\n".join(_static(name) for name in SCRIPTS) + "})();\n"
    style = _static("style.css")
    parts = {
        "version": __version__,
        "style": style,
        "style-hash": _digest(style),
        "script": script,
        "script-hash": _digest(script),
        "data": embedded(data),
        "curves": "\n".join(
            f'<script type="application/json" id="curves-{i}">{embedded(part)}</script>'
            for i, part in enumerate(curves)
        ),
    }
    # One pass, so that nothing in the data is taken for a place to fill in.
    return re.sub(r"@([a-z-]+)@", lambda match: parts[match[1]], _static("page.html"))


def embedded(value: Any) -> str:
    r"""Return JSON that may stand in a script element: no markup in it can end the element.

    Examples
    --------
    >>> embedded("</script>")
    '"\\u003c/script\\u003e"'
    """
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _static(name: str) -> str:
    return (_STATIC / name).read_text(encoding="utf-8")


def _digest(content: str) -> str:
    """Return what a content security policy names a style or script by."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"
