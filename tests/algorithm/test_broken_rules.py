"""Environments that do not keep to their spaces or to Gymnasium's interface: the error says what finds the breach."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv
from gymnasium import spaces
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecNormalize

from sb3_dreamer_urlb import DreamerV2, DrQv2
from sb3_dreamer_urlb.mistakes import tell

BOX = spaces.Box(-1, 1, (3,), np.float32)


class Kept(gymnasium.Env):
    """Keeps to everything; subclasses break one rule each."""

    observation_space = BOX
    action_space = spaces.Discrete(2)

    def seen(self):
        return self.observation_space.sample()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.seen(), {}

    def step(self, action):
        return self.seen(), 0.0, False, False, {}


class OldReset(Kept):
    def reset(self):
        return self.seen()


class OldStep(Kept):
    def step(self, action):
        return self.seen(), 0.0, False, {}


class OtherShape(Kept):
    def seen(self):
        return np.zeros(4, np.float32)


class NoReward(Kept):
    def step(self, action):
        return self.seen(), None, False, False, {}


class MissingPart(Kept):
    observation_space = spaces.Dict({"arm": BOX, "leg": BOX})

    def seen(self):
        return {"arm": np.zeros(3, np.float32)}


BROKEN = [OldReset, OldStep, OtherShape, NoReward, MissingPart]


@pytest.mark.parametrize("given", [lambda env: env(), lambda env: DummyVecEnv([env])], ids=["plain", "vectorised"])
@pytest.mark.parametrize("env", BROKEN, ids=lambda env: env.__name__)
def test_an_error_says_what_finds_the_breach(env, given, capsys):
    policy = "MultiInputPolicy" if env is MissingPart else "MlpPolicy"
    model = DreamerV2(policy, given(env), preset="tiny", device="cpu")
    if env is NoReward and isinstance(model.env.envs[0], NoReward):
        # Without a Monitor numpy takes it for NaN.
        with pytest.raises(ValueError, match=r"Environment 0, step 1: .*reward.*expected finite numbers"):
            model.learn(4)
        return
    with pytest.raises((TypeError, ValueError, KeyError)) as raised:
        model.learn(4)
    (note,) = raised.value.__notes__
    asked = "step" if env in (OldStep, NoReward) else "reset"
    assert f"asked to {asked}. stable_baselines3.common.env_checker.check_env(env) tells" in note
    tell("a-command", raised.value)
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "check_env(env)" in error


CHOICES = {
    "Discrete": (spaces.Discrete(4), 7, "7"),
    "Discrete, from 1": (spaces.Discrete(4, start=1), 0, "0"),
    "MultiDiscrete": (spaces.MultiDiscrete([2, 3]), np.array([1, -1]), r"1, -1"),
}


class LeavesItsSpace(Kept):
    """With its observation of a number, counted from 0; the last of an episode is number 3."""

    def __init__(self, space, wrong, when, named):
        self.observation_space = spaces.Dict({"arm": BOX, "way": space}) if named else space
        self.wrong, self.when, self.named, self.count = wrong, when, named, -1

    def seen(self):
        self.count += 1
        seen = super().seen()
        if self.count == self.when:
            return {**seen, "way": self.wrong} if self.named else self.wrong
        return seen

    def step(self, action):
        ends = (self.count + 1) % 4 == 3
        return self.seen(), 0.0, ends, False, {}


@pytest.mark.parametrize("named", [False, True], ids=["alone", "by name"])
@pytest.mark.parametrize("when", [0, 2, 3, 4], ids=["first", "within an episode", "last", "first of the next"])
@pytest.mark.parametrize("choices", CHOICES)
def test_choices_out_of_their_space_are_refused_before_they_are_kept(choices, when, named):
    space, wrong, shown = CHOICES[choices]
    env = LeavesItsSpace(space, wrong, when, named)
    model = DreamerV2("MultiInputPolicy" if named else "MlpPolicy", env, preset="tiny", device="cpu", learning_starts=100)
    whose = "observation 'way'" if named else "observation"
    with pytest.raises(ValueError, match=rf"^The environments' {whose} must be in {type(space).__name__}.*{shown}") as raised:
        model.learn(8)
    (note,) = raised.value.__notes__
    assert f"asked to {'step' if when else 'reset'}." in note and "check_env(env) tells" in note


@pytest.mark.parametrize("normalized", [False, True], ids=["plain", "normalised"])
@pytest.mark.parametrize("named", [False, True], ids=["alone", "by name"])
@pytest.mark.parametrize("when", [0, 2, 3, 4], ids=["first", "within an episode", "last", "first of the next"])
def test_observations_that_are_not_finite_are_refused_before_they_are_kept(when, named, normalized):
    env = DummyVecEnv([lambda: LeavesItsSpace(BOX, np.float32([0, np.nan, 0]), when, named)])
    env = VecNormalize(env, norm_reward=False, norm_obs_keys=["way"] if named else None) if normalized else env
    model = DreamerV2("MultiInputPolicy" if named else "MlpPolicy", env, preset="tiny", device="cpu", learning_starts=100)
    whose = "observation 'way'" if named else "observation"
    step = "reset" if when == 0 else f"step {min(when, 3)}"
    with pytest.raises(ValueError, match=rf"^Environment 0, {step}: the {whose} is not finite; .*FaultGuard"):
        model.learn(8)
    for episode in (*model.replay_buffer.episodes, *filter(None, model.replay_buffer.open)):
        assert all(np.isfinite(column[: len(episode)]).all() for column in episode.columns.values())


def test_other_errors_are_left_alone():
    def fails(*_):
        raise ValueError("of a callback")

    model = DreamerV2("MlpPolicy", Kept(), preset="tiny", device="cpu")
    for _ in range(2):
        with pytest.raises(ValueError, match="of a callback") as raised:
            model.learn(4, callback=fails)
        assert not hasattr(raised.value, "__notes__")
    assert model.learn(4).num_timesteps == 4


# -- vectorised environments that others wrote -----------------------------------------------------------------------------

FORMS = {
    "rewards by rows": (
        lambda seen, reward: (seen, reward[:, None]),
        r"must give 2 rewards, got an array of the shape \(2, 1\)",
    ),
    "too few rows": (lambda seen, reward: (seen[:1], reward), r"arrays of 2 observations, got array of the shape \(1, 3\)"),
    "tensors": (lambda seen, reward: (th.as_tensor(seen), reward), "arrays of 2 observations, got Tensor"),
}


@pytest.mark.parametrize("form", FORMS)
def test_rows_of_another_form_are_named(form):
    change, message = FORMS[form]

    class Others(VecEnvWrapper):
        def reset(self):
            return self.venv.reset()

        def step_wait(self):
            seen, reward, dones, infos = self.venv.step_wait()
            return (*change(seen, reward), dones, infos)

    model = DreamerV2("MlpPolicy", Others(DummyVecEnv([Kept] * 2)), preset="tiny", device="cpu")
    with pytest.raises(ValueError, match=message) as raised:
        model.learn(8)
    assert "asked to step" in raised.value.__notes__[0]


@pytest.mark.parametrize("name", ["observation_space", "action_space"])
def test_environments_with_unequal_spaces_are_named(name):
    class Other(Kept):
        pass

    setattr(Other, name, spaces.Box(-5, 5, (3,), np.float32))
    with pytest.raises(ValueError, match=rf"env must have one {name}: environment 1 has Box\(-5.0, 5.0"):
        DreamerV2("MlpPolicy", DummyVecEnv([Kept, Other]), preset="tiny")


def test_a_class_is_no_environment():
    with pytest.raises(ValueError, match=r"env must be an environment, got the class Kept: Kept\(\) is one"):
        DreamerV2("MlpPolicy", Kept, preset="tiny")
    model = DreamerV2("MlpPolicy", Kept(), preset="tiny")
    with pytest.raises(ValueError, match="got the class Kept"):
        model.set_env(Kept)


@pytest.mark.parametrize("n_envs", [1, 2])
def test_noise_that_is_none_is_not_the_policys_fault(n_envs):
    noise = NormalActionNoise(np.full(2, np.nan), np.zeros(2))
    env = DummyVecEnv([lambda: CounterEnv(5, observation_space=BOX)] * n_envs)
    with pytest.raises(ValueError, match=r"(?s)action_noise gives .*nan.*; expected finite numbers"):
        DrQv2("MlpPolicy", env, preset="tiny", action_noise=noise).learn(20)
