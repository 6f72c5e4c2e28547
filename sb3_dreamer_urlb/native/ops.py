"""The kernels as torch operators, so that whoever records or counts operator calls sees them.

Registered with :class:`torch.library.Library`, whose calls cost less than those of ``torch.library.custom_op``. They have no
gradients of their own: call them inside an ``autograd.Function``, or where nobody learns.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from typing import Any

import torch as th

from sb3_dreamer_urlb.native.build import NativeUnavailable

#: ``torch.ops.sb3_dreamer_urlb``
LIBRARY = th.library.Library("sb3_dreamer_urlb", "DEF")
#: formats, as the C functions' names end
FORMATS = {th.float32: "float", th.bfloat16: "bfloat16"}
_POINTER, _INDEX, _INT, _FLOAT = ctypes.c_void_p, ctypes.c_int64, ctypes.c_int, ctypes.c_float
#: arguments of the C functions; one a format where the name ends in _
ARGUMENTS: dict[str, tuple[Any, ...]] = {
    "bias_elu_": (_POINTER, _POINTER, _INDEX, _INDEX, _INT),
    "elu_backward_": (_POINTER, _POINTER, _POINTER, _POINTER, _INDEX, _INDEX, _INT),
}
#: the same of functions that only some processors have, by the name of the function that says so
OPTIONAL: dict[str, dict[str, tuple[Any, ...]]] = {}
#: sums of columns that a thread keeps at a time, at most, unless a row has more; they stay in the processor's cache
PERIOD = 1024

_functions: dict[str, Callable[..., None]] = {}


def bind(library: ctypes.CDLL) -> None:
    """Let the operators call a library's functions.

    :raises NativeUnavailable: where one is missing
    """
    found: dict[str, Callable[..., None]] = {}
    wanted = dict(ARGUMENTS)
    for question, functions in OPTIONAL.items():
        if getattr(library, question, bool)():
            wanted.update(functions)
    for name, arguments in wanted.items():
        for full_name in [name + suffix for suffix in FORMATS.values()] if name.endswith("_") else [name]:
            try:
                function = getattr(library, full_name)
            except AttributeError as error:
                raise NativeUnavailable(f"the library has no function {full_name}") from error
            function.argtypes, function.restype = arguments, ctypes.c_int if name.startswith("has_") else None
            found[full_name] = function
    _functions.update(found)


def operator(schema: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Make a torch operator of a function on CPU tensors.

    :param schema: as ``"name(Tensor x) -> Tensor"``
    :return: a decorator; the decorated name is the operator
    """
    name = schema.split("(")[0]

    def register(function: Callable[..., Any]) -> Callable[..., Any]:
        LIBRARY.define(schema)
        LIBRARY.impl(name, function, "CPU")
        # torch's own stand-in for a missing gradient takes a microsecond.
        LIBRARY.impl(name, th.library.fallthrough_kernel, "AutogradCPU")
        its: Callable[..., Any] = getattr(th.ops.sb3_dreamer_urlb, name).default
        return its

    return register


@operator("bias_elu_(Tensor(a!) x, Tensor? bias) -> ()")
def bias_elu_(x: th.Tensor, bias: th.Tensor | None) -> None:
    """x ← ELU(x + bias), in place.

    :param x: float32 or bfloat16, contiguous, or 4-d and channels last
    :param bias: as many as x has columns, in the same format; None adds none. Columns are the last dimension; of four
        dimensions, which are images, the channels, and then x must be channels last
    :raises TypeError: for another format
    :raises ValueError: for another layout or size
    """
    function = _of_format("bias_elu_", x)
    _check_dense(x)
    columns, place = 1, None
    if bias is not None:
        columns = _columns(x)
        if columns == 0 or bias.dtype != x.dtype or bias.shape != (columns,) or not bias.is_contiguous():
            raise ValueError(f"a bias for {_describe(x)}, the channels last in memory, cannot be {_describe(bias)}.")
        place = bias.data_ptr()
    if x.numel():
        function(x.data_ptr(), place, x.numel() // columns, columns, th.get_num_threads())


@operator("elu_backward(Tensor grad, Tensor y, bool sums) -> (Tensor, Tensor)")
def elu_backward(grad: th.Tensor, y: th.Tensor, sums: bool) -> tuple[th.Tensor, th.Tensor]:
    """The gradient at ELU's input, and its sums over all rows, the gradient of a bias.

    :param grad: at ELU's output; fastest where it lies in memory as y does
    :param y: that output, float32 or bfloat16, contiguous, or 4-d and channels last
    :param sums: whether they are asked for
    :return: grad · (min(y, 0) + 1); float32 (columns,), see :func:`bias_elu_`, empty where ``sums`` is false
    :raises TypeError: for another format
    :raises ValueError: for another layout or size
    """
    function = _of_format("elu_backward_", y)
    _check_dense(y)
    if grad.shape != y.shape:
        raise ValueError(f"a gradient of {_describe(y)} cannot be {_describe(grad)}.")
    if grad.dtype != y.dtype or grad.stride() != y.stride():
        grad = th.empty_like(y).copy_(grad)
    out = th.empty_like(y)
    threads = th.get_num_threads()
    if not sums:
        if y.numel():
            function(grad.data_ptr(), y.data_ptr(), out.data_ptr(), None, y.numel(), 4096, threads)
        return out, y.new_empty(0, dtype=th.float32)
    columns = _columns(y)
    if columns == 0:
        raise ValueError(f"no sums of {_describe(y)}: images must have their channels last in memory.")
    period = _period(columns)
    scratch = th.zeros(threads, period)
    if y.numel():
        function(grad.data_ptr(), y.data_ptr(), out.data_ptr(), scratch.data_ptr(), y.numel(), period, threads)
    return out, scratch.view(-1, columns).sum(0)


def _period(columns: int) -> int:
    """A multiple of the columns, and of 16 unless that is too much, so that hardly any work is done in small pieces."""
    even = math.lcm(columns, 16)
    if even > PERIOD:
        return columns if columns >= 256 else even
    return even * (PERIOD // even)


def _of_format(name: str, x: th.Tensor) -> Callable[..., None]:
    suffix = FORMATS.get(x.dtype)
    if suffix is None:
        raise TypeError(f"{name} takes float32 and bfloat16, got {x.dtype}.")
    return _function(name + suffix)


def _function(name: str) -> Callable[..., None]:
    try:
        return _functions[name]
    except KeyError:
        raise RuntimeError(f"{name} is not loaded; call it inside native.using(), where native.active().") from None


def _check_dense(x: th.Tensor) -> None:
    if not (x.is_contiguous() or (x.dim() == 4 and x.is_contiguous(memory_format=th.channels_last))):
        raise ValueError(f"numbers must lie in memory one after the other, got {_describe(x)}.")


def _columns(x: th.Tensor) -> int:
    """Numbers in a row; 0 where the rows do not lie in memory one after the other."""
    if x.dim() != 4:
        return x.shape[-1] if x.dim() else 1
    return x.shape[1] if x.is_contiguous(memory_format=th.channels_last) else 0


def _describe(x: th.Tensor) -> str:
    return f"{x.dtype} of shape {tuple(x.shape)} and strides {x.stride()}"
