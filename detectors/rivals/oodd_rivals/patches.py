"""The encoder of `paano`: a small convolutional network, its training and its forward pass."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from oodd_common.charts import Floats
from oodd_common.windows import windows
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, conv1d, normalize

from oodd_rivals.parameters import PaanoParameters

LAYERS: Final = 4
KERNEL: Final = 3
"""Rows that a unit of a convolution sees."""

PROJECTION: Final = 256
"""Units of the hidden layer behind which the triplets are compared, in training alone."""

MARGIN: Final = 0.5
"""By so much a patch is to be nearer to its neighbour in time than to the farthest patch."""

RADIUS: Final = 2
"""Rows by which a neighbour is shifted at most."""

PRETEXT: Final = 0.1
"""Share of the updates in which the second task, whose weight falls to nothing, is learnt too."""

WEIGHT_DECAY: Final = 1e-4

LEAST_SPREAD: Final = 1e-2
"""A sensor that varies less within a patch, in training deviations, is not magnified further."""

Convolutions = list[tuple[NDArray[np.float64], NDArray[np.float64]]]
"""Weights (kernel * inputs, outputs) and bias (outputs,) of each layer."""


class Patches(NamedTuple):
    """All patches of training: rows, and for each the episode's first row."""

    rows: NDArray[np.float32]  # (N, D), standardized
    first: NDArray[np.int64]  # (N,)
    last: NDArray[np.int64]  # (N,), row number of the episode's last row

    @classmethod
    def of(cls, episodes: Sequence[NDArray[np.float32]]) -> Patches:
        """Return the patches that end in each row of standardized episodes."""
        lengths = [len(x) for x in episodes]
        starts = np.cumsum([0, *lengths[:-1]])
        first = np.repeat(starts, lengths)
        return cls(np.concatenate(episodes), first, first + np.repeat(lengths, lengths) - 1)

    def ending(self, at: NDArray[np.int64], length: int) -> NDArray[np.float32]:
        """Return the patches that end in rows, (B, W, D); beyond an episode's ends, at its ends."""
        return windows(self.rows, at, length, self.first[at])

    def shifted(self, at: NDArray[np.int64], by: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return row numbers moved within their episodes."""
        return np.asarray(np.clip(at + by, self.first[at], self.last[at]), np.int64)


def normalized(patches: NDArray[np.float32]) -> Floats:
    """Return patches (N, W, D) with mean 0 and deviation 1 of every sensor within each.

    Examples
    --------
    >>> normalized(np.array([[[1.0, 5.0], [3.0, 5.0]]], np.float32)).round(3).tolist()
    [[[-1.0, 0.0], [1.0, 0.0]]]
    """
    x = patches.astype(np.float64)
    x -= x.mean(axis=1, keepdims=True)
    spread = np.sqrt((x**2).mean(axis=1, keepdims=True) + LEAST_SPREAD**2)
    return np.asarray(x / spread)


def embedded(x: Floats, layers: Convolutions) -> Floats:
    """Return the embeddings (N, H) of patches (N, W, D).

    Each patch is a matrix product of one shape, so that its bits do not depend on the others.
    """
    for weights, bias in layers:
        padded = np.pad(x, ((0, 0), (KERNEL // 2, KERNEL // 2), (0, 0)))
        width = x.shape[1]
        columns = np.concatenate([padded[:, k : k + width] for k in range(KERNEL)], axis=2)
        x = np.maximum(np.matmul(columns, weights) + bias, 0.0)
    return np.asarray(x.mean(axis=1))


def train(
    heads: Heads, patches: Patches, settings: PaanoParameters, rng: np.random.Generator
) -> None:
    """Train the encoder and its heads in place, on triplets of patches and on pairs in succession.

    By AdamW (Loshchilov & Hutter 2019), at a rate that falls to nothing as a cosine.
    """
    adam = torch.optim.AdamW(heads.weights, lr=settings.rate, weight_decay=WEIGHT_DECAY)
    task = max(1, round(PRETEXT * settings.updates))
    for update in range(settings.updates):
        for group in adam.param_groups:
            group["lr"] = settings.rate * 0.5 * (1 + math.cos(math.pi * update / settings.updates))
        triplet, pretext = losses(heads, patches, settings, rng)
        loss = triplet + max(0.0, 1 - update / task) * pretext
        adam.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        adam.step()


def losses(
    heads: Heads, patches: Patches, settings: PaanoParameters, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Return the losses of a batch of patches: of triplets, and of the second task.

    The first wants a patch nearer, in cosine distance, to one that is shifted by a row or two than
    to the farthest of the batch. The second asks whether one patch comes right before another.
    """
    anchors = rng.integers(len(patches.rows), size=settings.batch)
    by = rng.integers(1, RADIUS + 1, size=settings.batch) * rng.choice([-1, 1], size=settings.batch)
    at = [anchors, patches.shifted(anchors, by)]
    at.append(patches.shifted(anchors, np.full(settings.batch, -settings.window)))
    x = patches.ending(np.concatenate(at), settings.window)
    x = normalized(x).astype(np.float32) if settings.normalize == "patch" else x
    hidden = heads.encode(torch.from_numpy(x))
    h, shifted, before = hidden.chunk(3)
    z, near = heads.project(h), heads.project(shifted)
    nearness = z @ z.T
    distances = (1 - (z * near).sum(1)) - (1 - nearness.min(dim=1).values)
    triplet = torch.relu(distances + MARGIN).mean()
    other = h[torch.from_numpy(rng.permutation(settings.batch))]
    follows, random = heads.follows(before, h), heads.follows(other, h)
    pretext = binary_cross_entropy_with_logits(follows, torch.ones_like(follows))
    return triplet, pretext + binary_cross_entropy_with_logits(random, torch.zeros_like(random))


class Heads:
    """The encoder and the two heads of its training, with normal weights of variance 2 / inputs."""

    def __init__(self, sensors: int, width: int, rng: np.random.Generator) -> None:
        def drawn(*shape: int, inputs: int) -> Tensor:
            values = rng.normal(size=shape) * math.sqrt(2 / inputs)
            return torch.from_numpy(values.astype(np.float32)).requires_grad_()

        sizes = [sensors, *[width] * LAYERS]
        self.filters = [drawn(o, i, KERNEL, inputs=i * KERNEL) for i, o in pairwise(sizes)]
        self.biases = [torch.zeros(width).requires_grad_() for _ in range(LAYERS)]
        self.projection = [
            drawn(width, PROJECTION, inputs=width),
            drawn(PROJECTION, PROJECTION, inputs=PROJECTION),
        ]
        self.follower = drawn(2 * width, 1, inputs=2 * width)
        self.weights = [*self.filters, *self.biases, *self.projection, self.follower]

    def encode(self, x: Tensor) -> Tensor:
        """Return embeddings (N, H) of patches (N, W, D)."""
        x = x.transpose(1, 2)
        for filters, bias in zip(self.filters, self.biases, strict=True):
            x = torch.relu(conv1d(x, filters, bias, padding=KERNEL // 2))
        return x.mean(dim=2)

    def project(self, h: Tensor) -> Tensor:
        """Return unit vectors, of which triplets are compared."""
        return normalize(torch.relu(h @ self.projection[0]) @ self.projection[1], dim=1)

    def follows(self, before: Tensor, h: Tensor) -> Tensor:
        """Return the logit of one patch coming right before the other, (N, 1)."""
        return torch.cat([before, h], dim=1) @ self.follower

    def convolutions(self) -> Convolutions:
        """Return the encoder alone, as `embedded` takes it."""
        return [
            (
                f.detach().permute(2, 1, 0).reshape(-1, f.shape[0]).numpy().astype(np.float64),
                b.detach().numpy().astype(np.float64),
            )
            for f, b in zip(self.filters, self.biases, strict=True)
        ]
