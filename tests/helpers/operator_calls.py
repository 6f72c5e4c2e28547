"""What torch is asked to do, and how far two ways to compute may be apart."""

from __future__ import annotations

from collections import Counter

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
