"""States of detectors with a scale of zero, which nothing can be divided by."""

import pytest

from oodd_eval.errors import FittedStateError
from oodd_eval.plugins.state import pack


def assert_zero_scales_are_refused(fitted, fresh, scales):
    """Set a value of each array that is a scale to 0, and restore the state."""
    for name in scales:
        state = pack(fitted.state()).state()
        state[name][-1, ...] = 0
        with pytest.raises(FittedStateError, match="positive finite floats"):
            fresh.restore(state)
