"""A detector's parameters: one frozen dataclass says names, types, defaults, bounds and effects.

The same class serves the detector's spec, its factory, ``--param`` and the conformance checks.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from oodd_eval.errors import UnknownNameError, UsageError

Decides = Literal["fit", "scores", "nothing"]


def parameter(
    default: Any,
    *,
    low: float | None = None,
    high: float | None = None,
    choices: tuple[Any, ...] = (),
    decides: Decides = "fit",
    help: str = "",  # noqa: A002  argparse's word
) -> Any:
    """Declare one parameter in a frozen dataclass of parameters.

    Parameters
    ----------
    default
        Value when nothing is given.
    low, high
        Smallest and largest value allowed.
    choices
        The values allowed, where there are only a few.
    decides
        ``"fit"``: it changes the fitted detector. ``"scores"``: it changes scores of the same fit,
        so that fits are shared over its values. ``"nothing"``: it changes neither, such as the
        device that computes; then it is no part of a result's identity.
    help
        One line.
    """
    facts = {"low": low, "high": high, "choices": choices, "decides": decides, "help": help}
    return dataclasses.field(default=default, metadata=facts)


@dataclass(frozen=True, slots=True)
class ParameterInfo:
    """One parameter of a detector, see `parameter`."""

    name: str
    types: tuple[type, ...]
    default: Any
    low: float | None = None
    high: float | None = None
    choices: tuple[Any, ...] = ()
    decides: Decides = "fit"
    help: str = ""

    def problem(self, value: Any) -> str:
        """Return what is wrong with a value, such as ``"expected an int"``; empty if nothing is."""
        # bool is an int to isinstance, and an int is as good as a float.
        plain = type(value) in self.types or (float in self.types and type(value) is int)
        if not plain:
            return f"expected {' or '.join(_TYPE_NAMES.get(t, t.__name__) for t in self.types)}"
        if self.choices and value not in self.choices:
            return f"expected one of {', '.join(map(repr, self.choices))}"
        # Written so that NaN is refused, too.
        if self.low is not None and value is not None and not value >= self.low:
            return f"expected at least {self.low:g}"
        if self.high is not None and value is not None and not value <= self.high:
            return f"expected at most {self.high:g}"
        return ""


_TYPE_NAMES = {
    int: "a whole number", float: "a number", str: "a text", bool: "true or false",
    types.NoneType: "null", list: "a list", tuple: "a list",
}  # fmt: skip


def parameters_of(declared: type | None) -> dict[str, ParameterInfo]:
    """Return the parameters that a dataclass declares, by name; none for None."""
    if declared is None:
        return {}
    hints = typing.get_type_hints(declared)
    return {
        f.name: ParameterInfo(f.name, _types_of(hints[f.name]), f.default, **f.metadata)
        for f in dataclasses.fields(declared)
    }


def _types_of(hint: Any) -> tuple[type, ...]:
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return tuple(t for part in typing.get_args(hint) for t in _types_of(part))
    if typing.get_origin(hint) is Literal:
        return tuple(dict.fromkeys(type(value) for value in typing.get_args(hint)))
    return (typing.get_origin(hint) or hint,)


def resolve_parameters(
    detector: str, declared: type | None, given: Mapping[str, Any], *, others: bool = False
) -> dict[str, Any]:
    """Return a detector's parameters with defaults filled in, sorted by name.

    Parameters
    ----------
    detector
        Its name, for messages.
    declared
        Its dataclass of parameters; None when it has none.
    given
        Values by name.
    others
        Whether the detector takes names that it does not declare.

    Raises
    ------
    UnknownNameError
        When `given` names a parameter that the detector does not declare.
    UsageError
        When a value has another type or lies outside of its bounds.
    """
    known = parameters_of(declared)
    for name, value in given.items():
        if name not in known:
            if others:
                continue
            raise UnknownNameError(f"parameter of {detector}", name, known)
        if problem := known[name].problem(value):
            raise UsageError(f"parameter {name!r} of {detector} is {value!r}, {problem}")
    return dict(sorted({**{n: p.default for n, p in known.items()}, **given}.items()))
