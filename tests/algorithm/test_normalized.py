"""A pre-trained world model is shown the same numbers for the same state in fine-tuning."""

from __future__ import annotations

import numpy as np
import pytest
from fake_envs import CounterEnv
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_dreamer_urlb import PhaseSwitchCallback

SPACE = spaces.Box(-1e4, 1e4, (2,), np.float32)


def env(**kwargs):
    plain = DummyVecEnv([lambda: CounterEnv(observation_space=SPACE)])
    return plain if kwargs == {"normalized": False} else VecNormalize(plain, **kwargs)


@pytest.mark.parametrize("by_callback", [False, True])
def test_statistics_are_carried_over(tiny_model, by_callback):
    before, after = env(), env()
    model = tiny_model(before, "MlpPolicy", intrinsic_reward="icm").learn(40)
    seen = SPACE.sample()
    expected = before.normalize_obs(seen)
    if by_callback:
        # The switch lies at the beginning: nothing of the task was seen yet.
        model.learn(4, callback=PhaseSwitchCallback(20, after), reset_num_timesteps=False)
        assert model.phase == "finetuning" and after.obs_rms.count > before.obs_rms.count - 1
    else:
        model.fine_tune(env=after)
        assert np.array_equal(after.normalize_obs(seen), expected)
    assert after.obs_rms is not before.obs_rms and after.ret_rms.count < before.ret_rms.count


@pytest.mark.parametrize("by_callback", [False, True])
@pytest.mark.parametrize(
    ("mine", "its"),
    [({}, {"norm_obs": False}), ({"norm_obs": False}, {}), ({}, {"clip_obs": 1.0}), ({}, {"normalized": False})],
)
def test_other_numbers_are_refused(tiny_model, mine, its, by_callback):
    model = tiny_model(env(**mine), "MlpPolicy", intrinsic_reward="icm").learn(12)
    with pytest.raises(ValueError, match=r"pre-trained on observations .* other numbers for the same state\. Wrap"):
        if by_callback:
            model.learn(8, callback=PhaseSwitchCallback(10_000, env(**its)), reset_num_timesteps=False)
        else:
            model.fine_tune(env=env(**its))
    assert model.phase == "pretraining"
