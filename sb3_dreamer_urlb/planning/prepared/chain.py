"""Dense layers one after the other, whose weights are laid out once for many products on a CPU."""

from __future__ import annotations

from collections.abc import Sequence

import torch as th

from sb3_dreamer_urlb.native import product_ops
from sb3_dreamer_urlb.nn.precision import full
from sb3_dreamer_urlb.planning.prepared.prepacked import PrepackedLinear


class Chain:
    """Layers with ELU behind all but the last one: on tiles in one pass where the processor has some, else one by one.

    Made and called inside ``native.using()`` where kernels of our own are active.

    :param weights: float (outputs, inputs) of each layer
    :param biases: float (outputs,) of each layer, None for none
    :param dtype: of products
    """

    def __init__(self, weights: Sequence[th.Tensor], biases: Sequence[th.Tensor | None], dtype: th.dtype):
        self.laid: list[th.Tensor] = []
        self.layers: list[PrepackedLinear] = []
        if product_ops.available():
            rows = [weight.detach().to(dtype).contiguous() for weight in weights]
            self.laid = [product_ops.lay_out_weights(weight, False) for weight in rows]
            self.biases = [_bias(*pair) for pair in zip(weights, biases, strict=True)]
        else:
            self.layers = [PrepackedLinear(*pair, dtype) for pair in zip(weights, biases, strict=True)]

    def __call__(self, x: th.Tensor, plus: th.Tensor | None = None, short: bool = False) -> th.Tensor:
        """
        :param x: (n, inputs), in the format of products, rows contiguous
        :param plus: added to what the first layer gives, in the same format, (n, its outputs)
        :param short: give the result in the format of products
        :return: (n, outputs of the last layer), float32 unless ``short``
        """
        if self.laid:
            y: th.Tensor = product_ops.chain(x, plus, self.laid, self.biases, short)
            return y
        for layer in self.layers[:-1]:
            x, plus = layer(x, plus, elu=True), None
        x = self.layers[-1](x, plus)
        return x if short else full(x)


def _bias(weight: th.Tensor, bias: th.Tensor | None) -> th.Tensor:
    return th.zeros(len(weight)) if bias is None else bias.detach().float().contiguous()
