"""The networks of one agent, in one module: what snapshots hold and transfers copy."""

from __future__ import annotations

import copy
import functools
from collections.abc import Sequence

import torch as th
from torch import nn

from sb3_dreamer_urlb.behavior.actor_critic import Actor, CategoricalActor, Critic, RewardNormalizer, SuccessorCritic
from sb3_dreamer_urlb.intrinsic.base import IntrinsicReward
from sb3_dreamer_urlb.intrinsic.skills import Skills
from sb3_dreamer_urlb.nn.nets import MLP
from sb3_dreamer_urlb.types import LatentState
from sb3_dreamer_urlb.world_model.world_model import WorldModel


class Agent(nn.Module):
    """World model, actor, critic with its slow copy, reward normaliser and, while exploring, the intrinsic reward.

    :param world_model: the model
    :param net_arch: hidden layers of actor and critic
    :param intrinsic: what it explores with, not yet built; None for an agent without skills that learns a task
    :param explores: the intrinsic reward drives the actor; False leaves only its skills in use
    :param classes: number of classes of each choice that is an action; empty where actions are numbers
    :param task_reward: while exploring with a reward that the reward head learns, learn the task's beside it (paper, appendix
        "Learning Rewards Online"); names of tasks: while exploring, learn the rewards of all of them, a head each
    """

    def __init__(
        self,
        world_model: WorldModel,
        net_arch: Sequence[int],
        intrinsic: IntrinsicReward | None,
        explores: bool = True,
        classes: Sequence[int] = (),
        task_reward: bool | Sequence[str] = False,
    ):
        super().__init__()
        sizes = world_model.sizes
        self.world_model = world_model
        self.intrinsic = copy.deepcopy(intrinsic)
        self.explores = explores and intrinsic is not None
        if self.intrinsic is not None:
            self.intrinsic.build(sizes)
        skill_size = 0 if self.skills is None else self.skills.dim
        critic_class = SuccessorCritic if intrinsic is not None and intrinsic.successor_features else Critic
        self.actor: Actor | CategoricalActor
        if classes:
            self.actor = CategoricalActor(sizes.feature, classes, net_arch, skill_size)
        else:
            self.actor = Actor(sizes.feature, sizes.action, net_arch, skill_size)
        self.critic = critic_class(sizes.feature, net_arch, skill_size)
        self.slow_critic = copy.deepcopy(self.critic).requires_grad_(False)
        self.reward_normalizer = RewardNormalizer(intrinsic.momentum if self.explores and intrinsic is not None else 1.0)
        self.task_reward: MLP | None = None
        self.task_rewards: nn.ModuleDict | None = None
        # Everything else begins as it does without these heads.
        with th.random.fork_rng(devices=[]):
            if not isinstance(task_reward, bool) and self.explores:
                self.task_rewards = nn.ModuleDict({name: MLP(sizes.feature, net_arch) for name in task_reward})
            elif task_reward and self.explores and intrinsic is not None and intrinsic.labels_replay:
                self.task_reward = MLP(sizes.feature, net_arch)

    @property
    def skills(self) -> Skills | None:
        """What actor and critic are conditioned on, None for a method without skills."""
        return None if self.intrinsic is None else self.intrinsic.skills

    def known_reward(self, task: str | None = None) -> MLP | None:
        """The head that has learnt the task's reward; None if the only one learns the intrinsic reward.

        :param task: which of several, where several are learnt; None is returned for another one
        """
        if self.task_rewards is not None:
            found = None if task is None or task not in self.task_rewards else self.task_rewards[task]
            return found  # type: ignore[return-value]
        if self.task_reward is not None:
            return self.task_reward
        taken = self.explores and self.intrinsic is not None and self.intrinsic.labels_replay
        return None if taken else self.world_model.reward

    def acts_randomly(self) -> bool:
        """Whether exploration is nothing but uniformly random actions."""
        return self.explores and self.intrinsic is not None and not self.intrinsic.trains_actor

    def trains_behavior(self) -> bool:
        """Whether actor and critic have something to learn now.

        Not while random actions explore, and not in fine-tuning before its skill is chosen (docs/algorithm.md, "Skills").
        """
        if self.explores:
            return not self.acts_randomly()
        return self.skills is None or self.skills.is_fixed


class PlannedAgent:
    """All that a planner sees of an agent: a few verbs, with one skill for each environment.

    :param agent: the networks
    :param skill: that each of the n environments follows, float (n, W); W is 0 without skills
    """

    def __init__(self, agent: Agent, skill: th.Tensor):
        self.agent = agent
        self.skill = skill if agent.skills is not None else None

    @functools.cached_property
    def _stoch_rows(self) -> th.Tensor:
        return self.agent.world_model.rssm.stoch_rows()

    def step(self, state: LatentState, action: th.Tensor, generator: th.Generator | None) -> LatentState:
        """Sample the next state from the prior."""
        return self.agent.world_model.rssm.planning_step(state, action, self._stoch_rows, generator)

    def imagine(self, state: LatentState, action: th.Tensor, generator: th.Generator | None) -> th.Tensor:
        """What the heads read of states 1 … H, sampled from the prior with the actions (n·M, H, A): (H, n·M, F)."""
        states = []
        for its in action.unbind(1):
            state = self.step(state, its, generator)
            states.append(state)
        return self.features(states)

    def features(self, states: Sequence[LatentState]) -> th.Tensor:
        """What the heads read of T successive states, (T, n·M, F)."""
        return th.stack([state.feature for state in states])

    def rewards(self, feature: th.Tensor) -> th.Tensor:
        """The reward head's mean, (…, n·M, F) → (…, n·M)."""
        return self.agent.world_model.reward(feature)

    def values(self, feature: th.Tensor) -> th.Tensor:
        """The slow critic's mean, (…, n·M, F) → (…, n·M)."""
        return self.agent.slow_critic(feature, self._skill_of(feature))

    def discounts(self, feature: th.Tensor) -> th.Tensor:
        """γ, or γ · p(the episode goes on), (…, n·M, F) → (…, n·M)."""
        return self.agent.world_model.discount(feature)

    def act(self, feature: th.Tensor, generator: th.Generator | None) -> th.Tensor:
        """Sample the actor, (…, n·M, F) → (…, n·M, A)."""
        return self.agent.actor(feature, self._skill_of(feature)).sample(generator)

    def _skill_of(self, feature: th.Tensor) -> th.Tensor | None:
        """The skill of each row: M rows in a row belong to one environment, float (n·M, W)."""
        if self.skill is None:
            return None
        return self.skill.repeat_interleave(feature.shape[-2] // self.skill.shape[0], 0)
