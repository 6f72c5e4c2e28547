"""Strided convolutions on CPUs, in the forms that are fast there; elsewhere the layers as they are.

With kernels of our own (native/) all passes are products with windows that are laid out in the cache, ELU comes with the
product, and its gradient with the bias's. What follows is for the other machines.

A convolution and a transposed one with the same kernel are the same three passes between a *wide* image and a *narrow*
one, whose every pixel belongs to one kernel-sized patch of the wide image:

==============  =================  ======================
pass            convolution        transposed convolution
==============  =================  ======================
gather          forward            gradient of the input
scatter         gradient of input  forward
weight          gradient of the weight, in both
==============  =================  ======================

:mod:`~sb3_dreamer_urlb.world_model.convolution_forms` has the passes. The gradient of the bias is summed here: torch takes
longer for that of a transposed convolution's bias than for that of its weight.
"""

from __future__ import annotations

import torch as th
import torch.nn.functional as F
from torch import nn
from torch.autograd import Function
from torch.autograd.function import FunctionCtx, once_differentiable

from sb3_dreamer_urlb import native
from sb3_dreamer_urlb.native import image_ops, ops
from sb3_dreamer_urlb.nn.activation import elu_
from sb3_dreamer_urlb.nn.dense import column_sums
from sb3_dreamer_urlb.nn.precision import product_dtype
from sb3_dreamer_urlb.world_model.convolution_forms import Direct, Form, Patches, PatchesAndPhases, Phases, PhasesOnce

#: Pixels a side of the narrow image up to which the passes are products on CPU. At 64×64 that is the last convolution and, in
#: float32, the second transposed one. Measured layer by layer (docs/notes/performance-eager.md).
SMALL_SIDE = {th.float32: 5, th.bfloat16: 4}
#: The same for products with one pass as phases: the third convolution and the second transposed one in bfloat16.
MIDDLE_SIDE = {th.float32: 0, th.bfloat16: 6}

#: Channels of either image below which tiles, three products for one, are not worth it in float32.
CHANNELS = 16


def convolve(layer: nn.Conv2d | nn.ConvTranspose2d, x: th.Tensor) -> th.Tensor:
    """``layer(x)``, while learning on a CPU in the form that is fastest there.

    :param layer: square stride, no padding
    :param x: (N, C, height, width)
    """
    if x.device.type != "cpu" or not th.is_grad_enabled():
        return layer(x)
    dtype = product_dtype(x)
    if convolves_on_tiles(layer, x):
        return _tiles(layer, x, False)
    form = _form(layer, x, dtype)
    if form is None:
        return layer(x)
    assert layer.bias is not None
    # Outside of the function, so that autograd brings the gradients back to float32.
    weight, bias = layer.weight.to(dtype), layer.bias.to(dtype)
    with th.autocast("cpu", enabled=False):
        transposed = isinstance(layer, nn.ConvTranspose2d)
        return _Convolution.apply(x.to(dtype), weight, bias, form, transposed)  # type: ignore[no-untyped-call]


def convolve_elu(layer: nn.Conv2d | nn.ConvTranspose2d, x: th.Tensor) -> th.Tensor:
    """ELU behind :func:`convolve`, whose parameters it takes."""
    if convolves_on_tiles(layer, x):
        return _tiles(layer, x, True)
    return elu_(convolve(layer, x))


def convolves_on_tiles(layer: nn.Conv2d | nn.ConvTranspose2d, x: th.Tensor) -> bool:
    """Whether kernels of our own do it; parameters as those of :func:`convolve`."""
    if not native.active() or x.device.type != "cpu" or not th.is_grad_enabled():
        return False
    if product_dtype(x) not in ops.FORMATS or layer.bias is None or layer.stride[0] != layer.stride[1]:
        return False
    if product_dtype(x) == th.float32 and min(layer.weight.shape[:2]) < CHANNELS:
        return False
    narrow = x.shape[-2:]
    if isinstance(layer, nn.Conv2d):
        narrow = th.Size((size - k) // layer.stride[0] + 1 for size, k in zip(narrow, layer.kernel_size, strict=True))
    return image_ops.worthwhile(len(x) * narrow.numel())


def _tiles(layer: nn.Conv2d | nn.ConvTranspose2d, x: th.Tensor, elu: bool) -> th.Tensor:
    # Outside of the function, so that autograd brings x's gradient back.
    x, transposed = x.to(product_dtype(x)), isinstance(layer, nn.ConvTranspose2d)
    # A single pixel meets the whole kernel at once.
    kernel = layer.kernel_size
    stride = kernel[0] if transposed and x.shape[-2:] == (1, 1) and kernel[0] == kernel[1] else layer.stride[0]
    y: th.Tensor = _OnTiles.apply(x, layer.weight, layer.bias, stride, transposed, elu)  # type: ignore[no-untyped-call]
    return y


def _form(layer: nn.Conv2d | nn.ConvTranspose2d, x: th.Tensor, dtype: th.dtype) -> Form | None:
    """For passes in ``dtype``. None where the layer itself is as good."""
    kernel, stride, transposed = layer.kernel_size[0], layer.stride[0], isinstance(layer, nn.ConvTranspose2d)
    if x.shape[-1] != x.shape[-2] or kernel != layer.kernel_size[1]:
        return None
    side = x.shape[-1] if transposed else (x.shape[-1] - kernel) // stride + 1
    if side <= SMALL_SIDE.get(dtype, SMALL_SIDE[th.float32]):
        return Patches(kernel, stride)
    if side <= MIDDLE_SIDE.get(dtype, 0):
        return PatchesAndPhases(kernel, stride)
    if not transposed:
        return None
    if kernel % stride:
        return Direct(kernel, stride)
    return Phases(kernel, stride) if dtype == th.bfloat16 else PhasesOnce(kernel, stride)


class _OnTiles(Function):
    """An image in the format of products; weights as below, in float32 whatever the format."""

    @staticmethod
    def forward(
        ctx: FunctionCtx, x: th.Tensor, weight: th.Tensor, bias: th.Tensor, stride: int, transposed: bool, elu: bool
    ) -> th.Tensor:
        x = x.contiguous(memory_format=th.channels_last)
        if transposed:
            size = [(side - 1) * stride + k for side, k in zip(x.shape[2:], weight.shape[2:], strict=True)]
            y: th.Tensor = image_ops.scatter(x, weight, stride, size, bias, elu)
        else:
            y = image_ops.gather(x, weight, stride, bias, elu)
        ctx.save_for_backward(x, weight, y if elu else None)  # type: ignore[arg-type]
        ctx.stride, ctx.transposed = stride, transposed  # type: ignore[attr-defined]
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, grad: th.Tensor) -> tuple[th.Tensor | None, ...]:
        x, weight, y = ctx.saved_tensors  # type: ignore[attr-defined]
        stride, transposed = ctx.stride, ctx.transposed  # type: ignore[attr-defined]
        wants_x, wants_weight, wants_bias, *_ = ctx.needs_input_grad  # type: ignore[attr-defined]
        x_grad = weight_grad = bias_grad = None
        if y is not None:
            grad, bias_grad = ops.elu_backward(grad, y, wants_bias)
        else:
            grad = grad.contiguous(memory_format=th.channels_last)
            bias_grad = column_sums(grad.permute(0, 2, 3, 1).flatten(0, 2)).float() if wants_bias else None
        if wants_x and transposed:
            x_grad = image_ops.gather(grad, weight, stride, None, False)
        elif wants_x:
            x_grad = image_ops.scatter(grad, weight, stride, x.shape[2:], None, False)
        if wants_weight:
            wide, narrow = (grad, x) if transposed else (x, grad)
            weight_grad = image_ops.weight_gradient(wide, narrow, weight.shape[2:], stride)
        return x_grad, weight_grad, bias_grad if wants_bias else None, None, None, None


class _Convolution(Function):
    """Weight (narrow channels, wide channels, k, k), as PyTorch has it for both kinds."""

    @staticmethod
    def forward(ctx: FunctionCtx, x: th.Tensor, weight: th.Tensor, bias: th.Tensor, form: Form, transposed: bool) -> th.Tensor:
        narrow = x if transposed else form.lay_out(x)
        ctx.save_for_backward(narrow, weight)
        ctx.form, ctx.transposed, ctx.side = form, transposed, x.shape[-1]  # type: ignore[attr-defined]
        return form.scatter(x, weight, bias) if transposed else form.gather(narrow, weight, bias)

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, grad: th.Tensor) -> tuple[th.Tensor | None, ...]:
        saved, weight = ctx.saved_tensors  # type: ignore[attr-defined]
        form, transposed = ctx.form, ctx.transposed  # type: ignore[attr-defined]
        wants_x, wants_weight, wants_bias, *_ = ctx.needs_input_grad  # type: ignore[attr-defined]
        wide, narrow = (form.lay_out(grad), saved) if transposed else (saved, grad)
        x_grad = weight_grad = None
        if wants_x:
            x_grad = form.gather(wide, weight, None) if transposed else form.scatter(grad, weight, None)
            # A convolution does not see the last pixels where stride and size do not fit.
            unseen = ctx.side - x_grad.shape[-1]  # type: ignore[attr-defined]
            x_grad = F.pad(x_grad, (0, unseen, 0, unseen)) if unseen else x_grad
        if wants_weight:
            weight_grad = form.weight(wide, narrow)
        bias_grad = column_sums(grad.permute(0, 2, 3, 1).flatten(0, 2)) if wants_bias else None
        return x_grad, weight_grad, bias_grad, None, None
