"""Images between bytes and numbers, and their distance, as torch operators: one pass over memory each."""

from __future__ import annotations

import torch as th

from sb3_dreamer_urlb.native import ops

_POINTER, _INDEX, _INT, _FLOAT = ops._POINTER, ops._INDEX, ops._INT, ops._FLOAT
#: numbers that are summed up at a time
PIECE = 8192

ops.ARGUMENTS.update(
    {
        "scale_images": (_POINTER, _INDEX, _INDEX, _INDEX, _INT, _FLOAT, _POINTER, _INT),
        "distance_": (_POINTER, _POINTER, _INDEX, _POINTER, _POINTER, _INT),
    }
)


@ops.operator("scale_images(Tensor images, float range) -> Tensor")
def scale_images(images: th.Tensor, range: float) -> th.Tensor:
    """images / range − 0.5, to the last bit as torch computes it.

    :param images: uint8 (N, C, height, width), contiguous or channels last
    :param range: see above
    :return: float32, channels last
    :raises TypeError: for another format
    :raises ValueError: for another layout
    """
    if images.dtype != th.uint8:
        raise TypeError(f"scale_images takes uint8, got {images.dtype}.")
    last = images.dim() == 4 and images.is_contiguous(memory_format=th.channels_last)
    if images.dim() != 4 or not (last or images.is_contiguous()):
        raise ValueError(f"images must be contiguous or channels last, got {ops._describe(images)}.")
    number, channels, height, width = images.shape
    out = th.empty(number, height, width, channels).permute(0, 3, 1, 2)
    pixels, threads = height * width, th.get_num_threads()
    if out.numel():
        function = ops._function("scale_images")
        function(images.data_ptr(), number, channels, pixels, last, range, out.data_ptr(), threads)
    return out


def comparable(mean: th.Tensor, target: th.Tensor) -> bool:
    """Whether :func:`squared_distance` takes them."""
    same = target.dtype == th.float32 and target.shape == mean.shape and target.stride() == mean.stride()
    dense = mean.is_contiguous() or (mean.dim() == 4 and mean.is_contiguous(memory_format=th.channels_last))
    return same and dense and mean.dtype in ops.FORMATS and mean.device.type == "cpu"


@ops.operator("squared_distance(Tensor mean, Tensor target) -> (Tensor, Tensor)")
def squared_distance(mean: th.Tensor, target: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Sum of (mean − target)², and what it is the sum of.

    :param mean: float32 or bfloat16, contiguous, or 4-d and channels last
    :param target: float32, in memory as mean is
    :return: float32 scalar, summed before anything is rounded to the short format; mean − target like mean
    :raises TypeError: for another format
    :raises ValueError: for another layout or size
    """
    function = ops._of_format("distance_", mean)
    ops._check_dense(mean)
    if target.dtype != th.float32 or target.shape != mean.shape or target.stride() != mean.stride():
        raise ValueError(f"the distance between {ops._describe(mean)} and {ops._describe(target)} is not computed here.")
    difference, sums = th.empty_like(mean), th.zeros(-(-mean.numel() // PIECE), dtype=th.float64)
    if mean.numel():
        place, threads = difference.data_ptr(), th.get_num_threads()
        function(mean.data_ptr(), target.data_ptr(), mean.numel(), place, sums.data_ptr(), threads)
    return sums.sum().float(), difference
