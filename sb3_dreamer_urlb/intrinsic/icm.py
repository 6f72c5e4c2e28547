"""ICM (Pathak et al., 2017; paper appendix B): seek transitions that a forward model predicts badly."""

from __future__ import annotations

import torch as th

from sb3_dreamer_urlb.intrinsic.base import IntrinsicReward
from sb3_dreamer_urlb.nn.nets import ReLUNet
from sb3_dreamer_urlb.types import Metrics, ModelSizes, Posterior, SequenceBatch


class ICM(IntrinsicReward):
    """r_t = log(1 + ‖f(e_{t-1}, a_{t-1}) − e_t‖), on replayed embeddings; the reward head carries it into imagination."""

    def build(self, sizes: ModelSizes) -> None:
        self.forward_model = ReLUNet([sizes.embed + sizes.action, sizes.embed, sizes.embed], orthogonal=True)

    def loss(self, posterior: Posterior, batch: SequenceBatch) -> tuple[th.Tensor, Metrics]:
        """Mean distance (not squared) to the next embedding."""
        loss = self._error(posterior, batch).mean()
        return loss, {}

    def replay_reward(self, posterior: Posterior, batch: SequenceBatch) -> th.Tensor:
        """log(1 + error); 1 for a sequence's first row, which nothing led to."""
        with th.no_grad():
            reward = self._error(posterior, batch).log1p()
        return th.cat([th.ones_like(reward[:, :1]), reward], 1)

    def _error(self, posterior: Posterior, batch: SequenceBatch) -> th.Tensor:
        predicted = self.forward_model(th.cat([posterior.embed[:, :-1], batch.action[:, 1:]], -1))
        return (predicted - posterior.embed[:, 1:]).norm(dim=-1)
