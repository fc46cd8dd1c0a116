"""Specs of detectors made from a class: name, parameters, version, and what is missing."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from importlib.metadata import version
from importlib.util import find_spec
from typing import Any, ClassVar, Final

from oodd_adapters.detectors import (
    AdapterParameters,
    ForecastDetector,
    OnlineDetector,
    OutlierDetector,
)
from oodd_adapters.names import (
    Signature,
    forecaster_class,
    pyod_class,
    river_factory,
    sklearn_class,
)
from oodd_eval import Detector, DetectorSpec
from oodd_eval.plugins.parameters import checked, declared_by
from oodd_eval.scoring.plan import source_digest

_WINDOW_PARAMETERS = frozenset(f.name for f in fields(AdapterParameters))

_PYOD: Final = {"verbose": 0, "device": "cpu"}
"""Values for classes of PyOD with other defaults: they draw bars, and take a GPU where one is."""


def pyod(name: str) -> DetectorSpec:
    """Return the spec of a detector of PyOD: its `decision_function` on windows."""
    summary = f"PyOD's {name} on a window of observations"
    if not _present("pyod"):
        return _absent(f"pyod:{name}", summary, "pyod", "oodd-eval[pyod]")
    try:
        library_class = pyod_class(name)
    except ModuleNotFoundError as error:
        return _absent(f"pyod:{name}", summary, str(error.name), "")
    plain = Signature.of(library_class).plain
    decided = {n: v for n, v in _PYOD.items() if plain.get(n, v) != v}
    recipe = _Recipe(library_class, f"pyod:{name}", ("decision_function", 1), decided)
    return recipe.spec(summary, f"pyod.{version('pyod')}")


def sklearn(name: str) -> DetectorSpec:
    """Return the spec of an outlier detector of scikit-learn: minus its `score_samples`."""
    if not _present("sklearn"):
        summary = f"scikit-learn's {name} on a window of observations"
        return _absent(f"sklearn:{name}", summary, "sklearn", "oodd-eval[reference]")
    name, library_class = sklearn_class(name)
    recipe = _Recipe(library_class, f"sklearn:{name}", outlier=("score_samples", -1))
    if "novelty" in recipe.signature:
        # Without it the class judges its training rows and no others.
        recipe = _Recipe(library_class, recipe.name, recipe.outlier, {"novelty": True})
    summary = f"scikit-learn's {name} on a window of observations"
    return recipe.spec(summary, _sklearn_version())


def river(name: str) -> DetectorSpec:
    """Return the spec of an online detector of river: its `score_one`, after training."""
    if not _present("river"):
        summary = f"river's {name} on a window of observations, learning in training alone"
        return _absent(f"river:{name}", summary, "river", "oodd-eval[river]")
    name, factory = river_factory(name)
    top = name.partition(".")[0]
    label = f"river.{version('river')}"
    if top != name:  # a user's own code: its digest tells when it changes
        label = f"{label}.{top}.{source_digest(top)[:12]}"
    summary = f"river's {name} on a window of observations, learning in training alone"
    return _OnlineRecipe(factory, f"river:{name}", outlier=None).spec(summary, label)


def forecast(path: str) -> DetectorSpec:
    """Return the spec of a forecaster: the error of its `predict`, fed with windows."""
    name = f"forecast:{path}"
    summary = f"error of forecasts by {path.rpartition('.')[2]} from a window of observations"
    top = path.partition(".")[0]
    if top == "sklearn" and not _present(top):
        return _absent(name, summary, top, "oodd-eval[reference]")
    library_class = forecaster_class(path)
    # Code of one's own changes without a new version; its digest tells.
    label = _sklearn_version() if top == "sklearn" else f"{top}.{source_digest(top)[:12]}"
    return _Recipe(library_class, name, outlier=None).spec(summary, label)


@dataclass(frozen=True)
class _Recipe:
    """Make detectors of a class: the factory of a spec.

    Attributes
    ----------
    library_class
        The class, or a function that makes objects.
    name
        Of the detector.
    outlier
        For outlier detectors of rows, the method that scores and its sign; None for others.
    fixed
        Parameters of the class that are not the user's to choose.
    """

    library_class: Callable[..., Any]
    name: str
    outlier: tuple[str, int] | None
    fixed: Mapping[str, Any] = field(default_factory=dict)
    seed_name: ClassVar[str] = "random_state"
    """Parameter of the class that is the seed."""
    decided: ClassVar[frozenset[str]] = frozenset({"random_state"})
    """Parameters of the class that the adapter decides."""

    @property
    def signature(self) -> Signature:
        """Return the parameters of the class's constructor."""
        return Signature.of(self.library_class)

    def spec(self, summary: str, label: str) -> DetectorSpec:
        """Return the spec; the label says which version of which library does the work."""
        signature = self.signature
        hidden = {*self.fixed, *_WINDOW_PARAMETERS, *self.decided}
        plain = {n: v for n, v in signature.plain.items() if n not in hidden}
        return DetectorSpec(
            name=self.name,
            factory=self,
            summary=summary,
            reference=f"{self.library_class.__module__}.{self.library_class.__qualname__}",
            parameters=declared_by(plain, AdapterParameters),
            other_parameters=bool(signature.required or signature.others is None),
            version=label,
        )

    def __call__(self, *, seed: int = 0, horizon: int = 1, **parameters: Any) -> Detector:
        """Return an unfitted detector, as the harness asks for it."""
        signature = self.signature
        window_parameters = {n: parameters.pop(n) for n in _WINDOW_PARAMETERS & parameters.keys()}
        arguments = {**parameters, **self.fixed}
        if self.seed_name in signature:
            arguments.setdefault(self.seed_name, seed)
        signature.check(arguments, self.name)
        make: Callable[..., Any] = lambda **more: self.library_class(**arguments, **more)  # noqa: E731
        windows = checked(AdapterParameters, self.name, window_parameters)
        return self._detector(make, windows, seed, horizon)

    def _detector(
        self, make: Callable[..., Any], windows: AdapterParameters, seed: int, horizon: int
    ) -> Detector:
        """Return the detector that feeds the objects that `make` returns."""
        if self.outlier is None:
            return ForecastDetector(self.name, make, windows, seed=seed, horizon=horizon)
        method, sign = self.outlier
        return OutlierDetector(
            self.name, make, windows, seed=seed, horizon=horizon, method=method, sign=sign
        )


class _OnlineRecipe(_Recipe):
    """Make detectors of what learns and scores one row at a time."""

    seed_name: ClassVar[str] = "seed"
    decided: ClassVar[frozenset[str]] = frozenset({"seed", "limits"})

    def _detector(
        self, make: Callable[..., Any], windows: AdapterParameters, seed: int, horizon: int
    ) -> Detector:
        base = importlib.import_module("river.base")
        kind = self.library_class
        return OnlineDetector(
            self.name,
            make,
            windows,
            seed=seed,
            horizon=horizon,
            limits="limits" in self.signature,
            one_variable=inspect.isclass(kind) and issubclass(kind, base.SupervisedAnomalyDetector),
        )


def _present(module: str) -> bool:
    return find_spec(module) is not None


def _sklearn_version() -> str:
    return f"scikit-learn.{version('scikit-learn')}"


def _absent(name: str, summary: str, module: str, extra: str) -> DetectorSpec:
    """Return the spec of a detector that cannot run here, and so cannot be looked at either."""
    return DetectorSpec(
        name=name,
        factory=_cannot_run,
        summary=summary,
        parameters=AdapterParameters,
        other_parameters=True,
        requires=(module,),
        extra=extra,
    )


def _cannot_run(**_: Any) -> Detector:
    raise ModuleNotFoundError("a module that this detector needs is not installed")
