"""An evaluation harness for detectors of out-of-distribution dynamics.

The names below are all that a plug-in or a script needs. They are imported when first used, so
that ``oodd-eval --help`` and the listing of plug-ins stay quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from oodd_eval._version import __version__

if TYPE_CHECKING:
    from oodd_eval.api import evaluate, load_results
    from oodd_eval.data.facts import Quantity
    from oodd_eval.data.registry import AnomalySpec, Attribute, EnvironmentSpec, Fault
    from oodd_eval.data.split import load_split
    from oodd_eval.data.trajectory import Trajectory
    from oodd_eval.plugins import hookimpl
    from oodd_eval.plugins.contract import Detector, DetectorSpec
    from oodd_eval.plugins.explanations import Explanation, Naming

__all__ = [
    "AnomalySpec",
    "Attribute",
    "Detector",
    "DetectorSpec",
    "EnvironmentSpec",
    "Explanation",
    "Fault",
    "Naming",
    "Quantity",
    "Trajectory",
    "__version__",
    "calibrate",
    "check_detector",
    "evaluate",
    "hookimpl",
    "import_frames",
    "intervene",
    "live",
    "load_results",
    "load_split",
]

_NAMES = {
    "api": ("evaluate", "load_results"),
    "data.facts": ("Quantity",),
    "data.registry": ("AnomalySpec", "Attribute", "EnvironmentSpec", "Fault"),
    "data.split": ("load_split",),
    "data.trajectory": ("Trajectory",),
    "plugins": ("hookimpl",),
    "plugins.contract": ("Detector", "DetectorSpec"),
    "plugins.explanations": ("Explanation", "Naming"),
}
_HOMES = {name: f"{__name__}.{home}" for home, names in _NAMES.items() for name in names}
# Known by name alone: nothing here imports these packages.
_HOMES |= {
    "calibrate": "oodd_monitors",
    "check_detector": "oodd_checks",
    "import_frames": "oodd_logs",
    "intervene": "oodd_interventions",
}
_MODULES = {"live": "oodd_live"}


def __getattr__(name: str) -> Any:
    if name not in _HOMES | _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value: Any = import_module(_HOMES.get(name) or _MODULES[name])
    value = getattr(value, name) if name in _HOMES else value
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
