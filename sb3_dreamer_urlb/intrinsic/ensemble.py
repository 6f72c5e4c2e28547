"""An ensemble of one-step models, and what it disagrees about: imagined steps (Plan2Explore) or replayed ones (Disagreement).

r = mean over dimensions of Var_k f_k(x), where the f_k learn to predict the same target (Pathak et al., 2019; Sekar et al.,
2020; paper appendix B).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch as th
from torch import nn

from sb3_dreamer_urlb.nn.nets import ReLUNet
from sb3_dreamer_urlb.number_checks import check_integer


class Ensemble(nn.ModuleList):
    """K networks that learn the same from different beginnings.

    :param widths: input, hidden and output sizes of each
    :param size: K
    """

    def __init__(self, widths: Sequence[int], size: int):
        super().__init__(ReLUNet(widths) for _ in range(size))

    def loss(self, inputs: th.Tensor, target: th.Tensor) -> th.Tensor:
        """Distance (not squared) between predictions and target, averaged over rows and models: a scalar.

        :param inputs: float (…, widths[0])
        :param target: float (…, widths[-1])
        """
        return th.stack([(model(inputs) - target).norm(dim=-1).mean() for model in self]).mean()

    def disagreement(self, inputs: th.Tensor) -> th.Tensor:
        """Unbiased variance over the models, averaged over the dimensions of the prediction: (…, widths[0]) → (…)."""
        return th.stack([model(inputs) for model in self]).var(0).mean(-1)


def check_ensemble_size(size: int) -> None:
    """:raises ValueError: for fewer than two models, which have no variance"""
    check_integer("ensemble_size", size, 2)
