"""Choices among classes, as spaces have them: numbers outside the agent, one-hot vectors inside."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch as th
from gymnasium import spaces


def classes_of(space: spaces.Discrete | spaces.MultiDiscrete) -> tuple[int, ...]:
    """Number of classes of each choice.

    :param space: of any shape
    """
    counts = space.n if isinstance(space, spaces.Discrete) else space.nvec
    return tuple(np.atleast_1d(counts).flatten().tolist())


def one_hot_numbers(numbers: th.Tensor, classes: Sequence[int], start: Sequence[int] | None = None) -> th.Tensor:
    """One-hot vectors, one after the other, float32.

    :param numbers: chosen classes, integer (…, len(classes))
    :param classes: number of classes of each choice
    :param start: what each choice's first class is called, 0 if None
    :raises RuntimeError: on CPU, for a number that is no class; on CUDA torch ends the program
    """
    parts = []
    for part, n, first in zip(numbers.long().unbind(-1), classes, start or [0] * len(classes), strict=True):
        zeros = part.new_zeros((*part.shape, n), dtype=th.float32)
        # Not F.one_hot, which looks at the numbers on the host.
        parts.append(zeros.scatter_(-1, (part - first).unsqueeze(-1), 1.0))
    return th.cat(parts, -1)
