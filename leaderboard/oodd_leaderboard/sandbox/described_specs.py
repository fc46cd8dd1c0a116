"""Specs of detectors as values that JSON knows, which come out of a sandbox over a pipe."""

from collections.abc import Callable, Mapping
from typing import Any, Final

from oodd_eval.plugins.contract import Detector, DetectorSpec
from oodd_eval.plugins.parameters import ParameterInfo, parameters_of
from oodd_eval.plugins.specs import FIELDS, PLAIN_TYPES, check_count, declared_as

Description = dict[str, Any]
"""A spec as values that JSON knows, without its factory."""

_TYPES: Final = {kind.__name__: kind for kind in PLAIN_TYPES}


def description_of(spec: DetectorSpec) -> Description:
    """Return a spec that `plain_spec` returned as values that JSON knows."""
    values = {name: getattr(spec, name) for names, *_ in FIELDS for name in names.split()}
    del values["factory"]
    values["requires"] = [*spec.requires]
    if spec.parameters is not None:
        declared = parameters_of(spec.parameters)
        values["parameters"] = {name: _described(info) for name, info in declared.items()}
    return values


def spec_of(description: Mapping[str, Any], factory: Callable[..., Detector]) -> DetectorSpec:
    """Return the spec that `description_of` described elsewhere.

    Raises `PluginError`, or what Python raises for values of another form. Its fields are checked
    as those of every plug-in's are, see `plain_spec`.
    """
    values = {**description, "requires": tuple(description["requires"])}
    if (declared := description["parameters"]) is not None:
        check_count(declared)
        infos = {name: _info(facts) for name, facts in declared.items()}
        values["parameters"] = declared_as(infos)
    return DetectorSpec(factory=factory, **values)


def _described(info: ParameterInfo) -> Description:
    values = {name: getattr(info, name) for name in ParameterInfo.__slots__}
    values |= {name: [kind.__name__ for kind in values[name]] for name in ("types", "items")}
    return values | {"choices": [*info.choices]}


def _info(facts: Mapping[str, Any]) -> ParameterInfo:
    """Return a parameter; raise what Python raises for values of another form."""
    values = dict(facts)
    for name in ("types", "items", "choices"):
        if type(values[name]) is not list:
            raise TypeError(f"{name} of a parameter is {values[name]!r:.80}, expected a list")
        values[name] = tuple(values[name])
    for name in ("types", "items"):
        values[name] = tuple(_TYPES[kind] for kind in values[name])
    return ParameterInfo(**values)
