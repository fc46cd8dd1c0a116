"""Training and evaluation of nominal policies (extra ``train``).

`train_policy` trains one policy resumably and freezes the best actor; `evaluate_policy` gives mean
and standard deviation of the return over fresh episodes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.data.simulate.policies import FROZEN, Policy, freeze_policy, load_policy
from oodd_eval.data.simulate.record import record_nominal
from oodd_eval.errors import MissingExtraError, PolicyError, UnknownNameError

EVALUATION_SEED: Final = 900_000_000
"""First seed of evaluation episodes: outside every split (bases times a million) and training."""

SELECTION_SEED: Final = 910_000_000
"""First seed of the episodes by which a trainer picks its best actor."""

DEFAULT_STEPS: Final = {
    "acrobot": 60_000, "cartpole": 60_000, "lunarlander": 400_000, "ant": 1_000_000,
    "halfcheetah": 1_500_000, "hopper": 1_000_000, "walker2d": 1_000_000,
}  # fmt: skip

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Returns of a policy over nominal episodes: array of shape (episodes,)."""

    returns: NDArray[np.float64]

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(self.returns.mean())

    @property
    def std(self) -> float:
        """Standard deviation of the return, ddof 0."""
        return float(self.returns.std())


def evaluate_policy(
    environment: str, policy: Policy, *, episodes: int = 100, seed: int = EVALUATION_SEED
) -> Evaluation:
    """Run nominal episodes, a fresh simulator each, seeds ``seed + i``."""
    returns = [
        float(record_nominal(environment, seed + i, policy=policy).rewards.sum(dtype=np.float64))
        for i in range(episodes)
    ]
    return Evaluation(np.array(returns))


def train_policy(
    environment: str,
    *,
    out: Path,
    steps: int | None = None,
    seed: int = 1,
    progress: Progress | None = None,
) -> Path:
    """Train a policy with the algorithm the benchmark names for the environment.

    Resumes from ``out/<environment>.ckpt`` when it is there. Writes checkpoint and, whenever the
    evaluation improves, ``out/<environment>.npz`` with its provenance; `out` is not the place of
    frozen policies, see `freeze_trained`.

    Parameters
    ----------
    environment
        Name in `oodd_eval.data.facts.ENVIRONMENTS`.
    out
        Directory for checkpoint, best policy and provenance.
    steps
        Environment steps in all, those of earlier runs included.
    seed
        Seed of networks, exploration and environment.
    progress
        Called with one line per evaluation.

    Returns
    -------
    Path of the best policy so far.
    """
    if environment not in ENVIRONMENTS:
        raise UnknownNameError("environment", environment, ENVIRONMENTS)
    try:
        from oodd_eval.data.simulate.train import (
            iqn,  # noqa: PLC0415  # torch is slow to import
            td3,  # noqa: PLC0415  # torch is slow to import
        )
    except ImportError as error:
        raise MissingExtraError(
            f"training needs torch ({error}): pip install 'oodd-eval[train]'"
        ) from error
    trainer = td3.train if ENVIRONMENTS[environment].policy == "TD3" else iqn.train
    total = DEFAULT_STEPS[environment] if steps is None else steps
    out.mkdir(parents=True, exist_ok=True)
    trainer(environment, out=out, steps=total, seed=seed, progress=progress or (lambda _: None))
    best = out / f"{environment}.npz"
    if not best.exists():
        raise PolicyError(
            f"{total} steps gave no evaluation of {environment}: train for more steps"
        )
    return best


def freeze_trained(
    environment: str, trained: Path, *, episodes: int = 100, directory: Path = FROZEN
) -> Evaluation:
    """Evaluate a trained policy over fresh episodes and freeze it with provenance.

    The policy is marked unfinished below 95 % of the paper's return (see `share_of_paper`), and
    flagged below 80 %.
    """
    import json  # noqa: PLC0415  # only here

    policy = load_policy(environment, trained)
    evaluation = evaluate_policy(environment, policy, episodes=episodes)
    facts: dict[str, Any] = json.loads(trained.with_suffix(".json").read_text(encoding="utf-8"))
    share = share_of_paper(environment, evaluation.mean)
    facts |= {
        "mean_return": evaluation.mean,
        "std_return": evaluation.std,
        "episodes": episodes,
        "evaluation": f"fresh simulator each, seeds {EVALUATION_SEED} and following, float64 "
        "forward pass, actions rounded to 2^-16",
        "paper_return": ENVIRONMENTS[environment].paper_return,
        "share_of_paper": share,
        "finished": share >= 0.95,
        "flagged": share < 0.8,
    }
    with np.load(trained, allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    freeze_policy(environment, arrays, facts, directory)
    return evaluation


def share_of_paper(environment: str, mean: float) -> float:
    """Return a mean return as a share of the paper's.

    Acrobot's return is negative, a count of steps: there the share is paper / mean, and the target
    of -85 of the protocol lies at 0.926; it is scaled so that -85 gives 0.95.
    """
    paper = ENVIRONMENTS[environment].paper_return
    if paper < 0:
        return 0.95 * -85.0 / mean if mean < 0 else 1.0
    return mean / paper
