"""Check every field of a `DetectorSpec` that a plug-in offers: its type, and its alphabet."""

import re
from dataclasses import fields, is_dataclass
from typing import Any, Final

from oodd_eval.errors import PluginError
from oodd_eval.names import PARAMETER_NAME, SPEC_NAME
from oodd_eval.plugins.contract import DetectorSpec

_TEXT: Final = "a printable line of at most 1000 characters"


def check_detector_spec(spec: DetectorSpec) -> None:
    """Raise `PluginError` for the first field that is wrong."""
    for name, expected, fits in (
        (
            "name",
            "lower-case letters, digits and '-', at most 64, perhaps ':' and a name",
            _matches(SPEC_NAME, spec.name),
        ),
        ("factory", "a function or class", callable(spec.factory)),
        *(
            (name, _TEXT, _is_line(getattr(spec, name)))
            for name in ("summary", "reference", "extra", "fit_name")
        ),
        (
            "inputs",
            "observations or observations+actions",
            spec.inputs in ("observations", "observations+actions"),
        ),
        ("alarm", "cusum or score", spec.alarm in ("cusum", "score")),
        *(
            (name, "True or False", isinstance(getattr(spec, name), bool))
            for name in ("deterministic", "other_parameters", "horizon_decides_fit")
        ),
        (
            "requires",
            "names of modules",
            isinstance(spec.requires, tuple | list) and all(map(_is_line, spec.requires)),
        ),
        ("version", "a version such as 1.2", _matches("[A-Za-z0-9.+!_-]{0,64}", spec.version)),
        (
            "parameters",
            "a dataclass with fields of ASCII names, or None",
            _declares(spec.parameters),
        ),
    ):
        if not fits:
            given = getattr(spec, name)
            raise PluginError(f"{name} of a DetectorSpec is {given!r:.80}, expected {expected}")


def _matches(pattern: str, value: object) -> bool:
    return isinstance(value, str) and bool(re.fullmatch(pattern, value, re.ASCII))


def _is_line(value: object) -> bool:
    return isinstance(value, str) and len(value) <= 1000 and value.isprintable()


def _declares(parameters: Any) -> bool:
    if parameters is None:
        return True
    found = isinstance(parameters, type) and is_dataclass(parameters)
    return found and all(_matches(PARAMETER_NAME, f.name) for f in fields(parameters))
