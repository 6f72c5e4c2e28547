"""The RSSM's GRU behind its linear layer: a layer norm over all three parts, two gates, a candidate (Hafner et al., 2021)."""

from __future__ import annotations

import torch as th
from torch import nn
from torch.autograd import Function
from torch.autograd.function import FunctionCtx, once_differentiable

from sb3_dreamer_urlb import native
from sb3_dreamer_urlb.native import planner_ops
from sb3_dreamer_urlb.nn.precision import full

#: rows from which on a kernel of our own pays
NATIVE_ROWS = 256


def recur(parts: th.Tensor, norm: nn.LayerNorm, deter: th.Tensor) -> th.Tensor:
    """The next deterministic state.

    :param parts: what the linear layer gives, reset, candidate and update gate, (n, 3·D), in the format of products
    :param norm: over all of them
    :param deter: the state before, float (n, D)
    """
    learns = th.is_grad_enabled() and norm.weight.requires_grad
    if native.on_lanes() and parts.device.type == "cpu" and len(parts) >= NATIVE_ROWS and not learns:
        new: th.Tensor = _Gates.apply(parts, norm.weight, norm.bias, norm.eps, deter)  # type: ignore[no-untyped-call]
        return new
    reset, candidate, update = norm(full(parts)).chunk(3, -1)
    candidate = th.tanh(th.sigmoid(reset) * candidate)
    # The bias of −1 makes a fresh GRU forget slowly (Hafner et al., 2021).
    return th.lerp(deter, candidate, th.sigmoid(update - 1))


class _Gates(Function):
    """Where the norm does not learn: in dreams."""

    @staticmethod
    def forward(
        ctx: FunctionCtx, parts: th.Tensor, weight: th.Tensor, bias: th.Tensor, epsilon: float, old: th.Tensor
    ) -> th.Tensor:
        old = old.contiguous()
        ctx.save_for_backward(parts, weight, bias, old)
        ctx.epsilon = epsilon  # type: ignore[attr-defined]
        new: th.Tensor = planner_ops.gates(parts, weight, bias, epsilon, old, None)
        return new

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, grad: th.Tensor) -> tuple[th.Tensor | None, ...]:
        parts, weight, bias, old = ctx.saved_tensors  # type: ignore[attr-defined]
        epsilon: float = ctx.epsilon  # type: ignore[attr-defined]
        parts_grad, old_grad = planner_ops.gates_backward(grad.contiguous(), parts, weight, bias, epsilon, old)
        return parts_grad, None, None, None, old_grad
