"""A stand-in for CUDA graphs that runs on a CPU: it tapes operator calls, and replays them without Python.

What a CUDA graph does not do, the tape does not do either: Python is not run by a replay, so whatever should change there
stays as it was; nothing is done while recording; results lie where they lay; and what a GPU cannot record is refused.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch as th
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

#: what makes the host wait for the device, or gives results whose shape depends on values
REFUSED = ("_local_scalar_dense", "nonzero", "masked_select", "unique", "equal.default", "lift_fresh", "is_nonzero")


class CannotRecord(RuntimeError):
    """What torch raises on a GPU."""


def refusal(func: Any, args: tuple[Any, ...]) -> str | None:
    """Why a GPU could not record an operator call, None if it could."""
    name = str(func)
    if any(part in name for part in REFUSED):
        return f"{name} waits for the device"
    if name.startswith("aten.index") and isinstance(args[1], (list, tuple)):
        if any(isinstance(index, th.Tensor) and index.dtype in (th.bool, th.uint8) for index in args[1]):
            return f"{name} with a mask waits for the device"
    return None


class Tape(TorchDispatchMode):
    """A recording."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[Any, tuple[Any, ...], dict[str, Any], list[th.Tensor]]] = []
        #: memory that the work made itself, and what stood in all other memory before it was written to
        self._made: set[int] = set()
        self._before: dict[int, tuple[th.Tensor, th.Tensor]] = {}

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if (why := refusal(func, args)) is not None:
            raise CannotRecord(why)
        for tensor in _written(func, args, kwargs):
            place = tensor.untyped_storage().data_ptr()
            if place not in self._made and place not in self._before:
                whole = th.empty(0, dtype=tensor.dtype).set_(tensor.untyped_storage())
                self._before[place] = (whole, whole.clone())
        result = func(*args, **kwargs)
        results = _tensors(result)
        self._made |= {tensor.untyped_storage().data_ptr() for tensor in results} - _places((args, kwargs)) - set(self._before)
        self.calls.append((func, args, kwargs, results))
        return result

    def undo(self) -> None:
        """Recording on a GPU does nothing; here it did."""
        with th.no_grad():
            for whole, before in self._before.values():
                whole.copy_(before)

    def replay(self) -> None:
        with th.no_grad(), th._C._AutoDispatchBelowAutograd():
            for func, args, kwargs, results in self.calls:
                inputs = _places((args, kwargs))
                for old, new in zip(results, _tensors(func(*args, **kwargs)), strict=True):
                    if old.untyped_storage().data_ptr() not in inputs:
                        assert old.shape == new.shape
                        old.copy_(new)


class TapeBackend:
    """Records on a tape."""

    def __init__(self) -> None:
        self.warm_ups = 0
        self.tapes: list[Tape] = []

    def __getstate__(self) -> dict[str, Any]:
        return {"warm_ups": 0, "tapes": []}

    def warm_up(self, work: Callable[[], Any]) -> tuple[Any, str | None]:
        self.warm_ups += 1
        return work(), None

    def record(self, work: Callable[[], Any], generator: th.Generator | None) -> tuple[Tape, Any]:
        state = th.get_rng_state()
        tape = Tape()
        try:
            with tape:
                results = work()
        finally:
            tape.undo()
            th.set_rng_state(state)
        self.tapes.append(tape)
        return tape, results


def _tensors(tree: Any) -> list[th.Tensor]:
    return [leaf for leaf in tree_flatten(tree)[0] if isinstance(leaf, th.Tensor)]


def _places(tree: Any) -> set[int]:
    return {tensor.untyped_storage().data_ptr() for tensor in _tensors(tree)}


def _written(func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> list[th.Tensor]:
    """The arguments that an operator changes."""
    found: list[th.Tensor] = []
    for i, argument in enumerate(func._schema.arguments):
        if argument.alias_info is not None and argument.alias_info.is_write:
            found += _tensors(args[i] if i < len(args) else kwargs.get(argument.name))
    return found
