"""Calling something with an environment where it lives, in another process, too.

A worker of Stable-Baselines3's ``SubprocVecEnv`` does what is on its list, and ends by any error. One thing on it takes a
class: whether the environment is wrapped in it. A class that is asked for its instances can answer with what it likes, so it
gets to see the environment in its own process. Only wrappers are asked: environments without any cannot be visited.
"""

from __future__ import annotations

from typing import Any

import gymnasium
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices


class Visitor(type):
    """Of classes whose ``visit(env)`` is called with the outermost wrapper, in its process."""

    def __instancecheck__(cls, env: Any) -> bool:
        try:
            cls.visit(env)
        except Exception:  # or the process would end
            return False
        return True

    def visit(cls, env: gymnasium.Env[Any, Any]) -> None:
        """What is to be done there."""
        raise NotImplementedError


def visited(env: VecEnv, visitor: Visitor, indices: VecEnvIndices = None) -> bool:
    """Send a visitor to environments.

    :param env: the innermost
    :param visitor: a class that every process can import
    :param indices: of the environments; None for all
    :return: whether it was with all of them
    """
    return all(env.env_is_wrapped(visitor, indices=indices))  # type: ignore[arg-type]
