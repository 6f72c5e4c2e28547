"""The multi-layer perceptron that every head, the actor and the critic are made of."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_dreamer_urlb.nn.dense import linear_elu
from sb3_dreamer_urlb.nn.precision import full


class MLP(nn.Module):
    """ELU layers ``dense`` and one linear output ``out`` (docs/algorithm.md, "World model").

    :param inputs: size of the input
    :param net_arch: widths of the hidden layers
    :param outputs: size of the output; 1 gives a scalar head whose last dimension is dropped
    """

    def __init__(self, inputs: int, net_arch: Sequence[int], outputs: int = 1):
        super().__init__()
        widths = [inputs, *net_arch]
        self.dense = nn.ModuleList(nn.Linear(*pair) for pair in pairwise(widths))
        self.out = nn.Linear(widths[-1], outputs)
        self.scalar = outputs == 1

    def hidden(self, x: th.Tensor) -> th.Tensor:
        """The last hidden layer, (…, inputs) → (…, net_arch[-1])."""
        for layer in self.dense:
            assert isinstance(layer, nn.Linear)
            x = linear_elu(x, layer.weight, layer.bias)
        return x

    def forward(self, x: th.Tensor) -> th.Tensor:
        """(…, inputs) → (…, outputs), or (…) for a scalar head."""
        y = full(self.out(self.hidden(x)))
        return y.squeeze(-1) if self.scalar else y


class ReLUNet(nn.Module):
    """Linear layers ``dense`` with ReLU between them, none after the last: the networks of the intrinsic rewards.

    :param widths: input, hidden and output sizes
    :param orthogonal: orthogonal weights and zero biases, instead of PyTorch's default
    """

    def __init__(self, widths: Sequence[int], orthogonal: bool = False):
        super().__init__()
        self.dense = nn.ModuleList(nn.Linear(*pair) for pair in pairwise(widths))
        if orthogonal:
            for layer in self.dense:
                assert isinstance(layer, nn.Linear)
                nn.init.orthogonal_(layer.weight)
                nn.init.zeros_(layer.bias)

    def forward(self, x: th.Tensor) -> th.Tensor:
        """(…, widths[0]) → (…, widths[-1])."""
        *hidden, last = self.dense
        for layer in hidden:
            x = F.relu(layer(x))
        return full(last(x))
