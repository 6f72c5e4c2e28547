"""Random Network Distillation (Burda et al., 2019; paper appendix B): seek observations that are not yet known by heart."""

from __future__ import annotations

import math
from typing import ClassVar

import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_dreamer_urlb.intrinsic.base import IntrinsicReward
from sb3_dreamer_urlb.intrinsic.moments import RunningMoments
from sb3_dreamer_urlb.nn.nets import ReLUNet
from sb3_dreamer_urlb.number_checks import is_integer
from sb3_dreamer_urlb.types import Metrics, ModelSizes, Observation, Posterior, SequenceBatch, map_observation
from sb3_dreamer_urlb.world_model.encoder import make_encoder

BOUND = 5.0


class ObservationNet(nn.Module):
    """An encoder and three layers, all orthogonal.

    :param sizes: of the world model; embedding and widths are the same
    :param outputs: size of the output
    """

    def __init__(self, sizes: ModelSizes, outputs: int):
        super().__init__()
        self.encoder = make_encoder(sizes.observations, sizes.cnn_depth, sizes.net_arch)
        for layer in self.encoder.modules():
            if isinstance(layer, (nn.Conv2d, nn.Linear)):
                assert layer.bias is not None
                nn.init.orthogonal_(layer.weight, math.sqrt(2))
                nn.init.zeros_(layer.bias)
        self.head = ReLUNet([sizes.embed, sizes.embed, sizes.embed, outputs], orthogonal=True)

    def forward(self, observation: Observation) -> th.Tensor:
        """Preprocessed (n, …) → (n, outputs)."""
        return self.head(self.encoder(observation))


class RND(IntrinsicReward):
    """r_t = ‖f(x_t) − f̄(x_t)‖² / σ: the error of a predictor of a fixed random network, in units of its running deviation.

    Computed on replayed observations; the reward head carries it into imagination.

    :param output_size: of the two networks
    :raises ValueError: if it is not positive
    """

    momentum: ClassVar[float] = 1.0

    def __init__(self, output_size: int = 512):
        super().__init__()
        if not is_integer(output_size) or output_size < 1:
            raise ValueError(f"output_size must be a positive integer, got {output_size!r}.")
        self.output_size = output_size

    def build(self, sizes: ModelSizes) -> None:
        self.observations = sizes.observations
        self.predictor = ObservationNet(sizes, self.output_size)
        self.target = ObservationNet(sizes, self.output_size).requires_grad_(False)
        self.error_moments = RunningMoments()

    def loss(self, posterior: Posterior, batch: SequenceBatch) -> tuple[th.Tensor, Metrics]:
        """Mean squared error of the predictor, mean over the outputs."""
        return self._error(batch).mean(), {}

    def replay_reward(self, posterior: Posterior, batch: SequenceBatch) -> th.Tensor:
        with th.no_grad():
            error = self._error(batch)
            self.error_moments.update(error)
            return (error / self.error_moments.std).view(batch.reward.shape)

    def _error(self, batch: SequenceBatch) -> th.Tensor:
        """(B·T,)"""
        observation = map_observation(_whitened, self.observations.preprocess(batch.observation))
        with th.no_grad():
            target = self.target(observation)
        return (self.predictor(observation) - target).square().mean(-1)


def _whitened(x: th.Tensor) -> th.Tensor:
    """Each batch is its own reference: whitened per channel, and no outlier beyond five deviations; (B, T, …) → (B·T, …)."""
    return F.batch_norm(x.flatten(0, 1), None, None, training=True).clamp(-BOUND, BOUND)
