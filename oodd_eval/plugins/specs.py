"""Specs of detectors as plain data: exact types, bounded, checked, and of nobody's classes.

A plug-in's spec may be of a class of its own, and so may each text in it. What the harness keeps is
a copy.
"""

import ast
import functools
import inspect
import math
import operator
import re
import sys
import types
from collections.abc import Callable, Mapping, Sequence, Sized
from dataclasses import fields, is_dataclass, make_dataclass, replace
from typing import Any, Final, get_args

from oodd_eval.errors import PluginError
from oodd_eval.names import PARAMETER_NAME, SPEC_NAME
from oodd_eval.plugins.contract import Alarm, DetectorSpec, Training
from oodd_eval.plugins.parameters import Decides, ParameterInfo, parameter, parameters_of

MOST_SPECS: Final = 1000  # that one hook may return
_MOST_PARAMETERS: Final = 256
_MOST_CHOICES: Final = 256
_DEEPEST: Final = 8  # lists within lists of a default
_LONGEST_LINE: Final = 1000  # characters
_LONGEST_TEXT: Final = 10_000  # characters of a default

PLAIN_TYPES: Final = (bool, int, float, str, list, tuple, dict, types.NoneType, object)
"""Types of the values of parameters."""


def reads_actions(factory: Callable[..., object]) -> bool:
    """Tell whether the module that a factory is of reads actions of episodes.

    A detector whose spec does not declare actions is given episodes without any: rows of width 0.

    Parameters
    ----------
    factory
        A detector's class, or a function that returns one.

    Returns
    -------
    bool
        Whether an attribute ``actions`` is read of anything but ``self``; False where there is no
        source.
    """
    try:
        source = inspect.getsource(sys.modules[factory.__module__])
    except (OSError, TypeError, KeyError, AttributeError):
        return False
    reads = (n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.Attribute))
    return any(n.attr == "actions" and ast.unparse(n.value) != "self" for n in reads)


def plain_spec(spec: object) -> DetectorSpec:
    """Return a copy of a plug-in's spec in plain types; raise `PluginError` for what is none."""
    if type(spec) is not DetectorSpec:
        raise PluginError(f"{spec!r:.80} is offered, expected a oodd_eval.DetectorSpec")
    check_detector_spec(spec)
    of_class = spec.parameters
    declared = None if of_class is None else declared_as(parameters_of(of_class))
    requires, columns = tuple(spec.requires), tuple(spec.columns)
    return replace(spec, requires=requires, columns=columns, parameters=declared)


def declared_as(infos: Mapping[str, ParameterInfo]) -> type:
    """Return a dataclass that declares these parameters, in plain types, as `parameters_of` reads.

    Raises `PluginError` where one is none.
    """
    check_count(infos)
    columns = [_field(name, info) for name, info in infos.items()]
    return make_dataclass("Parameters", columns, frozen=True)


def check_count(parameters: Sized) -> None:
    """Raise `PluginError` for more parameters than a detector can have."""
    if len(parameters) > _MOST_PARAMETERS:
        raise PluginError(f"{len(parameters)} parameters, expected at most {_MOST_PARAMETERS}")


def check_detector_spec(spec: DetectorSpec) -> None:
    """Raise `PluginError` for the first field of a spec whose type or alphabet is wrong."""
    for names, expected, fits in FIELDS:
        for name in names.split():
            if not fits(value := getattr(spec, name)):
                raise PluginError(f"{name} of a DetectorSpec is {value!r:.80}, expected {expected}")


def _field(name: str, info: ParameterInfo) -> tuple[str, Any, Any]:
    """Return a field of a dataclass of parameters, which `parameters_of` reads."""
    bounds = {bound: getattr(info, bound) for bound in ("low", "above", "high")}
    default, choices = _plain(name, info.default), _plain(name, info.choices)
    for fits, expected in (
        (_text(PARAMETER_NAME)(name) and not name.startswith("__"), "an ASCII name"),
        (all(map(_is_bound, bounds.values())), "finite numbers, or None, as bounds"),
        (max(len(info.items), len(choices)) <= _MOST_CHOICES, f"at most {_MOST_CHOICES} choices"),
        (_one_of(*get_args(Decides))(info.decides), f"one of {get_args(Decides)} as decides"),
        (is_line(info.help), "a printable line as help"),
    ):
        if not fits:
            raise PluginError(f"parameter {name!r:.80} is {info!r:.200}, expected {expected}")
    hint = _annotation(info.types)
    if info.types == (list,) and info.items:
        hint = types.GenericAlias(list, (_annotation(info.items),))
    declared = parameter(
        default, **bounds, choices=tuple(choices), decides=info.decides, help=info.help
    )
    return name, hint, declared


def _annotation(kinds: Sequence[type]) -> Any:
    """Return the annotation of a field of some types; one that is not plain allows every value."""
    return functools.reduce(operator.or_, [t if t in PLAIN_TYPES else object for t in kinds])


def _plain(name: str, value: Any, depth: int = 0) -> Any:
    """Return a value that JSON knows, with lists for tuples; raise `PluginError` for others."""
    kind = type(value)
    if kind in (types.NoneType, bool, int, float) or (kind is str and len(value) <= _LONGEST_TEXT):
        return value
    if depth < _DEEPEST:
        if kind in (list, tuple) and len(value) <= _LONGEST_TEXT:
            return [_plain(name, nested, depth + 1) for nested in value]
        if kind is dict and all(type(key) is str for key in value):
            return {key: _plain(name, nested, depth + 1) for key, nested in value.items()}
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


def _are_lines(value: Any) -> bool:
    return type(value) in (tuple, list) and all(map(is_line, value))


def _is_truth(value: object) -> bool:
    return type(value) is bool


def _declares(parameters: Any) -> bool:
    if parameters is None:
        return True
    declares = isinstance(parameters, type) and is_dataclass(parameters)
    return declares and all(_text(PARAMETER_NAME)(f.name) for f in fields(parameters))


_INPUTS: Final = ("observations", "observations+actions")
FIELDS: Final[tuple[tuple[str, str, Callable[[Any], bool]], ...]] = (
    (
        "name",
        "lower-case letters, digits, '-', at most 64, perhaps ':' and a name",
        _text(SPEC_NAME),
    ),
    ("factory", "a function or class", callable),
    ("summary reference extra fit_name", "a printable line of at most 1000 characters", is_line),
    ("inputs", " or ".join(_INPUTS), _one_of(*_INPUTS)),
    ("with_actions", "the name of a detector, or ''", _text(f"({SPEC_NAME})?")),
    ("training", " or ".join(get_args(Training)), _one_of(*get_args(Training))),
    ("alarm", " or ".join(get_args(Alarm)), _one_of(*get_args(Alarm))),
    ("adapts", "'' or baseline", _one_of("", "baseline")),
    ("deterministic other_parameters horizon_decides_fit roles", "True or False", _is_truth),
    ("requires columns", "names, of modules or columns", _are_lines),
    ("seconds", "a number, 0 or more", lambda n: type(n) in (int, float) and 0 <= n < math.inf),
    ("version", "a version such as 1.2", _text("[A-Za-z0-9.+!_-]{0,64}")),
    ("parameters", "a dataclass with fields of ASCII names, or None", _declares),
)
"""Fields of a spec, what is expected of them, and whether a value is."""
