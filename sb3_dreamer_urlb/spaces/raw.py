"""Observations as tensors: one, or several by name."""

from __future__ import annotations

from collections.abc import Callable

import torch as th

#: of one kind, or several by name (Dict spaces)
Observation = th.Tensor | dict[str, th.Tensor]


def map_observation(function: Callable[[th.Tensor], th.Tensor], observation: Observation) -> Observation:
    """Apply a function to an observation, or to each of several."""
    if isinstance(observation, dict):
        return {key: function(part) for key, part in observation.items()}
    return function(observation)


def batch_size(observation: Observation) -> int:
    """Length of the first dimension."""
    first = next(iter(observation.values())) if isinstance(observation, dict) else observation
    return len(first)
