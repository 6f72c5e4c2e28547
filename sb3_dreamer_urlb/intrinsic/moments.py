"""Mean and deviation of everything seen so far (Chan's merge of batches; docs/algorithm.md, "Running statistics")."""

from __future__ import annotations

import torch as th
from torch import nn


class RunningMoments(nn.Module):
    """Running mean and variance of scalars; buffers, so that snapshots carry them."""

    mean: th.Tensor
    variance: th.Tensor
    count: th.Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", th.zeros(()))
        self.register_buffer("variance", th.ones(()))
        self.register_buffer("count", th.full((), 1e-4))

    @th.no_grad()
    def update(self, values: th.Tensor) -> None:
        """Merge a batch in.

        :param values: any shape, at least two values
        """
        n = values.numel()
        total = self.count + n
        delta = values.mean() - self.mean
        spread = self.variance * self.count + values.var() * n + delta.square() * self.count * n / total
        self.mean += delta * n / total
        self.variance.copy_(spread / total)
        self.count.copy_(total)

    @property
    def std(self) -> th.Tensor:
        """Standard deviation, scalar; a little more than 0."""
        return self.variance.sqrt() + 1e-8
