"""The recurrent layer: a GRU over whole sequences with gradients, and one step without.

``r = sigmoid(p_r + m U_r + c_r)``, ``u = sigmoid(p_u + m U_u + c_u)``,
``n = tanh(p_n + r (m U_n + c_n))``, ``m' = n + u (m - n)``, with the projected input p and the
memory m. Letters in shape comments: K networks, T steps, B sequences, H units.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


class Sequence(torch.autograd.Function):
    """A GRU over time, with its derivative written out.

    Automatic differentiation would record a dozen small operations a step and add up the gradient
    of the weights step by step; here a step back is one product and a few passes in place, and the
    weights' gradient is one product over all steps.

    Parameters
    ----------
    projected : (K, T, B, 3H)
        ``p`` of reset, update and candidate.
    memory : (K, B, H)
        Memory before the first step; gets no gradient.
    weights : (K, H, 3H)
    bias : (K, 1, 3H)
    kept : (K, T, B, 1) or None
        What the memory is multiplied with before each step: 0 where an episode begins.

    Returns
    -------
    Memories after every step, (K, T, B, H).
    """

    @staticmethod
    def forward(
        ctx: Any,
        projected: Tensor,
        memory: Tensor,
        weights: Tensor,
        bias: Tensor,
        kept: Tensor | None,
    ) -> Tensor:
        """Return the memories; see the class."""
        k, steps, b, h = *projected.shape[:3], memory.shape[2]
        after = projected.new_empty(k, steps, b, h)
        learns = any(ctx.needs_input_grad)  # Scoring needs nothing of what a step back looks at.
        if learns:
            opened = projected.new_empty(k, steps, b, 2 * h)
            before, old, candidate = (torch.empty_like(after) for _ in range(3))
        for t in range(steps):
            if kept is not None:
                memory = memory * kept[:, t]
            if learns:
                before[:, t] = memory
            recurrent = torch.baddbmm(bias, memory, weights)  # (K, B, 3H)
            gates = (projected[:, t, :, : 2 * h] + recurrent[..., : 2 * h]).sigmoid_()
            inner = recurrent[..., 2 * h :]
            new = torch.addcmul(projected[:, t, :, 2 * h :], gates[..., :h], inner).tanh_()
            if learns:
                opened[:, t], old[:, t], candidate[:, t] = gates, inner, new
            memory = torch.lerp(new, memory, gates[..., h:])
            after[:, t] = memory
        if learns:
            ctx.save_for_backward(before, opened, old, candidate, weights)
            ctx.kept = kept
        return after

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients of projected input, weights and bias."""
        before, opened, old, candidate, weights = ctx.saved_tensors
        k, steps, b, h = before.shape
        reset, update = opened.chunk(2, 3)
        rest = 1 - update
        of_update = (before - candidate).mul_(update).mul_(rest)
        of_new = rest.mul_(1 - candidate * candidate)
        of_reset = old * reset * (1 - reset)
        inner = before.new_empty(k, steps, b, 3 * h)  # slopes of m U + c
        new = torch.empty_like(before)  # and of the candidate's p
        back = weights.transpose(1, 2)
        carried = before.new_zeros(k, b, h)
        for t in reversed(range(steps)):
            now = carried.add_(slope[:, t])
            one, here = inner[:, t], new[:, t]
            torch.mul(now, of_new[:, t], out=here)
            torch.mul(here, of_reset[:, t], out=one[..., :h])
            torch.mul(now, of_update[:, t], out=one[..., h : 2 * h])
            torch.mul(here, reset[:, t], out=one[..., 2 * h :])
            carried = torch.baddbmm(now * update[:, t], one, back)
            if ctx.kept is not None:
                carried *= ctx.kept[:, t]
        flat = inner.reshape(k, steps * b, 3 * h)
        gradient = torch.bmm(before.reshape(k, steps * b, h).transpose(1, 2), flat)
        total = flat.sum(1, keepdim=True)
        inner[..., 2 * h :] = new
        return inner, None, gradient, total, None


@dataclass(frozen=True, slots=True)
class GruCell:
    """A GRU's weights for many single steps: one product for both gates, two for the candidate.

    Everything else works in place. A rollout's step is bound by passes over arrays larger than the
    cache.
    """

    gates: Tensor  # (K, 2H, 2H): reset and update from input and memory
    gates_bias: Tensor
    new: Tensor  # (K, H, H): candidate from the input
    new_bias: Tensor
    old: Tensor  # (K, H, H): candidate from the memory
    old_bias: Tensor

    def __call__(self, f: Tensor, memory: Tensor) -> Tensor:
        """One step: (K, B, H) and (K, B, H) to the new memory (K, B, H)."""
        both = torch.cat([f, memory], 2)
        reset, update = torch.bmm(both, self.gates).add_(self.gates_bias).sigmoid_().chunk(2, 2)
        old = torch.bmm(memory, self.old).add_(self.old_bias)
        candidate = torch.bmm(f, self.new).add_(self.new_bias).addcmul_(reset, old).tanh_()
        return candidate.lerp_(memory, update)
