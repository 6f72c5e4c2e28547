"""Dense layers with many rows on a CPU, forward and backward: with kernels of our own where there are some (native/).

They lay the weights out once a product, add the bias and apply ELU before a sum ever leaves the processor, and give the
gradients of weights in float32. Elsewhere these are torch's own products, but for the gradient of wide weights in bfloat16:
oneDNN is slow where the left operand lies in memory the wrong way round. Laid out first, the narrower one of the two operands,
it takes two thirds of the time (docs/notes/performance-eager.md).
"""

from __future__ import annotations

import torch as th
import torch.nn.functional as F
from torch.autograd import Function
from torch.autograd.function import FunctionCtx, once_differentiable

from sb3_dreamer_urlb import native
from sb3_dreamer_urlb.native import ops, product_ops
from sb3_dreamer_urlb.nn.activation import elu_
from sb3_dreamer_urlb.nn.precision import product_dtype

#: rows and inputs from which on laying an operand out pays
ROWS, INPUTS = 1024, 1024


def linear(x: th.Tensor, weight: th.Tensor, bias: th.Tensor | None) -> th.Tensor:
    """x · weightᵀ + bias.

    :param x: (…, inputs)
    :param weight: (outputs, inputs)
    :param bias: (outputs,), None for none
    """
    if _on_tiles(x, weight):
        return _layer(x, weight, bias, False)
    if bias is None or not _cheaper(x, weight):
        return F.linear(x, weight, bias)
    dtype = th.get_autocast_dtype("cpu")
    # Outside of the function, so that autograd brings the gradients back to float32.
    x, weight, bias = x.to(dtype), weight.to(dtype), bias.to(dtype)
    with th.autocast("cpu", enabled=False):
        y: th.Tensor = _Linear.apply(x.flatten(0, -2), weight, bias)  # type: ignore[no-untyped-call]
    return y.view(*x.shape[:-1], -1)


def linear_elu(x: th.Tensor, weight: th.Tensor, bias: th.Tensor) -> th.Tensor:
    """ELU(x · weightᵀ + bias); parameters as those of :func:`linear`."""
    return _layer(x, weight, bias, True) if _on_tiles(x, weight) else elu_(linear(x, weight, bias))


def column_sums(x: th.Tensor) -> th.Tensor:
    """(n, m) → (m,). As a product with ones, which takes half the time of torch's sum in bfloat16."""
    return x.sum(0) if x.dtype != th.bfloat16 or x.shape[1] < 16 else (x.new_ones(1, len(x)) @ x).squeeze(0)


def _on_tiles(x: th.Tensor, weight: th.Tensor) -> bool:
    if not native.active() or x.device.type != "cpu" or product_dtype(x) not in ops.FORMATS:
        return False
    return product_ops.worthwhile(x.shape[:-1].numel(), x.shape[-1], len(weight))


def _layer(x: th.Tensor, weight: th.Tensor, bias: th.Tensor | None, elu: bool) -> th.Tensor:
    # Outside of the function, so that autograd brings x's gradient back.
    rows = x.to(product_dtype(x)).flatten(0, -2)
    y: th.Tensor = _Layer.apply(rows, weight, bias, elu)  # type: ignore[no-untyped-call]
    return y.view(*x.shape[:-1], -1)


class _Layer(Function):
    """Rows (n, inputs) in the format of products; float32 weights, whatever the format."""

    @staticmethod
    def forward(ctx: FunctionCtx, x: th.Tensor, weight: th.Tensor, bias: th.Tensor | None, elu: bool) -> th.Tensor:
        x, weight = (part if product_ops.rows_fit(part) else part.contiguous() for part in (x, weight))
        weight = weight.to(x.dtype)
        y: th.Tensor = product_ops.rows_by_weights(x, product_ops.lay_out_weights(weight, False), len(weight), bias, elu)
        wants_weight = ctx.needs_input_grad[1]  # type: ignore[attr-defined]
        # torch takes None for "nothing to keep", its types do not.
        ctx.save_for_backward(x if wants_weight else None, weight, y if elu else None)  # type: ignore[arg-type]
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, grad: th.Tensor) -> tuple[th.Tensor | None, th.Tensor | None, th.Tensor | None, None]:
        x, weight, y = ctx.saved_tensors  # type: ignore[attr-defined]
        wants_x, wants_weight, wants_bias, _ = ctx.needs_input_grad  # type: ignore[attr-defined]
        x_grad = weight_grad = bias_grad = None
        if y is not None:
            grad, bias_grad = ops.elu_backward(grad, y, wants_bias)
        else:
            grad = grad.contiguous()
            bias_grad = column_sums(grad).float() if wants_bias else None
        if wants_x:
            laid = product_ops.lay_out_weights(weight, True)
            x_grad = product_ops.rows_by_weights(grad, laid, weight.shape[1], None, False)
        if wants_weight:
            weight_grad = product_ops.transposed_product(grad, x)
        return x_grad, weight_grad, bias_grad if wants_bias else None, None


class _Linear(Function):
    @staticmethod
    def forward(ctx: FunctionCtx, x: th.Tensor, weight: th.Tensor, bias: th.Tensor) -> th.Tensor:
        ctx.save_for_backward(x, weight)
        return F.linear(x, weight, bias)

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, grad: th.Tensor) -> tuple[th.Tensor | None, th.Tensor, th.Tensor]:
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
