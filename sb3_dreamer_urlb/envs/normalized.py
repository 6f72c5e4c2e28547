"""What environments gave before VecNormalize changed it, and how a replay does that again when it draws.

A normalised observation cannot be undone: VecNormalize clips it. It remembers the last ones that it got, but not those that
ended an episode; so they are noted where it gets them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize, VecTransposeImage

from sb3_dreamer_urlb.envs.info_keys import TERMINAL
from sb3_dreamer_urlb.envs.intercepting import intercept

#: attribute of what a VecNormalize wraps: those of the episodes that ended with its last step, by number of environment
ENDS = "_ends_of_last_step"


def watch_ends(normalizer: VecNormalize) -> None:
    """Let what it wraps note from now on how episodes end.

    :param normalizer: that will not tell
    """
    intercept(normalizer.venv, ("step_wait",), _note_ends)


def _note_ends(owner: Any, method: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    step = method(*args, **kwargs)
    # VecNormalize puts others into the same dictionaries.
    vars(owner)[ENDS] = {i: info[TERMINAL] for i, info in enumerate(step[3]) if TERMINAL in info}
    return step


def original_end(env: VecEnv, normalizer: VecNormalize, i: int) -> Any:
    """The observation with which an episode ended with the last step; None if nobody told.

    :param env: the outermost
    :param normalizer: within it, watched by :func:`watch_ends`
    :param i: number of the environment
    """
    end = vars(normalizer.venv).get(ENDS, {}).get(i)
    return None if end is None else _transposed(end, env, normalizer)


def original_observations(env: VecEnv, normalizer: VecNormalize) -> Any:
    """The last ones of all environments, with channels where the outermost wrapper puts them.

    :param env: the outermost
    :param normalizer: within it
    """
    return _transposed(normalizer.get_original_obs(), env, normalizer)


def _transposed(observation: Any, env: VecEnv, normalizer: VecNormalize) -> Any:
    for wrapper in reversed(list(_outside(env, normalizer))):
        if isinstance(wrapper, VecTransposeImage):
            observation = wrapper.transpose_observations(observation)
    return observation


def _outside(env: VecEnv, normalizer: VecNormalize) -> Iterator[VecEnvWrapper]:
    """The wrappers around a normaliser, outermost first."""
    while isinstance(env, VecEnvWrapper) and env is not normalizer:
        yield env
        env = env.venv


def hides_originals(env: VecEnv, normalizer: VecNormalize) -> bool:
    """Whether a wrapper outside of the normaliser makes other observations of its own: VecFrameStack, as rl_zoo3 puts it.

    :param env: the outermost
    :param normalizer: within it
    """
    return any(
        not isinstance(wrapper, VecTransposeImage) and wrapper.observation_space != wrapper.venv.observation_space
        for wrapper in _outside(env, normalizer)
    )


class RewardsOnly:
    """Stands for a VecNormalize where a replay draws observations that were stored as the agent saw them.

    :param normalizer: of the rewards
    """

    def __init__(self, normalizer: VecNormalize):
        self.normalizer = normalizer

    def normalize_obs(self, obs: Any) -> Any:
        """As they are."""
        return obs

    def normalize_reward(self, reward: np.ndarray) -> np.ndarray:
        """As the normaliser's."""
        return self.normalizer.normalize_reward(reward)
