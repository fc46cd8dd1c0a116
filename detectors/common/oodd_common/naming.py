"""Names all sensors and actuators that are at fault at once, by the evidence of sets of them.

A fault of a sensor is a reading that is its state and something else. It shows in the row itself,
and in the forecasts of the next rows, which are made from it: so a faulty sensor is told from
neighbours whose forecasts it spoils.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter
from typing import Any, Final, NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from oodd_common.charts import Floats, limited
from oodd_common.windows import StandardEpisode, regressors
from oodd_eval import Naming, Trajectory
from oodd_eval.plugins.forecasting import CONSTANT, FeatureScale
from oodd_eval.plugins.state import Arrays, take

ORDER: Final = 2  # latest rows, and commands, that a forecast uses
RIDGE: Final = 1e-6  # relative to the mean square of a standardized sensor
FED_BACK: Final = 1e-4  # the same of forecasts that are fed back, as a virtual sensor's are
FOLDS: Final = 5  # of episodes, each forecast by what was fitted on the others
FLOOR: Final = 3e-3  # least standard deviation of an error, in those of training
FREEDOM: Final = 4.0  # of the errors' Student t distribution: contacts make heavy tails
STEPS: Final = 10  # in which the errors' covariance is fitted
STEP: Final = 2.0  # limit of an error's logarithm in the CUSUM that finds the onset
LIMIT: Final = 100.0  # of a reading that a fault is proportional to, in standard deviations
JUMP: Final = 10.0  # of an error over all since the onset that makes it the onset
ROWS: Final = 30_000  # that a fit takes, at most about
WINDOW: Final = 8  # rows from the onset on that a naming looks at
SIZES: Final = np.array([0.03, 0.1, 0.3, 1.0, 3.0])  # of faults, in standard deviations
LARGEST: Final = 0.4  # share of the sensors in a set
DISTINCT: Final = 8  # a sensor with as few values tells contacts or modes: it is never named

# Prices in nats of evidence.
PRICE: Final = 2.0  # of a part
FIRST: Final = 4.0  # of a set, times the logarithm of the number of sensors: the best is of many
DYNAMIC: Final = 2.0  # of a set of actuators, where sensors do not explain the errors
NEVER: Final = 1e9

NAMES: Final = ["sensors", "actions", "coefficients", "covariance", "price", "runs", "reference"]


@dataclass(frozen=True, slots=True, eq=False)
class ReadingModel:
    """A linear forecast of nominal readings from the two rows, and commands, before them.

    Attributes
    ----------
    sensors, actions
        Means and standard deviations in training, of shape (D,) and (A,); A may be 0.
    coefficients : float64 array of shape (2 (D + A) + 1, D)
        Of standardized regressors: two rows, newest first, two commands, and 1.
    covariance : float64 array of shape (D, D)
        Of the errors of one forecast, standardized.
    """

    sensors: FeatureScale
    actions: FeatureScale
    coefficients: Floats
    covariance: Floats

    @classmethod
    def fit(cls, nominal: Sequence[Trajectory]) -> Self:
        """Fit to nominal episodes; those without actions have forecasts without commands."""
        return cls.with_errors(nominal, FED_BACK)[0]

    @classmethod
    def with_errors(
        cls, nominal: Sequence[Trajectory], ridge: float = RIDGE
    ) -> tuple[Self, Floats]:
        """Return a fit, and the errors of forecasts that were fitted to other episodes, (N, D)."""
        nominal = _some(nominal)
        sensors = _scale([x.observations for x in nominal])
        actions = _scale([x.actions for x in nominal])
        bare = cls(sensors, actions, np.empty((0, 0)), np.empty((0, 0)))
        pairs = [(bare.regressors(x), bare.standard(x)[1:]) for x in nominal]
        fits = [
            _ridge([pair for j, pair in enumerate(pairs) if j % FOLDS != i] or pairs, ridge)
            for i in range(min(FOLDS, len(pairs)))
        ]
        errors = np.concatenate([y - x @ fits[i % FOLDS] for i, (x, y) in enumerate(pairs)])
        return cls(sensors, actions, _ridge(pairs, ridge), _covariance(errors)), errors

    def standard(self, x: Trajectory) -> Floats:
        """Return the standardized rows of an episode, (T + 1, D)."""
        return np.asarray((x.observations - self.sensors.mean) / self.sensors.std)

    def regressors(self, x: Trajectory) -> Floats:
        """Return what forecasts of the rows 1 to T are made of, (T, K)."""
        actions = x.actions if len(self.actions.mean) else x.actions[:, :0]
        commands = (actions - self.actions.mean) / self.actions.std
        return regressors(StandardEpisode(self.standard(x), commands), 1, ORDER)

    def errors(self, x: Trajectory) -> Floats:
        """Return the errors of the forecasts of the rows 1 to T, standardized: (T, D)."""
        return np.asarray(self.standard(x)[1:] - self.regressors(x) @ self.coefficients)


@dataclass(frozen=True, eq=False)
class PartNamer:
    """Names the parts at fault as a set, by the evidence of sets in the errors of forecasts.

    A reading is the state and, of faulty sensors, something more, f. The error of a row is then the
    nominal one, plus f, minus what the f of the two rows before brought into the forecast. The
    evidence of a set is the density of the errors of some rows with normal f, divided by that
    without a fault. An unknown scale of all errors, which makes both Student's t, keeps contacts
    and other dynamics from being called sensors. A faulty actuator adds to errors alone.

    Attributes
    ----------
    model
        How readings follow from earlier ones in nominal operation.
    price : float64 array of shape (D + A,)
        Evidence, in natural logarithms, for which a sensor or actuator joins a set. `NEVER` for
        sensors that have few values, and for columns of actions that are choices.
    runs : float64 array of shape (2, D)
        Longest runs in training of readings that are exactly 0, and that equal the one before.
    reference
        Length of an error that one nominal row in ten exceeds.
    """

    model: ReadingModel
    price: Floats
    runs: Floats
    reference: float

    @classmethod
    def fit(cls, nominal: Sequence[Trajectory]) -> Self:
        """Fit to nominal episodes; actions are used where episodes have them."""
        nominal = _some(nominal)
        model, errors = ReadingModel.with_errors(nominal)
        lengths = _squares(errors, np.linalg.inv(model.covariance))
        reference = float(np.sqrt(np.quantile(lengths, 0.9))) or 1.0
        rows = np.concatenate([x.observations for x in nominal])
        actions = np.concatenate([x.actions for x in nominal])
        choices = ((actions == 0) | (actions == 1)).all() and (actions.sum(axis=1) == 1).all()
        coarse = [len(np.unique(sensor)) <= DISTINCT for sensor in rows.T]
        price = np.where(coarse + [choices] * actions.shape[1], NEVER, PRICE)
        runs = np.max([_longest(x.observations) for x in nominal], axis=0)
        return cls(model, price, runs, reference)

    def name(self, x: Trajectory, since: int | None = None) -> tuple[Naming, int]:
        """Name the parts at fault as seen at the last row of an episode.

        Parameters
        ----------
        x
            The episode up to that row.
        since
            A row that the fault did not begin before, where one is known.

        Returns
        -------
        naming : Naming
        onset : int
            The row with which the fault began, by the lengths of errors.
        """
        live = self.begin(since)
        for row, action in zip(x.observations, [None, *x.actions], strict=True):
            live.update(row, action)
        return live.name()

    def begin(self, since: int | None = None) -> LiveNaming:
        """Return what names the parts at fault of a live episode; `since` as in `name`."""
        return LiveNaming(self, since or 0)

    def arrays(self) -> dict[str, Floats]:
        """Return the fit as arrays of numbers, by name."""
        model, reference = self.model, np.array([self.reference])
        scales = [np.stack([s.mean, s.std]) for s in (model.sensors, model.actions)]
        fit = *scales, model.coefficients, model.covariance, self.price, self.runs, reference
        return {f"naming_{name}": array for name, array in zip(NAMES, fit, strict=True)}

    @classmethod
    def of(cls, arrays: Arrays) -> Self:
        """Return the fit among saved arrays; `FittedStateError` where there is none."""
        sensors, actions = (FeatureScale.of(arrays, f"naming_{name}") for name in NAMES[:2])
        d, parts = len(sensors.mean), len(sensors.mean) + len(actions.mean)
        forms = (ORDER * parts + 1, d), (d, d), (parts,), (2, d), (1,)
        *fit, price, runs, reference = (
            take(arrays, f"naming_{name}", form)
            for name, form in zip(NAMES[2:], forms, strict=True)
        )
        return cls(ReadingModel(sensors, actions, *fit), price, runs, float(reference[0]))

    @cached_property
    def evidence(self) -> tuple[_Evidence, _Evidence]:
        """Evidence of faulty sensors, and of faulty actuators."""
        d, precision = len(self.model.covariance), np.linalg.inv(self.model.covariance)
        readings = self.model.coefficients[: ORDER * d].reshape(ORDER, d, d)
        commands = self.model.coefficients[ORDER * d : -1].reshape(ORDER, -1, d)
        lags = np.concatenate([np.eye(d)[None], -readings])
        return _Evidence(lags, precision), _Evidence(commands, precision)


class LiveNaming:
    """Names the parts at fault of one live episode, row by row; made by `PartNamer.begin`."""

    def __init__(self, namer: PartNamer, since: int) -> None:
        self._namer, self._since, self._t = namer, since, -1
        self._runs, self._sum, self._largest, self._onset = np.zeros_like(namer.runs), 0.0, 0.0, 0
        self._window: list[tuple[Floats, Floats]] = []
        self._precision = namer.evidence[0].precision

    def update(self, row: NDArray[Any], action: NDArray[Any] | None = None) -> None:
        """Take the next row, (D,), and the action commanded since the one before, (A,)."""
        model, values = self._namer.model, np.array(row, dtype=np.float64)
        self._t, standard = self._t + 1, (values - model.sensors.mean) / model.sensors.std
        if not self._t:
            self._last, self._rows = values, [standard] * ORDER
            self._commands = [np.zeros(len(model.actions.mean))] * ORDER
            return
        command = np.array(action, dtype=np.float64) if len(model.actions.mean) else np.empty(0)
        self._commands = [(command - model.actions.mean) / model.actions.std, *self._commands[:-1]]
        forecast = np.concatenate([*self._rows, *self._commands, [1.0]]) @ model.coefficients
        shape = np.concatenate([values / model.sensors.std, command / model.actions.std])
        self._follow(standard - forecast, limited(shape, LIMIT))
        self._runs = np.where([values == 0, values == self._last], self._runs + 1, 0)
        self._last, self._rows = values, [standard, *self._rows[:-1]]

    def _follow(self, error: Floats, shape: Floats) -> None:
        """Find the onset with a CUSUM, and keep the first rows from there on."""
        length = float(np.sqrt(_squares(error[None], self._precision)[0])) / self._namer.reference
        if self._sum <= 0 or self._t <= self._since or length > JUMP * self._largest:
            self._sum, self._largest, self._onset, self._window = 0.0, 1e-9, self._t, []
        self._largest = max(self._largest, length)
        self._sum += float(np.clip(np.log(max(length, 1e-9)), -STEP, STEP))
        if len(self._window) < WINDOW:
            self._window.append((error, shape))

    def name(self) -> tuple[Naming, int]:
        """Name the parts at fault as seen at the latest row, and the onset."""
        namer, onset, d = self._namer, self._onset, len(self._precision)
        sensors, actuators = np.zeros(d), np.zeros(len(namer.price) - d)
        sizes, kind, varies = np.full(d, np.nan), "", namer.price[:d] < NEVER
        rests = (self._runs > namer.runs + np.array([[0], [1]])) & varies
        if rests.any():
            # Those that came to rest in the same row do so for the same reason.
            length = np.where(rests, self._runs, -1).max(axis=1, keepdims=True)
            rests = (rests | ((self._runs == length) & varies)).any(axis=0)
            sensors, sizes, kind = rests * 1.0, np.where(rests, np.inf, np.nan), "sensor"
            onset = self._t + 1 - int(length.max())
        elif self._window:
            errors, shapes = (np.stack(list(arrays)) for arrays in zip(*self._window, strict=True))
            most, price = max(1, int(LARGEST * d)), namer.price
            readings = namer.evidence[0].best(errors, shapes[:, :d], price[:d], most)
            commands = namer.evidence[1].best(errors, shapes[:, d:], price[d:], len(actuators))
            of_sensors, of_actuators = readings[0] - FIRST * np.log(1 + d), commands[0] - DYNAMIC
            if max(of_sensors, of_actuators) <= 0:
                kind = "body"
            elif of_sensors >= of_actuators:
                (_, sensors, sizes), kind = readings, "sensor"
            elif (commands[1] >= 0.5).sum() > 1:
                kind = "environment"  # such as wind, which moves all joints
            else:
                actuators, kind = commands[1], "actuator"
        return Naming(sensors, actuators, sizes * namer.model.sensors.std, kind), onset


# A set of parts: its evidence beyond prices, and each part's probability and size, (P,).
_Set: TypeAlias = tuple[float, Floats, Floats]


class _Evidence:
    """Evidence of sets of parts in the errors of some rows.

    A fault of size 1 in part p at row t adds ``lags[a, p]`` to the error of row t + a.
    """

    def __init__(self, lags: Floats, precision: NDArray[Any]) -> None:
        self.precision, self._weighted = precision, lags @ precision  # (L, P, D)
        self._products = np.einsum("apd,bqd->abpq", self._weighted, lags)

    def best(self, errors: Floats, shapes: Floats, price: Floats, most: int) -> _Set:
        """Return the best set of at most so many parts.

        Faults are like `shapes`, (N, P), or constant, or free in each row.
        """
        (rows, parts), lags = shapes.shape, len(self._weighted)
        gram, pull = np.zeros((parts, rows, parts, rows)), np.zeros((parts, rows))
        for k, a in np.ndindex(rows, lags):
            if a <= k:
                pull[:, k - a] += self._weighted[a] @ errors[k]
                for b in range(min(lags, k + 1)):
                    gram[:, k - a, :, k - b] += self._products[a, b]
        square = float(_squares(errors, self.precision).sum())
        free, sets = np.tile(np.eye(rows), (parts, 1, 1)), []
        for form in (shapes.T[:, None], np.ones((parts, 1, rows)), free):
            blocks = np.einsum("pai,piqj,qbj->paqb", form, gram, form, optimize=True)
            pulls = np.einsum("pai,pi->pa", form, pull)
            sets.append(_Search(blocks, pulls, form, price, square, errors.size).best(most))
        return max(sets, key=itemgetter(0))


class _Search(NamedTuple):
    """A search for the best set of faults, each a sum of K rows of its part's `form`, (P, K, N)."""

    gram: Floats
    pull: Floats
    form: Floats
    price: Floats
    square: float
    number: int

    def density(self, square: Any) -> Any:
        """Return Student's log density of all errors, as far as the square of their length says."""
        return -0.5 * (FREEDOM + self.number) * np.log(FREEDOM + np.maximum(square, 0.0))

    def best(self, most: int) -> _Set:
        """Return the best set, whose parts join one by one, for all sizes of faults at once.

        The columns of the Cholesky factor of the set's precision tell what is left for the others.
        """
        (parts, k), every, sizes = self.pull.shape, np.arange(len(SIZES)), SIZES[:, None, None]
        prior = np.eye(k) / sizes[..., None] ** 2
        blocks = np.einsum("pipj->pij", self.gram)[None].repeat(len(SIZES), axis=0)
        pulls, columns = np.tile(self.pull, (len(SIZES), 1, 1)), list[Floats]()
        joined, value = np.zeros((len(SIZES), parts), dtype=bool), np.zeros(len(SIZES))
        square, best_set = np.full((len(SIZES), 1), self.square), (-np.inf, every[:0], value, 1.0)
        for step in range(most + 1):
            root = np.linalg.inv(np.linalg.cholesky(blocks + prior))
            seen = (root @ pulls[..., None])[..., 0]
            squares, scales = (seen**2).sum(axis=2), np.einsum("spkk->spk", root)
            cost = self.price - np.log(scales / sizes).sum(axis=2)
            worth = self.density(square - squares) - self.density(square) - cost
            g = int(value.argmax())
            if value[g] > best_set[0]:
                best_set = float(value[g]), np.flatnonzero(joined[g]), worth[g], float(SIZES[g])
            if step == most:
                break
            part = np.where(joined, -np.inf, 0.5 * squares - cost).argmax(axis=1)
            value, square = value + worth[every, part], square - squares[every, part][:, None]
            joined[every, part] = True
            column = self.gram[:, :, part].transpose(2, 0, 1, 3)
            for earlier in columns:
                column = column - earlier @ earlier[every, part].transpose(0, 2, 1)[:, None]
            columns.append(column @ root[every, part].transpose(0, 2, 1)[:, None])
            pulls = pulls - (columns[-1] @ seen[every, part][:, None, :, None])[..., 0]
            blocks = blocks - columns[-1] @ columns[-1].transpose(0, 1, 3, 2)
        return self._judged(*best_set)

    def _judged(self, value: float, members: NDArray[Any], worth: Floats, size: float) -> _Set:
        """Return a set with what each member is worth beside the others, and its size."""
        (_, k), count, every = self.pull.shape, len(members), np.arange(len(members))
        worth, sizes = np.minimum(worth, -1e-6), np.full(len(worth), np.nan)
        precision = self.gram[members][:, :, members].reshape(count * k, count * k)
        posterior = np.linalg.inv(precision + np.eye(count * k) / size**2)
        mean = (posterior @ self.pull[members].ravel()).reshape(count, k)
        blocks = posterior.reshape(count, k, count, k)[every, :, every]
        squares = (mean * np.linalg.solve(blocks, mean[..., None])[..., 0]).sum(axis=1)
        left = self.square - (mean * self.pull[members]).sum()
        worth[members] = self.density(left) - self.density(left + squares) - self.price[members]
        worth[members] += 0.5 * np.linalg.slogdet(blocks)[1] - k * np.log(size)
        moments, form = mean[:, :, None] * mean[:, None] + blocks, self.form[members]
        sizes[members] = np.sqrt(np.einsum("mab,mai,mbi->mi", moments, form, form).mean(axis=1))
        return value, 1 / (1 + np.exp(-np.clip(worth, -50, 50))), sizes


def _some(nominal: Sequence[Trajectory]) -> list[Trajectory]:
    """Return episodes evenly, and the beginning of long ones, so that they have few rows."""
    step = max(1, round(sum(map(len, nominal)) / ROWS))
    return [x if len(x) <= ROWS else x[:ROWS] for x in nominal[::step]]


def _longest(rows: NDArray[np.float32]) -> Floats:
    """Return each sensor's longest runs of zeros, and of readings as before, (2, D)."""
    run, longest = np.zeros((2, rows.shape[1])), np.zeros((2, rows.shape[1]))
    for now, before in itertools.pairwise(rows):
        run = np.where([now == 0, now == before], run + 1, 0)
        longest = np.maximum(longest, run)
    return longest


def _squares(errors: Floats, precision: NDArray[Any]) -> Floats:
    """Return the squares of the Mahalanobis lengths of errors, (N,)."""
    return np.asarray(((errors @ precision) * errors).sum(axis=1))


def _scale(arrays: Sequence[NDArray[np.float32]]) -> FeatureScale:
    rows = np.concatenate(arrays).astype(np.float64)
    std = rows.std(axis=0)
    return FeatureScale(rows.mean(axis=0), np.where(std < CONSTANT, 1.0, std))


def _ridge(pairs: Sequence[tuple[Floats, Floats]], ridge: float) -> Floats:
    """Return the coefficients of a ridge regression, whose constant goes unpunished."""
    gram = np.sum([x.T @ x for x, _ in pairs], axis=0)
    penalty = np.full(len(gram), ridge * gram[-1, -1])
    penalty[-1] = 0.0
    return np.asarray(
        np.linalg.solve(gram + np.diag(penalty), np.sum([x.T @ y for x, y in pairs], axis=0))
    )


def _covariance(errors: Floats) -> Floats:
    """Return the scatter of errors with the weights of a Student t (Lange et al. 1989)."""
    dimensions = errors.shape[1]
    floor = FLOOR**2 * np.eye(dimensions)
    scatter = errors.T @ errors / len(errors) + floor
    for _ in range(STEPS):
        weights = (FREEDOM + dimensions) / (FREEDOM + _squares(errors, np.linalg.inv(scatter)))
        scatter = (errors * weights[:, None]).T @ errors / len(errors) + floor
    return scatter
