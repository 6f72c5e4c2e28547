"""In which number format matrix products and convolutions run: float32, or bfloat16 where that is faster.

bfloat16 means torch.autocast: products take bfloat16 operands and add up in float32; weights, optimisers, recurrent
state, layer norm, probabilities, draws, losses and returns stay float32. Every network hands out float32
(:func:`full`), so what reads its output never meets the short format.
"""

from __future__ import annotations

import functools
import warnings

import torch as th

PRECISIONS = ("auto", "float32", "bfloat16")

#: ``"auto"``: from this size on bfloat16 is faster on a CPU with AMX tiles or AVX-512's products of bfloat16: the width of the
#: model's features for each part (docs/notes/performance.md has the measurements). Elsewhere float32, until somebody has
#: measured it there. Acting without a planner is one row at a time and always float32.
AUTO_FEATURE_SIZE = {"update": 1024, "planner": 1024}


def choose(precision: str, part: str, device: th.device | str, feature_size: int) -> th.dtype:
    """The format of one part's products.

    :param precision: one of ``PRECISIONS``
    :param part: a key of ``AUTO_FEATURE_SIZE``
    :param device: where it runs
    :param feature_size: F, width of the model's features
    :return: ``torch.float32`` or ``torch.bfloat16``; the latter warns, once a process, where the processor is slow at it
    """
    on_cpu = th.device(device).type == "cpu"
    if precision == "auto":
        fast = on_cpu and cpu_is_fast_at_short() and feature_size >= AUTO_FEATURE_SIZE[part]
        return th.bfloat16 if fast else th.float32
    if precision == "bfloat16" and on_cpu:
        if not cpu_multiplies_short():
            _warn_of_slow_products("about a hundred times")
        elif _cpu_widens_first():
            _warn_of_slow_products("two to three times")
    return {"float32": th.float32, "bfloat16": th.bfloat16}[precision]


def suited(precision: str, device: th.device | str) -> str:
    """A format that a file asks for: what was fast where it was written takes a hundred times as long elsewhere.

    :param precision: one of ``PRECISIONS``; anything else is for others to refuse
    :param device: where it would run
    :return: the same, or ``"auto"``, with a warning
    """
    if precision != "bfloat16" or th.device(device).type != "cpu" or cpu_multiplies_short():
        return precision
    warnings.warn(
        'The file asks for precision="bfloat16", for which this processor has no instructions: it gets precision="auto". '
        'To have it nevertheless, about a hundred times as slow, give it again: precision="bfloat16".'
    )
    return "auto"


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


def multiply(left: th.Tensor, right: th.Tensor) -> th.Tensor:
    """left · right for operands in one format, which the result has, too; in float32 where the CPU is slow at theirs."""
    if left.dtype == th.bfloat16 and left.device.type == "cpu" and not cpu_multiplies_short():
        return (left.float() @ right.float()).to(left.dtype)
    return left @ right


@functools.cache
def cpu_multiplies_short() -> bool:
    """Whether torch multiplies bfloat16 numbers at all well: with instructions for them, or widened, with AVX-512's.

    Whoever multiplies is asked, oneDNN: it knows what the processor can, and what ``ONEDNN_MAX_CPU_ISA`` hides. Elsewhere
    torch has loops of its own, at a hundredth of the speed of float32.
    """
    if not (th.backends.mkldnn.is_available() and hasattr(th.ops.mkldnn, "_reorder_linear_weight")):
        return False
    try:
        th.ops.mkldnn._reorder_linear_weight(th.zeros(1, 1, dtype=th.bfloat16), None)
    except RuntimeError:
        return False
    return True


def cpu_is_fast_at_short() -> bool:
    """Whether the processor has products of bfloat16 numbers, AMX's or AVX-512's, and torch takes them."""
    return _cpu_has_short_products() and cpu_multiplies_short()


@functools.cache
def _warn_of_slow_products(how_long: str) -> None:
    warnings.warn(
        'precision="bfloat16" is slow here: this processor has no instructions for bfloat16 products, which take '
        f'{how_long} as long as float32 ones; precision="auto" takes whichever is faster'
    )


def _cpu_has_short_products() -> bool:
    return _is_any_supported("amx_tile", "avx512_bf16")


def _cpu_widens_first() -> bool:
    """Whether torch takes bfloat16, with AVX-512, but has to turn every number into float32 before it multiplies."""
    return _is_any_supported("avx512") and not _cpu_has_short_products()


def _is_any_supported(*features: str) -> bool:
    # Private in every torch so far; without them nothing is known about the CPU.
    probes = (getattr(th.cpu, f"_is_{feature}_supported", None) for feature in features)
    return any(probe is not None and probe() for probe in probes)
