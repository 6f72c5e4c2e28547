"""The analyses for agents of other kinds: Dict observations, Discrete actions; and those that they are not for."""

from __future__ import annotations

import numpy as np
import pytest
from counter_task import STATES, STEPS
from fake_envs import CounterEnv
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from sb3_dreamer_urlb import DreamerV2, DrQv2
from sb3_dreamer_urlb.analysis.discrepancy import latent_dynamics_discrepancy
from sb3_dreamer_urlb.analysis.novelty import intrinsic_reward_on
from sb3_dreamer_urlb.analysis.trajectories import as_batch, load_trajectories, play_trajectories, save_trajectories

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


def normalized_agent(**kwargs):
    env = VecNormalize(make_vec_env(STATES, 2), norm_reward=False)
    env.obs_rms.mean, env.obs_rms.var = np.array([0.1, 0.2, 0.3]), np.array([0.5, 1.0, 2.0])
    return DreamerV2("MlpPolicy", env, preset="tiny", intrinsic_reward="lbs", seed=0, device="cpu", **kwargs)


def test_trajectories_hold_what_the_environment_gave_and_each_agent_normalises_it():
    model, env = normalized_agent(), VecNormalize(make_vec_env(STATES, 2), norm_reward=False)
    before = env.obs_rms.count
    given = []
    inner_step, inner_reset = env.venv.step_wait, env.venv.reset
    env.venv.reset = lambda: given.append(inner_reset()) or given[-1]
    env.venv.step_wait = lambda: given.append((made := inner_step())[0]) or made
    [played, _] = play_trajectories(model, env, 2)
    np.testing.assert_array_equal(played.observations[:STEPS], [seen[0] for seen in given[:STEPS]])
    assert env.obs_rms.count == before
    normalizer = model.get_vec_normalize_env()
    batch = as_batch(model.policy, played, normalizer)
    np.testing.assert_array_equal(batch.observation[0].numpy(), normalizer.normalize_obs(played.observations))
    assert not np.allclose(batch.observation[0].numpy(), played.observations)
    assert latent_dynamics_discrepancy(model, model, [played]) == [0.0]


def test_an_agent_acts_on_what_it_knows_normalised():
    model = normalized_agent()
    seen = []
    predict = model.predict
    model.predict = lambda shown, *args, **kwargs: seen.append(shown) or predict(shown, *args, **kwargs)
    env = VecNormalize(make_vec_env(STATES, 1), norm_reward=False)
    env.obs_rms = model.get_vec_normalize_env().obs_rms
    [played] = play_trajectories(model, env, 1)
    np.testing.assert_allclose(np.concatenate(seen), env.normalize_obs(played.observations[:-1]))


def test_statistics_that_moved_are_refused():
    one, other = normalized_agent(), normalized_agent()
    other.get_vec_normalize_env().obs_rms.mean = np.zeros(3)
    trajectories = play_trajectories(one, one.get_vec_normalize_env(), 1)
    with pytest.raises(ValueError, match="statistics of observations moved"):
        latent_dynamics_discrepancy(one, other, trajectories)


def test_agents_without_a_model_and_hidden_observations_are_refused():
    env = DummyVecEnv([lambda: CounterEnv(6)])
    model = DrQv2("CnnPolicy", env, preset="tiny", intrinsic_reward="disagreement", device="cpu", frame_stack=1)
    with pytest.raises(ValueError, match="DrQv2 has none"):
        intrinsic_reward_on(model, [])
    with pytest.raises(ValueError, match="DrQv2 has none"):
        latent_dynamics_discrepancy(model, model, [])
    states = DummyVecEnv([lambda: CounterEnv(6, observation_space=spaces.Box(-1, 1, (3,), np.float32))])
    dreamer = DreamerV2("MlpPolicy", states, preset="tiny", intrinsic_reward="lbs", device="cpu")
    with pytest.raises(ValueError, match="VecFrameStack around VecNormalize hides it"):
        play_trajectories(dreamer, VecFrameStack(VecNormalize(states), 2), 1)
