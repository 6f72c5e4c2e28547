"""Wherever an environment is taken, its id will do; what is none is told by its value."""

from __future__ import annotations

import pytest

from sb3_dreamer_urlb import DreamerV2

ENV = "CartPole-v1"


def tiny():
    return DreamerV2("MlpPolicy", ENV, preset="tiny", intrinsic_reward="lbs", device="cpu")


def set_env(model, env, folder):
    model.set_env(env)
    return model


def fine_tune(model, env, folder):
    model.fine_tune(env)
    return model


def load(model, env, folder):
    model.save(folder / "model")
    return DreamerV2.load(folder / "model", env=env, device="cpu")


DOORS = pytest.mark.parametrize("door", [set_env, fine_tune, load], ids=lambda door: door.__name__)


@DOORS
def test_an_id_will_do(door, tmp_path):
    model = door(tiny(), ENV, tmp_path)
    assert model.get_env().num_envs == 1 and model.learn(20).num_timesteps == 20


@DOORS
def test_what_is_no_environment(door, tmp_path):
    with pytest.raises(ValueError, match="env must be an environment of Gymnasium, a VecEnv or an id, got 3"):
        door(tiny(), 3, tmp_path)
