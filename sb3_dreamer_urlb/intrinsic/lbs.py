"""Latent Bayesian Surprise (Mazzaglia et al., 2022; paper appendix B)."""

from __future__ import annotations

import torch as th

from sb3_dreamer_urlb.intrinsic.base import IntrinsicReward, RewardHead
from sb3_dreamer_urlb.nn import distributions
from sb3_dreamer_urlb.nn.nets import MLP
from sb3_dreamer_urlb.types import Imagination, Metrics, ModelSizes, Posterior, SequenceBatch


class LBS(IntrinsicReward):
    """r_t ∝ KL(q(z_t | z_{t-1}, a_{t-1}, e_t) ‖ p(z_t | z_{t-1}, a_{t-1})): how much the observation surprises.

    In imagination there is no observation, so a head learns to predict the surprise from features.
    """

    def build(self, sizes: ModelSizes) -> None:
        self.surprise = MLP(sizes.feature, sizes.net_arch)

    def loss(self, posterior: Posterior, batch: SequenceBatch) -> tuple[th.Tensor, Metrics]:
        """Unit-normal NLL of the predicted surprise of each replayed state."""
        loss = distributions.unit_normal_nll(self.surprise(posterior.feature), posterior.kl).mean()
        return loss, {}

    def reward(self, imagination: Imagination, reward_head: RewardHead) -> th.Tensor:
        return self.surprise(imagination.seen)
