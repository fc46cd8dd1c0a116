"""Facts of registered environments: what recording has to know of them beside their specs."""

import functools
import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from oodd_eval.data.facts import ANOMALIES, ENVIRONMENTS, EnvironmentInfo, in_order
from oodd_eval.data.registry import (
    AnomalySpec,
    EnvironmentSpec,
    Spec,
    anomaly_spec,
    environment_spec,
    file_of,
    functions_of,
    inner_of,
    long_name,
    registered,
)
from oodd_eval.errors import UsageError


class Measured(NamedTuple):
    """The spread of each sensor in nominal rows, and the numbers of the sensors that may break."""

    spread: tuple[float, ...]
    sensors: tuple[int, ...]


_infos: Final[dict[str, tuple[EnvironmentSpec, EnvironmentInfo]]] = {}
MEASURED: Final[dict[str, Measured]] = {}
"""Spreads and sensors of environments by name; those of custom ones are measured at recording."""


def info_of(environment: str) -> EnvironmentInfo:
    """Return the facts of an environment.

    The first call makes a custom environment once, to see its spaces. `UsageError` when they are
    not as `EnvironmentSpec` says.
    """
    if environment in ENVIRONMENTS:
        return ENVIRONMENTS[environment]
    spec = environment_spec(environment)
    if environment in _infos and _infos[environment][0] is not spec:  # another of the same name
        del _infos[environment]
        MEASURED.pop(environment, None)
    if environment not in _infos:
        _infos[environment] = spec, _inspected(spec)
    return _infos[environment][1]


def kinds_of(environment: str) -> list[str]:
    """Return the kinds of anomalies that can be recorded in an environment at any strength."""
    discrete, attributes = info_of(environment).discrete, environment_spec(environment).attributes
    names = {environment, long_name(environment_spec(environment))}
    kinds = [
        spec.name
        for spec in registered()
        if isinstance(spec, AnomalySpec)
        and (not spec.environments or names & {*spec.environments})
        and {*spec.needs, *(spec.needs_discrete if discrete else ())} <= attributes.keys()
    ]
    return in_order(kinds, ANOMALIES)


def code_digest(environment: str, kinds: Iterable[str]) -> str:
    """Return the SHA-256 of the packages that custom specs name; empty without any.

    A package counts as a whole, with its data; of a module that is in none its file does.
    Arguments of a ``functools.partial`` count, too. The environment's ladder does not: a split
    names its strengths.
    """
    spec = environment_spec(environment)
    specs: list[Spec] = [spec, *map(anomaly_spec, kinds)]
    functions = [f for spec in specs for f in functions_of(spec) if not _of_benchmark(f)]
    arguments = [repr((f.args, f.keywords)) for f in functions if isinstance(f, functools.partial)]
    files: dict[str, Path] = {}
    for code in dict.fromkeys(file_of(inner_of(f)) for f in functions):
        files |= _package_of(Path(code))
    digests = [
        (name, hashlib.sha256(file.read_bytes()).hexdigest())
        for name, file in sorted(files.items())
        if not _is_ladder(file, spec)
    ]
    return hashlib.sha256(repr((digests, arguments)).encode()).hexdigest() if files else ""


def _package_of(file: Path) -> dict[str, Path]:
    """Return the files of the outermost package that a file is in, by name, or the file alone."""
    # Hidden ones and caches are left out.
    package = file
    while (package.parent / "__init__.py").exists():
        package = package.parent
    names = {p.relative_to(package.parent): p for p in (package, *package.rglob("*"))}
    return {
        name.as_posix(): path
        for name, path in names.items()
        if path.is_file() and not any(p[0] == "." or p == "__pycache__" for p in name.parts)
    }


def _is_ladder(file: Path, spec: EnvironmentSpec) -> bool:
    """Tell whether a file is the environment's ladder, or what a calibration has measured."""
    ladder = spec.ladder
    # A spec may name its ladder only once the calibration has ended.
    return file.suffix == ".work" or (
        ladder is not None and file.parent == ladder.parent and file.name.startswith(ladder.name)
    )


def packages_of(environments: Iterable[str]) -> list[str]:
    """Return the distributions that simulate some environments, each once."""
    specs = map(environment_spec, environments)
    return list(dict.fromkeys(package for spec in specs for package in spec.packages))


def _of_benchmark(function: Callable[..., Any]) -> bool:
    return getattr(inner_of(function), "__module__", "").partition(".")[0] == __package__


def _inspected(spec: EnvironmentSpec) -> EnvironmentInfo:
    """Look at the spaces of an environment."""
    env = spec.make()
    rows, actions = env.observation_space, env.action_space
    env.close()
    discrete = hasattr(actions, "n") and hasattr(actions, "start")
    widths = (getattr(rows, "shape", None), (int(actions.n),) if discrete else actions.shape)
    expected = (len(spec.sensors),), (len(spec.actions),)
    finite = discrete or bool(np.isfinite([actions.low, actions.high]).all())
    if widths != expected or not finite or (discrete and actions.start != 0):
        raise UsageError(
            f"environment {spec.name!r} has observations {rows} and actions {actions}, expected a "
            f"Box of shape {expected[0]} as it names {len(spec.sensors)} sensors, and Discrete("
            f"{len(spec.actions)}) or a Box of shape {expected[1]} with finite ends as it names "
            f"{len(spec.actions)} actions"
        )
    title, columns = spec.title or spec.name, (spec.sensors, spec.actions)
    limits = () if discrete else (tuple(actions.low.tolist()), tuple(actions.high.tolist()))
    low, high = limits or ((), ())
    return EnvironmentInfo(
        spec.name,
        title,
        spec.name,
        "custom",
        discrete,
        *columns,
        spec.episode_cap,
        low=low,
        high=high,
    )
