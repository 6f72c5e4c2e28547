"""Where rewards come from: one interface for the task's reward and for every intrinsic one."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import torch as th
from torch import nn

from sb3_dreamer_urlb.intrinsic.method import ExplorationMethod
from sb3_dreamer_urlb.intrinsic.skills import Skills
from sb3_dreamer_urlb.types import Imagination, Metrics, ModelSizes, Posterior, SequenceBatch

#: features (…, F) → predicted rewards (…)
RewardHead = Callable[[th.Tensor], th.Tensor]


class RewardSource(nn.Module):
    """Where the rewards of imagined states come from. As it stands: from the environment, through the reward head.

    The world model's reward head learns :meth:`replay_reward`, the actor seeks :meth:`reward`. Fine-tuning uses this class
    itself, pre-training one of the subclasses below :class:`IntrinsicReward`.
    """

    #: μ of the reward normaliser; 1 switches it off (docs/algorithm.md, "Behaviour")
    momentum: ClassVar[float] = 1.0

    @property
    def labels_replay(self) -> bool:
        """Whether the reward head learns a reward of this module's own in place of the task's (ICM, RND)."""
        return type(self).replay_reward is not RewardSource.replay_reward

    @property
    def makes_rewards(self) -> bool:
        """Whether the actor seeks anything else than the environment's rewards."""
        return self.labels_replay or type(self).reward is not RewardSource.reward

    def loss(self, posterior: Posterior, batch: SequenceBatch) -> tuple[th.Tensor, Metrics] | None:
        """What the module itself learns from a replayed batch; None if there is nothing to learn.

        :param posterior: of the world model's pass of this same update, *before* its optimiser step; detached
        :param batch: the replayed rows
        :return: loss (scalar) and metrics (detached scalars, logged as ``train/intrinsic_<name>``)
        """
        return None

    def replay_reward(self, posterior: Posterior, batch: SequenceBatch) -> th.Tensor:
        """What the reward head learns for the replayed states: the environment's rewards, float (B, T).

        Called after the module's own step.

        :param posterior: as for :meth:`loss`
        :param batch: the replayed rows
        """
        return batch.reward

    def reward(self, imagination: Imagination, reward_head: RewardHead) -> th.Tensor:
        """Rewards of all imagined states, with gradients to them: the reward head's mean, float (H + 1, N).

        :param imagination: what the actor dreamt
        :param reward_head: of the world model
        """
        return reward_head(imagination.seen)


class IntrinsicReward(ExplorationMethod, RewardSource):
    """A reward the agent makes for itself while it pre-trains.

    A subclass takes its hyperparameters in ``__init__`` and makes its networks in :meth:`build`. Then it overrides

    - :meth:`loss`, if there is any: what its networks learn; the learner owns the optimiser,
    - :meth:`reward`: where the reward can be computed in imagination, or
    - :meth:`replay_reward`: where it needs real observations; the world model's reward head then learns it.

    One that overrides neither of the last two is refused, unless it acts at random (``trains_actor = False``).

    What snapshots must hold is a parameter or a buffer. See docs/howto/intrinsic_reward.md for an example.
    """

    reads: ClassVar[str] = "a world model"
    momentum: ClassVar[float] = 0.95
    #: entropy bonus of the actor while exploring with this reward
    ent_coef: ClassVar[float] = 0.0
    #: the critic learns successor features ψ with value = ψ · w instead of values (APS)
    successor_features: ClassVar[bool] = False

    def __init__(self) -> None:
        super().__init__()
        #: what conditions actor and critic, None for a method without skills
        self.skills: Skills | None = None

    def build(self, sizes: ModelSizes) -> None:
        """Make the networks. Called once, on a copy of what the user handed in.

        :param sizes: of the world model whose features are read
        """

    def check(self, particles: int) -> None:
        """Refuse hyperparameters that do not fit the run, before any time is spent.

        :param particles: imagined states of an update, (H + 1) · B · T
        :raises ValueError: if they do not
        """
