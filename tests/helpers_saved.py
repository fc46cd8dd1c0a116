"""Saved detectors with a scale of zero, which nothing can be divided by."""

import numpy as np
import pytest

from oodd_eval.errors import FittedStateError
from oodd_eval.plugins.state import ARRAYS


def assert_zero_scales_are_refused(saved, fresh, place, scales):
    """Save a fit, set a value of each array that is a scale to 0, and load it."""
    saved.save(place)
    with np.load(place / ARRAYS) as stored:
        whole = {name: stored[name] for name in stored.files}
    for name in scales:
        wrong = whole[name].copy()
        wrong[-1, ...] = 0
        np.savez(place / ARRAYS, **(whole | {name: wrong}))
        with pytest.raises(FittedStateError, match="positive finite floats"):
            fresh.load(place)
