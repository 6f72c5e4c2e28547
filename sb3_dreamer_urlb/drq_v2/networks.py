"""Encoder, actor and critic of DrQ-v2 (Yarats et al., 2021), in the benchmark's sizes (URLB, Laskin et al., 2021)."""

from __future__ import annotations

from collections.abc import Sequence

import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_dreamer_urlb.nn.distributions import BoundedNormal
from sb3_dreamer_urlb.nn.nets import ReLUNet
from sb3_dreamer_urlb.nn.precision import full

KERNEL = 3
STRIDES = (2, 1, 1, 1)


class PixelEncoder(nn.Module):
    """Four convolutions with ReLU, flattened: 84×84 pixels become 32 channels of 35×35.

    :param channels: of a stack of frames
    :param height: in pixels, at least 16
    :param width: likewise
    :param depth: channels of every convolution
    """

    def __init__(self, channels: int, height: int, width: int, depth: int):
        super().__init__()
        self.convs = nn.ModuleList()
        for stride in STRIDES:
            self.convs.append(nn.Conv2d(channels, depth, KERNEL, stride))
            channels = depth
            height, width = (height - KERNEL) // stride + 1, (width - KERNEL) // stride + 1
        for conv in self.convs:
            assert isinstance(conv, nn.Conv2d) and conv.bias is not None
            nn.init.orthogonal_(conv.weight, nn.init.calculate_gain("relu"))
            nn.init.zeros_(conv.bias)
        #: E
        self.size = depth * height * width

    def forward(self, image: th.Tensor) -> th.Tensor:
        """Images in [-0.5, 0.5], (B, C, height, width), → float (B, E)."""
        for conv in self.convs:
            image = F.relu(conv(image))
        return full(image).flatten(1)


class VectorEncoder(nn.Identity):
    """Vectors as they are.

    :param size: E
    """

    def __init__(self, size: int):
        super().__init__()
        self.size = size


class Trunk(nn.Sequential):
    """From encodings to a few bounded features: linear, layer norm, tanh; (…, E) → (…, features).

    :param encoding_size: E
    :param features: size of the output
    """

    def __init__(self, encoding_size: int, features: int):
        linear = nn.Linear(encoding_size, features)
        nn.init.orthogonal_(linear.weight)
        nn.init.zeros_(linear.bias)
        super().__init__(linear, nn.LayerNorm(features), nn.Tanh())

    def forward(self, encoding: th.Tensor) -> th.Tensor:
        """(…, E) → (…, features)."""
        linear, norm, tanh = self
        features: th.Tensor = tanh(norm(full(linear(encoding))))
        return features


class Actor(nn.Module):
    """π(a | s): a normal around tanh(m), whose samples are clamped to the action box.

    :param encoding_size: E
    :param action_size: A
    :param features: of its trunk
    :param net_arch: widths of the hidden layers
    """

    def __init__(self, encoding_size: int, action_size: int, features: int, net_arch: Sequence[int]):
        super().__init__()
        self.trunk = Trunk(encoding_size, features)
        self.body = ReLUNet([features, *net_arch, action_size], orthogonal=True)
        self.action_size = action_size

    def forward(self, encoding: th.Tensor, std: th.Tensor) -> BoundedNormal:
        """
        :param encoding: float (…, E)
        :param std: of the noise, a scalar
        :return: distribution over (…, A)
        """
        mean = th.tanh(self.body(self.trunk(encoding)))
        return BoundedNormal(mean, std.expand_as(mean))


class Critic(nn.Module):
    """Q(s, a), twice, on one trunk; the action joins after it.

    :param encoding_size: E
    :param action_size: A
    :param features: of its trunk
    :param net_arch: widths of the hidden layers
    """

    def __init__(self, encoding_size: int, action_size: int, features: int, net_arch: Sequence[int]):
        super().__init__()
        self.trunk = Trunk(encoding_size, features)
        self.heads = nn.ModuleList(ReLUNet([features + action_size, *net_arch, 1], orthogonal=True) for _ in range(2))

    def forward(self, encoding: th.Tensor, action: th.Tensor) -> th.Tensor:
        """Encodings (…, E) and actions (…, A) → both values, float (…, 2)."""
        inputs = th.cat([self.trunk(encoding), action], -1)
        return th.cat([head(inputs) for head in self.heads], -1)
