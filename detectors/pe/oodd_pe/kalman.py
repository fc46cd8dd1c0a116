"""A learned Kalman filter: for systems whose sensors are noisier than their dynamics.

Where sensors have noise, the latest rows say little about the state, and a forecast from them is
as noisy as they are. A filter weighs all rows so far.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from oodd_common.charts import Floats
from oodd_torch.optimizers import Adam
from torch import Tensor
from torch.nn import Parameter

from oodd_eval.plugins.state import Arrays, take
from oodd_pe.forecaster import LIMIT, Assessment, Judge, Transitions, Units
from oodd_pe.likelihood import student
from oodd_pe.statistic import deviance

WIDTH: Final = 32
"""Units of each of the two hidden layers of the correction g."""
CHUNK: Final = 100
"""Rows over which the filter runs in an update."""
SHORT: Final = 25
"""Rows in the first updates, which find the dynamics in a fraction of the time."""
SHORTLY: Final = 0.6
"""Share of the updates with these."""
DRAWN: Final = 6400
"""Rows of an update."""
UPDATES: Final = 300
"""Gradient steps."""
RATE: Final = 2e-3
"""Learning rate of the dynamics at the start; it falls to nothing as a cosine."""
NOISE_RATE: Final = 5e-2
"""Learning rate of the logarithms of the noises' variances."""
HELD_OUT: Final = 3
"""One fold of so many is not learnt from: charts are learnt from its episodes."""
ALTERNATING: Final = -0.1
"""Mean correlation of neighbouring errors of a linear forecast from which noise is looked for."""
RIDGE: Final = 1e-6
"""Penalty of the linear part to start from, relative to the mean square of standardized rows."""
SETTLED: Final = 50
"""Rows after which the gain stays as it is."""
QUIET: Final = 1e-4
"""Noise variance of the dynamics at the start, in shares of that of the sensors."""
LEAST: Final = 1e-12
"""Least variance of any noise."""
LOG_TAIL: Final = math.log(64.0)
"""Degrees of freedom of innovations, which bounds what one of them says."""


class Gains(NamedTuple):
    """Gains and innovation covariances of the first rows of an episode, of which the last stay.

    Attributes
    ----------
    gain
        What an innovation adds to the state, (T, D, D).
    root
        Lower triangular roots of the covariances of innovations, (T, D, D).
    """

    gain: Tensor
    root: Tensor


class FilterModel(torch.nn.Module):
    r"""Dynamics and noise of D sensors under A commands.

    .. math:: y_t = x_t + v_t, \quad x_{t+1} = A x_t + B a_t + c + g(x_t, a_t) + w_t

    with v and w Gaussian, of diagonal covariances R and Q, and g a network that is zero at first.
    Parameters have a first axis of length 1, as optimizers of stacked networks want it.

    Parameters
    ----------
    a, b, c
        The linear part: (D, D), (D, A), (D,).
    noise
        Variances of the sensors' noise to start from, (D,).
    seed
        Decides the network's first weights.
    """

    def __init__(self, a: Floats, b: Floats, c: Floats, noise: Floats, seed: int) -> None:
        super().__init__()
        d, commands = b.shape
        random = torch.Generator().manual_seed(seed)

        def drawn(rows: int, columns: int, inputs: int) -> Parameter:
            weights = torch.randn(rows, columns, generator=random)
            return Parameter(weights[None] / math.sqrt(max(1, inputs)))

        def single(values: Floats) -> Parameter:
            return Parameter(torch.from_numpy(np.atleast_2d(values)[None]).float())

        self.a, self.b, self.c = single(a), single(b), single(c)
        self.w1, self.v1 = (drawn(n, WIDTH, d + commands) for n in (d, commands))
        self.w2 = drawn(WIDTH, WIDTH, WIDTH)
        self.d1, self.d2 = (Parameter(torch.zeros(1, 1, WIDTH)) for _ in range(2))
        self.w3 = Parameter(torch.zeros(1, WIDTH, d))
        self.log_r, self.log_q = single(np.log(noise)), single(np.log(QUIET * noise))

    def arrays(self) -> Arrays:
        """Return parameters, gains and roots by name, in double precision."""
        vectors = {"c", "d1", "d2", "log_r", "log_q"}
        parameters = {n: p.detach()[0].double().numpy() for n, p in self.named_parameters()}
        arrays = {n: v[0] if n in vectors else v for n, v in parameters.items()}
        return arrays | {n: v.detach().numpy() for n, v in self.gains(SETTLED)._asdict().items()}

    def gains(self, rows: int) -> Gains:
        """Return the gains and roots of the first rows after the one that an episode starts from.

        The covariance follows the linear part alone, so that it is the same in every episode.
        """
        a, r, q = (v.double() for v in (self.a[0], self.log_r[0, 0].exp(), self.log_q[0, 0].exp()))
        r, q, covariance = torch.diag(r + LEAST), torch.diag(q + LEAST), torch.diag(r + LEAST)
        gains, roots = [], []
        for _ in range(min(rows, SETTLED)):
            before = a @ covariance @ a.T + q
            # Without an error where training has failed: what is not a number is not chosen.
            root = torch.linalg.cholesky_ex(before + r).L
            gain = torch.cholesky_solve(before, root).T
            covariance = before - gain @ before
            covariance = 0.5 * (covariance + covariance.T)
            gains.append(gain)
            roots.append(root)
        return Gains(torch.stack(gains), torch.stack(roots))

    def surprise(self, y: Tensor, commands: Tensor, weight: Tensor) -> Tensor:
        """Return the mean negative log likelihood of a row's sensor, less a constant.

        Parameters
        ----------
        y
            Stretches of rows, (T + 1, B, D); the first row of each is where the state starts.
        commands
            Commands after each row but the last, (T, B, A).
        weight
            How much each row but the first counts, (T, B).
        """
        gains = self.gains(len(commands))
        gain = gains.gain.float().mT
        linear, w1, w2, d2, w3 = self.a[0].T, self.w1[0], self.w2[0], self.d2[0], self.w3[0]
        driven, pushed = commands @ self.b[0].T + self.c[0], commands @ self.v1[0] + self.d1[0]
        state, innovations = y[0], []
        for t in range(len(commands)):
            hidden = torch.tanh(torch.addmm(pushed[t], state, w1))
            hidden = torch.tanh(torch.addmm(d2, hidden, w2))
            state = torch.addmm(torch.addmm(driven[t], state, linear), hidden, w3)
            innovation = y[t + 1] - state
            innovations.append(innovation)
            state = torch.addmm(state, innovation, gain[min(t, SETTLED - 1)])
        rows = torch.clamp(torch.arange(len(commands)), max=SETTLED - 1)
        errors = torch.stack(innovations).double()
        white = torch.linalg.solve_triangular(gains.root, errors.mT[: len(gains.root)], upper=False)
        late = errors[len(gains.root) :]
        if len(late):
            last = torch.linalg.solve_triangular(
                gains.root[-1], late.reshape(-1, late.shape[-1]).T, upper=False
            )
            last = last.T.reshape(late.shape).mT
            white = torch.cat([white, last])
        volume = gains.root.diagonal(dim1=1, dim2=2).log().sum(1)[rows]
        each = 0.5 * white.square().sum(1) + volume[:, None]
        mean: Tensor = (each * weight).sum() / (weight.sum() * y.shape[2])
        return mean


def fitted(pieces: Sequence[tuple[Floats, Floats]], *, updates: int = UPDATES, seed: int) -> Arrays:
    """Return the filter that is learnt from pieces of episodes: see `FilterModel.arrays`.

    Parameters
    ----------
    pieces
        Rows (T + 1, D) and the commands between them (T, A).
    updates
        Gradient steps.
    seed
        Decides first weights and stretches.
    """
    a, b, c, left = linear(pieces)
    # What a linear forecast leaves holds the noise of two rows.
    noise = np.maximum(0.5 * left, LEAST)
    model = FilterModel(a, b, c, noise, seed)
    random = np.random.default_rng([seed, 2])
    noises = Adam([model.log_r, model.log_q])
    dynamics = Adam([p for n, p in model.named_parameters() if not n.startswith("log")])
    lengths = np.array([len(commands) for _, commands in pieces])
    whole = min(CHUNK, int(lengths.max()))
    # Filled up at the end, where nothing counts.
    y = torch.from_numpy(np.concatenate([_filled(y, len(y) + whole) for y, _ in pieces])).float()
    u = torch.from_numpy(
        np.concatenate([_filled(u, len(u) + 1 + whole) for _, u in pieces])
    ).float()
    first_y = np.cumsum([0, *(lengths[:-1] + 1 + whole)])
    share = lengths / lengths.sum()
    for update in range(updates):
        rows = min(SHORT, whole) if update < SHORTLY * updates else whole
        chosen = random.choice(len(pieces), DRAWN // rows, p=share)
        start = random.integers(0, np.maximum(lengths - rows + 1, 1)[chosen])
        index = (first_y[chosen] + start) + np.arange(rows + 1)[:, None]
        weight = (np.arange(rows)[:, None] < lengths[chosen] - start).astype(np.float64)
        last = index[:-1]
        loss = model.surprise(y[index], u[last], torch.from_numpy(weight))
        loss.backward()  # type: ignore[no-untyped-call]
        decay = torch.full((1,), 0.5 * (1 + math.cos(math.pi * update / updates)))
        dynamics.step(RATE * decay)
        noises.step(NOISE_RATE * decay)
    return model.arrays()


def _filled(values: Floats, rows: int) -> Floats:
    """Return values with rows of zeros at their end, so many in all."""
    return np.concatenate([values, np.zeros((rows - len(values), values.shape[1]))])


def linear(pieces: Sequence[tuple[Floats, Floats]]) -> tuple[Floats, Floats, Floats, Floats]:
    """Return A, B, c of the least squared errors, and the mean square that is left, (D,)."""
    d, commands = pieces[0][0].shape[1], pieces[0][1].shape[1]
    gram, cross = np.zeros((d + commands + 1,) * 2), np.zeros((d + commands + 1, d))
    total, squares = 0, np.zeros(d)
    for y, u in pieces:
        x = np.concatenate([y[:-1], u, np.ones((len(u), 1))], axis=1)
        gram += x.T @ x
        cross += x.T @ (y[1:] - y[:-1])
        squares += ((y[1:] - y[:-1]) ** 2).sum(axis=0)
        total += len(u)
    slope = np.asarray(np.linalg.solve(gram + RIDGE * total * np.eye(len(gram)), cross), float)
    explained = 2.0 * slope * cross - slope * (gram @ slope)
    left = np.maximum(squares - explained.sum(axis=0), 0.0) / total
    return slope[:d].T + np.eye(d), slope[d:-1].T, slope[-1], left


def noise_shows(units: Units, pieces: Sequence[Transitions]) -> bool:
    """Return whether errors of a linear forecast alternate, as they do where sensors have noise.

    The noise of a row is in the errors of two steps, with opposite signs: without other errors
    neighbours have a correlation of -1/2 where the state changes slowly.
    """
    rows = [_rows(units, p) for p in pieces]
    a, b, c, _ = linear(rows)
    products, squares = np.zeros(len(c)), np.zeros(len(c))
    for y, commands in rows:
        errors = y[1:] - y[:-1] @ a.T - commands @ b.T - c
        products += (errors[1:] * errors[:-1]).sum(axis=0)
        squares += (errors**2).sum(axis=0)
    return bool((products / np.maximum(squares, LEAST)).mean() < ALTERNATING)


class KalmanForecaster:
    """The learned filter as a forecaster of one step; its whitened innovations are judged.

    Parameters
    ----------
    seed
        Decides first weights and the stretches of rows of each update.
    updates
        Gradient steps.
    """

    def __init__(self, *, seed: int, updates: int = UPDATES) -> None:
        self.seed, self.updates = seed, updates
        self.units_: Units
        self.arrays_: Arrays
        self.log_density_ = -math.inf

    def fit(
        self, units: Units, pieces: Sequence[Transitions], folds: Sequence[int]
    ) -> list[Assessment | None]:
        """Learn from nominal pieces: see `oodd_pe.forecaster.EpisodeForecaster.fit`.

        Every `HELD_OUT`-th fold is held out, of which the first decides how likely the filter is,
        where there are others.
        """
        self.units_ = units
        seen = [bool(fold % HELD_OUT) for fold in folds]
        training = [p for p, learnt in zip(pieces, seen, strict=True) if learnt] or list(pieces)
        self.arrays_ = fitted(
            [_rows(units, p) for p in training], updates=self.updates, seed=self.seed
        )
        judged: list[Assessment | None] = [None] * len(pieces)
        white, volumes = [], []
        for n, piece in enumerate(pieces):
            if seen[n]:
                continue
            innovations = _Running(units, self.arrays_).innovations(piece)
            judged[n] = _judgement(innovations)
            # As of the others' forecasts, which are compared with this one.
            if folds[n] == 0:
                white.append(innovations.white)
                volumes.append(innovations.log_volume)
        density = student(np.concatenate(white)).mean()
        self.log_density_ = float(density - np.concatenate(volumes).mean() / len(units.varying))
        return judged

    def begin(self) -> Judge:
        """Return what judges a new episode, from its first observation on."""
        return _Running(self.units_, self.arrays_)

    def explained(self, steps: Transitions, judged: Assessment) -> Floats:
        """Return by how much each varying sensor alone explains steps, (N, D).

        With the precision P of the innovations e it is the square of (P e)_d / sqrt(P_dd).
        """
        roots = self.arrays_["root"]
        root = roots[np.minimum(steps.known.steps, len(roots) - 1)]
        inverse = np.linalg.inv(root)
        slope = np.einsum("nkd,nk->nd", inverse, judged.residuals)
        explained: Floats = slope**2 / np.einsum("nkd,nkd->nd", inverse, inverse)
        return explained

    def arrays(self) -> Arrays:
        """Return the fit as arrays of numbers, by name."""
        return {"filter." + name: values for name, values in self.arrays_.items()}

    def restore(self, units: Units, arrays: Arrays) -> None:
        """Take over a fit; raise `FittedStateError` where the arrays are none."""
        self.units_ = units
        d = len(units.varying)
        commands = 0 if units.commands is None else len(units.commands.mean)
        zeros = np.zeros((d, d)), np.zeros((d, commands)), np.zeros(d), np.ones(d)
        like = FilterModel(*zeros, 0).arrays()
        shapes: dict[str, tuple[int | None, ...]] = {n: v.shape for n, v in like.items()}
        shapes |= {"gain": (None, d, d), "root": (None, d, d)}
        self.arrays_ = {n: take(arrays, "filter." + n, shape) for n, shape in shapes.items()}


def _rows(units: Units, steps: Transitions) -> tuple[Floats, Floats]:
    """Return the rows of a piece, (T + 1, D), and the commands between them, (T, A)."""
    rows = np.concatenate([steps.before[:1], steps.now])
    return _standard(units, rows), _commands(units, steps)


def _standard(units: Units, observations: NDArray[np.float32]) -> Floats:
    z = (observations.astype(np.float64) - units.sensors.mean) / units.sensors.std
    clipped: Floats = np.clip(z[:, units.varying], -LIMIT, LIMIT)
    return clipped


def _commands(units: Units, steps: Transitions) -> Floats:
    if units.commands is None or steps.known.actions is None:
        return np.zeros((len(steps.now), 0))
    scaled: Floats = (steps.known.actions[:, 0] - units.commands.mean) / units.commands.std
    return scaled


class Innovations(NamedTuple):
    """Innovations of N rows: differences from what the filter expected of them.

    Attributes
    ----------
    white
        Innovations, uncorrelated and of unit variance in nominal operation, (N, D).
    states
        Forecasts of the rows, in training standard deviations, (N, D).
    log_volume
        Logarithms of the determinants of the roots by which innovations were divided, (N,).
    """

    white: Floats
    states: Floats
    log_volume: Floats


class _Running:
    """The filter over one episode: each call continues where the last one ended."""

    def __init__(self, units: Units, arrays: Arrays) -> None:
        self._units, self._arrays = units, arrays
        self._inverse = np.linalg.inv(arrays["root"])
        diagonals = np.diagonal(arrays["root"], axis1=1, axis2=2)
        self._log_volume = np.log(diagonals).sum(axis=1)
        self._state: Floats | None = None
        self._row = 0

    def __call__(self, steps: Transitions) -> Assessment:
        """Judge the next steps."""
        return _judgement(self.innovations(steps))

    def innovations(self, steps: Transitions) -> Innovations:
        """Run over the next steps."""
        p, last = self._arrays, len(self._inverse) - 1
        y, commands = _standard(self._units, steps.now), _commands(self._units, steps)
        state = self._state
        if state is None:
            state = _standard(self._units, steps.before[:1])[0]
        first, self._row = self._row, self._row + len(y)
        white, states = np.empty_like(y), np.empty_like(y)
        for t, (row, command) in enumerate(zip(y, commands, strict=True)):
            hidden = np.tanh(state @ p["w1"] + command @ p["v1"] + p["d1"])
            hidden = np.tanh(hidden @ p["w2"] + p["d2"])
            states[t] = p["a"] @ state + p["b"] @ command + p["c"] + hidden @ p["w3"]
            at, innovation = min(first + t, last), row - states[t]
            white[t] = self._inverse[at] @ innovation
            state = np.clip(states[t] + p["gain"][at] @ innovation, -LIMIT, LIMIT)
        self._state = state
        rows = np.minimum(first + np.arange(len(y)), last)
        return Innovations(white, states, self._log_volume[rows])


def _judgement(innovations: Innovations) -> Assessment:
    """Return residuals, and for the tails by which they are scaled, how far out the state is.

    Far from the middle of the training rows the dynamics are less well known.
    """
    white, states, _ = innovations
    return Assessment(
        deviance(white, np.full_like(white, LOG_TAIL)), 0.5 * np.log1p(states * states)
    )
