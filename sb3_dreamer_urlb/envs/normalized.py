"""What of a VecNormalize a replay can undo and do again, when other wrappers lie outside of it."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize, VecTransposeImage


def hides_originals(env: VecEnv, normalizer: VecNormalize) -> bool:
    """Whether a wrapper outside of the normaliser makes other observations of its own: VecFrameStack, as rl_zoo3 puts it.

    :param env: the outermost
    :param normalizer: within it
    """
    while isinstance(env, VecEnvWrapper) and env is not normalizer:
        if not isinstance(env, VecTransposeImage) and env.observation_space != env.venv.observation_space:
            return True
        env = env.venv
    return False


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
