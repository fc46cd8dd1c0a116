"""Training of one policy: resumable, with checkpoint, learning curve and the best actor so far."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from oodd_eval.data.files import replacing, write_text
from oodd_eval.errors import MissingExtraError, PolicyError
from oodd_recording.closed_loop import evaluate_policy
from oodd_recording.policies import load_policy
from oodd_recording.registered import info_of
from oodd_recording.train.freeze import freeze_policy

if TYPE_CHECKING:
    from oodd_recording.train import iqn, td3  # need torch

SELECTION_SEED: Final = 910_000_000
"""First seed of the episodes by which a training picks its best actor."""

SELECTION_EPISODES: Final = 100

DEFAULT_STEPS: Final = {
    "acrobot": 60_000,
    "cartpole": 60_000,
    "lunarlander": 400_000,
    "ant": 1_000_000,
    "halfcheetah": 1_500_000,
    "hopper": 1_000_000,
    "walker2d": 1_000_000,
}

OTHER_STEPS: Final = 200_000  # of an environment of one's own

Progress = Callable[[str], None]


Learner: TypeAlias = "td3.TD3 | iqn.IQN"
"""An algorithm that trains a policy of one environment."""


def train_policy(
    environment: str,
    *,
    out: Path,
    steps: int | None = None,
    seed: int = 1,
    progress: Progress = lambda _line: None,
) -> Path:
    """Train a policy with the environment's algorithm; return the path of the best so far.

    Resumes from ``out/<environment>.ckpt`` when it is there. Writes checkpoint and, whenever the
    evaluation improves, ``out/<environment>.npz`` with its provenance. `steps` are environment
    steps in all, those of earlier runs included; `progress` is called with one line per
    evaluation.
    """
    algorithm = info_of(environment).policy
    total = DEFAULT_STEPS.get(environment, OTHER_STEPS) if steps is None else steps
    learner = _make_learner(environment, algorithm, seed)
    facts = {"algorithm": algorithm, "hyper_parameters": learner.hyper_parameters, "seed": seed}
    journal = _Journal(environment, out, facts, progress)
    start = journal.resume(learner)
    for step in learner.run(seed, start, total):
        journal.evaluate(step, learner)
    best = out / f"{environment}.npz"
    if not best.exists():
        raise PolicyError(
            f"{total} steps gave no evaluation of {environment}: train for more steps"
        )
    return best


def _make_learner(environment: str, algorithm: str, seed: int) -> Learner:
    try:
        import torch  # noqa: PLC0415  slow to import

        from oodd_recording.train import iqn, td3  # noqa: PLC0415  need torch
    except ImportError as error:
        raise MissingExtraError(
            f"training needs torch ({error}): pip install 'oodd-eval[train]'"
        ) from error
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    return td3.TD3(environment) if algorithm == "TD3" else iqn.IQN(environment)


class _Journal:
    """Curve, best actor and checkpoint of one training, all in one directory."""

    # The best actor is the one whose worst return over a hundred selection episodes, the same for
    # every candidate, is largest: a policy that sometimes falls makes a poor nominal one, and one
    # start in fifty that falls shows neither in forty episodes nor in their mean.

    def __init__(
        self, environment: str, out: Path, facts: dict[str, Any], progress: Progress
    ) -> None:
        self.environment, self.out, self.facts, self.progress = environment, out, facts, progress
        self.curve: list[list[float]] = []
        self.best = -np.inf
        self._started = time.perf_counter()
        self._first_step = 0
        self.checkpoint = out / f"{environment}.ckpt"

    def resume(self, learner: Learner) -> int:
        """Load the state of an earlier run, if there is one; return its step, or 0."""
        import torch  # noqa: PLC0415  slow to import

        if not self.checkpoint.exists():
            return 0
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
        learner.load(state)
        self.progress(f"{self.environment}: resumed at step {self._first_step}")
        return self._first_step

    def evaluate(self, step: int, learner: Learner) -> None:
        """Evaluate an actor, keep it if it is the best so far, and store the checkpoint."""
        import torch  # noqa: PLC0415  slow to import

        candidate, arrays = self.out / "candidate", learner.arrays()
        freeze_policy(self.environment, arrays, {}, candidate)
        policy = load_policy(self.environment, candidate / f"{self.environment}.npz")
        returns = evaluate_policy(
            self.environment, policy, episodes=SELECTION_EPISODES, seed=SELECTION_SEED
        )
        mean, deviation = float(returns.mean()), float(returns.std())
        self.curve.append([step, mean, deviation])
        low = float(returns.min())
        if low > self.best:
            self.best = low
            facts = self.facts | {"steps": step, "curve": self.curve}
            facts["selection"] = (
                f"largest worst return over {SELECTION_EPISODES} episodes, "
                f"seeds {SELECTION_SEED} and following"
            )
            freeze_policy(self.environment, arrays, facts, self.out)
        state = learner.state() | {"step": step, "best": float(self.best), "curve": self.curve}
        with replacing(self.checkpoint) as partial:
            torch.save(state, partial)
        log = json.dumps({"environment": self.environment, **self.facts, "curve": self.curve})
        write_text(self.out / f"{self.environment}.curve.json", log + "\n")
        rate = (step - self._first_step) / (time.perf_counter() - self._started)
        self.progress(
            f"{self.environment}: step {step}, return {mean:.1f} ± {deviation:.1f}, "
            f"worst {low:.1f}, {rate:.0f} steps/s"
        )
