"""An evaluation harness for detectors of out-of-distribution dynamics.

The names below are all that a plug-in or a script needs. They are imported when first used, so
that ``oodd-eval --help`` and the listing of plug-ins stay quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from oodd_eval._version import __version__

if TYPE_CHECKING:
    from oodd_eval.api import evaluate, load_results
    from oodd_eval.data.facts import Quantity
    from oodd_eval.data.importing import import_frames
    from oodd_eval.data.logs import Reader
    from oodd_eval.data.recording import Recording, Topic
    from oodd_eval.data.registry import AnomalySpec, Attribute, EnvironmentSpec, Fault
    from oodd_eval.data.split import load_split
    from oodd_eval.data.trajectory import Trajectory
    from oodd_eval.live.scan import scan_episodes
    from oodd_eval.plugins import hookimpl
    from oodd_eval.plugins.contract import Detector, DetectorSpec
    from oodd_eval.plugins.explanations import Explanation
    from oodd_eval.testing import check_detector

__all__ = [
    "AnomalySpec",
    "Attribute",
    "Detector",
    "DetectorSpec",
    "EnvironmentSpec",
    "Explanation",
    "Fault",
    "Quantity",
    "Reader",
    "Recording",
    "Topic",
    "Trajectory",
    "__version__",
    "check_detector",
    "evaluate",
    "hookimpl",
    "import_frames",
    "load_results",
    "load_split",
    "scan_episodes",
]

_NAMES = {
    "api": ("evaluate", "load_results"),
    "data.facts": ("Quantity",),
    "data.importing": ("import_frames",),
    "data.logs": ("Reader",),
    "data.recording": ("Recording", "Topic"),
    "data.registry": ("AnomalySpec", "Attribute", "EnvironmentSpec", "Fault"),
    "data.split": ("load_split",),
    "data.trajectory": ("Trajectory",),
    "live.scan": ("scan_episodes",),
    "plugins": ("hookimpl",),
    "plugins.contract": ("Detector", "DetectorSpec"),
    "plugins.explanations": ("Explanation",),
    "testing": ("check_detector",),
}
_HOMES = {name: home for home, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
