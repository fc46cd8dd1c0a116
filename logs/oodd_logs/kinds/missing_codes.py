"""Codes for values that are missing: texts of spreadsheets and C libraries, and a recipe's own."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

from oodd_eval.errors import UsageError
from oodd_logs.kinds import Kind

KEY: Final = "missing_codes"

_MISSING: Final = re.compile(
    r"#(n/?a|value|div/0|ref|num|null|name)[!?]?|[?*.-]{1,3}|n[./]?[ad][.]?|<(na|nan)>|[+]?nan|nat|nil|"
    r"[+-]?nan\((s?nan|ind)\)|[+-]?1[.]#(ind|qnan|snan)0*|"
    r"missing|void|undef|undefined|unknown|invalid|bad|bad input|err|error|offline|timeout|"
    r"no[ _-]?data|not available|out of range"
)
_INFINITE: Final = {"1.#inf": math.inf, "+1.#inf": math.inf, "-1.#inf": -math.inf}


def _read(texts: Sequence[str]) -> Mapping[str, float]:
    words = {text: text.strip().lower() for text in texts}
    missing = {text: math.nan for text, word in words.items() if _MISSING.fullmatch(word)}
    return missing | {t: _INFINITE[word] for t, word in words.items() if word in _INFINITE}


def check(key: str, value: Any) -> tuple[float | str, ...]:
    """Return the codes that a recipe names; `UsageError` for other values."""
    if not isinstance(value, list | tuple) or not all(
        type(code) in {int, float, str} for code in value
    ):
        raise UsageError(f"{key} is {value!r:.80}, expected a list of numbers and texts")
    return tuple(value)


KIND: Final = Kind(
    "missing-codes",
    "{names}: numbers that stand for a missing value, it seems: {line}",
    key=KEY,
    check=check,
    convert=lambda _codes, _sensors: (),  # they are missing before there are sensors
    read=_read,
)
