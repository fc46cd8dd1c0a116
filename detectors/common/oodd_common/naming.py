"""Which parts are at fault, named as a set: sensors and actuators, by the evidence of sets.

A fault of a sensor is a reading that is its state and something else. It shows in the row itself,
and in the forecasts of the next rows, which are made from it: so a faulty sensor is told from
neighbours whose forecasts it spoils.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from oodd_common.charts import Floats
from oodd_common.windows import StandardEpisode, regressors
from oodd_eval import Naming, Trajectory
from oodd_eval.plugins.forecasting import CONSTANT, FeatureScale
from oodd_eval.plugins.state import Arrays, take

ORDER: Final = 2
"""Latest rows, and commands, that a forecast uses."""
RIDGE: Final = 1e-4
"""Penalty of the forecast, relative to the mean square of a standardized sensor."""
FOLDS: Final = 5
"""Parts of the episodes, each forecast by what was fitted on the others."""
FLOOR: Final = 3e-3
"""Least standard deviation of a forecast's error, in training standard deviations."""
FREEDOM: Final = 4.0
"""Degrees of freedom of the errors' Student t distribution: contacts make their tails heavy."""
STEPS: Final = 10
"""Steps in which the errors' covariance is found."""
WINDOW: Final = 6
"""Rows from the onset on that a naming looks at."""
SIZES: Final = np.array([0.03, 0.1, 0.3, 1.0, 3.0])
"""Sizes of faults that are tried, in training standard deviations."""
LARGEST: Final = 0.4
"""Largest share of the sensors that is named as a set."""
LEAST: Final = 2.0
"""Least evidence, in natural logarithms, for which a further sensor is named."""
SHARE: Final = 0.4
"""Price of a sensor as a share of the 99 % quantile of its evidence in nominal windows."""
DISTINCT: Final = 8
"""A sensor with as few values in training is never named: it tells contacts or modes."""
STEP: Final = 2.0
"""Limit of the logarithm of a row's error in the CUSUM that finds the onset."""
NOMINAL: Final = 400
"""Nominal windows that prices are learnt from, at most."""
NEVER: Final = 1e9
"""Price of a sensor that is never named."""


@dataclass(frozen=True, slots=True, eq=False)
class ReadingModel:
    """How readings follow from the two rows, and commands, before them in nominal operation.

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
        return cls.with_errors(nominal)[0]

    @classmethod
    def with_errors(cls, nominal: Sequence[Trajectory]) -> tuple[Self, list[Floats]]:
        """Return a fit, and the errors of forecasts that were fitted to other episodes, (T, D)."""
        sensors, actions = (
            _scale([x.observations for x in nominal]),
            _scale([x.actions for x in nominal]),
        )
        bare = cls(sensors, actions, np.empty((0, 0)), np.empty((0, 0)))
        pairs = [(bare.regressors(x), bare.standard(x)[1:]) for x in nominal]
        fits = [
            _ridge([pair for j, pair in enumerate(pairs) if j % FOLDS != i] or pairs)
            for i in range(min(FOLDS, len(pairs)))
        ]
        errors = [y - x @ fits[i % FOLDS] for i, (x, y) in enumerate(pairs)]
        return cls(sensors, actions, _ridge(pairs), _covariance(np.concatenate(errors))), errors

    def standard(self, x: Trajectory) -> Floats:
        """Return the standardized rows of an episode, (T + 1, D)."""
        standard: Floats = (x.observations - self.sensors.mean) / self.sensors.std
        return standard

    def regressors(self, x: Trajectory) -> Floats:
        """Return what forecasts of the rows 1 to T are made of, (T, K)."""
        commands = (x.actions - self.actions.mean) / self.actions.std
        if not len(self.actions.mean):
            commands = np.empty((x.transitions, 0))
        return regressors(StandardEpisode(self.standard(x), commands), 1, ORDER)

    def errors(self, x: Trajectory) -> Floats:
        """Return the errors of the forecasts of the rows 1 to T, standardized: (T, D)."""
        errors: Floats = self.standard(x)[1:] - self.regressors(x) @ self.coefficients
        return errors


@dataclass(frozen=True, eq=False)
class PartNamer:
    """Names the parts at fault as a set, by the evidence of sets in the errors of forecasts.

    A reading is the state and, of faulty sensors, something more, f. The error of a row is then the
    nominal one, plus f, minus what the f of the two rows before brought into the forecast. The
    evidence of a set is the density of the errors of some rows with normal f, divided by that
    without a fault. Parts join the set as long as they are worth their price.

    Attributes
    ----------
    model
        How readings follow from earlier ones in nominal operation.
    price : float64 array of shape (D + A,)
        Evidence, in natural logarithms, for which a sensor or actuator is named; `NEVER` for
        sensors that have few values.
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
        model, errors = ReadingModel.with_errors(nominal)
        values = [len(np.unique(x)) for x in np.concatenate([x.observations for x in nominal]).T]
        runs = np.max([_longest(x.observations) for x in nominal], axis=0)
        precision = np.linalg.inv(model.covariance)
        rows = np.concatenate(errors)
        lengths = np.sqrt(((rows @ precision) * rows).sum(axis=1))
        d, a = len(values), len(model.actions.mean)
        free = cls(model, np.zeros(d + a), runs, float(np.quantile(lengths, 0.9)) or 1.0)
        windows = [
            (e[i : i + n], shapes[:, i : i + n])
            for e, x in zip(errors, nominal, strict=True)
            for shapes in [free.shapes(x)]
            for i, n in zip(range(0, len(e), WINDOW), itertools.cycle([1, WINDOW]))
        ]
        gains = [free.alone(*w) for w in windows[:: -(-len(windows) // NOMINAL)]]
        price = np.maximum(LEAST, SHARE * np.quantile(gains, 0.99, axis=0))
        price[:d][np.array(values) <= DISTINCT] = NEVER
        return cls(model, price, runs, free.reference)

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
        model = self.model
        return {
            "naming_sensors": np.stack([model.sensors.mean, model.sensors.std]),
            "naming_actions": np.stack([model.actions.mean, model.actions.std]),
            "naming_coefficients": model.coefficients,
            "naming_covariance": model.covariance,
            "naming_price": self.price,
            "naming_runs": self.runs,
            "naming_reference": np.array([self.reference]),
        }

    @classmethod
    def of(cls, arrays: Arrays) -> Self:
        """Return the fit among saved arrays; `FittedStateError` where there is none."""
        sensors = FeatureScale.of(arrays, "naming_sensors")
        actions = FeatureScale.of(arrays, "naming_actions")
        d, a = len(sensors.mean), len(actions.mean)
        coefficients = take(arrays, "naming_coefficients", (ORDER * (d + a) + 1, d))
        covariance = take(arrays, "naming_covariance", (d, d))
        reference = take(arrays, "naming_reference", (1,), "+")
        return cls(
            ReadingModel(sensors, actions, coefficients, covariance),
            take(arrays, "naming_price", (d + a,)),
            take(arrays, "naming_runs", (2, d)),
            float(reference[0]),
        )

    @cached_property
    def precision(self) -> Floats:
        """Inverse of the covariance of one row's errors, (D, D)."""
        return np.asarray(np.linalg.inv(self.model.covariance))

    @cached_property
    def evidence(self) -> tuple[_Evidence, _Evidence]:
        """Evidence of faulty sensors, and of faulty actuators."""
        d, a = len(self.model.sensors.mean), len(self.model.actions.mean)
        readings = self.model.coefficients[: ORDER * d].reshape(ORDER, d, d)
        commands = self.model.coefficients[ORDER * d : -1].reshape(ORDER, a, d)
        lags = np.concatenate([np.eye(d)[None], -readings]).transpose(0, 2, 1)
        sensors = _Evidence(lags, self.precision)
        return sensors, _Evidence(commands.transpose(0, 2, 1), self.precision)

    def shapes(self, x: Trajectory) -> Floats:
        """Return readings and commands about 0, in their standard deviations, (D + A, T)."""
        readings = x.observations[1:] / self.model.sensors.std
        return np.concatenate([readings, x.actions / self.model.actions.std], axis=1).T

    def alone(self, errors: Floats, shapes: Floats) -> Floats:
        """Return the evidence of each part alone in some rows, (D + A,)."""
        d = errors.shape[1]
        parts = zip(self.evidence, (shapes[:d], shapes[d:]), strict=True)
        return np.concatenate([e.alone(errors, shape) for e, shape in parts])


class LiveNaming:
    """Names the parts at fault of one live episode, row by row; made by `PartNamer.begin`."""

    def __init__(self, namer: PartNamer, since: int) -> None:
        self._namer, self._since, self._t = namer, since, -1
        self._runs = np.zeros_like(namer.runs)
        self._sum, self._onset = 0.0, 0
        self._errors: list[Floats] = []
        self._shapes: list[Floats] = []

    def update(self, row: NDArray[Any], action: NDArray[Any] | None = None) -> None:
        """Take the next row, (D,), and the action commanded since the one before, (A,)."""
        model = self._namer.model
        self._t += 1
        values = np.asarray(row, dtype=np.float64)
        standard = (values - model.sensors.mean) / model.sensors.std
        if not self._t:
            self._last, self._runs[0] = values, values == 0
            self._rows = [standard] * ORDER
            self._commands = [np.zeros(len(model.actions.mean))] * ORDER
            return
        command = np.asarray(action, dtype=np.float64) if len(model.actions.mean) else np.empty(0)
        self._commands = [(command - model.actions.mean) / model.actions.std, *self._commands[:-1]]
        self._runs = np.where([values == 0, values == self._last], self._runs + 1, 0)
        error = (
            standard - np.concatenate([*self._rows, *self._commands, [1.0]]) @ model.coefficients
        )
        self._follow(
            error, np.concatenate([values / model.sensors.std, command / model.actions.std])
        )
        self._last, self._rows = values, [standard, *self._rows[:-1]]

    def _follow(self, error: Floats, shape: Floats) -> None:
        """Find the onset with a CUSUM, and keep the first rows from there on."""
        length = np.sqrt(error @ self._namer.precision @ error) / self._namer.reference
        if self._sum <= 0 or self._t <= self._since:
            self._sum, self._onset, self._errors, self._shapes = 0.0, self._t, [], []
        self._sum += float(np.clip(np.log(np.maximum(length, 1e-9)), -STEP, STEP))
        if len(self._errors) < WINDOW:
            self._errors.append(error)
            self._shapes.append(shape)

    def name(self) -> tuple[Naming, int]:
        """Name the parts at fault as seen at the latest row, and the onset."""
        namer, (d, a) = self._namer, (len(self._namer.runs[0]), len(self._namer.model.actions.mean))
        sensors, actuators, sizes = np.zeros(d), np.zeros(a), np.full(d, np.nan)
        silent = (self._runs > namer.runs + np.array([[0], [1]])).any(axis=0) & (
            namer.price[:d] < NEVER
        )
        if silent.any():
            sensors[silent], sizes[silent] = 1.0, np.inf
            return Naming(sensors, actuators, sizes, "sensor"), self._onset
        if not self._errors:
            return Naming(sensors, actuators, sizes), self._onset
        errors, shapes = np.stack(self._errors), np.stack(self._shapes, axis=1)
        readings, commands = namer.evidence
        most = max(1, int(LARGEST * d))
        of_sensors = readings.best(errors, shapes[:d], namer.price[:d], most)
        of_actuators = commands.best(errors, shapes[d:], namer.price[d:], min(a, 1))
        if of_sensors.value <= 0 and of_actuators.value <= 0:
            return Naming(sensors, actuators, sizes, "body"), self._onset
        if of_actuators.value > of_sensors.value:
            return Naming(sensors, of_actuators.probability, sizes, "actuator"), self._onset
        sizes = of_sensors.sizes * namer.model.sensors.std
        return Naming(of_sensors.probability, actuators, sizes, "sensor"), self._onset


class _Set(NamedTuple):
    """The best set: its evidence beyond prices, and of each part probability and size, (P,)."""

    value: float
    probability: Floats
    sizes: Floats


class _Evidence:
    """Evidence of sets of parts in the errors of some rows.

    A fault of size 1 in part p at row t adds ``lags[a, :, p]`` to the error of row t + a.
    """

    def __init__(self, lags: Floats, precision: Floats) -> None:
        self._weighted = lags.transpose(0, 2, 1) @ precision  # (L, P, D)
        self._products = np.einsum("apd,bdq->abpq", self._weighted, lags)

    def _problems(self, errors: Floats, shape: Floats) -> Iterator[tuple[Floats, Floats]]:
        """Yield H'Q⁻¹H and H'Q⁻¹r of faults that are like `shape`, constant, and free."""
        rows, parts = len(errors), len(shape)
        gram, pull = np.zeros((parts, rows, parts, rows)), np.zeros((parts, rows))
        for k, a in np.ndindex(rows, len(self._weighted)):
            if k >= a:
                pull[:, k - a] += self._weighted[a] @ errors[k]
                for b in range(min(len(self._weighted), k + 1)):
                    gram[:, k - a, :, k - b] += self._products[a, b]
        for form in (shape, np.ones_like(shape)):
            small = np.einsum("piqj,pi,qj->pq", gram, form, form, optimize=True)
            yield small[:, None, :, None], (form * pull).sum(axis=1)[:, None]
        if rows > 1:
            yield gram, pull

    def alone(self, errors: Floats, shape: Floats) -> Floats:
        """Return the evidence of each part alone, (P,)."""
        values = [_worth(_own_blocks(g), p[None]) for g, p in self._problems(errors, shape)]
        best: Floats = np.max([value.max(axis=0) for value in values], axis=0)
        return best

    def best(self, errors: Floats, shape: Floats, price: Floats, most: int) -> _Set:
        """Return the best set of at most so many parts."""
        none = _Set(0.0, np.zeros(len(price)), np.full(len(price), np.nan))
        sets = (_search(g, p, price, most) for g, p in self._problems(errors, shape) if most)
        return max([none, *sets], key=lambda found: found.value)


def _own_blocks(gram: Floats) -> Floats:
    """Return the blocks of the parts themselves for all sizes, (S, P, K, K)."""
    every = np.arange(len(gram))
    return np.tile(gram[every, :, every], (len(SIZES), 1, 1, 1))


def _worth(blocks: Floats, pulls: Floats) -> Floats:
    """Return the evidence of each part for each size, (S, P), of blocks and pulls (S, P, K)."""
    k = pulls.shape[-1]
    precision = blocks + np.eye(k) / SIZES[:, None, None, None] ** 2
    squares = (
        pulls * np.linalg.solve(precision, pulls[..., None] + 0 * blocks[..., :1])[..., 0]
    ).sum(-1)
    spread = np.linalg.slogdet(precision)[1] + 2 * k * np.log(SIZES)[:, None]
    return np.asarray(0.5 * (squares - spread))


def _search(gram: Floats, pull: Floats, price: Floats, most: int) -> _Set:
    """Return the best set, whose parts join one by one, for all sizes of faults at once.

    The columns of the Cholesky factor of the set's precision tell what is left for the others.
    """
    every, blocks = np.arange(len(SIZES)), _own_blocks(gram)
    pulls, columns = np.tile(pull, (len(SIZES), 1, 1)), np.empty((0, *blocks.shape))
    joined, value = np.zeros(pulls.shape[:2], dtype=bool), np.zeros(len(SIZES))
    for step in range(most + 1):
        worth = _worth(blocks, pulls) - price
        net = np.where(joined, -np.inf, worth)
        part = net.argmax(axis=1)
        grows = net[every, part] > 0
        if step == most or not grows.any():
            break
        value += np.where(grows, net[every, part], 0.0)
        joined[every, part] |= grows
        precision = blocks[every, part] + np.eye(pull.shape[1]) / SIZES[:, None, None] ** 2
        root = np.linalg.inv(np.linalg.cholesky(precision)) * grows[:, None, None]
        column = gram[:, :, part].transpose(2, 0, 1, 3)
        for earlier in columns:
            column = column - earlier @ earlier[every, part].transpose(0, 2, 1)[:, None]
        column = column @ root.transpose(0, 2, 1)[:, None]
        pulls = pulls - (column @ (root @ pulls[every, part][..., None])[:, None])[..., 0]
        blocks = blocks - column @ column.transpose(0, 1, 3, 2)
        columns = np.concatenate([columns, column[None]])
    g = int(value.argmax())
    return _judged(gram, pull, price, worth[g], joined[g], g, float(value[g]))


def _judged(
    gram: Floats,
    pull: Floats,
    price: Floats,
    worth: Floats,
    joined: NDArray[np.bool_],
    g: int,
    value: float,
) -> _Set:
    """Return a set with what each part is worth beside the others, and the sizes of its faults."""
    members, sizes, k = np.flatnonzero(joined), np.full(len(pull), np.nan), pull.shape[1]
    worth = np.minimum(worth, -1e-6)
    if len(members):
        precision = gram[members][:, :, members].reshape(len(members) * k, -1)
        posterior = np.linalg.inv(precision + np.eye(len(precision)) / SIZES[g] ** 2)
        mean = (posterior @ pull[members].ravel()).reshape(-1, k)
        blocks = posterior.reshape(len(members), k, len(members), k)
        blocks = blocks[np.arange(len(members)), :, np.arange(len(members))]
        squares = (mean * np.linalg.solve(blocks, mean[..., None])[..., 0]).sum(axis=1)
        spread = np.linalg.slogdet(blocks)[1] - 2 * k * np.log(SIZES[g])
        worth[members] = 0.5 * (squares + spread) - price[members]
        sizes[members] = np.sqrt((mean**2 + np.einsum("mkk->mk", blocks)).mean(axis=1))
    return _Set(value, 1 / (1 + np.exp(-np.clip(worth, -50, 50))), sizes)


def _longest(rows: NDArray[np.float32]) -> Floats:
    """Return each sensor's longest runs of zeros, and of readings as before, (2, D)."""
    run, longest = np.zeros((2, rows.shape[1])), np.zeros((2, rows.shape[1]))
    for now, before in zip(rows, [rows[0] + 1, *rows[:-1]], strict=True):
        run = np.where([now == 0, now == before], run + 1, 0)
        longest = np.maximum(longest, run)
    return longest


def _scale(arrays: Sequence[NDArray[np.float32]]) -> FeatureScale:
    rows = np.concatenate(arrays).astype(np.float64)
    std = rows.std(axis=0)
    return FeatureScale(rows.mean(axis=0), np.where(std < CONSTANT, 1.0, std))


def _ridge(pairs: Sequence[tuple[Floats, Floats]]) -> Floats:
    """Return the coefficients of a ridge regression, whose constant goes unpunished."""
    gram = np.sum([x.T @ x for x, _ in pairs], axis=0)
    penalty = np.full(len(gram), RIDGE * gram[-1, -1])
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
        lengths = np.einsum("nd,de,ne->n", errors, np.linalg.inv(scatter), errors)
        weights = (FREEDOM + dimensions) / (FREEDOM + lengths)
        scatter = (errors * weights[:, None]).T @ errors / len(errors) + floor
    return scatter
