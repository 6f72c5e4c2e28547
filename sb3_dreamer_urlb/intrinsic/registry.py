"""From what users write as ``intrinsic_reward=`` to an object."""

from __future__ import annotations

import copy
from typing import Any, TypeVar

from sb3_dreamer_urlb.intrinsic.base import IntrinsicReward
from sb3_dreamer_urlb.intrinsic.method import ExplorationMethod
from sb3_dreamer_urlb.intrinsic.skill_reward import SkillReward
from sb3_dreamer_urlb.signatures import named_parameters
from sb3_dreamer_urlb.unknown_names import check_keys, did_you_mean

Method = TypeVar("Method", bound=ExplorationMethod)

#: what is written for a method, whichever agent it is for
_REGISTRY: dict[str, type[ExplorationMethod]] = {}


def register_intrinsic_reward(name: str, method: type[ExplorationMethod]) -> None:
    """Let ``intrinsic_reward=name`` mean ``method``, for the algorithms whose agents have what it reads.

    :param name: what users write
    :param method: subclass of :class:`IntrinsicReward`, or of ``TransitionReward``
    :raises ValueError: if another class has that name already, the name is no text, or ``method`` no such subclass
    """
    if not isinstance(name, str) or not name:
        raise ValueError(f"The name of an intrinsic reward must be a text, got {name!r}.")
    if not (isinstance(method, type) and issubclass(method, ExplorationMethod)):
        raise ValueError(f"The intrinsic reward {name!r} must be a subclass of IntrinsicReward, got {method!r}.")
    if _REGISTRY.get(name, method) is not method:
        raise ValueError(f"The intrinsic reward {name!r} is already {_REGISTRY[name].__qualname__}.")
    _REGISTRY[name] = method


def get_intrinsic_reward(name: str, kind: type[Method] = IntrinsicReward) -> type[Method]:  # type: ignore[assignment]
    """The class registered as ``name``.

    :param name: what users write
    :param kind: base class of the methods that an agent can use
    :raises ValueError: for an unknown name; the message lists the known ones
    """
    known = registered_intrinsic_rewards(kind)
    if name in known:
        return known[name]
    other = f" ({name!r} reads {_REGISTRY[name].reads}, this agent's read {kind.reads})" if name in _REGISTRY else ""
    meant = did_you_mean([name], known)
    raise ValueError(
        f"Unknown intrinsic_reward {name!r}; known are {sorted(known)}, and None for the task's reward{other}.{meant}"
    )


def registered_intrinsic_rewards(kind: type[Method] = IntrinsicReward) -> dict[str, type[Method]]:  # type: ignore[assignment]
    """All known methods of a kind by name.

    :param kind: base class of the methods that an agent can use
    """
    return {name: method for name, method in _REGISTRY.items() if issubclass(method, kind)}


def make_intrinsic_reward(
    method: str | type[Method] | Method | None,
    kwargs: dict[str, Any] | None = None,
    kind: type[Method] = IntrinsicReward,  # type: ignore[assignment]
) -> Method | None:
    """What the agent explores with, its networks not yet built.

    :param method: a registered name, a class, an instance (of which a copy is used), or None for the task's reward
    :param kwargs: hyperparameters for a name or a class
    :param kind: base class of the methods that the agent can use
    :raises ValueError: for an unknown name, unknown or unfit hyperparameters, or anything else that is no intrinsic reward
    """
    if kwargs is not None and not isinstance(kwargs, dict):
        raise ValueError(f"intrinsic_kwargs must be a dictionary or None, got {kwargs!r}.")
    kwargs = kwargs or {}
    if kwargs and (method is None or isinstance(method, kind)):
        raise ValueError(f"intrinsic_kwargs={kwargs} need the name or the class of a method, got intrinsic_reward={method!r}.")
    if method is None:
        return None
    if isinstance(method, kind):
        return _checked(copy.deepcopy(method))
    chosen = get_intrinsic_reward(method, kind) if isinstance(method, str) else method
    if not (isinstance(chosen, type) and issubclass(chosen, kind)):
        raise ValueError(
            f"intrinsic_reward must be a name, a subclass or an instance of {kind.__name__}, or None, got {method!r}."
        )
    missing = sorted(getattr(chosen, "__abstractmethods__", ()))
    if missing:
        raise ValueError(f"intrinsic_reward: {chosen.__qualname__} does not say what its {' and '.join(missing)} is.")
    check_keys("intrinsic_kwargs", kwargs, named_parameters(chosen), repr(method))
    return _checked(chosen(**kwargs))


def _checked(made: Method) -> Method:
    if "_parameters" not in vars(made):
        raise ValueError(f"{type(made).__qualname__}.__init__ must call super().__init__() before anything else.")
    if isinstance(made, IntrinsicReward) and made.skills is not None and not isinstance(made, SkillReward):
        raise ValueError(f"{type(made).__qualname__} has skills, so it must be a subclass of SkillReward, which chooses one.")
    if isinstance(made, IntrinsicReward) and made.trains_actor and not made.makes_rewards:
        raise ValueError(
            f"{type(made).__qualname__} makes no reward, and its pre-training would seek the task's: it must override "
            "reward(self, imagination, reward_head) or replay_reward(self, posterior, batch)."
        )
    return made
