"""Whether an environment still stands where it was left: who resets or steps it leaves a number, whoever it is.

A row of replay is true only if nobody stepped or reset the environment between its observation and its action. Others may:
``evaluate_policy(model, model.get_env())``, a user's ``env.reset()``, a second model. So the innermost objects that can be
reached, the ``VecEnv`` and where it has them the environments themselves, count what is asked of them.
"""

from __future__ import annotations

import copy
import functools
import itertools
import types
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

#: attribute with the number of the last touch; numbers are never given twice, so they tell environments apart, too
TOUCHED = "_last_touch"
_numbers = itertools.count()
#: what of an environment, and of a VecEnv, changes where it stands
ENV_METHODS, VEC_ENV_METHODS = ("reset", "step"), ("reset", "step_async")


def last_touches(env: VecEnv) -> tuple[int, ...]:
    """Numbers that stay the same until somebody resets or steps the environments.

    :param env: whose; watched from now on
    """
    innermost = env.unwrapped
    members = getattr(innermost, "envs", ())
    owners: list[Any] = [innermost]
    _intercept(innermost, VEC_ENV_METHODS, _count)
    for one in members if isinstance(members, list | tuple) else ():
        _intercept(one, ("step",), _hand_over_a_copy)
        owners.append(getattr(one, "unwrapped", one))
        _intercept(owners[-1], ENV_METHODS, _count)
    return tuple(vars(owner).setdefault(TOUCHED, next(_numbers)) for owner in owners if hasattr(owner, "__dict__"))


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


def _intercept(owner: Any, names: Sequence[str], around: Callable[..., Any]) -> None:
    """Let calls of methods go through ``around``, once; objects that take no attributes are left alone.

    What is put into the instance is a method bound to it: in a deep copy it is bound to the copy.
    """
    for name in names:
        mine = getattr(owner, "__dict__", {}).get(name)
        if around in getattr(mine, "interceptors", ()):
            continue
        with suppress(AttributeError, TypeError):
            setattr(owner, name, types.MethodType(_interceptor(owner, name, mine, around), owner))


def _interceptor(owner: Any, name: str, mine: Any, around: Callable[..., Any]) -> Callable[..., Any]:
    on_class = mine is None and hasattr(type(owner), name)
    found: Any = None if on_class else getattr(owner, name)

    def method(self: Any, *args: Any, **kwargs: Any) -> Any:
        original: Callable[..., Any]
        if on_class:
            original = functools.partial(getattr(type(self), name), self)
        elif isinstance(found, types.MethodType) and found.__self__ is owner:
            original = functools.partial(found.__func__, self)
        else:
            original = found
        return around(self, original, *args, **kwargs)

    # A pickle of the bound method looks it up by its name.
    method.__name__ = name
    method.interceptors = (*getattr(mine, "interceptors", ()), around)  # type: ignore[attr-defined]
    return method
