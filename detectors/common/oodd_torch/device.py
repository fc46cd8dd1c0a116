"""The parameter `device` of detectors that use torch."""

import torch

from oodd_eval.errors import UsageError


def resolved_device(detector: str, device: str) -> str:
    """Return the device that the parameter's value stands for: ``"cpu"`` or ``"cuda"``.

    ``"auto"`` is cuda where there is one. Raises `UsageError` for cuda where there is none.
    """
    available = torch.cuda.is_available()
    if device == "cuda" and not available:
        raise UsageError(
            f"parameter 'device' of {detector} is 'cuda', expected auto or cpu, since torch finds "
            "no CUDA device here"
        )
    if device == "auto":
        return "cuda" if available else "cpu"
    return device
