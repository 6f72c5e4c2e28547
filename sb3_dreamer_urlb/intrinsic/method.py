"""What every way to explore has in common, whatever the agent: it knows what it was made with, so that files can hold it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch as th
from torch import nn

from sb3_dreamer_urlb.signatures import named_arguments

#: of rewards; returns are computed in the first
FLOATS = (th.float32, th.bfloat16, th.float16)


class ExplorationMethod(nn.Module):
    """Base of :class:`~sb3_dreamer_urlb.IntrinsicReward`, which reads a world model, and of
    :class:`~sb3_dreamer_urlb.intrinsic.transition_reward.TransitionReward`, which reads replayed steps.
    """

    #: what it makes its rewards of, for messages
    reads: ClassVar[str]
    #: False: nothing for an actor to learn, pre-training acts uniformly at random
    trains_actor: ClassVar[bool] = True
    #: False: something changes in Python from update to update, as a counter or a schedule, and a recorded update would not
    #: see it (graphs.py); updates then run eager on CUDA, too
    graph_safe: ClassVar[bool] = True

    #: what the constructor was called with, for files
    constructor_kwargs: dict[str, Any]

    def __new__(cls, *args: Any, **kwargs: Any) -> Any:
        self = super().__new__(cls)
        # A copy is made without arguments, and gets them with everything else.
        self.__dict__["constructor_kwargs"] = named_arguments(cls, args, kwargs)
        return self


def check_learnt(method: nn.Module, learnt: Any) -> None:
    """What a method's ``loss`` returned; costs nothing on the device.

    :param method: for the message
    :param learnt: None, or its loss and metrics
    :raises ValueError: for anything else, and for a loss that nothing can descend
    """
    if learnt is None:
        return
    good = isinstance(learnt, tuple) and len(learnt) == 2 and isinstance(learnt[0], th.Tensor) and isinstance(learnt[1], dict)
    if not good or not all(isinstance(value, th.Tensor) and value.shape == () for value in (learnt[0], *learnt[1].values())):
        raise ValueError(
            f"{type(method).__qualname__}.loss must return None, or a scalar tensor and a dictionary of scalar tensors "
            f"(the metrics), got {_kind_of(learnt)}."
        )


def check_reward(method: nn.Module, name: str, reward: Any, shape: Sequence[int], of: str) -> None:
    """What a method says steps are worth; another shape would be broadcast, and every step be paid for all others.

    :param method: for the message
    :param name: of what was called on it
    :param reward: what that returned
    :param shape: what it must have
    :param of: that shape in words
    :raises ValueError: for another shape, or what is no tensor of floats
    """
    if not isinstance(reward, th.Tensor) or reward.dtype not in FLOATS or tuple(reward.shape) != tuple(shape):
        raise ValueError(
            f"{type(method).__qualname__}.{name} must return a float32 tensor of the shape {of} = {tuple(shape)}, "
            f"got {_kind_of(reward)}."
        )


def _kind_of(value: Any) -> str:
    if isinstance(value, th.Tensor):
        return f"{value.dtype} of the shape {tuple(value.shape)}"
    if isinstance(value, tuple):
        return f"({', '.join(map(_kind_of, value))})"
    return type(value).__name__
