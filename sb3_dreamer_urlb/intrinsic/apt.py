"""APT (Liu & Abbeel, 2021; paper appendix B): spread the imagined states as widely as possible."""

from __future__ import annotations

import torch as th

from sb3_dreamer_urlb.intrinsic.base import IntrinsicReward, RewardHead
from sb3_dreamer_urlb.intrinsic.particles import check_neighbours, knn_distances
from sb3_dreamer_urlb.nn.precision import full
from sb3_dreamer_urlb.types import Imagination, ModelSizes


class APT(IntrinsicReward):
    """r_i = log(1 + mean distance to the k nearest particles): a particle estimate of the states' entropy.

    The particles are the deterministic states of a whole imagination. The reward carries no gradient, as in the authors'
    code: the actor learns through the critic.

    :param k: neighbours, the particle itself included
    :raises ValueError: if k is not positive, or exceeds the number of particles
    """

    def __init__(self, k: int = 12):
        super().__init__()
        check_neighbours(k)
        self.k = k

    def check(self, particles: int) -> None:
        check_neighbours(self.k, particles)

    def build(self, sizes: ModelSizes) -> None:
        self.deter_size = sizes.deter

    def reward(self, imagination: Imagination, reward_head: RewardHead) -> th.Tensor:
        deter = full(imagination.seen[..., -self.deter_size :])
        distance = knn_distances(deter.detach().flatten(0, 1), self.k)
        return distance.mean(-1).log1p().view(deter.shape[:2])
