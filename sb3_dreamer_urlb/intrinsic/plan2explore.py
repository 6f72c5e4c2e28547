"""Plan2Explore (Sekar et al., 2020; paper appendix B): seek what an ensemble of one-step models disagrees about."""

from __future__ import annotations

import torch as th

from sb3_dreamer_urlb.intrinsic.base import IntrinsicReward, RewardHead
from sb3_dreamer_urlb.intrinsic.ensemble import Ensemble, check_ensemble_size
from sb3_dreamer_urlb.types import Imagination, Metrics, ModelSizes, Posterior, SequenceBatch


class Plan2Explore(IntrinsicReward):
    """r_t = Var_k[f_k(z_{t-1}, a_{t-1})]: the disagreement of models that predict the next embedding.

    :param ensemble_size: number of models
    :raises ValueError: for fewer than two
    """

    def __init__(self, ensemble_size: int = 5):
        super().__init__()
        check_ensemble_size(ensemble_size)
        self.ensemble_size = ensemble_size

    def build(self, sizes: ModelSizes) -> None:
        self.models = Ensemble([sizes.feature + sizes.action, sizes.embed, sizes.embed], self.ensemble_size)

    def loss(self, posterior: Posterior, batch: SequenceBatch) -> tuple[th.Tensor, Metrics]:
        """Distance (not squared) between predicted and next embedding, averaged over states and models."""
        inputs = th.cat([posterior.feature[:, :-1], batch.action[:, 1:]], -1)
        return self.models.loss(inputs, posterior.embed[:, 1:]), {}

    def reward(self, imagination: Imagination, reward_head: RewardHead) -> th.Tensor:
        """Variance over the models, averaged over the embedding; the first state, which nothing led to, gets 0.

        Gradients reach the actor through the features only, not through the last action: as in the authors' code.
        """
        inputs = th.cat([imagination.feature[:-1], imagination.action[1:].detach()], -1)
        disagreement = self.models.disagreement(inputs)
        return th.cat([th.zeros_like(disagreement[:1]), disagreement])
