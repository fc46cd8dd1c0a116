"""The bench a detector is checked on: how to make it, one shared fit, and what checks may ask.

Checks that only score share one fitted detector, because fits are what costs time. What one check
needs and another one is about (a factory that works, a fit, scores of the right shape) is not
reported twice: the former is skipped and names the latter.
"""

from __future__ import annotations

import contextlib
import unittest
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import ContractError
from oodd_eval.plugins.conformance.audit import Events
from oodd_eval.plugins.conformance.problem import Problem
from oodd_eval.plugins.conformance.witness import Watched, settings, watch
from oodd_eval.plugins.contract import Detector, DetectorSpec, Scores
from oodd_eval.plugins.isolation.worker import reason_of

Factory = Callable[..., Detector] | DetectorSpec
"""A detector's factory, or the spec that a plug-in offers."""


class CheckFailedError(ContractError, AssertionError):
    """A detector does not behave as the contract asks; the message says in which way."""


class CheckSkipped(unittest.SkipTest):
    """A check does not apply, or cannot be carried out; pytest reports it as a skip."""


@dataclass(frozen=True, slots=True)
class Subject:
    """What is checked: a factory and what it is called with.

    Parameters
    ----------
    factory
        As `DetectorSpec.factory`.
    horizon, seed
        Handed to the factory.
    parameters
        Handed to the factory too; others than these have the factory's own defaults.
    declared
        Names and defaults of the parameters that the plug-in declares; None when not known.
    fit_ignores
        As in `DetectorSpec`.
    """

    factory: Callable[..., Detector]
    horizon: int = 1
    seed: int = 0
    parameters: Mapping[str, Any] = field(default_factory=dict)
    declared: Mapping[str, Any] | None = None
    fit_ignores: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        factory: Factory,
        *,
        horizon: int = 1,
        seed: int = 0,
        parameters: Mapping[str, Any] | None = None,
    ) -> Subject:
        """Return the subject that a factory or a spec stands for."""
        given = dict(parameters or {})
        if isinstance(factory, DetectorSpec):
            return cls(
                factory.factory,
                horizon,
                seed,
                given,
                declared=factory.parameters,
                fit_ignores=factory.fit_ignores,
            )
        return cls(factory, horizon, seed, given)


class Bench:
    """Everything that the checks of one subject share.

    Parameters
    ----------
    subject
        What is checked.

    Attributes
    ----------
    problem
        Trajectories to fit on and to score.
    events
        What was done to files and the network in all checks so far.
    settings_before
        Settings of the process before the first of them.
    """

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        self.problem = Problem(subject.horizon)
        self.events = Events()
        self.settings_before = settings()
        self._made: CheckFailedError | None = None
        self._fitted: Detector | CheckFailedError | None = None
        self._watched: Watched | None = None

    def make(self, **changes: Any) -> Detector:
        """Return a new unfitted detector; `changes` replace seed, horizon or parameters.

        Raises
        ------
        CheckFailedError
            When the factory raises or returns something else than a detector.
        """
        s = self.subject
        arguments = {"seed": s.seed, "horizon": s.horizon, **s.parameters, **changes}
        called = ", ".join(f"{name}={value!r}" for name, value in arguments.items())
        with doing(f"the factory, called with {called},"):
            detector: object = s.factory(**arguments)
        for method in ("fit", "score"):
            if not callable(getattr(detector, method, None)):
                raise CheckFailedError(
                    f"the factory returned {type(detector).__name__} without a method {method}: "
                    "expected an object with fit(nominal) and score(trajectory)"
                )
        return detector  # type: ignore[return-value]  # it has what the protocol asks for

    def unfitted(self) -> Detector:
        """Return a new unfitted detector, for checks that are about something else."""
        try:
            return self.make()
        except CheckFailedError:
            raise CheckSkipped("needs a detector: see check 'factory'") from None

    def fit(self, nominal: Sequence[Trajectory] | None = None, **changes: Any) -> Detector:
        """Return a detector of its own, fitted on the training trajectories or the given ones."""
        detector = self.make(**changes)
        with doing("fit"):
            # The harness hands over a sequence that is not a list, as here.
            detector.fit(tuple(self.problem.training()) if nominal is None else nominal)
        return detector

    def first_fit(self) -> Detector:
        """Return the fitted detector that checks share, made at the first call.

        Raises
        ------
        CheckFailedError
            When it cannot be fitted or cannot score; at every call.
        """
        if self._fitted is None:
            self.unfitted()
            try:
                self._fitted = self.fit()
                with doing("score"):
                    self._fitted.score(self.problem.nominal(1)[0])
            except CheckFailedError as error:
                self._fitted = error
        if isinstance(self._fitted, CheckFailedError):
            raise self._fitted
        return self._fitted

    def fitted(self) -> Detector:
        """Return the fitted detector that checks share, for checks that are about something else.

        They must leave it as it is: score with it, no more.
        """
        try:
            return self.first_fit()
        except CheckFailedError:
            raise CheckSkipped("needs a fitted detector: see check 'fits'") from None

    def learns_nothing(self) -> bool:
        """Whether a detector scores without a fit as it does after it."""
        trajectory = self.problem.nominal(1)[0]
        try:
            before = scores_of(self.unfitted(), trajectory)
        except Exception:  # noqa: BLE001  whatever it is: without a fit it does not score
            return False
        return np.array_equal(before, scores_of(self.fitted(), trajectory), equal_nan=True)

    def watched(self) -> Watched:
        """Return what was seen while a new detector was made, fitted and used."""
        if self._watched is None:
            self.fitted()
            detector = self.unfitted()
            training, nominal = self.problem.training(), self.problem.nominal()

            def work() -> None:
                self.make()
                detector.fit(training)
                for trajectory in nominal:
                    detector.score(trajectory)

            self._watched = watch(work, self.settings_before)
        return self._watched


@contextlib.contextmanager
def doing(what: str) -> Iterator[None]:
    """Turn whatever a detector raises into a failure that says what it was doing.

    Raises
    ------
    CheckFailedError
        ``<what> raised <type>: <message> (<file>:<line>)``, or that it called ``sys.exit``.
    """
    try:
        yield
    except (CheckFailedError, CheckSkipped):
        raise
    except SystemExit as error:
        raise CheckFailedError(f"{what} {reason_of(error)}") from error
    except Exception as error:
        raise CheckFailedError(f"{what} raised {reason_of(error)}") from error


def scores_of(detector: Detector, trajectory: Trajectory) -> Scores:
    """Return a detector's scores of a trajectory as float64, for checks about their values.

    Raises
    ------
    CheckSkipped
        When they have another shape, which is the matter of another check.
    """
    return as_scores(detector.score(trajectory), trajectory)


def as_scores(returned: object, trajectory: Trajectory) -> Scores:
    """Return what a detector returned as float64 scores of the right shape, likewise."""
    if not isinstance(returned, np.ndarray) or returned.shape != (len(trajectory),):
        raise CheckSkipped("needs one score per observation: see checks 'shape' and 'dtype'")
    try:
        return returned.astype(np.float64)
    except (TypeError, ValueError):
        raise CheckSkipped("needs scores that are numbers: see check 'dtype'") from None


def listed(directory: Path) -> list[Path]:
    """Return the files below a directory, sorted."""
    return sorted(path for path in directory.rglob("*") if path.is_file())
