"""Products with weights while learning on a CPU in bfloat16, where oneDNN is slow at the gradient of wide weights.

That gradient is a product whose left operand lies in memory the wrong way round. Laid out first, the narrower one of the two
operands, it takes two thirds of the time (docs/performance.md). Elsewhere these are torch's own products.
"""

from __future__ import annotations

import torch as th
import torch.nn.functional as F
from torch.autograd import Function
from torch.autograd.function import once_differentiable

#: rows and inputs from which on it pays
ROWS, INPUTS = 1024, 1024


def linear(x: th.Tensor, weight: th.Tensor, bias: th.Tensor) -> th.Tensor:
    """x · weightᵀ + bias.

    :param x: (…, inputs)
    :param weight: (outputs, inputs)
    :param bias: (outputs,)
    """
    if not _cheaper(x, weight):
        return F.linear(x, weight, bias)
    dtype = th.get_autocast_dtype("cpu")
    # Outside of the function, so that autograd brings the gradients back to float32.
    x, weight, bias = x.to(dtype), weight.to(dtype), bias.to(dtype)
    with th.autocast("cpu", enabled=False):
        y: th.Tensor = _Linear.apply(x.flatten(0, -2), weight, bias)  # type: ignore[no-untyped-call]
    return y.view(*x.shape[:-1], -1)


def column_sums(x: th.Tensor) -> th.Tensor:
    """(n, m) → (m,). As a product with ones, which takes half the time of torch's sum in bfloat16."""
    return x.sum(0) if x.dtype != th.bfloat16 or x.shape[1] < 16 else (x.new_ones(1, len(x)) @ x).squeeze(0)


class _Linear(Function):
    @staticmethod
    def forward(ctx: th.autograd.function.FunctionCtx, x: th.Tensor, weight: th.Tensor, bias: th.Tensor) -> th.Tensor:
        ctx.save_for_backward(x, weight)
        return F.linear(x, weight, bias)

    @staticmethod
    @once_differentiable
    def backward(ctx: th.autograd.function.FunctionCtx, grad: th.Tensor) -> tuple[th.Tensor | None, th.Tensor, th.Tensor]:
        x, weight = ctx.saved_tensors  # type: ignore[attr-defined]
        x_grad = grad @ weight if ctx.needs_input_grad[0] else None  # type: ignore[attr-defined]
        if grad.shape[1] < x.shape[1]:
            weight_grad = grad.T.contiguous() @ x
        else:
            weight_grad = (x.T.contiguous() @ grad).T
        return x_grad, weight_grad, column_sums(grad)


def _cheaper(x: th.Tensor, weight: th.Tensor) -> bool:
    """Whether a gradient of the weight will be asked for, and lies in the range that was measured."""
    if x.device.type != "cpu" or not th.is_autocast_enabled("cpu") or not (th.is_grad_enabled() and weight.requires_grad):
        return False
    return th.get_autocast_dtype("cpu") == th.bfloat16 and x.shape[-1] >= INPUTS and x.shape[:-1].numel() >= ROWS
