"""Choices among classes, as spaces have them: numbers outside the agent, one-hot vectors inside."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch as th
import torch.nn.functional as F
from gymnasium import spaces


def classes_of(space: spaces.Discrete | spaces.MultiDiscrete) -> tuple[int, ...]:
    """Number of classes of each choice.

    :param space: of any shape
    """
    counts = space.n if isinstance(space, spaces.Discrete) else space.nvec
    return tuple(np.atleast_1d(counts).flatten().tolist())


def one_hot_numbers(numbers: th.Tensor, classes: Sequence[int]) -> th.Tensor:
    """One-hot vectors, one after the other, float32.

    :param numbers: chosen classes, counted from 0, integer (…, len(classes))
    :param classes: number of classes of each choice
    """
    parts = zip(numbers.long().unbind(-1), classes, strict=True)
    return th.cat([F.one_hot(part, n) for part, n in parts], -1).to(th.float32)
