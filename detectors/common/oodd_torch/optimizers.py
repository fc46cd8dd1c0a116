"""Optimizers of stacked networks: every parameter holds K networks, (K, rows, columns).

The networks are independent of each other: each has its own learning rate, gradient clip and
orthogonalized momentum. They are stepped together because a batched operation is quicker than K.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import torch
from torch import Tensor

BETAS: Final = (0.9, 0.999)
"""Decay per step of Adam's running means of the gradient and of its square."""

EPSILON: Final = 1e-8

CLIP: Final = 1.0
"""Largest norm of one network's gradient in `Adam`."""

MOMENTUM: Final = 0.95
"""Decay per step of Muon's running mean of the gradient."""

NEWTON_SCHULZ: Final = (3.4445, -4.7750, 2.0315)
"""Coefficients a, b, c of `orthogonal`, by which small singular values grow quickest."""


class Adam:
    """Adam (Kingma & Ba 2015) with a learning rate and a gradient clip per network."""

    def __init__(self, parameters: Iterable[Tensor]) -> None:
        self.parameters = list(parameters)
        self.mean = [torch.zeros_like(p) for p in self.parameters]
        self.square = [torch.zeros_like(p) for p in self.parameters]
        self.count = 0

    @torch.no_grad()
    def step(self, rates: Tensor) -> None:
        """Take one step; `rates` has shape (K,)."""
        gradients = [p.grad if p.grad is not None else torch.zeros_like(p) for p in self.parameters]
        norm = torch.stack([g.flatten(1).square().sum(1) for g in gradients]).sum(0).sqrt()  # (K,)
        shrink = (CLIP / norm.clamp(min=CLIP))[:, None, None]
        self.count += 1
        correction = (1 - BETAS[1] ** self.count) ** 0.5 / (1 - BETAS[0] ** self.count)
        for p, g, m, v in zip(self.parameters, gradients, self.mean, self.square, strict=True):
            clipped = g * shrink
            m.lerp_(clipped, 1 - BETAS[0])
            v.mul_(BETAS[1]).addcmul_(clipped, clipped, value=1 - BETAS[1])
            p.sub_(rates[:, None, None] * correction * m / (v.sqrt() + EPSILON))
            p.grad = None


class Muon:
    """Muon: every network's momentum is made orthogonal, so that all its directions move alike.

    It is for weights between hidden layers, ``y = x W`` with W of shape (rows, columns); biases and
    output layers are for `Adam`. A step with rate r changes the output by about r times the norm of
    a unit input, whatever the size of the gradient, which is why there is no clip. Source: Keller
    Jordan et al. (2024), "Muon: an optimizer for hidden layers in neural networks". With `shrink`
    a step also takes ``r shrink`` times the weights away.
    """

    def __init__(self, parameters: Iterable[Tensor], shrink: float = 0.0) -> None:
        self.parameters, self.shrink = list(parameters), shrink
        self.mean = [torch.zeros_like(p) for p in self.parameters]

    @torch.no_grad()
    def step(self, rates: Tensor) -> None:
        """Take one step; `rates` has shape (K,)."""
        for p, m in zip(self.parameters, self.mean, strict=True):
            if p.grad is not None:
                m.lerp_(p.grad, 1 - MOMENTUM)
                # Nesterov's momentum: the mean as it will be after another such gradient.
                step = orthogonal(p.grad.lerp(m, MOMENTUM))
                size = max(1.0, p.shape[2] / p.shape[1]) ** 0.5
                p.sub_(rates[:, None, None] * (size * step + self.shrink * p))
                p.grad = None


def orthogonal(matrices: Tensor, steps: int = 5) -> Tensor:
    """Move the singular values of (K, rows, columns) into about 0.7 to 1.2; vectors stay.

    By ``X <- a X + b X X' X + c (X X')^2 X``, a step of Newton and Schulz, after X is divided by
    its norm. A matrix of zeros stays zero.
    """
    a, b, c = NEWTON_SCHULZ
    wide = matrices.shape[1] <= matrices.shape[2]
    x = matrices if wide else matrices.transpose(1, 2)
    x = x / (torch.linalg.matrix_norm(x, keepdim=True) + EPSILON)
    for _ in range(steps):
        square = torch.bmm(x, x.transpose(1, 2))
        x = torch.baddbmm(x, torch.baddbmm(square, square, square, beta=b, alpha=c), x, beta=a)
    return x if wide else x.transpose(1, 2)


class Average:
    """Exponentially weighted mean of parameters over the steps of a training.

    The weight of the past is ``min(decay, (u + 1) / (u + 10))`` at step u = 0, 1, ...: short at
    first, so that the initial weights leave no trace.
    """

    def __init__(self, parameters: Iterable[Tensor], decay: float) -> None:
        self.parameters, self.decay, self.count = list(parameters), decay, 0
        self.mean = [p.detach().clone() for p in self.parameters]

    @torch.no_grad()
    def update(self) -> None:
        """Take the parameters as they are now into the mean."""
        decay = min(self.decay, (self.count + 1) / (self.count + 10))
        self.count += 1
        for mean, p in zip(self.mean, self.parameters, strict=True):
            mean.lerp_(p, 1 - decay)

    @torch.no_grad()
    def apply(self) -> None:
        """Set the parameters to their mean."""
        for mean, p in zip(self.mean, self.parameters, strict=True):
            p.copy_(mean)
