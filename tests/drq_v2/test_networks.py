"""Sizes, beginnings and noise of DrQ-v2's networks."""

from __future__ import annotations

import pytest
import torch as th

from sb3_dreamer_urlb.drq_v2.networks import Actor, Critic, PixelEncoder, Trunk


def test_the_papers_sizes():
    encoder = PixelEncoder(9, 84, 84, 32)
    assert encoder.size == 32 * 35 * 35
    assert [tuple(conv.weight.shape) for conv in encoder.convs] == [(32, 9, 3, 3)] + [(32, 32, 3, 3)] * 3
    assert [conv.stride[0] for conv in encoder.convs] == [2, 1, 1, 1]
    assert encoder(th.zeros(2, 9, 84, 84)).shape == (2, encoder.size)


@pytest.mark.parametrize(("height", "width"), [(16, 16), (17, 40)])
def test_other_sizes(height, width):
    encoder = PixelEncoder(3, height, width, 2)
    assert encoder(th.zeros(1, 3, height, width)).shape == (1, encoder.size)


def test_they_begin_orthogonal_without_biases(seeded):
    encoder, actor, critic = PixelEncoder(3, 16, 16, 4), Actor(20, 2, 5, [8, 8]), Critic(20, 2, 5, [8, 8])
    for name, value in [*encoder.named_parameters(), *actor.named_parameters(), *critic.named_parameters()]:
        if name.endswith("bias"):
            assert not value.any(), name
        if name.endswith("weight") and value.dim() > 1:
            rows = value.detach().flatten(1)
            rows = rows if rows.shape[0] <= rows.shape[1] else rows.T
            gain = 2.0 if value.dim() == 4 else 1.0
            assert th.allclose(rows @ rows.T, gain * th.eye(len(rows)), atol=1e-5), name


def test_the_trunk_is_linear_norm_tanh(seeded):
    trunk, encoding = Trunk(7, 3), th.randn(4, 7)
    linear = encoding @ trunk[0].weight.T
    normal = (linear - linear.mean(-1, keepdim=True)) / (linear.var(-1, unbiased=False, keepdim=True) + 1e-5).sqrt()
    assert th.allclose(trunk(encoding), th.tanh(normal), atol=1e-6)


def test_the_two_critics_share_their_trunk_only(seeded):
    critic = Critic(7, 2, 3, [8, 8])
    encoding, action = th.randn(5, 7), th.rand(5, 2)
    values = critic(encoding, action)
    assert values.shape == (5, 2)
    for i, head in enumerate(critic.heads):
        assert th.allclose(values[:, i], head(th.cat([critic.trunk(encoding), action], -1))[:, 0])
    assert not th.allclose(values[:, 0], values[:, 1])


def test_noise_is_clipped_when_learning_and_not_when_acting(seeded):
    actor, encoding = Actor(7, 2, 3, [8]), th.randn(1, 7).expand(4000, 7)
    policy = actor(encoding, th.tensor(0.2))
    acting, learning = (policy.sample(noise_clip=clip) - policy.mean for clip in (None, 0.3))
    assert acting.std().item() == pytest.approx(0.2, abs=0.01)
    assert acting.abs().max() > 0.5
    assert learning.abs().max().item() == pytest.approx(0.3, abs=1e-6)
    assert th.equal(policy.mode, policy.mean)


def test_samples_stay_in_the_box_and_pass_gradients(seeded):
    actor = Actor(7, 2, 3, [8])
    with th.no_grad():
        actor.body.dense[-1].bias.fill_(3.0)
    sample = actor(th.randn(50, 7), th.tensor(0.5)).sample(noise_clip=0.3)
    assert sample.abs().max() < 1
    sample.sum().backward()
    assert actor.body.dense[-1].bias.grad.abs().min() > 0
