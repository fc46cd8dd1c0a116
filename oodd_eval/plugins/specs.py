"""Specs of detectors as plain data: exact types, bounded, checked, and of nobody's classes.

A plug-in's spec may be of a class of its own, and so may each text in it. What the harness keeps is
a copy; in a sandbox the copy comes over a pipe, and nothing else of the plug-in does.
"""

import functools
import math
import operator
import re
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, make_dataclass
from typing import Any, Final, get_args

from oodd_eval.errors import PluginError
from oodd_eval.names import PARAMETER_NAME, SPEC_NAME
from oodd_eval.plugins.contract import Alarm, Detector, DetectorSpec, Training
from oodd_eval.plugins.parameters import Decides, ParameterInfo, parameter, parameters_of

MOST_SPECS: Final = 1000  # that one hook may return
_MOST_PARAMETERS: Final = 256
_MOST_CHOICES: Final = 256
_DEEPEST: Final = 8  # lists within lists of a default
_LONGEST_LINE: Final = 1000  # characters
_LONGEST_TEXT: Final = 10_000  # characters of a default

Description = dict[str, Any]
"""A spec as values that JSON knows, without its factory."""

_TYPES: Final[dict[str, type]] = {
    t.__name__: t for t in (bool, int, float, str, list, tuple, dict, types.NoneType, object)
}


def plain_spec(spec: object) -> DetectorSpec:
    """Return a copy of a plug-in's spec in plain types; raise `PluginError` for what is none."""
    if type(spec) is not DetectorSpec:
        raise PluginError(f"{spec!r:.80} is offered, expected a oodd_eval.DetectorSpec")
    return spec_of(description_of(spec), spec.factory)


def description_of(spec: DetectorSpec) -> Description:
    """Return a spec as plain values; raise `PluginError` where a field is none."""
    check_detector_spec(spec)
    values = {name: getattr(spec, name) for names, *_ in _FIELDS for name in names.split()}
    del values["factory"]
    values["requires"] = [*spec.requires]
    if spec.parameters is not None:
        declared = parameters_of(spec.parameters)
        if len(declared) > _MOST_PARAMETERS:
            raise PluginError(f"{len(declared)} parameters, expected at most {_MOST_PARAMETERS}")
        values["parameters"] = {name: _description_of(name, p) for name, p in declared.items()}
    return values


def spec_of(description: Mapping[str, Any], factory: Callable[..., Detector]) -> DetectorSpec:
    """Return the spec that `description_of` described, perhaps elsewhere, checked again.

    Raises `PluginError`, or what Python raises for values of another form.
    """
    values = {**description, "requires": tuple(description["requires"])}
    if (declared := description["parameters"]) is not None:
        if len(declared) > _MOST_PARAMETERS:
            raise PluginError(f"{len(declared)} parameters, expected at most {_MOST_PARAMETERS}")
        columns = [_field(name, facts) for name, facts in declared.items()]
        values["parameters"] = make_dataclass("Parameters", columns, frozen=True)
    spec = DetectorSpec(factory=factory, **values)
    check_detector_spec(spec)
    return spec


def check_detector_spec(spec: DetectorSpec) -> None:
    """Raise `PluginError` for the first field of a spec whose type or alphabet is wrong."""
    for names, expected, fits in _FIELDS:
        for name in names.split():
            if not fits(value := getattr(spec, name)):
                raise PluginError(f"{name} of a DetectorSpec is {value!r:.80}, expected {expected}")


def _description_of(name: str, info: ParameterInfo) -> Description:
    """Return a parameter as plain values."""
    return {
        "types": _type_names(info.types),
        "items": _type_names(info.items),
        "default": _plain(name, info.default),
        "low": info.low,
        "above": info.above,
        "high": info.high,
        "choices": _plain(name, info.choices),
        "decides": info.decides,
        "help": info.help,
    }


def _field(name: str, facts: Mapping[str, Any]) -> tuple[str, Any, Any]:
    """Return a field of a dataclass of parameters, which `parameters_of` reads."""
    default = _plain(name, facts["default"])
    bounds = {bound: facts[bound] for bound in ("low", "above", "high")}
    lists = facts["items"], facts["choices"]
    for fits, expected in (
        (_text(PARAMETER_NAME)(name) and not name.startswith("__"), "an ASCII name"),
        (all(map(_is_bound, bounds.values())), "finite numbers, or None, as bounds"),
        (all(type(values) is list and len(values) <= _MOST_CHOICES for values in lists), "lists"),
        (_one_of(*get_args(Decides))(facts["decides"]), f"one of {get_args(Decides)} as decides"),
        (is_line(facts["help"]), "a printable line as help"),
    ):
        if not fits:
            raise PluginError(f"parameter {name!r:.80} is {facts!r:.200}, expected {expected}")
    hint = _annotation(facts["types"])
    if facts["types"] == ["list"] and facts["items"]:
        hint = types.GenericAlias(list, (_annotation(facts["items"]),))
    choices = tuple(_plain(name, choice) for choice in facts["choices"])
    more = {"decides": facts["decides"], "help": facts["help"], "choices": choices}
    return name, hint, parameter(default, **bounds, **more)


def _annotation(names: Sequence[str]) -> Any:
    """Return the annotation of a field whose values are of one of some types."""
    return functools.reduce(operator.or_, [_TYPES[name] for name in names])


def _type_names(kinds: tuple[type, ...]) -> list[str]:
    """Return the names of plain types; any other type allows every value."""
    known = {kind: name for name, kind in _TYPES.items()}
    return [known.get(kind, "object") for kind in kinds]


def _plain(name: str, value: Any, depth: int = 0) -> Any:
    """Return a value that JSON knows, with lists for tuples; raise `PluginError` for others."""
    kind = type(value)
    if kind in (types.NoneType, bool, int, float) or (kind is str and len(value) <= _LONGEST_TEXT):
        return value
    if depth < _DEEPEST:
        if kind in (list, tuple) and len(value) <= _LONGEST_TEXT:
            return [_plain(name, one, depth + 1) for one in value]
        if kind is dict and all(type(key) is str for key in value):
            return {key: _plain(name, one, depth + 1) for key, one in value.items()}
    raise PluginError(f"parameter {name!r:.80} has {value!r:.80}, expected a value that JSON knows")


def _is_bound(value: object) -> bool:
    return value is None or type(value) is int or (type(value) is float and math.isfinite(value))


def _text(pattern: str) -> Callable[[object], bool]:
    """Return a function that tells whether a value is a text of a pattern."""
    return lambda value: type(value) is str and bool(re.fullmatch(pattern, value, re.ASCII))


def _one_of(*texts: str) -> Callable[[object], bool]:
    return lambda value: type(value) is str and value in texts


def is_line(value: object) -> bool:
    """Tell whether a value is one printable line, not too long."""
    return type(value) is str and len(value) <= _LONGEST_LINE and value.isprintable()


def _are_lines(value: object) -> bool:
    return (
        isinstance(value, tuple | list)
        and type(value) in (tuple, list)
        and all(map(is_line, value))
    )


def _is_truth(value: object) -> bool:
    return type(value) is bool


def _declares(parameters: Any) -> bool:
    if parameters is None:
        return True
    declares = isinstance(parameters, type) and is_dataclass(parameters)
    return declares and all(_text(PARAMETER_NAME)(f.name) for f in fields(parameters))


_INPUTS: Final = ("observations", "observations+actions")
_FIELDS: Final[tuple[tuple[str, str, Callable[[Any], bool]], ...]] = (
    (
        "name",
        "lower-case letters, digits, '-', at most 64, perhaps ':' and a name",
        _text(SPEC_NAME),
    ),
    ("factory", "a function or class", callable),
    ("summary reference extra fit_name", "a printable line of at most 1000 characters", is_line),
    ("inputs", " or ".join(_INPUTS), _one_of(*_INPUTS)),
    ("training", " or ".join(get_args(Training)), _one_of(*get_args(Training))),
    ("alarm", " or ".join(get_args(Alarm)), _one_of(*get_args(Alarm))),
    ("adapts", "'' or baseline", _one_of("", "baseline")),
    ("deterministic other_parameters horizon_decides_fit", "True or False", _is_truth),
    ("requires", "names of modules", _are_lines),
    ("version", "a version such as 1.2", _text("[A-Za-z0-9.+!_-]{0,64}")),
    ("parameters", "a dataclass with fields of ASCII names, or None", _declares),
)
"""Fields of a spec, what is expected of them, and whether a value is."""
