"""Observations → embeddings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch as th
from torch import nn

from sb3_dreamer_urlb.nn.activation import elu_
from sb3_dreamer_urlb.nn.nets import MLP
from sb3_dreamer_urlb.nn.precision import full
from sb3_dreamer_urlb.spaces.observations import DictObservations, Images, Observations, Vectors
from sb3_dreamer_urlb.world_model.convolution import convolve, convolve_elu

KERNEL, STRIDE = 4, 2


class Encoder(nn.Module):
    """From preprocessed observations, (…), to embeddings, float (…, E)."""

    #: E
    embed_size: int


class ConvEncoder(Encoder):
    """Strided convolutions, an activation after each, flattened channel-first (docs/algorithm.md, "World model").

    At 64×64 these are the paper's four stages, 64 → 31 → 14 → 6 → 2; other sizes take as many stages as fit.

    :param image_shape: (channels, height, width), height and width at least 16
    :param depth: channels of the first stage; they double with each stage, up to 8 × depth
    :param activation: after each convolution
    """

    def __init__(self, image_shape: tuple[int, int, int], depth: int, activation: Callable[[th.Tensor], th.Tensor] = elu_):
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
            x = convolve_elu(conv, x) if self.activation is elu_ else self.activation(convolve(conv, x))
        return full(x).reshape(image.shape[:-3] + (self.embed_size,))


class VectorEncoder(MLP, Encoder):
    """ELU layers; the last one's output is the embedding. Without layers, that is the vector itself.

    :param size: of the vector
    :param net_arch: widths of the layers
    """

    def __init__(self, size: int, net_arch: Sequence[int]):
        super().__init__(size, net_arch[:-1], net_arch[-1] if net_arch else size)
        self.scalar = False
        self.embed_size = net_arch[-1] if net_arch else size
        if not net_arch:
            self.out = nn.Identity()  # type: ignore[assignment]

    def forward(self, x: th.Tensor) -> th.Tensor:
        """(…, size) → (…, E)."""
        return x if isinstance(self.out, nn.Identity) else elu_(super().forward(x))


class DictEncoder(Encoder):
    """One encoder a name; their embeddings one after the other.

    :param encoders: by name
    """

    def __init__(self, encoders: Mapping[str, Encoder]):
        super().__init__()
        # A list, because a module's name may hold no dot.
        self.names = tuple(encoders)
        self.encoders = nn.ModuleList(encoders.values())
        self.embed_size = sum(encoder.embed_size for encoder in encoders.values())

    def forward(self, observation: dict[str, th.Tensor]) -> th.Tensor:
        """Preprocessed observations by name → float (…, E)."""
        parts = zip(self.names, self.encoders, strict=True)
        return th.cat([encoder(observation[name]) for name, encoder in parts], -1)


def make_encoder(observations: Observations, cnn_depth: int, net_arch: Sequence[int]) -> Encoder:
    """The network that reads one kind of observation.

    :param observations: the kind; its preprocessed form is what the encoder takes
    :param cnn_depth: channels of the first convolution
    :param net_arch: hidden layers where there is nothing to convolve
    """
    match observations:
        case Images():
            return ConvEncoder(observations.shape, cnn_depth)
        case Vectors():
            return VectorEncoder(observations.size, net_arch)
        case DictObservations():
            return DictEncoder({key: make_encoder(part, cnn_depth, net_arch) for key, part in observations.parts.items()})
    raise TypeError(f"There is no encoder of {observations!r}.")
