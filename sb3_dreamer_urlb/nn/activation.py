"""ELU, the activation of every network of the agent: torch's where it is fast, cheaper arithmetic on CPUs.

Where there are kernels of our own (native/), one pass over memory does it. What follows is for the other machines.

torch computes exp(x) − 1 to the last bit (expm1), which costs seven times what exp in float32 does, and exp in bfloat16 costs
more than in float32. Computed as exp(x) − 1 in float32, it is off by one rounding of 1 at most. Which of x and exp(x) − 1 is
nearer to zero where x < 0, and the smaller where x > 0? The smaller one of their bits, read as signed integers, and that is
ELU. Each step is a pass over memory: they go over a piece at a time that stays in the processor's cache. The gradient is
taken from the output, min(y, 0) + 1, and needs no exp at all.
"""

from __future__ import annotations

import torch as th
import torch.nn.functional as F
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from sb3_dreamer_urlb import native
from sb3_dreamer_urlb.native import ops

#: formats, and integers of the same size
BITS = {th.float32: th.int32, th.bfloat16: th.int16}
#: numbers that are not worth the calls
SMALLEST = 2**16
#: nor those of kernels of our own: without gradients, with gradients, and for the gradient itself, by format
SMALLEST_NATIVE = 2**12
SMALLEST_NATIVE_LEARNING = 2**14
SMALLEST_NATIVE_GRADIENT = {th.bfloat16: 2**15}
#: numbers that are done at once
PIECE = 2**17


def elu_(x: th.Tensor) -> th.Tensor:
    """x where positive, exp(x) − 1 elsewhere, elementwise.

    May overwrite its input, which nobody may need afterwards: neither the caller nor a gradient.

    :param x: float tensor of any shape
    """
    if not _cheaper(x):
        return F.elu(x) if _learns(x) else F.elu_(x)
    if not _learns(x):
        return _in_place(x)
    y: th.Tensor = _ELU.apply(x)  # type: ignore[no-untyped-call]
    return y


class _ELU(Function):
    @staticmethod
    def forward(ctx: th.autograd.function.FunctionCtx, x: th.Tensor) -> th.Tensor:
        # Not ctx.mark_dirty: autograd refuses to overwrite what another Function gave out as a view. Hence nobody checks that
        # the input is not needed any more.
        y = _in_place(x.data)
        ctx.native = native.active()  # type: ignore[attr-defined]
        ctx.save_for_backward(y)
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx: th.autograd.function.FunctionCtx, grad: th.Tensor) -> th.Tensor:
        (y,) = ctx.saved_tensors  # type: ignore[attr-defined]
        enough = SMALLEST_NATIVE_GRADIENT.get(y.dtype)
        if ctx.native and enough is not None and y.numel() >= enough and grad.stride() == y.stride():  # type: ignore[attr-defined]
            ours: th.Tensor = ops.elu_backward(grad, y, False)[0]
            return ours
        slope: th.Tensor = th.ops.aten.elu_backward(grad, 1.0, 1.0, 1.0, True, y)
        return slope


def _learns(x: th.Tensor) -> bool:
    return th.is_grad_enabled() and x.requires_grad


def _cheaper(x: th.Tensor) -> bool:
    """Whether to compute it here. The numbers must lie in memory one after the other, in whatever order."""
    if th.jit.is_tracing() or th.compiler.is_exporting():  # type: ignore[attr-defined, no-untyped-call]
        # What is written down runs elsewhere, on other sizes.
        return False
    smallest = SMALLEST
    if native.active():
        smallest = SMALLEST_NATIVE_LEARNING if _learns(x) else SMALLEST_NATIVE
    if x.device.type != "cpu" or x.dtype not in BITS or x.numel() < smallest:
        return False
    return x.is_contiguous() or (x.dim() == 4 and x.is_contiguous(memory_format=th.channels_last))


def _in_place(x: th.Tensor) -> th.Tensor:
    if not native.active():
        return _in_pieces(x)
    ops.bias_elu_(x, None)
    return x


def _in_pieces(x: th.Tensor) -> th.Tensor:
    """ELU in place."""
    bits = BITS[x.dtype]
    # In the order of memory.
    flat = x.as_strided((x.numel(),), (1,))
    work = th.empty(min(PIECE, x.numel()), dtype=th.float32)
    short = work if x.dtype == th.float32 else th.empty_like(work, dtype=x.dtype)
    for numbers in flat.split(PIECE):
        part, result = work[: numbers.numel()], short[: numbers.numel()]
        if short is work:
            th.exp(numbers, out=part).sub_(1)
        else:
            result.copy_(part.copy_(numbers).exp_().sub_(1))
        th.minimum(numbers.view(bits), result.view(bits), out=numbers.view(bits))
    return x
