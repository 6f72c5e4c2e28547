"""DIAYN (Eysenbach et al., 2019; paper appendix B): skills that can be told apart by the states they visit."""

from __future__ import annotations

import math
from typing import ClassVar

import torch as th
import torch.nn.functional as F

from sb3_dreamer_urlb.behavior.actor_critic import Actor, CategoricalActor
from sb3_dreamer_urlb.intrinsic.base import RewardHead
from sb3_dreamer_urlb.intrinsic.skill_reward import SkillReward
from sb3_dreamer_urlb.intrinsic.skills import OneHotSkills
from sb3_dreamer_urlb.nn.nets import ReLUNet
from sb3_dreamer_urlb.types import Imagination, Metrics, ModelSizes, Posterior, SequenceBatch


class DIAYN(SkillReward):
    """r_t = log q(w | z_t) − log p(w): how well a discriminator recognises the skill by the state.

    :param skill_dim: number of skills
    :param skill_interval: agent steps between two draws of an acting agent
    :raises ValueError: for fewer than two skills
    """

    ent_coef: ClassVar[float] = 0.1

    def __init__(self, skill_dim: int = 50, skill_interval: int = 50):
        super().__init__(OneHotSkills(skill_dim, skill_interval))

    def build(self, sizes: ModelSizes) -> None:
        self.discriminator = ReLUNet([sizes.feature, sizes.feature, sizes.feature, self.skills.dim], orthogonal=True)

    def loss(self, posterior: Posterior, batch: SequenceBatch) -> tuple[th.Tensor, Metrics]:
        """Cross-entropy of the skills that were followed."""
        assert batch.skill is not None
        logits = self.discriminator(posterior.feature).flatten(0, 1)
        followed = batch.skill.flatten(0, 1).argmax(-1)
        accuracy = (logits.detach().argmax(-1) == followed).float().mean()
        return F.cross_entropy(logits, followed), {"accuracy": accuracy}

    def reward(self, imagination: Imagination, reward_head: RewardHead) -> th.Tensor:
        """log q(w | z) + log W: skills are drawn uniformly."""
        assert imagination.skill is not None
        log_q = self.discriminator(imagination.seen).log_softmax(-1)
        return (log_q * imagination.skill).sum(-1) + math.log(self.skills.dim)

    def choose_skill(self, actor: Actor | CategoricalActor, posterior: Posterior, batch: SequenceBatch) -> th.Tensor:
        """The skill most likely to act as the sequences of large return did.

        argmax_w of the mean over sequences of (Σ_t r_t) · (Σ_t log π(a_t | z_t, w)).
        """
        feature, action = posterior.feature[:, :-1], batch.action[:, 1:]
        total_reward = batch.reward.sum(1)
        score = []
        for skill in th.eye(self.skills.dim, device=feature.device):
            log_prob = actor(feature, skill.expand(*feature.shape[:2], -1)).log_prob(action).sum(1)
            score.append((total_reward * log_prob).mean())
        return F.one_hot(th.stack(score).argmax(), self.skills.dim).to(feature.dtype)
