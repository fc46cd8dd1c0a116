"""Acts: what takes over from the policy at an alarm, and what it knows then."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from oodd_common.naming import ReadingModel
from oodd_recording.policies import Policy

from oodd_eval import Naming
from oodd_eval.data.facts import Group

Row = NDArray[np.float32]


@dataclass(slots=True)
class Situation:
    """An episode from the row of an alarm on. Rows, actions and naming are kept current.

    Attributes
    ----------
    environment, policy
        Name, and the policy that has acted until now, with the memory that it has.
    rows : float32 array of shape (t + 1, D)
        Observations as the sensors reported them; the last one is the latest, at first the
        alarm's row.
    actions : float32 array of shape (t, A)
        Commands between them, as trajectories have them: one-hot where they are discrete.
    naming
        The parts that are at fault. It is replaced when the watchdog names them again.
    onset
        The row with which the fault began, as far as is known.
    model
        How readings follow from the ones before them in nominal operation.
    """

    environment: str
    policy: Policy
    rows: NDArray[np.float32]
    actions: NDArray[np.float32]
    naming: Naming
    onset: int
    model: ReadingModel


class Act(Protocol):
    """What commands the environment from the row of an alarm on."""

    def act(self, row: Row) -> Any:
        """Return the command for the next observation row.

        Parameters
        ----------
        row : float32 array of shape (D,)
            As the sensors report it; the first one is the alarm's row.

        Returns
        -------
        int or float32 array of shape (A,)
            As a policy of the environment returns it.
        """


@dataclass(frozen=True, slots=True)
class ActSpec:
    """One act that a plug-in offers.

    Parameters
    ----------
    name
        Lower-case letters, digits and hyphens. Several specs may share a name, for environments
        of their own: ``stop`` is another act for a drone than for a robot.
    make
        Called as ``make(situation)`` at the row of an alarm; returns an `Act`.
    summary
        One line: what happens.
    groups
        Groups of anomalies that it suits: ``"sensor"``, ``"dynamics"`` or both.
    environments
        Names of the environments that it is for; empty for all.
    """

    name: str
    make: Callable[[Situation], Act]
    summary: str
    groups: tuple[Group, ...]
    environments: tuple[str, ...] = ()
