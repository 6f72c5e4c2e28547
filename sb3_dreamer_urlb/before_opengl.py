"""What has to be loaded before any OpenGL library: torch's GPU builds bring Triton, whose LLVM ends the process beside Mesa's.

torch imports Triton when its first optimiser is made. Where Mesa's drivers are there by then, which have an LLVM of
their own, that import is a segmentation fault, on machines without a GPU, too. The other way round both work.
"""

from __future__ import annotations

import importlib
from contextlib import suppress


def load_triton() -> None:
    """Import Triton where it is installed; half a second, once. Without it, and where it is broken, nothing happens."""
    # Whoever needs it hears what is wrong with it from torch.
    with suppress(Exception):
        importlib.import_module("triton")
