"""The ensemble of networks as a forecaster.

A linear forecast is the base; the networks forecast the distribution of its errors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from oodd_common.charts import Floats, limited

from oodd_eval.plugins.contract import Progress, ignore_progress
from oodd_eval.plugins.forecasting import CONSTANT
from oodd_eval.plugins.state import Arrays, take
from oodd_pe import PeParameters
from oodd_pe.ensemble import DensityEnsemble
from oodd_pe.forecaster import LIMIT, Assessment, Judge, Transitions, Units
from oodd_pe.network import DensityNetworks, train
from oodd_pe.statistic import deviance

RIDGE: Final = 1e-6
"""Penalty of the linear forecast, relative to the mean squared change of standardized sensors."""


class DensityForecaster:
    """A ridge regression, and networks for the distribution of what it leaves.

    Parameters
    ----------
    parameters
        See `oodd_pe.PeParameters`.
    seed
        Decides the networks and their batches.
    device
        Where torch trains, ``cpu`` or ``cuda``.
    """

    def __init__(self, parameters: PeParameters, *, seed: int, device: str) -> None:
        self.parameters, self.seed, self.device = parameters, seed, device
        self.units_: Units
        self.ensemble_: DensityEnsemble
        self.log_density_ = -math.inf

    def fit(
        self,
        units: Units,
        pieces: Sequence[Transitions],
        folds: Sequence[int],
        progress: Progress = ignore_progress,
    ) -> list[Assessment | None]:
        """Learn from nominal pieces: see `oodd_pe.forecaster.EpisodeForecaster.fit`.

        Each member leaves one fold out, in turn. `progress` hears of the updates.
        """
        self.units_ = units
        p, k = self.parameters, max(folds) + 1
        unseen = np.arange(p.members) % k
        inputs, outcomes, of_row = self._examples(pieces, folds, unseen)
        # What has no other folds to learn from judges itself.
        rows = [np.flatnonzero(seen if seen.any() else ~seen) for seen in of_row != unseen[:, None]]
        held_out = [
            np.flatnonzero(~seen if seen.any() else seen) for seen in of_row != unseen[:, None]
        ]
        network = DensityNetworks(p.members, inputs.shape[1], outcomes.shape[2], p.width, self.seed)
        if outcomes.shape[2]:
            train(
                network,
                inputs,
                outcomes,
                rows,
                held_out,
                updates=p.updates,
                batch=p.batch,
                seed=self.seed,
                device=self.device,
                progress=progress,
            )
        self.ensemble_ = DensityEnsemble(network.arrays())
        first = [piece for piece, fold in zip(pieces, folds, strict=True) if not fold]
        blind = np.arange(p.members) % (max(folds) + 1) == 0
        self.log_density_ = self._log_density(first, blind)
        return self.out_of_fold(pieces, folds)

    def begin(self) -> Judge:
        """Return what judges a new episode: forecasts need no memory beyond their window."""
        return self._judged

    def explained(self, steps: Transitions, judged: Assessment) -> Floats:  # noqa: ARG002
        """Return by how much each varying sensor alone explains steps, (N, D)."""
        return self.ensemble_.of_sensors(*self._posed(steps))

    def arrays(self) -> Arrays:
        """Return the fit as arrays of numbers, by name."""
        return {
            "ridge": self.ridge_,
            "error_scale": self.error_scale_,
            "input_scale": self.input_scale_,
            **self.ensemble_.arrays,
        }

    def restore(self, units: Units, arrays: Arrays) -> None:
        """Take over a fit; raise `FittedStateError` where the arrays are none."""
        self.units_ = units
        d, p = len(units.varying), self.parameters
        self.ridge_ = take(arrays, "ridge", (p.members, units.width + 1, d))
        self.error_scale_ = take(arrays, "error_scale", (d,), "+")
        self.input_scale_ = take(arrays, "input_scale", (units.width,), "+")
        self.ensemble_ = DensityEnsemble.restored(
            arrays, DensityNetworks(p.members, units.width, d, p.width)
        )

    def _examples(
        self, pieces: Sequence[Transitions], folds: Sequence[int], unseen: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64]]:
        """Fit the linear forecasts of members, each without the fold that it leaves out.

        Returns inputs, (N, I), outcomes, (M, N, D), of networks, and the fold of each row, (N,).
        """
        # Twice over the episodes, since all their inputs in double precision need gigabytes.
        grams, crosses = [], []
        for t in pieces:
            ones = np.pad(self.units_.inputs(t.known), ((0, 0), (0, 1)), constant_values=1.0)
            grams.append(ones.T @ ones)
            crosses.append(ones.T @ self._changes(t))
        of_piece = np.asarray(folds)
        ridges = []
        for fold in unseen:
            seen = np.flatnonzero(of_piece != fold)
            seen = seen if len(seen) else np.arange(len(pieces))
            gram, cross = (np.sum([m[i] for i in seen], axis=0) for m in (grams, crosses))
            penalty = RIDGE * gram[-1, -1] * np.eye(len(gram))
            ridges.append(np.linalg.solve(gram + penalty, cross))
        self.ridge_ = np.stack(ridges)
        gram = np.sum(grams, axis=0)
        n = int(gram[-1, -1])
        variance = np.diag(gram)[:-1] / n - (gram[-1, :-1] / n) ** 2
        self.input_scale_ = np.sqrt(np.maximum(variance, CONSTANT**2))

        inputs = np.empty((n, len(variance)), np.float32)
        outcomes = np.empty((len(unseen), n, crosses[0].shape[1]), np.float32)
        squares = np.zeros(crosses[0].shape[1])
        done = 0
        for t in pieces:
            x = self.units_.inputs(t.known)
            rows = slice(done, done := done + len(x))
            inputs[rows] = self._scaled(x)
            errors = self._errors(x, self._changes(t))
            outcomes[:, rows] = errors
            squares += (errors**2).mean(axis=0).sum(axis=0)
        self.error_scale_ = np.maximum(np.sqrt(squares / n), CONSTANT)
        outcomes /= self.error_scale_.astype(np.float32)
        of_row = np.repeat(of_piece, [len(t.now) for t in pieces])
        return inputs, outcomes, of_row

    def _log_density(self, held_out: Sequence[Transitions], blind: NDArray[np.bool_]) -> float:
        """Return the mean log density of a row's sensor by some members, in standardized units."""
        densities = [self.ensemble_.log_densities(*self._posed(piece)) for piece in held_out]
        pooled = np.concatenate(densities, axis=1)[blind]
        mixture = np.logaddexp.reduce(pooled, axis=0) - np.log(len(pooled))
        d = max(1, len(self.error_scale_))
        return float(mixture.mean() - np.log(self.error_scale_).sum()) / d

    def out_of_fold(
        self, pieces: Sequence[Transitions], folds: Sequence[int]
    ) -> list[Assessment | None]:
        """Judge each piece of a fit by the members that have not seen its fold."""
        unseen = np.arange(self.parameters.members) % (max(folds) + 1)
        judged: list[Assessment | None] = []
        for piece, fold in zip(pieces, folds, strict=True):
            blind = unseen == fold
            if not blind.any():
                judged.append(None)
                continue
            residual, log_tail = self.ensemble_.each(*self._posed(piece))
            mean, tail = residual[blind].mean(axis=0), log_tail[blind].mean(axis=0)
            judged.append(Assessment(deviance(mean, tail), tail))
        return judged

    def _judged(self, steps: Transitions) -> Assessment:
        residual, log_tail = self.ensemble_(*self._posed(steps))
        return Assessment(deviance(residual, log_tail), log_tail)

    def _posed(self, steps: Transitions) -> tuple[Floats, Floats]:
        """Return what networks are given, (N, I), and what they are to forecast, (M, N, D)."""
        x = self.units_.inputs(steps.known)
        errors = self._errors(x, self._changes(steps))
        return self._scaled(x), errors / self.error_scale_

    def _changes(self, steps: Transitions) -> Floats:
        """Return how far the sensors are from where forecasts start, (N, D)."""
        return self.units_.changes(steps.now, steps.known.window[:, 0])

    def _scaled(self, x: Floats) -> Floats:
        return limited(x / self.input_scale_, LIMIT)

    def _errors(self, x: Floats, y: Floats) -> Floats:
        """Return what each member's linear forecast leaves of changes, (M, N, D)."""
        left: Floats = y - x @ self.ridge_[:, :-1] - self.ridge_[:, -1:]
        return left
