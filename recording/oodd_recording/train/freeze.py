"""Frozen policies: weights as npz, and how they were trained as JSON beside them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from oodd_eval.data.files import replacing, write_text
from oodd_recording.benchmark import FROZEN
from oodd_recording.policies import LAYERS, Arrays, make_policy, policy_digest
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
