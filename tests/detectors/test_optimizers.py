"""Optimizers of stacked networks, and the mean of their weights."""

import pytest
import torch
from oodd_torch.optimizers import CLIP, Adam, Average, Muon, orthogonal


def matrices(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("shape", [(3, 8, 8), (3, 8, 24), (3, 24, 8)])
def test_singular_values_come_near_one_and_directions_stay(shape):
    x = matrices(*shape)
    left, sizes, right = torch.linalg.svd(x, full_matrices=False)
    found = orthogonal(x)
    kept = torch.diagonal(left.mT @ found @ right.mT, dim1=1, dim2=2)
    large = sizes > 0.05 * sizes.square().sum(1, keepdim=True).sqrt()
    assert kept[large].min() > 0.6
    assert kept.max() < 1.3
    assert torch.allclose(found, left @ torch.diag_embed(kept) @ right, atol=1e-4)


def test_no_gradient_is_no_step():
    assert not orthogonal(torch.zeros(2, 3, 4)).any()


@pytest.mark.parametrize("optimiser", [Adam, Muon])
def test_networks_are_trained_independently(optimiser):
    """Two networks together are what each is alone, to the bit."""
    targets = matrices(2, 4, 4, seed=1)

    def trained(members):
        weights = torch.zeros(len(members), 4, 4, requires_grad=True)
        step = optimiser([weights])
        for _ in range(20):
            (weights - targets[members]).square().sum().backward()
            step.step(torch.tensor([0.01, 0.03])[members])
        return weights.detach()

    both = trained([0, 1])
    assert torch.equal(both[:1], trained([0]))
    assert torch.equal(both[1:], trained([1]))


@pytest.mark.parametrize("optimiser", [Adam, Muon])
def test_a_linear_map_is_learned(optimiser):
    x, true = matrices(1, 200, 6), matrices(1, 6, 6, seed=1)
    weights = torch.zeros(1, 6, 6, requires_grad=True)
    step = optimiser([weights])
    for update in range(300):
        (torch.bmm(x, weights - true)).square().mean().backward()
        step.step(torch.tensor([0.1 * (1 - update / 300)]))
    assert (weights - true).abs().max() < 0.02


def test_a_step_of_muon_does_not_depend_on_the_size_of_the_gradient():
    steps = []
    for size in (1e-3, 1e3):
        weights = torch.zeros(1, 4, 4, requires_grad=True)
        (size * weights * matrices(1, 4, 4)).sum().backward()
        Muon([weights]).step(torch.tensor([0.1]))
        steps.append(weights.detach())
    assert torch.allclose(*steps, atol=1e-5)


def test_the_clip_is_over_all_parameters_of_a_network():
    parameters = [torch.zeros(2, 1, 3, requires_grad=True) for _ in range(2)]
    for p in parameters:
        p.grad = torch.ones(2, 1, 3) * torch.tensor([0.01, 100.0])[:, None, None]
    optimiser = Adam(parameters)
    optimiser.step(torch.zeros(2))
    norms = torch.stack(optimiser.mean).square().sum((0, 2, 3)).sqrt() / 0.1
    assert norms.tolist() == pytest.approx([0.01 * 6**0.5, CLIP])


def test_the_mean_forgets_the_first_weights_and_then_moves_slowly():
    weights = torch.full((1, 1, 1), 100.0)
    mean = Average([weights], 0.9)
    weights.fill_(1.0)
    mean.update()
    assert mean.mean[0].item() == pytest.approx(0.1 * 100 + 0.9 * 1)
    for _ in range(30):
        mean.update()
    assert mean.mean[0].item() == pytest.approx(1.0, abs=1e-3)
    weights.fill_(5.0)
    mean.update()
    mean.apply()
    # After 31 steps the weight of the past is (31 + 1) / (31 + 10) = 0.78, not yet 0.9.
    assert weights.item() == pytest.approx(0.780 * 1 + 0.220 * 5, abs=1e-2)
