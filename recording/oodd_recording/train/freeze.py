"""Frozen policies: weights as npz, and how they were trained and judged as JSON beside them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from oodd_eval.data.facts import ENVIRONMENTS
from oodd_eval.data.files import replacing, write_text
from oodd_recording.benchmark import FROZEN
from oodd_recording.closed_loop import EVALUATION_SEED, evaluate_policy
from oodd_recording.policies import LAYERS, Arrays, load_policy, make_policy, policy_digest
from oodd_recording.registered import info_of


def freeze_policy(
    environment: str, arrays: Arrays, facts: Mapping[str, Any], directory: Path = FROZEN
) -> str:
    """Write a policy (float32 arrays) and its provenance; return the content digest."""
    info = info_of(environment)
    packed = {
        name: np.asarray(arrays[name]).astype(np.int64 if name == "quantiles" else np.float32)
        for name in LAYERS[info.policy]
        if name in arrays
    }
    make_policy(f"{environment}.npz", info, packed)
    digest = policy_digest(packed)
    with replacing(directory / f"{environment}.npz") as partial, partial.open("wb") as out:
        np.savez_compressed(out, allow_pickle=False, **packed)
    text = json.dumps({"environment": environment, **facts, "digest": digest}, indent=1)
    write_text(directory / f"{environment}.json", text + "\n")
    return digest


def freeze_trained(
    environment: str, trained: Path, *, episodes: int = 100, directory: Path = FROZEN
) -> NDArray[np.float64]:
    """Evaluate a trained policy, freeze it with provenance and return its returns.

    The policy is marked unfinished below 95 % of the paper's return (see `share_of_paper`), and
    flagged below 80 %.
    """
    returns = evaluate_policy(environment, load_policy(environment, trained), episodes=episodes)
    facts: dict[str, Any] = json.loads(trained.with_suffix(".json").read_text(encoding="utf-8"))
    share = share_of_paper(environment, float(returns.mean()))
    facts |= {
        "mean_return": float(returns.mean()),
        "std_return": float(returns.std()),
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
    return returns


def share_of_paper(environment: str, mean: float) -> float:
    """Return a mean return as a share of the paper's.

    Acrobot's return is negative, a count of steps: there the share is paper / mean, and the target
    of -85 of the protocol lies at 0.926; it is scaled so that -85 gives 0.95.
    """
    paper = ENVIRONMENTS[environment].paper_return
    if paper < 0:
        return 0.95 * -85.0 / mean if mean < 0 else 1.0
    return mean / paper
