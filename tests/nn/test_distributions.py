"""Draws and densities, against torch's own."""

from __future__ import annotations

import math

import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st

from sb3_dreamer_urlb.nn import distributions
from sb3_dreamer_urlb.nn.distributions import BoundedNormal

weight_lists = st.lists(st.sampled_from([0.0, 0.01, 0.3, 1.0, 5.0]), min_size=2, max_size=8).filter(any)


def _generator(seed=0):
    return th.Generator().manual_seed(seed)


@given(weight_lists, st.integers(0, 1000))
def test_draw_classes_follows_the_probabilities(weights, seed):
    probs, count = th.tensor(weights), 4000
    drawn = distributions.draw_classes(probs.expand(count, -1), _generator(seed))
    observed = drawn.bincount(minlength=len(weights))
    assert observed[probs == 0].sum() == 0
    expected = count * probs / probs.sum()
    possible = probs > 0
    statistic = ((observed - expected).square()[possible] / expected[possible]).sum().item()
    freedom = int(possible.sum()) - 1
    # Five standard deviations above the mean of a chi-square variable, with room for its skew.
    assert statistic <= freedom + 5 * math.sqrt(2 * freedom) + 10


@pytest.mark.parametrize("uniform", [0.0, 1 - 2**-24])
def test_draw_classes_at_the_ends_of_the_uniform(monkeypatch, uniform):
    monkeypatch.setattr(th, "rand", lambda shape, **_: th.full(shape, uniform))
    probs = th.tensor([[0.0, 0.3, 0.0, 0.7, 0.0], [0.0, 0.1, 0.0, 3.3, 0.0]])
    assert distributions.draw_classes(probs).tolist() == [1 if uniform == 0 else 3] * 2


def test_sample_one_hot_is_one_hot_with_straight_through_gradients(seeded):
    logits = th.randn(6, 3, 4, requires_grad=True)
    weight = th.randn(6, 3, 4)
    sample = distributions.sample_one_hot(logits, _generator())
    assert th.allclose(sample.sum(-1), th.ones(6, 3)) and th.allclose(sample.max(-1).values, th.ones(6, 3))
    (ours,) = th.autograd.grad((sample * weight).sum(), logits)
    (softmax,) = th.autograd.grad((logits.softmax(-1) * weight).sum(), logits)
    assert th.allclose(ours, softmax, atol=1e-7)
    plain = distributions.sample_one_hot(logits.detach(), _generator())
    assert th.equal(plain, sample.detach().round()) and set(plain.unique().tolist()) == {0.0, 1.0}


@given(st.integers(0, 2**31))
def test_equal_generators_draw_equally_and_leave_the_global_one_alone(seed):
    logits, normal = th.randn(5, 3, 4), BoundedNormal(th.zeros(5, 2), th.ones(5, 2))
    before = th.get_rng_state()
    drawn = [
        (distributions.sample_one_hot(logits, generator), normal.sample(generator))
        for generator in (_generator(seed), _generator(seed), _generator(seed + 1))
    ]
    assert all(th.equal(a, b) for a, b in zip(drawn[0], drawn[1], strict=True))
    assert not th.equal(drawn[0][1], drawn[2][1])
    assert th.equal(before, th.get_rng_state())


@given(st.integers(0, 1000), st.floats(0.1, 2.1))
def test_bounded_normal_has_the_density_of_the_untruncated_normal(seed, scale):
    generator = _generator(seed)
    mean, std = th.rand(4, 3, generator=generator) * 2 - 1, th.full((4, 3), scale)
    action = th.rand(4, 3, generator=generator) * 2 - 1
    ours, theirs = BoundedNormal(mean, std), th.distributions.Normal(mean, std)
    assert th.allclose(ours.log_prob(action), theirs.log_prob(action).sum(-1), atol=1e-5)
    assert th.allclose(ours.entropy(), theirs.entropy().sum(-1), atol=1e-5)


def test_bounded_normal_clamps_samples_and_passes_gradients_straight_through():
    mean = th.zeros(1000, 1, requires_grad=True)
    std = th.full((1000, 1), 2.0, requires_grad=True)
    noise = distributions.draw_normal((1000, 1), mean, _generator())
    limit = 1 - distributions.ACTION_MARGIN
    sample = BoundedNormal(mean, std).sample(_generator())
    assert th.allclose(sample, (2 * noise).clamp(-limit, limit), atol=1e-6) and sample.abs().max() < 1
    assert (sample.abs() > 0.9999).float().mean() > 0.5  # the clamp had work
    grad_mean, grad_std = th.autograd.grad(sample.sum(), (mean, std))
    assert th.equal(grad_mean, th.ones(1000, 1)) and th.equal(grad_std, noise)
    plain = BoundedNormal(mean.detach(), std.detach()).sample(_generator())
    assert th.equal(plain, (2 * noise).clamp(-limit, limit))


@given(st.integers(0, 1000), st.floats(0.1, 8))
def test_categorical_kl_and_entropy(seed, scale):
    generator = _generator(seed)
    p, q = (scale * th.randn(5, 3, 4, generator=generator) for _ in range(2))
    theirs_p, theirs_q = th.distributions.Categorical(logits=p), th.distributions.Categorical(logits=q)
    kl = th.distributions.kl_divergence(theirs_p, theirs_q).sum(-1)
    assert th.allclose(distributions.categorical_kl(p, q), kl, rtol=1e-4, atol=1e-5)
    assert th.allclose(distributions.categorical_entropy(p), theirs_p.entropy().sum(-1), rtol=1e-4, atol=1e-5)
    assert th.allclose(distributions.categorical_kl(p, p), th.zeros(5), atol=1e-6)


def test_unit_normal_and_image_nll(seeded):
    mean, target = th.randn(2, 5, 3, 6, 6), th.randn(2, 5, 3, 6, 6)
    direct = -th.distributions.Normal(mean, 1.0).log_prob(target)
    assert th.allclose(distributions.unit_normal_nll(mean, target), direct, atol=1e-6)
    assert th.allclose(distributions.image_nll(mean, target), direct.sum((-1, -2, -3)).mean(), rtol=1e-5)


def test_bernoulli_nll(seeded):
    logit, target = th.randn(20), th.randint(0, 2, (20,)).float()
    direct = -th.distributions.Bernoulli(logits=logit).log_prob(target)
    assert th.allclose(distributions.bernoulli_nll(logit, target), direct, atol=1e-6)
