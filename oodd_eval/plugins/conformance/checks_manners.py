"""Checks of manners: what a detector does to the process, the machine and the user around it.

All of them judge one run that is watched from all sides (`oodd_eval.plugins.conformance.witness`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path

from oodd_eval.plugins.conformance.bench import Bench, CheckFailedError, CheckSkipped
from oodd_eval.plugins.conformance.kit import check
from oodd_eval.plugins.conformance.problem import EPISODES
from oodd_eval.plugins.conformance.witness import outside
from oodd_eval.plugins.isolation.worker import reason_of

MOST_SECONDS = 120.0
MOST_MEGABYTES = 1500.0


@check
def random_state(bench: Bench) -> None:
    """Global random generators are left alone."""
    _none(
        bench.watched().random,
        "fit or score changed the state of the global generator of",
        "use numpy.random.default_rng(seed), or a generator of one's own",
    )


@check
def thread_settings(bench: Bench) -> None:
    """The number of threads that libraries may use is left to the user."""
    _none(bench.watched().threads, "fit or score changed", "the number of threads is the user's")


@check
def global_settings(bench: Bench) -> None:
    """Settings of the process, such as the working directory, are left alone."""
    _none(bench.watched().settings, "fit or score changed", "leave, or put back, what is global")


@check
def leftovers(bench: Bench) -> None:
    """No thread and no process is left running."""
    _none(bench.watched().running, "left running:", "end what was started")


@check
def quiet(bench: Bench) -> None:
    """Nothing is printed."""
    printed = bench.watched().printed
    if printed:
        line = printed.strip().partition("\n")[0]
        raise CheckFailedError(
            f"fit or score printed {len(printed)} characters, first {line[:60]!r}: expected none"
        )


@check
def warnings(bench: Bench) -> None:
    """No warning is raised."""
    _none(bench.watched().warnings, "fit or score warned:", "mend or silence what is expected")


@check
def network(bench: Bench) -> None:
    """The network is not asked for."""
    # All that was done so far counts: what is there after a first fit is not fetched again.
    with contextlib.suppress(CheckSkipped):
        bench.events.network += bench.watched().network
    _none(
        list(dict.fromkeys(bench.events.network)),
        "the factory, fit or score asked the network for",
        "a detector comes with all that it needs",
    )
    bench.fitted()


@check
def files(bench: Bench) -> None:
    """Files are written in the user's cache directory alone, or gone in the end."""
    seen = bench.watched()
    _none(
        list(dict.fromkeys([*outside(bench.events.written, Path.cwd()), *seen.written])),
        "the factory, fit or score wrote",
        "write below XDG_CACHE_HOME (default ~/.cache), or to temporary files that are removed",
    )
    if seen.error and not seen.network:
        raise CheckFailedError(
            f"in an empty working directory it raised {reason_of(seen.error)}: relative paths "
            "depend on where the user stands"
        )


@check
def time_budget(bench: Bench) -> None:
    """A small problem takes little time."""
    seconds = bench.watched().seconds
    if seconds > MOST_SECONDS:
        raise CheckFailedError(
            f"fit and score took {seconds:.1f} s on {_size(bench)}: expected at most "
            f"{MOST_SECONDS:g} s"
        )


@check
def memory_budget(bench: Bench) -> None:
    """A small problem takes little memory."""
    megabytes = bench.watched().megabytes
    if megabytes > MOST_MEGABYTES:
        raise CheckFailedError(
            f"fit and score took {megabytes:.0f} MB on {_size(bench)}: expected at most "
            f"{MOST_MEGABYTES:g} MB"
        )


def _size(bench: Bench) -> str:
    return f"{EPISODES} episodes of {bench.problem.rows} observations"


def _none(found: Sequence[str], what: str, advice: str) -> None:
    if found:
        more = f" and {len(found) - 1} more" if len(found) > 1 else ""
        raise CheckFailedError(f"{what} {found[0]}{more}: {advice}")


CHECKS = (
    random_state,
    thread_settings,
    global_settings,
    leftovers,
    quiet,
    warnings,
    network,
    files,
    time_budget,
    memory_budget,
)
