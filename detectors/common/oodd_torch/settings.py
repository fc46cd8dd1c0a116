"""What a detector of the torch family may be told, and how its members differ."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import torch

from oodd_eval.errors import UsageError
from oodd_torch.training import Schedule

RATES: Final = (1e-2,)
"""Largest learning rates, in turn over the members: the larger of the paper's two.

With the smaller one, 0.001, the held-out loss after the same number of updates is twice as high.
"""

WIDTHS: Final = (0.2, 0.1, 0.4, 0.2, 0.3)
"""Widths of the quadratic part of the quantile loss, in turn over the members.

In standard deviations of a sensor's change. With the usual 1 nearly all errors of a good forecast
would fall into the quadratic part, and the minimizer would be an expectile instead of a quantile.
"""

TRUNKS: Final = ("shared", "per-feature")
DEVICES: Final = ("auto", "cpu", "cuda")


@dataclass(frozen=True, slots=True)
class Settings:
    """What a detector of this family may be told.

    Attributes
    ----------
    members
        Networks in the ensemble, e; they differ in seed, order of episodes, and by `WIDTHS`.
    samples
        Samples of each network, M; 1 without quantiles.
    window
        Observations in the input, W.
    recurrent, quantiles
        Whether the networks have memory, and a quantile function as their output.
    mean_sampling
        Whether each step of a rollout feeds back the mean of M samples rather than one sample.
    trunk
        ``"shared"``: one network with a head per sensor; ``"per-feature"``: a network per sensor,
        the paper's words, D times as dear.
    updates
        Gradient steps of each member, at most.
    batch, chunk
        Episodes in a batch, and steps through which gradients flow.
    levels
        Quantile levels of an update, one from each of as many equal parts of (0, 1).
    scheduled_sampling
        Share of inputs that are the network's own samples at the end of training; it rises
        linearly from 0 with the updates.
    device
        ``"cpu"``, ``"cuda"``, or ``"auto"``: cuda where there is one.
    """

    members: int = 5
    samples: int = 8
    window: int = 1
    recurrent: bool = True
    quantiles: bool = True
    mean_sampling: bool = False
    trunk: str = "shared"
    updates: int = 600
    batch: int = 16
    chunk: int = 100
    levels: int = 8
    scheduled_sampling: float = 0.0
    device: str = "cpu"

    def check(self, name: str) -> None:
        """Raise `UsageError` when a value is out of range, naming detector and parameter."""

        def wrong(field: str, expected: str) -> UsageError:
            value = getattr(self, field)
            return UsageError(
                f"parameter {field} of detector {name!r}: expected {expected}, got {value!r}"
            )

        for field in ("members", "samples", "window", "updates", "batch", "chunk", "levels"):
            value = getattr(self, field)
            if not isinstance(value, int) or isinstance(value, bool) or value < 1:
                raise wrong(field, "an integer of at least 1")
        share = self.scheduled_sampling
        if isinstance(share, bool) or not isinstance(share, int | float) or not 0 <= share <= 1:
            raise wrong("scheduled_sampling", "a number between 0 and 1")
        if self.trunk not in TRUNKS:
            raise wrong("trunk", f"one of {', '.join(TRUNKS)}")
        if self.device not in DEVICES:
            raise wrong("device", f"one of {', '.join(DEVICES)}")
        if self.device == "cuda" and not torch.cuda.is_available():
            raise wrong("device", "auto or cpu, since torch finds no CUDA device here")

    @property
    def place(self) -> str:
        """Name of the torch device."""
        if self.device != "auto":
            return self.device
        return "cuda" if torch.cuda.is_available() else "cpu"

    @property
    def architecture(self) -> dict[str, Any]:
        """Fields of `Architecture` that these settings decide."""
        return {
            "window": self.window,
            "recurrent": self.recurrent,
            "quantiles": self.quantiles,
            "per_feature": self.trunk == "per-feature",
        }

    @property
    def schedule(self) -> Schedule:
        """How training goes."""
        return Schedule(
            updates=self.updates,
            batch=self.batch,
            chunk=self.chunk,
            levels=self.levels,
            rates=tuple(RATES[i % len(RATES)] for i in range(self.members)),
            widths=tuple(WIDTHS[i % len(WIDTHS)] for i in range(self.members)),
            scheduled_sampling=float(self.scheduled_sampling),
        )
