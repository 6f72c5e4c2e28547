"""A linear layer whose weights are laid out once for many products on a CPU."""

from __future__ import annotations

import torch as th
import torch.nn.functional as F

from sb3_dreamer_urlb.nn.activation import elu_
from sb3_dreamer_urlb.nn.precision import cpu_multiplies_short


class PrepackedLinear:
    """x · weightᵀ + bias. oneDNN orders weights its own way before each bfloat16 product; here it does so once.

    The two operators are those that torch.compile emits on CPUs. Where torch lacks them, or the processor cannot multiply
    bfloat16 numbers, they are multiplied as float32 ones, and the result is rounded.

    :param weight: float (outputs, inputs)
    :param bias: float (outputs,), None for none
    :param dtype: of products
    """

    def __init__(self, weight: th.Tensor, bias: th.Tensor | None, dtype: th.dtype):
        self.dtype = dtype
        #: of the product; other than that of operands and result only where the processor cannot
        self.inner = th.float32 if dtype == th.bfloat16 and not cpu_multiplies_short() else dtype
        self.weight = weight.detach().to(dtype).to(self.inner)
        self.bias = None if bias is None else bias.detach().to(dtype).to(self.inner)
        #: None for float32, whose products gain nothing from it (docs/notes/performance.md, "Forms of the planned agent")
        self.packed: th.Tensor | None = None
        if self.inner == th.bfloat16:
            self.packed = th.ops.mkldnn._reorder_linear_weight(self.weight.contiguous(), None)

    def __call__(self, x: th.Tensor, plus: th.Tensor | None = None, elu: bool = False) -> th.Tensor:
        """
        :param x: (n, inputs), in the format of products
        :param plus: added to the result in the same pass, (n, outputs)
        :param elu: whether to apply ELU to the result
        :return: (n, outputs), in the format of products
        """
        y = self._product(x.to(self.inner), None if plus is None else plus.to(self.inner)).to(self.dtype)
        return elu_(y) if elu else y

    def _product(self, x: th.Tensor, plus: th.Tensor | None) -> th.Tensor:
        y: th.Tensor
        if self.packed is None:
            y = F.linear(x, self.weight, self.bias)
            return y if plus is None else y.add_(plus)
        if plus is None:
            y = th.ops.mkldnn._linear_pointwise(x, self.packed, self.bias, "none", [], "")
        else:
            y = th.ops.mkldnn._linear_pointwise.binary(x, plus, self.packed, self.bias, "add")
        return y
