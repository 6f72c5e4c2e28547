"""What an agent may do: numbers in a box, or choices among classes. Made from the action space.

Inside the agent an action is a float vector, (n, A): numbers in [-1, 1], or one-hot choices one after the other.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_dreamer_urlb.nn import distributions
from sb3_dreamer_urlb.spaces.choices import classes_of, one_hot_numbers
from sb3_dreamer_urlb.spaces.errors import UnsupportedSpaceError


class Actions(ABC):
    """One kind of action space."""

    #: A, size of the agent's action vector
    size: int
    #: number of classes of each choice; empty for numbers
    classes: tuple[int, ...] = ()

    @abstractmethod
    def to_env(self, action: np.ndarray) -> np.ndarray:
        """From the agent's actions, (n, A), to the space's bounds, shape and dtype, (n, …)."""

    @abstractmethod
    def from_env(self, action: np.ndarray) -> np.ndarray:
        """From the space's actions, (n, …), to the agent's, float32 (n, A)."""

    @abstractmethod
    def executable(self, action: th.Tensor) -> th.Tensor:
        """The agent's action, (n, A), that an environment will be given for any numbers."""

    @abstractmethod
    def random(self, n: int, generator: th.Generator | None, device: th.device) -> th.Tensor:
        """Uniformly random actions of the agent, float (n, A)."""


class BoxActions(Actions):
    """Numbers, scaled from the space's bounds to [-1, 1].

    :param space: with finite bounds
    :raises UnsupportedSpaceError: if there is no dimension, or one has no range, or an infinite one
    """

    def __init__(self, space: spaces.Box):
        if 0 in space.shape:
            raise UnsupportedSpaceError(f"The action space holds no number: {space}.")
        if not (space.low < space.high).all():
            raise UnsupportedSpaceError(
                f"Every action dimension needs low < high, got {space} with low={space.low}, high={space.high}."
            )
        # Not the difference of two bytes, which overflows.
        kind = space.low.dtype if space.low.dtype.kind == "f" else np.float64
        with np.errstate(over="ignore"):
            self.range = space.high.astype(kind) - space.low.astype(kind)
        if not np.isfinite(self.range).all():
            # ±float32.max is how an unbounded space is written by many.
            raise UnsupportedSpaceError(f"Actions need finite bounds that are not the largest numbers there are, got {space}.")
        self.space = space
        self.size = int(np.prod(space.shape))

    def to_env(self, action: np.ndarray) -> np.ndarray:
        space = self.space
        scaled = space.low + 0.5 * (action.reshape((-1, *space.shape)) + 1.0) * self.range
        if np.issubdtype(space.dtype, np.integer):
            scaled = np.rint(scaled)
        return np.clip(scaled, space.low, space.high).astype(space.dtype)

    def from_env(self, action: np.ndarray) -> np.ndarray:
        space = self.space
        scaled: np.ndarray = 2.0 * (np.subtract(action, space.low, dtype=self.range.dtype) / self.range) - 1.0
        return scaled.reshape(-1, self.size).astype(np.float32)

    def executable(self, action: th.Tensor) -> th.Tensor:
        return action.clamp(-1, 1)

    def random(self, n: int, generator: th.Generator | None, device: th.device) -> th.Tensor:
        return 2 * th.rand((n, self.size), generator=generator, device=device) - 1


class ClassActions(Actions):
    """Choices, one-hot.

    :param space: Discrete or MultiDiscrete of any shape
    """

    def __init__(self, space: spaces.Discrete | spaces.MultiDiscrete):
        self.space = space
        self.classes = classes_of(space)
        self.size = sum(self.classes)

    def to_env(self, action: np.ndarray) -> np.ndarray:
        parts = np.split(action, np.cumsum(self.classes)[:-1], axis=-1)
        chosen = np.stack([part.argmax(-1) for part in parts], -1)
        return (chosen.reshape(-1, *self._shape) + self.space.start).astype(self.space.dtype)

    def from_env(self, action: np.ndarray) -> np.ndarray:
        chosen = th.as_tensor(np.asarray(action) - self.space.start).reshape(-1, len(self.classes))
        return one_hot_numbers(chosen, self.classes).numpy()

    def executable(self, action: th.Tensor) -> th.Tensor:
        chosen = th.stack([part.argmax(-1) for part in action.split(self.classes, -1)], -1)
        return one_hot_numbers(chosen, self.classes).to(action.dtype)

    def random(self, n: int, generator: th.Generator | None, device: th.device) -> th.Tensor:
        return distributions.one_hot_choices(th.ones(n, self.size, device=device), self.classes, generator)

    @property
    def _shape(self) -> tuple[int, ...]:
        assert self.space.shape is not None
        return self.space.shape


def make_actions(space: spaces.Space[Any]) -> Actions:
    """The kind of an action space.

    :param space: of the environment
    :raises UnsupportedSpaceError: if the agent cannot act in it
    """
    if isinstance(space, spaces.Box):
        return BoxActions(space)
    if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)):
        return ClassActions(space)
    raise UnsupportedSpaceError(f"An agent needs a Box, Discrete or MultiDiscrete action space, got {space}.")
