"""Codes for values that are missing: texts of spreadsheets and C libraries, and a recipe's own."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from oodd_logs.kinds import Kind
from oodd_logs.kinds.naming import wrong_value

KEY: Final = "missing_codes"

_MISSING: Final = re.compile(
    r"#(n/?a|value|div/0|ref|num|null|name)[!?]?|[?*.-]{1,3}|n[./]?[ad][.]?|<(na|nan)>|[+]?nan|nat|nil|"
    r"[+-]?nan\((s?nan|ind)\)|[+-]?1[.]#(ind|qnan|snan)0*|"
    r"missing|void|undef|undefined|unknown|invalid|bad|bad input|err|error|offline|timeout|"
    r"no[ _-]?data|not available|out of range"
)
NUMBERS: Final = frozenset(
    [sign * code for code in (999, 9999, 99999, 999999, 999.25, 999.9, 9999.9) for sign in (1, -1)]
    + [32767, -32768, 65535, 2147483647, -2147483648, 4294967295, 1e20, 1e30, -1e30]
)
"""Numbers that often stand for a missing value."""

_FAR: Final = 3.0  # ranges of the other cells
_FEW: Final = 0.2  # of the recordings
_INFINITE: Final = {"1.#inf": math.inf, "+1.#inf": math.inf, "-1.#inf": -math.inf}


def _read(texts: Sequence[str]) -> Mapping[str, float]:
    words = {text: text.strip().lower() for text in texts}
    missing = {text: math.nan for text, word in words.items() if _MISSING.fullmatch(word)}
    return missing | {t: _INFINITE[word] for t, word in words.items() if word in _INFINITE}


def check(key: str, value: Any) -> dict[str, tuple[float | str, ...]]:
    """Return the codes of columns by glob, as a recipe names them; `UsageError` for other values.

    A list is of all columns; a table has a code, or a list, for each.
    """
    tables = value if isinstance(value, Mapping) else {"*": value} if value else {}
    codes = {g: (c,) if isinstance(c, int | float | str) else tuple(c) for g, c in tables.items()}
    if isinstance(value, int | float | str) or any(
        type(code) not in {int, float, str} for listed in codes.values() for code in listed
    ):
        raise wrong_value(key, value, "a list of numbers and texts, or a table of such by column")
    return codes


def _recognise(columns: Mapping[str, Any]) -> dict[str | tuple[str, ...], Any]:
    """Return usual codes far from all other cells of a column, in more than a few recordings.

    In one of many recordings the same number may be a fault.
    """
    recognised: dict[str | tuple[str, ...], Any] = {}
    for name, facts in columns.items():
        low, high = np.median(facts.inner or [(0.0, 0.0)], axis=0)
        least = max(2, _FEW * facts.recordings) if facts.recordings > 1 else 1
        cells = {code: sum(counts.values()) for code, counts in facts.codes.items()}
        usual = [c for c in cells if len(facts.codes[c]) >= least and cells[c] > 1]
        far = [c for c in usual if max(low - c, c - high) > _FAR * (high - low) > 0]
        if far and 2 * sum(cells.values()) < facts.cells:
            recognised[name] = max(far, key=lambda code: cells[code])
    return recognised


KIND: Final = Kind(
    "missing-code",
    "{names}: a number far from all others that may stand for a missing value: {line} says so",
    key=KEY,
    recognise=_recognise,
    check=check,
    convert=lambda _codes, _sensors: (),  # they are missing before there are sensors
    read=_read,
)
