"""What users hand to either algorithm meets the same rules: one clear error before anything is built."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.sac.policies import SACPolicy

from sb3_dreamer_urlb import DreamerV2, DrQv2, FineTuneCallback, PhaseSwitchCallback
from sb3_dreamer_urlb.dreamer_v2.policies import DreamerPolicy
from sb3_dreamer_urlb.drq_v2.policies import DrQPolicy
from sb3_dreamer_urlb.intrinsic import TransitionReward
from sb3_dreamer_urlb.replay import SequenceReplayBuffer
from sb3_dreamer_urlb.replay.n_step import NStepFrameReplayBuffer

#: algorithm, its policies, its replay, a way to explore
KINDS = [
    (DreamerV2, DreamerPolicy, SequenceReplayBuffer, "lbs"),
    (DrQv2, DrQPolicy, NStepFrameReplayBuffer, "disagreement"),
]
each = pytest.mark.parametrize(("algorithm", "policy", "replay", "method"), KINDS, ids=["dreamer_v2", "drq_v2"])


def make(algorithm, policy="CnnPolicy", **kwargs):
    return algorithm(policy, CounterEnv(9), **{"preset": "tiny", "seed": 0, "device": "cpu", **kwargs})


@each
@pytest.mark.parametrize("given", [SACPolicy, th.nn.Linear, dict, 3, None, len])
def test_a_policy_that_is_none_of_its_own_is_named(algorithm, policy, replay, method, given):
    with pytest.raises(ValueError, match=rf"policy must be one of \['CnnPolicy', .*or a subclass of {policy.__name__}, got "):
        make(algorithm, given)


@each
def test_each_refuses_the_others_policy(algorithm, policy, replay, method):
    (other,) = (kind for _, kind, *_ in KINDS if kind is not policy)
    with pytest.raises(ValueError, match=f"subclass of {policy.__name__}, got .*{other.__name__}"):
        make(algorithm, other)


@each
@pytest.mark.parametrize("name", ["stor", "optimize_memory_usage", "buffer_size", "device", "n_envs", "phase", "batch_length"])
def test_arguments_that_the_replay_has_not_are_named(algorithm, policy, replay, method, name):
    with pytest.raises(
        ValueError, match=rf"Unknown replay_buffer_kwargs \['{name}'\]; known are .*'max_episode_rows'.*'store'"
    ):
        make(algorithm, replay_buffer_kwargs={name: 1})


@each
def test_arguments_of_a_replay_of_ones_own_are_known(algorithm, policy, replay, method):
    class Own(replay):
        def __init__(self, *args, shade=0, **kwargs):
            super().__init__(*args, **kwargs)
            self.shade = shade

    assert make(algorithm, replay_buffer_class=Own, replay_buffer_kwargs={"shade": 7}).replay_buffer.shade == 7


BAD_CHOICES = [
    *(({"keep_actor": value}, f"keep_actor must be True, False or None, got {value!r}") for value in ("yes", 1, 0)),
    *(({"keep_critic": value}, f"keep_critic must be True or False, got {value!r}") for value in (None, "no", 0)),
    *(({"keep_reward": value}, f"keep_reward must be True or False, got {value!r}") for value in (None, "no", 1)),
]


@each
@pytest.mark.parametrize(("kwargs", "message"), BAD_CHOICES)
def test_what_fine_tuning_keeps_is_true_or_false(algorithm, policy, replay, method, kwargs, message):
    model = make(algorithm, intrinsic_reward=method)
    with pytest.raises(ValueError, match=message):
        model.fine_tune(**kwargs)
    assert model.phase == "pretraining"


@pytest.mark.parametrize("callback", [PhaseSwitchCallback, FineTuneCallback])
@pytest.mark.parametrize(("kwargs", "message"), BAD_CHOICES)
def test_callbacks_say_so_when_they_are_made(callback, kwargs, message):
    with pytest.raises(ValueError, match=message):
        callback(**kwargs)
    assert callback(keep_actor=np.bool_(True)).keep_actor is True


# -- assigned --------------------------------------------------------------------------------------------------------------

#: another value for each argument of DrQv2 that can be assigned
VALUES = {
    "learning_rate": 2e-4,
    "adam_eps": 1e-3,
    "batch_size": 3,
    "tau": 0.5,
    "gamma": 0.5,
    "noise_std": (1.0, 0.5, 20),
    "noise_clip": 0.1,
    "learning_starts": 12,
    "train_freq": 2,
    "gradient_steps": 2,
    "action_noise": NormalActionNoise([0.0, 0.0], [0.1, 0.1]),
    "overlap": False,
    "verbose": 0,
    "tensorboard_log": None,
}


def test_the_values_are_all_there_are():
    assert VALUES.keys() == DrQv2.assignable


@pytest.mark.parametrize("name", sorted(VALUES))
def test_an_assigned_model_is_one_that_was_made_so(weights, name):
    assigned, made = make(DrQv2), make(DrQv2, **{name: VALUES[name]})
    setattr(assigned, name, VALUES[name])
    for model in (assigned, made):
        model.set_random_seed(1)
        model.learn(24)
    assert weights(assigned.policy) == weights(made.policy)
    assert assigned.learner.config == made.learner.config
    if name not in ("overlap", "verbose", "tensorboard_log"):
        assert weights(make(DrQv2).learn(24).policy) != weights(made.policy)


@pytest.mark.parametrize("name", sorted(set(DrQv2.argument_names()) - VALUES.keys() - {"stats_window_size"}))
def test_what_was_built_is_not_assigned(name):
    model = make(DrQv2)
    before = getattr(model, name)
    with pytest.raises(AttributeError, match=rf"{name} cannot be assigned.*DrQv2.load\(path, {name}=\.\.\.\)"):
        setattr(model, name, before)
    assert getattr(model, name) is before


@pytest.mark.parametrize(("name", "value"), [("tau", 0), ("gamma", "x"), ("noise_std", -1), ("learning_rate", None)])
def test_bad_values_leave_the_old_ones(name, value):
    model = make(DrQv2)
    before, config = getattr(model, name), model.learner.config
    with pytest.raises(ValueError, match=name):
        setattr(model, name, value)
    assert getattr(model, name) == before and model.learner.config is config


# -- a method of one's own -------------------------------------------------------------------------------------------------


def test_a_method_that_does_not_say_what_a_step_is_worth_is_refused():
    class Silent(TransitionReward):
        pass

    with pytest.raises(ValueError, match=r"Silent does not say what its reward is"):
        make(DrQv2, intrinsic_reward=Silent)
    with pytest.raises(TypeError, match="reward"):
        Silent()
