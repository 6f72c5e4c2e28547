"""Images → embeddings."""

from __future__ import annotations

from collections.abc import Callable

import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_dreamer_urlb.precision import full
from sb3_dreamer_urlb.world_model.convolution import convolve

KERNEL, STRIDE = 4, 2


class ConvEncoder(nn.Module):
    """Strided convolutions, an activation after each, flattened channel-first (spec/algorithms §1).

    At 64×64 these are DreamerV2's four stages, 64 → 31 → 14 → 6 → 2; other sizes take as many stages as fit.

    :param image_shape: (channels, height, width), height and width at least 16
    :param depth: channels of the first stage; they double with each stage, up to 8 × depth
    :param activation: after each convolution
    """

    def __init__(self, image_shape: tuple[int, int, int], depth: int, activation: Callable[[th.Tensor], th.Tensor] = F.elu):
        super().__init__()
        self.activation = activation
        channels, height, width = image_shape
        self.convs = nn.ModuleList()
        while min(height, width) >= KERNEL:
            out = depth * min(2 ** len(self.convs), 8)
            self.convs.append(nn.Conv2d(channels, out, KERNEL, STRIDE))
            channels, height, width = out, (height - KERNEL) // STRIDE + 1, (width - KERNEL) // STRIDE + 1
        self.embed_size = channels * height * width

    def forward(self, image: th.Tensor) -> th.Tensor:
        """
        :param image: float in [-0.5, 0.5], (…, C, height, width)
        :return: embedding, float (…, E)
        """
        # Channels last is a third faster on CPU, from small to paper size.
        x = image.flatten(0, -4).contiguous(memory_format=th.channels_last)
        for conv in self.convs:
            assert isinstance(conv, nn.Conv2d)
            x = self.activation(convolve(conv, x))
        return full(x).reshape(image.shape[:-3] + (self.embed_size,))
