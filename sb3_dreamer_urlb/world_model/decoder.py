"""Features → images."""

from __future__ import annotations

from itertools import pairwise

import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_dreamer_urlb.precision import full
from sb3_dreamer_urlb.world_model.convolution import convolve


def deconvolution_kernels(size: int) -> list[int]:
    """Kernel sizes of stride-2 transposed convolutions that grow a 1×1 map to ``size``×``size`` exactly.

    64 gives DreamerV2's [5, 5, 6, 6]: 1 → 5 → 13 → 30 → 64. Found backwards, so that every size has a chain.

    :param size: height and width of the image
    """
    kernels = []
    while size > 1:
        kernel = size if size <= 6 else 6 - size % 2
        kernels.append(kernel)
        size = (size - kernel) // 2 + 1
    return kernels[::-1]


class ConvDecoder(nn.Module):
    """A linear layer to a 1×1 map, then transposed convolutions (spec/algorithms §1).

    ELU follows every transposed convolution, *also the last*: the authors' published numbers carry it, and it is
    harmless since targets lie in [-0.5, 0.5].

    :param feature_size: F
    :param image_shape: (channels, height, width), square
    :param depth: channels of the last hidden stage; they double towards the input
    :raises ValueError: if the image is not square
    """

    def __init__(self, feature_size: int, image_shape: tuple[int, int, int], depth: int):
        super().__init__()
        image_channels, height, width = image_shape
        if height != width:
            raise ValueError(f"The decoder makes square images, got {height}×{width} (resize the observation).")
        kernels = deconvolution_kernels(height)
        hidden = [depth * 2**i for i in reversed(range(len(kernels) - 1))]
        channels = [32 * depth, *hidden, image_channels]
        self.input = nn.Linear(feature_size, channels[0])
        self.deconvs = nn.ModuleList(
            nn.ConvTranspose2d(*pair, kernel, stride=2) for pair, kernel in zip(pairwise(channels), kernels, strict=True)
        )

    def forward(self, feature: th.Tensor) -> th.Tensor:
        """
        :param feature: float (…, F)
        :return: mean image, float (…, C, height, width)
        """
        x = F.elu(self._grow(self.input(feature.flatten(0, -2))))
        for deconv in self.deconvs[1:]:
            assert isinstance(deconv, nn.ConvTranspose2d)
            x = F.elu(convolve(deconv, x))
        return full(x).reshape(feature.shape[:-1] + x.shape[1:])

    def _grow(self, x: th.Tensor) -> th.Tensor:
        """The first transposed convolution: on a 1×1 map it is a plain matrix product, which is faster."""
        first = self.deconvs[0]
        assert isinstance(first, nn.ConvTranspose2d) and first.bias is not None
        channels, out, height, width = first.weight.shape
        y = (x @ first.weight.view(channels, -1)).view(-1, out, height, width)
        return y + first.bias.to(y.dtype).view(1, -1, 1, 1)
