"""APS (Liu & Abbeel, 2021; paper appendix B): spread out, while following a skill through successor features."""

from __future__ import annotations

from typing import ClassVar

import torch as th
import torch.nn.functional as F

from sb3_dreamer_urlb.behavior.actor_critic import Actor, CategoricalActor
from sb3_dreamer_urlb.intrinsic.base import RewardHead
from sb3_dreamer_urlb.intrinsic.moments import RunningMoments
from sb3_dreamer_urlb.intrinsic.particles import check_neighbours, knn_distances
from sb3_dreamer_urlb.intrinsic.skill_reward import SkillReward
from sb3_dreamer_urlb.intrinsic.skills import UnitSkills
from sb3_dreamer_urlb.nn.nets import ReLUNet
from sb3_dreamer_urlb.types import Imagination, Metrics, ModelSizes, Posterior, SequenceBatch

# Distances below this share of their running mean count as none.
DISTANCE_FLOOR = 1e-4


class APS(SkillReward):
    """r_t = log(1 + mean distance of φ(z_t) to its k nearest) + w · φ̂(z_t), φ̂ of unit length.

    The critic learns successor features ψ, and the value of a state is ψ · w. The reward carries no gradient, as in the
    authors' code: the actor learns through the critic.

    :param skill_dim: size of φ and w
    :param k: neighbours, the particle itself included
    :param skill_interval: agent steps between two draws of an acting agent
    :raises ValueError: for fewer than two dimensions, or a k that is not positive or exceeds the number of particles
    """

    momentum: ClassVar[float] = 1.0
    successor_features: ClassVar[bool] = True

    def __init__(self, skill_dim: int = 5, k: int = 12, skill_interval: int = 50):
        super().__init__(UnitSkills(skill_dim, skill_interval))
        check_neighbours(k)
        self.k = k

    def check(self, particles: int) -> None:
        check_neighbours(self.k, particles)

    def build(self, sizes: ModelSizes) -> None:
        self.features = ReLUNet([sizes.feature, sizes.feature, sizes.feature, self.skills.dim], orthogonal=True)
        self.distance_moments = RunningMoments()

    def loss(self, posterior: Posterior, batch: SequenceBatch) -> tuple[th.Tensor, Metrics]:
        """− mean(w · φ̂): turn the features towards the skills that were followed."""
        assert batch.skill is not None
        return -(F.normalize(self.features(posterior.feature), dim=-1) * batch.skill).sum(-1).mean(), {}

    def reward(self, imagination: Imagination, reward_head: RewardHead) -> th.Tensor:
        assert imagination.skill is not None
        with th.no_grad():
            phi = self.features(imagination.seen)
            follows = (F.normalize(phi, dim=-1) * imagination.skill).sum(-1)
            return self._entropy(phi.flatten(0, 1)).view(phi.shape[:2]) + follows

    def _entropy(self, particles: th.Tensor) -> th.Tensor:
        distance = knn_distances(particles, self.k)
        self.distance_moments.update(distance)
        relative = distance / self.distance_moments.mean
        return (relative - DISTANCE_FLOOR).clamp(min=0).mean(-1).log1p()

    def choose_skill(self, actor: Actor | CategoricalActor, posterior: Posterior, batch: SequenceBatch) -> th.Tensor:
        """The least-squares solution w of r_t · w ≈ φ̂(z_t), at unit length; a random skill if there was no reward at all.

        φ̂ of unit length, as in the reward: otherwise states of long features would outvote the others. The features
        are the pre-trained ones. The authors' code forgets to carry them over and fits random features.
        """
        phi, reward = F.normalize(self.features(posterior.feature), dim=-1), batch.reward.unsqueeze(-1)
        # One unknown a dimension: w = Σ r φ̂ / Σ r², and the denominator drops out of the direction.
        direction = (reward * phi).sum((0, 1))
        if not bool(direction.any()):
            return self.skills.draw(1)[0]
        return F.normalize(direction, dim=-1)
