"""ELU, the activation of every network of the agent: torch's where it is fast, cheaper arithmetic on CPUs.

torch computes exp(x) − 1 to the last bit (expm1), which costs three times what exp does. Written as
max(x, exp(min(x, 0)) − 1) it is off by one rounding of 1, in steps that are each a pass over memory: they go over a piece at
a time that stays in the processor's cache. The gradient is taken from the output, min(y, 0) + 1, and needs no exp at all.
"""

from __future__ import annotations

import torch as th
import torch.nn.functional as F
from torch.autograd import Function
from torch.autograd.function import once_differentiable

FORMATS = (th.float32, th.bfloat16)
#: numbers that are not worth the calls
SMALLEST = 2**14
#: numbers that are done at once, and numbers in a piece of more
WHOLE, PIECE = 2**18, 2**16


def elu(x: th.Tensor) -> th.Tensor:
    """x where positive, exp(x) − 1 elsewhere, elementwise.

    :param x: float tensor of any shape; never changed
    """
    if not _cheaper(x):
        return F.elu(x)
    if not (th.is_grad_enabled() and x.requires_grad):
        return _in_pieces(x, th.empty_like(x))
    y: th.Tensor = _ELU.apply(x)  # type: ignore[no-untyped-call]
    return y


def elu_(x: th.Tensor) -> th.Tensor:
    """:func:`elu` that overwrites its input; without gradients."""
    if not _cheaper(x):
        return F.elu_(x)
    return _in_pieces(x, x)


class _ELU(Function):
    @staticmethod
    def forward(ctx: th.autograd.function.FunctionCtx, x: th.Tensor) -> th.Tensor:
        y = _in_pieces(x, th.empty_like(x))
        ctx.save_for_backward(y)
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx: th.autograd.function.FunctionCtx, grad: th.Tensor) -> th.Tensor:
        (y,) = ctx.saved_tensors  # type: ignore[attr-defined]
        slope: th.Tensor = th.ops.aten.elu_backward(grad, 1.0, 1.0, 1.0, True, y)
        return slope


def _cheaper(x: th.Tensor) -> bool:
    """Whether to compute it here. The numbers must lie in memory one after the other, in whatever order."""
    if x.device.type != "cpu" or x.dtype not in FORMATS or x.numel() < SMALLEST:
        return False
    return x.is_contiguous() or (x.dim() == 4 and x.is_contiguous(memory_format=th.channels_last))


def _in_pieces(x: th.Tensor, y: th.Tensor) -> th.Tensor:
    # Both in the order of memory.
    source, target = (t.as_strided((t.numel(),), (1,)) for t in (x, y))
    compute = _short if x.dtype == th.bfloat16 else _full
    piece_size = PIECE if x.numel() > WHOLE else WHOLE
    for piece, out in zip(source.split(piece_size), target.split(piece_size), strict=True):
        compute(piece, out)
    return y


def _full(x: th.Tensor, out: th.Tensor) -> None:
    negative = x.clamp(max=0).exp_().sub_(1)
    th.maximum(x, negative, out=out)


def _short(x: th.Tensor, out: th.Tensor) -> None:
    """In bfloat16, comparisons with 0 and the final choice are cheapest as integers: only the sign bit counts."""
    bits, result = x.view(th.int16), out.view(th.int16)
    negative = bits.clamp(max=0).view(x.dtype).exp_().sub_(1)
    # One of the two parts is +0, all bits zero.
    th.clamp(bits, min=0, out=result).bitwise_or_(negative.view(th.int16))
