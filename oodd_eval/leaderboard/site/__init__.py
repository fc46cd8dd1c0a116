"""The leaderboard's site: a page and data files beside it, from disk or from any web server.

The page holds styles, scripts and the index of all rows. Its content security policy allows that
style and script, by digest, and scripts beside the page: the data files, loaded when needed. Each
calls one function with its name and its content as JSON text. What they hold is computed in
`oodd_eval.leaderboard.site.data`; here curves are made small.
"""

import base64
import hashlib
import itertools
import json
import math
import re
import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from oodd_eval._version import __version__
from oodd_eval.leaderboard.sections import LeaderboardSection
from oodd_eval.leaderboard.site.data import Json, site_data
from oodd_eval.metrics.cusum import THRESHOLD

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

LEVELS: Final = 250  # least steps from zero to the largest value of a drawing: one a pixel
HEAVY: Final = 30  # A largest value this many times the typical one asks for a logarithmic scale

_STATIC = Path(__file__).with_name("static")


def files(
    sections: Sequence[LeaderboardSection], power: Sequence[Json] = (), *, project: str = ""
) -> dict[str, str]:
    """Return the files of a leaderboard's site by name; the same entries give the same bytes.

    `power` is of further test suites. `project` is the address of code and documents; without it
    the page does not link to them.
    """
    data, parts = site_data(sections, power)
    contents = {PAGE: index(data | {"project": project})}
    for name, part in parts.items():
        if part.get("curves"):
            part = part | {"curves": packed(part["curves"])}  # noqa: PLW2901
        contents[f"{PARTS}/{name}.js"] = data_file(name, part)
    return contents


def index(data: Json) -> str:
    """Return the page with its index of all rows."""
    script = "(() => {\n" + "\n".join(_static(name) for name in SCRIPTS) + "})();\n"
    style = _static("style.css")
    parts = {
        "version": __version__,
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


def packed(curves: Mapping[str, Json]) -> Json:
    """Return the curves of a row's cells, by ``environment/anomaly``, in fewer characters.

    The result has ``lists``, every list of ``roc`` and ``delay_far`` once, and ``cells``, in which
    places in ``lists`` stand for these. Examples are those of `gridded`; their twins lack the first
    ``same_scores`` and ``same_cusum`` values, which are no others.
    """
    positions: dict[tuple[float, ...], int] = {}

    def position(numbers: Sequence[float]) -> int:
        return positions.setdefault(tuple(numbers), len(positions))

    cells = {}
    for name, cell in curves.items():
        example = _without_same(gridded(cell["example"]))
        lists = {
            part: {key: position(numbers) for key, numbers in cell[part].items()}
            for part in ("roc", "delay_far")
        }
        cells[name] = cell | lists | {"example": example}
    return {"lists": [list(numbers) for numbers in positions], "cells": cells}


def gridded(example: Json) -> Json:
    """Return an example whose scores and statistics are whole numbers of steps.

    A ``score_step`` or ``cusum_step`` of None says that the numbers are as they were, because a few
    are so large that they need a logarithmic scale.
    """
    steps = dict(example)
    for step_name, unit, names in (
        ("score_step", 1.0, ("scores", "twin")),
        ("cusum_step", THRESHOLD, ("cusum", "twin_cusum")),
    ):
        step = _step((v for name in names for v in example[name] if v is not None), unit)
        steps[step_name] = step
        if step is not None:
            for name in names:
                steps[name] = [None if v is None else round(v / step) for v in example[name]]
    return steps


def _without_same(example: Json) -> Json:
    """Leave out the beginnings of the twin's series: up to the onset both are the same."""
    shorter = dict(example)
    for name, twin in (("scores", "twin"), ("cusum", "twin_cusum")):
        pairs = zip(example[name], example[twin], strict=False)
        same = sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], pairs))
        shorter[f"same_{name}"] = same
        shorter[twin] = example[twin][same:]
    return shorter


def _step(numbers: Iterable[float], unit: float) -> float | None:
    """Return a round step for numbers that are drawn together; None where they are too uneven."""
    sizes = [abs(v) for v in numbers]
    largest = max([unit, *sizes])
    typical = max(unit, statistics.median(sizes) if sizes else unit)
    if largest > HEAVY * typical:
        return None
    power = math.floor(math.log10(largest / LEVELS))
    # Not 10**-4 but the float that is printed as 0.0001.
    steps = [float(f"{digit}e{power}") for digit in (1, 2, 5)]
    return max(s for s in steps if s <= largest / LEVELS * (1 + 1e-9))
