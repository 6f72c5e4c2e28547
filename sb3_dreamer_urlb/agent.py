"""The networks of one agent, in one module: what snapshots hold and transfers copy."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import torch as th
from torch import nn

from sb3_dreamer_urlb.behavior.actor_critic import Actor, RewardNormalizer
from sb3_dreamer_urlb.intrinsic.base import IntrinsicReward
from sb3_dreamer_urlb.nets import MLP
from sb3_dreamer_urlb.types import LatentState
from sb3_dreamer_urlb.world_model.world_model import WorldModel


class Agent(nn.Module):
    """World model, actor, critic with its slow copy, reward normaliser and, while exploring, the intrinsic reward.

    :param world_model: the model
    :param net_arch: hidden layers of actor and critic
    :param intrinsic: class of the intrinsic reward, None for the task's reward
    """

    def __init__(self, world_model: WorldModel, net_arch: Sequence[int], intrinsic: type[IntrinsicReward] | None):
        super().__init__()
        sizes = world_model.sizes
        self.world_model = world_model
        self.actor = Actor(sizes.feature, sizes.action, net_arch)
        self.critic = MLP(sizes.feature, net_arch)
        self.slow_critic = copy.deepcopy(self.critic).requires_grad_(False)
        self.intrinsic = None if intrinsic is None else intrinsic(sizes)
        self.reward_normalizer = RewardNormalizer(1.0 if intrinsic is None else intrinsic.momentum)

    # -- what a planner sees -------------------------------------------------------------------------------------------

    def step(self, state: LatentState, action: th.Tensor, generator: th.Generator | None) -> LatentState:
        """Sample the next state from the prior."""
        return self.world_model.rssm.prior_step(state, action, generator)

    def rewards(self, feature: th.Tensor) -> th.Tensor:
        """The reward head's mean, (…, F) → (…)."""
        return self.world_model.reward(feature)

    def values(self, feature: th.Tensor) -> th.Tensor:
        """The slow critic's mean, (…, F) → (…)."""
        return self.slow_critic(feature)

    def discounts(self, feature: th.Tensor) -> th.Tensor:
        """γ, or γ · p(the episode goes on), (…, F) → (…)."""
        return self.world_model.discount(feature)

    def act(self, feature: th.Tensor, generator: th.Generator | None) -> th.Tensor:
        """Sample the actor, (…, F) → (…, A) in (-1, 1)."""
        return self.actor(feature).sample(generator)
