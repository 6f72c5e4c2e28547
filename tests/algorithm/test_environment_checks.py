"""A model without an environment, or with one that does not fit, says what to do."""

from __future__ import annotations

import numpy as np
import pytest
from fake_envs import CounterEnv
from gymnasium import spaces

from sb3_dreamer_urlb import DreamerV2, DrQv2

METHODS = {DreamerV2: "lbs", DrQv2: "disagreement"}
each = pytest.mark.parametrize("algorithm", METHODS)


def make(algorithm, **kwargs):
    return algorithm("CnnPolicy", CounterEnv(9), **{"preset": "tiny", "seed": 0, "device": "cpu", **kwargs})


@pytest.fixture
def without_env(algorithm, tmp_path):
    make(algorithm).save(tmp_path / "model")
    return algorithm.load(tmp_path / "model", device="cpu")


@each
def test_what_steps_needs_an_environment(algorithm, without_env):
    before = without_env.num_timesteps
    for name, call in (
        ("learn", lambda: without_env.learn(8)),
        ("learn", lambda: without_env.learn(8, reset_num_timesteps=False)),
        ("collect_rollouts", lambda: without_env.collect_rollouts(None, None, without_env.train_freq, None)),
        ("restart_episodes", without_env.restart_episodes),
    ):
        me = algorithm.__name__
        with pytest.raises(
            ValueError, match=rf"^{name}\(\) needs an environment, .*set_env\(env\).*{me}\.load\(path, env"
        ) as it:
            call()
        # As Stable-Baselines3's own.
        assert isinstance(it.value, AssertionError) and without_env.num_timesteps == before
    without_env.set_env(CounterEnv(9))
    assert without_env.learn(8).num_timesteps == 8


@each
def test_what_does_not_step_needs_none(algorithm, without_env, tmp_path):
    observation = CounterEnv(9).reset()[0]
    without_env.predict(observation)
    without_env.train(1, 2)
    without_env.save(tmp_path / "again")
    assert without_env.get_env() is None


@each
def test_an_environment_with_other_spaces_is_refused_alike_wherever_it_is_given(algorithm, tmp_path):
    model, pretrained = make(algorithm), make(algorithm, intrinsic_reward=METHODS[algorithm])
    model.save(tmp_path / "model")
    other = CounterEnv(9, action_space=spaces.Box(-1, 1, (5,), np.float32))
    told = set()
    for give in (
        lambda: algorithm.load(tmp_path / "model", env=other, device="cpu"),
        lambda: model.set_env(other),
        lambda: setattr(model, "env", other),
        lambda: pretrained.fine_tune(other),
    ):
        with pytest.raises(ValueError) as caught:
            give()
        told.add(str(caught.value))
    (message,) = told
    assert message.startswith(
        "Action spaces do not match: the model's is Box(-1.0, 1.0, (2,), float32), the environment's Box("
    )
    assert message.endswith(f"make a new one: {algorithm.__name__}(policy, env).")


@each
def test_fine_tuning_what_never_explored_says_so(algorithm, without_env):
    for model in (make(algorithm), without_env):
        with pytest.raises(ValueError, match=r"never pre-trained: .*learn\(\), .*intrinsic_reward=\.\.\.\)") as caught:
            model.fine_tune()
        assert "snapshot" not in str(caught.value)


@each
def test_fine_tuning_twice_names_the_snapshot_before(algorithm):
    model = make(algorithm, intrinsic_reward=METHODS[algorithm])
    model.fine_tune()
    with pytest.raises(ValueError, match=r"needs a model in the phase 'pretraining', .*SnapshotCallback"):
        model.fine_tune()
