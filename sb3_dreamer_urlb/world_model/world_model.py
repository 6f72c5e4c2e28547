"""The world model: what the agent learns from observations, with or without rewards."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch as th
from torch import nn

from sb3_dreamer_urlb.nn import distributions
from sb3_dreamer_urlb.nn.distributions import BoundedNormal, OneHotChoices
from sb3_dreamer_urlb.nn.nets import MLP
from sb3_dreamer_urlb.nn.precision import short
from sb3_dreamer_urlb.spaces.observations import Observations
from sb3_dreamer_urlb.types import Imagination, LatentState, Metrics, ModelSizes, Observation, Posterior
from sb3_dreamer_urlb.world_model.decoder import make_decoder
from sb3_dreamer_urlb.world_model.encoder import make_encoder
from sb3_dreamer_urlb.world_model.kl_balance import balanced_kl
from sb3_dreamer_urlb.world_model.rssm import RSSM


class Acts(Protocol):
    """Anything that turns features, and the skills followed, into an action distribution."""

    def __call__(self, feature: th.Tensor, skill: th.Tensor | None = None) -> BoundedNormal | OneHotChoices: ...


class WorldModel(nn.Module):
    """Encoder, RSSM, decoder and reward head (Hafner et al., 2021); a discount head where episodes can terminate.

    :param observations: what it sees
    :param action_size: A
    :param cnn_depth: channels of the first convolution
    :param deter_size: D
    :param hidden_size: width of the layers around the GRU
    :param stoch_variables: S
    :param stoch_classes: K
    :param net_arch: hidden layers of the heads, and of the encoder and decoder of vectors
    :param gamma: discount factor of a state that does not terminate
    :param discount_head: learn which states terminate
    """

    def __init__(
        self,
        observations: Observations,
        action_size: int,
        cnn_depth: int,
        deter_size: int,
        hidden_size: int,
        stoch_variables: int,
        stoch_classes: int,
        net_arch: Sequence[int],
        gamma: float,
        discount_head: bool,
    ):
        super().__init__()
        self.gamma = gamma
        self.observations = observations
        self.encoder = make_encoder(observations, cnn_depth, net_arch)
        embed = self.encoder.embed_size
        self.rssm = RSSM(action_size, embed, deter_size, hidden_size, stoch_variables, stoch_classes)
        feature = self.rssm.stoch_size + deter_size
        self.decoder = make_decoder(observations, feature, cnn_depth, net_arch)
        self.reward = MLP(feature, net_arch)
        self.discount_logit = MLP(feature, net_arch) if discount_head else None
        self.sizes = ModelSizes(action_size, embed, feature, deter_size, tuple(net_arch), observations, cnn_depth)

    def preprocess(self, observation: Observation) -> Observation:
        """What the networks see and predict: images → float32 in [-0.5, 0.5]; vectors and classes → float32 vectors."""
        return self.observations.preprocess(observation)

    # -- learning ------------------------------------------------------------------------------------------------------

    def loss(
        self,
        posterior: Posterior,
        observation: Observation,
        reward: th.Tensor,
        is_terminal: th.Tensor,
        free_nats: float,
        kl_balance: float,
        reward_trains_model: bool,
        kl_scale: float = 1.0,
    ) -> tuple[th.Tensor, Metrics]:
        """The negative evidence lower bound of a replayed batch (docs/algorithm.md, "World model").

        :param posterior: what :meth:`observe` inferred about it, with its graph
        :param observation: that it was inferred from, preprocessed, (B, T, …)
        :param reward: what the reward head learns, float (B, T)
        :param is_terminal: bool (B, T), what the discount head learns
        :param free_nats: the KL below which the model is not pushed; applied to the batch mean
        :param kl_balance: share of the KL's gradient that trains the prior
        :param reward_trains_model: False stops the reward head's gradient before the model (pre-training)
        :param kl_scale: weight of the KL
        :return: loss (scalar) and metrics (detached scalars)
        """
        kl_loss = balanced_kl(posterior.post_logits, posterior.prior_logits, free_nats, kl_balance)
        seen_losses = self.observations.losses(self.decoder(posterior.feature), observation)
        reward_feature = posterior.feature if reward_trains_model else posterior.feature.detach()
        reward_nll = distributions.unit_normal_nll(self.reward(reward_feature), reward).mean()
        loss = kl_scale * kl_loss + sum(seen_losses.values()) + reward_nll
        metrics = {"kl_loss": kl_loss, **seen_losses, "reward_loss": reward_nll, "kl": posterior.kl.mean()}
        if self.discount_logit is not None:
            goes_on = (~is_terminal).to(reward.dtype)
            discount_nll = distributions.bernoulli_nll(self.discount_logit(posterior.feature), goes_on).mean()
            loss = loss + discount_nll
            metrics["discount_loss"] = discount_nll
        with th.no_grad():
            metrics["prior_entropy"] = distributions.categorical_entropy(posterior.prior_logits).mean()
            metrics["posterior_entropy"] = distributions.categorical_entropy(posterior.post_logits).mean()
        return loss, {name: value.detach() for name, value in metrics.items()}

    def observe(self, observation: Observation, action: th.Tensor, is_first: th.Tensor) -> Posterior:
        """Infer the states behind sequences of observations.

        :param observation: preprocessed, (B, T, …)
        :param action: float (B, T, A), the action that led to each
        :param is_first: bool (B, T)
        """
        embed = self.encoder(observation)
        state, post_logits, prior_logits = self.rssm.observe(embed, action, is_first)
        with th.no_grad():
            kl = distributions.categorical_kl(post_logits, prior_logits)
        return Posterior(state, state.feature, embed, post_logits, prior_logits, kl)

    # -- dreaming ------------------------------------------------------------------------------------------------------

    def imagine(self, actor: Acts, start: LatentState, horizon: int, skill: th.Tensor | None = None) -> Imagination:
        """Let the actor act inside the model (paper §2; gradients flow through the dynamics to its actions).

        :param actor: sees features cut from the graph
        :param start: where the dreams begin, (N, …)
        :param horizon: H, number of steps
        :param skill: that the actor follows in each dream, float (N, W)
        """
        state = start
        action = start.deter.new_zeros(start.deter.shape[0], self.sizes.action)
        seen, actions, entropies = [short(state.feature)], [action], []
        for _ in range(horizon):
            policy = actor(seen[-1].detach(), skill)
            action = policy.sample()
            state = self.rssm.prior_step(state, action)
            seen.append(th.cat([state.stoch, short(state.deter)], -1))
            actions.append(action)
            entropies.append(policy.entropy())
        return Imagination(th.stack(seen), th.stack(actions), th.stack(entropies), skill)

    def discount(self, feature: th.Tensor, goes_on: th.Tensor | None = None) -> th.Tensor:
        """How much the future after each state counts: γ, or γ · p(the episode goes on) with a discount head, (…).

        :param feature: float (…, F); (H + 1, N, F) of dreams if ``goes_on`` is given
        :param goes_on: what is known about the states where the dreams begin, 0 or 1, float (N,): needs no guess
        """
        if self.discount_logit is None:
            return th.full_like(feature[..., 0], self.gamma)
        probability = th.sigmoid(self.discount_logit(feature))
        if goes_on is not None:
            probability = th.cat([goes_on.unsqueeze(0), probability[1:]])
        return self.gamma * probability
