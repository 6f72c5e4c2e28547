"""What torch is asked to do, and how far two ways to compute may be apart."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch as th
from torch.utils._python_dispatch import TorchDispatchMode

#: of ELU relative to max(|x|, 1), and of a product
ROUNDING = {th.float32: 2e-7, th.bfloat16: 2**-8}


class Calls(TorchDispatchMode):
    """Counts operator calls by name."""

    def __init__(self):
        super().__init__()
        self.counts: Counter[str] = Counter()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.counts[str(func)] += 1
        return func(*args, **(kwargs or {}))


SYNCHRONISING = ["item", "cpu", "numpy", "tolist", "__bool__", "__float__", "__int__", "__index__", "__array__"]


@contextmanager
def never_waiting(what: str) -> Iterator[None]:
    """A block in which asking a tensor for its value fails; that it does is tried first.

    :param what: is done in it, for the message
    """

    def refuse(*_, **__):
        raise AssertionError(f"{what} waited for the device")

    with pytest.MonkeyPatch.context() as patch:
        for name in SYNCHRONISING:
            patch.setattr(th.Tensor, name, refuse)
        for ask in (th.Tensor.item, bool):
            with pytest.raises(AssertionError, match="waited"):
                ask(th.ones(()))
        yield
