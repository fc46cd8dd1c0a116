"""A detector under test: how to make it, what to try it on, and one fit that checks share.

Checks that only score share one fitted detector, because fits take the time. A check that needs
what another one is about (a factory that works, a fit, the shape of scores) is skipped without it
and names the other one, so that one fault is told once.

The fixture `trial` hands it to the tests; it needs a fixture `detector`, with what `Trial` takes.

PYTEST_DONT_REWRITE: messages are whole sentences.
"""

import contextlib
import functools
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import pytest

from oodd_checks.conformance.side_effects import Effects, Events, auditing, watch
from oodd_eval.data.trajectory import Trajectory
from oodd_eval.errors import ContractError
from oodd_eval.metrics.auc import Floats
from oodd_eval.plugins.contract import (
    ROLLOUT_TOLERANCE,
    TOLERANCE,
    Detector,
    DetectorSpec,
    Scores,
    accepted,
    factory_of,
    float_scores,
)
from oodd_eval.plugins.foreign import refuse_foreign
from oodd_eval.plugins.isolation.worker import reason_of
from oodd_eval.results.evaluate import difference

SENSORS: Final = 3
ACTIONS: Final = 2
EPISODES: Final = 12
ROWS: Final = 80  # observations of an episode, beyond the horizon
Factory = Callable[..., Detector] | Detector | DetectorSpec
"""A class or function that makes a detector, one that is copied, or what a plug-in offers."""


class RaisedError(AssertionError):
    """A detector raised; the message says what it was doing, and where."""


class Trial:
    """All that the checks of one detector share.

    Episodes have actions where the spec declares them, and for a factory, which declares nothing.

    Parameters
    ----------
    factory
        Called as ``factory(seed=..., horizon=..., **parameters)``, without seed or horizon if it
        does not take them; a `DetectorSpec` tells what the detector declares too. Of an unfitted
        detector copies are made.
    horizon
        Prediction horizon in steps.
    seed
        Seed of the detector.
    parameters
        Further arguments of the factory.
    """

    def __init__(
        self,
        factory: Factory,
        *,
        horizon: int = 1,
        seed: int = 0,
        parameters: Mapping[str, Any] | None = None,
    ) -> None:
        if not isinstance(factory, DetectorSpec):
            refuse_foreign(factory)
            factory = DetectorSpec("", factory_of(factory), "", inputs="observations+actions")
        self.spec = factory
        self.actions = self.spec.inputs == "observations+actions"
        self.sensors = len(self.spec.columns) or SENSORS
        self.horizon, self.seed, self.parameters = horizon, seed, dict(parameters or {})
        self.arguments = self._accepted(seed=seed, horizon=horizon) | self.parameters
        self.rows = ROWS + horizon  # of an ordinary episode
        self.tolerance = TOLERANCE if horizon == 1 else ROLLOUT_TOLERANCE
        self.events = Events()  # of all checks so far

    @contextlib.contextmanager
    def watched(self) -> Iterator[None]:
        """Watch a check; warnings are the matter of the check of that name alone."""
        with warnings.catch_warnings(action="ignore"), auditing(self.events):
            yield

    def make(self, **changes: Any) -> Detector:
        """Return a new unfitted detector; `changes` replace seed, horizon or parameters."""
        fixed = self._accepted(**{n: changes.pop(n) for n in ("seed", "horizon") if n in changes})
        arguments = self.arguments | fixed | changes
        called = ", ".join(f"{name}={value!r}" for name, value in arguments.items())
        with doing(f"the factory, called with {called},"):
            detector = self.spec.factory(**arguments)
        for method in ("fit", "score"):
            assert callable(getattr(detector, method, None)), (
                f"the factory returned {type(detector).__name__} without a method {method}: "
                "expected an object with fit(nominal) and score(trajectory)"
            )
        return detector

    def _accepted(self, **arguments: int) -> dict[str, Any]:
        return accepted(self.spec.factory, **arguments)

    def unfitted(self) -> Detector:
        """Return a new unfitted detector, for checks that are about something else."""
        try:
            return self.make()
        except AssertionError:
            pytest.skip("needs a detector: see check 'factory'")

    def fit(self, nominal: Sequence[Trajectory] | None = None, **changes: Any) -> Detector:
        """Return a detector of its own, fitted on the training trajectories or the given ones."""
        detector = self.make(**changes)
        with doing("fit"):
            # The harness hands over a sequence that is not a list, as here.
            self.learn(detector, tuple(self.training()) if nominal is None else nominal)
        return detector

    def learn(
        self, detector: Any, nominal: Sequence[Trajectory], first: int = 7000, **further: Any
    ) -> None:
        """Fit a detector, with episodes that get ten times noisier if it declares failures."""
        if self.spec.training == "failures":
            episodes = self.training(nominal[0].observation_dim, first)
            further["failures"] = tuple(noisy_from(x, self.rows // 2) for x in episodes)
        detector.fit(nominal, **further)

    @functools.cached_property
    def first_fit(self) -> Detector | AssertionError:
        """The fitted detector that checks share, or why it cannot be fitted or cannot score."""
        self.unfitted()
        try:
            detector = self.fit()
            with doing("score"):
                detector.score(self.nominal(1)[0])
        except AssertionError as error:
            return error
        return detector

    def fitted(self) -> Detector:
        """Return the shared fitted detector, for checks about something else: only to score."""
        if isinstance(self.first_fit, AssertionError):
            pytest.skip("needs a fitted detector: see check 'fits'")
        return self.first_fit

    def scores(self, trajectory: Trajectory, detector: Detector | None = None) -> Scores:
        """Return the scores of the shared detector or another one, for checks of their values."""
        detector = self.fitted() if detector is None else detector
        return as_scores(detector.score(trajectory), trajectory)

    def must_agree(self, detector: Detector, what: str, advice: str = "", n: int = 2) -> None:
        """Fail when a detector does not give `n` trajectories the scores of the shared one."""
        for x in self.nominal(n):
            assert_equal(self.scores(x, detector), self.scores(x), what, advice)

    def learns_nothing(self) -> bool:
        """Tell whether a detector scores without a fit as it does after it."""
        trajectory = self.nominal(1)[0]
        try:
            before = self.scores(trajectory, self.unfitted())
        except (Exception, pytest.skip.Exception):  # noqa: BLE001  whatever it is: without a fit it does not score
            return False
        return np.array_equal(before, self.scores(trajectory), equal_nan=True)

    @functools.cached_property
    def effects(self) -> Effects:
        """The side effects of making, fitting and using a new detector."""
        self.fitted()
        detector, training, nominal = self.unfitted(), self.training(), self.nominal()

        def work() -> None:
            self.make()
            self.learn(detector, training)
            for trajectory in nominal:
                detector.score(trajectory)

        return watch(work)

    def episode(self, key: int, rows: int | None = None, sensors: int = 0) -> Trajectory:
        """Return the nominal episode of a key; another number of sensors is another system."""
        rows = self.rows if rows is None else rows
        observations, actions = _system(key, rows, sensors or self.sensors)
        return Trajectory(observations, actions if self.actions else None)

    def training(self, sensors: int = 0, first: int = 1000) -> list[Trajectory]:
        """Return nominal episodes of equal length to fit on."""
        return [self.episode(first + i, sensors=sensors) for i in range(EPISODES)]

    def nominal(self, n: int = 4) -> list[Trajectory]:
        """Return nominal episodes to score, of unequal lengths, not among the training ones."""
        return [self.episode(2000 + i, self.rows - 7 * i) for i in range(n)]

    def anomalous(self, n: int = 4) -> list[tuple[Trajectory, Trajectory, int]]:
        """Return episodes in which all sensors get ten times noisier, with twins and onsets."""
        twins = [(self.episode(3000 + i), self.rows // 2 + i) for i in range(n)]
        return [(noisy_from(twin, onset), twin, onset) for twin, onset in twins]


def noisy_from(trajectory: Trajectory, row: int) -> Trajectory:
    """Return an episode with noise of ten times the spread of each sensor from a row on."""
    observations = trajectory.observations.astype(np.float64)
    noise = np.random.default_rng(row).normal(size=observations[row:].shape)
    observations[row:] += 10 * observations.std(axis=0) * noise
    return Trajectory(observations, trajectory.actions)


@functools.lru_cache(maxsize=256)
def _system(key: int, rows: int, sensors: int) -> tuple[Floats, Floats]:
    """Return observations and actions of a nominal episode of a linear-Gaussian system."""
    # A two-dimensional state turns and decays, actions push it, and every sensor sees a combination
    # of it in units of its own, with noise.
    system = np.random.default_rng(sensors)
    mixing = system.normal(size=(2, sensors))
    scale = 10.0 ** system.integers(-1, 2, size=sensors)
    angle, decay = 0.3, 0.97
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    push = np.array([[0.2, 0.0], [0.1, 0.2]])
    rng = np.random.default_rng([key, sensors])
    actions = rng.uniform(-1, 1, size=(rows - 1, ACTIONS))
    states = [rng.normal(size=2)]
    for action in actions:
        states.append(decay * turn @ states[-1] + push @ action + 0.1 * rng.normal(size=2))
    noise = 0.05 * rng.normal(size=(rows, sensors))
    return scale * (np.array(states) @ mixing + noise), actions


@contextlib.contextmanager
def doing(what: str) -> Iterator[None]:
    """Turn whatever a detector raises into a failure that says what it was doing, and where."""
    try:
        yield
    except RaisedError:
        raise
    except (Exception, SystemExit) as error:
        raised = "" if isinstance(error, SystemExit) else "raised "
        raise RaisedError(f"{what} {raised}{reason_of(error)}") from error


def as_scores(returned: object, trajectory: Trajectory) -> Scores:
    """Return scores as float64; skip when their form, which another check is about, is wrong."""
    try:
        scores = float_scores(returned)
    except ContractError:
        pytest.skip("needs scores that are numbers: see check 'scores'")
    if scores.shape != (len(trajectory),):
        pytest.skip("needs one score per observation: see check 'scores'")
    return scores


def assert_equal(
    scores: Scores, expected: Scores, what: str, advice: str = "", tolerance: float = 0.0
) -> None:
    """Fail when scores differ, with the first difference between `what` and `advice`."""
    problem = difference(scores, expected, tolerance)
    assert not problem, f"{what}: {problem}" + (f"; {advice}" if advice else "")


def offered(detector: Detector, first: str, second: str) -> Any:
    """Return a detector that has both of two optional methods; skip the check if it has none."""
    has = [callable(getattr(detector, name, None)) for name in (first, second)]
    if not any(has):
        pytest.skip(f"has no {first} and {second}")
    assert all(has), f"has only one of {first} and {second}: expected both, or none"
    return detector


def fail_for(effects: Iterable[str], what: str, advice: str) -> None:
    """Fail when there are effects, with the first one and the number of others."""
    different = list(dict.fromkeys(effects))
    more = f" and {len(different) - 1} more" if len(different) > 1 else ""
    assert not different, f"{what} {different[0]}{more}: {advice}"


@pytest.fixture(scope="module")
def shared_trial(detector: Factory | Trial) -> Trial:
    """Return what the tests of a module share."""
    return detector if isinstance(detector, Trial) else Trial(detector)


@pytest.fixture
def trial(shared_trial: Trial) -> Iterator[Trial]:
    """Yield what the tests share, watched while one of them runs."""
    with shared_trial.watched():
        yield shared_trial
