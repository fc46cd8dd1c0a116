"""What both trainers share: atomic checkpoints, the evaluation curve and the best actor."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from oodd_eval.data.simulate.policies import freeze_policy, load_policy
from oodd_eval.data.simulate.train import SELECTION_SEED, Progress, evaluate_policy
from oodd_eval.errors import PolicyError

SELECTION_EPISODES = 10


class Journal:
    """Curve, best actor and checkpoint of one training, all in one directory.

    The best actor is the one with the largest mean return minus one standard deviation over ten
    selection episodes, the same for every candidate: a policy that sometimes falls makes a poor
    nominal one.
    """

    def __init__(
        self, environment: str, out: Path, facts: dict[str, Any], progress: Progress
    ) -> None:
        self.environment, self.out, self.facts, self.progress = environment, out, facts, progress
        self.curve: list[list[float]] = []
        self.best = -np.inf
        self._started = time.perf_counter()
        self._first_step = 0

    @property
    def checkpoint(self) -> Path:
        """Where networks and optimisers are kept."""
        return self.out / f"{self.environment}.ckpt"

    def resume(self) -> dict[str, Any] | None:
        """Return the stored state of an earlier run, or None.

        Raises
        ------
        PolicyError
            When the file cannot be read as a checkpoint.
        """
        if not self.checkpoint.exists():
            return None
        try:
            state: dict[str, Any] = torch.load(self.checkpoint, weights_only=True)
            self.curve, self.best = [list(x) for x in state["curve"]], float(state["best"])
            self._first_step = int(state["step"])
        except Exception as error:
            # Without torch's own message: it recommends loading the file with pickle.
            raise PolicyError(
                f"{self.checkpoint.name} is not a checkpoint of this trainer "
                f"({type(error).__name__}), expected one that `policies train` wrote: "
                "move it away to start anew"
            ) from error
        self.progress(f"{self.environment}: resumed at step {self._first_step}")
        return state

    def evaluate(self, step: int, arrays: dict[str, NDArray[Any]], state: dict[str, Any]) -> None:
        """Evaluate an actor, keep it if it is the best so far, and store the checkpoint."""
        candidate = self.out / "candidate"
        freeze_policy(self.environment, arrays, {}, candidate)
        policy = load_policy(self.environment, candidate / f"{self.environment}.npz")
        result = evaluate_policy(
            self.environment, policy, episodes=SELECTION_EPISODES, seed=SELECTION_SEED
        )
        self.curve.append([step, result.mean, result.std])
        if result.mean - result.std > self.best:
            self.best = result.mean - result.std
            facts = self.facts | {"steps": step, "curve": self.curve}
            facts["selection"] = (
                f"largest mean - s.d. of the return over {SELECTION_EPISODES} episodes, "
                f"seeds {SELECTION_SEED} and following"
            )
            freeze_policy(self.environment, arrays, facts, self.out)
        partial = self.checkpoint.with_suffix(".ckpt.partial")
        torch.save(state | {"step": step, "best": float(self.best), "curve": self.curve}, partial)
        partial.replace(self.checkpoint)
        log = json.dumps({"environment": self.environment, **self.facts, "curve": self.curve})
        partial = self.out / f"{self.environment}.curve.json.partial"
        partial.write_text(log + "\n", encoding="utf-8")
        partial.replace(self.out / f"{self.environment}.curve.json")
        rate = (step - self._first_step) / (time.perf_counter() - self._started)
        self.progress(
            f"{self.environment}: step {step}, return {result.mean:.1f} ± {result.std:.1f}, "
            f"{rate:.0f} steps/s"
        )
