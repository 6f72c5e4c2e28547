"""Whether an environment still stands where it was left: who resets or steps it leaves a number, whoever it is.

A row of replay is true only if nobody stepped or reset the environment between its observation and its action. Others may:
``evaluate_policy(model, model.get_env())``, a user's ``env.reset()``, a second model. So the innermost objects that can be
reached, the ``VecEnv`` and where it has them the environments themselves, count what is asked of them. Environments in other
processes can only be touched by a method that their ``VecEnv`` is told to call there, which it may see.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable
from typing import Any

import gymnasium
from stable_baselines3.common.vec_env import VecEnv

from sb3_dreamer_urlb.envs.intercepting import intercept
from sb3_dreamer_urlb.envs.visiting import Visitor, visited

#: attribute with the number of the last touch; numbers are never given twice, so they tell environments apart, too
TOUCHED = "_last_touch"
_numbers = itertools.count()
#: what of an environment, and of a VecEnv, changes where it stands
ENV_METHODS, VEC_ENV_METHODS = ("reset", "step"), ("reset", "step_async")
#: what a VecEnv calls a method of its environments with
CALLS_INSIDE = "env_method"


def last_touches(env: VecEnv) -> tuple[int, ...]:
    """Numbers that stay the same until somebody resets or steps the environments.

    :param env: whose; watched from now on
    """
    innermost = env.unwrapped
    members = getattr(innermost, "envs", ())
    owners: list[Any] = [innermost]
    intercept(innermost, VEC_ENV_METHODS, _count)
    if isinstance(members, list | tuple) and members:
        owners += map(_watch, members)
    elif intercept(innermost, (CALLS_INSIDE,), _count_what_it_touched):
        _touched_inside(innermost)  # watched from now on, there, too
    return tuple(vars(owner).setdefault(TOUCHED, next(_numbers)) for owner in owners if hasattr(owner, "__dict__"))


def _watch(env: Any) -> Any:
    """:return: the innermost environment, which counts"""
    innermost = getattr(env, "unwrapped", env)
    intercept(env, ("step",), _hand_over_a_copy)
    intercept(innermost, ENV_METHODS, _count)
    return innermost


class Watched(metaclass=Visitor):
    """An environment that was visited is watched in its process."""

    @staticmethod
    def visit(env: gymnasium.Env[Any, Any]) -> None:
        """Let it count."""
        vars(_watch(env)).setdefault(TOUCHED, next(_numbers))


def _touched_inside(innermost: VecEnv) -> list[int] | None:
    """The numbers of environments in other processes; None where they cannot be had."""
    try:
        # Each time: a process may have been replaced.
        return innermost.get_attr(TOUCHED) if visited(innermost, Watched) else None
    except Exception:
        return None


def _count_what_it_touched(owner: Any, method: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    before = _touched_inside(owner)
    try:
        return method(*args, **kwargs)
    finally:
        # Where nobody counts, names must do.
        name = args[0] if args else kwargs.get("method_name")
        if name in ENV_METHODS if before is None else _touched_inside(owner) != before:
            vars(owner)[TOUCHED] = next(_numbers)


def _count(owner: Any, method: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    # Before the call: one that fails has touched it, too.
    vars(owner)[TOUCHED] = next(_numbers)
    return method(*args, **kwargs)


def _hand_over_a_copy(_: Any, method: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    return with_own_observation(method(*args, **kwargs))


def with_own_observation(step: tuple[Any, ...]) -> tuple[Any, ...]:
    """What a step returned, made safe from the reset that follows where it ends the episode.

    Environments may return the same array, and the same ``info``, each time. Vectorised ones keep the last observation of an
    episode until after the reset, which would write the next episode's first into it.

    :param step: observation, reward, terminated, truncated, info
    """
    observation, reward, terminated, truncated, info = step
    if not (terminated or truncated):
        return step
    return copy.deepcopy(observation), reward, terminated, truncated, dict(info)
