"""Numbers with marks between thousands: ``1,013.5``, ``1.013,5``, ``1'013`` and ``1 013``.

Those of Fortran, ``1.5D+03``, and in percent are numbers, too.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np

from oodd_logs.kinds import Kind
from oodd_logs.recording import Column

MARKS: Final = (".", ",", "'", " ")
"""Marks between thousands; other blanks and apostrophes count as these."""

_BLANKS: Final = str.maketrans({"\u00a0": " ", "\u202f": " ", "\u2009": " ", "\u2019": "'"})
_GROUPED: Final = {
    mark: re.compile(rf"[+-]?\d{{1,3}}(?:{re.escape(mark)}\d{{3}})+(?:([.,])\d+)?(?:[eE][+-]?\d+)?")
    for mark in MARKS
}
_OTHER: Final = re.compile(
    r"([+-]?\d*\.?\d+|[+-]?\d+\.)(?:[dD]([+-]?\d{1,3})| ?%)"
)  # 1.5D+03, 45 %
_SINGLE: Final = 1000  # a number without a mark is below


def without_marks(text: str, mark: str, decimal: str = ".") -> str:
    """Return a number without marks between its thousands; what is no such number as it is.

    Decimals stand behind `decimal` then.

    >>> without_marks("1.013,5", "."), without_marks("12.5", ".")
    ('1013.5', '12.5')
    """
    plain = text.strip().translate(_BLANKS)
    match = _GROUPED[mark].fullmatch(plain)
    if match is None or match[1] == mark:
        return text
    return re.sub("[.,]", decimal, plain.replace(mark, ""))


def _read(texts: Sequence[str]) -> Mapping[str, float]:
    """Return the numbers of texts whose marks stand for nothing else."""
    numbers = {}
    for text in texts:
        plain = text.strip().translate(_BLANKS)
        if match := _OTHER.fullmatch(plain):
            numbers[text] = float(f"{match[1]}e{match[2] or 0}")
        for mark in MARKS:
            match = _GROUPED[mark].fullmatch(plain)
            sure = mark in "' " or plain.count(mark) > 1 or (match and match[1])
            if match and sure and match[1] != mark:
                numbers[text] = float(without_marks(text, mark))
    return numbers


def has_thousands(cells: Iterable[str], mark: str, decimal: str = "") -> bool | None:
    """Tell whether points, or commas, in a column of numbers stand between thousands.

    Parameters
    ----------
    cells
        All cells of the column.
    mark
        The point or comma.
    decimal
        What stands before decimals in the file; empty where that is open.

    Returns
    -------
    bool or None
        None where either may be so.

    Examples
    --------
    >>> has_thousands(["999", "1.013", "1.020"], "."), has_thousands(["999", "1.5"], ".")
    (True, False)
    >>> has_thousands(["2", "1.234"], "."), has_thousands(["2,5", "1.234"], ".")
    (None, True)
    """
    values = {cell.strip().lstrip("+-") for cell in cells}
    marked = {cell for cell in values if mark in cell and cell[0].isdigit()}
    matches = [_GROUPED[mark].fullmatch(cell) for cell in marked if cell[0] != "0"]
    if not matches or len(matches) < len(marked) or any(m is None or m[1] == mark for m in matches):
        return False
    other = "," if mark == "." else "."
    if decimal == other or any(other in cell or cell.count(mark) > 1 for cell in values):
        return True
    single = [float(cell) for cell in values - marked if cell.isdigit()]
    if not single or max(single) >= _SINGLE:
        return False
    # Decimals that are written as short as may be end in no 0; others have a mark in all cells.
    shortened = any(cell.endswith("0") for cell in marked)
    largest = max(float(cell.replace(mark, ".")) for cell in marked)
    return True if shortened or np.median(single) > 10 * largest else None


def may_have_thousands(column: Column) -> bool:
    """Tell whether numbers with a point may be thousands: whole ones, and some with three decimals.

    It is quick; `has_thousands` looks at the texts.
    """
    present = column[np.isfinite(column)]
    whole = present == np.floor(present)
    if whole.all() or not (np.abs(present[whole]) < _SINGLE).all():
        return False
    thousandths = present[~whole] * _SINGLE
    return bool((np.abs(thousandths - np.round(thousandths)) < 1e-6).all())


KIND: Final = Kind("number-marks", "", read=_read)
