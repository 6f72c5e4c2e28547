"""Tensors ↔ safetensors, with the table of names, dtypes and shapes compared before anything is allocated."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import safetensors.torch
import torch as th
from torch import nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from sb3_dreamer_urlb.snapshots import bounded_json
from sb3_dreamer_urlb.snapshots.archive import Archive

Table = dict[str, tuple[str, tuple[int, ...]]]

DTYPES = {
    th.float64: "F64", th.float32: "F32", th.float16: "F16", th.bfloat16: "BF16", th.int64: "I64", th.int32: "I32",
    th.int16: "I16", th.int8: "I8", th.uint64: "U64", th.uint32: "U32", th.uint16: "U16", th.uint8: "U8", th.bool: "BOOL",
}  # fmt: skip
SIZES = {name: dtype.itemsize for dtype, name in DTYPES.items()}
MAX_HEADER = 4 << 20


def table_of(tensors: dict[str, th.Tensor]) -> Table:
    """Name → dtype and shape, as safetensors calls them; also of tensors without memory (``device="meta"``)."""
    return {name: (DTYPES[tensor.dtype], tuple(tensor.shape)) for name, tensor in tensors.items()}


def table_without_memory(build: Callable[[], nn.Module], found: Table) -> Table:
    """The table of a module that is built without memory.

    :param build: makes it
    :param found: of the file that describes it
    :raises ValueError: if it gets far more parameters than the file has; a million layers take time even without memory
    """
    most, count = 1000 + 4 * len(found), 0

    def check(*_: object) -> None:
        nonlocal count
        count += 1
        if count > most:
            raise ValueError(f"it describes more than {most} parameters and has {len(found)} tensors")

    hook = register_module_parameter_registration_hook(check)
    try:
        with th.device("meta"):
            return table_of(build().state_dict())
    finally:
        hook.remove()


def pack(tensors: dict[str, th.Tensor]) -> bytes:
    """Into the safetensors form.

    :raises ValueError: naming a tensor with NaN or infinities: such a state is never worth keeping
    """
    check_finite(tensors)
    plain: dict[str, th.Tensor] = {}
    seen: set[int] = set()
    for name, tensor in tensors.items():
        tensor = tensor.detach().cpu().contiguous()
        # The form knows no shared memory.
        plain[name] = tensor.clone() if tensor.data_ptr() in seen else tensor
        seen.add(tensor.data_ptr())
    return safetensors.torch.save(plain)


def read_table(archive: Archive, member: str) -> Table:
    """The table of a member, from its first bytes only.

    :raises ValueError: if it is malformed, or its sizes do not add up to the member's
    """
    length = int.from_bytes(archive.head(member, 8), "little")
    if length > min(MAX_HEADER, archive.size(member) - 8):
        raise ValueError(f"the header of {member} is damaged")
    header = bounded_json.parse(archive.head(member, 8 + length)[8:])
    if not isinstance(header, dict):
        raise ValueError(f"the header of {member} is damaged")
    table = {str(name): _entry(member, name, entry) for name, entry in header.items()}
    total = sum(SIZES[dtype] * math.prod(shape) for dtype, shape in table.values())
    if 8 + length + total != archive.size(member):
        raise ValueError(f"the tensors of {member} do not fill it")
    return table


def _entry(member: str, name: str, entry: Any) -> tuple[str, tuple[int, ...]]:
    if not isinstance(entry, dict) or set(entry) != {"dtype", "shape", "data_offsets"}:
        raise ValueError(f"the header of {member} is damaged at {name[:80]!r}")
    dtype, shape = entry["dtype"], entry["shape"]
    sizes_fit = isinstance(shape, list) and len(shape) <= 16 and all(type(size) is int and size >= 0 for size in shape)
    if not isinstance(dtype, str) or dtype not in SIZES or not sizes_fit:
        raise ValueError(f"{name[:80]!r} has the dtype {dtype!r} and the shape {str(shape)[:80]}")
    return dtype, tuple(shape)


def compare(found: Table, expected: Table) -> None:
    """Compare two tables.

    :raises ValueError: naming the first difference
    """
    for name in sorted(expected.keys() - found.keys()):
        raise ValueError(f"it lacks the tensor {name!r}")
    for name in sorted(found.keys() - expected.keys()):
        raise ValueError(f"it has a tensor {name[:80]!r}, which the model has not")
    for name, entry in expected.items():
        if found[name] != entry:
            dtype, shape = found[name]
            raise ValueError(f"the tensor {name!r} is {dtype} {list(shape)}, the model's {entry[0]} {list(entry[1])}")


def unpack(archive: Archive, member: str) -> dict[str, th.Tensor]:
    """All tensors of a member, on the CPU; compare its table first.

    :raises ValueError: naming a tensor that is not finite
    """
    try:
        tensors = safetensors.torch.load(archive.read(member))
    except safetensors.SafetensorError as error:
        raise ValueError(f"{member} is damaged: {error}") from error
    check_finite(tensors)
    return tensors


def check_finite(tensors: dict[str, th.Tensor]) -> None:
    """:raises ValueError: naming a tensor with NaN or infinities"""
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and tensor.numel() > 0:
            # NaN is the extreme of whatever holds it.
            low, high = tensor.detach().aminmax()
            if not bool(low.isfinite() & high.isfinite()):
                raise ValueError(f"the tensor {name!r} holds values that are not finite")
