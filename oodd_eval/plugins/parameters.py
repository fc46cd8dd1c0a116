"""A detector's parameters: one frozen dataclass says names, types, defaults, bounds and effects.

The same class serves the detector's spec, its factory, ``--param`` and the conformance checks.
"""

import copy
import dataclasses
import functools
import types
import typing
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from oodd_eval.errors import UnknownNameError, UsageError
from oodd_eval.names import check_known

Decides = Literal["fit", "scores", "nothing"]
Declared = TypeVar("Declared")


def parameter(
    default: Any,
    *,
    low: float | None = None,
    above: float | None = None,
    high: float | None = None,
    choices: tuple[Any, ...] = (),
    decides: Decides = "fit",
    help: str = "",  # noqa: A002  click's word, too
) -> Any:
    """Declare one parameter in a frozen dataclass of parameters.

    Values are at least `low`, more than `above`, at most `high`, and among the `choices`, where
    there are any; where all choices are texts, numbers are bounded alone. In a ``list[float]`` that
    holds for each value, and there has to be one.

    `decides` is ``"fit"`` for what changes the fitted detector, ``"scores"`` for what changes the
    scores of the same fit, so that fits are shared over its values, and ``"nothing"`` for what
    changes neither, such as the device that computes: that is no part of a result's identity.
    """
    bounds = {"low": low, "above": above, "high": high}
    facts = bounds | {"choices": choices, "decides": decides, "help": help}
    # Dataclasses refuse defaults that all instances would share and could change.
    if isinstance(default, list | dict):
        copies = functools.partial(copy.deepcopy, default)
        return dataclasses.field(default_factory=copies, metadata=facts)
    return dataclasses.field(default=default, metadata=facts)


@dataclass(frozen=True, slots=True)
class ParameterInfo:
    """One parameter of a detector, see `parameter`; `items` are the types of a list's values."""

    types: tuple[type, ...]
    items: tuple[type, ...]
    default: Any
    low: float | None = None
    above: float | None = None
    high: float | None = None
    choices: tuple[Any, ...] = ()
    decides: Decides = "fit"
    help: str = ""

    def problem(self, value: Any) -> str:
        """Return what is wrong with a value, such as ``"expected an int"``; empty if nothing is."""
        if list not in self.types or type(value) not in (list, tuple):
            return self._wrong(value, self.types)
        if self.items and not value:
            return "expected at least one value"
        wrong = (self._wrong(item, self.items) for item in value if self.items)
        return next(filter(None, wrong), "")

    def _wrong(self, value: Any, expected: tuple[type, ...]) -> str:
        # bool is an int to isinstance, and an int is as good as a float.
        plain = type(value) in expected or (float in expected and type(value) is int)
        if not plain and object not in expected:
            return f"expected {' or '.join(_TYPE_NAMES.get(t, t.__name__) for t in expected)}"
        named = isinstance(value, str) or not all(isinstance(c, str) for c in self.choices)
        if self.choices and named and value not in self.choices:
            others = [_TYPE_NAMES[kind] for kind in (int, float) if kind in expected]
            texts = ", ".join(map(repr, self.choices))
            return f"expected one of {' or '.join([texts, *others])}"
        if value is None or isinstance(value, str):
            return ""
        # Written so that NaN is refused, too.
        if self.low is not None and not value >= self.low:
            return f"expected at least {self.low:g}"
        if self.above is not None and not value > self.above:
            return f"expected more than {self.above:g}"
        return "" if self.high is None or value <= self.high else f"expected at most {self.high:g}"


_TYPE_NAMES = {int: "a whole number", float: "a number", str: "a text", bool: "true or false"}
_TYPE_NAMES |= {types.NoneType: "null", list: "a list"}


def parameters_of(declared: type | None) -> dict[str, ParameterInfo]:
    """Return the parameters that a dataclass declares, by name; none for None."""
    if declared is None:
        return {}
    hints, infos = typing.get_type_hints(declared), {}
    for f in dataclasses.fields(declared):
        hint = hints[f.name]
        within = typing.get_args(hint) if typing.get_origin(hint) is list else ()
        items = tuple(t for part in within for t in _types_of(part))
        default = f.default if f.default_factory is dataclasses.MISSING else f.default_factory()
        infos[f.name] = ParameterInfo(_types_of(hint), items, default, **f.metadata)
    return infos


def _types_of(hint: Any) -> tuple[type, ...]:
    """Return the plain types of an annotation; ``object`` and ``Any`` allow every value."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return tuple(t for part in inner for t in _types_of(part))
    if origin is Literal:
        return tuple(dict.fromkeys(type(value) for value in inner))
    return (object,) if hint is Any else (origin or hint,)


def checked(declared: type[Declared], detector: str, values: Mapping[str, Any]) -> Declared:
    """Return what `resolve_parameters` returns as an instance of the dataclass: for factories."""
    return declared(**resolve_parameters(detector, declared, values))


def resolve_parameters(
    detector: str, declared: type | None, values: Mapping[str, Any], *, others: bool = False
) -> dict[str, Any]:
    """Return a detector's parameters with defaults filled in, sorted by name.

    Raises `UsageError` for a wrong value, or a name not declared, unless it takes `others`.
    """
    parameters = parameters_of(declared)
    for name, value in values.items():
        if name not in parameters and not others:
            raise UnknownNameError(f"parameter of {detector}", name, parameters)
        if name in parameters and (problem := parameters[name].problem(value)):
            raise UsageError(f"parameter {name!r} of {detector} is {value!r}, {problem}")
    return dict(sorted({**{n: p.default for n, p in parameters.items()}, **values}.items()))


def parameters_by_detector(
    detectors: Collection[str], values: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Return the parameters of each detector, of values that may be for one alone.

    A value under ``NAME`` is for all. One under ``DETECTOR.NAME``, or in a mapping under
    ``DETECTOR``, is for that detector, and wins there. Raises `UnknownNameError` for a detector
    that is not among them.

    Examples
    --------
    >>> parameters_by_detector(["pe", "rf"], {"seed": 1, "rf.trees": 5, "pe": {"width": 8}})
    {'pe': {'seed': 1, 'width': 8}, 'rf': {'seed': 1, 'trees': 5}}
    """
    shared: dict[str, Any] = {}
    alone: dict[str, dict[str, Any]] = {name: {} for name in detectors}
    for key, value in values.items():
        detector, dot, name = key.rpartition(".")
        if dot:
            check_known("detector", alone, detector)
            alone[detector][name] = value
        elif key in alone and isinstance(value, Mapping):
            alone[key] |= value
        else:
            shared[key] = value
    return {name: shared | of_one for name, of_one in alone.items()}


def declared_by(defaults: Mapping[str, Any], base: type = object) -> type:
    """Return a dataclass of parameters for defaults that are known at run time only.

    Values have to be of the default's kind: a number, a text or a truth value. Where the default is
    something else, such as None, any value will do. Parameters of `base` come first.
    """
    kinds = {bool: bool, str: str, int: float, float: float}
    fields = []
    for name, value in defaults.items():
        kind = next((k for t, k in kinds.items() if isinstance(value, t)), object)
        fields.append((name, kind, parameter(value)))
    return dataclasses.make_dataclass("Parameters", fields, bases=(base,), frozen=True)
