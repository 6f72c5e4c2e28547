"""Products on a processor's tiles (AMX) as torch operators: rows · weights with what follows, and the gradient of weights.

Operands are bfloat16, or float32 as three bfloat16 parts each: six products of parts round as float32 products do, and take
half the time that this processor's float32 arithmetic takes (docs/notes/performance.md).
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch as th

from sb3_dreamer_urlb.native import ops

_POINTER, _INDEX, _INT = ops._POINTER, ops._INDEX, ops._INT
#: rows or columns that are laid out together
PANEL = 32
#: rows from which on a product is worth laying the weights out, and columns and depth that tiles are filled with
ROWS, COLUMNS = 256, 32


class ChainLayer(ctypes.Structure):
    """As chain.h has it."""

    _fields_ = (("weights", _POINTER), ("bias", _POINTER), ("depth", _INDEX), ("outputs", _INDEX))


ops.OPTIONAL["has_tiles"] = {
    "lay_out_weights_": (_POINTER, _INDEX, _INDEX, _INDEX, _INT, _POINTER, _INT),
    "rows_by_weights_": (_POINTER, _INDEX, _INDEX, _INDEX, _POINTER, _INDEX, _POINTER, _INT, _POINTER, _INDEX, _INT),
    "chain_": (_POINTER, _INDEX, _INDEX, _POINTER, _INDEX, _POINTER, _INDEX, _POINTER, _INT),
    "chain_short": (_POINTER, _INDEX, _INDEX, _POINTER, _INDEX, _POINTER, _INDEX, _POINTER, _INT),
    "transposed_product_": (_POINTER, _INDEX, _POINTER, _INDEX, _POINTER, _POINTER, _INDEX, _INDEX, _INDEX, _INT),
}


def available() -> bool:
    """Whether this processor has tiles, inside ``native.using()``."""
    return "rows_by_weights_float" in ops._functions


def worthwhile(rows: int, inputs: int, outputs: int) -> bool:
    """Whether this processor has tiles, and a product of (rows, inputs) with (inputs, outputs) makes use of them."""
    return rows >= ROWS and inputs >= COLUMNS and outputs >= COLUMNS and available()


@ops.operator("lay_out_weights(Tensor weight, bool transposed) -> Tensor")
def lay_out_weights(weight: th.Tensor, transposed: bool) -> th.Tensor:
    """Weights as :func:`rows_by_weights` reads them.

    :param weight: float32 or bfloat16 (outputs, inputs), or (inputs, outputs) if ``transposed``; rows contiguous
    :param transposed: see above
    :return: int16, opaque
    """
    function = ops._of_format("lay_out_weights_", weight)
    _check_rows(weight)
    outputs, inputs = weight.shape[::-1] if transposed else weight.shape
    laid = th.empty(_laid_size(inputs, outputs, weight.dtype), dtype=th.int16)
    threads = th.get_num_threads()
    function(weight.data_ptr(), weight.stride(0), outputs, inputs, transposed, laid.data_ptr(), threads)
    return laid


@ops.operator("rows_by_weights(Tensor x, Tensor laid, int outputs, Tensor? bias, bool elu) -> Tensor")
def rows_by_weights(x: th.Tensor, laid: th.Tensor, outputs: int, bias: th.Tensor | None, elu: bool) -> th.Tensor:
    """x · weightᵀ + bias, then ELU.

    :param x: float32 or bfloat16 (n, inputs), at least one, rows contiguous
    :param laid: what :func:`lay_out_weights` gave for weights of the same format
    :param outputs: of the weights
    :param bias: float32 (outputs,), None for none
    :param elu: whether ELU follows
    :return: (n, outputs) in x's format
    """
    function = ops._of_format("rows_by_weights_", x)
    _check_rows(x)
    _check_inputs(x)
    rows, inputs = x.shape
    if laid.numel() != _laid_size(inputs, outputs, x.dtype):
        raise ValueError(f"these weights were not laid out for {ops._describe(x)} and {outputs} outputs.")
    _check_bias(bias, outputs)
    y = x.new_empty(rows, outputs)
    if y.numel():
        function(
            *(x.data_ptr(), x.stride(0), rows, inputs, laid.data_ptr(), outputs),
            *(None if bias is None else bias.data_ptr(), elu, y.data_ptr(), outputs, th.get_num_threads()),
        )
    return y


@ops.operator("chain(Tensor x, Tensor? plus, Tensor[] laid, Tensor[] biases, bool short) -> Tensor")
def chain(x: th.Tensor, plus: th.Tensor | None, laid: list[th.Tensor], biases: list[th.Tensor], short: bool) -> th.Tensor:
    """Layers one after the other, with ELU behind all but the last one.

    :param x: float32 or bfloat16 (n, inputs), at least one, rows contiguous
    :param plus: added to what the first layer gives, before ELU, (n, outputs of the first layer), in x's format; None for none
    :param laid: what :func:`lay_out_weights` gave for the weights of each layer, of x's format
    :param biases: float32 (outputs,) of each layer
    :param short: give the result in x's format
    :return: (n, outputs of the last layer), float32 unless ``short``
    """
    function = ops._function("chain_short") if short and x.dtype == th.bfloat16 else ops._of_format("chain_", x)
    _check_rows(x)
    _check_inputs(x)
    rows, depth = x.shape
    layers = chain_layers(depth, laid, biases, x.dtype)
    plus_row = 0
    if plus is not None:
        if plus.dtype != x.dtype or plus.shape != (rows, len(biases[0])) or plus.stride(1) != 1:
            raise ValueError(f"to {rows} rows of {len(biases[0])} outputs one cannot add {ops._describe(plus)}.")
        plus_row = plus.stride(0)
    y = x.new_empty(rows, layers[-1].outputs, dtype=x.dtype if short else th.float32)
    if y.numel():
        place = None if plus is None else plus.data_ptr()
        function(x.data_ptr(), x.stride(0), rows, place, plus_row, layers, len(laid), y.data_ptr(), th.get_num_threads())
    return y


def chain_layers(
    depth: int, laid: Sequence[th.Tensor], biases: Sequence[th.Tensor], dtype: th.dtype
) -> ctypes.Array[ChainLayer]:
    """Layers one after the other, as the kernels read them. They hold no reference to the tensors.

    :param depth: inputs of the first layer
    :param laid: what :func:`lay_out_weights` gave for the weights of each layer
    :param biases: float32 (outputs,) of each layer
    :param dtype: of the weights
    :raises ValueError: for weights and biases that do not fit
    """
    layers = (ChainLayer * len(laid))()
    for layer, weights, bias in zip(layers, laid, biases, strict=True):
        outputs = len(bias)
        if weights.numel() != _laid_size(depth, outputs, dtype):
            raise ValueError(f"these weights were not laid out for {depth} inputs and {outputs} outputs in {dtype}.")
        _check_bias(bias, outputs)
        layer.weights, layer.bias, layer.depth, layer.outputs = weights.data_ptr(), bias.data_ptr(), depth, outputs
        depth = outputs
    return layers


@ops.operator("transposed_product(Tensor left, Tensor right) -> Tensor")
def transposed_product(left: th.Tensor, right: th.Tensor) -> th.Tensor:
    """leftᵀ · right: the gradient of weights from that of the outputs, and the inputs.

    :param left: float32 or bfloat16 (n, M), rows contiguous
    :param right: (n, N) in the same format, rows contiguous
    :return: float32 (M, N)
    """
    function = ops._of_format("transposed_product_", left)
    _check_rows(left)
    _check_rows(right)
    if left.dtype != right.dtype or len(left) != len(right):
        raise ValueError(f"the transpose of {ops._describe(left)} cannot be multiplied with {ops._describe(right)}.")
    threads, m, n = th.get_num_threads(), left.shape[1], right.shape[1]
    out = th.empty(m, n) if len(left) else th.zeros(m, n)
    if len(left) and out.numel():
        sums = th.empty(threads * _up(m) * _up(n))
        function(
            *(left.data_ptr(), left.stride(0), right.data_ptr(), right.stride(0), sums.data_ptr(), out.data_ptr()),
            *(len(left), m, n, threads),
        )
    return out


def _up(size: int) -> int:
    return -(-size // PANEL) * PANEL


def _laid_size(inputs: int, outputs: int, dtype: th.dtype) -> int:
    """How many numbers :func:`lay_out_weights` gives."""
    return _up(outputs) * _up(inputs) * (3 if dtype == th.float32 else 1)


def rows_fit(x: th.Tensor) -> bool:
    """Whether a row's numbers lie next to each other, and rows do not overlap. The stride of a dimension of one is any."""
    (rows, columns), (down, across) = x.shape, x.stride()
    return (columns < 2 or across == 1) and (rows < 2 or down >= columns)


def _check_rows(x: th.Tensor) -> None:
    if x.dim() != 2 or not rows_fit(x):
        raise ValueError(f"rows must be contiguous, got {ops._describe(x)}.")


def _check_inputs(x: th.Tensor) -> None:
    if x.shape[1] == 0:
        raise ValueError(f"there are no inputs in {ops._describe(x)}.")


def _check_bias(bias: th.Tensor | None, outputs: int) -> None:
    if bias is not None and (bias.dtype != th.float32 or bias.shape != (outputs,) or not bias.is_contiguous()):
        raise ValueError(f"a bias for {outputs} outputs cannot be {ops._describe(bias)}.")
