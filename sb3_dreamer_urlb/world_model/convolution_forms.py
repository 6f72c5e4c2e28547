"""The three passes of a strided convolution (see :mod:`~sb3_dreamer_urlb.world_model.convolution`), each in several forms.

Symbols: N images; narrow channels n and side s, wide channels w and side (s − 1) · stride + k, kernel k. Images lie in memory
channels last, so a pixel's channels, and a row of a patch, are one contiguous piece.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch as th
import torch.nn.functional as F

CHANNELS_LAST = th.channels_last


class Form(ABC):
    """One way to compute the passes.

    :param kernel: k
    :param stride: of the convolution
    """

    def __init__(self, kernel: int, stride: int):
        self.kernel, self.stride = kernel, stride

    @abstractmethod
    def lay_out(self, wide: th.Tensor) -> th.Tensor:
        """The wide image (N, w, …) as :meth:`gather` and :meth:`weight` read it."""

    @abstractmethod
    def gather(self, laid_out: th.Tensor, weight: th.Tensor, bias: th.Tensor | None) -> th.Tensor:
        """Wide image laid out, weight (n, w, k, k) and bias (n,) → (N, n, s, s)."""

    @abstractmethod
    def scatter(self, narrow: th.Tensor, weight: th.Tensor, bias: th.Tensor | None) -> th.Tensor:
        """Narrow image (N, n, s, s), weight (n, w, k, k) and bias (w,) → (N, w, …)."""

    @abstractmethod
    def weight(self, laid_out: th.Tensor, narrow: th.Tensor) -> th.Tensor:
        """Wide image laid out, narrow image → gradient of the weight, (n, w, k, k)."""


class Direct(Form):
    """oneDNN's strided convolutions."""

    def lay_out(self, wide: th.Tensor) -> th.Tensor:
        return wide

    def gather(self, laid_out: th.Tensor, weight: th.Tensor, bias: th.Tensor | None) -> th.Tensor:
        return F.conv2d(laid_out, weight, bias, self.stride)

    def scatter(self, narrow: th.Tensor, weight: th.Tensor, bias: th.Tensor | None) -> th.Tensor:
        return F.conv_transpose2d(narrow, weight, bias, self.stride)

    def weight(self, laid_out: th.Tensor, narrow: th.Tensor) -> th.Tensor:
        shape = (narrow.shape[1], laid_out.shape[1], self.kernel, self.kernel)
        return _weight_of_convolution(laid_out, narrow, shape, self.stride)


class Phases(Form):
    """stride² pixels of the wide image as one with stride² times the channels: a convolution of stride 1, kernel k / stride.

    oneDNN is faster at these. The kernel must be a multiple of the stride.
    """

    def lay_out(self, wide: th.Tensor) -> th.Tensor:
        """(N, stride² · w, side / stride, side / stride); a pixel's channels are ordered (row, column, w)."""
        stride, side = self.stride, wide.shape[-1] // self.stride
        image = wide.permute(0, 2, 3, 1)[:, : side * stride, : side * stride]
        pixels = image.unflatten(2, (side, stride)).unflatten(1, (side, stride))  # (N, y, row, x, column, w)
        return pixels.transpose(2, 3).flatten(3).permute(0, 3, 1, 2)

    def gather(self, laid_out: th.Tensor, weight: th.Tensor, bias: th.Tensor | None) -> th.Tensor:
        return F.conv2d(laid_out, self._phases_of(weight), bias)

    def scatter(self, narrow: th.Tensor, weight: th.Tensor, bias: th.Tensor | None) -> th.Tensor:
        bias = None if bias is None else bias.repeat(self.stride**2)
        pixels = F.conv_transpose2d(narrow, self._phases_of(weight), bias).permute(0, 2, 3, 1)  # (N, y, x, channels)
        pixels = pixels.unflatten(3, (self.stride, self.stride, weight.shape[1])).transpose(2, 3)
        return pixels.flatten(3, 4).flatten(1, 2).permute(0, 3, 1, 2)

    def weight(self, laid_out: th.Tensor, narrow: th.Tensor) -> th.Tensor:
        few = self.kernel // self.stride
        channels = laid_out.shape[1] // self.stride**2
        grad = _weight_of_convolution(laid_out, narrow, (narrow.shape[1], laid_out.shape[1], few, few), 1)
        grad = grad.unflatten(1, (self.stride, self.stride, channels))  # (n, row, column, w, y, x)
        return grad.permute(0, 3, 4, 1, 5, 2).flatten(4).flatten(2, 3)

    def _phases_of(self, weight: th.Tensor) -> th.Tensor:
        """(n, w, k, k) → (n, stride² · w, k / stride, k / stride)."""
        few = self.kernel // self.stride
        phases = weight.unflatten(3, (few, self.stride)).unflatten(2, (few, self.stride))  # (n, w, y, row, x, column)
        phases = phases.permute(0, 3, 5, 1, 2, 4).flatten(1, 3)
        return phases.contiguous(memory_format=CHANNELS_LAST)


class PhasesOnce(Direct):
    """Phases where they pay most, to scatter: only there oneDNN computes what the stride then throws away.

    Nothing is laid out, which takes as long as a pass does where channels are few.
    """

    def scatter(self, narrow: th.Tensor, weight: th.Tensor, bias: th.Tensor | None) -> th.Tensor:
        return Phases(self.kernel, self.stride).scatter(narrow, weight, bias)


class Patches(Form):
    """Products of a matrix of patches, which repeats pixels: between small images, where oneDNN is slow.

    Gather is patches · weight, scatter adds up the patches narrow · weightᵀ, and the weight's gradient is narrowᵀ · patches.
    """

    def lay_out(self, wide: th.Tensor) -> th.Tensor:
        """The patch below each narrow pixel, (N, s, s, k · k · w)."""
        image = wide.permute(0, 2, 3, 1).contiguous()
        windows = image.unfold(1, self.kernel, self.stride).unfold(2, self.kernel, self.stride)  # (N, s, s, w, k, k), a view
        return windows.permute(0, 1, 2, 4, 5, 3).flatten(3)

    def gather(self, laid_out: th.Tensor, weight: th.Tensor, bias: th.Tensor | None) -> th.Tensor:
        return F.linear(laid_out, weight.permute(0, 2, 3, 1).flatten(1), bias).permute(0, 3, 1, 2)

    def scatter(self, narrow: th.Tensor, weight: th.Tensor, bias: th.Tensor | None) -> th.Tensor:
        side, kernel, stride = narrow.shape[-1], self.kernel, self.stride
        channels, size = weight.shape[1], (side - 1) * stride + kernel
        rows = narrow.permute(0, 2, 3, 1).flatten(0, 2) @ weight.permute(0, 2, 3, 1).flatten(1)
        patches = rows.view(-1, side, side, kernel, kernel, channels)
        wide = patches.new_zeros(len(narrow), size, size, channels)
        for i in range(side):
            for j in range(side):
                wide[:, i * stride : i * stride + kernel, j * stride : j * stride + kernel] += patches[:, i, j]
        if bias is not None:
            wide += bias
        return wide.permute(0, 3, 1, 2)

    def weight(self, laid_out: th.Tensor, narrow: th.Tensor) -> th.Tensor:
        rows = narrow.permute(0, 2, 3, 1).flatten(0, 2).T
        # oneDNN is a third faster on a transposed operand that has been laid out, in bfloat16.
        rows = rows.contiguous() if rows.dtype == th.bfloat16 else rows
        product = rows @ laid_out.flatten(0, 2)
        return product.view(narrow.shape[1], self.kernel, self.kernel, -1).permute(0, 3, 1, 2)


class PatchesAndPhases(Patches):
    """Patches, but scatter as phases: adding patches up is their slow pass. Fast in bfloat16 between the images in between."""

    def scatter(self, narrow: th.Tensor, weight: th.Tensor, bias: th.Tensor | None) -> th.Tensor:
        # Zeros make the kernel a multiple of the stride, and the wide image larger than it is.
        zeros = -self.kernel % self.stride
        phases = Phases(self.kernel + zeros, self.stride)
        wide = phases.scatter(narrow, F.pad(weight, (0, zeros, 0, zeros)), bias)
        side = (narrow.shape[-1] - 1) * self.stride + self.kernel
        return wide[..., :side, :side].contiguous(memory_format=CHANNELS_LAST)


def _weight_of_convolution(wide: th.Tensor, narrow: th.Tensor, shape: tuple[int, ...], stride: int) -> th.Tensor:
    """Of a plain convolution, without the two other gradients that autograd's own call would compute."""
    weight = wide.new_empty(()).expand(shape)
    return th.ops.aten.convolution_backward(
        narrow, wide, weight, None, [stride] * 2, [0, 0], [1, 1], False, [0, 0], 1, [False, True, False]
    )[1]
