"""A fitted detector as two plain files: weights in safetensors, everything else in JSON."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from oodd_eval.errors import FittedStateError
from oodd_eval.plugins.forecasting import FeatureScale
from oodd_torch.network import Architecture, Ensemble

WEIGHTS: Final = "weights.safetensors"
STATE: Final = "state.json"
FORMAT: Final = 1


@dataclass(frozen=True, slots=True)
class Fit:
    """What `fit` learns: the networks, the scale of every sensor, and how training went."""

    network: Ensemble
    scale: FeatureScale
    history: list[list[float]]


def save_fit(directory: Path, fit: Fit) -> None:
    """Write a fit into a directory."""
    weights = {n: t.detach().cpu().contiguous() for n, t in fit.network.state_dict().items()}
    save_file(weights, directory / WEIGHTS)
    state = {
        "format": FORMAT,
        "architecture": asdict(fit.network.architecture),
        "members": fit.network.members,
        "mean": fit.scale.mean.tolist(),
        "std": fit.scale.std.tolist(),
        "history": fit.history,
    }
    (directory / STATE).write_text(json.dumps(state, indent=1), encoding="utf-8")


def load_fit(directory: Path, *, members: int, expected: dict[str, Any], device: str) -> Fit:
    """Read a fit back.

    Parameters
    ----------
    directory
        Where `save_fit` wrote.
    members, expected
        Ensemble size, and fields of the architecture, that the detector was made with.
    device
        Where the networks go.

    Raises
    ------
    FittedStateError
        When files are missing, damaged, or of a detector with other parameters.
    """
    try:
        state = json.loads((directory / STATE).read_text(encoding="utf-8"))
        weights = load_file(directory / WEIGHTS)
        found = {"format": state["format"], "members": state["members"]} | {
            name: state["architecture"][name] for name in expected
        }
        wanted = {"format": FORMAT, "members": members} | expected
        if found != wanted:
            raise FittedStateError(
                f"{str(directory)!r} holds a detector with {found}, expected {wanted}: make the "
                "detector with the parameters that it was saved with"
            )
        architecture = Architecture(**state["architecture"])
        scale = FeatureScale(np.array(state["mean"]), np.array(state["std"]))
        generators = [torch.Generator() for _ in range(members)]
        network = Ensemble(architecture, generators, np.ones(architecture.features, np.float32))
        network.load_state_dict(weights)
        if len(scale.mean) != architecture.features or len(scale.std) != architecture.features:
            raise FittedStateError(
                f"{str(directory)!r}: {STATE} holds {len(scale.mean)} means and {len(scale.std)} "
                f"standard deviations, expected {architecture.features} of each"
            )
        return Fit(network.to(device).requires_grad_(requires_grad=False), scale, state["history"])
    except (OSError, KeyError, TypeError, ValueError, RuntimeError, SafetensorError) as error:
        if isinstance(error, FittedStateError):
            raise
        raise FittedStateError(
            f"{str(directory)!r} cannot be read as a saved detector ({STATE}, {WEIGHTS}): {error}"
        ) from None
