"""What a check is: a named function of a bench that passes, fails or is skipped."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from oodd_eval.plugins.conformance.audit import auditing
from oodd_eval.plugins.conformance.bench import Bench, Factory, Subject, doing


@dataclass(frozen=True, slots=True)
class Check:
    """One named check; calling it with a factory carries it out.

    Attributes
    ----------
    name
        Lower-case words with hyphens.
    summary
        What holds when it passes, in one line.
    judge
        The function that does it.
    """

    name: str
    summary: str
    judge: Callable[[Bench], None]

    def __call__(
        self,
        factory: Factory,
        *,
        horizon: int = 1,
        seed: int = 0,
        parameters: Mapping[str, Any] | None = None,
    ) -> None:
        """Return if the detector passes.

        Parameters
        ----------
        factory
            Called as ``factory(seed=..., horizon=..., **parameters)``; a `DetectorSpec` tells its
            declared parameters too. The same factory in the next check shares the fit.
        horizon, seed, parameters
            What the factory is called with.

        Raises
        ------
        CheckFailedError
            With a message that says what was expected and what came.
        CheckSkipped
            When the check does not apply; pytest reports it as a skip.
        """
        subject = Subject.of(factory, horizon=horizon, seed=seed, parameters=parameters)
        self.carry_out(_bench(subject))

    def carry_out(self, bench: Bench) -> None:
        """Do the same on a bench that several checks share."""
        with warnings.catch_warnings():
            # They are the matter of the check 'warnings'.
            warnings.simplefilter("ignore")
            with auditing(bench.events), doing("the detector"):
                self.judge(bench)

    def __str__(self) -> str:
        """Return the name: the ids of parametrized tests."""
        return self.name


def check(judge: Callable[[Bench], None]) -> Check:
    """Make a check of a function: its name with hyphens, the first line of its docstring."""
    summary = (judge.__doc__ or "").partition("\n")[0].rstrip(".")
    return Check(judge.__name__.replace("_", "-"), summary, judge)


_latest: list[Bench] = []
"""The bench of the last check that was called with a factory."""


def _bench(subject: Subject) -> Bench:
    """Return the bench of the check before when it had the same subject, or a new one."""
    if not _latest or _latest[0].subject != subject:
        _latest[:] = [Bench(subject)]
    return _latest[0]
