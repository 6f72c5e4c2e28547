"""In which number format matrix products and convolutions run: float32, or bfloat16 where that is faster.

bfloat16 means torch.autocast: products take bfloat16 operands and add up in float32; weights, optimisers, recurrent
state, layer norm, probabilities, draws, losses and returns stay float32. Every network hands out float32
(:func:`full`), so what reads its output never meets the short format.
"""

from __future__ import annotations

import functools

import torch as th

PRECISIONS = ("auto", "float32", "bfloat16")

#: ``"auto"``: from this size on bfloat16 is faster on a CPU with AMX tiles: the width of the model's features for each part
#: (docs/performance.md has the measurements). Elsewhere float32, until somebody has measured it there. Acting without a
#: planner is one row at a time and always float32.
AUTO_FEATURE_SIZE = {"update": 1024, "planner": 1024}


def choose(precision: str, part: str, device: th.device | str, feature_size: int) -> th.dtype:
    """The format of one part's products.

    :param precision: one of ``PRECISIONS``
    :param part: a key of ``AUTO_FEATURE_SIZE``
    :param device: where it runs
    :param feature_size: F, width of the model's features
    :return: ``torch.float32`` or ``torch.bfloat16``
    """
    if precision != "auto":
        return {"float32": th.float32, "bfloat16": th.bfloat16}[precision]
    fast = th.device(device).type == "cpu" and _cpu_has_amx() and feature_size >= AUTO_FEATURE_SIZE[part]
    return th.bfloat16 if fast else th.float32


def products(device: th.device | str, dtype: th.dtype) -> th.autocast:
    """Let products inside ``with products(...)`` run in ``dtype``; float32 leaves everything as it is."""
    return th.autocast(th.device(device).type, th.bfloat16, enabled=dtype == th.bfloat16)


def product_dtype(x: th.Tensor) -> th.dtype:
    """The format of a product with x here and now: as :func:`products` set it, else x's own."""
    device = x.device.type
    if not th.amp.is_autocast_available(device) or not th.is_autocast_enabled(device):
        return x.dtype
    return th.get_autocast_dtype(device)


def short(x: th.Tensor) -> th.Tensor:
    """In the format of products here and now; gradients come back in x's own."""
    return x.to(product_dtype(x))


def full(x: th.Tensor) -> th.Tensor:
    """Back to float32 behind a product; anything but bfloat16 passes as it is."""
    return x.float() if x.dtype == th.bfloat16 else x


@functools.cache
def _cpu_has_amx() -> bool:
    # Private in every torch so far; without it nothing is known about the CPU.
    probe = getattr(th.cpu, "_is_amx_tile_supported", None)
    return bool(probe is not None and probe())
