"""Policies of plain layers, in NumPy: what ``oodd-eval policies import`` makes of an ONNX file.

A policy file has an array ``steps`` of numbers of operations, in their order, and arrays ``a0``,
``b0``, ``a1``, … with the operands of each.
"""

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Numbers are kept for ever: files have them.
OPERATIONS: Final[Mapping[int, tuple[str, Callable[[Floats, Floats, Floats], Any]]]] = {
    0: ("affine", lambda x, a, b: x @ a + b),
    1: ("scale", lambda x, a, b: x * a + b),
    2: ("relu", lambda x, *_: np.maximum(x, 0)),
    3: ("tanh", lambda x, _, __: np.tanh(x)),
    4: ("sigmoid", lambda x, *_: np.exp(-np.logaddexp(0, -x))),  # no number overflows
    5: ("elu", lambda x, a, _: np.where(x > 0, x, a * np.expm1(np.minimum(x, 0)))),
    6: ("leaky-relu", lambda x, a, _: np.where(x > 0, x, a * x)),
    7: ("clip", np.clip),
    8: ("softplus", lambda x, *_: np.logaddexp(0, x)),
    9: ("silu", lambda x, *_: x * np.exp(-np.logaddexp(0, -x))),
    10: ("part", lambda x, a, b: np.split(x, int(b))[int(a)]),  # of b parts of equal width
}
"""Name and function of each operation, of a row and its two operands."""

NUMBERS: Final = {name: number for number, (name, _) in OPERATIONS.items()}


def names_of(arrays: Mapping[str, Any]) -> list[str]:
    """Return the names of the arrays of a policy file, in order."""
    count = len(np.atleast_1d(arrays["steps"]))
    return ["steps", *(f"{operand}{i}" for i in range(count) for operand in "ab")]


class Layers:
    """The forward pass, in float64.

    Raises `ValueError` where arrays are not those of a policy, or do not fit one another.
    """

    def __init__(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        steps = np.atleast_1d(arrays["steps"])
        if steps.ndim != 1 or not len(steps) or not set(steps.tolist()) <= OPERATIONS.keys():
            raise ValueError(f"steps are {steps!r:.100}, expected numbers from 0 to 10")
        operands = {n: np.asarray(arrays[n], np.float64) for n in names_of(arrays) if n != "steps"}
        self._steps = [
            (OPERATIONS[int(number)][1], operands[f"a{i}"], operands[f"b{i}"])
            for i, number in enumerate(steps)
        ]
        if bad := [n for n, x in operands.items() if np.isnan(x).any()]:
            raise ValueError(f"{', '.join(bad)} hold NaN, expected numbers")
        affine = [operands[f"a{i}"] for i, number in enumerate(steps) if number == 0]
        if not affine or any(a.ndim != 2 for a in affine):
            raise ValueError("expected a layer with a matrix of weights")
        width = affine[0].shape[0]
        self.widths = width, len(self(np.zeros(width)))

    def __call__(self, row: NDArray[Any]) -> Floats:
        """Return the outputs for an observation row of shape (D,)."""
        x = row.astype(np.float64)
        for operation, a, b in self._steps:
            x = np.asarray(operation(x, a, b))
        return x
