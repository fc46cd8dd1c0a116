"""Random values and damaged bytes, and the bounds within which they have to be dealt with."""

import resource
import time

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

MOST_SECONDS, MOST_BYTES = 20, 500 * 10**6


def fuzz(strategy, tried, *, long):
    """Run a function on examples: a few, or thousands."""
    count = 3000 if long else 60
    settled = settings(
        max_examples=count, deadline=None, database=None, derandomize=not long,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    settled(given(strategy)(bounded(tried)))()


def bounded(tried):
    def one(case):
        start, before = time.monotonic(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        tried(case)
        assert time.monotonic() - start < MOST_SECONDS
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
        assert grown * 1024 < MOST_BYTES

    return one


ANY = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=9), inner),
    max_leaves=6,
)


@st.composite
def damaged(draw, contents):
    content = bytearray(draw(contents))
    for _ in range(draw(st.integers(0, 3))):
        place = draw(st.integers(0, max(0, len(content) - 1)))
        part = draw(st.binary(max_size=4))
        if draw(st.booleans()):
            content[place : place + len(part)] = part
        elif draw(st.booleans()):
            content[place:place] = part
        else:
            del content[place : place + draw(st.integers(1, 40))]
    return bytes(content)
