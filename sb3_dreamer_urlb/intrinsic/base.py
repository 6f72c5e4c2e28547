"""What a reward inside imagination is, and the registry of the intrinsic ones.

A new way to explore is one subclass of :class:`IntrinsicReward` and one call of :func:`register_intrinsic_reward`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import torch as th
from torch import nn

from sb3_dreamer_urlb.types import Imagination, Metrics, ModelSizes, Posterior, SequenceBatch


class RewardSource(ABC):
    """Where the rewards of imagined states come from: the task's reward head, or an intrinsic reward."""

    #: μ of the reward normaliser; 1 switches it off (spec/algorithms §2)
    momentum: ClassVar[float] = 1.0

    @abstractmethod
    def reward(self, imagination: Imagination) -> th.Tensor:
        """Rewards of all imagined states, with gradients to them: float (H + 1, N)."""


class TaskReward(RewardSource):
    """Fine-tuning: the world model's reward head, which learnt the environment's reward.

    :param head: features (…, F) → reward (…)
    """

    def __init__(self, head: nn.Module):
        self.head = head

    def reward(self, imagination: Imagination) -> th.Tensor:
        return self.head(imagination.feature)


class IntrinsicReward(nn.Module, RewardSource):
    """A reward the agent makes for itself while it pre-trains.

    Subclasses build their networks in ``__init__`` and say what those learn in :meth:`loss`; the learner owns the
    optimiser. What must be saved is a parameter or a buffer.

    :param sizes: sizes of the world model it reads
    """

    momentum: ClassVar[float] = 0.95
    #: entropy bonus of the actor while exploring with this reward
    ent_coef: ClassVar[float] = 0.0

    def __init__(self, sizes: ModelSizes):
        super().__init__()
        self.sizes = sizes

    @abstractmethod
    def loss(self, posterior: Posterior, batch: SequenceBatch) -> tuple[th.Tensor, Metrics]:
        """What the module learns from a replayed batch.

        :param posterior: of the world model's pass of this same update, *before* its optimiser step; detached
        :param batch: the replayed rows
        :return: loss (scalar) and metrics (detached scalars, logged as ``train/intrinsic_<name>``)
        """


_REGISTRY: dict[str, type[IntrinsicReward]] = {}


def register_intrinsic_reward(name: str, method: type[IntrinsicReward]) -> None:
    """Make ``DreamerV2(..., intrinsic_reward=name)`` use ``method``.

    :param name: what users write
    :param method: subclass of :class:`IntrinsicReward`
    :raises ValueError: if another class has that name already
    """
    if _REGISTRY.get(name, method) is not method:
        raise ValueError(f"The intrinsic reward {name!r} is already {_REGISTRY[name].__qualname__}.")
    _REGISTRY[name] = method


def get_intrinsic_reward(name: str) -> type[IntrinsicReward]:
    """The class registered as ``name``.

    :raises ValueError: for an unknown name; the message lists the known ones
    """
    if name not in _REGISTRY:
        raise ValueError(f"Unknown intrinsic_reward {name!r}; known are {sorted(_REGISTRY)}, and None for the task's reward.")
    return _REGISTRY[name]


def registered_intrinsic_rewards() -> dict[str, type[IntrinsicReward]]:
    """All known methods by name."""
    return dict(_REGISTRY)
