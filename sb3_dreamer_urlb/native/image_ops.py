"""Convolutions on a processor's tiles (AMX) as torch operators: products with an image's windows, which never are in memory.

Images are (N, C, height, width), channels last in memory. The three passes are those of
:mod:`sb3_dreamer_urlb.world_model.convolution`, the formats those of :mod:`sb3_dreamer_urlb.native.product_ops`.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch as th
import torch.nn.functional as F

from sb3_dreamer_urlb.native import ops, product_ops

_POINTER, _INDEX, _INT = ops._POINTER, ops._INDEX, ops._INT

_BY_WEIGHTS = (*(_POINTER, _POINTER, _POINTER, _INDEX, _POINTER), *(_INT, _POINTER, _INDEX, _INDEX, _INT))
ops.OPTIONAL["has_tiles"].update(
    {
        "windows_by_weights_": _BY_WEIGHTS,
        "lines_by_weights": _BY_WEIGHTS,
        "arrange_weights_": (_POINTER, _INDEX, _INDEX, _INDEX, _INDEX, _INDEX, _POINTER, _INT),
        "transposed_by_windows_": (_POINTER, _POINTER, _POINTER, _INDEX, _POINTER, _POINTER, _INT),
    }
)


def worthwhile(narrow: int) -> bool:
    """Whether this processor has tiles, and so many pixels of a narrow image make use of them."""
    return narrow >= product_ops.ROWS and "windows_by_weights_float" in ops._functions


@ops.operator("image_gather(Tensor wide, Tensor weight, int stride, Tensor? bias, bool elu) -> Tensor")
def gather(wide: th.Tensor, weight: th.Tensor, stride: int, bias: th.Tensor | None, elu: bool) -> th.Tensor:
    """A convolution.

    :param wide: float32 or bfloat16 (N, w, …)
    :param weight: (n, w, height, width), float32
    :param stride: of the windows
    :param bias: float32 (n,), None for none
    :param elu: whether ELU follows
    :return: (N, n, …) in wide's format
    """
    n, channels, *kernel = weight.shape
    _check_image(wide, channels)
    product_ops._check_bias(bias, n)
    grid = _grid(wide, kernel, stride)
    narrow = wide.new_empty(len(wide), *grid, n).permute(0, 3, 1, 2)
    arranged, function = _arranged(weight, wide.dtype, 0), ops._of_format("windows_by_weights_", wide)
    if _by_lines(wide, grid):
        arranged, function = _whole_steps(arranged.unflatten(1, (kernel[0], -1))).flatten(1), ops._function("lines_by_weights")
    laid = product_ops.lay_out_weights(arranged, False)
    if narrow.numel():
        function(
            *(_shape(wide, kernel, stride, grid, (0, 0), 0), wide.data_ptr(), laid.data_ptr(), n),
            *(None if bias is None else bias.data_ptr(), elu, narrow.data_ptr(), 0, 0, th.get_num_threads()),
        )
    return narrow


@ops.operator("image_scatter(Tensor narrow, Tensor weight, int stride, int[] size, Tensor? bias, bool elu) -> Tensor")
def scatter(
    narrow: th.Tensor, weight: th.Tensor, stride: int, size: Sequence[int], bias: th.Tensor | None, elu: bool
) -> th.Tensor:
    """A transposed convolution: stride² pixels of the wide image at a time, from the few narrow ones that reach them.

    :param narrow: float32 or bfloat16 (N, n, …)
    :param weight: (n, w, height, width), float32
    :param stride: of the windows
    :param size: height and width of the wide image; what no window reaches is the bias alone
    :param bias: float32 (w,), None for none
    :param elu: whether ELU follows
    :return: (N, w, *size) in narrow's format
    """
    n, channels, *kernel = weight.shape
    _check_image(narrow, n)
    product_ops._check_bias(bias, channels)
    few = [-(-side // stride) for side in kernel]
    grid = [-(-side // stride) for side in size]
    bias = None if bias is None else bias.repeat(stride**2)
    wide = narrow.new_empty(len(narrow), *size, channels).permute(0, 3, 1, 2)
    arranged, function = _arranged(weight, narrow.dtype, stride), ops._of_format("windows_by_weights_", narrow)
    if _by_lines(narrow, grid):
        arranged = _whole_steps(arranged.unflatten(0, (few[0], -1)).mT).mT.flatten(0, 1).contiguous()
        function = ops._function("lines_by_weights")
    laid = product_ops.lay_out_weights(arranged, True)
    if wide.numel():
        shape = _shape(narrow, few, 1, grid, (few[0] - 1, few[1] - 1), stride)
        function(
            *(shape, narrow.data_ptr(), laid.data_ptr(), stride**2 * channels),
            *(None if bias is None else bias.data_ptr(), elu, wide.data_ptr(), *size, th.get_num_threads()),
        )
    return wide


@ops.operator("image_weight(Tensor wide, Tensor narrow, int[] kernel, int stride) -> Tensor")
def weight_gradient(wide: th.Tensor, narrow: th.Tensor, kernel: Sequence[int], stride: int) -> th.Tensor:
    """Gradient of the weight.

    :param wide: float32 or bfloat16 (N, w, …)
    :param narrow: (N, n, …) in the same format
    :param kernel: height and width
    :param stride: of the windows
    :return: float32 (n, w, *kernel)
    """
    function = ops._of_format("transposed_by_windows_", wide)
    _check_image(wide, wide.shape[1])
    _check_image(narrow, narrow.shape[1])
    n, channels, grid = narrow.shape[1], wide.shape[1], _grid(wide, kernel, stride)
    if narrow.dtype != wide.dtype or len(narrow) != len(wide) or list(narrow.shape[2:]) != grid:
        raise ValueError(f"windows {tuple(kernel)} of {ops._describe(wide)} do not belong to {ops._describe(narrow)}.")
    depth, threads = kernel[0] * kernel[1] * channels, th.get_num_threads()
    out = th.empty(n, channels, *kernel) if narrow.numel() else th.zeros(n, channels, *kernel)
    if narrow.numel():
        sums = th.empty(threads * product_ops._up(n) * product_ops._up(depth))
        shape = _shape(wide, kernel, stride, grid, (0, 0), 0)
        function(shape, wide.data_ptr(), narrow.data_ptr(), n, sums.data_ptr(), out.data_ptr(), threads)
    return out


def _arranged(weight: th.Tensor, dtype: th.dtype, stride: int) -> th.Tensor:
    """In the order of windows, (n, height · width · w); if there is a stride, in that of :func:`scatter`'s phases."""
    n, channels, height, width = weight.shape
    if weight.dtype != th.float32 or not weight.is_contiguous():
        weight = weight.float().contiguous()
    rows, columns = n, height * width * channels
    if stride:
        rows, columns = -(-height // stride) * -(-width // stride) * n, stride**2 * channels
    arranged = th.empty(rows, columns, dtype=dtype)
    function = ops._of_format("arrange_weights_", arranged)
    function(weight.data_ptr(), n, channels, height, width, stride, arranged.data_ptr(), th.get_num_threads())
    return arranged


def _by_lines(image: th.Tensor, grid: Sequence[int]) -> bool:
    """Whether lines of the grid nearly fill panels, and pixels are too small for the other way."""
    return image.dtype == th.bfloat16 and image.shape[1] % 32 > 0 and 4 * grid[1] >= 3 * product_ops._up(grid[1])


def _whole_steps(weight: th.Tensor) -> th.Tensor:
    """Zeros behind the last dimension up to a multiple of 32."""
    return F.pad(weight, (0, -weight.shape[-1] % product_ops.PANEL))


def _grid(wide: th.Tensor, kernel: Sequence[int], stride: int) -> list[int]:
    return [(size - side) // stride + 1 for size, side in zip(wide.shape[2:], kernel, strict=True)]


def _shape(
    image: th.Tensor, kernel: Sequence[int], stride: int, grid: Sequence[int], before: tuple[int, int], to: int
) -> ctypes.Array[ctypes.c_int64]:
    """As images.cpp reads it."""
    number, channels, height, width = image.shape
    numbers = (number, height, width, channels, *kernel, stride, *grid, *before, to)
    return (_INDEX * len(numbers))(*numbers)


def _check_image(image: th.Tensor, channels: int) -> None:
    if image.dim() != 4 or image.shape[1] != channels or not image.is_contiguous(memory_format=th.channels_last):
        raise ValueError(f"images must have {channels} channels, last in memory, got {ops._describe(image)}.")
