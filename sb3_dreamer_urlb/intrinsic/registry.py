"""From what users write as ``intrinsic_reward=`` to an object."""

from __future__ import annotations

import copy
import inspect
from typing import Any

from sb3_dreamer_urlb.intrinsic.base import IntrinsicReward
from sb3_dreamer_urlb.intrinsic.skill_reward import SkillReward

_REGISTRY: dict[str, type[IntrinsicReward]] = {}


def register_intrinsic_reward(name: str, method: type[IntrinsicReward]) -> None:
    """Make ``DreamerV2(..., intrinsic_reward=name)`` use ``method``.

    :param name: what users write
    :param method: subclass of :class:`IntrinsicReward`
    :raises ValueError: if another class has that name already, or ``method`` is no such subclass
    """
    if not (isinstance(method, type) and issubclass(method, IntrinsicReward)):
        raise ValueError(f"The intrinsic reward {name!r} must be a subclass of IntrinsicReward, got {method!r}.")
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


def make_intrinsic_reward(
    method: str | type[IntrinsicReward] | IntrinsicReward | None, kwargs: dict[str, Any] | None = None
) -> IntrinsicReward | None:
    """What the agent explores with, its networks not yet built.

    :param method: a registered name, a class, an instance (of which a copy is used), or None for the task's reward
    :param kwargs: hyperparameters for a name or a class
    :raises ValueError: for an unknown name, unknown or unfit hyperparameters, or anything else that is no intrinsic reward
    """
    if kwargs is not None and not isinstance(kwargs, dict):
        raise ValueError(f"intrinsic_kwargs must be a dictionary or None, got {kwargs!r}.")
    kwargs = kwargs or {}
    if kwargs and (method is None or isinstance(method, IntrinsicReward)):
        raise ValueError(f"intrinsic_kwargs={kwargs} need the name or the class of a method, got intrinsic_reward={method!r}.")
    if method is None:
        return None
    if isinstance(method, IntrinsicReward):
        return _checked(copy.deepcopy(method))
    chosen = get_intrinsic_reward(method) if isinstance(method, str) else method
    if not (isinstance(chosen, type) and issubclass(chosen, IntrinsicReward)):
        raise ValueError(
            f"intrinsic_reward must be a name, a subclass or an instance of IntrinsicReward, or None, got {method!r}."
        )
    # A class without a constructor of its own shows nn.Module's *args and **kwargs.
    known = {
        name
        for name, one in inspect.signature(chosen).parameters.items()
        if one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)
    }
    unknown = sorted(set(kwargs) - known)
    if unknown:
        raise ValueError(f"Unknown intrinsic_kwargs {unknown} for {method!r}; known are {sorted(known)}.")
    return _checked(chosen(**kwargs))


def _checked(made: IntrinsicReward) -> IntrinsicReward:
    if made.skills is not None and not isinstance(made, SkillReward):
        raise ValueError(f"{type(made).__qualname__} has skills, so it must be a subclass of SkillReward, which chooses one.")
    return made
