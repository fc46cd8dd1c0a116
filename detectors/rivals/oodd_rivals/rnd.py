"""Random network distillation: a network learns what a random one says of nominal rows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, ClassVar, Final

import numpy as np
import torch
from numpy.typing import NDArray
from oodd_common.charts import Floats, product
from oodd_common.windows import windows
from torch import Tensor

from oodd_eval import Trajectory
from oodd_eval.plugins.forecasting import FeatureScale
from oodd_eval.plugins.state import Arrays, take
from oodd_rivals.parameters import RndParameters
from oodd_rivals.recent import RecentRowsDetector

BLOCK: Final = 8
"""Rows that go through the networks at once: a streamed one costs as much as so many."""

TARGET_LAYERS: Final = 3
PREDICTOR_LAYERS: Final = 4
"""Layers of both networks: the one that learns has one more, as in the paper."""

Layers = list[tuple[NDArray[np.float64], NDArray[np.float64]]]
"""Weights (inputs, outputs) and bias (outputs,) of each layer."""


def random_layers(widths: Sequence[int], rng: np.random.Generator) -> Layers:
    """Return layers of the given widths with normal weights of variance 2 / inputs, no bias."""
    return [
        (rng.normal(size=(i, o)) * math.sqrt(2 / i), rng.normal(size=o) * 0.1)
        for i, o in pairwise(widths)
    ]


def forward(x: Floats, layers: Layers) -> Floats:
    """Return the outputs of a network with rectified hidden layers, (N, I) to (N, O)."""
    for i, (weights, bias) in enumerate(layers):
        x = product(x, weights, BLOCK) + bias
        if i < len(layers) - 1:
            x = np.maximum(x, 0.0)
    return x


class RndDetector(RecentRowsDetector):
    r"""Error of a network that was taught a random one's outputs on nominal rows.

    .. math:: s_t = \sqrt{\frac{1}{O} \sum_j (f_j(x_t) - g_j(x_t))^2}

    with f the random network, g the trained one, and :math:`x_t` the standardized rows
    :math:`o_t .. o_{t-W+1}`, clipped. Higher means more anomalous.

    Parameters
    ----------
    name, seed, horizon
        See `RecentRowsDetector`. The seed decides networks and batches.
    parameters
        See `oodd_rivals.parameters.RndParameters`.

    Notes
    -----
    Sources: Y. Burda, H. Edwards, A. Storkey & O. Klimov, "Exploration by random network
    distillation", arXiv 1810.12894 (2018); R. Roemer, A. Kobras, L. Worbis & A. P. Schoellig,
    "Failure prediction at runtime for generative robot policies", NeurIPS (2025), arXiv 2510.09459.
    """

    kind: ClassVar[str] = "rnd/1"

    def __init__(self, name: str, parameters: RndParameters, *, seed: int, horizon: int) -> None:
        super().__init__(name, seed=seed, horizon=horizon, window=parameters.window)
        self.parameters = parameters
        self.target_: Layers
        self.predictor_: Layers

    def _learn(self, nominal: Sequence[Trajectory]) -> FeatureScale:
        scale = FeatureScale.fit(nominal)
        rows = [windows(scale(x), np.arange(len(x)), self.window) for x in nominal]
        x = self._columns(np.concatenate(rows))
        p = self.parameters
        rng = np.random.default_rng(self.seed)
        hidden = [p.width] * (PREDICTOR_LAYERS - 1)
        self.target_ = random_layers([x.shape[1], *hidden[: TARGET_LAYERS - 1], p.outputs], rng)
        start = random_layers([x.shape[1], *hidden, p.outputs], rng)
        self.predictor_ = distilled(x, forward(x, self.target_), start, p, rng)
        return scale

    def _columns(self, latest: NDArray[np.float32]) -> Floats:
        limit = self.parameters.limit
        flat = latest.reshape(len(latest), -1).astype(np.float64)
        return np.clip(flat, -limit, limit)

    def _scores(self, latest: NDArray[np.float32]) -> Floats:
        x = self._columns(latest)
        errors = forward(x, self.target_) - forward(x, self.predictor_)
        return np.asarray(np.sqrt((errors**2).mean(axis=1)))

    def _fitted_with(self) -> dict[str, Any]:
        p = self.parameters
        return {"window": p.window, "limit": p.limit, "width": p.width, "outputs": p.outputs}

    def _arrays(self) -> Arrays:
        networks = {"target": self.target_, "predictor": self.predictor_}
        return {
            f"{network}.{kind}.{i}": array
            for network, layers in networks.items()
            for i, layer in enumerate(layers)
            for kind, array in zip(("weights", "bias"), layer, strict=True)
        }

    def _restore(self, arrays: Arrays, sensors: int) -> None:
        p = self.parameters

        def taken(network: str, layers: int) -> Layers:
            widths = [sensors * self.window, *[p.width] * (layers - 1), p.outputs]
            return [
                (
                    take(arrays, f"{network}.weights.{i}", shape),
                    take(arrays, f"{network}.bias.{i}", shape[1:]),
                )
                for i, shape in enumerate(pairwise(widths))
            ]

        self.target_ = taken("target", TARGET_LAYERS)
        self.predictor_ = taken("predictor", PREDICTOR_LAYERS)


def distilled(
    x: Floats, y: Floats, start: Layers, settings: RndParameters, rng: np.random.Generator
) -> Layers:
    """Return the layers that the mean squared error of y, (N, O), by x, (N, I), leads to.

    By Adam (Kingma & Ba 2015) in single precision, at a rate that falls to nothing as a cosine.
    """
    inputs, outputs = (torch.from_numpy(a.astype(np.float32)) for a in (x, y))
    weights = [
        torch.from_numpy(a.astype(np.float32)).requires_grad_() for layer in start for a in layer
    ]
    adam = torch.optim.Adam(weights, lr=settings.rate)
    for update in range(settings.updates):
        for group in adam.param_groups:
            group["lr"] = settings.rate * 0.5 * (1 + math.cos(math.pi * update / settings.updates))
        rows = torch.from_numpy(rng.integers(len(inputs), size=settings.batch))
        loss = (_output(inputs[rows], weights) - outputs[rows]).square().mean()
        adam.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        adam.step()
    arrays = [w.detach().numpy().astype(np.float64) for w in weights]
    return list(zip(arrays[::2], arrays[1::2], strict=True))


def _output(x: Tensor, weights: list[Tensor]) -> Tensor:
    *hidden, last = zip(weights[::2], weights[1::2], strict=True)
    for w, b in hidden:
        x = torch.relu(torch.addmm(b, x, w))
    return torch.addmm(last[1], x, last[0])
