"""The analyses for agents of other kinds: Dict observations, Discrete actions; and those that they are not for."""

from __future__ import annotations

import numpy as np
import pytest
from fake_envs import CounterEnv
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_dreamer_urlb import DreamerV2, DrQv2
from sb3_dreamer_urlb.analysis.discrepancy import latent_dynamics_discrepancy
from sb3_dreamer_urlb.analysis.novelty import intrinsic_reward_on
from sb3_dreamer_urlb.analysis.trajectories import load_trajectories, play_trajectories, save_trajectories

BOTH = spaces.Dict({"image": spaces.Box(0, 255, (16, 16, 3), np.uint8), "state": spaces.Box(-1, 1, (2,), np.float32)})


@pytest.mark.parametrize(
    ("policy", "observations", "actions"),
    [
        ("MultiInputPolicy", BOTH, None),
        ("MlpPolicy", spaces.Box(-1, 1, (3,), np.float32), spaces.Discrete(3)),
    ],
    ids=["Dict", "Discrete"],
)
def test_observations_and_actions_of_other_kinds(tmp_path, policy, observations, actions):
    env = DummyVecEnv([lambda: CounterEnv(6, observation_space=observations, action_space=actions)])
    model = DreamerV2(policy, env, preset="tiny", intrinsic_reward="lbs", seed=0, device="cpu")
    save_trajectories(play_trajectories(model, env, 2), tmp_path)
    trajectories = load_trajectories(tmp_path, 2)
    assert latent_dynamics_discrepancy(model, model, trajectories) == [0.0, 0.0]
    assert np.isfinite(intrinsic_reward_on(model, trajectories)).all()


def test_agents_without_a_model_and_normalised_worlds_are_refused():
    env = DummyVecEnv([lambda: CounterEnv(6)])
    model = DrQv2("CnnPolicy", env, preset="tiny", intrinsic_reward="disagreement", device="cpu", frame_stack=1)
    with pytest.raises(ValueError, match="DrQv2 has none"):
        intrinsic_reward_on(model, [])
    with pytest.raises(ValueError, match="DrQv2 has none"):
        latent_dynamics_discrepancy(model, model, [])
    states = DummyVecEnv([lambda: CounterEnv(6, observation_space=spaces.Box(-1, 1, (3,), np.float32))])
    dreamer = DreamerV2("MlpPolicy", states, preset="tiny", intrinsic_reward="lbs", device="cpu")
    with pytest.raises(ValueError, match="must not be a VecNormalize"):
        play_trajectories(dreamer, VecNormalize(states), 1)
