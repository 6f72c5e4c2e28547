"""Products on a processor's tiles (AMX) as torch operators: rows · weights with what follows, and the gradient of weights.

Operands are bfloat16, or float32 as three bfloat16 parts each: six products of parts round as float32 products do, and take
half the time that this processor's float32 arithmetic takes (docs/performance.md).
"""

from __future__ import annotations

import torch as th

from sb3_dreamer_urlb.native import ops

_POINTER, _INDEX, _INT = ops._POINTER, ops._INDEX, ops._INT
#: rows or columns that are laid out together
PANEL = 32
#: rows from which on a product is worth laying the weights out, and columns and depth that tiles are filled with
ROWS, COLUMNS = 256, 32

ops.OPTIONAL["has_tiles"] = {
    "lay_out_weights_": (_POINTER, _INDEX, _INDEX, _INDEX, _INT, _POINTER, _INT),
    "rows_by_weights_": (
        *(_POINTER, _INDEX, _INDEX, _INDEX, _POINTER, _INDEX),
        *(_POINTER, _POINTER, _INDEX, _INT, _POINTER, _INDEX, _INT),
    ),
    "transposed_product_": (_POINTER, _INDEX, _POINTER, _INDEX, _POINTER, _POINTER, _INDEX, _INDEX, _INDEX, _INT),
}


def worthwhile(rows: int, inputs: int, outputs: int) -> bool:
    """Whether this processor has tiles, and a product of (rows, inputs) with (inputs, outputs) makes use of them."""
    return rows >= ROWS and inputs >= COLUMNS and outputs >= COLUMNS and "rows_by_weights_float" in ops._functions


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
    parts = 3 if weight.dtype == th.float32 else 1
    laid = th.empty(_up(outputs) * _up(inputs) * parts, dtype=th.int16)
    threads = th.get_num_threads()
    function(weight.data_ptr(), weight.stride(0), outputs, inputs, transposed, laid.data_ptr(), threads)
    return laid


@ops.operator("rows_by_weights(Tensor x, Tensor laid, int outputs, Tensor? bias, Tensor? plus, bool elu) -> Tensor")
def rows_by_weights(
    x: th.Tensor, laid: th.Tensor, outputs: int, bias: th.Tensor | None, plus: th.Tensor | None, elu: bool
) -> th.Tensor:
    """x · weightᵀ + bias + plus, then ELU.

    :param x: float32 or bfloat16 (n, inputs), rows contiguous
    :param laid: what :func:`lay_out_weights` gave for weights of the same format
    :param outputs: of the weights
    :param bias: float32 (outputs,), None for none
    :param plus: (n, outputs) in x's format, None for none
    :param elu: whether ELU follows
    :return: (n, outputs) in x's format
    """
    function = ops._of_format("rows_by_weights_", x)
    _check_rows(x)
    rows, inputs = x.shape
    if laid.numel() != _up(outputs) * _up(inputs) * (3 if x.dtype == th.float32 else 1):
        raise ValueError(f"these weights were not laid out for {ops._describe(x)} and {outputs} outputs.")
    if bias is not None and (bias.dtype != th.float32 or bias.shape != (outputs,) or not bias.is_contiguous()):
        raise ValueError(f"a bias for {outputs} outputs cannot be {ops._describe(bias)}.")
    plus_row = 0
    if plus is not None:
        if plus.dtype != x.dtype or plus.shape != (rows, outputs) or plus.stride(1) != 1:
            raise ValueError(f"to {rows} rows of {outputs} outputs one cannot add {ops._describe(plus)}.")
        plus_row = plus.stride(0)
    y = x.new_empty(rows, outputs)
    function(
        *(x.data_ptr(), x.stride(0), rows, inputs, laid.data_ptr(), outputs),
        *(None if bias is None else bias.data_ptr(), None if plus is None else plus.data_ptr(), plus_row),
        *(elu, y.data_ptr(), outputs, th.get_num_threads()),
    )
    return y


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
    if len(left):
        sums = th.empty(threads * _up(m) * _up(n))
        function(
            *(left.data_ptr(), left.stride(0), right.data_ptr(), right.stride(0), sums.data_ptr(), out.data_ptr()),
            *(len(left), m, n, threads),
        )
    return out


def _up(size: int) -> int:
    return -(-size // PANEL) * PANEL


def _check_rows(x: th.Tensor) -> None:
    if x.dim() != 2 or x.stride(1) != 1 or x.stride(0) < x.shape[1]:
        raise ValueError(f"rows must be contiguous, got {ops._describe(x)}.")
