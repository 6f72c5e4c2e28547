"""ClippedAdam against its definition: clip, shrink, torch's Adam."""

from __future__ import annotations

import copy

import pytest
import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_dreamer_urlb.learning.optim import ClippedAdam

STEPS = 6


def _reference(module, losses, learning_rates, eps, max_norm, decay):
    adam = th.optim.Adam(module.parameters(), lr=1.0, eps=eps)
    norms = []
    for loss, learning_rate in zip(losses, learning_rates, strict=True):
        adam.zero_grad()
        loss(module).backward()
        norms.append(nn.utils.clip_grad_norm_(module.parameters(), max_norm))
        with th.no_grad():
            for parameter in module.parameters():
                parameter.mul_(1 - decay)
        adam.param_groups[0]["lr"] = learning_rate
        adam.step()
    return norms


def _run(module, losses, learning_rates, eps, max_norm, decay):
    optimizer = ClippedAdam(module.parameters(), learning_rates[0], eps, max_norm, decay)
    norms = []
    for loss, learning_rate in zip(losses, learning_rates, strict=True):
        optimizer.set_learning_rate(learning_rate)
        norms.append(optimizer.step(loss(module)))
    return norms


def _network():
    return nn.Sequential(nn.Conv2d(3, 8, 4, 2), nn.ELU(), nn.Flatten(), nn.Linear(8 * 9, 1))


def _losses(layout):
    images = [th.randn(5, 3, 8, 8) for _ in range(STEPS)]
    return [lambda net, x=x: net(x.contiguous(memory_format=layout)).square().sum() for x in images]


@pytest.mark.parametrize("layout", [th.contiguous_format, th.channels_last])
@pytest.mark.parametrize(
    ("learning_rates", "max_norm", "decay"),
    [
        ([1e-2] * STEPS, 100.0, 1e-6),
        ([1e-2] * STEPS, 0.1, 1e-2),  # the bound is active, the decay large
        ([1e-2, 1e-3, 1e-4, 3e-2, 1e-3, 1e-3], 1.0, 1e-2),  # a schedule: the decay must not scale with it
    ],
)
def test_equals_clip_then_shrink_then_adam(seeded, layout, learning_rates, max_norm, decay):
    ours = _network()
    theirs = copy.deepcopy(ours)
    losses = _losses(layout)
    norms = _run(ours, losses, learning_rates, 1e-5, max_norm, decay)
    expected = _reference(theirs, losses, learning_rates, 1e-5, max_norm, decay)
    assert th.allclose(th.stack(norms), th.stack(expected), rtol=1e-4)
    for mine, reference in zip(ours.parameters(), theirs.parameters(), strict=True):
        assert th.allclose(mine, reference, atol=2e-6)


def test_a_gradient_laid_out_channels_last_moves_the_right_weights():
    parameter = nn.Parameter(th.zeros(4, 3, 2, 2))
    direction = th.arange(48.0).view(4, 3, 2, 2).sub(23.5).contiguous(memory_format=th.channels_last)

    def loss():
        return (parameter.contiguous(memory_format=th.channels_last) * direction).sum()

    assert not th.autograd.grad(loss(), parameter)[0].is_contiguous()  # else this test would test nothing
    ClippedAdam([parameter], 0.1, 1e-8, 1e9, 0.0).step(loss())
    # Adam's first step moves every weight by the learning rate, against the sign of its gradient.
    assert th.allclose(parameter.detach(), -0.1 * direction.sign(), atol=1e-5)


def test_only_its_own_parameters_receive_gradients(seeded):
    mine, other = nn.Linear(3, 3), nn.Linear(3, 3)
    before = copy.deepcopy(other.state_dict())
    ClippedAdam(mine.parameters(), 0.1, 1e-5, 1.0, 1e-2).step(other(mine(th.randn(4, 3))).sum())
    assert all(parameter.grad is None for parameter in [*mine.parameters(), *other.parameters()])
    assert all(th.equal(value, before[name]) for name, value in other.state_dict().items())


def test_returns_the_norm_before_the_bound():
    parameter = nn.Parameter(th.zeros(2))
    norm = ClippedAdam([parameter], 0.1, 1e-5, 0.5, 0.0).step((parameter * th.tensor([3.0, 4.0])).sum())
    assert norm.item() == pytest.approx(5.0) and not norm.requires_grad


def test_learning_rate_zero_changes_nothing_and_recovers():
    parameter = nn.Parameter(th.ones(3))
    optimizer = ClippedAdam([parameter], 0.0, 1e-5, 1.0, 1e-2)
    optimizer.step(F.mse_loss(parameter, th.zeros(3)))
    assert th.equal(parameter.detach(), th.ones(3))
    optimizer.set_learning_rate(1e-3)
    optimizer.step(F.mse_loss(parameter, th.zeros(3)))
    assert th.allclose(parameter.detach(), th.full((3,), 0.99 - 1e-3), atol=2e-4)


def test_state_moves_to_another_optimizer(seeded):
    first, target = nn.Linear(3, 1), th.randn(4, 3)
    optimizer = ClippedAdam(first.parameters(), 0.01, 1e-5, 1.0, 1e-3)
    optimizer.step(first(target).square().sum())
    second = copy.deepcopy(first)
    resumed = ClippedAdam(second.parameters(), 0.01, 1e-5, 1.0, 1e-3)
    resumed.load_state_dict(copy.deepcopy(optimizer.state_dict()))
    for network, its in ((first, optimizer), (second, resumed)):
        its.step(network(target).square().sum())
    assert th.equal(first.weight, second.weight) and th.equal(first.bias, second.bias)
