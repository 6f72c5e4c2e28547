"""A pre-trained world model is shown the same numbers for the same state in fine-tuning."""

from __future__ import annotations

import io
import warnings

import numpy as np
import pytest
from fake_envs import CounterEnv
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_dreamer_urlb import DreamerV2, DrQv2, PhaseSwitchCallback

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


# -- a model alone, in a file ----------------------------------------------------------------------------------------------


def file_of(algorithm, method, before):
    kwargs = {"preset": "tiny", "seed": 0, "device": "cpu", "intrinsic_reward": method}
    model = algorithm("MlpPolicy", before, **kwargs).learn(40)
    file = io.BytesIO()
    model.save(file)
    return file


def in_load(algorithm, file, after):
    return algorithm.load(file, after, device="cpu")


def in_set_env(algorithm, file, after):
    model = algorithm.load(file, device="cpu")
    model.set_env(after)
    return model


def in_fine_tune(algorithm, file, after):
    model = algorithm.load(file, device="cpu")
    model.fine_tune(env=after)
    return model


def saved_without_env(algorithm, file, after):
    again = io.BytesIO()
    algorithm.load(file, device="cpu").save(again)
    again.seek(0)
    return algorithm.load(again, after, device="cpu")


each = pytest.mark.parametrize(("algorithm", "method"), [(DreamerV2, "icm"), (DrQv2, "disagreement")])
ways = pytest.mark.parametrize("way", [in_load, in_set_env, in_fine_tune, saved_without_env])


@each
@ways
@pytest.mark.parametrize("reset", [False, True])
def test_a_fresh_normaliser_takes_the_files_statistics_over(algorithm, method, way, reset):
    before, after = env(), env()
    file = file_of(algorithm, method, before)
    file.seek(0)
    if reset:
        after.reset()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = way(algorithm, file, after)
    seen = SPACE.sample()
    assert np.array_equal(model.get_vec_normalize_env().normalize_obs(seen), before.normalize_obs(seen))
    assert model.learn(4, reset_num_timesteps=False).env is not None


@each
@ways
def test_statistics_of_ones_own_stay(algorithm, method, way):
    file = file_of(algorithm, method, env())
    file.seek(0)
    after = env()
    after.reset()
    for _ in range(5):
        after.step(np.zeros((1, 2), np.float32))
    seen = SPACE.sample()
    expected = after.normalize_obs(seen)
    assert np.array_equal(way(algorithm, file, after).get_vec_normalize_env().normalize_obs(seen), expected)


@each
@ways
@pytest.mark.parametrize(
    ("mine", "its", "text"),
    [
        ({}, {"normalized": False}, "behind VecNormalize, this environment shows them as they are"),
        ({}, {"norm_obs": False}, "behind VecNormalize, this environment shows them as they are"),
        ({"normalized": False}, {}, "which has seen nothing yet"),
    ],
)
def test_other_numbers_are_warned_of(algorithm, method, way, mine, its, text):
    file = file_of(algorithm, method, env(**mine))
    file.seek(0)
    with pytest.warns(UserWarning, match=text):
        way(algorithm, file, env(**its))


def test_a_model_that_has_learnt_nothing_takes_any(tiny_model):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tiny_model(env(normalized=False), "MlpPolicy").set_env(env())
