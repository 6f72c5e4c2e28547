"""Strided convolutions; those between small images as products of a matrix of patches, where oneDNN is slow on CPUs.

A convolution and a transposed one with the same kernel are the same three passes between a *wide* image and a *narrow*
one, whose every pixel belongs to one kernel-sized patch of the wide image:

==============  =================  ======================
pass            convolution        transposed convolution
==============  =================  ======================
gather          forward            gradient of the input
scatter         gradient of input  forward
weight          gradient of the weight, in both
==============  =================  ======================

Gather is patches · weight, scatter adds up the patches narrow · weightᵀ, and the weight's gradient is patchesᵀ · narrow.
Images lie in memory channels last, so a row of a patch is one contiguous piece.
"""

from __future__ import annotations

import torch as th
import torch.nn.functional as F
from torch import nn
from torch.autograd import Function
from torch.autograd.function import once_differentiable

#: Pixels a side of the narrow image up to which the passes are products on CPU: the last convolution and the second
#: transposed one at 64×64. Measured layer by layer, in float32 and bfloat16 (docs/performance.md).
SMALL_SIDE = 5


def convolve(layer: nn.Conv2d | nn.ConvTranspose2d, x: th.Tensor) -> th.Tensor:
    """``layer(x)``, as matrix products where that is faster; never where image or kernel is not square.

    :param layer: square stride, no padding
    :param x: (N, C, height, width)
    """
    dtype = th.get_autocast_dtype("cpu") if th.is_autocast_enabled("cpu") else x.dtype
    transposed, stride = isinstance(layer, nn.ConvTranspose2d), layer.stride[0]
    side = x.shape[-1] if transposed else (x.shape[-1] - layer.kernel_size[0]) // stride + 1
    square = x.shape[-1] == x.shape[-2] and layer.kernel_size[0] == layer.kernel_size[1]
    if x.device.type != "cpu" or not th.is_grad_enabled() or side > SMALL_SIDE or not square:
        return layer(x)
    assert layer.bias is not None
    # Outside of the function, so that autograd brings the gradients back to float32.
    x, weight, bias = x.to(dtype), layer.weight.to(dtype), layer.bias.to(dtype)
    with th.autocast("cpu", enabled=False):
        return _Convolution.apply(x, weight, bias, stride, transposed)  # type: ignore[no-untyped-call]


class _Convolution(Function):
    """Weight (narrow channels, wide channels, k, k), as PyTorch has it for both kinds."""

    @staticmethod
    def forward(
        ctx: th.autograd.function.FunctionCtx, x: th.Tensor, weight: th.Tensor, bias: th.Tensor, stride: int, transposed: bool
    ) -> th.Tensor:
        ctx.save_for_backward(x, weight)
        ctx.stride, ctx.transposed = stride, transposed  # type: ignore[attr-defined]
        return _scatter(x, weight, bias, stride) if transposed else _gather(x, weight, bias, stride)

    @staticmethod
    @once_differentiable
    def backward(ctx: th.autograd.function.FunctionCtx, grad: th.Tensor) -> tuple[th.Tensor | None, ...]:
        x, weight = ctx.saved_tensors  # type: ignore[attr-defined]
        stride, transposed = ctx.stride, ctx.transposed  # type: ignore[attr-defined]
        wants_x, wants_weight, wants_bias, *_ = ctx.needs_input_grad  # type: ignore[attr-defined]
        wide, narrow = (grad, x) if transposed else (x, grad)
        x_grad = weight_grad = None
        if wants_x:
            x_grad = (_gather if transposed else _scatter)(grad, weight, None, stride)
            # A convolution does not see the last pixels where stride and size do not fit.
            x_grad = F.pad(x_grad, (0, x.shape[3] - x_grad.shape[3], 0, x.shape[2] - x_grad.shape[2]))
        if wants_weight:
            weight_grad = _weight_pass(wide, narrow, weight.shape[-1], stride)
        return x_grad, weight_grad, grad.sum((0, 2, 3)) if wants_bias else None, None, None


def _gather(wide: th.Tensor, weight: th.Tensor, bias: th.Tensor | None, stride: int) -> th.Tensor:
    """(N, wide channels, …) → (N, narrow channels, …)."""
    kernel = weight.shape[-1]
    side = (wide.shape[-1] - kernel) // stride + 1
    rows = F.linear(_patches(wide, kernel, stride), weight.permute(0, 2, 3, 1).flatten(1), bias)
    return rows.view(wide.shape[0], side, side, -1).permute(0, 3, 1, 2)


def _scatter(narrow: th.Tensor, weight: th.Tensor, bias: th.Tensor | None, stride: int) -> th.Tensor:
    """(N, narrow channels, …) → (N, wide channels, …)."""
    side, kernel = narrow.shape[-1], weight.shape[-1]
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


def _weight_pass(wide: th.Tensor, narrow: th.Tensor, kernel: int, stride: int) -> th.Tensor:
    """(narrow channels, wide channels, kernel, kernel)."""
    rows = narrow.permute(0, 2, 3, 1).flatten(0, 2)
    product = rows.T @ _patches(wide, kernel, stride)
    return product.view(narrow.shape[1], kernel, kernel, wide.shape[1]).permute(0, 3, 1, 2)


def _patches(wide: th.Tensor, kernel: int, stride: int) -> th.Tensor:
    """The patch below each narrow pixel as a row, (N · side · side, kernel · kernel · channels)."""
    image = wide.permute(0, 2, 3, 1).contiguous()
    windows = image.unfold(1, kernel, stride).unfold(2, kernel, stride)  # (N, side, side, C, k, k), a view
    return windows.permute(0, 1, 2, 4, 5, 3).flatten(0, 2).flatten(1)
