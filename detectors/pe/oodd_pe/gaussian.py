"""Exact Gaussian processes, one a sensor, for systems whose next row follows without noise.

A network's error has a floor; that of a Gaussian process falls as long as rows are added, and its
standard deviation says how far a row is from those that it has seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from oodd_common.charts import Floats
from torch import Tensor

from oodd_eval.plugins.forecasting import CONSTANT
from oodd_eval.plugins.state import Arrays, take
from oodd_pe.forecaster import LIMIT, Assessment, Judge, Transitions, Units
from oodd_pe.likelihood import student
from oodd_pe.statistic import deviance

TUNED: Final = 500
"""Rows on which lengths, signal and noise are found."""
ROWS: Final = 3000
"""Most rows on which forecasts rest: their matrix takes n^2 numbers."""
WORK: Final = 6 * ROWS**3
"""Most operations, in cubes of rows of all sensors: fewer rows are used where there are many."""
LANDMARKS: Final = 500
"""Most rows from which the standard deviation is computed: n^2 operations a row that is scored."""
STEPS: Final = 50
"""Most evaluations of the likelihood in the search for lengths, signal and noise of a sensor."""
SHARPER: Final = 100.0
"""The noise variance is divided by this once the lengths are known.

What few rows cannot explain looks like noise; ever more rows explain it.
"""
SEARCHED: Final = 1e-9
"""Noise variance that the search adds, in shares of the signal's, to stay where matrices invert."""
LEAST_NOISE: Final = 1e-11
"""Least noise variance afterwards, in shares of the signal's."""
SETTLED: Final = 3e-4
"""The search ends where a step gains less than this in a row's log likelihood."""
UNLIKELY: Final = 1e6
"""Surprise that the search is told where covariances cannot be inverted."""
PRIOR: Final = 0.1
"""Pull of the logarithms of lengths towards the start, so that those of unused inputs end."""
JUDGED: Final = 20_000
"""Most rows that are looked at in a fit: first pieces, which are in random order."""
RIDGE: Final = 1e-6
"""Penalty of the linear forecast, relative to the mean squared change of standardized sensors."""
HOPELESS: Final = 1.0
"""Least log likelihood of a row of every sensor, in units of what the linear forecast leaves.

Where the few rows on which lengths are found leave more than a fifth of that, there is noise, or
there are jumps, and more rows do not help.
"""
LOG_TAIL: Final = math.log(64.0)
"""Degrees of freedom of residuals, which bounds what one of them says."""
BLOCK: Final = 8
"""Rows that are forecast together, filled up with zeros where there are fewer.

Small variances are differences of large numbers, whose last bits depend on the shape of a product.
"""


class Kernel(NamedTuple):
    """A squared exponential of I inputs, each with a length of its own, and noise.

    Attributes
    ----------
    lengths
        How far an input must move to matter, (I,).
    signal, noise
        Variances of the function and of what is added to it.
    """

    lengths: Floats
    signal: float
    noise: float

    def __call__(self, a: Floats, b: Floats) -> Floats:
        """Return covariances of the function at rows (N, I) and (K, I): (N, K)."""
        a, b = a / self.lengths, b / self.lengths
        squares = (a * a).sum(axis=1)[:, None] + (b * b).sum(axis=1)
        squares -= 2.0 * (a @ b.T)
        np.maximum(squares, 0.0, out=squares)
        squares *= -0.5
        np.exp(squares, out=squares)
        squares *= self.signal
        covariances: Floats = squares
        return covariances


def surprise(theta: Floats, x: Floats, y: Floats) -> tuple[float, Floats]:
    r"""Return a row's mean negative log likelihood, less a constant, and its gradient.

    With :math:`K = k(x, x) + \sigma^2 I` and :math:`\alpha = K^{-1} y` they are
    :math:`(y^\top \alpha + \log |K|) / 2n` and
    :math:`\operatorname{tr}((K^{-1} - \alpha \alpha^\top) \, \partial K) / 2n`
    (Rasmussen & Williams 2006, 5.8 and 5.9).

    Parameters
    ----------
    theta
        Logarithms of lengths, signal and noise variance, (I + 2,).
    x, y
        Inputs (N, I) and one sensor's outcomes, (N,).
    """
    n = len(x)
    lengths, (signal, noise) = np.exp(theta[:-2]), np.exp(theta[-2:])
    noise += SEARCHED * signal
    covariance = Kernel(lengths, signal, noise)(x, x)
    root, failed = torch.linalg.cholesky_ex(torch.from_numpy(covariance + noise * np.eye(n)))
    if failed:
        return math.inf, np.zeros_like(theta)
    inverse = torch.cholesky_inverse(root).numpy()
    alpha = inverse @ y
    value = 0.5 * float(y @ alpha) + float(root.diagonal().log().sum())
    slope = inverse - np.outer(alpha, alpha)
    at_noise = np.trace(slope)
    weighted = slope * covariance
    scaled = x / lengths
    pairs = (scaled**2).T @ weighted.sum(axis=1) - (scaled * (weighted @ scaled)).sum(axis=0)
    at_signal = weighted.sum() + SEARCHED * signal * at_noise
    at_noise *= math.exp(theta[-1])
    gradient: Floats = np.concatenate([pairs, [0.5 * at_signal, 0.5 * at_noise]])
    return value / n, gradient / n


def tuned(x: Floats, y: Floats, steps: int = STEPS) -> tuple[Kernel, float]:
    """Return the likeliest kernel of inputs (N, I) and outcomes (N,), and a row's likelihood.

    The latter is the logarithm of the marginal likelihood, over N.
    """
    inputs = x.shape[1]
    start = np.concatenate([np.full(inputs, 0.5 * math.log(max(1, inputs))), [0.0, math.log(1e-4)]])
    theta = torch.from_numpy(start.copy()).requires_grad_(True)
    search = torch.optim.LBFGS(
        [theta],
        max_iter=steps,
        max_eval=steps,
        history_size=20,
        line_search_fn="strong_wolfe",
        tolerance_change=SETTLED,
    )
    best: tuple[float, Floats] = (math.inf, start)

    def value() -> Tensor:
        nonlocal best
        at = theta.detach().numpy().copy()
        loss, gradient = surprise(at, x, y)
        pulled = at[:inputs] - start[:inputs]
        loss += PRIOR * float(pulled @ pulled) / (2 * len(x))
        gradient[:inputs] += PRIOR * pulled / len(x)
        theta.grad = torch.from_numpy(gradient)
        if loss < best[0]:
            best = loss, at
        return torch.tensor(loss if math.isfinite(loss) else UNLIKELY)

    search.step(value)  # type: ignore[no-untyped-call]
    chosen = np.exp(best[1])
    likelihood = -surprise(best[1], x, y)[0] - 0.5 * math.log(2 * math.pi)
    return Kernel(chosen[:inputs], float(chosen[-2]), float(chosen[-1])), likelihood


def solved(kernel: Kernel, x: Floats, y: Floats) -> tuple[Kernel, Floats, Floats]:
    """Return the weights of outcomes (n,) at rows (n, I), and the inverse of their covariances.

    The kernel that comes first has the noise that was needed to solve for them, at least its own.
    """
    covariance = kernel(x, x)
    while True:
        matrix = torch.from_numpy(covariance + kernel.noise * np.eye(len(x)))
        root, failed = torch.linalg.cholesky_ex(matrix)
        if not failed:
            break
        kernel = kernel._replace(noise=10.0 * kernel.noise)
    weights = torch.cholesky_solve(torch.from_numpy(y)[:, None], root)[:, 0]
    return kernel, weights.numpy(), torch.cholesky_inverse(root).numpy()


def without(inverse: Floats, weights: Floats, rows: NDArray[np.int64]) -> Floats:
    """Return the weights of a fit without some of the rows, whose weights are then 0: (n,).

    By blocks of the inverse, so that nothing is fitted again (Rasmussen & Williams 2006, 5.4.2).

    Parameters
    ----------
    inverse
        Inverse of the covariances of all rows, (n, n).
    weights
        Weights of the fit on all of them, (n,).
    rows
        Numbers of the rows that are left out.
    """
    if not len(rows):
        return weights
    block = inverse[np.ix_(rows, rows)]
    left: Floats = weights - inverse[:, rows] @ np.linalg.solve(block, weights[rows])
    left[rows] = 0.0
    return left


def landmarks(kernel: Kernel, x: Floats, count: int = LANDMARKS) -> NDArray[np.int64]:
    """Return rows of which each was the least certain given those before it, (m,).

    They are the pivots of a Cholesky decomposition of the covariances of rows (n, I).
    """
    count = min(count, len(x))
    variance, factor = np.full(len(x), kernel.signal), np.empty((count, len(x)))
    pivots: list[int] = []
    while len(pivots) < count:
        n, pivot = len(pivots), int(variance.argmax())
        if n and variance[pivot] <= kernel.noise:
            break
        column = kernel(x[pivot : pivot + 1], x)[0] - factor[:n, pivot] @ factor[:n]
        factor[n] = column / math.sqrt(variance[pivot])
        variance -= factor[n] ** 2
        variance[pivot] = 0.0
        pivots.append(pivot)
    return np.array(pivots, np.int64)


def root_of(kernel: Kernel, x: Floats) -> Floats:
    """Return the matrix M for which rows (m, I) leave the variance signal - |k M|^2: (m, m)."""
    covariance, noise = kernel(x, x), kernel.noise
    while True:
        matrix = torch.from_numpy(covariance + noise * np.eye(len(x)))
        lower, failed = torch.linalg.cholesky_ex(matrix)
        if not failed:
            break
        noise *= 10.0
    inverse = torch.linalg.solve_triangular(
        lower, torch.eye(len(x), dtype=torch.float64), upper=False
    )
    return np.ascontiguousarray(inverse.numpy().T)


class Process(NamedTuple):
    """The Gaussian process of one sensor, given n rows.

    Attributes
    ----------
    kernel
        Its covariances.
    weights
        Weights of the covariances with the rows in a forecast, (n,).
    marks
        Numbers of the rows from which the standard deviation is computed, (m,).
    root
        See `root_of`, of these rows, (m, m).
    """

    kernel: Kernel
    weights: Floats
    marks: NDArray[np.int64]
    root: Floats

    def __call__(self, rows: Floats, x: Floats) -> tuple[Floats, Floats]:
        """Return means and log standard deviations at inputs (N, I), from the rows (n, I)."""
        covariance = self.kernel(x, rows)
        known = covariance[:, self.marks] @ self.root
        variance = self.kernel.signal + self.kernel.noise - (known * known).sum(axis=1)
        return covariance @ self.weights, 0.5 * np.log(np.maximum(variance, self.kernel.noise))


class GaussianForecaster:
    """A ridge regression, and an exact Gaussian process a sensor for what it leaves.

    Parameters
    ----------
    seed
        Draws the rows that decide the lengths, and the rows that are kept if there are many.
    """

    def __init__(self, *, seed: int) -> None:
        self.seed = seed
        self.units_: Units
        self.kernels_: list[Kernel] = []
        self.processes_: list[Process]
        self.log_density_ = -math.inf

    def tune(self, units: Units, pieces: Sequence[Transitions]) -> bool:
        """Find lengths, signals and noises; return whether an exact forecast is worth its cost.

        Inputs are the newest row, or the whole window, whichever makes the outcomes likelier.
        """
        self.units_, self.kernels_ = units, []
        pieces = pieces[: _within(pieces)]
        changes = np.concatenate([self._changes(p) for p in pieces])
        wide = np.concatenate([units.inputs(p.known) for p in pieces])
        random = np.random.default_rng([self.seed, 3])
        sample = np.sort(random.permutation(len(wide))[:TUNED])
        best, chosen = -math.inf, self._columns()[0]
        for columns in self._columns():
            self.columns_: NDArray[np.int64] = columns
            self._regress(wide, changes)
            x, y = self._posed(wide[sample], changes[sample])
            kernels: list[Kernel] = []
            likelihoods: list[float] = []
            for outcomes in y.T:
                kernel, likelihood = tuned(x, outcomes)
                if likelihood < HOPELESS:
                    break
                kernels.append(kernel)
                likelihoods.append(likelihood - math.log(self.error_scale_[len(likelihoods)]))
            if len(kernels) == y.shape[1] > 0 and sum(likelihoods) > best:
                best, self.kernels_, chosen = sum(likelihoods), kernels, columns
        if not self.kernels_:
            return False
        self.columns_ = chosen
        self._regress(wide, changes)
        return True

    def fit(
        self, units: Units, pieces: Sequence[Transitions], folds: Sequence[int]
    ) -> list[Assessment | None]:
        """Learn from nominal pieces: see `oodd_pe.forecaster.EpisodeForecaster.fit`.

        Each piece is judged by a fit on all the others, whatever its fold.
        """
        if not self.kernels_:
            self.tune(units, pieces)
        total, pieces = len(pieces), pieces[: _within(pieces)]
        posed = [self._posed_steps(p) for p in pieces]
        lengths = [len(x) for x, _ in posed]
        x, y = (np.concatenate(parts) for parts in zip(*posed, strict=True))
        most = min(ROWS, int((WORK / max(1, y.shape[1])) ** (1 / 3)))
        random = np.random.default_rng([self.seed, 4])
        kept = np.sort(random.permutation(len(x))[:most])
        of_row = np.repeat(np.arange(len(pieces)), lengths)
        self.rows_, self.processes_ = x[kept], []
        errors, log_deviations = np.empty_like(y), np.empty_like(y)
        for sensor, searched in enumerate(self.kernels_):
            noise = max(searched.noise / SHARPER, LEAST_NOISE * searched.signal)
            kernel, weights, inverse = solved(
                searched._replace(noise=noise), self.rows_, y[kept, sensor]
            )
            marks = landmarks(kernel, self.rows_)
            root = root_of(kernel, self.rows_[marks])
            self.processes_.append(Process(kernel, weights, marks, root))
            for piece in range(len(pieces)):
                rows, left_out = np.flatnonzero(of_row == piece), of_row[kept] == piece
                seen = marks[~left_out[marks]]
                process = Process(
                    kernel,
                    without(inverse, weights, np.flatnonzero(left_out)),
                    seen,
                    root_of(kernel, self.rows_[seen]),
                )
                mean, log_deviations[rows, sensor] = process(self.rows_, x[rows])
                errors[rows, sensor] = y[rows, sensor] - mean
        scaled = errors / np.exp(log_deviations)
        held_out = np.asarray(folds)[of_row] == 0
        density = student(scaled) - log_deviations - np.log(self.error_scale_)
        self.log_density_ = float(density[held_out].mean())
        every, ends = _judgement(scaled, log_deviations), np.cumsum(lengths)
        judged = [every.rows(slice(end - n, end)) for end, n in zip(ends, lengths, strict=True)]
        return [*judged, *[None] * (total - len(judged))]

    def begin(self) -> Judge:
        """Return what judges a new episode: forecasts need no memory beyond their window."""
        return self._judged

    def explained(self, steps: Transitions, judged: Assessment) -> Floats:  # noqa: ARG002
        """Return by how much each varying sensor alone explains steps, (N, D): its own square."""
        explained: Floats = judged.residuals**2
        return explained

    def arrays(self) -> Arrays:
        """Return the fit as arrays of numbers, by name."""
        shared = {
            "gp.columns": self.columns_,
            "gp.ridge": self.ridge_,
            "gp.error_scale": self.error_scale_,
            "gp.input_scale": self.input_scale_,
            "gp.rows": self.rows_,
        }
        kernels = [p.kernel for p in self.processes_]
        shared["gp.lengths"] = np.stack([k.lengths for k in kernels])
        shared["gp.variances"] = np.array([[k.signal, k.noise] for k in kernels])
        shared["gp.weights"] = np.stack([p.weights for p in self.processes_])
        for sensor, process in enumerate(self.processes_):
            shared[f"gp.marks.{sensor}"] = process.marks
            # As it lies in memory, on which the last bit of a product depends.
            shared[f"gp.root.{sensor}"] = process.root
        return shared

    def restore(self, units: Units, arrays: Arrays) -> None:
        """Take over a fit; raise `FittedStateError` where the arrays are none."""
        self.units_, d = units, len(units.varying)
        self.columns_ = take(arrays, "gp.columns", (None,), "i")
        inputs = len(self.columns_)
        self.ridge_ = take(arrays, "gp.ridge", (inputs + 1, d))
        self.error_scale_ = take(arrays, "gp.error_scale", (d,), "+")
        self.input_scale_ = take(arrays, "gp.input_scale", (inputs,), "+")
        self.rows_ = take(arrays, "gp.rows", (None, inputs))
        lengths = take(arrays, "gp.lengths", (d, inputs), "+")
        variances = take(arrays, "gp.variances", (d, 2), "+")
        weights = take(arrays, "gp.weights", (d, len(self.rows_)))
        self.processes_ = []
        for n in range(d):
            marks = take(arrays, f"gp.marks.{n}", (None,), "i")
            root = take(arrays, f"gp.root.{n}", (len(marks), len(marks)))
            kernel = Kernel(lengths[n], float(variances[n, 0]), float(variances[n, 1]))
            self.processes_.append(Process(kernel, weights[n], marks, root))
        self.kernels_ = [p.kernel for p in self.processes_]

    def _columns(self) -> list[NDArray[np.int64]]:
        """Return the inputs of `Units.inputs` to choose from: of the newest row, and all."""
        units = self.units_
        d, every = len(units.varying), np.arange(units.width)
        commands = 0 if units.commands is None else len(units.commands.mean)
        first = units.window * d
        newest = np.concatenate([every[:d], every[first : first + commands]])
        return [newest, every] if units.window > 1 else [newest]

    def _regress(self, wide: Floats, changes: Floats) -> None:
        """Fit the linear forecast of changes (N, D) by the chosen of the inputs (N, I)."""
        x = np.pad(wide[:, self.columns_], ((0, 0), (0, 1)), constant_values=1.0)
        gram = x.T @ x
        self.ridge_ = np.linalg.solve(gram + RIDGE * len(x) * np.eye(len(gram)), x.T @ changes)
        errors = changes - x @ self.ridge_
        self.error_scale_ = np.maximum(np.sqrt((errors**2).mean(axis=0)), CONSTANT)
        self.input_scale_ = np.maximum(x[:, :-1].std(axis=0), CONSTANT)

    def _posed_steps(self, steps: Transitions) -> tuple[Floats, Floats]:
        return self._posed(self.units_.inputs(steps.known), self._changes(steps))

    def _posed(self, wide: Floats, changes: Floats) -> tuple[Floats, Floats]:
        """Return the inputs of the processes, (N, I), and what they are to forecast, (N, D)."""
        x = wide[:, self.columns_]
        errors = changes - x @ self.ridge_[:-1] - self.ridge_[-1]
        return np.clip(x / self.input_scale_, -LIMIT, LIMIT), errors / self.error_scale_

    def _changes(self, steps: Transitions) -> Floats:
        return self.units_.changes(steps.now, steps.known.window[:, 0])

    def _judged(self, steps: Transitions) -> Assessment:
        x, y = self._posed_steps(steps)
        scaled, log_deviations = np.empty_like(y), np.empty_like(y)
        for start in range(0, len(x), BLOCK):
            rows = slice(start, start + BLOCK)
            block = np.zeros((BLOCK, x.shape[1]))
            block[: (n := len(x[rows]))] = x[rows]
            for sensor, process in enumerate(self.processes_):
                mean, log_deviation = (v[:n] for v in process(self.rows_, block))
                scaled[rows, sensor] = (y[rows, sensor] - mean) / np.exp(log_deviation)
                log_deviations[rows, sensor] = log_deviation
        return _judgement(scaled, log_deviations)


def _judgement(scaled: Floats, log_deviations: Floats) -> Assessment:
    """Return residuals, and for the tails by which they are scaled, how sure forecasts were."""
    return Assessment(deviance(scaled, np.full_like(scaled, LOG_TAIL)), log_deviations)


def _within(pieces: Sequence[Transitions]) -> int:
    """Return how many of the first pieces have so few rows as are looked at; at least one."""
    return max(1, int((np.cumsum([len(p.now) for p in pieces]) <= JUDGED).sum()))
