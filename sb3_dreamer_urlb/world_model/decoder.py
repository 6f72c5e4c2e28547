"""Features → observations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import torch as th
from torch import nn

from sb3_dreamer_urlb import native
from sb3_dreamer_urlb.nn.dense import linear, linear_elu
from sb3_dreamer_urlb.nn.nets import MLP
from sb3_dreamer_urlb.nn.precision import full
from sb3_dreamer_urlb.spaces.observations import DictObservations, Images, Observations, Vectors
from sb3_dreamer_urlb.world_model.convolution import convolve_elu, convolves_on_tiles


def deconvolution_kernels(size: int) -> list[int]:
    """Kernel sizes of stride-2 transposed convolutions that grow a 1×1 map to ``size``×``size`` exactly.

    64 gives the paper's [5, 5, 6, 6]: 1 → 5 → 13 → 30 → 64. Found backwards, so that every size has a chain.

    :param size: height and width of the image
    """
    kernels = []
    while size > 1:
        kernel = size if size <= 6 else 6 - size % 2
        kernels.append(kernel)
        size = (size - kernel) // 2 + 1
    return kernels[::-1]


class ConvDecoder(nn.Module):
    """A linear layer to a 1×1 map, then transposed convolutions (docs/algorithm.md, "World model").

    ELU follows every transposed convolution, *also the last*: the authors' published numbers carry it, and it is
    harmless since targets lie in [-0.5, 0.5].

    :param feature_size: F
    :param image_shape: (channels, height, width)
    :param depth: channels of the last hidden stage; they double towards the input
    """

    def __init__(self, feature_size: int, image_shape: tuple[int, int, int], depth: int):
        super().__init__()
        image_channels, height, width = image_shape
        rows, columns = deconvolution_kernels(height), deconvolution_kernels(width)
        stages = max(len(rows), len(columns))
        # The shorter side waits: a kernel of 1 leaves a 1×1 map as it is.
        kernels = [([1] * stages + rows)[-stages:], ([1] * stages + columns)[-stages:]]
        hidden = [depth * 2**i for i in reversed(range(stages - 1))]
        channels = [32 * depth, *hidden, image_channels]
        self.input = nn.Linear(feature_size, channels[0])
        self.deconvs = nn.ModuleList(
            nn.ConvTranspose2d(*pair, kernel, stride=2)
            for pair, kernel in zip(pairwise(channels), zip(*kernels, strict=True), strict=True)
        )

    def forward(self, feature: th.Tensor) -> th.Tensor:
        """
        :param feature: float (…, F)
        :return: mean image, float (…, C, height, width); what kernels of our own learn from may be bfloat16
        """
        x = self._grow(linear(feature.flatten(0, -2), self.input.weight, self.input.bias))
        for deconv in self.deconvs[1:]:
            assert isinstance(deconv, nn.ConvTranspose2d)
            x = convolve_elu(deconv, x)
        # The loss takes the short format as it is.
        x = x if native.active() and th.is_grad_enabled() else full(x)
        return x.reshape(feature.shape[:-1] + x.shape[1:])

    def _grow(self, x: th.Tensor) -> th.Tensor:
        """The first transposed convolution and its ELU: on a 1×1 map it is a plain matrix product, which is faster."""
        first = self.deconvs[0]
        assert isinstance(first, nn.ConvTranspose2d) and first.bias is not None
        channels, out, height, width = first.weight.shape
        image = x.view(-1, channels, 1, 1)
        if convolves_on_tiles(first, image):
            return convolve_elu(first, image)
        # Channels last, as all that follow.
        weight = first.weight.permute(0, 2, 3, 1).reshape(channels, -1).T
        return linear_elu(x, weight, first.bias.repeat(height * width)).view(-1, height, width, out).permute(0, 3, 1, 2)


class VectorDecoder(MLP):
    """ELU layers and a linear output.

    :param feature_size: F
    :param net_arch: widths of the hidden layers
    :param size: of the vector
    """

    def __init__(self, feature_size: int, net_arch: Sequence[int], size: int):
        super().__init__(feature_size, net_arch, size)
        self.scalar = False


class DictDecoder(nn.Module):
    """One decoder a name.

    :param decoders: by name
    """

    def __init__(self, decoders: Mapping[str, nn.Module]):
        super().__init__()
        self.names = tuple(decoders)
        self.decoders = nn.ModuleList(decoders.values())

    def forward(self, feature: th.Tensor) -> dict[str, th.Tensor]:
        """(…, F) → means by name."""
        return {name: decoder(feature) for name, decoder in zip(self.names, self.decoders, strict=True)}


def make_decoder(observations: Observations, feature_size: int, cnn_depth: int, net_arch: Sequence[int]) -> nn.Module:
    """The network that predicts one kind of observation.

    :param observations: the kind; the decoder gives the mean of a unit normal over its preprocessed form
    :param feature_size: F
    :param cnn_depth: channels of the last hidden convolution
    :param net_arch: hidden layers where there is nothing to convolve
    """
    match observations:
        case Images():
            return ConvDecoder(feature_size, observations.shape, cnn_depth)
        case Vectors():
            return VectorDecoder(feature_size, net_arch, observations.size)
        case DictObservations():
            parts = observations.parts.items()
            return DictDecoder({key: make_decoder(part, feature_size, cnn_depth, net_arch) for key, part in parts})
    raise TypeError(f"There is no decoder of {observations!r}.")
