"""What an alarm saves: the closed loop goes on with an act where a watchdog alarms.

Plug-ins offer acts through the hook ``oodd_acts``, as `ActSpec` objects.
"""

from oodd_interventions.situation import Act, ActSpec, Situation

__all__ = ["Act", "ActSpec", "Situation"]
