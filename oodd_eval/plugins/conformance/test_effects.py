"""Tests of what a detector does to the process, the machine and the user around it.

All of them judge one fit with scores, whose side effects are recorded.

PYTEST_DONT_REWRITE: messages are whole sentences.
"""

import contextlib
from collections.abc import Iterable
from pathlib import Path

import pytest

from oodd_eval.plugins.conformance.side_effects import DAEMON, outside
from oodd_eval.plugins.conformance.trial import EPISODES, Trial, shared_trial, trial
from oodd_eval.plugins.contract import StorableDetector
from oodd_eval.plugins.isolation.worker import reason_of

__all__ = ["shared_trial", "trial"]  # fixtures

MOST_SECONDS = 120.0
MOST_MEGABYTES = 1500.0


def test_random_state(trial: Trial) -> None:
    """Global random generators are left alone."""
    effect = "fit or score changed the state of the global generator of"
    advice = "use numpy.random.default_rng(seed), or a generator of one's own"
    _none(trial.effects.random, effect, advice)


def test_thread_settings(trial: Trial) -> None:
    """The number of threads that libraries may use is left to the user."""
    _none(trial.effects.threads, "fit or score changed", "the number of threads is the user's")


def test_global_settings(trial: Trial) -> None:
    """Settings of the process, such as the working directory, are left alone."""
    _none(trial.effects.settings, "fit or score changed", "leave, or put back, what is global")


def test_leftovers(trial: Trial) -> None:
    """No thread and no process is left running."""
    # A run loads the saved fit anew where threads run on.
    saved = isinstance(trial.fitted(), StorableDetector)
    left = [x for x in trial.effects.running if not (saved and x.startswith(DAEMON))]
    _none(left, "left running:", "end what was started")


def test_quiet(trial: Trial) -> None:
    """Nothing is printed."""
    printed = trial.effects.printed
    line = printed.strip().partition("\n")[0][:60]
    assert not printed, (
        f"fit or score printed {len(printed)} characters, first {line!r}: expected none"
    )


def test_warnings(trial: Trial) -> None:
    """No warning is raised."""
    _none(trial.effects.warnings, "fit or score warned:", "mend or silence what is expected")


def test_network(trial: Trial) -> None:
    """The network is not asked for."""
    # All that was done so far counts: what is there after a first fit is not fetched again.
    with contextlib.suppress(pytest.skip.Exception):
        trial.events.network += trial.effects.network
    effect = "the factory, fit or score asked the network for"
    _none(trial.events.network, effect, "a detector comes with all that it needs")
    trial.fitted()


def test_files(trial: Trial) -> None:
    """Files are written in the user's cache directory alone, or gone in the end."""
    effects = trial.effects
    written = [*outside(trial.events.written, Path.cwd()), *effects.written]
    advice = "write below XDG_CACHE_HOME (default ~/.cache), or to temporary files that are removed"
    _none(written, "the factory, fit or score wrote", advice)
    assert not effects.error or effects.network, (
        f"in an empty working directory it raised {reason_of(effects.error)}: relative paths "
        "depend on where the user stands"
    )


def test_time_budget(trial: Trial) -> None:
    """A small problem takes little time."""
    seconds = trial.effects.seconds
    assert seconds <= MOST_SECONDS, _too_much(trial, f"{seconds:.1f} s", f"{MOST_SECONDS:g} s")


def test_memory_budget(trial: Trial) -> None:
    """A small problem takes little memory."""
    megabytes = trial.effects.megabytes
    assert megabytes <= MOST_MEGABYTES, _too_much(
        trial, f"{megabytes:.0f} MB", f"{MOST_MEGABYTES:g} MB"
    )


def _too_much(trial: Trial, used: str, budget: str) -> str:
    problem = f"{EPISODES} episodes of {trial.rows} observations"
    return f"fit and score took {used} on {problem}: expected at most {budget}"


def _none(effects: Iterable[str], what: str, advice: str) -> None:
    """Fail when there are effects, with the first one and the number of others."""
    different = list(dict.fromkeys(effects))
    more = f" and {len(different) - 1} more" if len(different) > 1 else ""
    assert not different, f"{what} {different[0]}{more}: {advice}"
