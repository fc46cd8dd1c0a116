"""What an alarm saves: the closed loop goes on with an act where a watchdog alarms.

Plug-ins offer acts through the hook ``oodd_acts``, as `ActSpec` objects. The study's names are
imported when first used, so that plug-ins stay quick.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from oodd_interventions.situation import Act, ActSpec, Situation

if TYPE_CHECKING:
    from oodd_interventions.study import Interventions, intervene

__all__ = ["Act", "ActSpec", "Interventions", "Situation", "intervene"]


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.study"), name)
