"""Checks of what a detector does to the process, the machine and the user around it.

All of them judge one fit with scores, whose side effects are recorded.
"""

import contextlib
from collections.abc import Iterable
from pathlib import Path

from oodd_eval.plugins.conformance.side_effects import DAEMON, outside
from oodd_eval.plugins.conformance.trial import EPISODES, CheckFailedError, CheckSkipped, Trial
from oodd_eval.plugins.contract import StorableDetector
from oodd_eval.plugins.isolation.worker import reason_of

MOST_SECONDS = 120.0
MOST_MEGABYTES = 1500.0


def check_random_state(trial: Trial) -> None:
    """Global random generators are left alone."""
    what = "fit or score changed the state of the global generator of"
    advice = "use numpy.random.default_rng(seed), or a generator of one's own"
    _none(trial.effects.random, what, advice)


def check_thread_settings(trial: Trial) -> None:
    """The number of threads that libraries may use is left to the user."""
    _none(trial.effects.threads, "fit or score changed", "the number of threads is the user's")


def check_global_settings(trial: Trial) -> None:
    """Settings of the process, such as the working directory, are left alone."""
    _none(trial.effects.settings, "fit or score changed", "leave, or put back, what is global")


def check_leftovers(trial: Trial) -> None:
    """No thread and no process is left running."""
    # A run loads the saved fit anew where threads run on.
    saved = isinstance(trial.fitted(), StorableDetector)
    left = [x for x in trial.effects.running if not (saved and x.startswith(DAEMON))]
    _none(left, "left running:", "end what was started")


def check_quiet(trial: Trial) -> None:
    """Nothing is printed."""
    if printed := trial.effects.printed:
        line = printed.strip().partition("\n")[0][:60]
        message = f"fit or score printed {len(printed)} characters, first {line!r}: expected none"
        raise CheckFailedError(message)


def check_warnings(trial: Trial) -> None:
    """No warning is raised."""
    _none(trial.effects.warnings, "fit or score warned:", "mend or silence what is expected")


def check_network(trial: Trial) -> None:
    """The network is not asked for."""
    # All that was done so far counts: what is there after a first fit is not fetched again.
    with contextlib.suppress(CheckSkipped):
        trial.events.network += trial.effects.network
    what = "the factory, fit or score asked the network for"
    _none(trial.events.network, what, "a detector comes with all that it needs")
    trial.fitted()


def check_files(trial: Trial) -> None:
    """Files are written in the user's cache directory alone, or gone in the end."""
    seen = trial.effects
    written = [*outside(trial.events.written, Path.cwd()), *seen.written]
    advice = "write below XDG_CACHE_HOME (default ~/.cache), or to temporary files that are removed"
    _none(written, "the factory, fit or score wrote", advice)
    if seen.error and not seen.network:
        raise CheckFailedError(
            f"in an empty working directory it raised {reason_of(seen.error)}: relative paths "
            "depend on where the user stands"
        )


def check_time_budget(trial: Trial) -> None:
    """A small problem takes little time."""
    _at_most(trial, trial.effects.seconds, MOST_SECONDS, "s", digits=1)


def check_memory_budget(trial: Trial) -> None:
    """A small problem takes little memory."""
    _at_most(trial, trial.effects.megabytes, MOST_MEGABYTES, "MB", digits=0)


def _at_most(trial: Trial, took: float, most: float, unit: str, digits: int) -> None:
    if took > most:
        problem = f"{EPISODES} episodes of {trial.rows} observations"
        message = f"fit and score took {took:.{digits}f} {unit} on {problem}: expected at most "
        raise CheckFailedError(f"{message}{most:g} {unit}")


def _none(found: Iterable[str], what: str, advice: str) -> None:
    if different := list(dict.fromkeys(found)):
        more = f" and {len(different) - 1} more" if len(different) > 1 else ""
        raise CheckFailedError(f"{what} {different[0]}{more}: {advice}")
