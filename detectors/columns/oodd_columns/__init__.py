"""Recorded columns as detectors: the plug-in `columns`."""

import re
from functools import partial
from importlib import import_module

from oodd_eval import Detector, DetectorSpec, hookimpl
from oodd_eval.errors import UsageError
from oodd_eval.names import COLUMN_NAME

_KINDS = {"column": "{} as recorded", "mean": "mean of {} so far", "flag": "where {} is not 0"}
_NAMED = re.compile(r"(-?)(?:\|(N)\||abs\((N)\)|(N))".replace("N", COLUMN_NAME), re.ASCII)


@hookimpl
def oodd_detector_from_spec(spec: str) -> DetectorSpec | None:
    """column:NAME, mean:NAME, flag:NAME: a recorded score, its running mean, a recorded alarm.

    Raises
    ------
    UsageError
        When the text behind the colon is no name of a column, perhaps with a sign.
    """
    kind, _, text = spec.partition(":")
    if kind not in _KINDS:
        return None
    match = _NAMED.fullmatch(text)
    if not match or (kind == "flag" and text != match[4]):
        signs = "NAME" if kind == "flag" else "NAME, -NAME or abs(NAME)"
        raise UsageError(
            f"{spec!r:.200} names no column: expected {kind}:{signs} of letters, digits, blanks "
            'and any of -_+./%()[]; import the logs with such a name, as in scores = ["new = old"]'
        )
    name = match[2] or match[3] or match[4]
    argument = match[1] + (name if match[4] else f"abs({name})")
    return DetectorSpec(
        name=f"{kind}:{argument}",
        factory=partial(_make, kind, -1 if match[1] else 1, not match[4]),
        summary=_KINDS[kind].format(argument),
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
