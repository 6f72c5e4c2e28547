"""Kernels that pay on vectors of sixteen lanes (AVX-512), as torch operators: draws from logits with their gradient, sums of
selected rows of weights, and what a GRU does last with its gradient.

Plans need draws, sums and the GRU, updates everything but the sums.
"""

from __future__ import annotations

import torch as th

from sb3_dreamer_urlb.native import ops

_POINTER, _INDEX, _INT, _FLOAT = ops._POINTER, ops._INDEX, ops._INT, ops._FLOAT
#: bytes of what a processor reads from memory at once
LINE = 64

#: arguments of the C function
GATHER = (
    *(_POINTER, _POINTER, _INDEX),
    *(_POINTER, _POINTER, _INDEX, _INDEX),
    *(_POINTER, _POINTER, _POINTER, _INDEX),
    *(_INDEX, _INDEX, _INDEX, _INT, _INT),
)
ops.ARGUMENTS.update(
    {
        "has_lanes": (),
        "draws_": (*[_POINTER] * 5, *[_INDEX] * 4, _INT),
        "gather_": GATHER,
        "gates_": (_POINTER, _POINTER, _POINTER, _FLOAT, *[_POINTER] * 3, *[_INDEX] * 3, _INT),
        "gates_backward_": (*[_POINTER] * 4, _FLOAT, *[_POINTER] * 3, _INDEX, _INDEX, _INT),
        "one_hot_": (_POINTER, _POINTER, _INDEX, _INDEX, _INT),
        "softmax_backward_": (_POINTER, _POINTER, _POINTER, _INDEX, _INDEX, _INT),
    }
)
ops.OPTIONAL["has_halves"] = {"gather_half": GATHER}


def fast() -> bool:
    """Whether these kernels are made for this processor (AVX-512); elsewhere torch's are faster."""
    return bool(ops._function("has_lanes")())


@ops.operator("draws(Tensor logits, Tensor? bias, Tensor uniform, bool counted, bool probs) -> (Tensor, Tensor)")
def draws(
    logits: th.Tensor, bias: th.Tensor | None, uniform: th.Tensor, counted: bool, probs: bool
) -> tuple[th.Tensor, th.Tensor]:
    """Draw one class per categorical by inverting its cumulative distribution.

    No logits are too large. Where some are not numbers, so are that variable's probabilities, and its class is any.

    :param logits: float32 or bfloat16 (…, S, K), contiguous
    :param bias: added to each of them, float32 (S, K); None for none
    :param uniform: numbers in [0, 1), float32 (…, S), contiguous
    :param counted: count classes through all S · K, not each variable's from 0
    :param probs: whether probabilities are asked for
    :return: classes, int64 (…, S), and probabilities, float32 (…, S, K), empty where ``probs`` is false
    :raises TypeError: for another format
    :raises ValueError: for another layout or size
    """
    function = ops._of_format("draws_", logits)
    *shape, variables, size = logits.shape
    ops._check_dense(logits)
    if size == 0:
        raise ValueError(f"nothing can be drawn from {ops._describe(logits)}.")
    _check("uniform numbers", uniform, th.float32, (*shape, variables))
    if bias is not None:
        _check("a bias", bias, th.float32, (variables, size))
    classes = th.empty_like(uniform, dtype=th.int64)
    found = th.empty(logits.shape if probs else 0, dtype=th.float32)
    if classes.numel():
        function(
            *(logits.data_ptr(), None if bias is None else bias.data_ptr(), uniform.data_ptr()),
            *(classes.data_ptr(), found.data_ptr() if probs else None),
            *(classes.numel() // variables, variables, size, size if counted else 0, th.get_num_threads()),
        )
    return classes, found


def rows_format(dtype: th.dtype) -> th.dtype:
    """Of rows whose sums are asked for in ``dtype``: float16 in place of bfloat16 where the processor adds such numbers, twice
    as fast and more exactly, as long as weights stay below 16 000."""
    return th.float16 if dtype == th.bfloat16 and "gather_half" in ops._functions else dtype


@ops.operator("one_hot(Tensor classes, Tensor like) -> Tensor")
def one_hot(classes: th.Tensor, like: th.Tensor) -> th.Tensor:
    """
    :param classes: int64 (…), contiguous and below K, which is not checked
    :param like: float32 or bfloat16 (…, K)
    :return: one-hot vectors in the shape and format of ``like``
    """
    function = ops._of_format("one_hot_", like)
    _check("classes", classes, th.int64, tuple(like.shape[:-1]))
    out = like.new_empty(like.shape)
    if out.numel():
        function(classes.data_ptr(), out.data_ptr(), classes.numel(), like.shape[-1], th.get_num_threads())
    return out


@ops.operator("softmax_backward(Tensor grad, Tensor probs) -> Tensor")
def softmax_backward(grad: th.Tensor, probs: th.Tensor) -> th.Tensor:
    """The gradient of logits from that of their probabilities.

    :param grad: float32 or bfloat16 (…, K), contiguous
    :param probs: float32, of the same shape, contiguous
    :return: as ``grad``
    """
    function = ops._of_format("softmax_backward_", grad)
    ops._check_dense(grad)
    _check("probabilities", probs, th.float32, tuple(grad.shape))
    out, size = th.empty_like(grad), grad.shape[-1]
    if grad.numel():
        places = [tensor.data_ptr() for tensor in (grad, probs, out)]
        function(*places, grad.numel() // size, size, th.get_num_threads())
    return out


def whole_lines(rows: th.Tensor, dtype: th.dtype) -> th.Tensor:
    """Rows of weights as :func:`gather` reads them: with zeros behind, so that each begins with a line of memory.

    :param rows: float (…, W)
    :param dtype: from :func:`rows_format`
    """
    whole = rows.new_zeros(*rows.shape[:-1], _whole(rows.shape[-1], dtype), dtype=dtype)
    whole[..., : rows.shape[-1]] = rows
    return whole


def _whole(width: int, dtype: th.dtype) -> int:
    return width + -width % (LINE // dtype.itemsize)


@ops.operator(
    "gather(Tensor rows, Tensor? classes, Tensor? others, Tensor? x, Tensor? bias, Tensor? addend, bool elu, Tensor(a!) out)"
    " -> ()"
)
def gather(
    rows: th.Tensor,
    classes: th.Tensor | None,
    others: th.Tensor | None,
    x: th.Tensor | None,
    bias: th.Tensor | None,
    addend: th.Tensor | None,
    elu: bool,
    out: th.Tensor,
) -> None:
    """out ← Σ rows[classes] + x · others + bias + addend, then ELU if asked for; summed in float32.

    :param rows: float32 or bfloat16, or float16 where :func:`rows_format` gives it, (classes, W), in :func:`whole_lines`
    :param classes: of each state, int64 (n, S), contiguous and within ``rows``, which is not checked; None for none
    :param others: as ``rows``, (A, W); None for none
    :param x: float32 (n, A), its rows contiguous
    :param bias: as ``rows``, (W,); None for none
    :param addend: in the format of ``out``, (n, W), contiguous; may be ``out``; None for none
    :param elu: whether to apply it
    :param out: (n, W), its rows contiguous; in the format of ``rows``, bfloat16 for float16
    :raises TypeError: for another format
    :raises ValueError: for another layout or size
    """
    half = rows.dtype == th.float16 and rows_format(th.bfloat16) == th.float16
    function = ops._function("gather_half") if half else ops._of_format("gather_", rows)
    n, width = out.shape
    dtype, stride = rows.dtype, _whole(width, rows.dtype)
    _check("rows of weights", rows, dtype, (len(rows), stride))
    variables, count, x_stride = 0, 0, 0
    if classes is not None:
        variables = classes.shape[-1]
        _check("classes", classes, th.int64, (n, variables))
    if others is not None:
        assert x is not None
        count, x_stride = len(others), x.stride(0)
        _check("other rows", others, dtype, (count, stride))
        _check_rows("other inputs", x, th.float32, (n, count))
    if bias is not None:
        _check("a bias", bias, dtype, (stride,))
    if addend is not None:
        _check("an addend", addend, out.dtype, (n, width))
    _check_rows("a result", out, th.bfloat16 if half else dtype, (n, width))
    places = [None if tensor is None else tensor.data_ptr() for tensor in (rows, classes, others, x, bias, addend, out)]
    function(
        *(*places[:2], variables, *places[2:4], count, x_stride, *places[4:], out.stride(0)),
        *(n, width, stride, elu, th.get_num_threads()),
    )


@ops.operator("gates(Tensor parts, Tensor weight, Tensor bias, float epsilon, Tensor old, Tensor(a!)? short) -> Tensor")
def gates(
    parts: th.Tensor, weight: th.Tensor, bias: th.Tensor, epsilon: float, old: th.Tensor, short: th.Tensor | None
) -> th.Tensor:
    """What the GRU of the RSSM does behind its product.

    :param parts: reset, candidate and update, before their norm, float32 or bfloat16 (n, 3D), contiguous
    :param weight: of the norm over all of them, float32 (3D,)
    :param bias: likewise
    :param epsilon: of the norm
    :param old: the state before, float32 (n, D), contiguous
    :param short: takes the new state, too, in the format of ``parts``, (n, D), its rows contiguous; None: nothing does
    :return: the new state, float32 (n, D)
    :raises TypeError: for another format
    :raises ValueError: for another layout or size
    """
    function = ops._of_format("gates_", parts)
    n, size = _check_gates(parts, weight, bias, old)
    if short is not None:
        _check_rows("the state's copy", short, parts.dtype, (n, size))
    new = th.empty_like(old)
    places = [tensor.data_ptr() for tensor in (parts, weight, bias)]
    copy = (None, 0) if short is None else (short.data_ptr(), short.stride(0))
    function(*places, epsilon, old.data_ptr(), new.data_ptr(), *copy, n, size, th.get_num_threads())
    return new


@ops.operator(
    "gates_backward(Tensor grad, Tensor parts, Tensor weight, Tensor bias, float epsilon, Tensor old) -> (Tensor, Tensor)"
)
def gates_backward(
    grad: th.Tensor, parts: th.Tensor, weight: th.Tensor, bias: th.Tensor, epsilon: float, old: th.Tensor
) -> tuple[th.Tensor, th.Tensor]:
    """Gradients of :func:`gates`.

    :param grad: of the new state, float32 (n, D), contiguous
    :return: of the parts, in their format, and of the state before
    """
    function = ops._of_format("gates_backward_", parts)
    n, size = _check_gates(parts, weight, bias, old)
    _check("a new state's gradient", grad, th.float32, (n, size))
    parts_grad, old_grad = th.empty_like(parts), th.empty_like(old)
    places = [tensor.data_ptr() for tensor in (grad, parts, weight, bias)]
    others = [tensor.data_ptr() for tensor in (old, parts_grad, old_grad)]
    function(*places, epsilon, *others, n, size, th.get_num_threads())
    return parts_grad, old_grad


def _check_gates(parts: th.Tensor, weight: th.Tensor, bias: th.Tensor, old: th.Tensor) -> tuple[int, int]:
    n, size = old.shape
    _check("parts", parts, parts.dtype, (n, 3 * size))
    _check("a norm's weight", weight, th.float32, (3 * size,))
    _check("a norm's bias", bias, th.float32, (3 * size,))
    _check("the state before", old, th.float32, (n, size))
    return n, size


def _check(what: str, x: th.Tensor, dtype: th.dtype, shape: tuple[int, ...]) -> None:
    if x.dtype != dtype or x.shape != shape or not x.is_contiguous():
        raise ValueError(f"{what} must be {dtype} of shape {shape} and contiguous, got {ops._describe(x)}.")


def _check_rows(what: str, x: th.Tensor, dtype: th.dtype, shape: tuple[int, ...]) -> None:
    if x.dtype != dtype or x.shape != shape or (x.stride(-1) != 1 and shape[-1] > 1):
        raise ValueError(f"{what} must be {dtype} of shape {shape} with contiguous rows, got {ops._describe(x)}.")
