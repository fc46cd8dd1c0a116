"""A deep autoencoding Gaussian mixture: how unlikely a window's code and its errors are.

After Zong, Song, Min, Cheng, Lumezanu, Cho and Chen (ICLR 2018).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import reduce
from itertools import pairwise
from typing import Any, ClassVar, Final

import numpy as np
import torch
from numpy.typing import NDArray
from oodd_common.charts import Floats, product
from torch import Tensor

from oodd_rivals.network_parameters import MixtureParameters
from oodd_rivals.network_training import arrays_of, draw, minimize
from oodd_rivals.networks import BLOCK, LIMIT, NetworkRival, Shapes, settings

WIDTHS: Final = (60, 30, 10)
"""Units of the encoder's hidden layers; the decoder's are these backwards."""

ESTIMATOR: Final = 10
"""Units of the hidden layer that decides on components."""

DROPPED: Final = 0.5
"""Share of these units that an update leaves out."""

ENERGY: Final = 0.1
"""Weight of the mean energy in the loss."""

SINGULAR: Final = 0.005
"""Weight of the inverse variances in the loss."""

JITTER: Final = 1e-6
"""Added to the variances of components: without variance there is no density."""

LEAST: Final = 1e-9
"""Least length and share that is divided by."""

FEATURES: Final = 2
"""Features of a reconstruction: its relative distance and its cosine."""


class DeepMixture(NetworkRival):
    r"""Energy of a window's code and reconstruction under a mixture of normal laws.

    .. math:: z = (c, |x - x'| / |x|, \cos(x, x')), \qquad
              s_t = -\log \sum_k \phi_k \, N(z; \mu_k, \Sigma_k)

    with c the code of the window x and x' what is decoded from it. Another network says which
    component a nominal window belongs to, and both are trained on the error of x' together with
    the energy. Higher means more anomalous. The held-out loss is the whole of what is minimized.

    Parameters
    ----------
    name, seed, horizon
        See `NetworkRival`. The horizon is without effect: nothing is forecast.
    parameters
        See `MixtureParameters`.

    Notes
    -----
    Source: B. Zong et al., "Deep autoencoding Gaussian mixture model for unsupervised anomaly
    detection", ICLR (2018).
    """

    kind: ClassVar[str] = "dagmm/1"

    def __init__(
        self, name: str, parameters: MixtureParameters, *, seed: int, horizon: int
    ) -> None:
        window = parameters.window
        super().__init__(name, seed=seed, horizon=horizon, actions=False, window=window, lag=0)
        self.parameters = parameters

    def _scores(self, rows: Floats, observations: NDArray[np.float32]) -> Floats:
        return self._energies(self._flat(rows), observations)

    def _judge(self, window: NDArray[np.float32], now: NDArray[np.float32], t: int) -> float:  # noqa: ARG002
        return float(self._energies(self._standard_rows(window).reshape(1, -1), now[None])[0])

    def _flat(self, rows: Floats) -> Floats:
        """Return the window that ends in each row, the newest row first: (N, D) to (N, W D)."""
        lags = np.arange(len(rows))[:, None] - np.arange(self.window)
        flat: Floats = rows[np.maximum(lags, 0)].reshape(len(rows), lags.shape[1] * rows.shape[1])
        return flat

    def _energies(self, x: Floats, observations: NDArray[np.float32]) -> Floats:
        w = self.weights_
        z, _ = encoded(np.clip(x, -LIMIT, LIMIT), w, np)
        roots = w["roots"].reshape(-1, *[z.shape[1]] * 2)
        energies: Floats = energy(z, w["shares"][0], w["centres"], roots, np)
        return energies + 0.5 * self.surprise_ * self._moved(observations)

    def _train(self, training: Sequence[Floats], held_out: Sequence[Floats]) -> None:
        p = self.parameters
        x, unseen = (
            torch.from_numpy(np.concatenate([self._flat(e) for e in part]).clip(-LIMIT, LIMIT))
            for part in (training, held_out)
        )
        weights = draw(self._network_shapes(x.shape[1]), self.seed)
        noise = torch.Generator().manual_seed(self.seed)

        def loss(update: int) -> Tensor:  # noqa: ARG001
            rows = torch.randint(len(x), (p.batch,), generator=noise)
            return _loss(weights, x[rows].float(), noise)

        def held_out_loss() -> Tensor:
            return _loss(weights, unseen.float(), None)

        minimize(weights, loss, held_out_loss, p.updates if x.shape[1] else 0, [])
        with torch.no_grad():
            self.loss_ = float(held_out_loss())
            z, _, members = _memberships(weights, x.float(), None)
            shares, centres, roots, _ = _mixture(z.double(), members.double())
        mixture = {"shares": shares[None], "centres": centres, "roots": roots.flatten(0, 1)}
        self.weights_ = arrays_of(weights) | {name: v.numpy() for name, v in mixture.items()}

    def _network_shapes(self, inputs: int) -> Shapes:
        p = self.parameters
        down = (inputs, *WIDTHS, p.code)
        choose = (p.code + FEATURES, ESTIMATOR, p.components)
        shapes: dict[str, tuple[int, int]] = {}
        for name, sizes in (("encode", down), ("decode", down[::-1]), ("choose", choose)):
            for n, shape in enumerate(pairwise(sizes)):
                shapes |= {f"{name}_{n}": shape, f"{name}_{n}_bias": (1, shape[1])}
        return shapes

    def _shapes(self, sensors: int, commands: int) -> Shapes:  # noqa: ARG002
        count, width = self.parameters.components, self.parameters.code + FEATURES
        mixture = {"shares": (1, count), "centres": (count, width), "roots": (count * width, width)}
        return {**self._network_shapes(sensors * self.window), **mixture}

    def _fitted_with(self) -> dict[str, Any]:
        return settings(self.parameters, "window", "code", "components")


# What follows takes arrays of NumPy or torch, as `library` says


def encoded(x: Any, w: Mapping[str, Any], library: Any) -> tuple[Any, Any]:
    """Return codes with the features of reconstructions, (N, C + 2), and these, from (N, I)."""
    code = layers(x, w, "encode", library)
    again = layers(code, w, "decode", library)
    size, other, far = (library.sqrt((v**2).sum(1) + LEAST**2) for v in (x, again, x - again))
    cosine = (x * again).sum(1) / (size * other)
    return library.hstack([code, (far / size)[:, None], cosine[:, None]]), again


def layers(x: Any, w: Mapping[str, Any], name: str, library: Any) -> Any:
    """Return what layers of one network make of x: tangents, and nothing on the last."""
    count = len(WIDTHS) + 1
    for n in range(count):
        x = _times(x, w[f"{name}_{n}"]) + w[f"{name}_{n}_bias"]
        x = library.tanh(x) if n < count - 1 else x
    return x


def energy(z: Any, shares: Any, centres: Any, roots: Any, library: Any) -> Any:
    """Return minus the log density of points (N, M) under a mixture, see `_mixture`."""
    logs = [
        share - 0.5 * (_times(z - centre, root) ** 2).sum(1)
        for share, centre, root in zip(shares, centres, roots, strict=True)
    ]
    return -reduce(library.logaddexp, logs)


def _times(x: Any, matrix: Any) -> Any:
    """Return a product whose rows have the same bits however many there are, outside training."""
    return x @ matrix if isinstance(x, Tensor) else product(x, matrix, BLOCK)


# The training


def _loss(weights: Mapping[str, Tensor], x: Tensor, noise: torch.Generator | None) -> Tensor:
    """Return error, energy and the term against components without variance, of a batch."""
    z, again, members = _memberships(weights, x, noise)
    z = z.double()  # a covariance of single precision may have no root
    shares, centres, roots, inverse = _mixture(z, members.double())
    mean: Tensor = energy(z, shares, centres, roots, torch).mean()
    return (x - again).square().sum(1).mean() + ENERGY * mean + SINGULAR * inverse


def _memberships(
    weights: Mapping[str, Tensor], x: Tensor, noise: torch.Generator | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return points (N, M), reconstructions (N, I) and shares of components in points (N, K)."""
    w = {name: weight[0] for name, weight in weights.items()}
    z, again = encoded(x, w, torch)
    hidden = torch.tanh(z @ w["choose_0"] + w["choose_0_bias"])
    if noise is not None:
        kept = torch.rand(hidden.shape, generator=noise) >= DROPPED
        hidden = hidden * kept / (1 - DROPPED)
    return z, again, torch.softmax(hidden @ w["choose_1"] + w["choose_1_bias"], 1)


def _mixture(z: Tensor, members: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the mixture of points (N, M) that belong to components by shares (N, K).

    Logs of the components' shares with what makes densities of them (K,), centres (K, M), matrices
    that whiten (K, M, M), and the sum of the inverse variances.
    """
    count = members.sum(0).clamp(min=LEAST)
    centres = (members.T @ z) / count[:, None]
    centred = z - centres[:, None]  # (K, N, M)
    covariance = (centred * members.T[..., None]).mT @ centred / count[:, None, None]
    covariance = covariance + JITTER * torch.eye(z.shape[1])
    roots = torch.linalg.inv(torch.linalg.cholesky(covariance)).mT
    density = roots.diagonal(dim1=1, dim2=2).log() - 0.5 * math.log(2 * math.pi)
    inverse = (1 / covariance.diagonal(dim1=1, dim2=2)).sum()
    return torch.log(count / len(z)) + density.sum(1), centres, roots, inverse
