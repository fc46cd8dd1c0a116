"""From a name on the command line to a class, importing no more than the name says."""

from __future__ import annotations

import importlib
import inspect
import io
import json
import math
import re
import sys
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from oodd_eval.errors import UnknownNameError, UsageError

PLACES: Final = ("covariance", "ensemble", "linear_model", "mixture", "neighbors", "svm")
"""Parts of scikit-learn whose classes need no path: those that hold its outlier detectors."""

_DEFINITION: Final = re.compile(r"^class (\w+)\([^)]*Detector[^)]*\):", re.MULTILINE)


def pyod_class(name: str) -> type:
    """Return a detector class of ``pyod.models`` by its bare name.

    Only the module that defines it is imported: others need libraries of their own. Raises
    `UnknownNameError` when there is no such class, and `UsageError` for one that does not compute
    what it is named after.
    """
    places: dict[str, str] = {}
    directory = _directory("pyod.models")
    for file in sorted(directory.glob("*.py")) if directory else []:
        if not file.stem.startswith("base"):
            for defined in _DEFINITION.findall(file.read_text(encoding="utf-8")):
                places.setdefault(defined, file.stem)
    if name not in places:
        raise UnknownNameError("detector of PyOD", name, places)
    if reason := _NOT_ITSELF.get(name):
        raise UsageError(f"'pyod:{name}' {reason}")
    with redirect_stdout(io.StringIO()):  # some print that torch is missing, and then raise
        module = importlib.import_module(f"pyod.models.{places[name]}")
    if bars := sys.modules.get("tqdm"):
        bars.tqdm.monitor_interval = 0  # its thread outlives a fit, which cannot be forked then
    outlier_class = getattr(module, name)
    return _class(outlier_class, f"pyod:{name}", "fit", "decision_function")


_NOT_ITSELF: Final = {
    "AnoGAN": "is not offered: up to PyOD 3.6.7 its decision_function searches no latent vector of "
    "a row, and compares all rows with one and the same generated row; pyod:AutoEncoder and "
    "pyod:VAE reconstruct each row"
}
"""Classes of PyOD whose scores are not those of the method in their names."""


def sklearn_class(name: str) -> tuple[str, type]:
    """Return an outlier detector or density estimator of scikit-learn, after its shortest name.

    The name is ``IsolationForest``, or with the path to it, ``ensemble.IsolationForest``. Raises
    `UsageError` when there is no such class, or it is something else.
    """
    modules = [importlib.import_module(f"sklearn.{module}") for module in PLACES]
    known = {n: c for m in modules for n in m.__all__ if _judges(c := getattr(m, n))}
    if name in known:
        return name, known[name]
    short = name.rpartition(".")[2]
    if short == name and not any(hasattr(m, name) for m in modules):
        raise UnknownNameError("outlier detector of scikit-learn", name, known)
    candidate: Any = None if short == name else imported(f"sklearn.{name}", f"sklearn:{name}")
    if not _judges(candidate):
        raise UsageError(
            f"'sklearn:{name}' is neither an outlier detector nor a density estimator; those of "
            f"scikit-learn are {', '.join(sorted(known))}"
        )
    return short if known.get(short) is candidate else name, candidate


def river_factory(name: str) -> tuple[str, Callable[..., Any]]:
    """Return what makes a detector of river, after its shortest name.

    The name is that of a class of ``river.anomaly``, or the path to a class or function of one's
    own that returns a detector or a pipeline which ends with one.

    Raises
    ------
    UsageError
        When it is none, or one that gives no scores of rows.
    """
    anomaly, drift = (importlib.import_module(f"river.{part}") for part in ("anomaly", "drift"))
    known = {n: c for n in anomaly.__all__ if n not in _NO_SCORES and (c := getattr(anomaly, n))}
    short = name.rpartition(".")[2]
    spec = f"river:{name}"
    if (reason := _NO_SCORES.get(short)) and name in (short, f"river.anomaly.{short}"):
        raise UsageError(f"{spec!r} {reason}")
    if short in drift.__all__ and name in (short, f"drift.{short}", f"river.drift.{short}"):
        raise UsageError(
            f"{spec!r} answers yes or no about a stream of one number and then begins anew: it has "
            "no score of a row, and no threshold that nominal episodes could calibrate. Name a "
            "detector that scores rows; its guaranteed alarm watches its scores for a change"
        )
    if name in known:
        return name, known[name]
    if short == name:
        raise UnknownNameError("anomaly detector of river", name, known)
    factory = imported(name, spec)
    routine = inspect.isroutine(factory)
    if not routine and not all(hasattr(factory, m) for m in ("learn_one", "score_one")):
        raise UsageError(
            f"{spec!r} is {factory!r:.60}, expected a class or a function that returns an anomaly "
            "detector of river, or a pipeline that ends with one"
        )
    return short if known.get(short) is factory else name, factory


_NO_SCORES: Final = {
    "QuantileFilter": "is a threshold around an anomaly detector: name the detector itself; the "
    "guaranteed alarm has a threshold of its own",
    "ThresholdFilter": "is a threshold around an anomaly detector: name the detector itself; the "
    "guaranteed alarm has a threshold of its own",
    "PredictiveAnomalyDetection": "learns from what it scores: its threshold follows the episode "
    "that it is to judge; name forecast:MODULE.CLASS for the error of a forecaster",
}
"""Classes of ``river.anomaly`` that cannot score an episode without remembering it, or at all."""


def imported(path: str, spec: str) -> Any:
    """Return the object that a dotted path ``module.name`` leads to.

    Raises `UsageError`, naming the detector, when the path cannot be one, its module does not exist
    or needs a module that does not, and `UnknownNameError` when the module has no such name.
    """
    module_name, _, name = path.rpartition(".")
    if not module_name or not all(part.isidentifier() for part in path.split(".")):
        raise UsageError(
            f"{spec!r} names no class: expected a module and a class in it, such as "
            "forecast:sklearn.linear_model.Ridge"
        )
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name and f"{module_name}.".startswith(f"{error.name}."):
            raise _no_module(error.name, spec) from None
        raise UsageError(
            f"{spec!r} cannot be imported: {module_name} needs the module {error.name!r}, which is "
            "not installed"
        ) from None
    if not hasattr(module, name):
        public = [n for n, v in vars(module).items() if inspect.isclass(v) and n[0] != "_"]
        raise UnknownNameError(f"class of {module_name}", name, public)
    return getattr(module, name)


def forecaster_class(path: str) -> type:
    """Return a class with `fit` and `predict`, by its dotted path.

    Raises `UsageError` when there is none; of scikit-learn's classes, when it is not a regressor.
    """
    spec = f"forecast:{path}"
    forecaster = _class(imported(path, spec), spec, "fit", "predict")
    if path.startswith("sklearn."):
        from sklearn.base import RegressorMixin  # noqa: PLC0415  an optional extra

        if not issubclass(forecaster, RegressorMixin):
            raise UsageError(
                f"{spec!r} is not a regressor: a forecaster predicts numbers, such as "
                "forecast:sklearn.linear_model.Ridge"
            )
    return forecaster


@dataclass(frozen=True, slots=True)
class Signature:
    """Parameters of a class's constructor.

    Attributes
    ----------
    plain
        Parameters whose default is a plain value, with the default.
    required
        Parameters without a default.
    others
        All further names that it takes; None if it takes any.
    """

    plain: Mapping[str, Any]
    required: tuple[str, ...]
    others: tuple[str, ...] | None

    @classmethod
    def of(cls, factory: Callable[..., Any]) -> Signature:
        """Read the signature of a class, or of a function that makes objects."""
        every = inspect.signature(factory).parameters.values()
        anything = any(p.kind is p.VAR_KEYWORD for p in every)
        named = [p for p in every if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
        required = tuple(p.name for p in named if p.default is p.empty)
        defaults = {p.name: p.default for p in named if p.default is not p.empty}
        plain = {name: value for name, value in defaults.items() if _is_plain(value)}
        others = tuple(name for name in defaults if name not in plain)
        return cls(plain, required, None if anything else others)

    def __contains__(self, name: str) -> bool:
        """Return True if it names this parameter; those that ``**`` would take do not count."""
        return name in (*self.plain, *self.required, *(self.others or ()))

    def check(self, values: Mapping[str, Any], spec: str) -> None:
        """Raise `UsageError` unless the class can be made of these parameters."""
        for name in values:
            if self.others is not None and name not in self:
                raise UnknownNameError(
                    f"parameter of {spec}", name, [*self.plain, *self.required, *self.others]
                )
        if missing := [name for name in self.required if name not in values]:
            raise UsageError(
                f"{spec} needs a value for {', '.join(missing)}: give it as --param {missing[0]}=…"
            )


def _is_plain(value: object) -> bool:
    """Return True if JSON gives the value back as it is."""
    if isinstance(value, float) and not math.isfinite(value):
        return False
    try:
        return bool(json.loads(json.dumps(value)) == value)
    except (TypeError, ValueError):
        return False


def _judges(candidate: object) -> bool:
    """Return True for a class of scikit-learn that scores how nominal a row is."""
    from sklearn.base import DensityMixin, OutlierMixin  # noqa: PLC0415  an optional extra
    from sklearn.neighbors import KernelDensity  # noqa: PLC0415  which lacks the mixin

    return (
        inspect.isclass(candidate)
        and issubclass(candidate, DensityMixin | OutlierMixin | KernelDensity)
        and hasattr(candidate, "score_samples")
    )


def _class(candidate: Any, spec: str, *methods: str) -> type:
    if inspect.isclass(candidate) and all(callable(getattr(candidate, m, None)) for m in methods):
        return candidate
    raise UsageError(
        f"{spec!r} is {candidate!r:.60}, expected a class with the methods {' and '.join(methods)}"
    )


def _no_module(name: str, spec: str) -> UsageError:
    parent, _, last = name.rpartition(".")
    if parent and (directory := _directory(parent)):
        there = [p.stem for p in directory.iterdir() if p.stem[0] not in "_."]
        return UnknownNameError(f"module of {parent}", last, there)
    return UsageError(
        f"{spec!r} cannot be imported: there is no module {name!r}; install what holds it, or call "
        "`python -m oodd_eval` in the directory of your own module"
    )


def _directory(module: str) -> Path | None:
    """Return where the modules of a package are; None for a module that is none."""
    spec = find_spec(module)
    places = spec.submodule_search_locations if spec else None
    return Path(next(iter(places))) if places else None
