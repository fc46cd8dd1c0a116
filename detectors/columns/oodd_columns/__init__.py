"""Recorded columns as detectors: the plug-in `columns`."""

import re
from functools import partial
from importlib import import_module

from oodd_eval import Detector, DetectorSpec, hookimpl
from oodd_eval.errors import UsageError
from oodd_eval.names import COLUMN_NAME

_SUMMARIES = {
    "column": "{} as it was recorded is the score",
    "mean": "mean of {} since the episode began",
    "flag": "an alarm of its own: where {} is not 0",
}
_NAMED = re.compile(r"(-?)(?:\|(?P<a>.+)\||abs\((?P<b>.+)\)|(?P<c>.*))")


@hookimpl
def oodd_detector_from_spec(spec: str) -> DetectorSpec | None:
    """column:NAME, mean:NAME, flag:NAME: a recorded score, its running mean, a recorded alarm.

    Raises
    ------
    UsageError
        When the text behind the colon is no name of a column, perhaps with a sign.
    """
    kind, _, text = spec.partition(":")
    if kind not in _SUMMARIES:
        return None
    match = _NAMED.fullmatch(text)
    name = match and (match["a"] or match["b"] or match["c"])
    signs = "NAME" if kind == "flag" else "NAME, -NAME or abs(NAME)"
    if not match or not name or not re.fullmatch(COLUMN_NAME, name, re.ASCII):
        raise UsageError(
            f"{spec!r:.200} names no column: expected {kind}:{signs}, with a NAME of letters, "
            "digits, blanks and any of -_+./%()[]; import the logs with scores or sensors of such "
            'names, as in scores = ["new = old"]'
        )
    size = not match["c"]
    if kind == "flag" and (match[1] or size):
        raise UsageError(f"{spec!r}: a flag has no sign, expected {kind}:{name}")
    argument = match[1] + (f"abs({name})" if size else name)
    return DetectorSpec(
        name=f"{kind}:{argument}",
        factory=partial(_make, kind, -1 if match[1] else 1, size),
        summary=_SUMMARIES[kind].format(argument),
        deterministic=True,
        alarm="flag" if kind == "flag" else "column",
        columns=(name,),
        adapts="baseline",
        horizon_decides_fit=False,
    )


def _make(kind: str, sign: int, size: bool, *, baseline: int = 0) -> Detector:
    del baseline  # Episodes come whole, as they were recorded. Listing detectors needs no numpy.
    column: Detector = import_module(f"{__name__}.detector").RecordedColumn(kind, sign, size)
    return column
