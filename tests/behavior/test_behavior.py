"""λ-returns, the losses of actor and critic, and what one update changes."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from operator_calls import never_waiting
from tiny import LEARNER, infer

from sb3_dreamer_urlb.agent import Agent
from sb3_dreamer_urlb.behavior import actor_critic
from sb3_dreamer_urlb.behavior.actor_critic import Actor, Critic, RewardNormalizer, SuccessorCritic
from sb3_dreamer_urlb.behavior.returns import lambda_return
from sb3_dreamer_urlb.intrinsic import RewardSource
from sb3_dreamer_urlb.learning.learner import Learner, LearnerConfig


def _trajectory(horizon, seed):
    generator = th.Generator().manual_seed(seed)
    reward, value = (th.randn(n, 3, generator=generator, dtype=th.float64) for n in (horizon, horizon + 1))
    return reward, value, th.rand(horizon, 3, generator=generator, dtype=th.float64)


def _naive(reward, value, discount, lam, t=0):
    """The recursion as it is written."""
    if t == len(reward):
        return value[t]
    return reward[t] + discount[t] * ((1 - lam) * value[t + 1] + lam * _naive(reward, value, discount, lam, t + 1))


@given(st.integers(1, 8), st.floats(0, 1), st.integers(0, 999))
def test_lambda_return_equals_the_recursion(horizon, lam, seed):
    reward, value, discount = _trajectory(horizon, seed)
    returns = lambda_return(reward, value, discount, lam)
    assert returns.shape == reward.shape
    for t in range(horizon):
        assert th.allclose(returns[t], _naive(reward, value, discount, lam, t))


def test_lambda_return_limits():
    reward, value, discount = _trajectory(5, 0)
    one_step, full = (lambda_return(reward, value, discount, lam) for lam in (0.0, 1.0))
    assert th.allclose(one_step, reward + discount * value[1:])
    weights = th.cat([th.ones(1, 3), discount.cumprod(0)])
    assert th.allclose(full[0], (weights[:-1] * reward).sum(0) + weights[-1] * value[-1])


@given(st.integers(2, 8), st.integers(0, 99))
def test_discount_weights_are_products_of_the_discounts_before(horizon, seed):
    discount = th.rand(horizon + 1, 3, generator=th.Generator().manual_seed(seed))
    weight = actor_critic.discount_weights(discount)
    assert weight.shape == (horizon, 3)
    for t in range(horizon):
        assert th.allclose(weight[t], discount[:t].prod(0))


def test_losses_by_hand(seeded):
    returns, entropy, value, weight = (th.randn(4, 3) for _ in range(4))
    target = actor_critic.with_entropy_bonus(returns, entropy, 0.3)
    assert th.equal(target[0], returns[0]) and th.allclose(target[1:], returns[1:] + 0.3 * entropy[:-1])
    assert th.equal(actor_critic.with_entropy_bonus(returns, entropy, 0.0), returns)
    terms = [weight[t, n] * target[t + 1, n] for t in range(3) for n in range(3)]
    assert th.allclose(actor_critic.actor_loss(target, weight), -sum(terms) / 9)
    nll = -th.distributions.Normal(value, 1.0).log_prob(target)
    assert th.allclose(Critic(1, [1]).loss(value, target, weight), (weight * nll).mean(), atol=1e-6)
    squares = weight * (value - target).square()
    assert th.allclose(SuccessorCritic(1, [1], 2).loss(value, target, weight), squares.mean())


def test_reinforce_by_hand(seeded):
    target, weight, log_prob, entropy = (th.randn(4, 3, requires_grad=True) for _ in range(4))
    value = th.randn(5, 3, requires_grad=True)
    loss = actor_critic.reinforce_loss(target, value, weight.detach(), log_prob, entropy, 0.3)
    terms = [
        weight[t, n] * (log_prob[t, n] * (target[t + 1, n] - value[t, n]) + 0.3 * entropy[t, n])
        for t in range(3)
        for n in range(3)
    ]
    assert th.allclose(loss, -sum(terms) / 9)
    gradients = th.autograd.grad(loss, [target, value, log_prob, entropy], allow_unused=True)
    assert gradients[0] is None and gradients[1] is None and all(g[:3].abs().min() > 0 for g in gradients[2:])


@pytest.mark.parametrize(
    ("given", "classes", "chosen"),
    [
        ("auto", (), "dynamics"),
        ("auto", (2, 3), "reinforce"),
        ("dynamics", (2, 3), "dynamics"),
        ("reinforce", (2,), "reinforce"),
    ],
)
def test_which_gradient(given, classes, chosen):
    assert actor_critic.choose_gradient(given, classes) == chosen


def test_actor_distribution(seeded):
    actor = Actor(6, 2, [8, 8])
    feature = 3 * th.randn(50, 6)
    policy, hidden = actor(feature), actor.body.hidden(feature)
    assert th.allclose(policy.mean, actor.body.out(hidden).tanh())
    assert th.allclose(policy.std, 2 * th.sigmoid(actor.out_std(hidden) / 2) + 0.1)


@given(st.lists(st.floats(-100, 100), min_size=1, max_size=6), st.floats(0, 1))
def test_reward_normalizer_is_the_moving_average(sizes, momentum):
    normalizer, scale = RewardNormalizer(momentum), 1.0
    for size in sizes:
        reward = th.tensor([[size, -2 * size], [0.0, size]])
        scale = momentum * scale + (1 - momentum) * abs(size)
        assert th.allclose(normalizer(reward), reward / (scale + 1e-8), rtol=1e-3, atol=1e-4)
        assert normalizer.scale.item() == pytest.approx(scale, rel=1e-4, abs=1e-6)


def test_reward_normalizer_off_and_its_gradients():
    reward = th.tensor([2.0, -4.0], requires_grad=True)
    assert th.allclose(RewardNormalizer(1.0)(reward), reward)
    normalizer = RewardNormalizer(0.5)
    first = normalizer(reward)  # scale 0.5 · 1 + 0.5 · 3 = 2
    normalizer(10 * reward.detach())  # must not change the gradient of the first
    assert th.allclose(th.autograd.grad(first.sum(), reward)[0], th.full((2,), 0.5))
    assert "scale" in normalizer.state_dict()


# -- one update ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("intrinsic", [None, "lbs"])
def test_behaviour_changes_actor_and_critic_only(learner, batch, weights, intrinsic):
    its = learner(intrinsic, discount_head=True)
    posterior = infer(its.agent.world_model, batch)
    before = {name: weights(module) for name, module in its.agent.named_children()}
    its.updates = 1  # no slow copy
    its._update_behavior(posterior.state.detach(), batch.is_terminal)
    changed = {name for name, module in its.agent.named_children() if weights(module) != before[name]}
    # LBS normalises its rewards, the task does not.
    assert changed == {"actor", "critic"} | ({"reward_normalizer"} if intrinsic else set())
    unchanged = [its.agent.world_model, its.agent.slow_critic, its.agent.intrinsic]
    assert all(p.grad is None for module in unchanged if module is not None for p in module.parameters())
    assert all(p.requires_grad for p in its.agent.world_model.parameters())
    assert not any(p.requires_grad for p in its.agent.slow_critic.parameters())


@pytest.mark.parametrize("intrinsic", [None, "lbs"])
def test_each_part_is_trained_by_its_own_optimizer(learner, batch, weights, intrinsic):
    names = {
        "learning_rate": {"world_model", "intrinsic"},
        "actor_learning_rate": {"actor"},
        "critic_learning_rate": {"critic"},
    }
    for rate, parts in names.items():
        its = learner(intrinsic, **{name: 1e-3 if name == rate else 0.0 for name in names})
        its.updates = 1
        before = {name: weights(module) for name, module in its.agent.named_children()}
        its.update(batch)
        changed = {name for name, module in its.agent.named_children() if weights(module) != before[name]}
        assert changed - {"reward_normalizer"} == parts & set(before)


@pytest.mark.parametrize("sign", [1, -1])
def test_actor_climbs_the_imagined_reward(learner, batch, sign):
    """With the model fixed, behaviour updates raise a reward that depends smoothly on the actions."""
    its = learner(learning_rate=0.0, gae_lambda=1.0)
    with th.no_grad():
        its.agent.world_model.rssm.input.weight[:, -2:] *= 20  # actions matter

    class Deterministic(RewardSource):
        def reward(self, imagination, reward_head):
            return sign * imagination.feature[..., -8:].sum(-1)

    its.reward_source = Deterministic()
    posterior = infer(its.agent.world_model, batch)
    state = posterior.state.detach()

    def imagined(actor_learning_rate, updates):
        its.actor_optimizer.set_learning_rate(actor_learning_rate)
        return th.stack([its._update_behavior(state, batch.is_terminal)["imagined_reward"] for _ in range(updates)])

    before = imagined(0.0, 40)
    imagined(1e-2, 150)
    after = imagined(0.0, 40)
    assert after.mean() > before.mean() + before.std()


@pytest.mark.parametrize("gradient", ["dynamics", "reinforce"])
def test_choices_climb_the_imagined_reward(world_model, batch, gradient):
    """The reward is the first of two classes; the model remembers the choice in its state, and nothing else."""
    agent = Agent(world_model(), [8], None, classes=(2,))
    its = Learner(agent, LearnerConfig(**{**LEARNER, "learning_rate": 0.0, "actor_gradient": gradient}))

    class FirstClass(RewardSource):
        def reward(self, imagination, reward_head):
            # With a gradient only where there is one to follow; "reinforce" must not need it.
            chosen = imagination.action[..., 0]
            return chosen if gradient == "dynamics" else chosen.detach()

    its.reward_source = FirstClass()
    state = infer(agent.world_model, batch).state.detach()
    its.actor_optimizer.set_learning_rate(3e-3)
    rewards = [its._update_behavior(state, batch.is_terminal)["imagined_reward"].item() for _ in range(100)]
    # Three of four imagined states follow a choice.
    assert np.mean(rewards[:10]) < 0.5 and np.mean(rewards[-10:]) > 0.7


@pytest.mark.parametrize("gradient", ["dynamics", "reinforce"])
def test_nothing_is_learnt_from_choices_after_the_end(world_model, batch, gradient):
    """A dream that begins in a terminal state: its choices weigh nothing, its value is its reward."""
    agent = Agent(world_model(discount_head=True), [8], None, classes=(2,))
    config = {**LEARNER, "actor_gradient": gradient, "critic_learning_rate": 0.0, "ent_coef": 0.1}
    its = Learner(agent, LearnerConfig(**config))
    state = infer(agent.world_model, batch).state.detach()
    norm = {
        ended: its._update_behavior(state, th.full_like(batch.is_terminal, ended))["actor_grad_norm"].item()
        for ended in (True, False)
    }
    assert norm[True] == 0 and norm[False] > 0


def test_entropy_bonus_widens_the_actor(learner, batch):
    def entropy(ent_coef):
        its = learner(actor_learning_rate=1e-2, ent_coef=ent_coef)
        for _ in range(30):
            metrics = its.update(batch)
        return metrics["actor_entropy"].item()

    assert entropy(1.0) > entropy(0.0) + 0.1


def test_slow_critic_copies_at_updates_0_k_2k(learner, batch, weights):
    its = learner(target_update_interval=3)
    for update in range(8):
        before = weights(its.agent.slow_critic)
        its.update(batch)
        copied = weights(its.agent.slow_critic) == weights(its.agent.critic)
        assert copied == (update % 3 == 0)
        if not copied:
            assert weights(its.agent.slow_critic) == before


def test_intrinsic_module_learns_from_the_pass_before_the_model_step(learner, batch):

    its = learner("lbs")
    twin = copy.deepcopy(its.agent)
    th.manual_seed(5)
    metrics = its.update(batch)
    th.manual_seed(5)
    posterior = infer(twin.world_model, batch)
    loss, _ = twin.intrinsic.loss(posterior, batch)
    assert th.allclose(metrics["intrinsic_loss"], loss)


@pytest.mark.parametrize("kind", [None, "lbs", "choices"])
def test_an_update_never_asks_the_device_for_a_value(learner, world_model, batch, monkeypatch, kind):
    if kind == "choices":
        agent = Agent(world_model(discount_head=True), [8], None, classes=(2,))
        its = Learner(agent, LearnerConfig(**LEARNER, actor_gradient="reinforce"))
    else:
        its = learner(kind, discount_head=True)
    its.update(batch)  # anything that torch sets up once

    with never_waiting("an update"):
        metrics = its.update(batch)
    assert all(isinstance(value, th.Tensor) and not value.requires_grad and value.dim() == 0 for value in metrics.values())
    assert all(len(f"train/{name}") <= 36 for name in metrics)
