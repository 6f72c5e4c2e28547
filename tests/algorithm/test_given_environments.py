"""Wherever an environment is taken, its id will do; what is none is told by its value."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from fake_envs import CounterEnv
from gymnasium import spaces

from sb3_dreamer_urlb import DreamerV2, EvaluationCallback, PhaseSwitchCallback
from sb3_dreamer_urlb.__main__ import main
from sb3_dreamer_urlb.evaluation.recording import env_to_play_in
from sb3_dreamer_urlb.spaces.errors import UnsupportedSpaceError

ENV = "CartPole-v1"
BOX = spaces.Box(-1, 1, (3,), np.float32)


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


def phase_switch(model, env, folder):
    return model.learn(40, PhaseSwitchCallback(20, env))


def construct(model, env, folder):
    return DreamerV2("MlpPolicy", env, preset="tiny", device="cpu")


DOORS = pytest.mark.parametrize("door", [construct, set_env, fine_tune, load, phase_switch], ids=lambda door: door.__name__)


@DOORS
def test_an_id_will_do(door, tmp_path):
    model = door(tiny(), ENV, tmp_path)
    assert model.get_env().num_envs == 1 and model.learn(20).num_timesteps == 20


@DOORS
def test_what_is_no_environment(door, tmp_path):
    with pytest.raises(ValueError, match="env must be an environment of Gymnasium, a VecEnv or an id, got 3"):
        door(tiny(), 3, tmp_path)


def play(model, env):
    return env_to_play_in(model, env, "eval_env")


def evaluate(model, env):
    return EvaluationCallback(env).eval_env


STAGES = pytest.mark.parametrize("stage", [play, evaluate], ids=lambda stage: stage.__name__)


@STAGES
def test_an_id_to_play_in(stage):
    assert stage(tiny(), ENV).envs[0].spec.id == ENV


@STAGES
def test_what_is_no_environment_to_play_in(stage):
    with pytest.raises(ValueError, match="eval_env must be an environment of Gymnasium, a VecEnv or an id, got 3"):
        stage(tiny(), 3)


@pytest.mark.parametrize("wrong", ["walker-run", "walker_run", "walker-Run-v0"])
def test_an_id_without_its_namespace_is_answered_with_the_one_that_has_it(wrong, tmp_path, capsys):
    near = r"Did you mean .*'urlb/walker-run-v0'"
    with pytest.raises(gymnasium.error.UnregisteredEnv, match=near):
        DreamerV2("CnnPolicy", wrong, preset="tiny")
    model = DreamerV2("CnnPolicy", CounterEnv(), preset="tiny")
    with pytest.raises(gymnasium.error.UnregisteredEnv, match=near):
        model.set_env(wrong)
    model.save(tmp_path / "model.zip")
    assert main(["evaluate", str(tmp_path / "model.zip"), "--env", wrong]) == 2
    assert "'urlb/walker-run-v0'" in capsys.readouterr().err


def test_what_gymnasium_answers_itself_stays(tiny_model):
    with pytest.raises(gymnasium.error.NameNotFound, match="CartPole") as error:
        tiny_model("CartPol-v1")
    assert str(error.value).lower().count("did you mean") == 1
    with pytest.raises(gymnasium.error.NameNotFound, match="qqqq") as error:
        tiny_model("qqqq")
    assert "did you mean" not in str(error.value).lower()


@pytest.mark.parametrize("part", [spaces.Dict(hand=BOX), spaces.Tuple([BOX])])
def test_what_is_nested_is_named_with_its_cure(part):
    env = CounterEnv(observation_space=spaces.Dict(arm=part, leg=BOX))
    with pytest.raises(UnsupportedSpaceError, match=r"The observation 'arm' must be an array, got .*FlattenObservation"):
        DreamerV2("MultiInputPolicy", env, preset="tiny")


def test_bytes_are_no_fractions():
    """As the environment would have them after dividing by 255: the picture would be 255 times too bright."""
    env = CounterEnv(observation_space=spaces.Box(0, 1, (3, 16, 16), np.float32))
    model = DreamerV2("CnnPolicy", env, preset="tiny", policy_kwargs={"normalize_images": False}, device="cpu")
    with pytest.raises(ValueError, match=r"Images must be numbers in \[0, 1\], as the environment gives them, got uint8"):
        model.predict(np.full((3, 16, 16), 200, np.uint8))
    model.predict(np.full((3, 16, 16), 0.8, np.float32))
