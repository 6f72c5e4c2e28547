"""Where a model left its environments: what another one needs to go on in them without a reset.

A file holds no observation of an environment, which may have gone on since. So the note is kept by the environment, and it is
true as long as nobody else steps or resets it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecTransposeImage
from stable_baselines3.common.vec_env.base_vec_env import VecEnvWrapper

from sb3_dreamer_urlb.envs.touches import last_touches

#: attribute of the innermost VecEnv
NOTE = "_left_standing"


@dataclass(frozen=True)
class Standing:
    """What a model saw last.

    :param touches: of the environments then
    :param wrappers: through which it saw, outermost first; those that transpose images make no difference
    :param observation: of each environment
    :param starts: where it is an episode's first, bool (n,)
    """

    touches: tuple[int, ...]
    wrappers: tuple[VecEnv, ...]
    observation: Any
    starts: np.ndarray


def leave(env: VecEnv, touches: tuple[int, ...], observation: Any, starts: np.ndarray) -> None:
    """Note where the environments stand.

    :param env: the model's
    :param touches: after the model's own step or reset
    :param observation: that it gave
    :param starts: bool (n,)
    """
    vars(env.unwrapped)[NOTE] = Standing(touches, _wrappers(env), observation, starts)


def found(env: VecEnv) -> Standing | None:
    """The note, if it is still true: nobody touched the environments since, and they are seen through the same wrappers.

    :param env: as it would be the model's
    """
    note: Standing | None = vars(env.unwrapped).get(NOTE)
    if note is None or note.touches != last_touches(env):
        return None
    mine = _wrappers(env)
    alike = len(mine) == len(note.wrappers) and all(a is b for a, b in zip(mine, note.wrappers, strict=True))
    return note if alike else None


def _wrappers(env: VecEnv) -> tuple[VecEnv, ...]:
    outside: list[VecEnv] = []
    while isinstance(env, VecEnvWrapper):
        if not isinstance(env, VecTransposeImage):
            outside.append(env)
        env = env.venv
    return tuple(outside)
