"""Encoder, RSSM, decoder, heads and loss of the world model."""

from __future__ import annotations

import golden
import numpy as np
import pytest
import torch as th
import torch.nn.functional as F
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from tiny import infer

from sb3_dreamer_urlb.spaces.observations import Images
from sb3_dreamer_urlb.types import LatentState
from sb3_dreamer_urlb.world_model.decoder import ConvDecoder, deconvolution_kernels
from sb3_dreamer_urlb.world_model.encoder import ConvEncoder
from sb3_dreamer_urlb.world_model.kl_balance import balanced_kl
from sb3_dreamer_urlb.world_model.world_model import WorldModel


def _sequence(model, is_first):
    lead = is_first.shape
    return th.randn(*lead, model.sizes.embed), th.rand(*lead, model.sizes.action) * 2 - 1, is_first


def _loop(rssm, embed, action, is_first):
    """What acting does: one posterior step after the other."""
    state, states = rssm.initial(embed.shape[0]), []
    for t in range(embed.shape[1]):
        state = rssm.posterior_step(state, action[:, t], embed[:, t], is_first[:, t])
        states.append(state)
    return th.stack([s.stoch for s in states], 1), th.stack([s.deter for s in states], 1)


# -- RSSM ------------------------------------------------------------------------------------------------------------------


@given(st.lists(st.booleans(), min_size=1, max_size=7), st.integers(0, 99))
def test_observe_equals_a_loop_of_posterior_steps(flags, seed):
    th.manual_seed(seed)
    model = WorldModel(Images(spaces.Box(0, 255, (3, 16, 16), np.uint8)), 2, 1, 8, 8, 3, 4, [8], 0.99, False)
    is_first = th.tensor([flags, flags[::-1]])
    with th.no_grad(), golden.deterministic_draws():
        sequence = _sequence(model, is_first)
        state, post_logits, prior_logits = model.rssm.observe(*sequence)
        stoch, deter = _loop(model.rssm, *sequence)
        assert th.allclose(state.deter, deter, atol=1e-6) and th.equal(state.stoch, stoch)
        assert post_logits.shape == prior_logits.shape == (2, len(flags), 3, 4)
        # The prior that imagination samples is the one that the KL compares with.
        previous = type(state)(stoch[:, 0], deter[:, 0])
        if len(flags) > 1 and not is_first[:, 1].any():
            imagined = model.rssm.prior_step(previous, sequence[1][:, 1])
            assert th.allclose(imagined.deter, deter[:, 1], atol=1e-6)
            assert th.equal(imagined.stoch, F.one_hot(prior_logits[:, 1].argmax(-1), 4).float().flatten(1))


def test_is_first_makes_a_state_independent_of_what_came_before(world_model):
    rssm = (model := world_model()).rssm
    is_first = th.tensor([[True, False, True, False, False]])
    with th.no_grad(), golden.deterministic_draws():
        embed, action, _ = _sequence(model, is_first)
        other_embed, other_action = embed.clone(), action.clone()
        other_embed[:, :2] += 1
        other_action[:, :3] = -other_action[:, :3]  # also the action that leads over the border
        first, *logits = rssm.observe(embed, action, is_first)
        second, *other_logits = rssm.observe(other_embed, other_action, is_first)
        assert th.equal(first.feature[:, 2:], second.feature[:, 2:])
        assert all(th.equal(a[:, 2:], b[:, 2:]) for a, b in zip(logits, other_logits, strict=True))
        assert not th.allclose(first.deter[:, 1], second.deter[:, 1])
        # Without the flag, history matters.
        no_reset = th.tensor([[True, False, False, False, False]])
        later = [rssm.observe(e, a, no_reset)[0].deter[:, 2] for e, a in ((embed, action), (other_embed, other_action))]
        assert not th.allclose(*later)


def test_the_action_leads_to_the_state_of_its_own_row(world_model):
    model = world_model()
    is_first = th.tensor([[True, False, False]])
    with th.no_grad(), golden.deterministic_draws():
        embed, action, _ = _sequence(model, is_first)
        changed = action.clone()
        changed[:, 1] *= -1
        first, second = (model.rssm.observe(embed, a, is_first)[0].deter for a in (action, changed))
    assert th.equal(first[:, 0], second[:, 0]) and not th.allclose(first[:, 1], second[:, 1])


def test_gru_step_follows_the_written_formula(world_model):
    rssm = world_model().rssm
    with th.no_grad(), golden.deterministic_draws():
        state = type(rssm.initial(4))(th.randn(4, 12), th.randn(4, 8))
        action = th.randn(4, 2)
        x = F.elu(rssm.input(th.cat([state.stoch, action], -1)))
        reset, candidate, update = rssm.gru_norm(rssm.gru(th.cat([x, state.deter], -1))).chunk(3, -1)
        update = th.sigmoid(update - 1)
        expected = update * th.tanh(th.sigmoid(reset) * candidate) + (1 - update) * state.deter
        assert th.allclose(rssm.prior_step(state, action).deter, expected, atol=1e-6)


# -- images ----------------------------------------------------------------------------------------------------------------


@given(st.integers(16, 128), st.integers(16, 128), st.integers(1, 4))
def test_every_image_size_comes_back(height, width, channels):
    shape = (channels, height, width)
    encoder, decoder = ConvEncoder(shape, 1), ConvDecoder(5, shape, 1)
    with th.no_grad():
        assert encoder(th.zeros(2, 3, *shape)).shape == (2, 3, encoder.embed_size)
        assert decoder(th.zeros(2, 3, 5)).shape == (2, 3, *shape)


def test_the_authors_sizes_at_64_pixels():
    encoder, decoder = ConvEncoder((3, 64, 64), 48), ConvDecoder(1224, (3, 64, 64), 48)
    assert encoder.embed_size == 1536 and [conv.out_channels for conv in encoder.convs] == [48, 96, 192, 384]
    assert deconvolution_kernels(64) == [5, 5, 6, 6]
    assert [deconv.kernel_size for deconv in decoder.deconvs] == [(5, 5), (5, 5), (6, 6), (6, 6)]
    assert decoder.input.out_features == 1536 and [conv.out_channels for conv in decoder.deconvs] == [192, 96, 48, 3]


def test_embedding_is_flattened_channel_first_and_the_decoder_ends_with_elu(world_model):
    model = world_model()
    image = th.rand(2, 3, 16, 16) - 0.5
    with th.no_grad():
        x = image
        for conv in model.encoder.convs:
            x = F.elu(conv(x))
        assert th.allclose(model.encoder(image), x.flatten(1), atol=1e-6)
        feature = 10 * th.randn(2, model.sizes.feature)
        y = model.decoder.input(feature)[:, :, None, None]
        for deconv in model.decoder.deconvs:
            y = F.elu(deconv(y))
        assert th.allclose(model.decoder(feature), y, atol=1e-5)


def test_preprocess_ends_at_half(world_model):
    assert world_model().preprocess(th.tensor([0, 255], dtype=th.uint8)).tolist() == [-0.5, 0.5]


# -- loss ------------------------------------------------------------------------------------------------------------------


def _kl(p, q):
    categorical = th.distributions.Categorical
    return th.distributions.kl_divergence(categorical(logits=p), categorical(logits=q)).sum(-1).mean()


@given(st.floats(0, 1))
def test_kl_balance_splits_the_gradient(balance):
    generator = th.Generator().manual_seed(0)
    post, prior = (th.randn(2, 3, 3, 4, generator=generator).requires_grad_() for _ in range(2))
    loss = balanced_kl(post, prior, 0.0, balance)
    assert th.allclose(loss, _kl(post, prior), rtol=1e-4)
    grad_post, grad_prior = th.autograd.grad(loss, (post, prior))
    full_post, full_prior = th.autograd.grad(_kl(post, prior), (post, prior))
    assert th.allclose(grad_post, (1 - balance) * full_post, atol=1e-6)
    assert th.allclose(grad_prior, balance * full_prior, atol=1e-6)


def test_free_nats_bound_the_mean_not_each_state():
    post = th.zeros(1, 2, 1, 2, requires_grad=True)
    prior = th.zeros(1, 2, 1, 2)
    prior[0, 0, 0, 0] = 8.0  # KL ≈ 3.3 there, 0 at the other state: 1.65 on average
    mean = _kl(post, prior)
    above = balanced_kl(post, prior, 1.0, 0.8)
    assert th.allclose(above, mean)
    below = balanced_kl(post, prior, 2.0, 0.8)
    assert below.item() == pytest.approx(2.0)
    assert th.autograd.grad(below, post)[0].abs().sum() == 0 and th.autograd.grad(above, post)[0].abs().sum() > 0


def test_loss_is_the_sum_of_its_parts(world_model, batch):
    model = world_model(discount_head=True)
    with golden.deterministic_draws():
        posterior = infer(model, batch)
        image = model.preprocess(batch.observation)
        loss, metrics = model.loss(posterior, image, batch.reward, batch.is_terminal, 0.0, 0.8, True)
        image = model.preprocess(batch.observation)
        decoded = model.decoder(posterior.feature)
        normal = th.distributions.Normal
        parts = {
            "kl_loss": posterior.kl.mean(),
            "image_loss": -normal(decoded, 1.0).log_prob(image).sum((-1, -2, -3)).mean(),
            "reward_loss": -normal(model.reward(posterior.feature), 1.0).log_prob(batch.reward).mean(),
            "discount_loss": F.binary_cross_entropy_with_logits(
                model.discount_logit(posterior.feature), 1 - batch.is_terminal.float()
            ),
        }
    for name, value in parts.items():
        assert th.allclose(metrics[name], value, rtol=1e-4, atol=1e-5), name
    assert th.allclose(loss, sum(parts.values()), rtol=1e-4)
    assert not any(value.requires_grad for value in metrics.values())


def test_weight_of_the_kl(world_model, batch):
    model = world_model(discount_head=True)
    with golden.deterministic_draws():
        posterior = infer(model, batch)
        image = model.preprocess(batch.observation)

        def loss(*scale):
            return model.loss(posterior, image, batch.reward, batch.is_terminal, 0.0, 0.8, True, *scale)

        plain, metrics = loss()
        weighed, same = loss(0.1)
    assert th.allclose(weighed, plain - 0.9 * metrics["kl_loss"], rtol=1e-5)
    assert same == metrics  # they tell the loss, not its weight


@pytest.mark.parametrize("trains", [True, False])
def test_rewards_reach_the_model_only_if_they_may(world_model, batch, trains):
    model = world_model()

    def gradients(reward):
        model.zero_grad()
        with golden.deterministic_draws():
            posterior, image = infer(model, batch), model.preprocess(batch.observation)
            model.loss(posterior, image, reward, batch.is_terminal, 0.0, 0.8, trains)[0].backward()
        return {name: parameter.grad.clone() for name, parameter in model.named_parameters()}

    first, second = gradients(batch.reward), gradients(batch.reward + 5)
    changed = {name.split(".")[0] for name in first if not th.equal(first[name], second[name])}
    assert changed == ({"encoder", "rssm", "reward"} if trains else {"reward"})


def test_discount(world_model):
    model = world_model()
    feature = th.randn(4, 5, model.sizes.feature)
    assert th.equal(model.discount(feature), th.full((4, 5), 0.99))
    model = world_model(discount_head=True)
    guessed = 0.99 * model.discount_logit(feature).sigmoid()
    assert th.allclose(model.discount(feature), guessed)
    # Where the dreams begin, the replay knows.
    known = model.discount(feature, th.tensor([1.0, 0.0, 1.0, 0.0, 0.0]))
    assert th.allclose(known[0], th.tensor([0.99, 0.0, 0.99, 0.0, 0.0])) and th.allclose(known[1:], guessed[1:])


def test_discount_head_learns_which_states_terminate(learner, batch):
    its = learner(discount_head=True, learning_rate=1e-2)
    for _ in range(60):
        its.update(batch)
    model = its.agent.world_model
    with th.no_grad():
        posterior = model.observe(model.preprocess(batch.observation), batch.action, batch.is_first)
        discount = model.discount(posterior.feature)
    assert discount[batch.is_terminal].max() < 0.2 and discount[~batch.is_terminal].min() > 0.8


def test_imagination(learner):
    agent = learner().agent
    start = agent.world_model.rssm.initial(6)
    imagination = agent.world_model.imagine(agent.actor, start, 4)
    assert imagination.feature.shape == (5, 6, agent.world_model.sizes.feature)
    assert imagination.action.shape == (5, 6, 2) and imagination.entropy.shape == (4, 6)
    assert th.equal(imagination.feature[0], start.feature) and imagination.action[0].abs().sum() == 0
    # The dynamics carry gradients to the actor; the actor does not see through its own features.
    expected = agent.actor(imagination.feature[2].detach()).entropy()
    assert th.allclose(imagination.entropy[2], expected)
    (gradient,) = th.autograd.grad(imagination.feature[-1].square().sum(), [agent.actor.body.out.weight])
    assert gradient.abs().sum() > 0


def test_planning_step_is_the_prior_step(world_model):
    """One after the other with the same draws: the first state is any, the others carry their classes."""
    rssm = world_model().rssm
    ours = theirs = LatentState(th.rand(6, rssm.stoch_size), th.randn(6, rssm.deter_size))
    with th.no_grad():
        for step in range(4):
            action, generators = th.rand(6, 2), [th.Generator().manual_seed(step) for _ in range(2)]
            ours = rssm.planning_step(ours, action, rssm.stoch_rows(), generators[0])
            theirs = rssm.prior_step(theirs, action, generators[1])
            assert theirs.classes is None and ours.classes.shape == (6, 3)
            assert th.equal(ours.stoch, theirs.stoch) and th.allclose(ours.deter, theirs.deter, atol=1e-6)
            assert th.equal(ours.stoch.gather(1, ours.classes), th.ones(6, 3)) and ours.stoch.sum() == 18
